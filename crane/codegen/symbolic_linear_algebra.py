"""Linear systems and factorizations of symbolic matrices, without branches."""

import itertools
import math
from collections.abc import Collection, Sequence

from crane.codegen.symbolic import (
    Scalar,
    SymbolicExpression,
    Tape,
    apply_function,
    copysign,
    dot,
    where_positive,
)


def solve_linear_system(
    matrix: Sequence[Sequence[Scalar]], right: Sequence[Sequence[Scalar]]
) -> tuple[list[list[Scalar]], Scalar]:
    """Solve A X = B without branches: Cramer's rule of order 2, else Householder reflections.

    Reflections need no pivoting.

    Args:
        matrix: (k, k).
        right: (k, columns).

    Returns:
        X (k, columns), and the determinant of A.
    """
    size = len(matrix)
    if size == 2:
        (a, b), (c, d) = matrix
        determinant = a * d - b * c
        inverse = 1.0 / determinant
        top = [(d * x - b * y) * inverse for x, y in zip(*right, strict=True)]
        return [top, [(a * y - c * x) * inverse for x, y in zip(*right, strict=True)]], determinant
    rows = [[*row, *more] for row, more in zip(matrix, right, strict=True)]
    determinant = 1.0
    diagonal: list[Scalar] = []
    for k in range(size):
        column = [rows[i][k] for i in range(k, size)]
        below = dot(column[1:], column[1:])
        if (
            not isinstance(below, SymbolicExpression) and below == 0
        ):  # only zeros below: no reflection needed
            diagonal.append(column[0])
            determinant = determinant * column[0]
            continue
        length = apply_function("sqrt", column[0] * column[0] + below)
        if isinstance(column[0], SymbolicExpression):
            length = copysign(length, column[0])
        elif column[0] < 0:
            length = -length
        first = column[0] + length
        normal = [first, *column[1:]]
        factor = 1.0 / (length * first)
        for j in range(k + 1, len(rows[0])):
            part = factor * dot(normal, [rows[i][j] for i in range(k, size)])
            for i in range(k, size):
                rows[i][j] = rows[i][j] - part * normal[i - k]
        diagonal.append(-length)
        determinant = (
            determinant * length
        )  # -length from the diagonal, times -1 from the reflection
    width = len(right[0])
    out: list[list[Scalar]] = [[0.0] * width for _ in range(size)]
    for k in range(size - 1, -1, -1):
        inverse = 1.0 / diagonal[k]
        for j in range(width):
            total = rows[k][size + j]
            for i in range(k + 1, size):
                total = total - rows[k][i] * out[i][j]
            out[k][j] = total * inverse
    return out, determinant


Matrix = list[list[Scalar]]


_ROUNDING_SHARE = 1e-11  # of a pivot in the diagonal entry: no more than five digits are left


def invert_pivot(pivot: Scalar, least: Scalar) -> Scalar:
    """1 / pivot, NaN where the pivot is not above `least`."""
    if not isinstance(pivot, SymbolicExpression) and not pivot > 0:
        return math.nan
    return where_positive(pivot - least, 1.0 / pivot, math.nan)


class LdltFactorization:
    """Factorization L D L^T of a symmetric positive definite matrix, with unit diagonal of L.

    A singular matrix has NaN in place of solutions if `least_pivots` are given: an entry of D is
    zero to rounding below 1e-11 of the diagonal entry of the matrix. Without them D is not looked
    at.

    Args:
        matrix: (k, k), of which the lower half is read.
        least_pivots: (k,) entries of D that count as zero in addition.
        held: Indices of unknowns that are left out: they are zero in solutions.

    Attributes:
        inverse_diagonal: (k,) inverse of D, 0 for held unknowns.
    """

    def __init__(
        self,
        matrix: Sequence[Sequence[Scalar]],
        least_pivots: Sequence[Scalar] | None = None,
        held: Collection[int] = (),
    ):
        size = len(matrix)
        self._unit_lower: Matrix = [[0.0] * size for _ in range(size)]
        self.inverse_diagonal: list[Scalar] = []
        for j in range(size):
            scaled = self.forward_substitute(matrix[j][:j])
            self._unit_lower[j][:j] = [
                x * d for x, d in zip(scaled, self.inverse_diagonal, strict=True)
            ]
            if j in held:
                self.inverse_diagonal.append(0.0)
                continue
            pivot = matrix[j][j] - dot(scaled, self._unit_lower[j][:j])
            self.inverse_diagonal.append(
                1.0 / pivot
                if least_pivots is None
                else invert_pivot(pivot, least_pivots[j] + _ROUNDING_SHARE * matrix[j][j])
            )

    def forward_substitute(self, right: Sequence[Scalar]) -> list[Scalar]:
        """L^-1 b; of the first entries of b the first of it."""
        x: list[Scalar] = []
        for row, value in zip(self._unit_lower, right, strict=False):
            x.append(value - dot(row[: len(x)], x))
        return x

    @property
    def inverse_matrix(self) -> Matrix:
        """A^-1 = L^-T D^-1 L^-1."""
        size = len(self._unit_lower)
        columns = [
            self.forward_substitute([float(i == k) for i in range(size)]) for k in range(size)
        ]
        out: Matrix = [[0.0] * size for _ in range(size)]
        for k, column in enumerate(columns):
            weighed = [x * d for x, d in zip(column, self.inverse_diagonal, strict=True)]
            for j in range(k + 1):
                out[j][k] = out[k][j] = dot(weighed[k:], columns[j][k:])
        return out

    def solve(self, right: Sequence[Scalar]) -> list[Scalar]:
        """A^-1 b."""
        x = [
            value * d
            for value, d in zip(self.forward_substitute(right), self.inverse_diagonal, strict=True)
        ]
        for j in range(len(x) - 1, -1, -1):
            x[j] = x[j] - dot([row[j] for row in self._unit_lower[j + 1 :]], x[j + 1 :])
        return x

    def root_solve(self, right: Sequence[Scalar]) -> list[Scalar]:
        """C^-1 b, A = C C^T with C = L D^(1/2)."""
        return [x * r for x, r in zip(self.forward_substitute(right), self._roots, strict=True)]

    def root_multiply(self, vector: Sequence[Scalar]) -> list[Scalar]:
        """C^T x."""
        columns = zip(*self._unit_lower, strict=True)
        below = [x + dot(column, vector) for x, column in zip(vector, columns, strict=True)]
        return [x / r for x, r in zip(below, self._roots, strict=True)]

    @property
    def _roots(self) -> list[Scalar]:
        return [apply_function("sqrt", x) for x in self.inverse_diagonal]


def lu_factorize(matrix: Sequence[Sequence[Scalar]]) -> Matrix:
    """LU factorization without pivoting, L and U in one matrix.

    The diagonal holds the inverse of U's; L has a unit diagonal. The caller must order the rows so
    that pivots stay away from zero.

    Args:
        matrix: (k, k).
    """
    rows = [list(row) for row in matrix]
    for k in range(len(rows)):
        inverse = 1.0 / rows[k][k]
        rows[k][k] = inverse
        below = (x for x in rows[k + 1 :] if isinstance(x[k], SymbolicExpression) or x[k] != 0)
        for row in below:
            row[k] = factor = row[k] * inverse
            row[k + 1 :] = [
                entry - factor * pivot
                for entry, pivot in zip(row[k + 1 :], rows[k][k + 1 :], strict=True)
            ]
    return rows


def lu_solve(factors: Sequence[Sequence[Scalar]], right: Sequence[Scalar]) -> list[Scalar]:
    """Solution x of A x = b, from `lu_factorize` of A."""
    x = list(right)
    size = len(x)
    for i in range(size):
        for j in range(i):
            x[i] = x[i] - factors[i][j] * x[j]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            x[i] = x[i] - factors[i][j] * x[j]
        x[i] = x[i] * factors[i][i]
    return x


def symbolic_entries(matrix: Sequence[Sequence[Scalar]]) -> list[Scalar]:
    """The entries that are not constant, row by row."""
    return [entry for row in matrix for entry in row if isinstance(entry, SymbolicExpression)]


def load_matrix(matrix: Sequence[Sequence[Scalar]], tape: Tape, array: int, start: int) -> Matrix:
    """The same matrix, with `symbolic_entries` loaded from an argument of a function."""
    indices = itertools.count(start)

    def read(entry: Scalar) -> Scalar:
        return tape.load(array, next(indices)) if isinstance(entry, SymbolicExpression) else entry

    return [[read(entry) for entry in row] for row in matrix]
