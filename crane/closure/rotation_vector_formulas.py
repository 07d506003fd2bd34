"""Rotation vectors as formulas, regular at zero; see `crane.description.floating_bases`."""

import math
from collections.abc import Sequence

from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    apply_function,
    cross,
    dot,
    scale_vector,
    where_positive,
)  # fmt: skip

# under a root: far below what a rotation vector rounds to, and its root is not zero
_NORM_REGULARIZATION = 1e-300


def rotation_matrix(vector: Sequence[Scalar]) -> list[list[Scalar]]:
    """R = 1 + (sin t / t) r x + (1/2) (sin(t/2) / (t/2))^2 (r x)^2, t = |r| (Rodrigues)."""
    length = _regularized_norm(vector)
    half = 0.5 * length
    first = apply_function("sin", length) / length
    ratio = apply_function("sin", half) / half
    second = 0.5 * ratio * ratio
    columns = []
    for k in range(3):
        unit = [float(i == k) for i in range(3)]
        turned = cross(vector, unit)
        columns.append(
            add_vectors(
                unit, scale_vector(first, turned), scale_vector(second, cross(vector, turned))
            )
        )
    return [list(row) for row in zip(*columns, strict=True)]


def rotation_vector_derivative(
    vector: Sequence[Scalar], angular_velocity: Sequence[Scalar]
) -> list[Scalar]:
    """R' = (1 + r x / 2 + c (r x)^2) w, c t^2 = 1 - (t/2) cot(t/2), w in the body's axes."""
    length = _regularized_norm(vector)
    half = 0.5 * length
    share = 1.0 - half * apply_function("cos", half) / apply_function("sin", half)
    unit = scale_vector(1.0 / length, vector)
    turned = cross(unit, angular_velocity)
    return add_vectors(
        angular_velocity, scale_vector(half, turned), scale_vector(share, cross(unit, turned))
    )


def wrap_rotation_vector(vector: Sequence[Scalar]) -> list[Scalar]:
    """The same rotation by at most pi, of a vector shorter than 2 pi."""
    length = _regularized_norm(vector)
    factor = where_positive(length - math.pi, 1.0 - 2.0 * math.pi / length, 1.0)
    return scale_vector(factor, vector)


def _regularized_norm(vector: Sequence[Scalar]) -> Scalar:
    return apply_function("sqrt", dot(vector, vector) + _NORM_REGULARIZATION)
