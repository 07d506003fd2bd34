"""Steady samples of signals, and means over periods of signals that ring."""

from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError, RecordingError
from crane.common.samples import Array, as_number
from crane.identification.signals.signal_processing import low_pass, sampling_step

_MAX_CHANGE = 0.02  # largest change relative to the range of a signal
_MIN_PERIODS = 3  # least number of periods of a ringing
_MAX_RESIDUAL_SHARE = 0.5  # largest share of the squares that a sinusoid leaves


def steady_samples(
    time: Array, settle: float, *signals: Array, share: float = _MAX_CHANGE, relative: bool = False
) -> np.ndarray:
    """Mask of samples before which signals were steady.

    Each signal, low-passed at 4 / settle Hz, changed by less than a share of its range in the last
    `settle` seconds.

    Args:
        time: Equidistant instants (N,) [s].
        settle: Duration [s].
        signals: Signals (N,).
        share: Largest change relative to the range.
        relative: Whether the share refers to the signal at the sample instead.

    Returns:
        Mask (N,), false during the first `settle` seconds.

    Raises:
        InputError: `settle` is not above two steps.
        RecordingError: No sample is steady.
    """
    is_steady = _steady_mask(time, settle, *signals, share=share, relative=relative)
    if not is_steady.any():
        raise RecordingError(
            f"no sample is steady for {settle:g} s, record slower ramps or longer steps"
        )
    return is_steady


def _steady_mask(
    time: Array, settle: float, *signals: Array, share: float = _MAX_CHANGE, relative: bool = False
) -> np.ndarray:
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    step = sampling_step(time)
    as_number(settle, "settle", "s", greater_than=0)
    count = round(settle / step)
    if count < 2:
        raise InputError(f"settle is {settle:g} s, give at least {2 * step:g} s")
    kept = np.ones(len(time), dtype=bool)
    kept[:count] = False
    for signal in signals:
        smooth = signal
        if 4 / settle < 0.4 / step:
            smooth = low_pass(time, signal, 4 / settle)
        # the window of sample k ends with it
        size, back = count + 1, count // 2
        span = maximum_filter1d(smooth, size, origin=back)
        span -= minimum_filter1d(smooth, size, origin=back)
        kept &= span <= share * (np.abs(smooth) if relative else np.ptp(smooth))
    return kept


@dataclass(frozen=True)
class SteadyMeans:
    """Steady samples of a signal and its response, with means over periods of a ringing response.

    Attributes:
        kept: Mask (N,) of the steady samples.
        signal: (N,) the signal, or its mean over the last period.
        answer: (N,) the response likewise.
        frequency: Lowest and highest frequency of the ringing [Hz], None without ringing.
        amplitude: Largest amplitude of the ringing, in the unit of the response.
    """

    kept: np.ndarray
    signal: Array
    answer: Array
    frequency: tuple[float, float] | None = None
    amplitude: float = 0.0


def steady_means(time: Array, settle: float, signal: Array, answer: Array) -> SteadyMeans:
    """Steady samples of a signal and its response, which may ring about a steady mean.

    Samples of `steady_samples` are not changed. Others are used if both have steady means over one
    period of the ringing, which is determined in each segment with a steady signal.

    Args:
        time: Equidistant instants (N,) [s].
        settle: As for `steady_samples`.
        signal: (N,) signal.
        answer: (N,) response.

    Raises:
        InputError: `settle` is not above two steps.
        RecordingError: No sample is steady.
    """
    plain = _steady_mask(time, settle, signal, answer)
    held = _steady_mask(time, settle, signal)
    step = sampling_step(time)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]]).astype(int)))
    means, found = plain.copy(), []
    pairs = np.stack([signal, answer])
    for start, end in edges.reshape(-1, 2).tolist():
        if plain[start:end].all():
            continue
        period, amplitude = _ringing(time[start:end], answer[start:end], settle)
        if not period or end - start <= round((period + settle) / step):
            continue
        part = _period_means(time[start:end], pairs[:, start:end], period)
        whole = pairs.copy()  # keeps the range of the whole signal
        whole[:, start:end] = part
        new = _steady_mask(time, settle, *whole)[start:end] & ~plain[start:end]
        new[: round((period + settle) / step)] = False
        if new.any():
            means[start:end] |= new
            pairs[:, start:end] = np.where(new, part, pairs[:, start:end])
            found.append((1 / period, amplitude))
    if not means.any():
        return SteadyMeans(steady_samples(time, settle, signal, answer), signal, answer)  # raises
    if not found:
        return SteadyMeans(means, signal, answer)
    frequencies, amplitudes = zip(*found, strict=True)
    ends = min(frequencies), max(frequencies)
    return SteadyMeans(means, pairs[0], pairs[1], ends, max(amplitudes))


def _ringing(time: Array, x: Array, settle: float) -> tuple[float, float]:
    """Period [s] and amplitude of a ringing about a straight line, zeros without ringing."""
    length = float(time[-1] - time[0])
    if length < max(_MIN_PERIODS * settle, 16 * float(time[1] - time[0])):
        return 0.0, 0.0
    is_settled = time >= time[0] + 0.25 * length  # transients of the preceding step have decayed
    t, x = time[is_settled], x[is_settled]
    rest = x - np.polynomial.Polynomial.fit(t, x, 1)(t)
    windowed = rest * np.hanning(len(rest))
    size = 16 * len(windowed)  # zero padding resolves frequencies to a few thousandths
    power = np.abs(np.fft.rfft(windowed, size)) ** 2
    at = np.fft.rfftfreq(size, t[1] - t[0])
    power[(at * (t[-1] - t[0]) < _MIN_PERIODS) | (at > 4 / settle)] = 0
    frequency = float(at[power.argmax()])
    if not power.any():
        return 0.0, 0.0
    angle = 2 * np.pi * frequency * t
    rows = np.column_stack([np.cos(angle), np.sin(angle)])
    coefficients = np.linalg.lstsq(rows, rest, rcond=None)[0]
    if np.sum((rest - rows @ coefficients) ** 2) > _MAX_RESIDUAL_SHARE * np.sum(rest**2):
        return 0.0, 0.0
    return 1 / frequency, float(np.hypot(*coefficients))


def _period_means(time: Array, rows: Array, period: float) -> Array:
    """Means (m, N) over the period before each sample, or over its available part."""
    steps = np.diff(time) * 0.5 * (rows[:, 1:] + rows[:, :-1])
    whole = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(steps, axis=1)], axis=1)
    since = np.maximum(time - period, time[0])
    before = np.stack([np.interp(since, time, row) for row in whole])
    return np.asarray((whole - before) / np.maximum(time - since, time[1] - time[0]))
