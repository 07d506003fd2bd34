"""Signals and weak forms: filters, derivatives, noise."""

import dataclasses
import math
import warnings

import numpy as np
import pytest
from scipy.linalg import block_diag

from crane.common.errors import CraneWarning, InputError, RecordingError
from crane.identification.mechanics.force_comparison import check_forces
from crane.identification.mechanics.smoothed_motion import (
    check_recording,
    signal_delay,
)
from crane.identification.signals import kalman_smoother
from crane.identification.signals import signal_processing as signals
from crane.identification.signals.signal_processing import Motion, differentiate
from crane.identification.signals.signal_quality import spectral_edge_frequency

JOINTS, UNITS = ("q1", "X1"), {"q1": "rad", "X1": "m"}


def movement(time):
    """Two joints of a crane: coordinates, velocities, accelerations (N, 2)."""
    q = v = a = 0
    for size, rate, phase in (([0.5, 0.1], 1.1, 0.3), ([0.2, 0.03], 3.3, 1.0)):
        angle = rate * time[:, None] + phase + np.array([0.0, 0.7])
        q = q + np.array(size) * np.sin(angle)
        v = v + np.array(size) * rate * np.cos(angle)
        a = a - np.array(size) * rate**2 * np.sin(angle)
    return q, v, a


def model(h):
    """F, Q and the process noise's factor of the constant-jerk model, from its definition."""
    F = np.array([[1, h, h**2 / 2, h**3 / 6], [0, 1, h, h**2 / 2], [0, 0, 1, h], [0, 0, 0, 1]])
    nodes, weights = np.polynomial.legendre.leggauss(8)
    b = [
        np.array([s**3 / 6, s**2 / 2, s, 1]) * math.sqrt(w * h / 2)
        for s, w in zip((nodes + 1) * h / 2, weights, strict=True)
    ]
    return F, h * np.array(b).T @ np.array(b)


def whole(y, h):
    """All states at once: generalised least squares over every equation, nothing known before."""
    F, Q = model(h)
    L = np.linalg.inv(np.linalg.cholesky(Q))
    n = len(y)
    process = np.kron(np.eye(n - 1, n, 1), L) - np.kron(np.eye(n - 1, n), L @ F)
    rows = np.vstack([process, block_diag(*[np.eye(1, 4)] * n)])
    right = np.concatenate([np.zeros(len(process)), y])
    Q_, R = np.linalg.qr(rows)
    inverse = np.linalg.inv(R)
    return (inverse @ (Q_.T @ right)).reshape(n, 4), (inverse**2).sum(1).reshape(n, 4)


@pytest.fixture
def fixed(monkeypatch):
    """Takes the search for the noise ratio out of the smoother."""

    def smooth(y, step, h):
        import scipy.optimize

        class Found:
            x = math.log(h)

        monkeypatch.setattr(scipy.optimize, "minimize_scalar", lambda *_, **__: Found)
        return kalman_smoother.kalman_smooth(y, step)

    return smooth


@pytest.mark.parametrize("h", [0.2, 0.5, 1.5])
@pytest.mark.parametrize("count", [60, 100])
def test_smoother_is_the_solution_of_all_equations_at_once(fixed, h, count):
    y = np.random.default_rng(1).standard_normal(count).cumsum()
    states, stds, sigma, _ = fixed(y, 0.01, h)
    exact, variances = whole(y, h)
    units = (h / 0.01) ** np.arange(3)
    np.testing.assert_allclose(states, exact[:, :3] * units, atol=1e-7 * units.max(), rtol=1e-7)
    np.testing.assert_allclose(stds, sigma * np.sqrt(variances[:, :3]) * units, rtol=1e-8)


def test_likelihood_is_the_density_of_what_polynomials_leave():
    """With an unknown state, the likelihood is that of the contrasts to cubic polynomials."""
    rng = np.random.default_rng(3)
    y, costs, exact = rng.standard_normal(40).cumsum(), [], []
    for h in (0.3, 0.7, 1.4):
        costs.append(kalman_smoother.likelihood(y, h)[0])
        F, Q = model(h)
        V, cross = np.zeros((40, 40)), np.zeros((4, 4))
        for k in range(40):
            cross = F @ cross @ F.T + Q if k else cross
            moved = cross[:, 0]
            for j in range(k, 40):
                V[k, j] = V[j, k] = moved[0]
                moved = F @ moved
        V += np.eye(40)
        basis = np.linalg.qr(np.vander(np.linspace(-1, 1, 40), 4), "complete")[0][:, 4:]
        S = basis.T @ V @ basis
        rest = basis.T @ y
        exact.append(36 * math.log(rest @ np.linalg.solve(S, rest)) + np.linalg.slogdet(S)[1])
    np.testing.assert_allclose(np.diff(costs), np.diff(exact), rtol=1e-6)


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_derivatives_of_a_crane_and_their_noise(noise):
    time = np.arange(30_000) * 1e-3
    q, v, a = movement(time)
    rng = np.random.default_rng(4)
    found = differentiate(time, q + noise * rng.standard_normal(q.shape))
    np.testing.assert_allclose(found.noise, noise, rtol=0.03)
    bound_v, bound_a = {1e-5: (2e-4, 3e-3), 1e-4: (1e-3, 1e-2), 1e-3: (7e-3, 4e-2)}[noise]
    assert (np.std(found.v - v, axis=0) < bound_v * np.std(v, axis=0) * [1, 5]).all()
    assert (np.std(found.a - a, axis=0) < bound_a * np.std(a, axis=0) * [1, 5]).all()
    assert found.v.shape == found.std_v.shape == q.shape


def test_standard_deviations_cover_the_truth():
    """Motions drawn from the model itself: errors over standard deviations are standard normal."""
    rng, step, h, count = np.random.default_rng(5), 1e-2, 0.3, 1000
    F, Q = model(h)
    factor = np.linalg.cholesky(Q)
    errors, noise = [], []
    for _ in range(16):
        x, states = np.zeros(4), []
        for _ in range(count):
            x = F @ x + factor @ rng.standard_normal(4)
            states.append(x)
        truth = np.array(states)[:, :3] * (h / step) ** np.arange(3)
        found = differentiate(
            step * np.arange(count), truth[:, :1] + rng.standard_normal((count, 1))
        )
        noise.append(found.noise[0])
        errors.append((found.v[:, 0] - truth[:, 1]) / found.std_v[:, 0])
        errors.append((found.a[:, 0] - truth[:, 2]) / found.std_a[:, 0])
    assert abs(np.std(errors) - 1) < 0.06
    assert 0.93 < np.mean(np.abs(errors) < 1.96) < 0.97
    assert abs(np.mean(noise) - 1) < 0.02
    assert np.std(noise) < 0.05


def test_without_noise_and_without_motion():
    time = np.arange(4000) * 1e-3
    q, v, a = movement(time)
    found = differentiate(time, np.column_stack([q, np.full(4000, 0.3)]))
    np.testing.assert_allclose(found.v[:, :2], v, atol=1e-8)
    np.testing.assert_allclose(found.a[50:-50, :2], a[50:-50], atol=1e-4)
    assert not found.v[:, 2].any() and found.passband[2] == math.inf


def test_the_frequency_of_which_a_smoother_leaves_half():
    """Found from noise, checked with a movement of that frequency through the same smoother."""
    step, rng = 1e-3, np.random.default_rng(6)
    time = step * np.arange(20_000)
    found = differentiate(time, movement(time)[0] + 1e-4 * rng.standard_normal((20_000, 2)))
    for passed in found.passband:
        F, _, K = kalman_smoother._stationary_filter(2 * np.pi * passed * step)
        z = np.exp(2j * np.pi * passed * step)
        gain = np.linalg.solve(z * np.eye(4) - F @ (np.eye(4) - np.outer(K, np.eye(4)[0])), F @ K)
        innovation = 1 - gain[0]  # of the predictions; |1 - innovation spectrum| is what is left
        left = 1 - abs(innovation) ** 2 * (1 - K[0])
        assert left == pytest.approx(0.5, abs=0.01)


def test_low_pass_halves_at_the_cutoff_without_delay():
    time = np.arange(8000) * 1e-3
    x = np.sin(2 * np.pi * np.array([1.0, 5.0, 50.0]) * time[:, None])
    y = signals.low_pass(time, x, 5.0)
    gain = (y * x)[1000:7000].mean(0) / (x * x)[1000:7000].mean(0)
    np.testing.assert_allclose(gain, [1, 0.5, 0], atol=2e-3)
    with pytest.raises(InputError, match="cutoff is 600 Hz, give one between 0 and 500 Hz"):
        signals.low_pass(time, x, 600.0)


def test_lowpass_method():
    time = np.arange(8000) * 1e-3
    q, v, a = movement(time)
    found = differentiate(time, q, "lowpass", cutoff=20.0)
    inner = slice(300, -300)
    np.testing.assert_allclose(found.v[inner], v[inner], atol=1e-5)
    np.testing.assert_allclose(found.a[inner], a[inner], atol=1e-4)
    for method, cutoff in (("spline", None), ("lowpass", None), ("kalman", 5.0)):
        with pytest.raises(InputError, match=f"method '{method}'"):
            differentiate(time, q, method, cutoff)


def test_resampling():
    rng = np.random.default_rng(6)
    time = np.sort(np.arange(4000) * 1e-3 + rng.uniform(0, 4e-4, 4000))
    with pytest.raises(RecordingError, match="off equidistant samples at .* resample first"):
        differentiate(time, movement(time)[0])
    even, q = signals.resample(time, movement(time)[0], 1e-3)
    assert even[0] == time[0]
    assert time[-1] - 1e-3 < even[-1] <= time[-1]
    np.testing.assert_allclose(q, movement(even)[0], atol=1e-10)
    time[2000:] += 0.1
    with pytest.raises(RecordingError, match=r"no sample between 1\.99\d* and 2\.1"):
        signals.resample(time, q, 1e-3)


def test_average_of_periods():
    rng = np.random.default_rng(7)
    time = np.arange(2650) * 1e-2
    clean = np.column_stack([np.sin(2 * np.pi * time), np.cos(4 * np.pi * time)])
    at, mean, error = signals.average_periods(time, clean + rng.standard_normal((2650, 2)), 1.0)
    assert at.shape == (100,)
    score = (mean - clean[:100]) / error
    assert abs(np.mean(error) * math.sqrt(26) - 1) < 0.03
    assert abs(np.std(score) - math.sqrt(25 / 23)) < 0.15  # Student's t of 25 degrees of freedom
    with pytest.raises(RecordingError, match="hold fewer than two periods of 20 s"):
        signals.average_periods(time, clean, 20.0)
    with pytest.raises(RecordingError, match="no multiple of the step 0.01 s, resample"):
        signals.average_periods(time, clean, 1.004)


def test_filtered_rows_keep_the_parameters():
    rng = np.random.default_rng(8)
    regressor = rng.standard_normal((2000, 2, 5))
    truth = np.arange(1.0, 6.0)
    W, y = signals.filter_rows(regressor, regressor @ truth, 1e-3, 20.0, 10)
    assert W.shape == (200, 2, 5)
    np.testing.assert_allclose(W @ truth, y, atol=1e-12)
    with pytest.raises(InputError, match="cutoff is 30 Hz, give at most 25 Hz for every 10th"):
        signals.filter_rows(regressor, y, 1e-3, 30.0, 10)
    regressor[7, 1, 2] = np.nan
    with pytest.raises(InputError, match="regressor is not finite at sample 7"):
        signals.filter_rows(regressor, regressor @ truth, 1e-3, 20.0, 10)


@pytest.mark.parametrize(("cutoff", "decimation"), [(5.0, 50), (5.0, 7), (60.0, 4)])
def test_a_filtered_row_sees_its_neighbourhood_and_nothing_else(cutoff, decimation):
    """Gain 1/2 at the cutoff, 3e-5 from three times that on, and an end to every answer."""
    weights = signals.filter_kernel(1e-3, cutoff)
    reach = len(weights) // 2
    assert reach < 0.667 / (cutoff * 1e-3) and weights.min() > 0
    frequency = np.array([1.0, 3.0, 4.5]) * cutoff
    turns = 2 * np.pi * 1e-3 * frequency[:, None] * np.arange(-reach, reach + 1)
    gain = np.cos(turns) @ weights
    assert abs(gain[0] - 0.5) < 2e-3 and np.abs(gain[1:]).max() < 5e-5
    forces = np.zeros((3001, 2))
    forces[1234, 0], forces[:, 1] = 1.0, 7.0
    W, y = signals.filter_rows(forces[:, :, None], forces, 1e-3, cutoff, decimation)
    assert len(y) == -(-3001 // decimation)
    at = np.arange(0, 3001, decimation)
    near = np.abs(at - 1234) <= reach
    assert near.any() and (y[near, 0] > 0).all() and not y[~near, 0].any()
    np.testing.assert_allclose(y[near, 0], weights[1234 - at[near] + reach], rtol=1e-12)
    np.testing.assert_allclose(y[:, 1], 7.0, rtol=1e-12)  # at the ends too
    np.testing.assert_array_equal(W[:, :, 0], y)


def recorded():
    time = np.arange(5000) * 4e-3
    q, v, a = movement(time)
    rng = np.random.default_rng(9)
    tau = 100 * a + 20 * np.sign(v) + 50 * np.cos(q) + rng.standard_normal(q.shape)
    return {
        "time": time,
        "q": q + 1e-4 * rng.standard_normal(q.shape),
        "v": v + 1e-3 * rng.standard_normal(q.shape),
        "tau": tau,
        "joints": JOINTS,
        "units": UNITS,
        "limits": np.array([[-0.8, 0.8], [-0.2, 0.2]]),
    }


def scale(name, column, factor):
    def spoil(r):
        r[name][:, column] *= factor

    return spoil


def still(r):
    r["q"] = r["q"][0] + 1e-4 * np.random.default_rng(0).standard_normal(r["q"].shape)


def late(seconds):
    def spoil(r):
        r["v"][:, 0] = movement(r["time"] - seconds)[1][:, 0]

    return spoil


def without_limits(spoil):
    def both(r):
        del r["limits"]
        spoil(r)

    return both


def hole(r):
    r["time"][2000:] += 0.5


def dead(r):
    r["tau"][:, 1] = 3.0


def short(r):
    r.update({x: r[x][:40] for x in ("time", "q", "v", "tau")})


SPOILT = {
    "short": (short, "40 samples are too few, record at least 50"),
    "hole": (hole, "no sample between 7.996 and 8.5 s where the usual step is 0.004 s, cut"),
    "still": (still, "no joint moves, record a motion"),
    "dead": (dead, "'X1_force' is constant while 'X1' moves, check it"),
    "degrees": (scale("q", 0, 57.3), "its limits are -0.8 and 0.8 rad, it looks like deg"),
    "millimetres": (scale("q", 1, 1e3), "its limits are -0.2 and 0.2 m, it looks like mm"),
    "beyond": (scale("q", 1, 5), "its limits are -0.2 and 0.2 m, check its zero and unit"),
    "degrees without limits": (
        without_limits(scale("q", 0, 57.3)),
        "times the derivative of 'q1', 'q1' looks like deg, give rad",
    ),
    "degrees per second": (
        scale("v", 0, 57.3),
        "'q1_velocity' is 57.3 times the derivative of 'q1', 'q1_velocity' looks like deg",
    ),
    "late": (late(0.2), "ms behind 'q1', record them with one clock"),
    "early": (late(-0.12), "ms ahead of 'q1', record them with one clock"),
    "exchanged": (scale("v", 1, -1), "'X1_velocity' is not the derivative of 'X1'"),
}


@pytest.mark.parametrize(("spoil", "message"), SPOILT.values(), ids=SPOILT.keys())
def test_bad_recordings_are_explained(spoil, message):
    def judge():
        check_recording(**recording)

    recording = recorded()
    judge()
    spoil(recording)
    with pytest.raises(RecordingError) as error:
        judge()
    assert message in str(error.value)


def moved():
    """A motion, its force by weight and inertia, and what friction and a rotor add to it."""
    time = np.arange(5000) * 4e-3
    q, v, a = movement(time)
    modelled = 50 * np.cos(3 * q) + 10 * a
    rest = 20 * np.sign(v) + 30 * v + 100 * a + np.random.default_rng(9).standard_normal(q.shape)
    return Motion(time, q, v, a, modelled + rest), modelled


def first(motion):
    """Its first joint."""
    parts = (x[:, :1] for x in (motion.q, motion.v, motion.a, motion.tau))
    return Motion(motion.time, *parts)


def times(motion, factor):
    return dataclasses.replace(motion, tau=factor * motion.tau)


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        (1e3, "times the model's, it looks 1000-fold, give SI units"),
        (1e-3, "times the model's, it looks like kN, give SI units"),
        (100, "times the model's, look at its unit and its gear ratio"),
        (-1, "'q1_force' is -1 times the model's, turn its sign"),
    ],
)
def test_forces_against_a_model(factor, message):
    motion, modelled = moved()
    check_forces(motion, modelled, JOINTS)
    motion, modelled = first(motion), modelled[:, :1]
    with pytest.raises(RecordingError) as error:
        check_forces(times(motion, factor), modelled, JOINTS[:1])
    line = str(error.value)
    assert message in line and line.endswith("trust it (trust)")
    found = float(line.split(" is ")[1].split(" times")[0])
    assert abs(found / factor - 1) < 0.02
    with pytest.warns(CraneWarning, match="'q1_force' is .*: trusted"):
        check_forces(times(motion, factor), modelled, JOINTS[:1], trust=True)


def test_forces_of_friction_and_rotors_tell_no_unit():
    """Where bodies have a hundredth of the force, it is a doubt; a visible share settles it."""
    motion, modelled = moved()
    others = motion.tau - modelled
    for share, told in ((1e-4, True), (2e-2, False)):
        heavy = dataclasses.replace(motion, tau=share * modelled + others)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            check_forces(first(heavy), share * modelled[:, :1], JOINTS[:1])
        assert bool(caught) == told
        if told:
            line = str(caught[0].message)
            assert line.startswith("'q1_force' is ") and line.endswith("recording cannot say")


def test_a_force_of_another_shape_is_a_doubt():
    """A hundred times the model, and more that the model lacks: what it has is no measure."""
    motion, modelled = moved()
    motion = dataclasses.replace(motion, tau=100 * modelled + 2e3 * np.sin(11 * motion.q))
    with pytest.warns(CraneWarning, match="'q1_force' is .* this recording cannot say"):
        check_forces(first(motion), modelled[:, :1], JOINTS[:1])


def test_forces_come_late():
    motion, modelled = moved()
    late = Motion(
        *(x[50:] for x in (motion.time, motion.q, motion.v, motion.a)), 1.2 * modelled[:-50]
    )
    with pytest.raises(RecordingError, match="'q1_force' is 200 ms behind its model"):
        check_forces(late, modelled[50:], JOINTS)


@pytest.mark.parametrize(("amplitude", "edge"), [(0.05, 1.03), (0.1, 4.0)])
def test_a_spectral_edge_leaves_out_half_a_percent_of_the_power(amplitude, edge):
    """Of 20.6 and 80 periods, so that the first one leaks; its Hann window holds it together."""
    time = 0.02 * np.arange(1000)
    x = np.sin(2 * np.pi * 1.03 * time) + amplitude * np.sin(2 * np.pi * 4.0 * time)
    found = spectral_edge_frequency(np.column_stack([np.ones(1000), 1e3 * x + 7.0]), 0.02)
    assert found == pytest.approx(edge, abs=2 / 20.0)
    held = spectral_edge_frequency(np.sin(2 * np.pi * 1.03 * time)[:, None], 0.02, 0.9999)
    assert held == pytest.approx(1.03, abs=4 / 20.0)


@pytest.mark.parametrize("delay", [-0.1234, -0.004, 0.0, 0.003, 0.2468])
def test_delays_of_parts_of_a_sample(delay):
    """Of a smooth signal that does not repeat; a parabola errs by a hundredth of a sample."""
    time = 0.01 * np.arange(1000)

    def signal(t):
        return sum(np.sin(rate * t + rate) for rate in (2.0, 3.3, 5.1, 7.7))

    found = signal_delay(time, signal(time), signal(time - delay))
    assert found == pytest.approx(delay, abs=2e-4)
