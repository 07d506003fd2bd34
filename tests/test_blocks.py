"""Long recordings in blocks: the same numbers, in memory that does not grow with the regressor."""

import dataclasses
import tracemalloc

import numpy as np
import pytest

import crane
from crane.identification import equations, estimators, regressor, smoother
from crane.identification.equations import Equations
from crane.identification.estimators import huber, instrumental, least_squares, weighted
from crane.identification.identify import equations_of, identify
from crane.identification.model import Model, Presliding, default_terms
from crane.identification.signals import Motion, filter_rows

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")


@pytest.fixture(scope="module")
def mini():
    return crane.load("mini_forwarder")


def motion(machine, duration=16.0, step=2e-3, seed=0):
    """Five harmonics, the machine's forces and noise on them."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, duration, step)
    w = 2 * np.pi / 8.0 * np.arange(1, 6)
    a, b = rng.normal(size=(2, 5, 3))
    phase = time[:, None] * w
    q = np.sin(phase) @ (a / w[:, None]) - np.cos(phase) @ (b / w[:, None])
    v = np.cos(phase) @ a + np.sin(phase) @ b
    acc = -np.sin(phase) @ (a * w[:, None]) + np.cos(phase) @ (b * w[:, None])
    size = np.array([1.5, 0.013, 0.013]) / np.abs(q).max(axis=0)
    q, v, acc = np.array([0, 0.015, 0.015]) + q * size, v * size, acc * size
    tau = crane.Dynamics(machine).inverse(q, v, acc, friction=True)
    return Motion(time, q, v, acc, tau + rng.normal(size=tau.shape) * [5e-3, 0.5, 0.3])


def rows(seed=0, count=3000):
    """A regressor, forces with noise that remembers, groups with missing rows, out of order."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    W = lfilter([1.0], [1, -0.95], rng.normal(size=(count, 5)), axis=0)
    noise = lfilter([1.0], [1, -1.2, 0.5], rng.standard_t(4, size=count))
    groups, samples = np.arange(count) % 3, np.arange(count) // 3
    kept = np.flatnonzero((samples < 400) | (samples > 640) | (groups == 2))
    kept = kept[np.argsort(groups[kept], kind="stable")]
    return W[kept], (W @ [1, -2, 3, 0.5, 0] + noise)[kept], groups[kept], samples[kept]


@pytest.mark.parametrize("estimator", [least_squares, weighted, huber, instrumental])
@pytest.mark.parametrize("prior", [None, (np.ones(5), np.array([0.1, np.inf, 1, 1e3, 0.01]))])
def test_estimates_do_not_depend_on_the_blocks(estimator, prior, monkeypatch):
    W, y, groups, samples = rows()
    parts = [W, W + 0.1 * np.random.default_rng(1).normal(size=W.shape)]
    parts = parts if estimator is instrumental else parts[:1]
    whole = estimator(parts[0], y, *parts[1:], groups=groups, samples=samples, prior=prior)
    stored = regressor.Stored.__init__.__defaults__
    monkeypatch.setattr(regressor.Stored.__init__, "__defaults__", (50,))
    monkeypatch.setattr(estimators, "_WAITING", 7)
    found = estimator(parts[0], y, *parts[1:], groups=groups, samples=samples, prior=prior)
    assert stored == (8192,)  # what the first call had: all rows in one block
    for key in ("values", "covariance", "residuals", "noise", "effective", "freedom", "condition"):
        one, other = getattr(found, key), getattr(whole, key)
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


def test_covariance_is_that_of_all_rows_at_once():
    """Q^T C Q by a dense C = (a^-1 a^-T) of one group with missing rows."""
    from scipy.linalg import toeplitz

    from crane.identification.noise import Noise

    W, y, groups, samples = (x[rows()[2] == 1] for x in rows())
    found = least_squares(W, y, groups - 1, samples)
    noise = Noise.of(found.residuals / found.noise, samples)
    impulse = np.eye(1, 2000)
    answer, _ = noise.pass_on(impulse, noise.at_rest(1))
    lags = np.correlate(answer[0], answer[0], "full")[1999:]
    C = toeplitz(lags)[samples][:, samples]
    inverse = np.linalg.inv(W.T @ W)
    wanted = inverse @ W.T @ C @ W @ inverse
    ratio = found.covariance / wanted
    # innovations, and degrees of freedom
    scale = np.nanvar(noise.innovations) * found.noise[0] ** 2 * noise.known / found.freedom
    assert ratio == pytest.approx(np.full((5, 5), scale), rel=0.01)
    assert ratio == pytest.approx(np.full((5, 5), ratio[0, 0]), rel=1e-6)


@pytest.mark.parametrize("bandwidth", [12.0, 200.0])
def test_a_recording_in_blocks_is_that_as_a_whole(mini, monkeypatch, bandwidth):
    """With a term that depends on the past; none of the blocks is held."""
    given = motion(mini, 10.0)
    terms = [*default_terms(mini), Presliding(mini, "X1", 1e-3)]
    settings = {"prior": 0.3, "bandwidth": bandwidth, "terms": terms}
    whole = identify(mini, given, motion(mini, 8.0, seed=1), **settings)
    monkeypatch.setattr(equations, "_BLOCK", 3 << 20)
    monkeypatch.setattr(equations, "_HELD", 0)
    found = identify(mini, given, motion(mini, 8.0, seed=1), **settings)
    for fit in ("training", "validation"):
        for key in ("measured", "modelled"):
            one, other = (getattr(getattr(x, fit), key) for x in (found, whole))
            assert np.abs(one - other).max() < 1e-9 * np.abs(other).max()
    assert np.abs((found.values - whole.values) / whole.std).max() < 1e-6
    np.testing.assert_allclose(found.std, whole.std, rtol=1e-6)


def test_the_equations_are_those_of_one_filter(mini, monkeypatch):
    """Against the whole regressor through the filter at once."""
    monkeypatch.setattr(equations, "_BLOCK", 1 << 19)
    given, model = motion(mini, 8.0), Model(mini)
    found, _ = equations_of(model, given, bandwidth=10.0)
    assert len(list(found.blocks())) > 2
    at = model.samples(given.q, given.v, given.a)
    W = model.regressor(at)[:, :, found.base.independent]
    W, tau = filter_rows(W, given.tau, 2e-3, 10.0, 12)
    blocks = np.concatenate([W for _, W in found.blocks()])
    assert (np.abs(blocks - W).max(axis=(0, 1)) < 1e-10 * np.abs(W).max(axis=(0, 1))).all()
    assert np.abs(found.forces - tau).max() < 1e-10 * np.abs(tau).max()


def test_memory_does_not_grow_with_the_recording(mini, monkeypatch):
    """Beyond what single numbers per row take, a hundredth of the regressor."""
    monkeypatch.setattr(equations, "_BLOCK", 1 << 21)
    monkeypatch.setattr(equations, "_HELD", 1 << 21)
    model, given = Model(mini), motion(mini, 8.0)
    copies = 8
    long = Motion(
        given.time[0] + 2e-3 * np.arange(copies * len(given.time)),
        *(np.tile(x, (copies, 1)) for x in (given.q, given.v, given.a, given.tau)),
    )
    peaks = []
    for one in (given, long):
        found, base = equations_of(model, one, bandwidth=100.0)  # compiles, and tells the base
        columns = found.selection(base)
        tracemalloc.start()
        fresh = Equations(model, found.base, one, 100.0, found.slow)
        weighted(fresh.columns(columns), fresh.y, fresh.groups, fresh.samples)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    whole = 8 * long.q.size * found.base.rank
    assert peaks[1] - peaks[0] < 0.25 * whole, (peaks, whole)
    assert peaks[1] < 0.5 * whole


def test_smoothing_does_not_depend_on_the_blocks(monkeypatch):
    rng = np.random.default_rng(0)
    y = np.sin(0.01 * np.arange(3000)) + 1e-3 * rng.normal(size=3000)
    whole = smoother.smooth(y, 0.01)
    monkeypatch.setattr(smoother, "_AT_ONCE", 101)
    for one, other in zip(smoother.smooth(y, 0.01), whole, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-9 * np.abs(other).max())


def test_progress_goes_up_to_one(mini):
    told = []
    recording = motion(mini, 8.0)
    identify(mini, recording, prior=0.3, progress=told.append)
    assert len(told) > 3 and told[-1] == 1.0
    assert (np.diff(told) >= 0).all()
    assert dataclasses.is_dataclass(recording)
