"""Samples that stand out from their neighbours: found before any filter smears them."""

import numpy as np

from crane.common.samples import Array

_MAX_RUN = 4  # samples from the first to the last of several outliers
_NOISE_FACTOR = 8.0  # robust standard deviations by which an outlier is off
_STEP_FACTOR = 4.0  # largest steps between its neighbours, likewise
_NEIGHBOUR_COUNT = 3  # neighbours on either side
_MAD_TO_STD = (
    1.482602218505602  # standard deviation over median absolute deviation of normal noise
)


def outlier_mask(x: Array) -> np.ndarray:
    """Which samples (N,) belong neither to the signal nor to its noise: a mask (N,).

    Samples, one or several within four, whose distance from the line through what is beside them
    is more than eight robust standard deviations of such distances, and more than four times the
    largest step between three neighbours on either side. So noise is none, nor a step, nor a peak
    of a force that the samples follow. The first and last three samples are not judged.

    Args:
        x: Equidistant samples.
    """
    found = np.zeros(len(x), dtype=bool)
    if len(x) <= 2 * _NEIGHBOUR_COUNT + _MAX_RUN:
        return found
    noise = _neighbour_noise(x)
    while True:  # those that others beside them hid come out when these are bridged
        bridged, before = replace_outliers(x, found), found.sum()
        for length in range(1, _MAX_RUN + 1):
            found |= _outlier_runs(bridged, length, noise)
        if found.sum() == before:
            return found


def replace_outliers(x: Array, mask: np.ndarray) -> Array:
    """The samples (N,) with the line between their neighbours in the place of bad ones."""
    if not mask.any():
        return x
    good = np.flatnonzero(~mask)
    out = x.copy()
    out[mask] = np.interp(np.flatnonzero(mask), good, x[good])
    return out


def _neighbour_noise(x: Array) -> float:
    """Robust standard deviation of a sample from the middle of its neighbours.

    Of coarse samples more than half may lie there exactly: at least their usual step.
    """
    deviation = _MAD_TO_STD * float(np.median(np.abs(x[1:-1] - 0.5 * (x[:-2] + x[2:]))))
    steps = np.abs(np.diff(x))
    steps = steps[steps > 0]
    return max(deviation, float(np.median(steps)) if len(steps) else 0.0)


def _outlier_runs(x: Array, length: int, noise: float) -> np.ndarray:
    """Mask of the samples that are off in runs of that length whose ends are."""
    count = len(x) - length - 2 * _NEIGHBOUR_COUNT + 1  # runs start at _BESIDE + i
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
