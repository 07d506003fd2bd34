"""Lines in the spectrum of a recorded signal: mains hum, a pump, a converter's switching."""

import math

import numpy as np

from crane.common.samples import Array

_SEGMENT_COUNT = 8
_MIN_SEGMENTS = 7  # of the segments in which a line stands out
_MIN_POWER_RATIO = 15.0  # times the median power around it: noise does that once in 2^15
_MEDIAN_HALF_WIDTH = 25  # frequencies on either side of which that median is
_MIN_SEGMENT_SAMPLES = 256  # samples of a segment
_MAX_SAMPLES = 2**17  # samples that are looked at


def strongest_spectral_line(
    x: Array, step: float, min_frequency: float
) -> tuple[float, float] | None:
    """The strongest line of a signal: frequency [Hz] and amplitude, None if there is none.

    A line stands out at one frequency of the spectrum from what is around it, in seven of eight
    parts of the signal: ripple that follows a speed, and jolts, do not.

    Args:
        x: Equidistant samples (N,).
        step: Between them [s].
        min_frequency: Frequency above which there is no motion [Hz].
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
    # between two frequencies a line shows at both
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
