"""Motions and wrenches of bodies as formulas: pairs of a linear and an angular part."""

from crane.codegen.symbolic import Scalar, add_vectors, cross, dot, scale_vector, subtract_vectors

Vector = list[Scalar]
SpatialVector = tuple[
    Vector, Vector
]  # motion [v, w] of a point and a body, wrench [f, n] about a point
ZERO_VECTOR: SpatialVector = ([0.0] * 3, [0.0] * 3)


def spatial_dot(first: SpatialVector, second: SpatialVector) -> Scalar:
    """Power of a wrench on a motion."""
    return dot(first[0], second[0]) + dot(first[1], second[1])


def add_spatial(*vectors: SpatialVector) -> SpatialVector:
    """Sum of pairs."""
    return add_vectors(*(pair[0] for pair in vectors)), add_vectors(*(pair[1] for pair in vectors))


def subtract_spatial(first: SpatialVector, second: SpatialVector) -> SpatialVector:
    """Difference of pairs."""
    return subtract_vectors(first[0], second[0]), subtract_vectors(first[1], second[1])


def scale_spatial(factor: Scalar, vector: SpatialVector) -> SpatialVector:
    """A factor times a pair."""
    return scale_vector(factor, vector[0]), scale_vector(factor, vector[1])


def shift_motion(motion: SpatialVector, arm: Vector) -> SpatialVector:
    """How a point that `arm` leads to moves with one that moves so."""
    linear, angular = motion
    return add_vectors(linear, cross(angular, arm)), angular


def shift_wrench(wrench: SpatialVector, arm: Vector) -> SpatialVector:
    """A wrench at a point, referred to the point from which `arm` leads there."""
    force, moment = wrench
    return force, add_vectors(moment, cross(arm, force))


def cross_motion(motion: SpatialVector, other: SpatialVector) -> SpatialVector:
    """V x S: how a motion changes that moves with V itself."""
    (v, w), (u, t) = motion, other
    return add_vectors(cross(w, u), cross(v, t)), cross(w, t)


def cross_wrench(motion: SpatialVector, wrench: SpatialVector) -> SpatialVector:
    """V x* F: how a wrench changes that moves with V."""
    (v, w), (force, moment) = motion, wrench
    return cross(w, force), add_vectors(cross(w, moment), cross(v, force))
