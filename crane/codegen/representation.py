"""Formulas, which go straight on, and routines: loops, conditions that stop, own arrays.

Nothing here is written in a machine's language; an emitter translates.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from crane.codegen.layout import Layout
from crane.codegen.scalar import Number

Kind = Literal["real", "integer", "truth"]
ArgumentKind = Literal["count", "function", "array"]


@dataclass(frozen=True, eq=False)
class Value:
    """A number or a truth that a routine computes, evaluated where a statement uses it.

    Comparisons are false where a number is NaN; `~` turns them round.

    Attributes:
        kind: What it is.
        operation: "constant", "variable", "argument", "element", "select", or an operator.
        operands: Values, an `Array` and an index, a number or a name.
    """

    kind: Kind
    operation: str
    operands: tuple

    @property
    def _zero(self) -> bool:
        return self.kind == "integer" and self.operation == "constant" and not self.operands[0]

    def __add__(self, other: "Operand") -> "Value":
        return self._arithmetic("+", other)

    def __sub__(self, other: "Operand") -> "Value":
        return self._arithmetic("-", other)

    def __mul__(self, other: "Operand") -> "Value":
        return self._arithmetic("*", other)

    def __truediv__(self, other: "Operand") -> "Value":
        return self._arithmetic("/", other)

    def __lt__(self, other: "Operand") -> "Value":
        return self._comparison("<", other)

    def __le__(self, other: "Operand") -> "Value":
        return self._comparison("<=", other)

    def __gt__(self, other: "Operand") -> "Value":
        return self._comparison(">", other)

    def __ge__(self, other: "Operand") -> "Value":
        return self._comparison(">=", other)

    def __and__(self, other: "Value") -> "Value":
        return Value("truth", "and", (self, other))

    def __or__(self, other: "Value") -> "Value":
        return Value("truth", "or", (self, other))

    def __invert__(self) -> "Value":
        return Value("truth", "not", (self,))

    def _arithmetic(self, operator: str, other: "Operand") -> "Value":
        second = constant(other, self.kind)
        if self.kind == "integer" and self.operation == second.operation == "constant":
            a, b = self.operands[0], second.operands[0]
            return constant({"+": a + b, "-": a - b, "*": a * b}[operator], "integer")
        if operator == "+" and self._zero:
            return second
        return Value(self.kind, operator, (self, second))

    def _comparison(self, operator: str, other: "Operand") -> "Value":
        return Value("truth", operator, (self, constant(other, self.kind)))


Operand = Value | float | int


def constant(value: Operand, kind: Kind) -> Value:
    """A number of this kind."""
    if isinstance(value, Value):
        if value.kind != kind:
            raise TypeError(f"{value.kind} where {kind} is needed")
        return value
    return Value(kind, "constant", (float(value) if kind == "real" else int(value),))


def select(test: Value, yes: Operand, no: Operand) -> Value:
    """One of two numbers."""
    return Value("real", "select", (test, constant(yes, "real"), constant(no, "real")))


@dataclass(frozen=True, eq=False)
class Array:
    """Numbers in memory, from some element of an argument or of a routine's own array on.

    Attributes:
        name: Of the argument or the own array.
        offset: Elements before the first one.
        layout: Its parts, where they have names.
    """

    name: str
    offset: Value = field(default_factory=lambda: constant(0, "integer"))
    layout: Layout | None = None

    def __getitem__(self, index: "int | Value | str") -> Value:
        """An element, or the first one of a part."""
        return Value("real", "element", (self, self._index(index)))

    def at(self, index: "int | Value | str", layout: Layout | None = None) -> "Array":
        """What begins at an element or a part."""
        return Array(self.name, self.offset + self._index(index), layout)

    def row(self, index: "int | Value", width: int, layout: Layout | None = None) -> "Array":
        """One of many rows."""
        return self.at(constant(index, "integer") * width, layout)

    def _index(self, index: "int | Value | str") -> Value:
        if isinstance(index, str):
            assert self.layout is not None
            index = self.layout.start(index)
        return constant(index, "integer")


@dataclass(frozen=True)
class Function:
    """A function that is an argument of a routine."""

    name: str


@dataclass(frozen=True)
class Assign:
    """variable = value."""

    variable: Value
    value: Value


@dataclass(frozen=True)
class Store:
    """array[0] = value."""

    target: Array
    value: Value


@dataclass(frozen=True)
class Copy:
    """Some elements from one array to another; they do not overlap."""

    target: Array
    source: Array
    count: int


@dataclass(frozen=True)
class Call:
    """A formula, a routine, or a function that is an argument; `variable` takes its answer."""

    function: str
    arguments: tuple["Value | Array | Function", ...]
    variable: Value | None


@dataclass(frozen=True)
class Loop:
    """Without end, or `variable` from 0 to below `count`."""

    body: list["Statement"]
    variable: Value | None = None
    count: Value | None = None


@dataclass(frozen=True)
class When:
    """One of two sequences."""

    test: Value
    yes: list["Statement"]
    no: list["Statement"]


@dataclass(frozen=True)
class Leave:
    """Go on behind the innermost loop."""


@dataclass(frozen=True)
class Give:
    """Return an integer."""

    value: Value


Statement = Assign | Store | Copy | Call | Loop | When | Leave | Give


@dataclass(frozen=True, eq=False)
class Formula:
    """f(in_0, in_1, ..., out), straight on.

    Attributes:
        name: Its name.
        arrays: Number of arguments that are read.
        outputs: What it writes, (m,).
        layout: The outputs' parts.
    """

    name: str
    arrays: int
    outputs: Sequence[Number]
    layout: Layout

    @property
    def kinds(self) -> tuple[ArgumentKind, ...]:
        """Of the arguments."""
        return tuple("array" for _ in range(self.arrays + 1))


class Routine:
    """f(counts, functions, arrays) -> integer, built by its methods; see the module's text.

    The arguments are attributes. Arrays of its own (`array`) hold nothing at first and are gone
    when it returns, so any number of threads may be in it.

    Attributes:
        name: Its name.
        counts: Names of arguments that are integers.
        functions: Names of arguments that are functions.
        arrays: Names of arguments that are arrays.
        own: Length of each array of its own.
        body: Statements.
        variables: Values whose operation is "variable".
    """

    def __init__(
        self,
        name: str,
        callees: Mapping[str, "Formula | Routine"],
        counts: Sequence[str],
        functions: Sequence[str],
        arrays: Mapping[str, Layout | None],
    ):
        self.name, self._callees = name, callees
        self.counts, self.functions, self.arrays = tuple(counts), tuple(functions), tuple(arrays)
        self.own: dict[str, int] = {}
        self.body: list[Statement] = []
        self.variables: list[Value] = []
        self._open = [self.body]
        self._arguments: dict[str, Value | Array | Function] = {
            **{function: Function(function) for function in functions},
            **{count: Value("integer", "argument", (count,)) for count in counts},
            **{array: Array(array, layout=layout) for array, layout in arrays.items()},
        }

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["_arguments"][name]
        except KeyError:
            raise AttributeError(f"'{self.name}' has no argument '{name}'") from None

    @property
    def kinds(self) -> tuple[ArgumentKind, ...]:
        """Of the arguments, in their order."""
        kinds: list[ArgumentKind] = ["count" for _ in self.counts]
        kinds += ["function" for _ in self.functions]
        kinds += ["array" for _ in self.arrays]
        return tuple(kinds)

    def array(self, name: str, layout: Layout | int) -> Array:
        """An array of its own."""
        size = layout if isinstance(layout, int) else layout.size
        if name in self.own or name in self._arguments:
            raise ValueError(f"'{self.name}' has two arrays '{name}'")
        self.own[name] = size
        return Array(name, layout=layout if isinstance(layout, Layout) else None)

    def let(self, value: Operand) -> Value:
        """A variable with the value that something has now, an integer if it is an int."""
        kind: Kind = "integer" if isinstance(value, int) else "real"
        value = constant(value, value.kind if isinstance(value, Value) else kind)
        variable = self._variable(value.kind)
        self.set(variable, value)
        return variable

    def set(self, variable: Value, value: Operand) -> None:
        """Give a variable another value."""
        self._add(Assign(variable, constant(value, variable.kind)))

    def store(self, array: Array, index: int | Value | str, value: Operand) -> None:
        """array[index] = value."""
        self._add(Store(array.at(index), constant(value, "real")))

    def copy(self, target: Array, source: Array, count: int) -> None:
        """target[:count] = source[:count]."""
        self._add(Copy(target, source, count))

    def call(self, function: str, *arguments: "Value | Array | Function | int") -> Value:
        """Call a formula, an earlier routine, or a function argument; the integer it returns."""
        ready = tuple(constant(x, "integer") if isinstance(x, int) else x for x in arguments)
        callee = self._callees.get(function)
        if callee is None and function not in self.functions:
            raise ValueError(f"'{self.name}' calls '{function}', which is not there yet")
        if callee is not None and len(ready) != len(callee.kinds):
            raise ValueError(f"'{function}' takes {len(callee.kinds)} arguments")
        if isinstance(callee, Formula):
            self._add(Call(function, ready, None))
            return constant(0, "integer")
        answer = self._variable("integer")
        self._add(Call(function, ready, answer))
        return answer

    @contextmanager
    def loop(self, count: Value) -> Iterator[Value]:
        """The statements inside for an index from 0 to below a count."""
        variable = self._variable("integer")
        loop = Loop([], variable, count)
        self._add(loop)
        with self._inside(loop.body):
            yield variable

    @contextmanager
    def forever(self) -> Iterator[None]:
        """The statements inside until one of them leaves."""
        loop = Loop([])
        self._add(loop)
        with self._inside(loop.body):
            yield

    @contextmanager
    def when(self, test: Value) -> Iterator[None]:
        """The statements inside where something is true."""
        when = When(test, [], [])
        self._add(when)
        with self._inside(when.yes):
            yield

    @contextmanager
    def otherwise(self) -> Iterator[None]:
        """The statements inside where the test of the `when` before them is not true."""
        when = self._open[-1][-1]
        assert isinstance(when, When)
        with self._inside(when.no):
            yield

    def leave(self) -> None:
        """Go on behind the innermost loop."""
        self._add(Leave())

    def give(self, value: Operand) -> None:
        """Return."""
        self._add(Give(constant(value, "integer")))

    def _variable(self, kind: Kind) -> Value:
        variable = Value(kind, "variable", (f"x{len(self.variables)}",))
        self.variables.append(variable)
        return variable

    def _add(self, statement: Statement) -> None:
        self._open[-1].append(statement)

    @contextmanager
    def _inside(self, body: list[Statement]) -> Iterator[None]:
        self._open.append(body)
        yield
        self._open.pop()
