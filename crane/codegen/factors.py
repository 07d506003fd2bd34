"""Sparse elimination as formulas: what is zero while tracing never becomes an operation."""

import itertools
from collections.abc import Sequence

from crane.codegen.scalar import Expression, Number, Tape, dot

Matrix = list[list[Number]]


class Positive:
    """A symmetric positive definite matrix as L D L^T, L with ones on its diagonal.

    Args:
        matrix: (k, k), of which the lower half is read.

    Attributes:
        inverse: (k,) one over the diagonal of D.
    """

    def __init__(self, matrix: Sequence[Sequence[Number]]):
        size = len(matrix)
        self._lower: Matrix = [[0.0] * size for _ in range(size)]
        self.inverse: list[Number] = []
        for j in range(size):
            scaled: list[Number] = []
            for k in range(j):
                scaled.append(matrix[j][k] - dot(scaled, self._lower[k][:k]))
            self._lower[j][:j] = [x * d for x, d in zip(scaled, self.inverse, strict=True)]
            self.inverse.append(1.0 / (matrix[j][j] - dot(scaled, self._lower[j][:j])))

    def halved(self, right: Sequence[Number]) -> list[Number]:
        """L^-1 b."""
        x: list[Number] = []
        for row, value in zip(self._lower, right, strict=True):
            x.append(value - dot(row[: len(x)], x))
        return x

    @property
    def inverted(self) -> Matrix:
        """A^-1 = L^-T D^-1 L^-1."""
        size = len(self._lower)
        columns = [self.halved([float(i == k) for i in range(size)]) for k in range(size)]
        out: Matrix = [[0.0] * size for _ in range(size)]
        for k, column in enumerate(columns):
            weighed = [x * d for x, d in zip(column, self.inverse, strict=True)]
            for j in range(k + 1):
                out[j][k] = out[k][j] = dot(weighed[k:], columns[j][k:])
        return out

    def solve(self, right: Sequence[Number]) -> list[Number]:
        """A^-1 b."""
        x = [value * d for value, d in zip(self.halved(right), self.inverse, strict=True)]
        for j in range(len(x) - 1, -1, -1):
            x[j] = x[j] - dot([row[j] for row in self._lower[j + 1 :]], x[j + 1 :])
        return x


def eliminated(matrix: Sequence[Sequence[Number]]) -> Matrix:
    """L and U of a matrix in one, by elimination without pivoting.

    The diagonal holds one over that of U; L has ones there. The order of the rows is the user's
    business: pivots must stay away from zero.

    Args:
        matrix: (k, k).
    """
    rows = [list(row) for row in matrix]
    size = len(rows)
    for k in range(size):
        inverse = 1.0 / rows[k][k]
        rows[k][k] = inverse
        for row in rows[k + 1 :]:
            if not isinstance(row[k], Expression) and row[k] == 0:
                continue
            row[k] = factor = row[k] * inverse
            below = zip(row[k + 1 :], rows[k][k + 1 :], strict=True)
            row[k + 1 :] = [entry - factor * pivot for entry, pivot in below]
    return rows


def substituted(factors: Sequence[Sequence[Number]], right: Sequence[Number]) -> list[Number]:
    """Solution x of A x = b, given `eliminated` of A."""
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


def stored(matrix: Sequence[Sequence[Number]]) -> list[Number]:
    """The entries that are no constants, row by row."""
    return [entry for row in matrix for entry in row if isinstance(entry, Expression)]


def loaded(matrix: Sequence[Sequence[Number]], tape: Tape, array: int, start: int) -> Matrix:
    """The same matrix, its `stored` entries read from an argument of another function."""
    places = itertools.count(start)

    def read(entry: Number) -> Number:
        return tape.load(array, next(places)) if isinstance(entry, Expression) else entry

    return [[read(entry) for entry in row] for row in matrix]
