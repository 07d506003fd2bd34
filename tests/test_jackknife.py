"""Jackknife standard deviations, which need no noise model."""

import numpy as np
import pytest

from crane.identification.estimation.estimators import huber, least_squares, weighted_least_squares
from crane.identification.estimation.noise_model import Jackknife, NoiseModel


def test_leaving_out_in_closed_form_is_leaving_out():
    """Against as many least-squares solutions as there are stretches, gaps and joints included."""
    rng = np.random.default_rng(0)
    samples = np.sort(np.r_[np.arange(50, 400), np.arange(50, 300, 3), np.arange(600, 700)])
    W = rng.standard_normal((len(samples), 5)) * np.geomspace(1, 100, 5)
    y = W @ np.arange(5.0) + (1 + np.abs(W[:, 0])) * rng.standard_normal(len(W))
    Q, R = np.linalg.qr(W)
    theta = np.linalg.solve(R, Q.T @ y)
    noise = NoiseModel.fit(rng.standard_normal(400), np.arange(400))
    jackknife = Jackknife(samples, [noise], 5)
    e = y - W @ theta
    for rows in (slice(300, None), slice(0, 300)):  # as they are read, in any order
        jackknife.add(samples[rows], Q[rows].T, e[rows], np.full(len(e[rows]), True))
    edges = [*jackknife._segment_starts.tolist(), np.inf]
    without = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        rest = (samples < low) | (samples >= high)
        without.append(np.linalg.lstsq(W[rest], y[rest])[0])
    K = len(without)
    assert jackknife.degrees_of_freedom == K - 1 and K >= 20
    off = without - np.mean(without, axis=0)
    exact = (K - 1) / K * off.T @ off
    inverse = np.linalg.inv(R)
    found = inverse @ jackknife.covariance() @ inverse.T
    np.testing.assert_allclose(found, exact, rtol=1e-8, atol=1e-12 * np.abs(exact).max())


def test_how_long_noise_is_correlated():
    rng = np.random.default_rng(1)
    u = rng.standard_normal(40_000)
    e = u.copy()
    for k in range(1, len(e)):
        e[k] += 0.9 * e[k - 1]
    long, white = (NoiseModel.fit(x, np.arange(len(x))).correlation_time for x in (e, u))
    assert long == pytest.approx(1.81 / 0.19, rel=0.1) and white == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("estimator", [least_squares, weighted_least_squares, huber])
def test_intervals_where_noise_depends_on_the_motion(estimator):
    """Noise that grows with a column: 95 % intervals hold for that column's parameter too."""
    rng, time = np.random.default_rng(2), np.arange(1500)
    column = np.sin(2 * np.pi * time / 100 + np.sin(2 * np.pi * time / 333))
    W = np.column_stack([column**3, np.ones(1500)])
    covered = []
    for _ in range(100):
        y = W @ [2.0, 1.0] + (0.05 + np.abs(column) ** 3) * rng.standard_normal(1500)
        low, high = estimator(W, y, np.zeros(1500, int)).confidence_interval().T
        covered.append((low < [2, 1]) & (high > [2, 1]))
    assert (np.mean(covered, axis=0) > 0.89).all(), np.mean(covered, axis=0)
