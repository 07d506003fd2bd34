"""Outliers, spectral lines and spectral edge frequencies of recorded signals."""

import math

import numpy as np

from crane.common.samples import Array

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
# standard deviation over median absolute deviation of normal noise
_MAD_TO_STD = 1.482602218505602


def spectral_edge_frequency(share: float, x: Array, step: float) -> float:
    """Spectral edge frequency [Hz], below which a share of the power of a signal lies.

    Args:
        share: Share of the power, 0 to 1.
        x: Equidistant samples (N,), not constant.
        step: Step between samples [s].
    """
    from scipy.signal import periodogram

    frequency, power = periodogram(x, 1 / step, window="hann")
    whole = np.cumsum(power, out=power)
    return float(frequency[max(1, np.searchsorted(whole, share * whole[-1]))])


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
    noise = _neighbour_noise(x)
    while True:  # outliers masked by others appear after these are replaced
        bridged, before = replace_outliers(x, found), found.sum()
        for length in range(1, _MAX_RUN + 1):
            found |= _outlier_runs(bridged, length, noise)
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


def _neighbour_noise(x: Array) -> float:
    """Robust standard deviation of samples about the mean of their neighbours.

    Coarse samples may coincide with it: at least the median nonzero step is returned.
    """
    deviation = _MAD_TO_STD * float(np.median(np.abs(x[1:-1] - 0.5 * (x[:-2] + x[2:]))))
    steps = np.abs(np.diff(x))
    steps = steps[steps > 0]
    return max(deviation, float(np.median(steps)) if len(steps) else 0.0)


def _outlier_runs(x: Array, length: int, noise: float) -> np.ndarray:
    """Mask of outliers in runs of a length whose both ends are outliers."""
    count = len(x) - length - 2 * _NEIGHBOUR_COUNT + 1  # runs start at _NEIGHBOUR_COUNT + i
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
