"""Estimators: closed forms, robustness, coverage of their intervals, and the jackknife."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfiltfilt
from scipy.stats import f, t

from crane.common.errors import InputError
from crane.identification.calibration.levenberg_marquardt import LevenbergMarquardt
from crane.identification.calibration.unknowns import Unknown
from crane.identification.estimation.estimators import (
    huber,
    instrumental_variables,
    least_squares,
    weighted_least_squares,
)
from crane.identification.estimation.noise_model import Jackknife, NoiseModel
from crane.identification.mechanics.identifiability import essential_parameters
from crane.identification.mechanics.identify_payload import _widen_covariance


def white(count=800, size=4, seed=0, noise=0.5):
    rng = np.random.default_rng(seed)
    W = rng.standard_normal((count, size)) * np.geomspace(1, 100, size)
    return W, W @ np.arange(1.0, size + 1) + noise * rng.standard_normal(count)


def test_ordinary_least_squares_of_white_noise():
    W, y = white()
    found = least_squares(W, y)
    exact, squares = np.linalg.lstsq(W, y)[:2]
    np.testing.assert_allclose(found.values, exact, rtol=1e-12)
    np.testing.assert_allclose(found.residuals, y - W @ exact, atol=1e-11)
    np.testing.assert_allclose(found.noise**2, squares / 796, rtol=1e-9)
    np.testing.assert_allclose(found.condition, np.linalg.cond(W), rtol=1e-9)
    assert found.scaled_condition < 1.3
    textbook = np.sqrt(squares / 796 * np.diag(np.linalg.inv(W.T @ W)))
    np.testing.assert_allclose(found.std, textbook, rtol=0.15)
    half = np.diff(found.confidence_interval(0.9))[:, 0] / 2
    np.testing.assert_allclose(half, t.ppf(0.95, found.degrees_of_freedom) * found.std)


def test_without_noise_every_estimator_is_exact():
    W, y = white(noise=0.0)
    groups = np.arange(800) % 2
    for found in (
        least_squares(W, y),
        weighted_least_squares(W, y, groups),
        huber(W, y, groups),
        instrumental_variables(W, y, W, groups),
    ):
        np.testing.assert_allclose(found.values, [1, 2, 3, 4], rtol=1e-11)


def test_weighting_finds_the_noise_of_each_joint():
    rng = np.random.default_rng(1)
    W, y = white(4000, noise=0.0)
    groups = np.arange(4000) % 2
    sigma = np.array([0.1, 3.0])
    found = weighted_least_squares(
        W, y + sigma[groups] * rng.standard_normal(4000), groups, np.arange(4000) // 2
    )
    np.testing.assert_allclose(found.noise, sigma, rtol=0.06)
    exact = np.sqrt(np.diag(np.linalg.inv((W.T / sigma[groups] ** 2) @ W)))
    np.testing.assert_allclose(found.std, exact, rtol=0.1)


def test_huber_resists_outliers():
    rng = np.random.default_rng(2)
    W, y = white(2000)
    y[rng.choice(2000, 100, replace=False)] += 500
    found, plain = huber(W, y), least_squares(W, y)
    assert (np.abs(found.values - [1, 2, 3, 4]) < 4 * found.std).all()
    assert (found.std < 0.1 * plain.std).all()


@pytest.mark.parametrize(
    "estimator", [least_squares, weighted_least_squares, huber, instrumental_variables]
)
def test_prior(estimator):
    """Known noise: the posterior of normal distributions. A column of zeros keeps its prior."""
    W, y = white(3000)
    W[:, 2] = 0
    y = y - white(3000)[0][:, 2] * 3
    mean, std = np.array([1.01, 0, 7, 0]), np.array([0.01, np.inf, 0.2, np.inf])
    kind = {"groups": np.zeros(3000, int), "prior": (mean, std)}
    found = (
        estimator(W, y, W, **kind)
        if estimator is instrumental_variables
        else estimator(W, y, **kind)
    )
    assert found.values[2] == pytest.approx(7)
    assert found.std[2] == pytest.approx(0.2)
    information = W.T @ W / found.noise**2 + np.diag(1 / std**2)
    exact = np.linalg.solve(information, W.T @ y / found.noise**2 + np.nan_to_num(mean / std**2))
    # Huber's clips the noise and weighs its rows less, together by a few percent.
    close = 0.1 if estimator is huber else 2e-3
    np.testing.assert_allclose(found.values[0], exact[0], rtol=close)
    information = W.T @ W / 0.5**2 + np.diag(1 / std**2)
    np.testing.assert_allclose(found.std[0], np.linalg.inv(information)[0, 0] ** 0.5, rtol=0.1)


def test_instruments_remove_the_bias_of_a_noisy_regressor():
    rng = np.random.default_rng(3)
    Z, y = white(20_000, 3, noise=0.1)
    W = Z + 0.5 * Z.std(axis=0) * rng.standard_normal(Z.shape)
    plain, found = least_squares(W, y), instrumental_variables(W, y, Z)
    assert (plain.values < 0.85 * np.array([1, 2, 3])).any()
    assert (np.abs(found.values - [1, 2, 3]) < 4 * found.std).all()


def draw(kind, strength, rng, count, joints):
    """Noise of joints that are correlated with each other at 0.5."""
    mixed = np.linalg.cholesky(0.5 * np.eye(joints) + 0.5)
    u = rng.standard_normal((count + 600, joints)) @ mixed.T * np.geomspace(1, 3, joints)
    if kind == "ar":
        return lfilter([1], [1, -strength], u, axis=0)[600:]
    return sosfiltfilt(butter(4, strength, output="sos"), u, axis=0)[300:-300]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("estimator", "kind", "strength", "gaps", "count"),
    [
        (weighted_least_squares, "ar", 0.95, True, 1000),
        (huber, "ar", 0.9, False, 1000),
        (weighted_least_squares, "low", 0.3, True, 1000),
        *(pytest.param(*x, marks=pytest.mark.long) for x in (
            (weighted_least_squares, "ar", -0.5, False, 1000),
            (weighted_least_squares, "ar", 0.0, True, 1000),
            (weighted_least_squares, "ar", 0.9, False, 1000),
            (weighted_least_squares, "ar", 0.95, False, 1000),
            (weighted_least_squares, "low", 0.1, True, 2500),
        )),
    ],
)  # fmt: skip
def test_intervals_cover_the_truth(estimator, kind, strength, gaps, count):
    """100 runs of two joints with slow, sharp and constant columns: 95 % within 90 to 99 %."""
    rng, size, joints = np.random.default_rng(4), 6, 2
    time, truth, covered = 0.01 * np.arange(count), np.arange(1.0, 7.0), []
    samples, groups = np.indices((count, joints))
    for _ in range(100):
        rate, phase = rng.uniform(0.1, 1, (joints, size)), rng.uniform(0, 7, (joints, size))
        W = np.sin(2 * np.pi * rate * time[:, None, None] + phase)
        W[..., 0] = np.sign(W[..., 0])
        W[..., 1] = 1 + 0.1 * W[..., 1]
        y = W @ truth + draw(kind, strength, rng, count, joints)
        kept = np.abs(W[..., 2]) > 0.1 * gaps
        low, high = (
            estimator(W[kept], y[kept], groups[kept], samples[kept]).confidence_interval().T
        )
        covered.append((low < truth) & (truth < high))
    assert 0.90 <= np.mean(covered) <= 0.99


def test_essential_parameters():
    W, _ = white(500, 6, seed=6)
    rng = np.random.default_rng(6)
    y = W @ [2.0, 0, 3, 0, 0, 4] + 0.5 * rng.standard_normal(500)
    found = least_squares(W, y)
    assert essential_parameters(found, 0.01).tolist() == [0, 2, 5]
    # The same F as from the sums of squares, where the covariance is the textbook one.
    dropped = [1, 3, 4]
    rest = np.linalg.lstsq(W[:, [0, 2, 5]], y)[1][0]
    full = found.residuals @ found.residuals
    C = full / 494 * np.linalg.inv(W.T @ W)[np.ix_(dropped, dropped)]
    theta = found.values[dropped]
    F = theta @ np.linalg.solve(C, theta) / 3
    assert pytest.approx((rest - full) / 3 / (full / 494)) == F
    assert f.ppf(0.99, 3, 494) > F


def test_errors():
    W, y = white(50)
    with pytest.raises(InputError, match=r"4 columns of the regressor depend on each other"):
        least_squares(W[:, [0, 1, 1, 2]], y)
    with pytest.raises(InputError, match="4 rows for 4 parameters are too few, record longer"):
        least_squares(W[:4], y[:4])
    with pytest.raises(InputError, match=r"y has the shape \(49,\), give \(50,\)"):
        least_squares(W, y[:49])
    with pytest.raises(InputError, match="samples of group 0 do not increase, sort its rows"):
        least_squares(W, y, samples=np.zeros(50))
    with pytest.raises(InputError, match="the prior has the deviation 0, give one above 0"):
        least_squares(W, y, prior=(np.zeros(4), np.zeros(4)))
    y[7] = np.nan
    with pytest.raises(InputError, match="forces not finite in row 7, leave such rows out"):
        least_squares(W, y)


# --- jackknife ----------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("decay", "count", "expected"),
    [
        (0.9, 1000, 4 * 0.02 * (1 - 0.9**29) / 0.1),  # correlations down to 0.9^28 = 0.052
        (0.0, 1000, (9.99 + 19.98) / 40),
        (0.99, 1000, (9.99 + 19.98) / 8),
    ],
)
def test_blocks_of_a_calibration_last_four_correlation_times(decay, count, expected):
    """Residuals decay^k, whose autocorrelation is decay^k; at least 8 blocks, at most 40."""
    residuals, cases = [], []
    for step, its_decay in ((0.01, 0.0), (0.02, decay)):
        time = step * np.arange(count)
        inputs = SimpleNamespace(time=time)
        mask = np.full(count, True)
        cases.append(SimpleNamespace(inputs=inputs, train_mask=mask, sensors=("x", "p")))
        columns = [np.zeros(count), its_decay ** np.arange(count)]
        residuals.append(np.column_stack(columns).ravel())
    fit = SimpleNamespace(training_cases=cases, residual=np.concatenate(residuals))
    assert LevenbergMarquardt._block_duration(fit) == pytest.approx(expected, rel=0.02)


def test_unknowns_without_bounds_keep_to_a_thousand_of_their_scales(mini):
    """A parameter that has no effect yet, where the crane never lifts, is not lost."""
    unknowns = [
        Unknown("positive", 2.0, 0.002, np.inf, 2.0), Unknown("bounded", 1.0, -np.inf, 5e3, 0.5)
    ]  # fmt: skip
    problem = SimpleNamespace(unknowns=unknowns, unknown_count=2, cases=[], machine=mini)
    search = LevenbergMarquardt(problem, print, None)
    assert search.low.tolist() == [-0.999, -1e3] and search.high.tolist() == [1e3, 9998.0]


class FlatSearch(LevenbergMarquardt):
    """A search of the cost (exp(-2 z) + 100) / 2, by steps of about 1."""

    def __init__(self):
        self.low, self.high, self.prior = np.array([-99.0]), np.array([99.0]), np.zeros(1)
        self.states, self.training_cases, self._progress = [], [], lambda share: None
        self.log = SimpleNamespace(begin=lambda: None, add=self.states.append, iterations=0)

    def linearize(self, z):
        self.jacobian, self.residual = np.array([[-np.exp(-z[0])], [0.0]]), [np.exp(-z[0]), 10.0]

    def cost(self, z):
        return 0.5 * float(np.exp(-2.0 * z[0])) + 50.0


@pytest.mark.parametrize("highest_cost, iterations", [(40.0, 1), (45.0, 2), (49.9, 3), (51.0, 9)])
def test_a_search_that_cannot_come_low_enough_is_given_up(highest_cost, iterations):
    """Twice the last reduction in each of nine iterations: to 42.3, 49.1, 49.9, ..."""
    search = FlatSearch()
    last = search.minimize(np.zeros(1), 1e-15, 1e-9, 9, highest_cost=highest_cost)
    assert last.iteration == len(search.states) == iterations
    assert last.has_ended == (iterations < 9) and search.states[-1] is last
    assert last.z[0] == pytest.approx(iterations, rel=1e-6)


@pytest.mark.parametrize("inflation", [0.5, 1.5, 4.0])
def test_payloads_are_as_uncertain_as_their_segments_differ(inflation):
    """A mean of ten segments, whose jackknife gives sum (m_i - m)^2 / (K (K - 1))."""
    means = np.random.default_rng(3).normal(size=10)
    variance = np.square(means - means.mean()).sum() / 90
    segments = np.array([[[1.0, m], [0.0, 0.0]] for m in means])
    equations = SimpleNamespace(segment_factors=lambda count: segments[:count])
    estimate = SimpleNamespace(
        noise=np.ones(10), covariance=np.array([[variance / inflation]]), degrees_of_freedom=77.0
    )
    covariance, freedom = _widen_covariance(equations, np.eye(1), estimate, np.eye(1))
    assert covariance[0, 0] == pytest.approx(variance / min(inflation, 1.0), rel=1e-12)
    assert freedom.tolist() == [9.0 if inflation > 1 else 77.0]


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
