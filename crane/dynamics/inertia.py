"""Symmetric 6 by 6 inertias as formulas: of rigid bodies, and of what hangs on them.

A wrench [f, n] answers an acceleration [a, e] of a point and of a body's directions:

    f = M a + H e,    n = H^T a + I e

M and I are symmetric. Wrenches and inertias refer to that point.
"""

from collections.abc import Callable, Sequence

from crane.closure.screws import Pair, Vector
from crane.codegen.factors import Positive
from crane.codegen.scalar import (
    Number,
    add,
    dot,
    product,
    scale,
    subtract,
    times,
    transposed,
)

Matrix = list[Vector]


def halved(factors: Positive, pairs: Sequence[Pair]) -> list[Pair]:
    """L^-1 of a column of pairs."""
    rows = transposed([factors.halved(column) for column in zip(*map(_flat, pairs), strict=True)])
    return [(row[:3], row[3:]) for row in rows]


def _flat(pair: Pair) -> Vector:
    return [*pair[0], *pair[1]]


class Inertia:
    """A symmetric 6 by 6 inertia.

    Args:
        mass: M (3, 3).
        mixed: H (3, 3).
        turning: I (3, 3).
    """

    def __init__(self, mass: Matrix, mixed: Matrix, turning: Matrix):
        self.mass, self.mixed, self.turning = mass, mixed, turning

    @classmethod
    def rigid(cls, mass: Number, lever: Vector, tensor: Matrix) -> "Inertia":
        """Of a rigid body.

        Args:
            mass: Its mass.
            lever: From the point to its COM (3,).
            tensor: Inertia about the COM (3, 3).
        """
        moment = scale(mass, lever)
        out = _symmetric(
            lambda r, c: (
                tensor[r][c] - moment[r] * lever[c] + (dot(moment, lever) if r == c else 0.0)
            )
        )
        straight: Matrix = [[mass if r == c else 0.0 for c in range(3)] for r in range(3)]
        return cls(straight, [scale(-1.0, row) for row in _skew(moment)], out)

    def __add__(self, other: "Inertia") -> "Inertia":
        return Inertia(
            _symmetric(lambda r, c: self.mass[r][c] + other.mass[r][c]),
            [add(one, two) for one, two in zip(self.mixed, other.mixed, strict=True)],
            _symmetric(lambda r, c: self.turning[r][c] + other.turning[r][c]),
        )

    def of(self, motion: Pair) -> Pair:
        """The wrench that answers a motion."""
        a, e = motion
        force = add(times(self.mass, a), times(self.mixed, e))
        return force, add(times(transposed(self.mixed), a), times(self.turning, e))

    def less(self, columns: Sequence[Pair], factors: Sequence[Number]) -> "Inertia":
        """Without what gives way: I - sum factor u u^T."""
        mass, mixed, turning = self.mass, self.mixed, self.turning
        for (f, n), factor in zip(columns, factors, strict=True):
            g, m = scale(factor, f), scale(factor, n)
            mass = _less(mass, g, f)
            turning = _less(turning, m, n)
            mixed = [subtract(row, scale(x, n)) for row, x in zip(mixed, g, strict=True)]
        return Inertia(mass, mixed, turning)

    def carried(self, arm: Vector) -> "Inertia":
        """The same, referred to the point from which `arm` leads to the present one."""
        skew = _skew(arm)
        mixed = [
            subtract(*rows) for rows in zip(self.mixed, product(self.mass, skew), strict=True)
        ]
        old, new, across = transposed(self.mixed), transposed(mixed), transposed(skew)
        turning = _symmetric(
            lambda r, c: self.turning[r][c] - dot(old[r], across[c]) + dot(skew[r], new[c])
        )
        return Inertia(self.mass, mixed, turning)


def _symmetric(entry: Callable[[int, int], Number]) -> Matrix:
    out: Matrix = [[0.0] * 3 for _ in range(3)]
    for r in range(3):
        for c in range(r + 1):
            out[r][c] = out[c][r] = entry(r, c)
    return out


def _less(matrix: Matrix, one: Vector, two: Vector) -> Matrix:
    """A symmetric matrix without a symmetric product."""
    return _symmetric(lambda r, c: matrix[r][c] - one[r] * two[c])


def _skew(v: Vector) -> Matrix:
    return [[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]]
