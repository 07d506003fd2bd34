"""Free joints and joints without actuator: paper, MuJoCo, Pinocchio; allowed operations."""

import dataclasses
import warnings

import hanging_loads
import numpy as np
import pinocchio as pin
import pytest
from command_line import typed
from oracles import constraint_dynamics
from rig import Rig, Tolerances
from rig.sensors import default_sensors
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve
from warned import quiet

import crane
from crane.common.errors import CraneError, CraneWarning

GRAVITY = 9.81
BACKENDS = ("compiled", "pinocchio")


@pytest.fixture
def machine(tmp_path):
    return crane.load(hanging_loads.file(tmp_path))


# --- a double pendulum that hangs from a tip that moves --------------------------------------

LENGTH, FIRST = 3.0, 0.4  # of the boom, of the upper pendulum
BOOM, UPPER, LOWER = (120.0, 1.4, 90.0), (14.0, 0.15, 0.8), (160.0, 0.7, 21.0)  # m, c, J at c
DOUBLE = (
    '<robot name="double"><link name="base"/>'
    + hanging_loads.link("boom", BOOM[0], f"{BOOM[1]} 0 0", (1, 0, 0, BOOM[2], 0, BOOM[2]))
    + hanging_loads.link("upper", UPPER[0], f"0 0 -{UPPER[1]}", (UPPER[2], 0, 0, UPPER[2], 0, 0.1))
    + hanging_loads.link("lower", LOWER[0], f"0 0 -{LOWER[1]}", (LOWER[2], 0, 0, LOWER[2], 0, 9))
    + hanging_loads.link("tube", 40, "-0.5 0 0", (1, 0, 0, 8, 0, 8))
    + hanging_loads.joint(
        "lift", "base", "boom", "0 0 0", "0 -1 0", hanging_loads.limits(-1, 2, 1e5)
    )
    + hanging_loads.joint(
        "reach",
        "boom",
        "tube",
        f"{LENGTH} 0 0",
        "1 0 0",
        hanging_loads.limits(0, 2, 1e5),
        "prismatic",
    )
    + hanging_loads.joint("one", "tube", "upper", "0 0 0", "0 -1 0")
    + hanging_loads.joint("two", "upper", "lower", f"0 0 -{FIRST}", "0 -1 0")
    + "</robot>"
)


def by_lagrange(q, v, a_d):
    """Forces of lift and reach, accelerations of both pins, of the motion of these two.

    With x, z the tip, t1 and t2 the angles of the pendulums against the vertical, l the length of
    the first, c and J distance and inertia of the centres of mass, s and k sine and cosine:

        L = m1/2 |p1'|^2 + J1/2 t1'^2 + m2/2 |p2'|^2 + J2/2 t2'^2 - m1 g z1 - m2 g z2,
        p1 = (x + c1 s1, z - c1 k1),    p2 = (x + l s1 + c2 s2, z - l k1 - c2 k2),

    d/dt dL/dt' = dL/dt of both angles solved for t'' at x'', z'', and of the boom's angle f and
    the tube's way r with x = (L + r) cos f, z = (L + r) sin f.
    """
    (f, r, one, two), (w, u, w1, w2), (e, b) = q, v, a_d
    # the links hang down at zero on a boom that is level: their angles are those of all before
    t1, t2 = f + one, f + one + two
    w1, w2 = w + w1, w + w1 + w2
    radius, (mb, cb, jb), (m1, c1, j1), (m2, c2, j2) = LENGTH + r, BOOM, UPPER, LOWER
    away, around = b - radius * w**2, radius * e + 2 * u * w
    ax = away * np.cos(f) - around * np.sin(f)
    az = away * np.sin(f) + around * np.cos(f)
    mass = np.array(
        [
            [j1 + m1 * c1**2 + m2 * FIRST**2, m2 * FIRST * c2 * np.cos(t1 - t2)],
            [m2 * FIRST * c2 * np.cos(t1 - t2), j2 + m2 * c2**2],
        ]
    )
    bend = m2 * FIRST * c2 * np.sin(t1 - t2)
    right = -np.array(
        [
            bend * w2**2
            + (m1 * c1 + m2 * FIRST) * (ax * np.cos(t1) + (GRAVITY + az) * np.sin(t1)),
            -bend * w1**2 + m2 * c2 * (ax * np.cos(t2) + (GRAVITY + az) * np.sin(t2)),
        ]
    )
    e1, e2 = np.linalg.solve(mass, right)

    def swung(length, t, rate, rising):
        return length * np.array(
            [rising * np.cos(t) - rate**2 * np.sin(t), rising * np.sin(t) + rate**2 * np.cos(t)]
        )

    tip, weight = np.array([ax, az]), np.array([0.0, GRAVITY])
    pull = m1 * (tip + swung(c1, t1, w1, e1) + weight)
    pull += m2 * (tip + swung(FIRST, t1, w1, e1) + swung(c2, t2, w2, e2) + weight)
    along, across = np.array([np.cos(f), np.sin(f)]), np.array([-np.sin(f), np.cos(f)])
    m, j, rc = 40.0, 8.0, radius - 0.5  # the tube, whose centre is behind the tip
    lift = (jb + mb * cb**2) * e + mb * cb * GRAVITY * np.cos(f)
    lift += (j + m * rc**2) * e + 2 * m * rc * u * w + m * rc * GRAVITY * np.cos(f)
    lift += radius * (across @ pull)
    reach = m * (b - rc * w**2) + m * GRAVITY * np.sin(f) + along @ pull
    return np.array([lift, reach]), np.array([e1 - e, e2 - e1])


@pytest.fixture
def double(tmp_path):
    (tmp_path / "double.urdf").write_text(DOUBLE)
    return crane.load(tmp_path / "double.urdf", active=["lift", "reach"], free=["one", "two"])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_double_pendulum_on_a_moving_tip_is_that_of_lagrange(double, backend):
    dynamics, random = crane.Dynamics(double, backend=backend), np.random.default_rng(0)
    q = random.uniform([-1, 0, -3, -3], [2, 2, 3, 3], (40, 4))
    v, a_d = random.normal(size=(40, 4)), 3 * random.normal(size=(40, 2))
    wanted = [by_lagrange(*row) for row in zip(q, v, a_d, strict=True)]
    tau_d, a_f = dynamics.hybrid(q, v, a_d)
    for found, paper in zip((tau_d, a_f), map(np.array, zip(*wanted, strict=True)), strict=True):
        np.testing.assert_allclose(found, paper, rtol=1e-10, atol=1e-11 * np.abs(paper).max())
    both = dynamics.hybrid(q[0], v[0], a_d[0])
    np.testing.assert_allclose(np.concatenate(both), [*tau_d[0], *a_f[0]], rtol=1e-13)
    # the full inverse and forward dynamics agree, with no force at the pins
    tau = double.expand_driven(tau_d, "tau_d")
    np.testing.assert_allclose(dynamics.forward(q, v, tau), np.hstack([a_d, a_f]), rtol=1e-9)
    again = dynamics.inverse(q, v, np.hstack([a_d, a_f]))
    np.testing.assert_allclose(again, tau, rtol=0, atol=1e-10 * np.abs(tau).max())


def test_it_swings_as_its_equations_do_while_the_tip_is_driven(double):
    """Under computed torque the tip follows its reference, the pins the equations on paper."""
    path = crane.point_to_point([0.2, 0.3], [0.7, 1.1], 1.5)
    start = np.array([0.2, 0.3, 0.1, -0.5])
    run = crane.simulate(
        double, crane.ComputedTorque(double, path), initial=start, tolerance=1e-13
    )
    assert np.abs(run.tau[:, 2:]).max() == 0.0
    assert np.abs(run.q[:, :2] - path.position(run.time)).max() < 1e-10

    def rate(t, x):
        (q_d, v_d, a_d), (q_f, v_f) = path(t), np.split(x, 2)
        forces, a_f = by_lagrange(np.append(q_d, q_f), np.append(v_d, v_f), a_d)
        return np.append(v_f, a_f)

    found = solve_ivp(
        rate, (0, 1.5), [*start[2:], 0, 0], "DOP853", run.time, rtol=1e-12, atol=1e-13
    )
    np.testing.assert_allclose(run.q[:, 2:], found.y[:2].T, rtol=0, atol=1e-9)
    assert np.ptp(run.q[:, 3]) > 0.5


def test_accelerations_of_the_hanging_grapple_are_those_of_mujoco(machine, tmp_path):
    pytest.importorskip("mujoco")
    from mujoco_oracle import Oracle

    path = tmp_path / "hanging.xml"
    done = typed("convert", machine.path, path)
    assert done.returncode == 0, done.stderr
    same = crane.load(path)
    assert same.free == machine.free
    oracle, dynamics = Oracle(path, same), crane.Dynamics(machine)
    random = np.random.default_rng(1)
    for _ in range(8):
        q, v = random.uniform([-3, -0.5, -2, -2], [3, 1.3, 2, 2]), random.normal(size=4)
        a_d = random.normal(size=2)
        tau_d, a_f = dynamics.hybrid(q, v, a_d, friction=True)
        oracle.place(q, v)
        wanted = oracle.accelerations(oracle.forces(q, machine.expand_driven(tau_d, "tau_d")))
        np.testing.assert_allclose(
            [*a_d, *a_f], oracle_order(same, machine, wanted), rtol=0,
            atol=1e-10 * np.abs(wanted).max(),
        )  # fmt: skip


def oracle_order(same, machine, found):
    return [found[same.column(joint)] for joint in machine.active]


# --- what floats -----------------------------------------------------------------------------


def states(machine, count, seed=0):
    random, n = np.random.default_rng(seed), len(machine.active)
    home = machine.home[machine.closure.active]
    for _ in range(count):
        q_a = home + random.uniform(-0.25, 0.25, n)
        q_a[[machine.active.index(f"base_r{x}") for x in "xyz"]] = random.uniform(-1.5, 1.5, 3)
        yield q_a, random.normal(size=n), random.normal(size=1)


def test_a_floating_closed_chain_is_that_of_constraint_dynamics(tmp_path):
    """Driven crank, free hull and load: Pinocchio's free-flyer with multipliers."""
    machine = hanging_loads.floating_series(tmp_path)
    assert machine.driven_joints == ("turn",) and len(machine.free) == 7
    closure, dynamics = machine.closure, crane.Dynamics(machine)
    for q_a, v_a, a_d in states(machine, 10):
        q = closure.solve(q_a)
        tau_d, a_f = dynamics.hybrid(q_a, v_a, a_d)
        along = np.zeros(machine.model.nv)
        along[machine.column("turn")] = tau_d[0]
        v = closure.gamma(q) @ v_a
        wanted = constraint_dynamics(machine, q, v, along)[closure.active]
        a_a = machine.expand_driven(a_d, "a_d")
        a_a[~machine.is_driven] = a_f
        np.testing.assert_allclose(a_a, wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())


def test_momentum_is_kept_while_a_drive_moves_what_floats(tmp_path):
    """In weightlessness, under computed torque of the crank alone: both momenta stay."""
    machine = hanging_loads.floating_series(tmp_path)
    machine.model.gravity.linear = np.zeros(3)
    n, turn = len(machine.active), machine.active.index("turn")
    start, rates = np.array(machine.home[machine.closure.active]), np.zeros(n)
    rates[[machine.active.index(f"base_{x}") for x in ("x", "ry", "rz")]] = 0.3, 0.4, -0.6
    path = crane.point_to_point(start[[turn]], start[[turn]] + 0.5, 1.0)
    control = crane.ComputedTorque(machine, path)
    run = crane.simulate(machine, control, initial=(start, rates), tolerance=1e-13)
    assert np.ptp(run.q[:, turn]) > 0.4 and np.ptp(run.q[:, machine.active.index("sway")]) > 0.05
    free = ~machine.is_driven
    assert np.abs(run.tau[:, free]).max() == 0.0 and np.abs(run.tau).max() > 0.1
    data, found, size = machine.model.createData(), [], []
    for i in range(0, len(run.time), 50):
        q = machine.closure.solve(run.q[i])
        at, v = machine.coordinates.configuration(q), machine.closure.gamma(q) @ run.v[i]
        momentum = pin.computeCentroidalMomentum(machine.model, data, at, v)
        angular = momentum.angular + np.cross(data.com[0], momentum.linear)
        found.append([*momentum.linear, *angular])
    found = np.array(found)
    for part in (slice(0, 3), slice(3, 6)):
        size = np.linalg.norm(found[0, part])
        assert size > 1.0
        assert np.abs(found[:, part] - found[0, part]).max() < 1e-12 * size


# --- nobody drives them ----------------------------------------------------------------------


class Everywhere(crane.control.ControlLaw):
    def law(self, inputs):
        return [-v for v in inputs.v_a], ()


class Late:
    def start(self, q_a):
        return np.zeros(0)

    def __call__(self, time, q_a, v_a, state):
        return np.array([0.0, 0.0, 0.0, 5.0 * (time > 0.02)]), state


@pytest.mark.parametrize(
    ("control", "line"),
    [
        (Everywhere, "the controller gives the free joint 'swing_x' a force: give it 0.0, or name "
         "it under active if something drives it"),
        (lambda machine: Late(), "the controller gives the free joint 'swing_y' a force of 5 at "
         "t = 0.02"),
        (lambda machine: lambda t, q, v: np.array([0, 0, 3.0, 0]), "the controller gives the free "
         "joint 'swing_x' a force of 3 at t = 0 s"),
        (lambda machine: lambda t, q, v: np.zeros(3), "the controller's force at t = 0 s has the "
         "shape (3,), give (4,)"),
        (lambda machine: crane.PI(machine, crane.point_to_point([0] * 3, [1] * 3, 1.0)),
         "the reference has 3 coordinates, give the 2 of the driven joints (slew, lift)"),
        (lambda machine: crane.Dynamics(machine).hybrid([0] * 4, [0] * 4, [0] * 4),
         "a_d has the shape (4,), give (2,) or (N, 2) (slew, lift)"),
    ],
)  # fmt: skip
def test_no_force_on_what_is_free(machine, control, line):
    with pytest.raises(CraneError) as caught:
        crane.simulate(machine, control(machine), duration=0.1)
    assert str(caught.value).startswith(line) and "\n" not in str(caught.value)


def test_forces_gains_and_references_are_of_driven_joints(machine):
    path = crane.point_to_point([0.2, 0.3], [0.5, 0.4], 1.0)
    weight = crane.Dynamics(machine).gravity(machine.home)[:2]
    free = crane.simulate(machine, lambda t, q, v: weight, duration=0.05)
    zeros = crane.simulate(machine, lambda t, q, v: [*weight, 0, 0], duration=0.05)
    assert (free.q == zeros.q).all()
    for control in (crane.PI(machine, path), crane.ComputedTorque(machine, path)):
        assert len(control.settings) in (1, 4)
        run = crane.simulate(machine, control, duration=0.2)
        assert run.q[0] == pytest.approx(machine.home)
        assert np.abs(run.tau[:, 2:]).max() == 0.0
        assert run.free == machine.free
        assert "reference_lift" in run.channels and "reference_swing_x" not in run.channels
    # what a file says of where free joints start, and nothing else
    apart = crane.point_to_point([0.2, 0.3, 0.1, 0.4], [0.5, 0.4, 1.0, 1.0], 1.0)
    run = crane.simulate(machine, crane.ComputedTorque(machine, apart), duration=0.1)
    assert run.q[0] == pytest.approx([0.2, 0.3, 0.1, 0.4])


def test_valves_tasks_and_levers_leave_it_swinging(tmp_path):
    machine = crane.load(hanging_loads.file(tmp_path, hanging_loads.HYDRAULICS))
    path = crane.point_to_point([0.2, 0.3], [0.5, 0.4], 1.0)
    runs = [
        crane.simulate(machine, crane.ValvePD(machine, path), duration=0.5),
        crane.simulate(
            machine, crane.joystick(machine, {"slew": [(0, 0), (0.5, 1)]}), duration=0.5
        ),
        crane.simulate(machine, crane.ValvePD(machine, crane.task_trajectory(machine, "turn"))),
    ]
    for run in runs:
        assert np.abs(run.tau[:, 2:]).max() == 0.0
        assert np.ptp(run.q[:, 3]) > 0.01


def test_tables_and_files_say_free(machine, tmp_path):
    out = tmp_path / "run"
    done = typed("simulate", machine.path, "--task", "turn", "--out", out)
    assert done.returncode == 0, done.stderr
    rows = {line.split("|")[1].strip(): line for line in done.stdout.splitlines() if "|" in line}
    assert rows["swing_x"].count("free") == 2 and "free" not in rows["lift"]
    path = out / "recording.csv"
    lines = path.read_text().splitlines()
    assert "# free: swing_x, swing_y" in lines
    (head,) = [line for line in lines if line.startswith("time")]
    assert "lift_force" in head and "swing_x_force" not in head
    for read in (crane.Recording.from_csv(path), crane.recordings.read_measured(machine, path)):
        assert read.free == machine.free and read.joints == machine.active
        assert not read.tau[:, 2:].any()
    wrong = tmp_path / "wrong.csv"
    more = {head: ",swing_x_force [N m]"} | {x: ",1.5" for x in lines if x[0].isdigit()}
    wrong.write_text("".join(f"{line}{more.get(line, '')}\n" for line in lines))
    with pytest.raises(CraneError, match="'swing_x' is free and has the force 1.5 at sample 0"):
        crane.recordings.read_measured(machine, wrong)
    assert typed("view", out).returncode == typed("plot", out).returncode == 0


def test_a_study_lets_it_swing_and_a_workspace_holds_it(machine, tmp_path):
    found = crane.study(machine, {"grapple.mass": [100.0, 180.0]}, tasks=["turn"])
    run = crane.simulate(
        machine, crane.ComputedTorque(machine, crane.task_trajectory(machine, "turn")), step=5e-3
    )
    assert found.columns["peak_lift"][-1] == pytest.approx(np.abs(run.tau[:, 1]).max(), rel=1e-6)
    assert not any("swing" in name for name in found.columns)
    assert crane.workspace(machine, 200).strokes == ("lift",)
    with pytest.raises(CraneError, match="nothing drives 'swing_x', 'swing_y', and a planned"):
        crane.excite(machine)


def test_the_rig_measures_it_and_lets_it_swing(machine):
    """Sensors of angles, no currents and no commands; the plant's swing is that of its angles."""
    sensors = {
        joint: dataclasses.replace(default_sensors(machine, joint), gain=3e4)
        for joint in machine.active
    }
    rig = Rig(machine, 1, Tolerances(pins=0.0), sensors)
    run = rig.run(crane.point_to_point([0.2, 0.3], [0.5, 0.4], 1.0))
    assert run.free == machine.free and not run.tau[:, 2:].any()
    assert "true_swing_x" in run.channels and "current_swing_x" not in run.channels
    assert np.ptp(run.q[:, 3]) > 0.05
    assert run.q[:, 3] == pytest.approx(run.channels["true_swing_y"], abs=1e-3)


def test_it_is_linearized_where_it_hangs_still(machine, tmp_path):
    """Frequencies of the small swings with the drives at rest, those of the crane that stands."""
    hydraulic = crane.load(hanging_loads.file(tmp_path, hanging_loads.HYDRAULICS))
    stands = crane.load(machine.path, lock={"slew": 0.2, "lift": 0.3})
    dynamics = crane.Dynamics(stands)
    at = fsolve(lambda q: dynamics.gravity(q), [0.3, 0.0], xtol=1e-14)
    place = dict(zip(machine.free, at.tolist(), strict=True))
    # little damping: roots of |K - w^2 M|, K the slope of the weight
    slope = np.array(
        [dynamics.gravity(at + step) - dynamics.gravity(at - step) for step in 1e-5 * np.eye(2)]
    )
    squares = np.linalg.eigvals(np.linalg.solve(dynamics.mass_matrix(at), slope.T / 2e-5))
    frequencies = sorted(mode.frequency for mode in crane.linearize(stands, place).modes)
    assert frequencies == pytest.approx(sorted(np.sqrt(squares) / (2 * np.pi)), rel=2e-3)
    # valves that are shut hold the drives nearly so
    held = [mode.frequency for mode in crane.linearize(hydraulic, place).modes]
    for frequency in frequencies:
        assert min(abs(held - np.array(frequency))) < 0.01 * frequency
    for one in (machine, hydraulic):
        with pytest.raises(CraneError, match="free joint 'swing_x' does not stay there, 370 N m"):
            crane.linearize(one, {"swing_x": 0.6})


# --- joints that nothing drives -----------------------------------------------------------------


ARM = """<robot name="swinging">
  <link name="base"/>
  <link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="10"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="grapple"><inertial><origin xyz="0.4 0 0"/><mass value="20"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="lift" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 -1 0"/>
    <limit lower="-2" upper="2" effort="500" velocity="2"/></joint>
  <joint name="swing" type="revolute"><origin xyz="1 0 0"/><parent link="arm"/><child link="grapple"/>
    <axis xyz="0 -1 0"/><limit lower="-3" upper="3" EFFORT velocity="2"/></joint>
</robot>
"""  # noqa: E501


def arm(folder, effort, section=""):
    (folder / "arm.urdf").write_text(ARM.replace("EFFORT", effort))
    (folder / "arm.yaml").write_text(
        "name: swinging\nchains:\n  - {name: arm, urdf: arm.urdf}\nactive: [lift, swing]\n"
        + section
    )
    return quiet(crane.load, folder / "arm.yaml")


def hold(machine):
    return crane.point_to_point([0.3, -0.3], [0.3, -0.3], 0.02)


@pytest.mark.parametrize("effort", ["", 'effort="0"'])
def test_computed_torque_names_what_nothing_drives_and_its_force(tmp_path, effort):
    """Arm and grapple held level with it: m g l = 20 * 9.81 * 0.4 = 78.48 N m at the swing."""
    machine = arm(tmp_path, effort)
    assert machine.undriven_joints == ("swing",)
    with pytest.warns(CraneWarning) as caught:
        control = crane.ComputedTorque(machine, hold(machine))
    (text,) = [str(one.message) for one in caught]
    assert text.startswith("nothing is said to drive 'swing' (up to 78.5 N m) of 'swinging'")
    assert "an effort above 0 into the <limit>" in text and "\n" not in text
    recording = crane.simulate(machine, control)
    assert recording.tau[:, 1] == pytest.approx(20 * 9.81 * 0.4, rel=1e-6)


@pytest.mark.parametrize(
    ("effort", "section"),
    [
        ('effort="100"', ""),
        ("", "control:\n  lift: {kp: 1e3, ki: 1e2}\n  swing: {kp: 1e3, ki: 1e2}\n"),
        ("", "hydraulics:\n  supply: {pressure: 2e7}\n  cylinders:\n    swing: {area_a: 1e-4, "
         "area_b: 1e-4, hose_a: 1e-5, hose_b: 1e-5}\n  valves:\n    swing: {type: orifice, "
         "c1: 1e-8, c2: 1e-8, c3: 1e-8, c4: 1e-8}\n"),
    ],
)  # fmt: skip
def test_effort_gains_and_cylinders_drive(tmp_path, effort, section):
    machine = arm(tmp_path, effort, section)
    assert machine.undriven_joints == ()
    with warnings.catch_warnings():
        warnings.simplefilter("error", CraneWarning)
        crane.ComputedTorque(machine, hold(machine))


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655", "kr300", "tx40", "ur5_robot"])
def test_bundled_machines_and_arms_are_driven(name):
    assert crane.load(name).undriven_joints == ()


def test_motors_of_other_formats_drive(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1" mass="1"/>'
        '<body pos="0.3 0 0"><joint name="b" axis="0 1 0"/><geom size="0.1" mass="1"/></body>'
        '</body></worldbody><actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>'
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        assert crane.load(tmp_path / "arm.xml").undriven_joints == ()


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_a_locked_joint_needs_no_drive(tmp_path):
    arm(tmp_path, "")
    assert crane.load(tmp_path / "arm.yaml", lock={"swing": 0.1}).undriven_joints == ()


def test_the_command_line_tells_it_in_one_line(tmp_path):
    task = "tasks:\n  hold: {duration: 0.01, active: {lift: [0.3], swing: [-0.3]}}\n"
    arm(tmp_path, 'effort="0"', "home: {lift: 0.3, swing: -0.3}\n" + task)
    words = ["simulate", tmp_path / "arm.yaml", "--task", "hold", "--out", tmp_path / "run"]
    done = typed(*words)
    assert done.returncode == 0
    lines = [line for line in done.stderr.splitlines() if "swing" in line]
    assert len(lines) == 1
    assert lines[0].startswith("warning: nothing is said to drive 'swing' (up to 78.5 N m)")
