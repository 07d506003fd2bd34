"""Spatial vectors and rotation vectors as symbolic formulas.

A spatial vector is a pair of a linear and an angular part. Rotation vectors are regular at zero;
see `crane.description.floating_bases`.
"""

import math
from collections.abc import Sequence

from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    apply_function,
    cross,
    dot,
    scale_vector,
    subtract_vectors,
    where_positive,
)  # fmt: skip

Vector = list[Scalar]
SpatialVector = tuple[
    Vector, Vector
]  # motion [v, w] of a point and a body, wrench [f, n] about a point
ZERO_VECTOR: SpatialVector = ([0.0] * 3, [0.0] * 3)


def spatial_dot(first: SpatialVector, second: SpatialVector) -> Scalar:
    """Power of a wrench on a motion."""
    return dot(first[0], second[0]) + dot(first[1], second[1])


def add_spatial(*vectors: SpatialVector) -> SpatialVector:
    """Sum of spatial vectors."""
    return add_vectors(*(pair[0] for pair in vectors)), add_vectors(*(pair[1] for pair in vectors))


def subtract_spatial(first: SpatialVector, second: SpatialVector) -> SpatialVector:
    """Difference of spatial vectors."""
    return subtract_vectors(first[0], second[0]), subtract_vectors(first[1], second[1])


def scale_spatial(factor: Scalar, vector: SpatialVector) -> SpatialVector:
    """A factor times a spatial vector."""
    return scale_vector(factor, vector[0]), scale_vector(factor, vector[1])


def shift_motion(motion: SpatialVector, arm: Vector) -> SpatialVector:
    """The motion of the point at `arm` from the reference point of a motion."""
    linear, angular = motion
    return add_vectors(linear, cross(angular, arm)), angular


def shift_wrench(wrench: SpatialVector, arm: Vector) -> SpatialVector:
    """A wrench at the point at `arm` from a reference point, referred to that reference point."""
    force, moment = wrench
    return force, add_vectors(moment, cross(arm, force))


def cross_motion(motion: SpatialVector, other: SpatialVector) -> SpatialVector:
    """V x S: rate of a motion S that is fixed to a body with velocity V."""
    (v, w), (u, t) = motion, other
    return add_vectors(cross(w, u), cross(v, t)), cross(w, t)


def cross_wrench(motion: SpatialVector, wrench: SpatialVector) -> SpatialVector:
    """V x* F: rate of a wrench F that is fixed to a body with velocity V."""
    (v, w), (force, moment) = motion, wrench
    return cross(w, force), add_vectors(cross(w, moment), cross(v, force))


# added under a square root: far below rounding, but its root is not zero
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
    """Derivative r' = (1 + r x / 2 + c (r x)^2) w of a rotation vector, w in the body's axes.

    With c t^2 = 1 - (t/2) cot(t/2), t = |r|.
    """
    length = _regularized_norm(vector)
    half = 0.5 * length
    share = 1.0 - half * apply_function("cos", half) / apply_function("sin", half)
    unit = scale_vector(1.0 / length, vector)
    turned = cross(unit, angular_velocity)
    return add_vectors(
        angular_velocity, scale_vector(half, turned), scale_vector(share, cross(unit, turned))
    )


def wrap_rotation_vector(vector: Sequence[Scalar]) -> list[Scalar]:
    """The same rotation with a vector of length pi or less, from one shorter than 2 pi."""
    length = _regularized_norm(vector)
    return scale_vector(
        where_positive(length - math.pi, 1.0 - 2.0 * math.pi / length, 1.0), vector
    )


def _regularized_norm(vector: Sequence[Scalar]) -> Scalar:
    return apply_function("sqrt", dot(vector, vector) + _NORM_REGULARIZATION)
