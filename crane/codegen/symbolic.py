"""Symbolic expressions: numbers that record how they were computed.

Python code that computes with `SymbolicExpression`s instead of floats records a tape of
operations. Values that are known while tracing are folded: 0 and 1 disappear, equal operations are
recorded once. General algorithms, traced for one machine, become the formulas of that machine; in
those of vectors and matrices structural zeros cause no operations.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Union

Scalar = Union["SymbolicExpression", float]


class Tape:
    """Operations in the order of their first use.

    Attributes:
        operations: Tuples (name, operand, ...); an operand is the index of an operation or, as a
            float, a constant. ("load", array, index) reads an argument.
    """

    def __init__(self) -> None:
        self.operations: list[tuple] = []
        self._known_operations: dict[tuple[object, ...], int] = {}

    def record(self, *operation: object) -> "SymbolicExpression":
        """The expression of an operation, which is only recorded once."""
        # in Python the constant 2.0 equals the operation index 2
        key = (*operation, *(type(operand) is float for operand in operation))
        index = self._known_operations.get(key)
        if index is None:
            index = self._known_operations[key] = len(self.operations)
            self.operations.append(operation)
        return SymbolicExpression(self, index)

    def load(self, array: int, index: int) -> "SymbolicExpression":
        """Element of an argument."""
        return self.record("load", array, index)

    def load_vector(self, array: int, start: int, count: int) -> list[Scalar]:
        """Consecutive elements of an argument."""
        return [self.load(array, start + i) for i in range(count)]


class SymbolicExpression:
    """A value on a tape."""

    __slots__ = ("index", "tape")

    def __init__(self, tape: Tape, index: int):
        self.tape, self.index = tape, index

    def __bool__(self) -> bool:
        raise TypeError("a formula is neither true nor false, choose with where_positive")

    def __add__(self, other: Scalar) -> Scalar:
        if not isinstance(other, SymbolicExpression) and other == 0:
            return self
        return self._commutative("add", other)

    __radd__ = __add__

    def __sub__(self, other: Scalar) -> Scalar:
        if not isinstance(other, SymbolicExpression):
            return self + (-other)
        if other.index == self.index:
            return 0.0
        return self.tape.record("subtract", self.index, other.index)

    def __rsub__(self, other: float) -> Scalar:
        return -self if other == 0 else self.tape.record("subtract", float(other), self.index)

    def __mul__(self, other: Scalar) -> Scalar:
        if not isinstance(other, SymbolicExpression):
            if other == 0:
                return 0.0
            if abs(other) == 1:
                return self if other == 1 else -self
        return self._commutative("multiply", other)

    __rmul__ = __mul__

    def __truediv__(self, other: Scalar) -> Scalar:
        if not isinstance(other, SymbolicExpression):
            return self * (1.0 / other)
        return self.tape.record("divide", self.index, other.index)

    def __rtruediv__(self, other: float) -> Scalar:
        return 0.0 if other == 0 else self.tape.record("divide", float(other), self.index)

    def __neg__(self) -> "SymbolicExpression":
        operation = self.tape.operations[self.index]
        if operation[0] == "negate":
            return SymbolicExpression(self.tape, operation[1])
        return self.tape.record("negate", self.index)

    def _commutative(self, name: str, other: Scalar) -> "SymbolicExpression":
        if not isinstance(other, SymbolicExpression):
            return self.tape.record(name, self.index, float(other))
        return self.tape.record(name, *sorted((self.index, other.index)))


def _operand(value: Scalar) -> int | float:
    return value.index if isinstance(value, SymbolicExpression) else float(value)


def required_operations(outputs: Sequence[Scalar]) -> list[int]:
    """Indices of the operations that the outputs depend on, in order."""
    found: set[int] = set()
    symbolic_outputs = [value for value in outputs if isinstance(value, SymbolicExpression)]
    operations = symbolic_outputs[0].tape.operations if symbolic_outputs else []
    indices = [value.index for value in symbolic_outputs]
    while indices:
        index = indices.pop()
        if index in found:
            continue
        found.add(index)
        kind, *operands = operations[index]
        if kind != "load":
            indices += [operand for operand in operands if type(operand) is int]
    return sorted(found)


def apply_function(function: str, x: Scalar) -> Scalar:
    """One of sin, cos, exp, log, tanh, sqrt, abs."""
    if isinstance(x, SymbolicExpression):
        return x.tape.record(function, x.index)
    return abs(x) if function == "abs" else float(getattr(math, function)(x))


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """The larger of two; NaN if one is NaN."""
    if isinstance(a, SymbolicExpression):
        return a.tape.record("maximum", a.index, _operand(b))
    if isinstance(b, SymbolicExpression):
        return maximum(b, a)
    return math.nan if a != a or b != b else max(a, b)


def minimum(first: Scalar, *others: Scalar) -> Scalar:
    """The smallest value; NaN if one is NaN."""
    for other in others:
        first = -maximum(-first, -other)
    return first


def where_positive(x: Scalar, if_positive: Scalar, otherwise: Scalar) -> Scalar:
    """`if_positive` where x > 0, else `otherwise`."""
    if not isinstance(x, SymbolicExpression):
        return if_positive if x > 0 else otherwise
    return x.tape.record("positive", x.index, _operand(if_positive), _operand(otherwise))


def max_abs(values: Iterable[Scalar]) -> Scalar:
    """The largest absolute value, 0 of an empty sequence."""
    out: Scalar = 0.0
    for value in values:
        out = maximum(out, apply_function("abs", value))
    return out


def copysign(magnitude: Scalar, sign: Scalar) -> Scalar:
    """|magnitude| with the sign of `sign`."""
    if not isinstance(sign, SymbolicExpression):
        return math.copysign(1.0, sign) * apply_function("abs", magnitude)
    return sign.tape.record("copysign", _operand(magnitude), sign.index)


def sum_scalars(values: Iterable[Scalar]) -> Scalar:
    """Sum of values."""
    total: Scalar = 0.0
    for value in values:
        total = total + value
    return total


def dot(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    """Dot product of two vectors."""
    total: Scalar = 0.0
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total


def cross(a: Sequence[Scalar], b: Sequence[Scalar]) -> list[Scalar]:
    """Cross product of two vectors (3,)."""
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def add_vectors(*vectors: Sequence[Scalar]) -> list[Scalar]:
    """Sum of vectors."""
    out = list(vectors[0])
    for vector in vectors[1:]:
        out = [x + y for x, y in zip(out, vector, strict=True)]
    return out


def scale_vector(factor: Scalar, vector: Sequence[Scalar]) -> list[Scalar]:
    """A factor times a vector."""
    return [factor * x for x in vector]


def subtract_vectors(a: Sequence[Scalar], b: Sequence[Scalar]) -> list[Scalar]:
    """Difference of two vectors."""
    return [x - y for x, y in zip(a, b, strict=True)]


def matvec(matrix: Sequence[Sequence[Scalar]], vector: Sequence[Scalar]) -> list[Scalar]:
    """Matrix times vector."""
    return [dot(row, vector) for row in matrix]


def transpose(matrix: Sequence[Sequence[Scalar]]) -> list[list[Scalar]]:
    """Transpose of a matrix."""
    return [list(column) for column in zip(*matrix, strict=True)]


def matmul(a: Sequence[Sequence[Scalar]], b: Sequence[Sequence[Scalar]]) -> list[list[Scalar]]:
    """Matrix times matrix."""
    columns = list(zip(*b, strict=True))
    return [[dot(row, column) for column in columns] for row in a]


def dot_products(vector: Sequence[Scalar], others: Sequence[Sequence[Scalar]]) -> list[Scalar]:
    """Dot products of one vector with several, which machine code computes together.

    Each symbolic one is a single operation, ("dot", *vector, *other).
    """
    nonzero = [i for i, x in enumerate(vector) if isinstance(x, SymbolicExpression) or x != 0]
    first = [vector[i] for i in nonzero]
    out: list[Scalar] = []
    for other in others:
        second = [other[i] for i in nonzero]
        found = [x for x in (*first, *second) if isinstance(x, SymbolicExpression)]
        if not found or all(not isinstance(x, SymbolicExpression) and x == 0 for x in second):
            out.append(dot(first, second))
            continue
        out.append(found[0].tape.record("dot", *map(_operand, (*first, *second))))
    return out
