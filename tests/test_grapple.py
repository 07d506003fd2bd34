"""A hanging grapple: sway against equations on paper, and references without residual sway."""

import hanging_loads
import numpy as np
import pytest
from command_line import typed
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

import crane
from crane.common.errors import CraneError
from crane.control.valve_feedforward import largest_flow_share
from crane.motion.sway import SWAY_METHODS, Sway, input_shaper, suppress_sway
from crane.motion.trajectory import retime

pytestmark = pytest.mark.slow

GRAVITY = 9.81
NAME = "patu655_grapple"
# mass, centre below the upper pin, inertias about axes forward, up and across
LINK = (15.0, 0.065, (0.06, 0.03, 0.06))
HOUSING = (30.0, 0.265, (0.16, 0.12, 0.16))
GRAPPLE = (105.0, 0.56, (3.7, 4.5, 6.1))
LOG = (191.4, 0.68, (144.77496, 144.77496, 2.44992))
PIN = 0.13  # the lower pin below the upper one
VISCOUS = 5.0


def bodies(payload):
    """Link, and what is one body below the lower pin."""
    scale = payload / LOG[0]
    log = (payload, LOG[1], tuple(scale * x for x in LOG[2]))
    below = [HOUSING, GRAPPLE, log]
    mass = sum(m for m, _, _ in below)
    centre = sum(m * d for m, d, _ in below) / mass
    off = np.array([1.0, 0.0, 1.0])
    inertia = sum(np.array(j) + m * (d - centre) ** 2 * off for m, d, j in below)
    return LINK, (mass, centre, tuple(inertia))


def carrying(payload, **more):
    changes = {"payload.mass": payload} if payload else {}
    return crane.load(
        NAME, changes=changes | {key.replace("__", "."): x for key, x in more.items()}
    )


def smooth(**more):
    """Without friction of the pins."""
    still = {f"friction__sway_{way}__viscous": 0.0 for way in ("radial", "tangential")}
    return {**still, **more}


def follow(machine, reference, after=6.0, **options):
    """Driven exactly along a reference; the run, and its sway."""
    start = reference.position(0.0)
    control = crane.ComputedTorque(machine, reference)
    until = np.ceil(100 * (reference.duration + after)) / 100
    run = crane.simulate(
        machine, control, initial=(start, 0 * start), duration=until, step=1e-2, **options
    )
    return run, run.q[:, -2:] - Sway(machine).hanging_equilibrium(run.q)[:, -2:]


# --- the pendulum ----------------------------------------------------------------------------


@pytest.mark.parametrize("payload", [0.0, 200.0, 500.0])
def test_small_sway_is_that_of_compound_pendulums(payload):
    """omega = sqrt(m g d / I) of both planes about their pins."""
    link, below = bodies(payload)
    radial = sum(m * d * GRAVITY for m, d, _ in (link, below))
    radial /= sum(j[2] + m * d**2 for m, d, j in (link, below))
    mass, centre, inertia = below
    lever = centre - PIN
    tangential = mass * GRAVITY * lever / (inertia[0] + mass * lever**2)
    machine = carrying(payload)
    home = machine.home[machine.closure.active]
    sway = Sway(machine)
    np.testing.assert_allclose(sway.hanging_equilibrium(home), home, atol=1e-9)
    omega, zeta = sway.modes(home)
    np.testing.assert_allclose(omega, np.sqrt(sorted([radial, tangential])), rtol=1e-7)
    turning = {
        radial: sum(j[2] + m * d**2 for m, d, j in (link, below)),
        tangential: inertia[0] + mass * lever**2,
    }
    wanted = [VISCOUS / (2 * np.sqrt(x) * turning[x]) for x in sorted(turning)]
    np.testing.assert_allclose(zeta, wanted, rtol=1e-7)
    # the pin moves about the centre of oscillation, at I / (m d)
    (shifts,) = sway.pivoting_motions(home[None])
    reach = np.hypot(*crane.Kinematics(machine, "tip").position(home)[:2])
    length = GRAVITY / tangential
    assert abs(shifts[0, 1]) == pytest.approx(length / (reach), rel=1e-6)


def turned(axis, angle):
    """Rotation matrix, by Rodrigues."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=float)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def motion_of(machine, reference):
    """The tip's frame along a reference: rotation of its axes, place, and two derivatives each.

    Rotations are Rz(slew) Ry(-pitch) of axes x forward, y up, z across (to the right).
    """
    time = np.linspace(0.0, reference.duration, 2001)
    q = machine.closure.solve(reference.position(time))
    place = crane.Kinematics(machine, "tip").positions_at_configurations(q)
    pitch = q[:, machine.column("q2")] + q[:, machine.column("q3")] + np.pi / 4
    slew = q[:, machine.column("slew")]
    spline = make_interp_spline(time, np.column_stack([place, slew, pitch]), k=7)

    def at(t):
        t = min(max(t, 0.0), reference.duration)
        (*p, s, b), (*_, ds, db), (*a, dds, ddb) = (spline(t, order) for order in range(3))
        if t in (0.0, reference.duration):
            ds = db = dds = ddb = 0.0
            a = [0.0, 0.0, 0.0]
        upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=float)  # y up, z to the right
        up, across = np.array([0, 0, 1.0]), np.array([np.sin(s), -np.cos(s), 0.0])
        rotation = turned(up, s) @ upright @ turned([0, 0, 1], b)
        spin = ds * up + db * across
        turn = dds * up + ddb * across + ds * db * np.cross(up, across)
        return rotation, np.array(a), spin, turn

    return at


def by_virtual_power(carrier, t, theta, rate, payload, viscous):
    """Accelerations of both pins, by Jourdain's principle: no power on any virtual velocity.

    sum m (a - g) . dv/dtheta' + (I w' + w x I w) . dw/dtheta' + c theta' = 0.
    """
    rotation, a0, w0, e0 = carrier(t)
    weight = np.array([0, 0, -GRAVITY])
    z = rotation[:, 2]
    first = rotation @ turned([0, 0, 1], theta[0])
    w1 = w0 + rate[0] * z
    e1 = e0 + rate[0] * np.cross(w0, z)
    x = first[:, 0]
    second = first @ turned([1, 0, 0], theta[1])
    w2 = w1 + rate[1] * x
    e2 = e1 + rate[1] * np.cross(w1, x)
    link, below = bodies(payload)
    arm1 = -link[1] * first[:, 1]
    pin = -PIN * first[:, 1]
    arm2 = -(below[1] - PIN) * second[:, 1]

    def accelerated(a, w, e, r):
        return a + np.cross(e, r) + np.cross(w, np.cross(w, r))

    a1 = accelerated(a0, w1, e1, arm1)
    a2 = accelerated(accelerated(a0, w1, e1, pin), w2, e2, arm2)
    mass, right = np.zeros((2, 2)), -viscous * np.array(rate)
    parts = (
        (link, first, a1, w1, e1, [np.cross(z, arm1), np.zeros(3)], [z, np.zeros(3)]),
        (below, second, a2, w2, e2, [np.cross(z, pin + arm2), np.cross(x, arm2)], [z, x]),
    )
    for (m, _, j), axes, a, w, e, moves, turns in parts:
        inertia = axes @ np.diag(j) @ axes.T
        torque = inertia @ e + np.cross(w, inertia @ w)
        for i in range(2):
            right[i] -= m * moves[i] @ (a - weight) + turns[i] @ torque
            for k in range(2):
                mass[i, k] += m * moves[i] @ moves[k] + turns[i] @ inertia @ turns[k]
    return np.linalg.solve(mass, right)


def swung(machine, reference, payload, viscous, times):
    """Sway joints by the equations on paper, of a tip that moves along a reference."""
    carrier = motion_of(machine, reference)

    def rate(t, y):
        return [*y[2:], *by_virtual_power(carrier, t, y[:2], y[2:], payload, viscous)]

    start = [*reference.position(0.0)[-2:], 0.0, 0.0]
    found = solve_ivp(rate, (0, times[-1]), start, "DOP853", times, rtol=1e-10, atol=1e-12)
    return found.y[:2].T


@pytest.fixture(scope="module")
def loaded():
    return carrying(200.0)


@pytest.fixture(scope="module")
def quarter(loaded):
    return retime(crane.task_trajectory(loaded, "swing"), 7.0)


def test_the_grapple_swings_as_its_equations_do(loaded, quarter):
    """A quarter turn that leaves 4 degrees, of the whole model and of the two pins alone."""
    reference = suppress_sway(loaded, quarter, "none")
    run, _ = follow(loaded, reference, 0.0, tolerance=1e-12)
    wanted = swung(loaded, reference, 200.0, VISCOUS, run.time)
    assert np.ptp(wanted, axis=0).min() > 0.05
    np.testing.assert_allclose(run.q[:, -2:], wanted, rtol=0, atol=1e-6)


# --- references that leave none --------------------------------------------------------------


@pytest.mark.parametrize("payload", [0.0, 250.0, 500.0])
def test_a_flat_reference_leaves_no_sway(payload):
    machine = carrying(payload)
    reference = retime(crane.task_trajectory(machine, "swing"), 7.0)
    flat = suppress_sway(machine, reference)
    assert flat.duration == 7.0
    ends = np.array([0.0, 7.0])
    driven = machine.is_driven
    np.testing.assert_allclose(
        flat.position(ends)[:, driven], reference.position(ends)[:, driven], atol=1e-9
    )
    run, sway = follow(machine, flat, tolerance=1e-11)
    assert np.abs(sway[run.time < 7.0]).max() > 0.1
    assert np.abs(sway[run.time >= 7.0]).max() < 5e-6
    np.testing.assert_allclose(run.q[:, -2:], flat.position(run.time)[:, -2:], rtol=0, atol=5e-6)
    _, before = follow(machine, suppress_sway(machine, reference, "none"), tolerance=1e-9)
    assert np.abs(before[run.time >= 7.0]).max() > 0.02


def test_equations_on_paper_say_so_too(loaded, quarter):
    """The flat motion of the tip, and the two pins alone."""
    flat = suppress_sway(loaded, quarter)
    times = np.linspace(0.0, 7.0, 50)
    found = swung(loaded, flat, 200.0, VISCOUS, times)
    np.testing.assert_allclose(found, flat.position(times)[:, -2:], rtol=0, atol=5e-6)


class Shaped(crane.motion.Trajectory):
    """A reference sent through impulses."""

    tip = None

    def __init__(self, base, delays, shares):
        self.duration = base.duration + delays[-1]
        self._base, self._impulses = base, list(zip(delays, shares, strict=True))

    def position(self, time):
        return sum(x * self._base.position(np.asarray(time) - at) for at, x in self._impulses)

    def _derivative(self, order, time):
        return sum(
            x * self._base._derivative(order, np.asarray(time) - at) for at, x in self._impulses
        )

    def breaks(self):
        return np.array([0.0, self.duration])

    extremum_times = breaks

    def bounds(self):
        return self._base.bounds()


@pytest.mark.parametrize("derivative", [False, True])
def test_a_shaper_of_the_wrong_length_leaves_what_theory_says(derivative):
    """|V| = |cos(pi r / 2)|, of ZVD its square, r the frequency over each mode's of the shaper."""
    designed = carrying(200.0, **smooth())
    home = designed.home[designed.closure.active]
    delays, shares = input_shaper(designed, home, derivative)
    assert shares.sum() == pytest.approx(1.0) and delays[0] == 0
    shaped = Sway(designed).modes(home)[0]
    base = crane.point_to_point(home, home + [0.02, 0, 0, 0, 0, 0, 0], 5.0)
    for payload in (200.0, 60.0, 500.0):
        machine = carrying(payload, **smooth())
        omega = Sway(machine).modes(home)[0][0]  # across the plane, where slewing sends it
        wanted = np.prod(np.abs(np.cos(np.pi / 2 * omega / shaped))) ** (1 + derivative)
        sizes = []
        for reference in (base, Shaped(base, delays, shares)):
            run, theta = follow(machine, reference, 8.0, tolerance=1e-11)
            sizes.append(np.abs(theta[run.time >= reference.duration, 1]).max())
        assert sizes[0] > 1e-4
        assert sizes[1] / sizes[0] == pytest.approx(wanted, abs=0.01)


def beside(joint):
    """The machine with a joint locked, and a motion of its extension."""
    machine = crane.load(NAME, lock={joint: 0.0})
    start = machine.home[machine.closure.active][machine.is_driven]
    return machine, crane.point_to_point(start, start + [0, 0, 0.3, 0], 5.0)


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda m, r: suppress_sway(m, r, "fast"), "method 'fast' is unknown, did you mean"),
        (
            lambda m, r: suppress_sway(m, retime(r, 1.0), "zvd"),
            "the shaper takes 4.08 s, the motion 1 s",
        ),
        (
            lambda m, r: suppress_sway(m, retime(r, 0.8)),
            "no motion of 0.8 s without residual sway was found",
        ),
        (lambda m, r: retime(r, 0.0), "the duration is 0"),
        (
            lambda m, r: crane.control.ValveFeedforward(m, r, sway=-0.1),
            "the damping ratio of sway is -0.1",
        ),
        (lambda m, r: Sway(crane.load("patu655")), "nothing sways on 'patu655': it has no free"),
        (lambda m, r: suppress_sway(crane.load("patu655"), r), "nothing sways on 'patu655'"),
        (
            lambda m, r: suppress_sway(*beside("slew")),
            "the drives of 'patu655_grapple' cannot move what hangs on sway_radial, "
            "sway_tangential in every direction",
        ),
        (
            lambda m, r: suppress_sway(
                m, crane.point_to_point([0, 0.117, 0.246, 0, 0], [1.5, 0.117, 0.246, 0, 0], 6.0)
            ),
            "method 'flat': the reference of 'X_ext' goes to -0.0",
        ),
    ],
)
def test_what_cannot_be_is_refused(loaded, quarter, call, line):
    with pytest.raises(CraneError) as caught:
        call(loaded, quarter)
    assert str(caught.value).startswith(line) and "\n" not in str(caught.value)


def test_any_machine_that_hangs(tmp_path):
    """Another one, whose grapple's products of inertia turn both planes into each other."""
    machine = crane.load(hanging_loads.file(tmp_path))
    reference = crane.point_to_point([0.2, 0.3], [1.0, 0.45], 6.0)
    run, sway = follow(machine, suppress_sway(machine, reference), tolerance=1e-11)
    _, before = follow(machine, suppress_sway(machine, reference, "none"), tolerance=1e-11)
    after = run.time >= 6.0
    assert np.abs(before[after]).max() > 0.02
    assert np.abs(sway[after]).max() < 1e-5


# --- through the valves ----------------------------------------------------------------------


def test_the_fastest_motion_takes_all_of_the_flow(loaded, quarter):
    none = crane.control.fastest_trajectory(loaded, quarter)
    time = np.linspace(0, none.duration, 1000)
    circuit = loaded.hydraulics
    flow = np.zeros((len(time), len(circuit.joints)))
    for i, joint in enumerate(circuit.joints):
        v, cylinder = none.velocity(time)[:, i], circuit.cylinders[joint]
        flow[:, i] = np.where(v > 0, v * cylinder.area_a, -v * cylinder.area_b)
    # of the slewing gear, a quarter turn by a quintic at 40 l/min: 15/8 A s / Q
    assert none.duration == pytest.approx(1.875 * 1.4137e-3 * np.pi / 2 / 6.6667e-4, rel=2e-3)
    assert (flow / 6.6667e-4).max() == pytest.approx(1.0, rel=2e-3)
    assert flow.sum(axis=1).max() < circuit.supply.flow
    assert largest_flow_share(loaded, retime(none, 2 * none.duration)) == pytest.approx(
        0.5, rel=2e-3
    )
    few = crane.load(NAME, changes={"payload.mass": 200.0, "supply.flow": 5e-4})
    slow = crane.control.fastest_trajectory(few, quarter)
    assert slow.duration == pytest.approx(none.duration * flow.sum(axis=1).max() / 5e-4, rel=2e-3)


def test_valves_follow_what_the_circuit_turned_round_says(loaded, quarter):
    """Within half a millimetre and half a milliradian, where a PD controller lags by degrees."""
    flat = suppress_sway(loaded, quarter)
    start = flat.position(0.0)
    errors = []
    for control in (crane.control.ValveFeedforward(loaded, flat), crane.ValvePD(loaded, flat)):
        run = crane.simulate(loaded, control, initial=(start, 0 * start), duration=7.0, step=1e-2)
        errors.append(np.abs(run.q - flat.position(run.time)).max(axis=0))
    assert (errors[0][:4] < [1.5e-3, 5e-4, 1e-3, 1e-3]).all()
    assert errors[1][0] > 0.1


@pytest.mark.slow
def test_a_command_tells_what_sway_is_left():
    """At the shortest time that the flow allows: 90 % less, in 10 % more time at most."""
    done = typed("sway", NAME, "--task", "swing", "--payload", "250", "--damping", "0")
    assert done.returncode == 0, done.stderr
    head, *lines = done.stdout.splitlines()
    assert head.split("  ")[0] == "payload" and len(lines) == len(SWAY_METHODS)
    rows = {cells[2]: cells for cells in (line.split() for line in lines)}
    assert float(rows["none"][6]) > 2.0
    assert float(rows["flat"][8]) > 90.0 and float(rows["flat"][5]) < 1.1
    assert typed("sway", NAME, "--task", "swing", "--payload", "x").returncode == 2


@pytest.mark.slow
@pytest.mark.long
def test_all_payloads_leave_a_tenth_of_the_sway():
    found = crane.studies.sway_study(NAME, "swing", (0.0, 125.0, 375.0, 500.0))
    assert len(found.rows) == 4 * 2 * len(SWAY_METHODS)
    for row in found.rows:
        if row.method == "flat":
            assert row.relative_reduction > 0.9 and row.relative_duration < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("payload", [0.0, 500.0])
@pytest.mark.parametrize("joint", ["sway_radial", "sway_tangential"])
def test_feedback_damps_what_is_left(payload, joint):
    """From 5 degrees at rest: about the damping that is asked for, half a degree within 6 s."""
    machine = carrying(payload)
    home = machine.home[machine.closure.active]
    stands = suppress_sway(machine, crane.point_to_point(home, home, 1.0), "none")
    omega, zeta = Sway(machine).modes(home)
    which = machine.active.index(joint)
    after = []
    for ratio in (0.0, 0.2):
        start = home + np.radians(5) * (np.arange(len(home)) == which)
        control = crane.control.ValveFeedforward(machine, stands, sway=ratio)
        run = crane.simulate(machine, control, initial=(start, 0 * start), duration=8.0, step=1e-2)
        size = np.abs(np.degrees(run.q[:, which] - home[which]))
        after.append(run.time[size > 0.5].max())
    assert after[1] < 6.0 and after[0] > 7.0
    slowest = np.log(10) / (omega * zeta).max()
    assert slowest > 3 * after[1]


def test_a_run_of_the_command_line(tmp_path):
    out = tmp_path / "run"
    options = ("--task", "swing", "--sway", "flat", "--controller", "valve-feedforward")
    done = typed("simulate", NAME, *options, "--step", "0.01", "--out", out)
    assert done.returncode == 0, done.stderr
    run = crane.Recording.from_csv(out / "recording.csv")
    assert run.free == ("sway_radial", "sway_tangential")
    done = typed("simulate", NAME, "--duration", "1", "--sway", "flat", "--out", tmp_path / "x")
    assert done.stderr == "error: --sway changes a reference, name a --task or a --path\n"
    done = typed("simulate", NAME, "--task", "stir", "--sway", "flat", "--out", tmp_path / "x")
    assert done.stderr == (
        "error: --sway does not go with task 'stir', which moves levers, leave it out\n"
    )
