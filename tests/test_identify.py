"""Identification from motions with known parameters, and how often samples are evaluated."""

import dataclasses
import re
from functools import partial

import forwarder_motions
import numpy as np
import pytest
from executed_lines import passes
from forwarder_motions import NOISE, noisy
from rig import Rig, Tolerances, default_sensors
from scipy.interpolate import CubicSpline
from threadpoolctl import threadpool_info, threadpool_limits

import crane
from crane.common.errors import InputError, RecordingError
from crane.common.threads import with_single_threaded_blas
from crane.dynamics import Dynamics
from crane.identification.estimation.estimators import least_squares
from crane.identification.excitation.periodic_excitation import excite
from crane.identification.mechanics import force_delays
from crane.identification.mechanics.base_parameters import base_parameters, random_samples
from crane.identification.mechanics.feasible_parameters import pseudo_inertia
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.identify import identify
from crane.identification.mechanics.identify_payload import identify_payload
from crane.identification.mechanics.model_terms import InertialTerm, friction_term
from crane.identification.mechanics.smoothed_motion import smoothed_motion
from crane.identification.signals.signal_processing import Motion
from crane.recordings import Recording
from crane.recordings.measured_recordings import read_run

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")
motion = partial(forwarder_motions.motion, step=2e-3)


def scales(model):
    """What counts as one of each parameter: masses and sizes of the bodies, friction."""
    out = np.maximum(np.abs(model.nominal), 0.1)
    for i in range(0, 10 * len(model.bodies), 10):
        P = pseudo_inertia(model.nominal[i : i + 10])
        mass, length = P[3, 3], np.sqrt(np.trace(P[:3, :3]) / P[3, 3])
        out[i : i + 10] = mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
    return out


def test_base_parameters_come_back_from_exact_forces(mini):
    """To 1e-8 of the bodies' masses and sizes; the regressor has rank 75."""
    model = IdentificationModel(mini)
    base = base_parameters(model)
    assert base.rank == 75
    at = random_samples(model, 1500, seed=3)
    tau = crane.Dynamics(mini).inverse(at.q_a, at.v_a, at.a_a, friction=True)
    W = model.regressor(at)[:, :, base.independent].reshape(-1, base.rank)
    found = least_squares(W, (tau - model.known_forces(at)).ravel()).values
    error = np.abs(found - base.values(model.nominal))
    assert (error / np.sqrt(base.grouping**2 @ scales(model) ** 2)).max() < 1e-8


@pytest.mark.parametrize("method", ["ols", "wls", pytest.param("huber", marks=pytest.mark.long)])
def test_noise_is_all_that_is_left(mini, method):
    """Within 10 % of what the filter passes of it, on another motion too where a prior helps."""
    given, other = noisy(motion(mini), 1), noisy(motion(mini, seed=7), 2)
    result = identify(mini, given, other, method, prior=0.3)
    step = given.time[1] - given.time[0]
    bandwidth = 0.25 / (result.training.time[1] - result.training.time[0])
    floor = NOISE * np.sqrt(2 * bandwidth * step)
    # ordinary least squares does not look after N m beside N
    joints = slice(1, 3) if method == "ols" else slice(0, 3)
    assert np.all(result.training.rmse[joints] < 1.1 * floor[joints])
    assert np.all(result.validation.rmse[joints] < 1.1 * floor[joints])
    text = result.to_text()
    assert "validation, samples near standstill excluded" in text
    for joint, unit in (("q1", "N m"), ("X1", "N"), ("X2", "N")):
        assert len(re.findall(rf"^{joint} +\S+ +{unit} +\d", text, re.M)) == 2


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ols", "wls"])
def test_intervals_cover_the_truth(mini, method):
    """Of eight recordings, 90 to 99 % of the 95 % intervals."""
    model = IdentificationModel(mini)
    given, covered = motion(mini, step=4e-3), []
    for seed in range(8):
        result = identify(mini, noisy(given, seed), method=method, bandwidth=30.0)
        truth = result.base.values(model.nominal)
        low, high = result.confidence_interval().T
        covered.append(np.mean((low <= truth) & (truth <= high)))
    assert 0.90 < np.mean(covered) < 0.99


@pytest.mark.slow
@pytest.mark.long
def test_intervals_cover_the_truth_of_rigs_as_users_identify_them():
    """12 rigs with settings of their own finding: bodies, friction with stiction, all sensors."""
    machine = crane.load("mini_forwarder")
    sensors = {
        joint: dataclasses.replace(default_sensors(machine, joint), error=(0.0, 0.0))
        for joint in machine.active
    }
    path = excite(machine, starts=1).trajectory
    covered = []
    for seed in range(100, 112):
        rig = Rig(machine, seed, Tolerances(pins=0.0), sensors)
        result = identify(machine, rig.run(path))
        truth = result.base.values(IdentificationModel(rig.plant).nominal)
        low, high = result.confidence_interval().T
        covered.append((low <= truth) & (truth <= high))
    assert 0.90 < np.mean(covered) < 0.99
    assert np.mean(covered, axis=0).min() >= 0.6  # of 95 % fewer than 8 in 12: one in 5000


def test_what_friction_does_near_standstill_is_in_no_row_that_counts(mini):
    """The filter has finite length, and rows that it reaches are left out."""
    given, slow = motion(mini, step=4e-3), np.array([0.1, 1e-3, 1e-3])
    stuck = np.abs(given.v) <= slow
    assert stuck.mean() < 0.2
    wrong = given.tau + np.where(stuck, 40 * NOISE, 0.0) * np.sign(given.v)
    result = identify(
        mini, dataclasses.replace(given, tau=wrong), bandwidth=5.0, min_speed=slow, method="ols"
    )
    found = result.predict(given.q, given.v, given.a)
    assert np.abs(found - given.tau).max() < 1e-6 * np.abs(given.tau).max()


def test_what_smoothing_takes_is_not_looked_for(mini):
    """Rows are no finer than the motion is known; a joint at rest does not count there."""
    given = motion(mini, step=4e-3)
    rng = np.random.default_rng(8)
    noise = np.array([2e-4, 2e-5, 2e-5]) * rng.normal(size=given.q.shape)

    def recording(q):
        units = {joint: mini.unit(joint) for joint in mini.active}
        return crane.Recording(given.time, mini.active, q, 0 * q, noisy(given, 8).tau, units)

    coarse = smoothed_motion(mini, recording(given.q + noise))
    assert 1.0 < coarse.passband < 20.0
    apart = np.diff(identify(mini, coarse).training.time[:2])[0]
    assert 0.25 / coarse.passband < apart < 0.5 / coarse.passband
    assert np.diff(identify(mini, given).training.time[:2])[0] < 0.1 * apart
    still = given.q + noise
    still[:, 0] = 0.3 + noise[:, 0]
    assert smoothed_motion(mini, recording(still)).passband > 0.8 * coarse.passband


def test_where_friction_settles_rows_begin_to_count(mini):
    """At 4 times the described smoothing, at stiction's end, at most at half of the speed."""
    given = noisy(motion(mini, step=4e-3, duration=12.0), 9)
    fastest = np.abs(given.v).max(axis=0)
    for joint, law, wanted in (
        ("q1", crane.description.Friction(coulomb=0.1, smoothing=2e-2), 0.08),
        (
            "q1",
            crane.description.Friction(coulomb=0.1, stiction=0.1, stribeck=0.03, smoothing=1e-3),
            0.12,
        ),
        ("q1", crane.description.Friction(coulomb=0.1, smoothing=10.0), 0.5 * fastest[0]),
        ("q1", crane.description.Friction(viscous=0.1, smoothing=0.0), 0.02 * fastest[0]),
    ):
        machine = mini.replace(friction={**mini.friction, joint: law})
        fit = identify(machine, given, bandwidth=20.0, prior=0.3).training
        near = np.abs(given.v[:: round((fit.time[1] - fit.time[0]) / 4e-3), 0])
        assert near[fit.is_moving[:, 0]].min() > wanted
        assert fit.is_moving[near > 1.5 * wanted, 0].mean() > 0.9


def test_a_prior_holds_what_forces_do_not_tell(mini):
    given = noisy(motion(mini), 3)
    result = identify(mini, given, prior=0.2)
    assert result.parameters is not None and len(result.parameters) == 130
    bodies = result.parameters[:110] - result.model.nominal[:110]
    assert np.abs(bodies / scales(result.model)[:110]).max() < 0.5
    assert result.training.overall_relative_error < 0.01
    np.testing.assert_allclose(
        result.values, result.base.values(result.parameters), rtol=1e-12, atol=1e-15
    )


def test_feasible_bodies_can_exist(mini):
    given = noisy(motion(mini), 4)
    result = identify(mini, given, feasible=True)
    for i in range(0, 110, 10):
        assert np.linalg.eigvalsh(pseudo_inertia(result.parameters[i : i + 10]))[0] > 0
    friction_of = dict(zip(result.model.names[110:], result.parameters[110:], strict=True))
    assert min(v for k, v in friction_of.items() if k.endswith((".coulomb", ".viscous"))) >= -1e-9
    plain = identify(mini, given)
    assert result.training.overall_relative_error < 1.5 * plain.training.overall_relative_error


def test_predict_is_the_inverse_dynamics_of_what_was_found(mini):
    given = motion(mini)
    result = identify(mini, given)
    other = motion(mini, seed=5, duration=2.0)
    found = result.predict(other.q, other.v, other.a)
    assert np.abs(found - other.tau).max() < 1e-6 * np.abs(other.tau).max()


def test_a_resting_joint_is_left_out(mini):
    """Without slewing, what only slewing tells is not told, the rest is."""
    given = motion(mini)
    q, v, a = (x.copy() for x in (given.q, given.v, given.a))
    q[:, 0], v[:, 0], a[:, 0] = 0.3, 0.0, 0.0
    tau = crane.Dynamics(mini).inverse(q, v, a, friction=True)
    result = identify(mini, noisy(Motion(given.time, q, v, a, tau), 6))
    assert result.base.rank < 60
    assert not any(name.startswith("q1.") for name in result.names)
    assert np.all(result.training.relative_error[1:] < 0.02)
    assert np.isnan([result.training.rmse[0], result.training.relative_error[0]]).all()


@pytest.mark.slow
def test_recordings_of_simulations_serve(mini):
    """From strokes and forces alone, velocities by the smoother."""
    given = motion(mini)
    path = crane.motion.Trajectory(CubicSpline(given.time, given.q))
    recording = crane.simulate(mini, crane.ComputedTorque(mini, path), path(0.0)[:2])
    slow = [0.03, 5e-4, 5e-4]
    result = identify(mini, recording, prior=0.1, min_speed=slow)
    assert result.training.overall_relative_error < 5e-3


PRIOR = "the prior's relative standard deviation"


def test_what_cannot_be_identified(mini):
    given = motion(mini)
    recording = crane.Recording(
        given.time, mini.active, given.q, given.v, given.tau,
        {joint: mini.unit(joint) for joint in mini.active},
    )  # fmt: skip
    other = crane.load("ur5_robot")
    for call, kind, message in (
        (lambda: identify(mini, given, method="lsq"), InputError, "method 'lsq' is unknown"),
        (
            lambda: identify(mini, given, prior=0.0),
            InputError,
            f"{PRIOR} is 0.0, give a number above",
        ),
        (lambda: identify(mini, given, prior=1e-300), InputError, f"{PRIOR} is 1e-300, give"),
        (lambda: identify(mini, given, prior=1e300), InputError, f"{PRIOR} is 1e+300, give"),
        (lambda: identify(mini, given, bandwidth=np.nan), InputError, "the bandwidth is nan Hz"),
        (
            lambda: identify(mini, given, min_speed={"X1": -1.0}),
            InputError,
            "min_speed of 'X1' is -1, it must",
        ),
        (lambda: identify(other, recording), RecordingError, "'shoulder_pan_joint', 'sho"),
        (
            lambda: identify(mini, given, feasible=True, terms=[friction_term(mini, "X1")]),
            InputError,
            "the model has no bodies",
        ),
        (
            lambda: identify(mini, given, min_speed=[1e3, 1e3, 1e3], terms=[InertialTerm(mini)]),
            RecordingError,
            "no joint moves faster than",
        ),
        (
            lambda: identify(
                mini, Motion(given.time, given.q, given.v, given.a, 1e-3 * given.tau)
            ),
            RecordingError,
            "'q1_force' is 0.001 times the model's, it looks like kN",
        ),
    ):
        with pytest.raises(kind) as caught:
            call()
        assert str(caught.value).startswith(message), str(caught.value)


def test_a_joint_of_one_row_is_refused(mini):
    """The noise cannot be estimated where all rows but one are slower than the limit."""
    given = motion(mini, step=4e-3)
    given = dataclasses.replace(given, v=given.v.copy())
    given.v[:, 1] = 0.0
    given.v[100, 1] = 1.0
    with pytest.raises(RecordingError, match="^'X1' is in one sample only faster than"):
        identify(mini, given, bandwidth=1e3, min_speed={"X1": 0.5}, trust=True)


def test_a_constant_recording_is_refused(mini):
    given = motion(mini, duration=2.0)
    still = np.broadcast_to(given.q[0], given.q.shape)
    recording = crane.Recording(
        given.time, mini.active, still, 0 * still, given.tau,
        {joint: mini.unit(joint) for joint in mini.active},
    )  # fmt: skip
    with pytest.raises(RecordingError, match="no joint moves, record a motion"):
        identify(mini, recording)
    with pytest.raises(InputError, match="a bandwidth of 0.1 Hz leaves nothing of 1.998 s"):
        identify(mini, given, bandwidth=0.1)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_feasible_estimates_settle_on_exact_forces_too(mini, level):
    path = crane.task_trajectory(mini, "loading")
    time = np.arange(0, 10, 2e-3)
    q, v, a = path(time)
    tau = crane.Dynamics(mini).inverse(q, v, a, friction=True)
    result = identify(mini, noisy(Motion(time, q, v, a, tau), 1, level), feasible=True)
    assert result.feasible and result.training.overall_relative_error < 0.02


# --- recordings without noise -------------------------------------------------------------------


def lift():
    """Of three drives one rests and one moves by an eighth of its stroke."""
    machine = crane.load("mini_forwarder")
    control = crane.PI(machine, crane.task_trajectory(machine, "lift"))
    return machine, crane.simulate(machine, control)


def tremble():
    """Of a robot whose joints move by a hundredth of their range."""
    machine = crane.load("tx40")
    small = 0.01 * np.random.default_rng(3).uniform(-1, 1, (4, 6))
    knots = small * (machine.upper - machine.lower)
    knots[[0, -1]] = 0
    knots += machine.home[machine.closure.active]
    path = crane.motion.Trajectory(CubicSpline(np.linspace(0, 6, 4), knots, bc_type="clamped"))
    control = crane.ComputedTorque(machine, path)
    return machine, crane.simulate(machine, control, path(0.0)[:2])


@pytest.fixture(scope="module", params=[lift, tremble])
def recorded(request):
    return request.param()


@pytest.mark.parametrize("method", ["ols", "wls", pytest.param("huber", marks=pytest.mark.long)])
def test_intervals_hold_the_truth_where_rounding_is_all_the_noise(recorded, method):
    machine, recording = recorded
    found = crane.identify(machine, recording, method=method)
    off = (found.values - found.base.values(found.model.nominal)) / found.std
    assert np.abs(off).max() < 3
    assert found.estimate.scaled_condition < 1e10  # of columns that count as told


def test_threads_of_the_linear_algebra_change_no_digit(recorded):
    machine, recording = recorded
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            assert crane_sees() == 1 and max(one["num_threads"] for one in blas()) == threads
            found.append(crane.identify(machine, recording))
    assert found[0].names == found[1].names
    np.testing.assert_array_equal(found[0].values, found[1].values)
    np.testing.assert_array_equal(found[0].std, found[1].std)


def blas():
    return [library for library in threadpool_info() if library["user_api"] == "blas"]


@with_single_threaded_blas
def crane_sees():
    """Largest number of threads that a decorated function has."""
    return max(library["num_threads"] for library in blas())


# --- evaluations per sample ---------------------------------------------------------------------


ASIDE = 2000  # samples at random postures for the base parameters, and at home, about


@pytest.fixture(scope="module")
def recording(mini):
    given = forwarder_motions.motion(mini, duration=24.0)
    units = {joint: mini.unit(joint) for joint in mini.active}
    return Recording(given.time, mini.active, given.q, given.v, given.tau, units)


@pytest.fixture
def undelayed(monkeypatch):
    """Without the search for delays, which looks at samples of its own."""
    nothing = force_delays.ForceDelays(("q1", "X1", "X2"), *np.full((3, 3), np.nan), 0)
    monkeypatch.setattr("crane.identification.mechanics.identify.force_delays", lambda *_: nothing)


def test_a_sample_is_closed_once_on_its_way_to_the_parameters(
    mini, recording, undelayed, monkeypatch
):
    N = len(recording.time)
    with passes(monkeypatch) as count:
        identify(mini, recording, feasible=True)
    assert set(count) == {"closed", "regressor"}
    assert N <= count["closed"] <= N + ASIDE
    assert N <= count["regressor"] <= N + ASIDE


def test_delays_are_looked_for_in_few_samples(mini, recording, monkeypatch):
    N = len(recording.time)
    with passes(monkeypatch) as count:
        identify(mini, recording)
    assert count["closed"] <= N + min(force_delays._MAX_SAMPLES, N) + ASIDE


def test_a_sample_is_closed_once_on_its_way_to_the_payload(mini, recording, monkeypatch):
    """Forces of the machine and of the load are computed at the same closed configurations."""
    N = len(recording.time)
    with passes(monkeypatch) as count:
        identify_payload(mini, recording)
    assert N <= count["closed"] <= N + ASIDE
    assert N <= count["inverse with friction"] <= N + ASIDE
    assert N <= count["regressor"] <= N + ASIDE


def test_strokes_from_angles_are_closed_twice(mini, recording, tmp_path, monkeypatch):
    """Closed once from angles to strokes, once back to verify that strokes give the angles."""
    N, q = len(recording.time), mini.closure.solve(recording.q)
    columns = {"time [s]": recording.time}
    columns |= {f"{x} [rad]": q[:, mini.column(x)] for x in ("q1", "q2", "q3")}
    for i, joint in enumerate(mini.active):
        columns[f"{joint}_force [{'N m' if i == 0 else 'N'}]"] = recording.tau[:, i]
    np.savez(tmp_path / "angles.npz", **columns)
    with passes(monkeypatch) as count:
        read = read_run(tmp_path / "angles.npz", mini)
    assert np.abs(read.q - recording.q).max() < 1e-9
    assert set(count) == {"closed"} and 2 * N <= count["closed"] <= 2 * N + 2 * ASIDE + 2000


def test_a_file_is_read_once(mini, recording, tmp_path, monkeypatch):
    """Also one that its machine completes, which the file names: by pressures without a force."""
    parsed, load = [], np.loadtxt
    monkeypatch.setattr(np, "loadtxt", lambda *a, **k: parsed.append(a) or load(*a, **k))
    plain, named = tmp_path / "plain.csv", tmp_path / "named.csv"
    recording.to_csv(plain)
    head, *rows = [x for x in plain.read_text().splitlines() if not x.startswith("#")]
    rows = [f"{head},pressure_pump_a [Pa]", *(f"{row},1e5" for row in rows)]
    named.write_text("\n".join(["# machine: mini_forwarder", *rows]))
    for file, machine in ((plain, mini), (plain, None), (named, mini), (named, None)):
        parsed.clear()
        assert np.array_equal(read_run(file, machine).q, recording.q)
        assert len(parsed) == -(-len(recording.time) // 4096)  # blocks, once each


@pytest.mark.parametrize("backend", ["compiled", "pinocchio"])
def test_quantities_at_closed_postures_are_those_of_their_strokes(mini, backend):
    given, dynamics = forwarder_motions.motion(mini, duration=0.2), Dynamics(mini, backend=backend)
    q = mini.closure.solve(given.q)
    found = dynamics.evaluate_closed("inverse with friction", q, given.v, given.a)
    wanted = dynamics.inverse(given.q, given.v, given.a, friction=True)
    assert np.abs(found - wanted).max() < 1e-12 * np.abs(wanted).max()
    one = dynamics.evaluate_closed("inverse with friction", q[3], given.v[3], given.a[3])
    assert np.abs(one - found[3]).max() <= 1e-14 * np.abs(wanted).max()
    # columns of a table that was solved or transposed stand the other way round
    turned = dynamics.evaluate_closed(
        "inverse with friction", *map(np.asfortranarray, (q, given.v, given.a))
    )
    np.testing.assert_array_equal(turned, found)
