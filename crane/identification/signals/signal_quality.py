"""Quality of recorded signals: outliers, spectral lines, delays, steady samples, rejection."""

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from crane.common.errors import CraneWarning, InputError, RecordingError
from crane.common.samples import Array, as_number, true_runs
from crane.common.scratch_arrays import BLOCK_SIZE, release_pages
from crane.identification.signals.signal_processing import low_pass, sampling_step

_SEGMENT_COUNT = 8
_MIN_SEGMENTS = 7  # segments in which a line must stand out
_MIN_POWER_RATIO = 15.0  # times the median power around it: for noise a probability of 2^-15
_MEDIAN_HALF_WIDTH = 25  # frequencies on either side of the median
_MIN_SEGMENT_SAMPLES = 256  # samples of a segment
_MAX_SAMPLES = 2**17  # samples that are used
_MAX_RUN = 4  # samples from the first to the last outlier of a group
_NOISE_FACTOR = 8.0  # robust standard deviations between an outlier and its neighbours
_STEP_FACTOR = 4.0  # times the largest step between the neighbours, likewise
_NEIGHBOUR_COUNT = 3  # neighbours on either side
_RUN_REACH = _NEIGHBOUR_COUNT + _MAX_RUN  # samples from one that is tested to those it needs
# standard deviation over median absolute deviation of normal noise
_MAD_TO_STD = 1.482602218505602
_MAX_CHANGE = 0.02  # largest change relative to the range of a signal
_MIN_PERIODS = 3  # least number of periods of a ringing
_MAX_LINES = 4  # ringings that are averaged one after the other
_CORRELATION_TOLERANCE = 0.01  # of a correlation
_MAX_DELAY = 1.0  # [s] longest delay of the search


def spectral_edge_frequency(x: Array, step: float, share: float = 0.995) -> float:
    """Spectral edge frequency [Hz] of a motion: the largest of those of its signals.

    Args:
        x: Equidistant samples (N, n); constant signals do not count.
        step: Step between samples [s].
        share: Share of the power below it, 0 to 1.
    """
    edges = []
    for column in filter(np.ptp, x.T):
        release_pages()
        windowed = column - column.mean()
        windowed /= max(column.std(), 1e-300)
        phase = np.linspace(0.0, 2 * np.pi, len(column), endpoint=False)
        windowed *= 1.0 - np.cos(phase, out=phase)  # window of Hann
        power = np.abs(np.fft.rfft(windowed))
        power *= power
        power[1 : (len(column) + 1) // 2] *= 2.0  # those of negative frequencies
        whole = np.cumsum(power, out=power)
        edges.append(max(1, np.searchsorted(whole, share * whole[-1])) / (len(column) * step))
    return float(max(edges, default=1 / (len(x) * step)))


def strongest_spectral_line(
    x: Array, step: float, min_frequency: float
) -> tuple[float, float] | None:
    """Frequency [Hz] and amplitude of the strongest spectral line, None if there is none.

    A line exceeds the surrounding spectrum at one frequency in seven of eight segments of the
    signal, unlike ripple that follows a speed, or shocks.

    Args:
        x: Equidistant samples (N,).
        step: Step between samples [s].
        min_frequency: Frequency above which the motion has no power [Hz].
    """
    from scipy.ndimage import median_filter

    x = x[:_MAX_SAMPLES]
    count = len(x) // _SEGMENT_COUNT
    if count < _MIN_SEGMENT_SAMPLES:
        return None
    parts = x[: count * _SEGMENT_COUNT].reshape(_SEGMENT_COUNT, count)
    window = np.hanning(count)
    spectrum = np.abs(np.fft.rfft((parts - parts.mean(axis=1)[:, None]) * window, axis=1))
    floor = median_filter(spectrum, (1, 2 * _MEDIAN_HALF_WIDTH + 1), mode="nearest")
    exceeds_floor = spectrum**2 > _MIN_POWER_RATIO * floor**2
    # a line between two frequencies appears at both
    widened = exceeds_floor.copy()
    widened[:, 1:] |= exceeds_floor[:, :-1]
    widened[:, :-1] |= exceeds_floor[:, 1:]
    is_line = widened.sum(axis=0) >= _MIN_SEGMENTS
    frequency = np.arange(spectrum.shape[1]) / (count * step)
    is_line &= (frequency > min_frequency) & (np.arange(len(frequency)) > _MEDIAN_HALF_WIDTH)
    is_line[-3:] = False
    if not is_line.any():
        return None
    power = np.where(is_line, np.mean(spectrum**2, axis=0), 0.0)
    at = int(power.argmax())
    neighbourhood = slice(at - 2, at + 3)  # the window spreads a line over four frequencies
    total = np.mean(spectrum[:, neighbourhood] ** 2, axis=0)
    line_frequency = float((frequency[neighbourhood] * total).sum() / total.sum())
    amplitude = 2 * math.sqrt(float(total.sum()) / (count * float(window @ window)))
    return line_frequency, amplitude


def outlier_mask(x: Array) -> np.ndarray:
    """Mask (N,) of outliers in samples (N,).

    Outliers are one or several samples within four whose distance from the line between the
    adjacent samples exceeds eight robust standard deviations of such distances, and four times the
    largest step between three neighbours on either side. Noise, steps and resolved peaks are not
    outliers. The first and last three samples are not tested.

    Args:
        x: Equidistant samples.
    """
    found = np.zeros(len(x), dtype=bool)
    if len(x) <= 2 * _NEIGHBOUR_COUNT + _MAX_RUN:
        return found
    # robust standard deviation of samples about the mean of their neighbours; coarse samples may
    # coincide with it: at least the median nonzero step
    noise = _MAD_TO_STD * float(np.median(np.abs(x[1:-1] - 0.5 * (x[:-2] + x[2:]))))
    steps = np.abs(np.diff(x))
    if steps.any():
        noise = max(noise, float(np.median(steps[steps > 0])))
    while True:  # outliers masked by others appear after these are replaced
        bridged, before = replace_outliers(x, found), found.sum()
        for start in range(0, len(x), BLOCK_SIZE):
            first, end = max(0, start - _RUN_REACH), start + BLOCK_SIZE
            for length in range(1, _MAX_RUN + 1):
                runs = _outlier_runs(bridged[first : end + _RUN_REACH], length, noise)
                found[start:end] |= runs[start - first : end - first]
        if found.sum() == before:
            return found


def replace_outliers(x: Array, mask: np.ndarray) -> Array:
    """Replace masked samples (N,) by linear interpolation between their neighbours."""
    if not mask.any():
        return x
    good = np.flatnonzero(~mask)
    out = x.copy()
    out[mask] = np.interp(np.flatnonzero(mask), good, x[good])
    return out


def _outlier_runs(x: Array, length: int, noise: float) -> np.ndarray:
    """Mask of outliers in runs of a length whose both ends are outliers."""
    # runs start at _NEIGHBOUR_COUNT + i
    count = max(0, len(x) - length - 2 * _NEIGHBOUR_COUNT + 1)
    steps = np.abs(np.diff(x))
    before, after = x[_NEIGHBOUR_COUNT - 1 :][:count], x[_NEIGHBOUR_COUNT + length :][:count]
    largest = np.abs(after - before)
    for k in range(_NEIGHBOUR_COUNT - 1):
        for start in (k, _NEIGHBOUR_COUNT + length + k):
            np.maximum(largest, steps[start : start + count], out=largest)
    limit = np.maximum(_NOISE_FACTOR * noise, _STEP_FACTOR * largest)
    exceeds_limit = []
    for k in range(length):
        share = (k + 1) / (length + 1)
        line = (1 - share) * before + share * after
        exceeds_limit.append(np.abs(x[_NEIGHBOUR_COUNT + k :][:count] - line) > limit)
    found = np.zeros(len(x), dtype=bool)
    for k in range(length):
        found[_NEIGHBOUR_COUNT + k :][:count] |= (
            exceeds_limit[0] & exceeds_limit[-1] & exceeds_limit[k]
        )
    return found


def signal_delay(time: Array, one: Array, other: Array) -> float:
    """Delay [s] of the second signal (N,) with respect to the first, at most 1 s.

    It is the maximum of the correlation of the overlapping parts, refined by a parabola.
    """
    step = sampling_step(time)
    one, other = one - one.mean(), other - other.mean()
    shifts = np.arange(-(reach := min(round(_MAX_DELAY / step), len(time) // 4)), reach + 1)
    products = _products(one, other, reach)
    first, second = (np.append(0, np.cumsum(x**2)) for x in (one, other))
    low, high = np.maximum(shifts, 0), len(time) + np.minimum(shifts, 0)
    energy = (first[high - shifts] - first[low - shifts]) * (second[high] - second[low])
    correlation = products / np.sqrt(np.maximum(energy, 1e-12 * first[-1] * second[-1] + 1e-300))
    # the shortest of equal maxima, as for periodic signals
    best = np.flatnonzero(correlation >= correlation.max() - _CORRELATION_TOLERANCE)
    at = int(np.clip(best[np.abs(shifts[best]).argmin()], 1, 2 * reach - 1))
    if correlation[at - 1 : at + 2].argmax() != 1:  # not at a local maximum
        direction = 1 if correlation[at + 1] > correlation[at] else -1
        while 1 < at < 2 * reach - 1 and correlation[at + direction] > correlation[at]:
            at += direction
    before, here, after = correlation[at - 1 : at + 2]
    curvature = before - 2 * here + after
    shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return float((at - reach + shift) * step)


def shifted_correlation(
    one: Array, other: Array, shift: int, samples: np.ndarray | None = None
) -> float:
    """Correlation of some samples of one signal, all by default, with another, shifted one."""
    samples = np.arange(len(one)) if samples is None else samples
    shifted = samples + shift
    is_overlap = (shifted >= 0) & (shifted < len(other))
    return float(np.corrcoef(one[samples[is_overlap]], other[shifted[is_overlap]])[0, 1])


def _products(one: Array, other: Array, reach: int) -> Array:
    """Sums of one_k other_k+s for the shifts s from -reach to reach, in blocks of samples."""
    from scipy.signal import correlate

    total, padded = np.zeros(2 * reach + 1), np.pad(other, reach)
    for start in range(0, len(one), BLOCK_SIZE):
        part = one[start : start + BLOCK_SIZE]
        window = padded[start : start + len(part) + 2 * reach]
        total += correlate(window, part, mode="valid", method="fft")
    return total


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
    is_steady = steady_mask(time, settle, *signals, share=share, relative=relative)
    if not is_steady.any():
        raise RecordingError(
            f"no sample is steady for {settle:g} s, record slower ramps or longer steps"
        )
    return is_steady


def steady_mask(
    time: Array, settle: float, *signals: Array, share: float = _MAX_CHANGE, relative: bool = False
) -> np.ndarray:
    """Mask (N,) of `steady_samples`, which may be empty."""
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
        others: (m, N) other responses likewise.
    """

    kept: np.ndarray
    signal: Array
    answer: Array
    frequency: tuple[float, float] | None = None
    amplitude: float = 0.0
    others: Array = field(default_factory=lambda: np.zeros((0, 0)))


def steady_means(
    time: Array,
    settle: float,
    signal: Array,
    answer: Array,
    *others: Array,
    share: float = _MAX_CHANGE,
    relative: bool = False,
) -> SteadyMeans:
    """Steady samples of a signal and its response, which may ring about a steady mean.

    Samples of `steady_samples` are not changed. Others are used if both have steady means over
    the period of the ringing, which is determined in each segment with a steady signal; if the
    means ring at another frequency, over the period of that, too.

    Args:
        time: Equidistant instants (N,) [s].
        settle: As for `steady_samples`.
        signal: (N,) signal.
        answer: (N,) response.
        others: Other responses (N,), which need not be steady.
        share: Largest change of the response, as for `steady_samples`.
        relative: Whether it refers to the response at the sample, likewise.

    Raises:
        InputError: `settle` is not above two steps.
        RecordingError: No sample is steady.
    """

    def has_steady_answer(x: Array) -> np.ndarray:
        return steady_mask(time, settle, x, share=share, relative=relative)

    held = steady_mask(time, settle, signal)
    plain = held & has_steady_answer(answer)
    step = sampling_step(time)
    means, found = plain.copy(), []
    pairs = np.stack([signal, answer, *others])
    for start, end in true_runs(held).tolist():
        if plain[start:end].all():
            continue
        lines: list[tuple[float, float]] = []
        reach, whole, new = settle, pairs.copy(), np.zeros(end - start, dtype=bool)
        while len(lines) < _MAX_LINES and not new.any():
            part = whole[:, start:end]  # the whole keeps the range of the signals
            period, amplitude = _ringing(time[start:end], part[1], settle)
            reach += period
            if not period or end - start <= round(reach / step):
                break
            part[:] = _period_means(time[start:end], part, period)
            lines.append((1 / period, amplitude))
            new = steady_mask(time, settle, whole[0]) & has_steady_answer(whole[1])
            new = new[start:end] & ~plain[start:end]
            new[: round(reach / step)] = False
        means[start:end] |= new
        pairs[:, start:end] = np.where(new, whole[:, start:end], pairs[:, start:end])
        found += lines if new.any() else []
    if not means.any():
        return SteadyMeans(steady_samples(time, settle, signal, answer), signal, answer)  # raises
    if not found:
        return SteadyMeans(means, signal, answer, others=pairs[2:])
    frequencies, amplitudes = zip(*found, strict=True)
    ends = min(frequencies), max(frequencies)
    return SteadyMeans(means, pairs[0], pairs[1], ends, max(amplitudes), pairs[2:])


def _ringing(time: Array, x: Array, settle: float) -> tuple[float, float]:
    """Period [s] and amplitude of a ringing about a straight line, zeros without ringing.

    It is the strongest line of the spectrum below 4 / settle, and may decay.
    """
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
    band = (at * (t[-1] - t[0]) >= _MIN_PERIODS) & (at <= 4 / settle)
    power, at = power[band], at[band]
    if not power.any() or power.max() < _MIN_POWER_RATIO * np.median(power):
        return 0.0, 0.0
    frequency = float(at[power.argmax()])
    angle = 2 * np.pi * frequency * t
    rows = np.column_stack([np.cos(angle), np.sin(angle)])
    coefficients = np.linalg.lstsq(rows, rest, rcond=None)[0]
    return 1 / frequency, float(np.hypot(*coefficients))


def _period_means(time: Array, rows: Array, period: float) -> Array:
    """Means (m, N) over the period before each sample, or over its available part."""
    steps = np.diff(time) * 0.5 * (rows[:, 1:] + rows[:, :-1])
    whole = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(steps, axis=1)], axis=1)
    since = np.maximum(time - period, time[0])
    before = np.stack([np.interp(since, time, row) for row in whole])
    return (whole - before) / np.maximum(time - since, time[1] - time[0])


def reject_unless_trusted(
    text: str, trust: bool, remedy: str = "if the recording is right, trust it (trust)"
) -> None:
    """Reject a recording that is probably wrong, or warn if it is trusted.

    Raises:
        RecordingError: It is not trusted.
    """
    if not trust:
        raise RecordingError(f"{text}; {remedy}")
    warnings.warn(f"{text}: trusted", CraneWarning, stacklevel=3)


def reject_delay(name: str, delay: float, reference: str, trust: bool) -> None:
    """Reject a column with a delay [s] with respect to another, or warn if it is trusted.

    Raises:
        RecordingError: It is not trusted.
    """
    side = "behind" if delay > 0 else "ahead of"
    reject_unless_trusted(
        f"'{name}' is {abs(delay) * 1e3:.0f} ms {side} {reference}, record them with one clock",
        trust,
        f"or {shift_remedy({name: delay})}",
    )


def shift_remedy(delays: Mapping[str, float]) -> str:
    """Text that offers to take delays [s] out of columns."""
    options = " ".join(f"--shift '{name}={delay:.3g}'" for name, delay in delays.items())
    return f"take that out ({options}, in Python crane.recordings.shift_columns)"
