"""Sparse elimination as formulas: what is zero while tracing never becomes an operation."""

from collections.abc import Sequence

from crane.codegen.scalar import Expression, Number, Tape

Matrix = list[list[Number]]


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
        for i in range(k + 1, size):
            if isinstance(rows[i][k], Expression) or rows[i][k] != 0:
                factor = rows[i][k] * inverse
                rows[i][k] = factor
                for j in range(k + 1, size):
                    rows[i][j] = rows[i][j] - factor * rows[k][j]
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
    count = start
    out: Matrix = []
    for row in matrix:
        out.append([])
        for entry in row:
            if isinstance(entry, Expression):
                out[-1].append(tape.load(array, count))
                count += 1
            else:
                out[-1].append(entry)
    return out
