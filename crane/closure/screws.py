"""Motions and wrenches of bodies as formulas: pairs of a linear and an angular part."""

from crane.codegen.scalar import Number, add, cross, dot, scale, subtract

Vector = list[Number]
Pair = tuple[Vector, Vector]  # motion [v, w] of a point and a body, wrench [f, n] about a point
NONE: Pair = ([0.0] * 3, [0.0] * 3)


def paired(one: Pair, two: Pair) -> Number:
    """Power of a wrench on a motion."""
    return dot(one[0], two[0]) + dot(one[1], two[1])


def plus(*pairs: Pair) -> Pair:
    """Sum of pairs."""
    return add(*(pair[0] for pair in pairs)), add(*(pair[1] for pair in pairs))


def minus(one: Pair, two: Pair) -> Pair:
    """Difference of pairs."""
    return subtract(one[0], two[0]), subtract(one[1], two[1])


def by(factor: Number, pair: Pair) -> Pair:
    """A factor times a pair."""
    return scale(factor, pair[0]), scale(factor, pair[1])


def shifted(motion: Pair, arm: Vector) -> Pair:
    """How a point that `arm` leads to moves with one that moves so."""
    linear, angular = motion
    return add(linear, cross(angular, arm)), angular


def carried(wrench: Pair, arm: Vector) -> Pair:
    """A wrench at a point, referred to the point from which `arm` leads there."""
    force, moment = wrench
    return force, add(moment, cross(arm, force))


def crossed(motion: Pair, other: Pair) -> Pair:
    """V x S: how a motion changes that moves with V itself."""
    (v, w), (u, t) = motion, other
    return add(cross(w, u), cross(v, t)), cross(w, t)


def crossed_wrench(motion: Pair, wrench: Pair) -> Pair:
    """V x* F: how a wrench changes that moves with V."""
    (v, w), (force, moment) = motion, wrench
    return cross(w, force), add(cross(w, moment), cross(v, force))
