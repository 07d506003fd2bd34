"""Derivatives, filters, resampling and decimation of recorded signals."""

import math
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError, RecordingError, check_name
from crane.common.one_line_repr import OneLineRepr
from crane.common.progress import Progress, ignore_progress
from crane.common.samples import Array, as_number
from crane.common.scratch_arrays import (
    BLOCK_SIZE,
    MIN_FILE_ELEMENTS,
    compute_in_blocks,
    empty_array,
    release_pages,
)
from crane.identification.signals.kalman_smoother import kalman_smooth

METHODS = ("kalman", "lowpass")
_MIN_SAMPLES = 50  # samples
_MAX_GAP = 5.0  # steps
_MAX_JITTER = 0.01  # steps
_STEP_TOLERANCE = 1e-3  # steps, by which one may differ from the others
# Blackman and Harris, about its middle
_WINDOW_COEFFICIENTS = np.array([0.35875, 0.48829, 0.14128, 0.01168])
_WINDOW_LENGTH = 1.3332  # over 1 / cutoff
_FILTER_MEMORY = 16.0  # over 1 / cutoff, after which the low-pass has forgotten 1 - 1e-16


@dataclass(frozen=True, eq=False, repr=False)
class Motion(OneLineRepr):
    """Motion and forces of n active joints at N samples.

    Attributes:
        time: Instants (N,) [s].
        q: Coordinates (N, n) [rad or m].
        v: Velocities (N, n) [rad/s or m/s].
        a: Accelerations (N, n) [rad/s2 or m/s2].
        tau: Generalized forces (N, n) [N m or N].
        passband: Frequency [Hz] at which smoothing passes half of the motion; infinite without
            smoothing.
    """

    time: Array
    q: Array
    v: Array
    a: Array
    tau: Array
    passband: float = math.inf

    def __getitem__(self, part: slice) -> "Motion":
        """The motion at some of its samples."""
        q, v, a, tau = (x[part] for x in (self.q, self.v, self.a, self.tau))
        return Motion(self.time[part], q, v, a, tau, self.passband)


@dataclass(frozen=True, eq=False, repr=False)
class Derivatives(OneLineRepr):
    """Smoothed coordinates and their derivatives (N, n).

    Attributes:
        q: Coordinates [rad or m].
        v: Velocities [rad/s or m/s].
        a: Accelerations [rad/s2 or m/s2].
        std_v: Standard deviations of the velocities, None if the method gives none.
        std_a: Standard deviations of the accelerations, None likewise.
        noise: Estimated standard deviations (n,) of the measured coordinates, None likewise.
        passband: Frequencies (n,) at which half passes [Hz]; infinite for a joint at rest.
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
    progress: Progress = ignore_progress,
) -> Derivatives:
    """Velocities and accelerations from measured coordinates.

    Args:
        time: Equidistant instants (N,) [s].
        q: Measured coordinates (N, n) [rad or m].
        method: "kalman" smooths each joint, see `kalman_smooth`; "lowpass" takes central
            differences, twice for the acceleration, of coordinates filtered by `low_pass`.
        cutoff: [Hz] of "lowpass".
        progress: Called with the finished share of "kalman".

    Raises:
        InputError: The method is unknown, or the cutoff is missing or superfluous.
        RecordingError: Samples are not equidistant, or too few.
    """
    step = sampling_step(time)
    check_name(method, METHODS, f"method '{method}' is unknown")
    if (method == "lowpass") != (cutoff is not None):
        verb = "needs" if cutoff is None else "estimates its own and takes no"
        raise InputError(f"method '{method}' {verb} cutoff, give one to 'lowpass' alone")
    if cutoff is not None:
        filtered = low_pass(time, q, cutoff)
        v = np.gradient(filtered, step, axis=0, edge_order=2)
        a = np.gradient(v, step, axis=0, edge_order=2)
        return Derivatives(filtered, v, a, passband=np.full(q.shape[1], float(cutoff)))
    position, v, a, std_v, std_a = (empty_array(*q.shape) for _ in range(5))
    noise, half = np.empty((2, q.shape[1]))
    for i, column in enumerate(q.T):
        states, std, noise[i], half[i] = kalman_smooth(column, step)
        position[:, i], v[:, i], a[:, i] = states.T
        std_v[:, i], std_a[:, i] = std.T[1:]
        del states, std
        release_pages()
        progress((i + 1) / q.shape[1])
    return Derivatives(position, v, a, std_v, std_a, noise, half)


def sampling_step(time: Array) -> float:
    """Step [s] of equidistant instants (N,).

    Raises:
        RecordingError: The instants are not equidistant, or fewer than 50.
    """
    if len(time) < _MIN_SAMPLES:
        raise RecordingError(f"{len(time)} samples are too few, record at least {_MIN_SAMPLES}")
    step = (time[-1] - time[0]) / (len(time) - 1)
    deviation = np.linspace(time[0], time[-1], len(time))
    np.abs(np.subtract(deviation, time, out=deviation), out=deviation)
    if not deviation.max() <= _MAX_JITTER * step:
        at = int(deviation.argmax())
        raise RecordingError(
            f"time is {deviation[at]:.3g} s off equidistant samples at {time[at]:g} s, resample "
            f"first"
        )
    return float(step)


def resample(time: Array, columns: Array, step: float) -> tuple[Array, Array]:
    """Resample columns (N, ...) at instants every `step` [s] by a cubic spline.

    The step should not exceed the recorded one, as there is no anti-aliasing filter.

    Raises:
        RecordingError: There is a gap of more than five median steps.
    """
    from scipy.interpolate import CubicSpline

    as_number(step, "the step", "s", greater_than=0)
    check_gaps(time)
    instants = time[0] + step * np.arange(math.floor((time[-1] - time[0]) / step * (1 + 1e-9)) + 1)
    return instants, CubicSpline(time, columns)(instants)


def resample_evenly(time: Array, columns: Array) -> tuple[Array, Array]:
    """Resample columns (N, ...) at equidistant instants, if they are not equidistant already."""
    steps = np.diff(time)
    step = float(np.median(steps))
    if np.abs(steps - step).max() <= _STEP_TOLERANCE * step:
        return time, columns
    return resample(time, columns, step)


def check_gaps(time: Array) -> None:
    """Reject instants (N,) with a gap of several median steps.

    Raises:
        RecordingError: There is a gap; the message gives its time.
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

    The amplitude at the frequency f is 1 / (1 + (f/cutoff)^(2 order)), 1/2 at the cutoff [Hz]. A
    long series is filtered in blocks that overlap by the memory of the filter.

    Raises:
        InputError: The cutoff is not below half of the sampling frequency.
    """
    from scipy.signal import butter, sosfiltfilt

    step = sampling_step(time)
    if not 0 < cutoff < 0.5 / step:
        raise InputError(f"cutoff is {cutoff:g} Hz, give one between 0 and {0.5 / step:g} Hz")
    sections = butter(order, cutoff, output="sos", fs=1 / step)
    reach = math.ceil(_FILTER_MEMORY / (cutoff * step))
    if np.size(x) < MIN_FILE_ELEMENTS or x.ndim > 2 or reach > BLOCK_SIZE:
        return np.asarray(sosfiltfilt(sections, x, axis=0))
    return compute_in_blocks(
        lambda part: sosfiltfilt(
            sections, x[max(0, part.start - reach) : part.stop + reach], axis=0
        )[min(part.start, reach) :][: part.stop - part.start].reshape(-1, x[0].size),
        len(x),
    ).reshape(x.shape, order="F")


def filter_kernel(step: float, cutoff: float) -> Array:
    """Weights (2 n + 1,) of the finite low-pass of `filter_rows`.

        w(t) = sum_k c_k cos(2 pi k t / T), |t| < T / 2,   T = 1.3332 / cutoff

    The impulse response is the 4-term window of Blackman and Harris. Its gain is 1/2 at the cutoff
    and below 3e-5 above three times the cutoff; no weight is negative.

    Source: Harris 1978, On the use of windows for harmonic analysis, Proc. IEEE 66(1).
    """
    length = _WINDOW_LENGTH / (cutoff * step)
    n = math.ceil(0.5 * length) - 1
    phase = 2 * math.pi * np.arange(-n, n + 1.0) / length
    weights = np.cos(np.outer(phase, np.arange(4.0))) @ _WINDOW_COEFFICIENTS
    return weights / weights.sum()


def average_periods(time: Array, x: Array, period: float) -> tuple[Array, Array, Array]:
    """Mean over the complete periods of a recording.

    Args:
        time: Equidistant instants (N,) [s].
        x: Columns (N, ...).
        period: Period [s], a multiple of the step.

    Returns:
        Instants (M,) of the first period, mean (M, ...), and its standard error (M, ...), the
        standard deviation between the K periods over sqrt(K).

    Raises:
        RecordingError: There are fewer than two periods, or the period is no multiple of the step.
        InputError: The period is not positive.
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
    return time[:count], stacked.mean(axis=0), (stacked.std(axis=0, ddof=1) / math.sqrt(periods))


def filter_rows(
    regressor: Array, forces: Array, step: float, cutoff: float, decimation: int
) -> tuple[Array, Array]:
    """Filter and decimate both sides of forces = regressor parameters.

    The filter is `filter_kernel`. It is linear, so the parameters do not change, and of finite
    length, so that rows that the model cannot explain, such as those near standstill, affect only
    rows within the kernel. A recursive filter would spread the jump of friction at a reversal over
    all rows. At the ends the remaining weights are scaled to a sum of one.

    The cutoff may be at most a quarter of the new sampling frequency; aliases below the cutoff
    then come from above three times the cutoff.

    Args:
        regressor: (N, n, p).
        forces: (N, n).
        step: [s].
        cutoff: [Hz].
        decimation: Decimation factor; the first sample is kept.

    Returns:
        Regressor (M, n, p) and forces (M, n).

    Raises:
        InputError: Values are not finite, or the cutoff is too high.
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
    thinned = np.stack(  # joint by joint, to save memory
        [_weighted_means(regressor[:, i], weights, decimation) for i in range(forces.shape[1])],
        axis=1,
    )
    return thinned, _weighted_means(forces, weights, decimation)


def _weighted_means(x: Array, weights: Array, decimation: int) -> Array:
    """Weighted means of x (N, ...) about every n-th sample."""
    from scipy.signal import upfirdn

    reach, count = len(weights) // 2, len(x)
    lead = -reach % decimation  # aligns the decimated convolution with the first sample
    kept_samples = slice((reach + lead) // decimation, None)

    def convolved(x: Array) -> Array:
        edges = [(lead, reach), *[(0, 0)] * (x.ndim - 1)]
        whole = upfirdn(weights, np.pad(x, edges), down=decimation, axis=0)
        return whole[kept_samples][: -(-count // decimation)]

    return convolved(x) / convolved(np.ones(count)).reshape(-1, *[1] * (x.ndim - 1))
