"""Long curves with as many points as a picture can show."""

import numpy as np

from crane.common.samples import Array

_MOST = 40_000  # points of a curve, several per column of dots of any print


def envelope(time: Array, values: Array) -> tuple[Array, Array]:
    """A curve (N,) that looks the same: of each stretch of time its lowest and highest sample.

    First and last sample and all extremes stay; a short curve stays as it is.
    """
    count = len(values)
    if count <= _MOST:
        return time, values
    size = -(-2 * count // _MOST)
    whole = count // size * size
    stretches = values[:whole].reshape(-1, size)
    first = np.arange(0, whole, size)
    kept = np.concatenate(
        [first + stretches.argmin(axis=1), first + stretches.argmax(axis=1), [0, count - 1]]
    )
    if whole < count:
        kept = np.append(
            kept, whole + np.array([values[whole:].argmin(), values[whole:].argmax()])
        )
    kept = np.unique(kept)
    return time[kept], values[kept]


def thinned(points: Array) -> Array:
    """Of a path (N, 3) every so many points, first and last among them."""
    step = -(-len(points) // _MOST)
    return points if step == 1 else np.vstack([points[:-1:step], points[-1:]])
