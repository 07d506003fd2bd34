"""Recordings processed in blocks: same results, and bounded memory."""

from functools import partial

import forwarder_motions
import numpy as np
import pytest
from scipy.signal import lfilter

from crane.identification.estimation import estimators, regressor
from crane.identification.estimation.estimators import (
    huber,
    instrumental_variables,
    least_squares,
    weighted_least_squares,
)
from crane.identification.mechanics import regression_equations
from crane.identification.mechanics.identification_model import IdentificationModel, default_terms
from crane.identification.mechanics.identify import build_equations, identify
from crane.identification.mechanics.model_terms import PreslidingFriction
from crane.identification.mechanics.regression_equations import (
    CombinedRegressor,
    RegressionEquations,
)
from crane.identification.signals import kalman_smoother
from crane.identification.signals.signal_processing import Motion

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")
motion = partial(forwarder_motions.motion, period=8.0, duration=16.0, step=2e-3, noise=1.0)


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


@pytest.mark.parametrize(
    "estimator", [least_squares, weighted_least_squares, huber, instrumental_variables]
)
@pytest.mark.parametrize("prior", [None, (np.ones(5), np.array([0.1, np.inf, 1, 1e3, 0.01]))])
def test_estimates_do_not_depend_on_the_blocks(estimator, prior, monkeypatch):
    W, y, groups, samples = rows()
    parts = [W, W + 0.1 * np.random.default_rng(1).normal(size=W.shape)]
    parts = parts if estimator is instrumental_variables else parts[:1]
    whole = estimator(parts[0], y, *parts[1:], groups=groups, samples=samples, prior=prior)
    stored = regressor.StoredRegressor.__init__.__defaults__
    monkeypatch.setattr(regressor.StoredRegressor.__init__, "__defaults__", (50,))
    monkeypatch.setattr(estimators, "_GAP_BLOCK", 7)
    found = estimator(parts[0], y, *parts[1:], groups=groups, samples=samples, prior=prior)
    assert stored == (8192,)  # what the first call had: all rows in one block
    keys = ("values", "covariance", "residuals", "noise")
    for key in (*keys, "degrees_of_freedom", "condition"):
        one, other = getattr(found, key), getattr(whole, key)
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


def test_covariance_is_that_of_all_rows_at_once():
    """Q^T C Q by a dense C = (a^-1 a^-T) of one group with missing rows."""
    from scipy.linalg import toeplitz

    from crane.identification.estimation.noise_model import NoiseModel

    W, y, groups, samples = (x[rows()[2] == 1] for x in rows())
    found = least_squares(W, y, groups - 1, samples)
    noise = NoiseModel.fit(found.residuals / found.noise, samples)
    impulse = np.eye(1, 2000)
    answer = lfilter([1.0], noise.a, impulse)
    lags = np.correlate(answer[0], answer[0], "full")[1999:]
    C = toeplitz(lags)[samples][:, samples]
    inverse = np.linalg.inv(W.T @ W)
    wanted = inverse @ W.T @ C @ W @ inverse
    # the jackknife may widen single deviations, never narrow them, and leaves correlations
    unit, wanted_unit = np.sqrt(np.diag(found.covariance)), np.sqrt(np.diag(wanted))
    correlation = found.covariance / np.outer(unit, unit)
    assert correlation == pytest.approx(wanted / np.outer(wanted_unit, wanted_unit), abs=1e-6)
    scale = np.sqrt(np.nanvar(noise.innovations)) * found.noise[0]
    assert (unit > 0.98 * scale * wanted_unit).all()


@pytest.mark.parametrize("bandwidth", [12.0, 200.0])
def test_a_recording_in_blocks_is_that_as_a_whole(mini, monkeypatch, bandwidth):
    """Also with a term that depends on earlier samples; no block stays in memory."""
    given = motion(mini, duration=10.0)
    terms = [*default_terms(mini), PreslidingFriction(mini, "X1", 1e-3)]
    settings = {"prior": 0.3, "bandwidth": bandwidth, "terms": terms}
    whole = identify(mini, given, motion(mini, duration=8.0, seed=1), **settings)
    monkeypatch.setattr(regression_equations, "_BLOCK_BYTES", 3 << 20)
    monkeypatch.setattr(regression_equations, "_CACHE_BYTES", 0)
    found = identify(mini, given, motion(mini, duration=8.0, seed=1), **settings)
    for fit in ("training", "validation"):
        for key in ("measured", "modelled"):
            one, other = (getattr(getattr(x, fit), key) for x in (found, whole))
            assert np.abs(one - other).max() < 1e-9 * np.abs(other).max()
    assert np.abs((found.values - whole.values) / whole.std).max() < 1e-6
    np.testing.assert_allclose(found.std, whole.std, rtol=1e-6)


def test_what_is_held_does_not_grow_with_the_recording(mini, monkeypatch):
    monkeypatch.setattr(regression_equations, "_BLOCK_BYTES", 1 << 21)
    monkeypatch.setattr(regression_equations, "_CACHE_BYTES", 1 << 20)
    unfiltered, sizes = RegressionEquations._unfiltered_block, []

    def spied(*arguments):
        out = unfiltered(*arguments)
        sizes.append(out.nbytes)
        return out

    monkeypatch.setattr(RegressionEquations, "_unfiltered_block", spied)
    given = motion(mini, duration=3.0)
    for copies in (2, 5):
        parts = (np.tile(x, (copies, 1)) for x in (given.q, given.v, given.a, given.tau))
        time = 2e-3 * np.arange(copies * len(given.time))
        rows, base = build_equations(
            IdentificationModel(mini), [Motion(time, *parts)], bandwidth=100.0
        )
        columns = CombinedRegressor(rows, rows.column_selection(base))
        assert len(list(columns.blocks())) >= copies
        assert max(sizes) < 1.5 * (1 << 21)  # with what the filter needs around
        assert sum(W.nbytes for W in rows._block_cache.values()) <= 1 << 20
    assert len(sizes) > 10


def test_smoothing_does_not_depend_on_the_blocks(monkeypatch):
    rng = np.random.default_rng(0)
    y = np.sin(0.01 * np.arange(3000)) + 1e-3 * rng.normal(size=3000)
    whole = kalman_smoother.kalman_smooth(y, 0.01)
    monkeypatch.setattr(kalman_smoother, "_BLOCK_SAMPLES", 101)
    for one, other in zip(kalman_smoother.kalman_smooth(y, 0.01), whole, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-9 * np.abs(other).max())


def test_progress_goes_up_to_one(mini):
    told = []
    identify(mini, motion(mini, duration=4.0), prior=0.3, progress=told.append)
    assert len(told) > 3 and told[-1] == 1.0
    assert (np.diff(told) >= 0).all()
