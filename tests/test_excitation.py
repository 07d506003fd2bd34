"""Excitation trajectories: limits are kept, and the information that they carry."""

import dataclasses

import numpy as np
import pytest
import urdf_text
from command_line import typed

import crane
from crane.common.errors import InputError
from crane.identification.excitation.fisher_information import FisherInformation
from crane.identification.excitation.fourier_trajectory import FourierTrajectory, fourier_basis
from crane.identification.excitation.periodic_excitation import excite
from crane.identification.excitation.trajectory_optimizer import (
    singularity_proximity,
    trajectory_limits,
)
from crane.identification.mechanics.base_parameters import base_parameters, random_samples
from crane.identification.mechanics.identification_model import IdentificationModel

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")
QUICK = {"harmonics": 3, "periods": 2, "starts": 1}


@pytest.fixture(scope="module")
def found(mini):
    return excite(mini, **QUICK)


# --- the series ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def series():
    return FourierTrajectory(np.random.default_rng(3).normal(size=(9, 2)), 2.5, 3)


def test_velocity_and_acceleration_are_derivatives(series):
    """Of the ways from and to rest too; central differences err by step^2."""
    time = np.linspace(0.01, series.duration - 0.01, 4001)
    step = 1e-5
    early, late = series(time - step), series(time + step)
    _, v, a = series(time)
    assert np.abs((late[0] - early[0]) / (2 * step) - v).max() < 1e-6
    joints = [series.lead, series.duration - series.lead]  # where the jerk jumps
    inside = np.abs(time[:, None] - joints).min(axis=1) > step
    assert np.abs((late[1] - early[1]) / (2 * step) - a)[inside].max() < 1e-5


def test_it_is_periodic_between_rests(series):
    time = series.lead + np.linspace(0, 2 * series.period, 301)
    for now, later in zip(series(time), series(time + series.period), strict=True):
        assert np.abs(later - now).max() < 1e-11
    for rest in (0.0, series.duration, -1.0, series.duration + 1):
        assert np.abs(series(rest)[1:]).max() < 1e-12
    assert series.duration == 3 * 2.5 + 2 * series.lead
    assert np.array_equal(series.position(time), series(time)[0])
    assert series(0.3)[0].shape == (2,)


def test_ways_from_and_to_rest_stay_on_the_curve(series):
    """Points of the start and end paths lie on the periodic curve, nowhere faster than it."""
    curve = (
        fourier_basis(np.linspace(0, series.period, 200001), 4, series.period)[0]
        @ series.coefficients
    )
    top = np.abs(series(np.linspace(series.lead, series.lead + 2.5, 5000))[1]).max(axis=0)
    for start in (0.0, series.duration - series.lead):
        q, v, _ = series(start + np.linspace(0, series.lead, 50))
        assert max(np.linalg.norm(curve - point, axis=1).min() for point in q) < 2e-4
        assert (np.abs(v) <= top * (1 + 1e-9)).all()


def test_a_machine_follows_it(mini, found):
    control = crane.ComputedTorque(mini, found.trajectory)
    recording = crane.simulate(mini, control, duration=2.0)
    assert np.abs(recording.q - found.trajectory(recording.time)[0]).max() < 1e-6


def test_bounds_enclose_a_series_and_its_velocity_is_its_rate(series):
    time = np.linspace(-1.0, series.duration + 1.0, 5000)
    q, v, _ = series(time)
    least, most = series.bounds()
    assert (least <= q.min(axis=0)).all() and (q.max(axis=0) <= most).all()
    np.testing.assert_array_equal(series.velocity(time), v)


# --- limits ----------------------------------------------------------------------------------


def keeps(excitation, machine):
    """Largest shares of the machine's own limits at instants the search has not seen."""
    path = excitation.trajectory
    q, v, a = path(np.sort(np.random.default_rng(1).uniform(0, path.duration, 20000)))
    machine.check_limits(q)
    tau = crane.Dynamics(machine, backend="pinocchio").inverse(q[::20], v[::20], a[::20], True)
    columns = machine.closure.active
    return (
        np.abs(v).max(axis=0) / machine.model.velocityLimit[columns],
        np.abs(a).max(axis=0),
        np.abs(tau).max(axis=0) / machine.model.effortLimit[columns],
    )


def test_limits_hold_between_samples(mini, found):
    v, _, tau = keeps(found, mini)
    assert (v <= 0.95).all() and (tau <= 0.95).all()
    assert v.max() > 0.93  # and they are used
    assert found.limit_usage.max() <= 1 and found.limit_usage.max() > 0.99


@pytest.mark.slow
def test_accelerations_can_be_limited(slider_crank):
    free = excite(slider_crank, **QUICK, period=2.0)
    joint = slider_crank.active[0]
    most = 0.5 * float(keeps(free, slider_crank)[1][0])
    tame = excite(slider_crank, **QUICK, period=2.0, acceleration={joint: most})
    assert keeps(tame, slider_crank)[1][0] <= 0.95 * most
    assert tame.optimized_information.logdet < free.optimized_information.logdet


@pytest.mark.slow
def test_forces_can_be_what_limits(edited):
    """A crank whose drive is weak: a third of the force that the motion would take."""
    machine = edited("slider_crank.yaml")
    free = excite(machine, **QUICK, period=1.0)
    needed = free.limit_usage[3, 0] * machine.model.effortLimit[machine.closure.active[0]] * 0.95
    machine.model.effortLimit[machine.closure.active[0]] = needed / 2
    weak = excite(machine, **QUICK, period=1.0)
    assert keeps(weak, machine)[2][0] <= 0.95
    assert weak.limit_usage[3, 0] > 0.9


@pytest.mark.slow
@pytest.mark.long
def test_the_edge_of_the_branch_is_kept(five_bar):
    """One radian of both cranks is out of reach; the reference stays within it."""
    result = excite(five_bar, **QUICK, period=4.0)
    q, v, a = result.trajectory(np.linspace(0, result.trajectory.duration, 3001))
    at = IdentificationModel(five_bar).samples(q, v, a)  # every sample closes
    assert five_bar.closure.residual(at.q).max() < 1e-12
    assert singularity_proximity(five_bar, at).max() <= 1
    assert result.optimized_information.condition < result.initial_information.condition / 5


# --- what it tells ---------------------------------------------------------------------------


def naive(excitation):
    """One sine per joint, the k-th at the k-th harmonic, 95 % of its limits."""
    K, n = excitation.trajectory.harmonics, len(excitation.machine.active)
    w = 2 * np.pi / excitation.trajectory.period
    table = np.zeros((1 + 2 * K, n))
    table[0] = excitation.limits.stroke_middle
    for i in range(n):
        k = i % K + 1
        table[k, i] = min(excitation.limits.velocity[i], k * w * excitation.limits.half_stroke[i])
    return FourierTrajectory(table, excitation.trajectory.period, excitation.trajectory.periods)


def information_of(excitation, path):
    """ln det (1 + M) in parameters scaled like the excitation's, by eigenvalues."""
    model = IdentificationModel(excitation.machine)
    time = path.lead + np.arange(0, path.period, excitation.step)
    W = model.regressor(model.samples(*path(time)))[:, :, excitation.base.independent]
    W = (W / excitation.noise[:, None]).reshape(-1, excitation.base.rank) * excitation.prior_std
    values = np.linalg.eigvalsh(path.periods * W.T @ W)
    return np.log1p(np.maximum(values, 0)).sum()


def test_it_tells_more_than_random_and_naive_references(found):
    """Per parameter, the volume of the ellipsoid shrinks at least by a factor of two."""
    rank = found.base.rank
    assert information_of(found, found.trajectory) == pytest.approx(
        found.optimized_information.logdet, rel=1e-3
    )
    assert (
        found.optimized_information.logdet - found.initial_information.logdet
        > 2 * np.log(2) * rank
    )
    assert (
        found.optimized_information.logdet - information_of(found, naive(found))
        > 2 * np.log(2) * rank
    )
    assert found.optimized_information.condition < found.initial_information.condition / 10
    assert (
        found.optimized_information.smallest_singular_value
        > 10 * found.initial_information.smallest_singular_value
    )


@pytest.mark.long
@pytest.mark.slow
def test_condition_can_be_the_criterion(slider_crank):
    one, other = (
        excite(slider_crank, harmonics=3, period=4.0, criterion=name)
        for name in ("condition", "logdet")
    )
    assert one.optimized_information.condition < one.initial_information.condition / 2
    assert one.optimized_information.condition < other.optimized_information.condition
    assert one.optimized_information.logdet < other.optimized_information.logdet


@pytest.mark.slow
def test_same_seed_same_bits(slider_crank):
    first, again, other = (excite(slider_crank, **QUICK, seed=seed) for seed in (4, 4, 5))
    assert np.array_equal(first.trajectory.coefficients, again.trajectory.coefficients)
    assert first.to_text() == again.to_text()
    assert not np.array_equal(first.trajectory.coefficients, other.trajectory.coefficients)


def test_predicted_deviations_are_those_of_least_squares(mini, found):
    """600 recordings with white noise: a deviation comes out within 3 % (one sigma)."""
    model, path, base = IdentificationModel(mini), found.trajectory, found.base
    time = path.lead + found.step * np.arange(path.periods * round(path.period / found.step))
    W = model.regressor(model.samples(*path(time)))[:, :, base.independent]
    W = (W / found.noise[:, None]).reshape(-1, base.rank)
    norms = np.linalg.norm(W, axis=0)
    noise = np.random.default_rng(0).normal(size=(len(W), 600))
    errors = np.linalg.lstsq(W / norms, noise, rcond=0)[0] / norms[:, None]
    assert errors.std(axis=1) == pytest.approx(found.optimized_information.std, rel=0.15)


def test_with_a_prior_deviations_are_those_after_it(slider_crank):
    """Bayes: covariance (prior^-1 + W^T W / noise^2)^-1, computed without any scaling."""
    model = IdentificationModel(slider_crank)
    base = base_parameters(model)
    at = random_samples(model, 50)
    prior = np.linspace(0.1, 2.0, len(model.names))
    noise = np.array([0.3])
    information = FisherInformation(model, base, noise, noise, at, prior)
    W = model.regressor(at)[:, :, base.independent].reshape(-1, base.rank)
    before = base.grouping @ np.diag(prior**2) @ base.grouping.T
    after = np.linalg.inv(np.linalg.inv(before) + 4 * W.T @ W / noise**2)
    quality = information.measures(at, 200)  # a recording of four times these samples
    assert quality.std == pytest.approx(np.sqrt(np.diag(after)), rel=1e-6)
    gain = np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1]
    assert quality.logdet == pytest.approx(gain, rel=1e-8)


@pytest.mark.slow
def test_an_open_arm():
    arm = crane.load("ur5_robot")
    result = excite(arm, period=10.0, harmonics=3, starts=1)
    v, _, tau = keeps(result, arm)
    assert (v <= 0.95).all() and (tau <= 0.95).all()
    assert result.optimized_information.logdet > result.initial_information.logdet + 20
    assert result.base.rank == base_parameters(IdentificationModel(arm)).rank


# --- files and errors ------------------------------------------------------------------------


def test_files(slider_crank, tmp_path):
    result = excite(slider_crank, **QUICK)
    result.to_csv(tmp_path / "reference.csv")
    recording = crane.Recording.from_csv(tmp_path / "reference.csv")
    q, v, a = result.trajectory(recording.time)
    assert np.array_equal(recording.q, q) and np.array_equal(recording.v, v)
    joint = slider_crank.active[0]
    assert np.array_equal(recording.channels[f"{joint}_acceleration"], a[:, 0])
    assert recording.channel_units[f"{joint}_acceleration"] == "rad/s2"


def test_errors(mini, slider_crank, edited):
    for call, text in (
        (
            lambda: FourierTrajectory(np.zeros((4, 2)), 1.0),
            r"shape \(4, 2\), give \(1 \+ 2 harmonics",
        ),
        (
            lambda: FourierTrajectory(np.zeros((3, 2)), 0.0),
            "period is 0.0 s, give a number above 0",
        ),
        (lambda: excite(mini, criterion="det"), "criterion 'det' is unknown, known: condition"),
        (lambda: excite(mini, harmonics=0), "number of harmonics is 0, give a whole number"),
        (lambda: excite(mini, seed=-1), "seed is -1, give a whole number from 0"),
        (lambda: excite(mini, period=-1.0), "period is -1.0 s"),
        (lambda: excite(mini, margin=1.0), "margin is 1, give a share"),
        (lambda: excite(mini, noise={"X3": 1.0}), "noise of 'X3', which is not active, known"),
        (lambda: excite(mini, noise={"X1": 0.0}), "noise of 'X1' is 0.0"),
        (lambda: excite(mini, acceleration={"q2": 1.0}), "acceleration of 'q2', which is not"),
        (
            lambda: excite(mini, noise={"X1": 1e-320}),
            "is 1e-320, give a number from 1e-30",
        ),
        (lambda: excite(mini, noise={"X1": 1e9}), "noise of 'X1' is 1e.09, above the 80 of its"),
        (lambda: excite(mini, period=1e300), "period is 1e.300 s, give a number from 1e-30 to"),
        (lambda: excite(mini, step=1e-7), "are 4e.08 samples of 1e-07 s, .* of at least 9.4e-05"),
        (
            lambda: excite(mini, periods=10**7),
            "the memory: give a step of at least",
        ),
        (lambda: excite(mini, harmonics=5000), "with 3 active joints: give at most 38"),
        (
            lambda: excite(mini, step=1.0),
            "10 samples in a period of 10 s do not determine 75",
        ),
        (lambda: excite(slider_crank, prior=np.zeros(3)), "the prior has the shape"),
    ):
        with pytest.raises(InputError, match=text):
            call()
    weak = edited("slider_crank.yaml")
    weak.model.effortLimit[weak.closure.active[0]] = 1e-6
    with pytest.raises(InputError, match="has no reference .* for the force limit of"):
        excite(weak, **QUICK)


@pytest.mark.slow
def test_command(tmp_path):
    machine = crane.load(__file__.replace("test_excitation.py", "data/slider_crank.yaml"))
    out = tmp_path / "found"
    arguments = ("excite", machine.path, "--harmonics", 2, "--periods", 1, "--out", out)
    result = typed(*arguments)
    assert result.returncode == 0, result.stderr
    assert "random  optimised" in result.stdout and "share of limits used" in result.stdout
    names = ["coefficients.yaml", "reference.csv", "reference.png"]
    assert sorted(path.name for path in out.iterdir()) == names
    for extra, text in (
        ((), "is not empty, choose another folder or add --force"),
        (("--force", "--noise", "5"), "--noise is '5', write JOINT=VALUE, as in X1=0.5"),
        (("--force", "--criterion", "cond"), "criterion 'cond' is unknown, known: condition"),
    ):
        result = typed(*arguments, *extra)
        assert result.returncode == 2 and result.stdout == ""
        assert len(result.stderr.splitlines()) == 1 and text in result.stderr


def test_joints_without_limits_stay_near_home(tmp_path):
    """Within 1 rad, and within the 0.4 m between the joints."""
    parts = [
        urdf_text.body("beam", 1.0), urdf_text.joint("h", "base", "beam", axis=(0, 1, 0)),
        urdf_text.body("slider", 1.0),
        urdf_text.joint("s", "beam", "slider", (0.4, 0, 0), "prismatic", (1, 0, 0)),
    ]  # fmt: skip
    machine = crane.load(urdf_text.write(tmp_path, "two", "base", *parts))
    limits = trajectory_limits(machine, margin=0.1)
    np.testing.assert_allclose(limits.half_stroke, [0.9, 0.36], rtol=1e-12)


@pytest.mark.parametrize(("pump", "through"), [(1.6667e-3, 6.6667e-4), (4e-4, 4e-4)])
def test_valves_and_pumps_limit_velocities(patu, pump, through):
    """By the larger side of each cylinder."""
    hydraulics = patu.hydraulics
    supply = dataclasses.replace(hydraulics.supply, flow=pump)
    machine = patu.replace(hydraulics=dataclasses.replace(hydraulics, supply=supply))
    limits = trajectory_limits(machine, margin=0.1)
    for name, cylinder in hydraulics.cylinders.items():
        expected = 0.9 * through / max(cylinder.area_a, cylinder.area_b)
        assert limits.velocity[machine.active.index(name)] == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_all_cylinders_together_take_what_the_pump_gives():
    """Of velocities of rod and piston sides at instants that the search has not seen."""
    machine = crane.load("patu655")
    found = crane.excite(machine, period=8.0, harmonics=2, seed=1)
    hydraulics = machine.hydraulics
    _, v, _ = found.trajectory(np.linspace(0, 24, 7013))
    drawn = np.zeros(len(v))
    for joint, cylinder in hydraulics.cylinders.items():
        i, valve = machine.active.index(joint), hydraulics.valves[joint]
        taken = np.where(v[:, i] > 0, cylinder.area_a, -cylinder.area_b) * v[:, i]
        assert taken.max() <= max(valve.c1, valve.c4) * np.sqrt(valve.margin)
        drawn += taken
    assert drawn.max() <= hydraulics.supply.flow
    assert drawn.max() == pytest.approx(
        0.95 * found.limit_usage[4].max() * hydraulics.supply.flow, rel=0.01
    )
