"""Delays of measured forces with respect to their motion."""

from dataclasses import dataclass

import numpy as np

from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.common.scratch_arrays import release_pages
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.force_comparison import STANDSTILL_SHARE
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.signals.signal_processing import Motion, low_pass
from crane.identification.signals.signal_quality import shift_remedy, spectral_edge_frequency
from crane.recordings.recording import FORCE_SUFFIX

_CUTOFF_FACTOR = 10.0  # cutoff, times the frequency of the motion
_SAMPLES_PER_PERIOD = 20.0  # samples of the regressor per period of the cutoff
_ROW_STRIDE = 5  # samples per row
_MAX_SAMPLES = 30_000  # samples that are used
_MAX_BLOCKS, _MIN_BLOCKS = 20, 5  # number of blocks for standard errors
_PERIODS_PER_BLOCK = 2.0  # periods of the motion per block
_MAX_ITERATIONS = 10
_TINY = 1e-300
_MAX_SHIFT_STEP = 0.25  # largest shift of an iteration in periods of the cutoff
_SINGULAR_VALUE_TOLERANCE = 1e-9  # singular values, relative, that count as zero
_CONFIDENCE = 0.999  # confidence level of a reported delay
_MIN_EXPLAINED_SHARE = 0.5  # of the squared residuals, that forces ahead of the motion explain
_MAX_SPREAD = 0.1  # of several delays about their mean, below which one is meant


@dataclass(frozen=True, eq=False, repr=False)
class ForceDelays(OneLineRepr):
    """Delays of measured forces with respect to their motion.

    Attributes:
        joints: (n,) names.
        seconds: (n,) delays [s], negative for forces ahead of the motion; nan if undetermined.
        std: (n,) standard deviations [s], nan likewise.
        explained: (n,) share of the squared residuals that the delay explains.
        blocks: Number of blocks that the standard deviations are based on.
    """

    joints: tuple[str, ...]
    seconds: Array
    std: Array
    explained: Array
    blocks: int

    @property
    def is_significant(self) -> np.ndarray:
        """Mask (n,) of delays that are not zero.

        Forces ahead of the motion have to explain at least half of the residuals, too: friction
        that the model lacks looks like a lead that explains less.
        """
        from scipy.stats import t

        if not self.blocks:
            return np.zeros(len(self.joints), dtype=bool)
        limit = float(t.ppf(_CONFIDENCE, self.blocks - 1)) * self.std
        is_early = (self.seconds < -limit) & (self.explained > _MIN_EXPLAINED_SHARE)
        return (self.seconds > limit) | is_early

    @property
    def text(self) -> str:
        """Text about significant delays, "" without any."""
        return ", ".join(
            f"'{self.joints[i]}{FORCE_SUFFIX}' is {1e3 * abs(self.seconds[i]):.3g} ms "
            f"(+- {1e3 * self.std[i]:.1g}) "
            f"{'behind' if self.seconds[i] > 0 else 'ahead of'} its motion"
            for i in np.flatnonzero(self.is_significant)
        )

    @property
    def warning(self) -> str:
        """Warning about significant delays with their remedy, "" without any."""
        found = np.flatnonzero(self.is_significant)
        if not len(found):
            return ""
        return f"{self.text}: record them with one clock, or {self._remedy(found)}"

    def _remedy(self, found: np.ndarray) -> str:
        weights = self.std[found] ** -2
        mean = float(weights @ self.seconds[found] / weights.sum())
        spread = np.abs(self.seconds[found] - mean)
        if len(found) > 1 and spread.max() <= _MAX_SPREAD * abs(mean):
            return shift_remedy({f"*{FORCE_SUFFIX}": mean})
        return shift_remedy({self.joints[i] + FORCE_SUFFIX: self.seconds[i] for i in found})


def force_delays(
    model: IdentificationModel, base: BaseParameters, motion: Motion, min_speed: Array
) -> ForceDelays:
    """Delays of the forces of a motion, late or early.

    A force with the delay d is tau(t) = m(t - d), to first order m - d m'. The column -m' of each
    joint is added to those of the model, so that effects that parameters can explain are not
    attributed to a delay:

        tau = W beta - sum_j d_j m_j' + noise,

    It is solved for beta and d with forces shifted back by d, until d converges. Both sides are
    low-passed at ten times the frequency of the motion; rows near standstill and within the reach
    of the filter are omitted. Standard deviations use blocks of two periods as independent; the
    result is nan for fewer than five blocks or too few rows.

    Args:
        model: The model.
        base: Base parameters of the model.
        motion: Recorded motion.
        min_speed: Standstill velocities (n,), if above a share of the largest velocity.
    """
    from scipy.ndimage import binary_dilation

    n, joints = motion.tau.shape[1], model.machine.active
    nothing = np.full(n, np.nan)
    unknown = ForceDelays(joints, nothing, nothing, nothing, 0)
    step = float(motion.time[1] - motion.time[0])
    frequency = spectral_edge_frequency(motion.q, step)
    cutoff = min(_CUTOFF_FACTOR * frequency, 0.2 / step)
    decimation = max(1, int(1 / (_SAMPLES_PER_PERIOD * cutoff * step)))
    chosen = slice(0, decimation * _MAX_SAMPLES, decimation)
    time = motion.time[chosen]
    filter_reach = int(np.ceil(1 / (cutoff * step * decimation)))
    blocks = min(_MAX_BLOCKS, int(frequency * (time[-1] - time[0]) / _PERIODS_PER_BLOCK))
    if blocks < _MIN_BLOCKS or len(time) < 10 * filter_reach:
        return unknown
    release_pages()
    at = model.samples(motion.q[chosen], motion.v[chosen], motion.a[chosen], step * decimation)
    W = model.regressor(at)[:, :, base.independent]
    for i in range(n):
        W[:, i] = low_pass(time, W[:, i], cutoff)
    known = low_pass(time, model.known_forces(at), cutoff)
    force = low_pass(motion.time, motion.tau, cutoff)[chosen]
    fastest = np.maximum(motion.v.max(axis=0), -motion.v.min(axis=0))
    is_resting = np.abs(motion.v[chosen]) <= np.maximum(min_speed, STANDSTILL_SHARE * fastest)
    is_used = ~binary_dilation(is_resting, np.ones((2 * filter_reach + 1, 1), dtype=bool))
    is_used[:filter_reach] = is_used[-filter_reach:] = False
    is_used[:, ~model.machine.is_driven] = False  # forces of free joints are zero
    rows = np.zeros_like(is_used)
    rows[::_ROW_STRIDE] = is_used[::_ROW_STRIDE]
    if rows.sum() < 4 * (W.shape[2] + n):
        return unknown
    found = _iterate_delays(time, W, known, force, rows, _MAX_SHIFT_STEP / cutoff, blocks)
    return ForceDelays(joints, *found, blocks)


def _iterate_delays(
    time: Array, W: Array, known: Array, force: Array, rows: np.ndarray, stride: float, blocks: int
) -> tuple[Array, Array, Array]:
    """Delays, standard deviations and explained shares (n,) from the rows (N, n).

    The equation of a row is force = W beta + known.
    """
    from scipy.interpolate import CubicSpline

    n = force.shape[1]
    joint, instant = np.nonzero(rows.T)
    count = np.bincount(joint, minlength=n)
    is_identifiable = count > 4 * blocks
    A, shifts = W[instant, joint], np.zeros(n)
    splines = [CubicSpline(time, column) for column in force.T]
    min_noise = _SINGULAR_VALUE_TOLERANCE * force.std(axis=0) + _TINY
    noise = force.std(axis=0) + _TINY
    squares = []  # of the residuals with the delays so far
    for _ in range(_MAX_ITERATIONS):
        shifted = np.stack([f(time + d) for f, d in zip(splines, shifts, strict=True)], axis=1)
        # truncated singular value decomposition with columns of length one
        weighted = A / noise[joint][:, None]
        length = np.linalg.norm(weighted, axis=0)
        length[length == 0] = 1.0
        U, values, V = np.linalg.svd(weighted / length, full_matrices=False)
        is_significant = values > _SINGULAR_VALUE_TOLERANCE * values[0]
        U, values, V = U[:, is_significant], values[is_significant], V[is_significant] / length
        y = (shifted - known)[instant, joint] / noise[joint]
        projected = U.T @ y
        rate = np.gradient(W @ (V.T @ (projected / values)) + known, time, axis=0)
        X = np.zeros((len(y), n))
        X[np.arange(len(y)), joint] = -rate[instant, joint] / noise[joint]
        X = X[:, is_identifiable] - U @ (U.T @ X[:, is_identifiable])
        found = np.linalg.lstsq(X, y - U @ projected, rcond=None)[0]
        without = y - U @ projected
        e = without - X @ found
        squares.append(np.bincount(joint, (without * noise[joint]) ** 2, minlength=n))
        shifts[is_identifiable] += np.clip(found, -stride, stride)
        spread = np.sqrt(np.bincount(joint, e**2, minlength=n) / np.maximum(count, 1))
        noise = np.maximum(noise * spread, min_noise)
    block = instant * blocks // len(time)
    score = np.stack([np.bincount(block, x * e, minlength=blocks) for x in X.T], axis=1)
    inverse = np.linalg.pinv(X.T @ X)
    covariance = inverse @ (score.T @ score) @ inverse * blocks / (blocks - 1)
    std = np.full(n, np.nan)
    std[is_identifiable] = np.sqrt(np.diag(covariance))
    not_converged = is_identifiable.copy()
    not_converged[is_identifiable] = np.abs(found) > std[is_identifiable]
    shifts[~is_identifiable | not_converged] = std[not_converged] = np.nan
    return shifts, std, 1.0 - squares[-1] / np.maximum(squares[0], _TINY)
