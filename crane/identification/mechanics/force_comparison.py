"""Comparison of measured and modelled forces: errors, delays, checks of recordings."""

import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.errors import CraneWarning
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.smoothed_motion import (
    delay_message,
    reject_unless_trusted,
    signal_delay,
)
from crane.identification.signals.signal_processing import (
    Motion,
    low_pass,
    sampling_step,
)
from crane.identification.signals.signal_quality import spectral_edge_frequency
from crane.recordings.recording import Recording

_CUTOFF_FACTOR = 10.0  # cutoff, times the frequency of the motion
_SAMPLES_PER_PERIOD = 20.0  # samples of the regressor per period of the cutoff
_ROW_STRIDE = 5  # samples per row
_MAX_SAMPLES = 30_000  # samples that are used
_STANDSTILL_SHARE = 0.05  # of a joint's largest velocity, below which rows are omitted
_MAX_BLOCKS, _MIN_BLOCKS = 20, 5  # number of blocks for standard errors
_PERIODS_PER_BLOCK = 2.0  # periods of the motion per block
_MAX_ITERATIONS = 10
_TINY = 1e-300
_MAX_SHIFT_STEP = 0.25  # largest shift of an iteration in periods of the cutoff
_SINGULAR_VALUE_TOLERANCE = 1e-9  # singular values, relative, that count as zero
_MAX_FORCE_FACTOR = 30.0  # largest ratio of a force to that of the model
_MIN_CORRELATION = 0.9  # least correlation for a significant factor
_BLOCK_COUNT = 10  # of time, for the standard error of that factor
_VALIDATION_FACTOR = 4.0  # times the error on training data, above which a warning is given
_NEGLIGIBLE_ERROR = 1e-6  # negligible error relative to the forces
_MAX_SHARED_SHARE = 0.2  # of the samples of a recording that another one may contain
_COMPARED_SAMPLES = 2000  # compared samples
_DELAY_CONFIDENCE = 0.999  # confidence level of a reported delay


def force_delays(
    model: IdentificationModel, base: BaseParameters, motion: Motion, min_speed: Array
) -> tuple[Array, Array, int]:
    """Delays of the forces (n,) [s], their standard errors (n,), and the number of blocks.

    A force with the delay d is tau(t) = m(t - d), to first order m - d m'. The column -m' of each
    joint is added to those of the model, so that effects that parameters can explain are not
    attributed to a delay:

        tau = W beta - sum_j d_j m_j' + noise,

    It is solved for beta and d with forces shifted back by d, until d converges. Both sides are
    low-passed at ten times the frequency of the motion; rows near standstill and within the reach
    of the filter are omitted. Standard errors use blocks of two periods as independent; the result
    is nan for fewer than five blocks or too few rows.

    Presliding friction makes forces lead by some milliseconds; late forces are caused by clocks,
    filters or sensors only.

    Args:
        model: The model.
        base: Base parameters of the model.
        motion: Recorded motion.
        min_speed: Standstill velocities (n,), if above a share of the largest velocity.
    """
    from scipy.ndimage import binary_dilation

    n = motion.tau.shape[1]
    unknown = np.full(n, np.nan), np.full(n, np.nan), 0
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
    at = model.samples(motion.q[chosen], motion.v[chosen], motion.a[chosen], step * decimation)
    W = model.regressor(at)[:, :, base.independent]
    for i in range(n):
        W[:, i] = low_pass(time, W[:, i], cutoff)
    known = low_pass(time, model.known_forces(at), cutoff)
    force = low_pass(motion.time, motion.tau, cutoff)[chosen]
    speed = np.abs(motion.v)
    is_resting = (speed <= np.maximum(min_speed, _STANDSTILL_SHARE * speed.max(axis=0)))[chosen]
    is_used = ~binary_dilation(is_resting, np.ones((2 * filter_reach + 1, 1), dtype=bool))
    is_used[:filter_reach] = is_used[-filter_reach:] = False
    is_used[:, ~model.machine.is_driven] = False  # forces of free joints are zero
    rows = np.zeros_like(is_used)
    rows[::_ROW_STRIDE] = is_used[::_ROW_STRIDE]
    if rows.sum() < 4 * (W.shape[2] + n):
        return unknown
    shifts, std = _iterate_delays(time, W, known, force, rows, _MAX_SHIFT_STEP / cutoff, blocks)
    return shifts, std, blocks


def _iterate_delays(
    time: Array, W: Array, known: Array, force: Array, rows: np.ndarray, stride: float, blocks: int
) -> tuple[Array, Array]:
    """Delays and standard errors (n,) from the rows (N, n) of force = W beta + known."""
    from scipy.interpolate import CubicSpline

    n = force.shape[1]
    joint, instant = np.nonzero(rows.T)
    count = np.bincount(joint, minlength=n)
    is_identifiable = count > 4 * blocks
    A, shifts = W[instant, joint], np.zeros(n)
    splines = [CubicSpline(time, column) for column in force.T]
    min_noise = _SINGULAR_VALUE_TOLERANCE * force.std(axis=0) + _TINY
    noise = force.std(axis=0) + _TINY
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
        e = y - U @ projected - X @ found
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
    return shifts, std


@dataclass(frozen=True, eq=False, repr=False)
class ForceComparison(OneLineRepr):
    """Measured and modelled forces of one recording after the same filter.

    Attributes:
        time: (M,) [s].
        measured: (M, n) measured forces [N], [N m].
        modelled: (M, n) modelled forces.
        is_moving: (M, n) mask of the rows away from standstill.
        joints: (n,) names.
    """

    time: Array
    measured: Array
    modelled: Array
    is_moving: np.ndarray
    joints: tuple[str, ...]

    @property
    def residuals(self) -> Array:
        """Residuals (M, n): measured minus modelled forces."""
        return self.measured - self.modelled

    def _rms(self, values: Array) -> Array:
        squares = (np.where(self.is_moving, values, 0.0) ** 2).sum(axis=0)
        count = self.is_moving.sum(axis=0)
        return np.sqrt(
            np.divide(squares, count, out=np.full_like(squares, np.nan), where=count > 0)
        )

    @property
    def rmse(self) -> Array:
        """Root mean square (n,) of the residuals [N], [N m], nan for joints without motion."""
        return self._rms(self.residuals)

    @property
    def relative_error(self) -> Array:
        """RMS of the residuals over that of the measured force (n,), nan of a free joint."""
        size = self._rms(self.measured)
        return np.divide(self.rmse, size, out=np.full_like(size, np.nan), where=size > 0)

    @property
    def percentage_error(self) -> Array:
        """Error (n,) of equation (9) of the reduced-scale forwarder paper [%]: 100 relative^2."""
        return 100 * self.relative_error**2

    @property
    def overall_relative_error(self) -> float:
        """Norm of all residuals over that of all measured forces, nan if these are zero."""
        residual_norm, force_norm = (
            np.linalg.norm(x[self.is_moving]) for x in (self.residuals, self.measured)
        )
        return float(residual_norm / force_norm) if force_norm else math.nan


def check_forces(
    motion: Motion,
    modelled: Array,
    joints: Sequence[str],
    longest_delay: float = 0.05,
    trust: bool = False,
) -> None:
    """Check recorded forces against those (N, n) of a model with rough parameters.

    Effects of friction and rotors are excluded: the scale c of a joint is that of the regression
    tau = c modelled + c0 + c1 sign(v) + c2 v + c3 |v| + c4 a, with the standard error by ten
    blocks of time. If the model explains little of the remaining force, c is not significant, and
    a force of many times the model's causes a warning only.

    Raises:
        RecordingError: The forces differ significantly by more than a factor of thirty, in sign,
            or by a delay.
    """
    messages = []
    for i, joint in enumerate(joints):
        measured, expected = motion.tau[:, i], modelled[:, i]
        if np.ptp(expected) == 0 or np.ptp(measured) == 0:
            continue
        scale, error, correlation = _force_scale(
            measured, expected, motion.v[:, i], motion.a[:, i]
        )
        size = abs(scale)
        if (
            correlation > _MIN_CORRELATION
            and not 1 / _MAX_FORCE_FACTOR < size < _MAX_FORCE_FACTOR
            and error < size / 4
        ):
            power = math.log10(max(size, 1e-300))
            looks = "look at its unit and its gear ratio"
            if 2.3 < abs(power) < 3.7:
                looks = f"it looks {'1000-fold' if power > 0 else 'like kN'}, give SI units"
            reject_unless_trusted(
                f"'{joint}_force' is {scale:.3g} times the model's, {looks}", trust
            )
            continue
        if correlation > _MIN_CORRELATION and scale < -4 * error and size > 1 / _MAX_FORCE_FACTOR:
            text = f"'{joint}_force' is {scale:.2g} times the model's, turn its sign"
            reject_unless_trusted(text, trust)
            continue
        ratio = math.sqrt(np.mean(measured**2) / np.mean(expected**2))
        is_known = 1 / _MAX_FORCE_FACTOR < size < _MAX_FORCE_FACTOR and error < size / 2
        if not is_known and not 1 / _MAX_FORCE_FACTOR < ratio < _MAX_FORCE_FACTOR:
            messages.append(f"'{joint}_force' is {ratio:.3g} times the model's")
        lag = signal_delay(motion.time, expected, measured)
        # a rough model gives a delay only if the shift explains nearly everything: friction looks
        # like inertia a quarter of a period later
        if not 0.5 < ratio < 2.0:
            continue
        shifted_correlation = _shifted_correlation(
            expected, measured, round(lag / sampling_step(motion.time))
        )
        if abs(lag) > longest_delay and shifted_correlation > max(
            0.9, _shifted_correlation(expected, measured, 0) + 0.05
        ):
            reject_unless_trusted(delay_message(f"{joint}_force", lag, "its model"), trust)
    if messages:
        text = (
            f"{', '.join(messages)}: friction and rotors may outweigh the bodies there, or the "
            "unit is wrong, this recording cannot say"
        )
        warnings.warn(text, CraneWarning, stacklevel=3)


def warn_delays(
    joints: Sequence[str], delays: Array, std: Array, blocks: int, longest_delay: float = 0.05
) -> None:
    """Warn of delays (n,) [s] of forces, see `force_delays`.

    Early forces are reported only above `longest_delay`, as friction causes small leads.
    """
    from scipy.stats import t

    if not blocks:
        return
    limit, messages = float(t.ppf(_DELAY_CONFIDENCE, blocks - 1)), []
    for joint, seconds, error in zip(joints, delays, std, strict=True):
        if seconds > limit * error or seconds < -max(longest_delay, limit * error):
            side = "behind" if seconds > 0 else "ahead of"
            messages.append(
                f"'{joint}_force' is {1e3 * abs(seconds):.0f} ms (+- {1e3 * error:.1g}) {side} its"
                " motion"
            )
    if messages:
        warnings.warn(
            f"{', '.join(messages)}: record them with one clock, or shift them",
            CraneWarning,
            stacklevel=3,
        )


def warn_validation(training: ForceComparison, validation: ForceComparison) -> None:
    """Warn if errors on held-out data are far above those on training data."""
    messages = []
    pairs = zip(
        training.joints,
        training.relative_error,
        validation.relative_error,
        training.rmse,
        validation.rmse,
        strict=True,
    )
    for joint, training_error, validation_error, rmse, validation_rmse in pairs:
        if (
            validation_error > max(_VALIDATION_FACTOR * training_error, _NEGLIGIBLE_ERROR)
            and validation_rmse > _VALIDATION_FACTOR * rmse
        ):
            messages.append(
                f"'{joint}' {validation_error / training_error:.3g} times "
                f"({100 * validation_error:.3g} %)"
            )
    if messages:
        text = (
            "errors on the validation are far above those on the training: "
            f"{', '.join(messages)}: the recordings do not belong together, or the training data "
            "determine too little"
        )
        warnings.warn(text, CraneWarning, stacklevel=3)


def check_shared_samples(
    recordings: Sequence[Recording | Motion],
    validation: Sequence[Recording | Motion],
    trust: bool = False,
) -> None:
    """Reject repeated training data, and warn of held-out data that are training data.

    Raises:
        RecordingError: Two of the recordings share instants and forces.
    """
    for (i, one), (j, other) in itertools.combinations(enumerate(recordings, start=1), 2):
        if (share := _shared_share(one, other)) > _MAX_SHARED_SHARE:
            reject_unless_trusted(
                f"{share:.0%} of recording {j}'s samples are in recording {i} as well: used "
                "twice they make intervals too narrow, give each once",
                trust,
            )
    share = max(
        (_shared_share(*pair) for pair in itertools.product(recordings, validation)), default=0
    )
    if share > _MAX_SHARED_SHARE:
        text = (
            f"{share:.0%} of the held-out samples are training data: their errors do not apply to "
            "other motions, give other data"
        )
        warnings.warn(text, CraneWarning, stacklevel=3)


def _shared_share(one: Recording | Motion, other: Recording | Motion) -> float:
    """Share of the other's samples that one contains at the same time with the same forces.

    Only samples with changing forces are used, as simulations from rest begin alike.
    """
    some = slice(None, None, max(1, len(other.time) // _COMPARED_SAMPLES))
    time, tau = other.time[some], other.tau[some]
    if one.tau.shape[1] != tau.shape[1]:
        return 0.0
    at = np.minimum(np.searchsorted(one.time, time), len(one.time) - 1)
    same = (one.time[at] == time) & (one.tau[at] == tau).all(axis=1)
    changing = (tau[1:] != tau[:-1]).any(axis=1)
    return float(np.mean(same[1:][changing])) if changing.any() else 0.0


def _force_scale(y: Array, x: Array, v: Array, a: Array) -> tuple[float, float, float]:
    """Scale of y against x beside friction and rotors, its standard error, and correlation."""
    others = np.column_stack([np.ones_like(v), np.sign(v), v, np.abs(v), a])
    size = np.linalg.norm(others, axis=0)
    U, values, _ = np.linalg.svd(others / np.where(size > 0, size, 1.0), full_matrices=False)
    U = U[:, values > 1e-9 * values[0]]
    residuals, energy = [], []
    for column in (y, x):
        rest = column - U @ (U.T @ column)
        residuals.append(rest)
        energy.append(float(rest @ rest))
        if energy[-1] < 1e-18 * float(column @ column):  # explained by friction alone
            return 0.0, math.inf, 0.0
    scale = float(residuals[0] @ residuals[1]) / energy[1]
    products = residuals[1] * (residuals[0] - scale * residuals[1])
    parts = np.array([part.sum() for part in np.array_split(products, _BLOCK_COUNT)])
    error = math.sqrt(float(parts @ parts) * _BLOCK_COUNT / (_BLOCK_COUNT - 1)) / energy[1]
    return scale, error, abs(scale) * math.sqrt(energy[1] / energy[0])


def _shifted_correlation(one: Array, other: Array, shift: int) -> float:
    """Correlation of one signal with another one shifted by a number of samples."""
    count = len(one) - abs(shift)
    offsets = max(shift, 0), max(-shift, 0)
    return float(np.corrcoef(one[offsets[1] :][:count], other[offsets[0] :][:count])[0, 1])
