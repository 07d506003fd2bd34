"""Texts and curves of figures: escaped labels, thinned curves."""

import numpy as np

from crane.common.samples import Array

_MAX_LENGTH = 80  # characters


def escape_label(text: str) -> str:
    r"""Return a text that matplotlib shows literally.

    Without escapes matplotlib reads text between two $ as mathematics (and raises for `$\bad$`),
    and leaves labels with a leading underscore out of legends.
    """
    shortened = text if len(text) <= _MAX_LENGTH else f"{text[: _MAX_LENGTH - 1]}…"
    shortened = escape_text(shortened)
    return f" {shortened}" if shortened.startswith("_") else shortened


def escape_text(text: str) -> str:
    """Escape a text of any length that is not in a legend, see `escape_label`."""
    printable = "".join(c if c.isprintable() or c == "\u00a0" else " " for c in text)
    return printable.replace("$", r"\$")


_MAX_POINTS = 40_000  # points of a curve, several per column of dots of any print


def envelope(time: Array, values: Array) -> tuple[Array, Array]:
    """Thin a curve (N,) to the smallest and the largest sample of each time span.

    First and last sample are kept; short curves are unchanged.
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
    """Thin a path (N, 3); the first and the last point are kept."""
    step = -(-len(points) // _MAX_POINTS)
    return points if step == 1 else np.vstack([points[:-1:step], points[-1:]])
