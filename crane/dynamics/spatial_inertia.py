"""Symmetric 6 by 6 inertias as formulas: of rigid bodies, and of what hangs on them.

A wrench [f, n] answers an acceleration [a, e] of a point and of a body's directions:

    f = M a + H e,    n = H^T a + I e

M and I are symmetric. Wrenches and inertias refer to that point.
"""

from collections.abc import Callable, Sequence

from crane.closure.spatial_vectors import SpatialVector, Vector
from crane.codegen.matrix_factorization import LdltFactorization
from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    dot,
    matmul,
    matvec,
    scale_vector,
    subtract_vectors,
    transpose,
)

Matrix = list[Vector]


def forward_substitute(
    factorization: LdltFactorization, vectors: Sequence[SpatialVector]
) -> list[SpatialVector]:
    """L^-1 of a column of pairs."""
    rows = transpose(
        [
            factorization.forward_substitute(column)
            for column in zip(*map(_flatten, vectors), strict=True)
        ]
    )
    return [(row[:3], row[3:]) for row in rows]


def _flatten(pair: SpatialVector) -> Vector:
    return [*pair[0], *pair[1]]


class SpatialInertia:
    """A symmetric 6 by 6 inertia.

    Args:
        mass: M (3, 3).
        coupling: H (3, 3).
        rotational: I (3, 3).
    """

    def __init__(self, mass: Matrix, coupling: Matrix, rotational: Matrix):
        self.mass, self.mixed, self.turning = mass, coupling, rotational

    @classmethod
    def rigid_body(cls, mass: Scalar, lever: Vector, tensor: Matrix) -> "SpatialInertia":
        """Of a rigid body.

        Args:
            mass: Its mass.
            lever: From the point to its COM (3,).
            tensor: Inertia about the COM (3, 3).
        """
        moment = scale_vector(mass, lever)
        out = _symmetric_matrix(
            lambda r, c: (
                tensor[r][c] - moment[r] * lever[c] + (dot(moment, lever) if r == c else 0.0)
            )
        )
        straight: Matrix = [[mass if r == c else 0.0 for c in range(3)] for r in range(3)]
        return cls(straight, [scale_vector(-1.0, row) for row in _skew(moment)], out)

    def __add__(self, other: "SpatialInertia") -> "SpatialInertia":
        return SpatialInertia(
            _symmetric_matrix(lambda r, c: self.mass[r][c] + other.mass[r][c]),
            [add_vectors(one, two) for one, two in zip(self.mixed, other.mixed, strict=True)],
            _symmetric_matrix(lambda r, c: self.turning[r][c] + other.turning[r][c]),
        )

    def apply_to(self, motion: SpatialVector) -> SpatialVector:
        """The wrench that answers a motion."""
        a, e = motion
        force = add_vectors(matvec(self.mass, a), matvec(self.mixed, e))
        return force, add_vectors(matvec(transpose(self.mixed), a), matvec(self.turning, e))

    def subtract_columns(
        self, columns: Sequence[SpatialVector], factors: Sequence[Scalar]
    ) -> "SpatialInertia":
        """Without what gives way: I - sum factor u u^T."""
        mass, mixed, turning = self.mass, self.mixed, self.turning
        for (f, n), factor in zip(columns, factors, strict=True):
            g, m = scale_vector(factor, f), scale_vector(factor, n)
            mass = _subtract_symmetric_product(mass, g, f)
            turning = _subtract_symmetric_product(turning, m, n)
            mixed = [
                subtract_vectors(row, scale_vector(x, n)) for row, x in zip(mixed, g, strict=True)
            ]
        return SpatialInertia(mass, mixed, turning)

    def shift_origin(self, arm: Vector) -> "SpatialInertia":
        """The same, referred to the point from which `arm` leads to the present one."""
        skew = _skew(arm)
        coupling = [
            subtract_vectors(*rows)
            for rows in zip(self.mixed, matmul(self.mass, skew), strict=True)
        ]
        old, new, across = transpose(self.mixed), transpose(coupling), transpose(skew)
        rotational = _symmetric_matrix(
            lambda r, c: self.turning[r][c] - dot(old[r], across[c]) + dot(skew[r], new[c])
        )
        return SpatialInertia(self.mass, coupling, rotational)


def _symmetric_matrix(entry: Callable[[int, int], Scalar]) -> Matrix:
    out: Matrix = [[0.0] * 3 for _ in range(3)]
    for r in range(3):
        for c in range(r + 1):
            out[r][c] = out[c][r] = entry(r, c)
    return out


def _subtract_symmetric_product(matrix: Matrix, one: Vector, two: Vector) -> Matrix:
    """A symmetric matrix without a symmetric product."""
    return _symmetric_matrix(lambda r, c: matrix[r][c] - one[r] * two[c])


def _skew(v: Vector) -> Matrix:
    return [[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]]
