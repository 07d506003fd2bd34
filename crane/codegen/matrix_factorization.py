"""Matrix factorizations as symbolic formulas; structural zeros cause no operations."""

import itertools
from collections.abc import Sequence

from crane.codegen.symbolic import Scalar, SymbolicExpression, Tape, dot

Matrix = list[list[Scalar]]


class LdltFactorization:
    """Factorization L D L^T of a symmetric positive definite matrix, with unit diagonal of L.

    Args:
        matrix: (k, k), of which the lower half is read.

    Attributes:
        inverse_diagonal: (k,) inverse of D.
    """

    def __init__(self, matrix: Sequence[Sequence[Scalar]]):
        size = len(matrix)
        self._unit_lower: Matrix = [[0.0] * size for _ in range(size)]
        self.inverse_diagonal: list[Scalar] = []
        for j in range(size):
            scaled: list[Scalar] = []
            for k in range(j):
                scaled.append(matrix[j][k] - dot(scaled, self._unit_lower[k][:k]))
            self._unit_lower[j][:j] = [
                x * d for x, d in zip(scaled, self.inverse_diagonal, strict=True)
            ]
            self.inverse_diagonal.append(
                1.0 / (matrix[j][j] - dot(scaled, self._unit_lower[j][:j]))
            )

    def forward_substitute(self, right: Sequence[Scalar]) -> list[Scalar]:
        """L^-1 b."""
        x: list[Scalar] = []
        for row, value in zip(self._unit_lower, right, strict=True):
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
        for row in rows[k + 1 :]:
            if not isinstance(row[k], SymbolicExpression) and row[k] == 0:
                continue
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
