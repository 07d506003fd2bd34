"""The full-size log crane against plane geometry and statics, written out by hand.

Numbers in this file are those of the machine's sources, not read from its files.
"""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from oracles import COMPLEX_STEP, GRAVITY, angle, at_angle, circles, constraint_dynamics, turned

import crane
from crane.view.page import build_scene
from crane.view.page.scene import link_poses

# pins in the frames of their bodies, (x, y) in the plane
LIFT_PIN, LIFT_BASE = np.array([-0.09, 1.4261]), np.array([0.17, 0.386113])
LIFT_ROD, TILT_BASE = np.array([0.3025, -0.105]), np.array([1.263, 0.206702])
BRACKET, ELBOW = np.array([2.69, -0.006593]), np.array([2.881081, 0.021593])
FAR, LENGTH, EYE = np.array([0.457227, -0.0425]), 0.475, np.array([-0.095, 0.24043])
EXTENSION, TIP = np.array([-0.415, 0.195]), np.array([2.113, 0.26])
AREA_A, AREA_B = 7.854e-3, 5.391e-3
LOAD = 211.4
STROKES = np.array([0.535, 0.780, 1.2])
LIFTING = Path(__file__).parents[2] / "shared" / "data" / "patu655" / "lifting_first_half.csv"
measured = pytest.mark.skipif(
    not LIFTING.exists(), reason="the recordings, ../shared/data, are not there"
)
REST = np.array([0.0, 0.117, 0.246, 0.0])  # boom level, tilt boom 45 degrees down, rod in


def cylinder(length, stroke):
    """(mass, COM from the base pin or from the eye) of barrel and rod: tubes and bars of steel."""
    tube, rod = length - 0.10, length - 0.08
    wall = 7850 * np.pi / 4 * (0.12**2 - 0.10**2) * (tube - 0.04)
    bottom = 7850 * np.pi / 4 * 0.12**2 * 0.04
    bar = 7850 * np.pi / 4 * 0.056**2 * rod
    piston = 7850 * np.pi / 4 * (0.10**2 - 0.056**2) * 0.05
    barrel = (wall * (tube + 0.04) / 2 + bottom * 0.02) / (wall + bottom)
    eye = (-bar * rod / 2 + piston * (0.025 - rod)) / (bar + piston)
    return (wall + bottom, barrel), (bar + piston, length + stroke + eye)


def column(point):
    return point[:, None]


def plane(lift, tilt):
    """Pins (2, N) in the crane's plane and angles (N,) of the bodies, by circles that meet."""
    ones = np.ones_like(lift)
    at = {"lift": column(LIFT_PIN) * ones, "base": column(LIFT_BASE) * ones}
    at["rod"] = circles(at["base"], 0.820 + lift, at["lift"], np.hypot(*LIFT_ROD), -1)
    turn = {"boom": angle(*(at["rod"] - at["lift"])) - np.arctan2(LIFT_ROD[1], LIFT_ROD[0])}
    for name, pin_ in (("tilt_base", TILT_BASE), ("bracket", BRACKET), ("elbow", ELBOW)):
        at[name] = at["lift"] + turned(turn["boom"], column(pin_))
    at["far"] = circles(at["tilt_base"], 1.050 + tilt, at["bracket"], np.hypot(*FAR), 1)
    at["eye"] = circles(at["far"], LENGTH, at["elbow"], np.hypot(*EYE), 1)
    turn["bracket1"] = angle(*(at["far"] - at["bracket"])) - np.arctan2(FAR[1], FAR[0])
    turn["bracket2"] = angle(*(at["eye"] - at["far"]))
    turn["tilt"] = angle(*(at["eye"] - at["elbow"])) - np.arctan2(EYE[1], EYE[0])
    turn["lift_cylinder"] = angle(*(at["rod"] - at["base"]))
    turn["tilt_cylinder"] = angle(*(at["far"] - at["tilt_base"]))
    return at, turn


def passive(lift, tilt):
    _, turn = plane(lift, tilt)
    return {
        "q2": turn["boom"],
        "q3": turn["tilt"] - turn["boom"],
        "lift_barrel": turn["lift_cylinder"],
        "tilt_barrel": turn["tilt_cylinder"] - turn["boom"],
        "bracket1": turn["bracket1"] - turn["boom"],
        "bracket2": turn["bracket2"] - turn["bracket1"],
    }


def bodies(lift, tilt, extension, load=0.0):
    """{name: (mass, COM (2, N))} of all that moves."""
    at, turn = plane(lift, tilt)
    arm = at["elbow"], turn["tilt"]
    far = at["far"], turn["bracket2"]
    out = 1.0 * extension
    table = {
        "lift boom": (143.66, at["lift"], turn["boom"], (1.229248, 0.055596)),
        "bracket 1": (11.524, at["bracket"], turn["bracket1"], (0.257068, 0.004)),
        "bracket 2": (7.900, *far, (0.212792, 0.0)),
        "tilt boom": (76.70, *arm, (0.497, 0.239)),
        "extension": (58.63, *arm, (EXTENSION[0] + 1.15 + out, EXTENSION[1] + 0.06)),
        "load": (load, *arm, (TIP[0] + out, TIP[1])),
    }
    for name, base, length, stroke in (
        ("lift", "base", 0.820, lift),
        ("tilt", "tilt_base", 1.050, tilt),
    ):
        (barrel, near), (rod, along) = cylinder(length, stroke)
        direction = turn[f"{name}_cylinder"]
        table[f"{name} barrel"] = (barrel, at[base], direction, (near, 0.0))
        table[f"{name} rod"] = (rod, at[base], direction, (along, 0.0))
    zero = np.zeros_like(lift)
    return {
        name: (mass, start + turned(direction, np.array([com[0] + zero, com[1] + zero])))
        for name, (mass, start, direction, com) in table.items()
    }


def draw(count, seed):
    random = np.random.default_rng(seed)
    strokes = random.uniform(size=(count, 3)) * STROKES
    return np.column_stack([random.uniform(-3.4, 3.4, count), strokes])


def slope(function, *at):
    """d function / d argument i of real arrays, exact to rounding."""
    found = []
    for i in range(len(at)):
        moved = [x + (1j * COMPLEX_STEP if i == j else 0) for j, x in enumerate(at)]
        found.append(np.imag(function(*moved)) / COMPLEX_STEP)
    return np.array(found)


@pytest.fixture(scope="module")
def loaded():
    return crane.load("patu655", {"payload.mass": LOAD})


# --- geometry --------------------------------------------------------------------------------


def test_it_is_the_machine_of_the_sources(patu):
    assert patu.active == ("slew", "X_lift", "X_tilt", "X_ext")
    assert np.allclose(patu.lower[1:], 0) and np.allclose(patu.upper[1:], STROKES)
    assert [loop.name for loop in patu.closure.equations.loops] == [
        "lift_eye", "tilt_eye", "bracket2_eye",
    ]  # fmt: skip


def test_the_lift_cylinder_is_the_side_of_a_triangle(patu):
    """Law of cosines between pillar and lift boom over the whole stroke; dx/dq = the lever."""
    stroke = np.linspace(0, 0.535, 200)
    q_a = np.tile(patu.home[patu.closure.active], (200, 1))
    q_a[:, 1] = stroke
    q = patu.closure.solve(q_a)
    q2 = q[:, patu.column("q2")]
    arm, post = np.hypot(*LIFT_ROD), np.hypot(*(LIFT_BASE - LIFT_PIN))
    down = LIFT_BASE - LIFT_PIN
    between = q2 + np.arctan2(LIFT_ROD[1], LIFT_ROD[0]) - np.arctan2(down[1], down[0])
    length = np.sqrt(arm**2 + post**2 - 2 * arm * post * np.cos(between))
    assert np.abs(length - 0.820 - stroke).max() < 1e-12
    lever = arm * post * np.sin(between) / length  # x'(q2), equations (18) and (19)
    gamma = patu.closure.gamma(q)[:, patu.column("q2")]
    assert np.abs(gamma[:, 1] * lever - 1).max() < 1e-11
    assert np.abs(gamma[:, [0, 2, 3]]).max() < 1e-12


def test_all_passive_joints_are_those_of_circles_that_meet(patu):
    q_a = draw(400, 1)
    q_a[:4, 1:3] = [[0, 0], [0, 0.780], [0.535, 0], [0.535, 0.780]]
    q = patu.closure.solve(q_a)
    gamma = patu.closure.gamma(q)
    wanted = passive(q_a[:, 1], q_a[:, 2])
    for name, value in wanted.items():
        gap = q[:, patu.column(name)] - value
        assert np.abs(gap - 2 * np.pi * np.round(gap / (2 * np.pi))).max() < 1e-11
        rows = slope(lambda x, y, name=name: passive(x, y)[name], q_a[:, 1], q_a[:, 2]).T
        found = gamma[:, patu.column(name)]
        assert np.abs(found[:, 1:3] - rows).max() < 1e-9
        assert np.abs(found[:, [0, 3]]).max() < 1e-12


def test_the_whole_range_of_strokes_is_reached_without_a_dead_centre(patu):
    """The rods carry both booms from end to end, one way, and never with a vanishing lever."""
    grid = np.stack(np.meshgrid(np.linspace(0, 0.535, 30), np.linspace(0, 0.780, 40)), -1)
    grid = grid.reshape(-1, 2)
    q_a = np.column_stack([np.zeros(len(grid)), grid, np.zeros(len(grid))])
    q = patu.closure.solve(q_a)
    gamma = patu.closure.gamma(q)
    q2, q3 = (np.rad2deg(q[:, patu.column(name)]) for name in ("q2", "q3"))
    assert (round(q2.min()), round(q2.max())) == (-24, 92)
    assert (round(q3.min()), round(q3.max())) == (-191, 0)
    lift, tilt = gamma[:, patu.column("q2"), 1], -gamma[:, patu.column("q3"), 2]
    assert 1 / lift.max() > 0.13 and 1 / lift.min() < 0.33  # levers [m]
    assert 1 / tilt.max() > 0.095 and 1 / tilt.min() < 0.34
    assert max(np.linalg.cond(rows) for rows in gamma) < 13
    patu.check_limits(q_a)


def test_with_both_rods_in_the_booms_are_in_line_as_in_the_sources(patu):
    """Source A's model starts with the lift boom at -1.2 and the tilt boom at -1.6 degrees, and
    the far pin of bracket 1 at (2.33, 0.2203) from the lift boom's pin."""
    q = patu.closure.solve([0, 0.11, 0, 0])
    data = patu.model.createData()
    pin.framesForwardKinematics(patu.model, data, q)
    far = data.oMf[patu.frame("bracket1_far")].translation[[0, 2]] - LIFT_PIN
    turn = -np.deg2rad(1.227) - q[patu.column("q2")]
    assert np.abs(turned(turn, far) - [2.33, 0.2203]).max() < 0.03
    assert abs(np.rad2deg(q[patu.column("q3")]) + 0.35) < 0.5


def test_the_tip_runs_out_along_the_tilt_boom(patu):
    q_a = draw(50, 2)
    at, turn = plane(q_a[:, 1], q_a[:, 2])
    reach = np.array([TIP[0] + q_a[:, 3], np.full(50, TIP[1])])
    r, z = at["elbow"] + turned(turn["tilt"], reach)
    wanted = np.column_stack([r * np.cos(q_a[:, 0]), r * np.sin(q_a[:, 0]), z])
    assert np.abs(crane.Kinematics(patu).position(q_a) - wanted).max() < 1e-12


# --- masses and forces -----------------------------------------------------------------------


def test_masses_and_their_centre_add_up(patu):
    assert sum(patu.model.inertias[i].mass for i in range(1, 11)) == pytest.approx(
        93.26 + 143.66 + 11.524 + 7.9 + 76.70 + 58.63 + sum(
            mass for length in (0.820, 1.050) for mass, _ in cylinder(length, 0.0)
        ), abs=2e-3,
    )  # fmt: skip
    data = patu.model.createData()
    for q_a in draw(20, 3):
        moving = bodies(*(q_a[i : i + 1] for i in (1, 2, 3))).values()
        moment = 93.26 * np.array([-0.017403, 0.577291])
        moment = moment + sum(mass * com[:, 0] for mass, com in moving)
        r, z = moment / (93.26 + sum(mass for mass, _ in moving))
        centre = pin.centerOfMass(patu.model, data, patu.closure.solve(q_a))
        assert np.abs(centre - [r * np.cos(q_a[0]), r * np.sin(q_a[0]), z]).max() < 1e-5


def test_weight_in_the_cylinders_is_the_slope_of_the_potential(patu):
    q_a = draw(100, 4)

    def potential(lift, tilt, extension):
        return GRAVITY * sum(mass * com[1] for mass, com in bodies(lift, tilt, extension).values())

    wanted = slope(potential, *q_a[:, 1:].T).T
    found = crane.Dynamics(patu).gravity(q_a)
    assert np.abs(found[:, 0]).max() < 1e-9
    assert np.abs(found[:, 1:] - wanted).max() < 1e-4 * np.abs(wanted).max()  # rounded masses


def holding_force(load):
    """X_lift's force at rest by three balances of moments and forces; all of `REST`."""
    one = [np.array([x]) for x in REST[1:]]
    at, turn = plane(*one[:2])
    at = {name: point[:, 0] for name, point in at.items()}
    parts = {name: (m, com[:, 0]) for name, (m, com) in bodies(*one, load).items()}
    own = {name: parts.pop(name) for name in ("lift barrel", "lift rod")}
    along = at_angle(turn["lift_cylinder"][0])
    across = np.array([-along[1], along[0]])
    # the cylinder about its base pin: its weight leans on the eye
    lean = -GRAVITY * sum(m * (com - at["base"])[0] for m, com in own.values())
    lean /= 0.820 + REST[1]
    # what the boom carries, about the boom's pin
    weight = GRAVITY * sum(m * (com - at["lift"])[0] for m, com in parts.values())
    arm = at["rod"] - at["lift"]
    lever = arm[0] * along[1] - arm[1] * along[0]
    push = (weight - lean * (arm[0] * across[1] - arm[1] * across[0])) / lever
    return push + own["lift rod"][0] * GRAVITY * along[1]


def pressure(force):
    """p_A [bar] with the ring side at 1 bar."""
    return (force + AREA_B * 1e5) / AREA_A / 1e5


def test_the_lift_cylinder_holds_what_was_measured(patu, loaded):
    """66 bar at rest and 72 bar as it starts, with the load; about half without it.

    The posture is known to a few degrees only: 5 degrees of the tilt boom are 2 bar.
    """
    forces = [crane.Dynamics(machine).gravity(REST)[1] for machine in (patu, loaded)]
    assert forces[0] == pytest.approx(holding_force(0.0), rel=1e-5)
    assert forces[1] == pytest.approx(holding_force(LOAD), rel=1e-5)
    empty, full = (pressure(force) for force in forces)
    assert 62 < full < 76 and 0.4 < empty / full < 0.55
    at, turn = plane(REST[1:2], REST[2:3])
    assert abs(np.rad2deg(turn["boom"][0])) < 1 and abs(np.rad2deg(turn["tilt"][0]) + 45) < 1


@pytest.mark.parametrize("mass", [0.0, LOAD])
def test_forward_dynamics_are_those_of_multipliers(mass):
    machine = crane.load("patu655", {"payload.mass": mass})
    dynamics, random = crane.Dynamics(machine), np.random.default_rng(5)
    for q_a in draw(12, 6):
        v_a = random.normal(size=4) * [0.3, 0.05, 0.05, 0.3]
        tau_a = dynamics.gravity(q_a) * random.uniform(0.8, 1.2, 4)
        q = machine.closure.solve(q_a)
        v, tau = machine.closure.gamma(q) @ v_a, np.zeros(machine.model.nv)
        tau[machine.closure.active] = tau_a
        wanted = constraint_dynamics(machine, q, v, tau)[machine.closure.active]
        found = dynamics.forward(q_a, v_a, tau_a)
        assert np.abs(found - wanted).max() < 1e-7 * max(1.0, np.abs(wanted).max())


def test_mass_matrix_is_kinetic_energy(patu):
    """Slewing aside: sum of m v^2 and I w^2 of the bodies, from complex steps of their places."""
    q_a = draw(30, 7)
    strokes = q_a[:, 1:].T
    inertia = {
        "lift boom": ("boom", 67.0537), "bracket 1": ("bracket1", 0.268644),
        "bracket 2": ("bracket2", 0.216772), "extension": ("tilt", 28.70),
        "tilt boom": ("tilt", 51.45 - 76.70 * (0.497**2 + 0.239**2)),
    }  # fmt: skip
    M = crane.Dynamics(patu).mass_matrix(q_a)[:, 1:, 1:]
    wanted = np.zeros_like(M)
    for name, (mass, _) in bodies(*strokes).items():
        speed = slope(lambda *x, name=name: bodies(*x)[name][1], *strokes)
        wanted += mass * np.einsum("ikn,jkn->nij", speed, speed)
        turn, about = inertia.get(name, ("", 0.0))
        for cylinder_ in ("lift", "tilt"):
            if name.startswith(f"{cylinder_} ") and "boom" not in name:
                body = patu.model.getJointId(
                    f"{cylinder_}_barrel" if "barrel" in name else f"X_{cylinder_}"
                )
                turn, about = f"{cylinder_}_cylinder", patu.model.inertias[body].inertia[2, 2]
        if turn:
            rate = slope(lambda x, y, e, turn=turn: plane(x, y)[1][turn] + 0 * e, *strokes)
            wanted += about * np.einsum("in,jn->nij", rate, rate)
    assert np.abs(M - wanted).max() < 1e-4 * np.abs(wanted).max()


# --- what it does ----------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["reach", "swing"])
def test_tasks_start_and_stop_smoothly_within_limits(patu, task):
    motion = patu.tasks[task]
    time = np.linspace(0, motion.duration, 201)
    q_a = np.empty((201, 4))
    for i, name in enumerate(patu.active):
        curve = np.polynomial.Polynomial(motion.coefficients[name])
        q_a[:, i] = curve(time)
        for order in (1, 2):
            ends = curve.deriv(order)([0.0, motion.duration])
            assert np.abs(ends).max() < 1e-6
        model = patu.model.joints[patu.model.getJointId(name)]
        fastest = patu.model.velocityLimit[model.idx_v]
        assert np.abs(curve.deriv()(time)).max() < fastest
    patu.check_limits(q_a)
    assert np.abs(q_a[0] - patu.home[patu.closure.active]).max() < 1e-12
    assert np.abs(np.linalg.norm(patu.closure.residual(patu.closure.solve(q_a[-1])))) < 1e-12


def test_it_stands_where_its_cylinders_hold_it(loaded):
    """The forces of gravity hold the crane still; without them the boom sinks."""
    dynamics = crane.Dynamics(loaded)
    q_a = loaded.home[loaded.closure.active]
    still = dynamics.forward(q_a, np.zeros(4), dynamics.gravity(q_a))
    assert np.abs(still).max() < 1e-9
    falling = dynamics.forward(q_a, np.zeros(4), np.zeros(4))
    assert falling[1] < 0


def test_pins_of_the_drawing_coincide(patu):
    pins = {
        "lift_eye": "lift_boom_rod", "tilt_eye": "bracket1_far",
        "bracket2_eye": "tilt_boom_bracket", "lift_barrel": "pillar_cylinder",
        "tilt_barrel": "lift_boom_cylinder", "bracket1": "lift_boom_bracket",
        "tilt_boom": "lift_boom_elbow", "lift_boom": "pillar_boom",
    }  # fmt: skip
    poses = link_poses(patu, patu.closure.solve(draw(30, 9)), [*pins, *pins.values()])
    for one, two in pins.items():
        gap = poses[one][:, :3, 3] - poses[two][:, :3, 3]
        axes = poses[one][:, :3, 2] - poses[two][:, :3, 2]
        assert np.abs(gap).max() < 1e-12 and np.abs(axes).max() < 1e-9


# --- the load --------------------------------------------------------------------------------


def test_the_load_is_a_point_at_the_tip_that_turns_with_the_slewing_gear_alone(patu, loaded):
    """In every posture, by weight and by inertia; in the source at (2.113, 0.26), extension in."""
    q_a = draw(50, 11)
    point = patu.with_payload(crane.Payload("tip", LOAD))
    one, two = (crane.Dynamics(machine) for machine in (loaded, point))
    assert np.abs(one.gravity(q_a) - two.gravity(q_a)).max() < 1e-8
    more = one.mass_matrix(q_a) - two.mass_matrix(q_a)
    # about the vertical a log of 3 m and 0.32 m that lies across, and the grapple
    about = 191.4 * (3 * 0.16**2 + 3.0**2) / 12 + 0.4
    assert np.abs(more[:, 0, 0] - about).max() < 1e-6
    more[:, 0, 0] = 0.0
    assert np.abs(more).max() < 1e-8
    at, turn = plane(q_a[:, 1], q_a[:, 2])
    r, z = at["elbow"] + turned(turn["tilt"], np.array([TIP[0] + q_a[:, 3], np.full(50, TIP[1])]))
    data = loaded.model.createData(), patu.model.createData()
    for i, posture in enumerate(loaded.closure.solve(q_a)):
        moments = [
            pin.centerOfMass(machine.model, data[k], posture)
            * sum(body.mass for body in machine.model.inertias[1:])
            for k, machine in enumerate((loaded, patu))
        ]
        where = (moments[0] - moments[1]) / LOAD
        slew = q_a[i, 0]
        assert np.abs(where - [r[i] * np.cos(slew), r[i] * np.sin(slew), z[i]]).max() < 1e-9


def test_the_load_is_drawn_hanging_at_home(loaded):
    poses = link_poses(loaded, loaded.home[None], ["tip", "log"])
    tip = poses["tip"][0]
    assert np.abs(tip[:3, 1] - [0, 0, 1]).max() < 0.01
    assert np.abs(poses["log"][0] - tip).max() < 1e-12


def test_the_load_is_scaled_and_drawn(patu, loaded):
    """Half the mass adds half of the mass matrix; the log is in the scene."""
    q_a = draw(10, 10)
    half = crane.load("patu655", {"payload.mass": LOAD / 2})
    bare, part, full = (crane.Dynamics(m).mass_matrix(q_a) for m in (patu, half, loaded))
    assert np.abs(full - 2 * part + bare).max() < 1e-12 * np.abs(full).max()

    def drawn(machine):
        return any(
            "/log/" in str(command.get("path")) for command in build_scene(machine).commands
        )

    assert drawn(loaded) and drawn(half) and not drawn(patu)
    assert not drawn(crane.load("patu655", {"payload.mass": 0.0}))


def test_end_stops_are_as_stiff_as_the_cylinders():
    """Tube and rod of steel in series between the pins, the rod out: E / (Lt / At + Lr / Ar)."""
    stiffness = {stop.joint: stop.stiffness for stop in crane.load("patu655").end_stops}
    tube, rod = np.pi / 4 * (0.12**2 - 0.10**2), np.pi / 4 * 0.056**2
    for joint, length in (("X_lift", 0.820), ("X_tilt", 1.050)):  # pin to pin with the rod in
        # of the tube its first 40 mm are solid, of the rod 50 mm are the piston
        stretched = (length - 0.10 - 0.04) / tube + (length - 0.08 - 0.05) / rod
        assert stiffness[joint] == pytest.approx(2.1e11 / stretched, rel=0.01)
    tube, rod = np.pi / 4 * (1.2**2 - 1) * 0.063**2, np.pi / 4 * 0.036**2
    length = 1.2 + 2 * 0.063  # stroke, piston and gland
    assert stiffness["X_ext"] == pytest.approx(2.1e11 / (length / tube + length / rod), rel=0.01)


# --- what was measured -----------------------------------------------------------------------


def band(values, low=1.2, high=6.5):
    """What of samples at 100 Hz lies in a band [Hz]."""
    from scipy.signal import butter, sosfiltfilt

    return sosfiltfilt(butter(3, [low, high], "bandpass", fs=100, output="sos"), values)


@measured
def test_it_rings_as_the_crane_did():
    """Nothing is fitted: the valve's signal as recorded, the load as printed.

    Frequency and size of the lift pressure's swing over ten seconds; a rigid boom rings at twice
    the frequency, with a tenth of the size.
    """
    log = np.genfromtxt(LIFTING, delimiter=",", names=True)
    time, rings = log["t_s"], {}
    start = [(log[name][:75].mean() - rod_in) / 1e3
             for name, rod_in in (("s1_mm", 820), ("s2_mm", 1050))]  # fmt: skip
    for name, changes in (("file", {}), ("rigid", {"cylinder.X_lift.stiffness": 0.0})):
        machine = crane.load(
            "patu655", {"payload.mass": LOAD, **changes}, lock={"slew": 0.0, "X_ext": 0.0}
        )
        run = crane.simulate(
            machine, crane.control.ValveSignals(machine, time, {"X_lift": log["U1_V"]}),
            initial=(start, [0.0, 0.0]), duration=13.5,
        )  # fmt: skip
        rings[name] = band(np.interp(time, run.time, run.channels["pressure_X_lift_a"]))
    rings["crane"] = band(log["p1_Pa"])
    some = (time > 2.5) & (time < 9.0)

    def frequency(x):
        swing = np.abs(np.fft.rfft(x[some] * np.hanning(some.sum()), 1 << 14))
        return np.fft.rfftfreq(1 << 14, 0.01)[swing.argmax()]

    assert frequency(rings["crane"]) == pytest.approx(2.15, abs=0.1)
    assert frequency(rings["file"]) == pytest.approx(frequency(rings["crane"]), rel=0.07)
    for low, high in ((2.2, 4.0), (4.0, 6.0), (6.0, 8.0), (8.0, 10.0)):
        part = (time > low) & (time < high)
        size = {name: x[part].std() for name, x in rings.items()}
        assert size["file"] == pytest.approx(size["crane"], rel=0.2)
        assert size["rigid"] < 0.2 * size["crane"]


@measured
def test_the_boom_moves_farther_than_its_rod():
    """By F / k: the gyro's angle times the lever less the length sensor's way, while it rings."""
    log = np.genfromtxt(LIFTING, delimiter=",", names=True)
    time, machine = log["t_s"], crane.load("patu655", lock={"slew": 0.0, "X_ext": 0.0})
    rod = (log["s1_mm"] - 820) / 1e3
    q = machine.closure.solve(np.column_stack([rod, np.full_like(rod, 0.231)]))
    lever = 1 / machine.closure.gamma(q)[:, machine.column("q2"), 0]
    w = 2 * np.pi * np.fft.rfftfreq(len(time), 0.01)
    rate = np.fft.rfft(band(np.deg2rad(log["z1dot_degps"]), 1.5, 3.0))
    boom = lever * np.fft.irfft(np.divide(rate, 1j * w, where=w > 0, out=0 * rate), len(time))
    rod = band(rod, 1.5, 3.0)
    force = band(AREA_A * log["p1_Pa"] - AREA_B * log["p2_Pa"], 1.5, 3.0)
    some = (time > 2.2) & (time < 9.0)
    gives = -force[some] @ (boom - rod)[some] / (force[some] @ force[some])
    assert 1 / gives == pytest.approx(machine.hydraulics.cylinders["X_lift"].stiffness, rel=0.2)
