"""Lines in the spectrum of a recorded signal: mains hum, a pump, a converter's switching."""

import math

import numpy as np

from crane.common.samples import Array

_SEGMENTS = 8
_HELD = 7  # of the segments in which a line stands out
_ABOVE = 15.0  # times the median power around it: noise does that once in 2^15
_AROUND = 25  # frequencies on either side of which that median is
_FEWEST = 256  # samples of a segment
_MOST = 2**17  # samples that are looked at


def line(x: Array, step: float, lowest: float) -> tuple[float, float] | None:
    """The strongest line of a signal: frequency [Hz] and amplitude, None if there is none.

    A line stands out at one frequency of the spectrum from what is around it, in seven of eight
    parts of the signal: ripple that follows a speed, and jolts, do not.

    Args:
        x: Equidistant samples (N,).
        step: Between them [s].
        lowest: Frequency above which there is no motion [Hz].
    """
    from scipy.ndimage import median_filter

    x = x[:_MOST]
    count = len(x) // _SEGMENTS
    if count < _FEWEST:
        return None
    parts = x[: count * _SEGMENTS].reshape(_SEGMENTS, count)
    window = np.hanning(count)
    spectrum = np.abs(np.fft.rfft((parts - parts.mean(axis=1)[:, None]) * window, axis=1))
    floor = median_filter(spectrum, (1, 2 * _AROUND + 1), mode="nearest")
    out = spectrum**2 > _ABOVE * floor**2
    # between two frequencies a line shows at both
    wide = out.copy()
    wide[:, 1:] |= out[:, :-1]
    wide[:, :-1] |= out[:, 1:]
    stands = wide.sum(axis=0) >= _HELD
    frequency = np.arange(spectrum.shape[1]) / (count * step)
    stands &= (frequency > lowest) & (np.arange(len(frequency)) > _AROUND)
    stands[-3:] = False
    if not stands.any():
        return None
    power = np.where(stands, np.mean(spectrum**2, axis=0), 0.0)
    at = int(power.argmax())
    near = slice(at - 2, at + 3)  # the window spreads a line over four frequencies
    total = np.mean(spectrum[:, near] ** 2, axis=0)
    place = float((frequency[near] * total).sum() / total.sum())
    amplitude = 2 * math.sqrt(float(total.sum()) / (count * float(window @ window)))
    return place, amplitude
