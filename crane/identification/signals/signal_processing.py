"""From recorded samples to velocities, accelerations and thinned equations."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError, RecordingError, suggest_names
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_number
from crane.identification.signals.kalman_smoother import kalman_smooth

METHODS = ("kalman", "lowpass")
_MIN_SAMPLES = 50  # samples
_MAX_GAP = 5.0  # steps
_MAX_JITTER = 0.01  # steps
_STEP_TOLERANCE = 1e-3  # steps, by which one may differ from the others
_WINDOW_COEFFICIENTS = np.array(
    [0.35875, 0.48829, 0.14128, 0.01168]
)  # Blackman and Harris, about its middle
_WINDOW_LENGTH = 1.3332  # over 1 / cutoff


@dataclass(frozen=True, eq=False, repr=False)
class Motion(OneLineRepr):
    """What an identification starts from: N samples of n active joints.

    Attributes:
        time: Instants (N,) [s].
        q: Coordinates (N, n) [rad or m].
        v: Velocities (N, n) [rad/s or m/s].
        a: Accelerations (N, n) [rad/s2 or m/s2].
        tau: Generalized forces (N, n) [N m or N].
        passband: Frequency [Hz] above which what the joints did is lost in smoothing, so that v
            and a hold less than half of it; infinite where nothing was smoothed.
    """

    time: Array
    q: Array
    v: Array
    a: Array
    tau: Array
    passband: float = math.inf


@dataclass(frozen=True, eq=False, repr=False)
class Derivatives(OneLineRepr):
    """Smoothed coordinates and their derivatives (N, n).

    Attributes:
        q: Coordinates [rad or m].
        v: Velocities [rad/s or m/s].
        a: Accelerations [rad/s2 or m/s2].
        std_v: Standard deviation of the velocities, None where the method knows none.
        std_a: Standard deviation of the accelerations, likewise.
        noise: Estimated standard deviation (n,) of the measured coordinates, likewise.
        passband: Frequencies (n,) of which half is left [Hz]; infinite of a joint at rest.
    """

    q: Array
    v: Array
    a: Array
    std_v: Array | None = None
    std_a: Array | None = None
    noise: Array | None = None
    passband: Array | None = None


def differentiate(
    time: Array,
    q: Array,
    method: str = "kalman",
    cutoff: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Derivatives:
    """Velocities and accelerations from measured coordinates.

    Args:
        time: Equidistant instants (N,) [s].
        q: Measured coordinates (N, n) [rad or m].
        method: "kalman" smooths each joint, see `smoother.smooth`; "lowpass" takes central
            differences, twice for the acceleration, of what `low_pass` lets through.
        cutoff: [Hz] of "lowpass".
        progress: Takes the finished share of "kalman".

    Raises:
        InputError: An unknown method, or a cutoff too much or too little.
        RecordingError: Samples are not equidistant, or too few.
    """
    step = sampling_step(time)
    if method not in METHODS:
        raise InputError(f"method '{method}' is unknown, {suggest_names(METHODS, method)}")
    if (method == "lowpass") != (cutoff is not None):
        verb = "needs" if cutoff is None else "estimates its own and takes no"
        raise InputError(f"method '{method}' {verb} cutoff, give one to 'lowpass' alone")
    if cutoff is not None:
        filtered = low_pass(time, q, cutoff)
        v = central_differences(time, filtered)
        half = np.full(q.shape[1], float(cutoff))
        return Derivatives(filtered, v, central_differences(time, v), passband=half)
    position, v, a, std_v, std_a = (np.empty(q.shape) for _ in range(5))
    noise, half = np.empty((2, q.shape[1]))
    for i, column in enumerate(q.T):
        states, std, noise[i], half[i] = kalman_smooth(column, step)
        position[:, i], v[:, i], a[:, i] = states.T
        std_v[:, i], std_a[:, i] = std.T[1:]
        if progress is not None:
            progress((i + 1) / q.shape[1])
    return Derivatives(position, v, a, std_v, std_a, noise, half)


def sampling_step(time: Array) -> float:
    """Step [s] of equidistant instants (N,).

    Raises:
        RecordingError: They are not equidistant, or fewer than 50.
    """
    if len(time) < _MIN_SAMPLES:
        raise RecordingError(f"{len(time)} samples are too few, record at least {_MIN_SAMPLES}")
    step = (time[-1] - time[0]) / (len(time) - 1)
    deviation = np.abs(time - (time[0] + step * np.arange(len(time))))
    if not deviation.max() <= _MAX_JITTER * step:
        at = int(deviation.argmax())
        raise RecordingError(
            f"time is {deviation[at]:.3g} s off equidistant samples at {time[at]:g} s, resample "
            f"first"
        )
    return float(step)


def resample(time: Array, columns: Array, step: float) -> tuple[Array, Array]:
    """Instants every `step` [s] and the columns (N, ...) there, by a cubic spline.

    The step should not exceed the recorded one: nothing is filtered out before.

    Raises:
        RecordingError: Between two samples lie more than five times the usual.
    """
    from scipy.interpolate import CubicSpline

    as_number(step, "the step", "s", greater_than=0)
    check_gaps(time)
    count = math.floor((time[-1] - time[0]) / step * (1 + 1e-9)) + 1
    instants = time[0] + step * np.arange(count)
    return instants, CubicSpline(time, columns)(instants)


def resample_evenly(time: Array, columns: Array) -> tuple[Array, Array]:
    """Equidistant instants and the columns (N, ...) there: resampled if they are not already."""
    steps = np.diff(time)
    step = float(np.median(steps))
    if np.abs(steps - step).max() <= _STEP_TOLERANCE * step:
        return time, columns
    return resample(time, columns, step)


def check_gaps(time: Array) -> None:
    """Refuse instants (N,) with a gap of several usual steps.

    Raises:
        RecordingError: There is one; the message says when.
    """
    steps = np.diff(time)
    usual = float(np.median(steps))
    if steps.max() > _MAX_GAP * usual:
        at = int(steps.argmax())
        raise RecordingError(
            f"no sample between {time[at]:g} and {time[at + 1]:g} s where the usual step is "
            f"{usual:g} s, cut the recording there"
        )


def low_pass(time: Array, x: Array, cutoff: float, order: int = 4) -> Array:
    """Zero-phase Butterworth low-pass of x (N, ...), forwards and backwards.

    The amplitude at the frequency f is 1 / (1 + (f/cutoff)^(2 order)), 1/2 at the cutoff [Hz].

    Raises:
        InputError: The cutoff is not below half of the sampling frequency.
    """
    from scipy.signal import butter, sosfiltfilt

    step = sampling_step(time)
    if not 0 < cutoff < 0.5 / step:
        raise InputError(f"cutoff is {cutoff:g} Hz, give one between 0 and {0.5 / step:g} Hz")
    return np.asarray(sosfiltfilt(butter(order, cutoff, output="sos", fs=1 / step), x, axis=0))


def filter_kernel(step: float, cutoff: float) -> Array:
    """Weights (2 n + 1,) of a low-pass that sees nothing beyond n samples, for `filter_rows`.

        w(t) = sum_k c_k cos(2 pi k t / T), |t| < T / 2,   T = 1.3332 / cutoff

    The 4-term window of Blackman and Harris as an impulse response. Its gain is 1/2 at the cutoff
    and below 3e-5 from three times the cutoff on; no weight is negative.

    Source: Harris 1978, On the use of windows for harmonic analysis, Proc. IEEE 66(1).
    """
    length = _WINDOW_LENGTH / (cutoff * step)
    n = math.ceil(0.5 * length) - 1
    phase = 2 * math.pi * np.arange(-n, n + 1.0) / length
    weights = np.cos(np.outer(phase, np.arange(4.0))) @ _WINDOW_COEFFICIENTS
    return np.asarray(weights / weights.sum())


def central_differences(time: Array, x: Array) -> Array:
    """(x_k+1 - x_k-1) / (2 dt) of x (N, ...), at the ends one-sided of second order."""
    return np.gradient(x, sampling_step(time), axis=0, edge_order=2)


def average_periods(time: Array, x: Array, period: float) -> tuple[Array, Array, Array]:
    """Mean over the whole periods of a recording; an incomplete last one is left out.

    Args:
        time: Equidistant instants (N,) [s].
        x: Columns (N, ...).
        period: [s], a multiple of the step.

    Returns:
        Instants (M,) of the first period, mean (M, ...), and its standard error (M, ...), the
        scatter between the K periods over sqrt(K).

    Raises:
        RecordingError: Fewer than two periods, or no multiple of the step.
        InputError: The period is no number above zero.
    """
    step, period = sampling_step(time), as_number(period, "the period", "s", greater_than=0)
    count = round(period / step)
    if count < 1 or abs(count * step - period) > _MAX_JITTER * step:
        raise RecordingError(
            f"the period {period:g} s is no multiple of the step {step:g} s, "
            f"resample with the step {period / max(count, 1):.9g} s"
        )
    periods = len(time) // count
    if periods < 2:
        raise RecordingError(
            f"{len(time) * step:g} s hold fewer than two periods of {period:g} s, record longer"
        )
    stacked = x[: periods * count].reshape(periods, count, *x.shape[1:])
    error = stacked.std(axis=0, ddof=1) / math.sqrt(periods)
    return time[:count], stacked.mean(axis=0), error


def filter_rows(
    regressor: Array, forces: Array, step: float, cutoff: float, decimation: int
) -> tuple[Array, Array]:
    """Both sides of forces = regressor parameters through one filter, then every n-th sample.

    The filter is `filter_kernel`: linear, so the parameters stay what they are, and of finite
    length, so that rows which cannot be explained, as near standstill, spoil those within it and
    no others. A recursive filter's ringing carries the jump of friction at a reversal, which no
    smoothed velocity tells to the millisecond, into every row. At the ends the weights that
    remain are scaled to a sum of one.

    The cutoff may be at most a quarter of the new sampling frequency; what decimation folds to
    below the cutoff then comes from above three times the cutoff.

    Args:
        regressor: (N, n, p).
        forces: (N, n).
        step: [s].
        cutoff: [Hz].
        decimation: One of so many samples is kept, the first of all among them.

    Returns:
        Regressor (M, n, p) and forces (M, n).

    Raises:
        InputError: Something is not finite, or the cutoff too high.
    """
    for name, array in (("regressor", regressor), ("forces", forces)):
        if not np.isfinite(array).all():
            sample = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise InputError(f"{name} is not finite at sample {sample}, cut the recording there")
    highest = 0.25 / (step * decimation)
    if cutoff > highest * (1 + 1e-9):
        raise InputError(
            f"cutoff is {cutoff:g} Hz, give at most {highest:g} Hz for every {decimation}th sample"
        )
    weights = filter_kernel(step, cutoff)
    thinned = np.stack(  # joint by joint, to hold no second whole regressor
        [_weighted_means(regressor[:, i], weights, decimation) for i in range(forces.shape[1])],
        axis=1,
    )
    return thinned, _weighted_means(forces, weights, decimation)


def _weighted_means(x: Array, weights: Array, decimation: int) -> Array:
    """Means of x (N, ...) about every n-th sample, with these weights."""
    from scipy.signal import upfirdn

    reach, count = len(weights) // 2, len(x)
    lead = -reach % decimation  # so that the kept samples of the convolution begin at the first
    kept_samples = slice((reach + lead) // decimation, None)

    def convolved(x: Array) -> Array:
        edges = [(lead, reach), *[(0, 0)] * (x.ndim - 1)]
        whole = upfirdn(weights, np.pad(x, edges), down=decimation, axis=0)
        return np.asarray(whole[kept_samples][: -(-count // decimation)])

    weight_sums = convolved(np.ones(count))
    return convolved(x) / weight_sums.reshape(-1, *[1] * (x.ndim - 1))


def is_moving(v: Array, threshold: ArrayLike) -> np.ndarray:
    """Where |v| (N, n) exceeds the threshold, one for all or (n,): a mask (N, n).

    Near zero velocity friction is none of the functions that are identified.
    """
    return np.abs(v) > np.asarray(threshold)
