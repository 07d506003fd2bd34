"""Numbers that remember how they were computed.

Python code that computes with `Expression`s instead of floats leaves a tape of operations.
What is known while tracing is folded: 0 and 1 disappear, equal operations are done once. So the
general algorithms, traced for one machine, become that machine's own formulas.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Union

Number = Union["Expression", float]


class Tape:
    """Operations in the order of their first use.

    Attributes:
        operations: Tuples (name, operand, ...); an operand is the index of an operation or, as a
            float, a constant. ("load", array, index) reads an argument.
    """

    def __init__(self) -> None:
        self.operations: list[tuple] = []
        self._index: dict[tuple[object, ...], int] = {}

    def add(self, *operation: object) -> "Expression":
        """The expression of an operation, the old one if it is there already."""
        # the constant 2.0 and operation number 2 are equal to Python
        key = (*operation, *(type(operand) is float for operand in operation))
        index = self._index.get(key)
        if index is None:
            index = self._index[key] = len(self.operations)
            self.operations.append(operation)
        return Expression(self, index)

    def load(self, array: int, index: int) -> "Expression":
        """Element of an argument."""
        return self.add("load", array, index)

    def loads(self, array: int, start: int, count: int) -> list[Number]:
        """Consecutive elements of an argument."""
        return [self.load(array, start + i) for i in range(count)]


class Expression:
    """One value on a tape."""

    __slots__ = ("index", "tape")

    def __init__(self, tape: Tape, index: int):
        self.tape, self.index = tape, index

    def __bool__(self) -> bool:
        raise TypeError("a formula is neither true nor false, choose with where_positive")

    def __add__(self, other: Number) -> Number:
        if not isinstance(other, Expression) and other == 0:
            return self
        return self._symmetric("add", other)

    __radd__ = __add__

    def __sub__(self, other: Number) -> Number:
        if not isinstance(other, Expression):
            return self + (-other)
        if other.index == self.index:
            return 0.0
        return self.tape.add("subtract", self.index, other.index)

    def __rsub__(self, other: float) -> Number:
        return -self if other == 0 else self.tape.add("subtract", float(other), self.index)

    def __mul__(self, other: Number) -> Number:
        if not isinstance(other, Expression):
            if other == 0:
                return 0.0
            if abs(other) == 1:
                return self if other == 1 else -self
        return self._symmetric("multiply", other)

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Number:
        if not isinstance(other, Expression):
            return self * (1.0 / other)
        return self.tape.add("divide", self.index, other.index)

    def __rtruediv__(self, other: float) -> Number:
        return 0.0 if other == 0 else self.tape.add("divide", float(other), self.index)

    def __neg__(self) -> "Expression":
        operation = self.tape.operations[self.index]
        if operation[0] == "negate":
            return Expression(self.tape, operation[1])
        return self.tape.add("negate", self.index)

    def _symmetric(self, name: str, other: Number) -> "Expression":
        if not isinstance(other, Expression):
            return self.tape.add(name, self.index, float(other))
        return self.tape.add(name, *sorted((self.index, other.index)))


def needed(outputs: Sequence[Number]) -> list[int]:
    """Indices of the operations that the outputs depend on, in order."""
    found: set[int] = set()
    waiting = [value for value in outputs if isinstance(value, Expression)]
    operations = waiting[0].tape.operations if waiting else []
    indices = [value.index for value in waiting]
    while indices:
        index = indices.pop()
        if index in found:
            continue
        found.add(index)
        kind, *operands = operations[index]
        if kind != "load":
            indices += [operand for operand in operands if type(operand) is int]
    return sorted(found)


def apply(function: str, x: Number) -> Number:
    """One of sin, cos, exp, log, tanh, sqrt, abs."""
    if isinstance(x, Expression):
        return x.tape.add(function, x.index)
    return abs(x) if function == "abs" else float(getattr(math, function)(x))


def maximum(a: Number, b: Number) -> Number:
    """The larger of two; NaN wins, so that it cannot hide."""
    if isinstance(a, Expression):
        return a.tape.add("maximum", a.index, b.index if isinstance(b, Expression) else float(b))
    if isinstance(b, Expression):
        return maximum(b, a)
    return math.nan if a != a or b != b else max(a, b)


def minimum(a: Number, b: Number) -> Number:
    """The smaller of two; NaN wins."""
    return -maximum(-a, -b)


def where_positive(x: Number, yes: Number, no: Number) -> Number:
    """One number where x > 0, another elsewhere."""
    if not isinstance(x, Expression):
        return yes if x > 0 else no
    words = (y.index if isinstance(y, Expression) else float(y) for y in (yes, no))
    return x.tape.add("positive", x.index, *words)


def largest(values: Iterable[Number]) -> Number:
    """The largest absolute value, 0 of none."""
    out: Number = 0.0
    for value in values:
        out = maximum(out, apply("abs", value))
    return out


def with_sign_of(magnitude: Number, sign: Number) -> Number:
    """|magnitude| with another's sign."""
    if not isinstance(sign, Expression):
        return math.copysign(1.0, sign) * apply("abs", magnitude)
    first = magnitude.index if isinstance(magnitude, Expression) else float(magnitude)
    return sign.tape.add("copysign", first, sign.index)


def dot(a: Sequence[Number], b: Sequence[Number]) -> Number:
    """Dot product of two vectors."""
    total: Number = 0.0
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total


def cross(a: Sequence[Number], b: Sequence[Number]) -> list[Number]:
    """Cross product of two vectors (3,)."""
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def add(*vectors: Sequence[Number]) -> list[Number]:
    """Sum of vectors."""
    out = list(vectors[0])
    for vector in vectors[1:]:
        out = [x + y for x, y in zip(out, vector, strict=True)]
    return out


def scale(factor: Number, vector: Sequence[Number]) -> list[Number]:
    """A factor times a vector."""
    return [factor * x for x in vector]


def subtract(a: Sequence[Number], b: Sequence[Number]) -> list[Number]:
    """Difference of two vectors."""
    return [x - y for x, y in zip(a, b, strict=True)]


def times(matrix: Sequence[Sequence[Number]], vector: Sequence[Number]) -> list[Number]:
    """Matrix times vector."""
    return [dot(row, vector) for row in matrix]


def transposed(matrix: Sequence[Sequence[Number]]) -> list[list[Number]]:
    """Rows as columns."""
    return [list(column) for column in zip(*matrix, strict=True)]


def product(a: Sequence[Sequence[Number]], b: Sequence[Sequence[Number]]) -> list[list[Number]]:
    """Matrix times matrix."""
    columns = list(zip(*b, strict=True))
    return [[dot(row, column) for column in columns] for row in a]


def dots(vector: Sequence[Number], others: Sequence[Sequence[Number]]) -> list[Number]:
    """Dot products of one vector with several, which machine code takes at once.

    Each is one operation, ("dot", *vector, *other). What is not a formula is not worth one.
    """
    kept = [i for i, x in enumerate(vector) if isinstance(x, Expression) or x != 0]
    first = [vector[i] for i in kept]
    out: list[Number] = []
    for other in others:
        second = [other[i] for i in kept]
        found = [x for x in (*first, *second) if isinstance(x, Expression)]
        if not found or all(not isinstance(x, Expression) and x == 0 for x in second):
            out.append(dot(first, second))
            continue
        words = (x.index if isinstance(x, Expression) else float(x) for x in (*first, *second))
        out.append(found[0].tape.add("dot", *words))
    return out


def solve(
    matrix: Sequence[Sequence[Number]], right: Sequence[Sequence[Number]]
) -> tuple[list[list[Number]], Number]:
    """Solve A X = B without branches: Cramer's rule to order 2, else Householder reflections.

    Reflections need no pivoting.

    Args:
        matrix: (k, k).
        right: (k, columns).

    Returns:
        X (k, columns), and the determinant of A.
    """
    size = len(matrix)
    if size == 1:
        inverse = 1.0 / matrix[0][0]
        return [[x * inverse for x in right[0]]], matrix[0][0]
    if size == 2:
        (a, b), (c, d) = matrix
        determinant = a * d - b * c
        inverse = 1.0 / determinant
        top = [(d * x - b * y) * inverse for x, y in zip(*right, strict=True)]
        bottom = [(a * y - c * x) * inverse for x, y in zip(*right, strict=True)]
        return [top, bottom], determinant
    rows = [[*row, *more] for row, more in zip(matrix, right, strict=True)]
    determinant = 1.0
    diagonal: list[Number] = []
    for k in range(size):
        column = [rows[i][k] for i in range(k, size)]
        below = dot(column[1:], column[1:])
        if not isinstance(below, Expression) and below == 0:  # nothing below: no reflection
            diagonal.append(column[0])
            determinant = determinant * column[0]
            continue
        length = apply("sqrt", column[0] * column[0] + below)
        if isinstance(column[0], Expression):
            length = with_sign_of(length, column[0])
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
        determinant = determinant * length  # -length on the diagonal, and -1 of the reflection
    width = len(right[0])
    out: list[list[Number]] = [[0.0] * width for _ in range(size)]
    for k in range(size - 1, -1, -1):
        inverse = 1.0 / diagonal[k]
        for j in range(width):
            total = rows[k][size + j]
            for i in range(k + 1, size):
                total = total - rows[k][i] * out[i][j]
            out[k][j] = total * inverse
    return out, determinant
