"""Long curves with as many points as a picture can show."""

import numpy as np

from crane.common.samples import Array

_MAX_POINTS = 40_000  # points of a curve, several per column of dots of any print


def envelope(time: Array, values: Array) -> tuple[Array, Array]:
    """A curve (N,) that looks the same: of each stretch of time its lowest and highest sample.

    First and last sample and all extremes stay; a short curve stays as it is.
    """
    count = len(values)
    if count <= _MAX_POINTS:
        return time, values
    block_size = -(-2 * count // _MAX_POINTS)
    divisible_count = count // block_size * block_size
    blocks = values[:divisible_count].reshape(-1, block_size)
    block_starts = np.arange(0, divisible_count, block_size)
    indices = np.concatenate(
        [
            block_starts + blocks.argmin(axis=1),
            block_starts + blocks.argmax(axis=1),
            [0, count - 1],
        ]
    )
    if divisible_count < count:
        indices = np.append(
            indices,
            divisible_count
            + np.array([values[divisible_count:].argmin(), values[divisible_count:].argmax()]),
        )
    indices = np.unique(indices)
    return time[indices], values[indices]


def thin_path(points: Array) -> Array:
    """Of a path (N, 3) every so many points, first and last among them."""
    step = -(-len(points) // _MAX_POINTS)
    return points if step == 1 else np.vstack([points[:-1:step], points[-1:]])
