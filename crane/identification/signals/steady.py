"""Where a motion is steady."""

import numpy as np

from crane.common.errors import InputError, RecordingError
from crane.common.samples import Array, as_number
from crane.identification.signals.motion import low_pass, sampling

_SHARE = 0.02  # of a signal's range, by which it may change


def steady(
    time: Array, settle: float, *signals: Array, share: float = _SHARE, relative: bool = False
) -> np.ndarray:
    """Samples before which signals hardly changed.

    Each signal, low-passed at 4 / settle Hz, moved by less than a share of its range during the
    last `settle` seconds.

    Args:
        time: Equidistant instants (N,) [s].
        settle: [s].
        signals: Each (N,).
        share: Of the range, by which each may change.
        relative: Whether the share is of the signal at that sample instead.

    Returns:
        Mask (N,), false during the first `settle` seconds.

    Raises:
        InputError: settle is not above two steps.
        RecordingError: No sample is steady.
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    step = sampling(time)
    as_number(settle, "settle", "s", above=0)
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
    if not kept.any():
        raise RecordingError(
            f"no sample is steady for {settle:g} s, record slower ramps or longer steps"
        )
    return kept
