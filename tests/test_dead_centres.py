"""Runs through dead centres and change points with any active joint."""

import warnings

import numpy as np
import pinocchio as pin
import pytest
import singular_linkages
from scipy.integrate import solve_ivp
from warned import told

import crane
from crane.closure import change_points, home_search
from crane.common.errors import CraneWarning, SimulationError
from crane.dynamics.dynamics import Dynamics
from crane.motion.trajectory import point_to_point
from crane.simulation.integration.charts import Chart

pytestmark = pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
GRAVITY = 9.81


def swung(angle, speed, until, inertia, lever, times):
    """Angle of J(angle) angle'' + J' angle'^2 / 2 = lever g cos(angle), see `singular`."""

    def rate(_, y):
        half = 0.5 * (inertia(y[0] + 1e-5) - inertia(y[0] - 1e-5)) / 2e-5
        return [y[1], (lever * GRAVITY * np.cos(y[0]) - half * y[1] ** 2) / inertia(y[0])]

    found = solve_ivp(
        rate, (0, until), [angle, speed], "DOP853", rtol=1e-13, atol=1e-13, t_eval=times
    )
    return found.y[0]


def run(machine, joint, speed, duration, **settings):
    return crane.simulate(
        machine,
        initial=singular_linkages.start(machine, joint, speed),
        duration=duration,
        **settings,
    )


def test_gamma_is_judged_in_characteristic_lengths(tmp_path):
    """The rod's angle per stroke, of s = r cos a + sqrt(l^2 - r^2 sin^2 a)."""
    machine, a = singular_linkages.slider_crank(tmp_path, "s", 0.3, 0.6), -np.pi / 4
    root = np.sqrt(0.6**2 - (0.3 * np.sin(a)) ** 2)
    stroke_per_angle = -0.3 * np.sin(a) * (1 + 0.3 * np.cos(a) / root)
    rod_per_stroke = (1 + 0.3 * np.cos(a) / root) / stroke_per_angle
    chart = Chart.from_dynamics(Dynamics(machine), None, 0)
    expected = rod_per_stroke * machine.closure.characteristic_length
    assert chart.largest_gamma_entry(machine.home) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("method, step", [("rk4", 2e-4), ("DOP853", 1e-3)])
def test_a_crank_turns_through_the_dead_centres_of_its_slider(tmp_path, method, step):
    """The motion equals that with the crank as active joint, which has no dead centre."""
    alone = singular_linkages.slider_crank(tmp_path, "a", 0.3, 0.6)
    wanted = run(alone, "a", 12.0, 1.0, step=step, method=method)
    machine = singular_linkages.slider_crank(tmp_path, "s", 0.3, 0.6)
    with pytest.warns(CraneWarning, match=r"^'s' passes a dead centre at t = 0") as told:
        found = run(machine, "a", 12.0, 1.0, step=step, method=method)
    assert len(told) == 1
    assert found.joints == ("s",) and np.ptp(wanted.q) > 4 * np.pi
    q = singular_linkages.postures(machine, found)
    np.testing.assert_allclose(q, singular_linkages.postures(alone, wanted), rtol=0, atol=2e-8)
    assert machine.closure.residual(q).max() < 1e-13
    rows = alone.closure.gamma(singular_linkages.postures(alone, wanted))[:, machine.column("s")]
    np.testing.assert_allclose(found.v, rows * wanted.v, rtol=0, atol=1e-6)
    assert singular_linkages.imbalance(found) < 1e-8


def test_forces_and_friction_stay_those_of_the_drive(tmp_path):
    """The slider is pushed through its dead centres, against friction of all joints."""
    friction = {
        joint: crane.description.Friction(coulomb=0.2, viscous=0.1, smoothing=0.05)
        for joint in ("a", "b", "s")
    }
    machine = singular_linkages.slider_crank(tmp_path, "s", 0.3, 0.6).replace(friction=friction)
    runs = {}
    for active in ("s", "a"):
        one = machine.with_home_configuration(machine.home, (active,))

        def push(t, q, v, active=active):
            # 5 N along the slider, whichever coordinate it is seen by
            sine, cosine = np.sin(q[0]), np.cos(q[0])
            lever = -0.3 * sine - 0.09 * sine * cosine / np.sqrt(0.36 - 0.09 * sine**2)
            return np.array([5.0 if active == "s" else 5.0 * lever])

        runs[active] = crane.simulate(
            one, push, singular_linkages.start(one, "a", 15.0), duration=1.0, step=2.5e-4
        )
        assert singular_linkages.imbalance(runs[active]) < 1e-7
    q = [singular_linkages.postures(machine, one) for one in runs.values()]
    assert np.ptp(q[0][:, machine.column("a")]) > 1.5 * np.pi
    np.testing.assert_allclose(*q, rtol=0, atol=1e-7)
    assert np.abs(runs["s"].tau - 5.0).max() == 0.0
    work = [one.channels["work"][-1] for one in runs.values()]
    assert work[0] == pytest.approx(work[1], rel=1e-6)


@pytest.mark.parametrize("active", ["a", "b", "s"])
def test_equal_lengths_go_on_where_branches_cross(tmp_path, active):
    def inertia(a):
        sine, cosine = np.sin(a) ** 2, np.cos(a) ** 2
        return 1 / 3 + 1 / 12 + 2.25 * sine + 0.25 * cosine + 4.0 * sine

    machine = singular_linkages.slider_crank(tmp_path, active)
    with pytest.warns(CraneWarning) as told:
        found = run(machine, "a", 4 / 2**0.5, 4.0, step=1e-3, method="DOP853")
    (line,) = [str(x.message) for x in told if "could go on in several ways" in str(x.message)]
    assert line.startswith("at t = 0.5559, 1.475, 2.386, 3.305 s (4 times) the linkage passes")
    a = singular_linkages.postures(machine, found)[:, machine.column("a")]
    assert np.ptp(a) > 3 * np.pi
    wanted = swung(-np.pi / 4, 4 / 2**0.5, 4.0, inertia, 1.0, found.time)
    np.testing.assert_allclose(a, wanted, rtol=0, atol=1e-7)
    assert singular_linkages.imbalance(found) < 2e-8


@pytest.mark.parametrize(
    "count, active",
    [
        (1, "r0"), (1, "c0"), (1, "r1"), (2, "c1"),
        pytest.param(10, "r5", marks=pytest.mark.slow),
        pytest.param(10, "c3", marks=pytest.mark.slow),
        pytest.param(40, "r0", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_parallelograms_stay_such_in_line(tmp_path, count, active):
    """Against the pendulum that they are; the other branch is an antiparallelogram."""
    machine = singular_linkages.windows(tmp_path, active, count)
    found = run(machine, "r0", 1.0, 10.0, step=1e-3, method="rk4")
    angle = singular_linkages.postures(machine, found)[:, machine.column("r0")]
    inertia, lever = (count + 1) / 3 + count, (count + 1) / 2 + count
    wanted = swung(-np.pi / 2, 1.0, 10.0, lambda _: inertia, lever, found.time)
    # rounding grows at each passage with the number of loops: with 40 the error is 1e-8 to 4e-7
    # in turn for steps of 0.5 to 2 ms, without an order of convergence
    np.testing.assert_allclose(angle, wanted, rtol=0, atol=max(1e-7, 1e-8 * count))
    assert np.ptp(angle) > 9 * np.pi
    assert singular_linkages.imbalance(found) < 1e-9


@pytest.mark.parametrize(
    ("duration", "step", "method", "error"),
    [
        (10.0, 10.0, "DOP853", 1e-7), (10.0, 1.0, "DOP853", 1e-7), (10.0, 0.1, "DOP853", 1e-7),
        (0.715, 0.715, "DOP853", 1e-10), (0.715, 0.143, "DOP853", 1e-10),
        (0.72, 0.72, "DOP853", 1e-10), (10.0, 0.005, "rk4", 1e-7), (10.0, 0.02, "rk4", 2e-5),
    ],
)  # fmt: skip
def test_distant_outputs_do_not_hide_a_crossing(tmp_path, duration, step, method, error):
    """Ten crossings between outputs a second apart, and runs that end within the first one."""
    machine = singular_linkages.windows(tmp_path, "r0", 2)
    found = run(machine, "r0", 1.0, duration, step=step, method=method)
    wanted = swung(-np.pi / 2, 1.0, duration, lambda _: 3.0, 3.5, found.time)
    np.testing.assert_allclose(found.q[:, 0], wanted, rtol=0, atol=error)
    assert len(found.time) == round(duration / step) + 1


def test_crossings_do_not_analyse_the_structure_anew(tmp_path, monkeypatch):
    """Ten times the links come in line; the equations that count stay the same."""
    analysed, whole = [], home_search.analyse_constraints

    def counted(*arguments):
        analysed.append(arguments)
        return whole(*arguments)

    machine = singular_linkages.windows(tmp_path, "r0", 6)
    monkeypatch.setattr(home_search, "analyse_constraints", counted)
    found = run(machine, "r0", 1.0, 10.0, step=1e-2)
    energy = found.channels["kinetic"] + found.channels["potential"]
    assert not analysed and np.ptp(energy) < 1e-5
    angle = singular_linkages.postures(machine, found)[:, machine.column("r0")]
    assert np.ptp(angle) > 9 * np.pi


@pytest.mark.slow
def test_a_rocker_that_turns_back_everywhere(tmp_path):
    """Each of its joints has dead centres; the motion is the same by all of them."""
    runs = [
        singular_linkages.postures(machine, run(machine, "a", 0.0, 3.0, method="DOP853"))
        for machine in (singular_linkages.four_bar(tmp_path, active) for active in "abc")
    ]
    assert np.ptp(runs[0], axis=0).min() > 1.0
    for other in runs[1:]:
        np.testing.assert_allclose(other, runs[0], rtol=0, atol=1e-7)


CHANGE_POINTS = {  # linkage by active joint, closed form of its joint angles, a change point
    "slider crank": (
        lambda folder: singular_linkages.slider_crank(folder, "a", 0.3, 0.3),
        lambda a: np.array([a, -2 * a, 0.6 * np.cos(a)]),
        np.pi / 2,
    ),
    "parallelogram": (
        lambda folder: singular_linkages.windows(folder, "r0", 1),
        lambda a: np.array([a, -a, a]),
        np.pi,
    ),
    "kite": (
        lambda folder: singular_linkages.kite(folder, "a"),
        singular_linkages.kite_angles,
        2 * np.pi,
    ),
}


def energies(machine, closed_form, a):
    """Inertia (N,) about the active joint, and potential energy (N,), of the closed form."""
    rates = (closed_form(a + 1e-5) - closed_form(a - 1e-5)) / 2e-5
    inertia, potential = np.zeros_like(a), np.zeros_like(a)
    data = machine.model.createData()
    for i, (q, v) in enumerate(zip(closed_form(a).T, rates.T, strict=True)):
        inertia[i] = 2 * pin.computeKineticEnergy(machine.model, data, q, v)
        potential[i] = pin.computePotentialEnergy(machine.model, data, q)
    return inertia, potential


def needed_torque(machine, closed_form, a, v, acceleration):
    """J a'' + J' a'^2 / 2 + V' of the closed form."""
    ends = [energies(machine, closed_form, a + side * 1e-4) for side in (1, -1)]
    inertia_slope, slope = ((one - other) / 2e-4 for one, other in zip(*ends, strict=True))
    inertia = energies(machine, closed_form, a)[0]
    return inertia * acceleration + 0.5 * inertia_slope * v**2 + slope


@pytest.mark.parametrize("name", CHANGE_POINTS)
def test_loops_are_followed_through_change_points(tmp_path, name):
    """Ten turns by `solve` and `follow_motion`, to change points themselves, and forces there."""
    make, closed_form, change_point = CHANGE_POINTS[name]
    machine = make(tmp_path)
    home = machine.home[machine.closure.active][0]
    a = np.append(home + np.linspace(0, 20 * np.pi, 1001), change_point + 2 * np.pi)
    q, lines = told(machine.closure.solve, a[:, None])
    assert len(lines) == 1 and "passes a change point" in lines[0]
    np.testing.assert_allclose(q.T, closed_form(a), rtol=0, atol=1e-12)
    assert machine.closure.residual(q).max() < 1e-13
    order = np.random.default_rng(1).permutation(len(a))[:40]
    np.testing.assert_allclose(machine.closure.solve(a[order, None]), q[order], rtol=0, atol=1e-12)
    guess = machine.closure.solve(a[[700]])
    np.testing.assert_allclose(machine.closure.solve(a[[702]], guess), q[702], rtol=0, atol=1e-12)
    followed = machine.closure.follow_motion(a[:150, None])
    np.testing.assert_allclose(followed, q[:150], rtol=0, atol=1e-11)
    some = np.append(a[::50], change_point)
    tau = crane.Dynamics(machine).inverse(some[:, None], [1.3], [-0.7])[:, 0]
    wanted = needed_torque(machine, closed_form, some, 1.3, -0.7)
    np.testing.assert_allclose(tau, wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())
    with pytest.raises(crane.CraneError, match="is at the edge of its branch"):
        machine.closure.gamma(machine.closure.solve([change_point]))


def test_guesses_beyond_a_change_point_may_have_either_rotation_vector(tmp_path):
    """The same rotation of a ball joint, by less or by more than half a revolution."""
    machine = singular_linkages.kite(tmp_path, "a", "spherical")
    a, b, c = singular_linkages.kite_angles(1.5)
    for angle in (b + 2 * np.pi, b):
        guess = np.array([a, 0.0, angle, 0.0, c])
        with warnings.catch_warnings(action="ignore"):
            q = machine.closure.solve([a], guess)
        np.testing.assert_allclose(q, [a, 0.0, b, 0.0, c], rtol=0, atol=1e-12)


def test_a_limit_of_neighbours_or_none():
    x = 4e-3 * change_points.NEIGHBOUR_PLACES
    values = np.column_stack([np.cos(x), np.exp(3 * x), np.zeros(8)])
    found = change_points.interpolate_limit(values)
    np.testing.assert_allclose(found, [1.0, 1.0, 0.0], rtol=0, atol=1e-14)
    for unbounded in (1 / x, 1 / x**2, np.sign(x), np.abs(x) + 0.01):
        assert change_points.interpolate_limit(unbounded[:, None]) is None


@pytest.mark.parametrize("name", CHANGE_POINTS)
def test_computed_torque_drives_through_change_points(tmp_path, name):
    """Two turns; torques of the closed form, and the energy balance closes."""
    make, closed_form, _ = CHANGE_POINTS[name]
    machine = make(tmp_path)
    start = machine.home[machine.closure.active]
    path = point_to_point(start, start + 4 * np.pi, 4.0)
    found = crane.simulate(machine, crane.ComputedTorque(machine, path), step=1e-3)
    q = singular_linkages.postures(machine, found)
    a = q[:, machine.column(machine.active[0])]
    np.testing.assert_allclose(a, path.position(found.time)[:, 0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(q.T, closed_form(a), rtol=0, atol=1e-10)
    every = slice(None, None, 50)
    _, v, acceleration = (np.atleast_2d(x)[:, 0] for x in path(found.time[every]))
    wanted = needed_torque(machine, closed_form, a[every], v, acceleration)
    error = np.abs(found.tau[every, 0] - wanted).max()
    assert error < 1e-5 * np.abs(wanted).max()
    assert singular_linkages.imbalance(found) < 1e-7


def test_a_kite_falls_through_its_change_points(tmp_path):
    """It turns on: energy is that of the closed form at every instant."""
    machine = singular_linkages.kite(tmp_path, "a")
    found = run(machine, "a", 9.0, 3.0, step=5e-4, method="rk4")
    q = singular_linkages.postures(machine, found)
    a = q[:, machine.column("a")]
    assert np.ptp(a) > 6 * np.pi
    np.testing.assert_allclose(q.T, singular_linkages.kite_angles(a), rtol=0, atol=1e-9)
    every = slice(None, None, 20)
    inertia, potential = energies(machine, singular_linkages.kite_angles, a[every])
    total = 0.5 * inertia * found.v[every, 0] ** 2 + potential
    assert np.ptp(total) < 1e-6 * np.ptp(potential)
    assert singular_linkages.imbalance(found) < 1e-8


@pytest.mark.parametrize("excess", [1e-3, 1e-6, 1e-9])
def test_branches_that_do_not_meet_are_not_changed(tmp_path, excess):
    """A rod that is longer than the crank turns over where one as long goes on."""
    machine = singular_linkages.slider_crank(tmp_path, "a", 0.3, 0.3 + excess)
    a = np.linspace(-0.7, 2.5, 400)
    s = machine.closure.solve(a[:, None])[:, machine.column("s")]
    wanted = 0.3 * np.cos(a) + np.sqrt((0.3 + excess) ** 2 - (0.3 * np.sin(a)) ** 2)
    np.testing.assert_allclose(s, wanted, rtol=0, atol=1e-9)
    short = singular_linkages.slider_crank(tmp_path, "a", 0.3, 0.3 - excess)
    with pytest.raises(crane.CraneError, match="cannot be closed at a = 2"):
        short.closure.solve([2.0])


class Weighed(crane.control.ControlLaw):
    """A spring along a reference, and what holds the weight."""

    def __init__(self, machine, reference):
        super().__init__(machine)
        self.reference = reference

    def references(self, times):
        return self.reference.position(times)

    def law(self, inputs):
        error = np.array(inputs.reference) - np.array(inputs.q_a)
        return np.array(inputs.gravity()) + 1e3 * error - 50.0 * np.array(inputs.v_a), ()


@pytest.mark.parametrize("made", [crane.ComputedTorque, Weighed])
def test_inverse_dynamics_at_a_dead_centre_is_one_line(tmp_path, made):
    machine = singular_linkages.slider_crank(tmp_path, "s", 0.3, 0.6)
    start = machine.home[machine.closure.active]
    path = point_to_point(start, [0.95], 1.0)  # the slider gets no farther than 0.9
    with warnings.catch_warnings(), pytest.raises(SimulationError) as caught:
        warnings.simplefilter("ignore", CraneWarning)
        crane.simulate(machine, made(machine, path))
    text = str(caught.value)
    assert "joint 's' at a dead centre" in text and "\n" not in text


@pytest.mark.slow
@pytest.mark.parametrize("rod", [2.0, 1.3])
def test_postures_follow_a_recorded_stroke_through_dead_centres(tmp_path, rod):
    """From the slider's stroke alone the crank is followed through three revolutions."""
    crank = singular_linkages.slider_crank(tmp_path, "a", 1.0, rod)
    found = run(crank, "a", 3.0, 5.0, step=2e-3)
    wanted = singular_linkages.postures(crank, found)
    assert np.ptp(wanted[:, crank.column("a")]) > 6 * np.pi
    slider = crank.with_home_configuration(crank.home, ("s",)).closure
    stroke = wanted[:, [crank.column("s")]]
    postures = slider.follow_motion(stroke)
    assert slider.residual(postures).max() < 1e-12
    assert np.abs(postures - wanted).max() < 1e-4
    # a stroke says nothing of the crank to first order there: errors of e are sqrt(e)
    noise = 1e-6 * np.random.default_rng(0).normal(size=stroke.shape)
    assert np.abs(slider.follow_motion(stroke + noise) - wanted).max() < 5 * np.sqrt(1e-6)
    with pytest.raises(crane.CraneError, match="sample 1: the motion does not go on to it"):
        slider.follow_motion(stroke[:2] - [[0.0], [5.0]])
