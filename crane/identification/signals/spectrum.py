"""Where the power of a signal is."""

import numpy as np

from crane.common.samples import Array


def spectral_edge_frequency(share: float, x: Array, step: float) -> float:
    """Frequency [Hz] below which a share of the power of a signal is, the lowest at least.

    Args:
        share: Of the power, 0 to 1.
        x: Equidistant samples (N,), which are not all the same.
        step: Between them [s].
    """
    from scipy.signal import periodogram

    frequency, power = periodogram(x, 1 / step, window="hann")
    whole = np.cumsum(power, out=power)
    return float(frequency[max(1, np.searchsorted(whole, share * whole[-1]))])
