"""Rotation vectors as formulas, regular at zero; see `crane.description.floating`."""

import math
from collections.abc import Sequence

from crane.codegen.scalar import (
    Number,
    add,
    apply,
    cross,
    dot,
    scale,
    where_positive,
)  # fmt: skip

# under a root: far below what a rotation vector rounds to, and its root is not zero
_TINY = 1e-300


def turned_by(vector: Sequence[Number]) -> list[list[Number]]:
    """R = 1 + (sin t / t) r x + (1/2) (sin(t/2) / (t/2))^2 (r x)^2, t = |r| (Rodrigues)."""
    length = _length(vector)
    half = 0.5 * length
    first = apply("sin", length) / length
    ratio = apply("sin", half) / half
    second = 0.5 * ratio * ratio
    columns = []
    for k in range(3):
        unit = [float(i == k) for i in range(3)]
        turned = cross(vector, unit)
        columns.append(add(unit, scale(first, turned), scale(second, cross(vector, turned))))
    return [list(row) for row in zip(*columns, strict=True)]


def vector_rate(vector: Sequence[Number], angular: Sequence[Number]) -> list[Number]:
    """R' = (1 + r x / 2 + c (r x)^2) w, c t^2 = 1 - (t/2) cot(t/2), w in the body's axes."""
    length = _length(vector)
    half = 0.5 * length
    share = 1.0 - half * apply("cos", half) / apply("sin", half)
    unit = scale(1.0 / length, vector)
    turned = cross(unit, angular)
    return add(angular, scale(half, turned), scale(share, cross(unit, turned)))


def wrapped(vector: Sequence[Number]) -> list[Number]:
    """The same rotation by at most pi, of a vector shorter than 2 pi."""
    length = _length(vector)
    factor = where_positive(length - math.pi, 1.0 - 2.0 * math.pi / length, 1.0)
    return scale(factor, vector)


def _length(vector: Sequence[Number]) -> Number:
    return apply("sqrt", dot(vector, vector) + _TINY)
