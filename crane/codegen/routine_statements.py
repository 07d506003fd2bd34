"""Routines: functions with loops and conditions around formulas, as statements.

A routine is built by calls of its methods, which record statements; `crane.codegen.llvm` and the
other targets write them in their languages.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partialmethod
from typing import Any, Literal

from crane.codegen.vector_layout import ArgumentKind, Formula, Layout

ValueKind = Literal["real", "integer", "truth"]


@dataclass(frozen=True, eq=False)
class RoutineValue:
    """A value that a routine computes where a statement uses it.

    Comparisons with NaN are false; `~` inverts them.

    Attributes:
        kind: Type of the value.
        operation: "constant", "variable", "argument", "element", "select", or an operator.
        operands: Values, an `ArrayPointer` and an index, a number or a name.
    """

    kind: ValueKind
    operation: str
    operands: tuple

    def _arithmetic_operation(self, operator: str, other: "Operand") -> "RoutineValue":
        second = as_value(other, self.kind)
        if self.kind == "integer" and self.operation == "constant":
            a, b = self.operands[0], second.operands[0]
            if second.operation == "constant":
                return as_value({"+": a + b, "-": a - b, "*": a * b}[operator], "integer")
            if operator == "+" and a == 0:
                return second
        return RoutineValue(self.kind, operator, (self, second))

    def _comparison_operation(self, operator: str, other: "Operand") -> "RoutineValue":
        return RoutineValue("truth", operator, (self, as_value(other, self.kind)))

    __add__ = partialmethod(_arithmetic_operation, "+")
    __sub__ = partialmethod(_arithmetic_operation, "-")
    __mul__ = partialmethod(_arithmetic_operation, "*")
    __truediv__ = partialmethod(_arithmetic_operation, "/")
    __lt__ = partialmethod(_comparison_operation, "<")
    __le__ = partialmethod(_comparison_operation, "<=")
    __gt__ = partialmethod(_comparison_operation, ">")
    __ge__ = partialmethod(_comparison_operation, ">=")

    def __and__(self, other: "RoutineValue") -> "RoutineValue":
        return RoutineValue("truth", "and", (self, other))

    def __or__(self, other: "RoutineValue") -> "RoutineValue":
        return RoutineValue("truth", "or", (self, other))

    def __invert__(self) -> "RoutineValue":
        return RoutineValue("truth", "not", (self,))


Operand = RoutineValue | float | int


def as_value(value: Operand, kind: ValueKind) -> RoutineValue:
    """A value of this kind."""
    if isinstance(value, RoutineValue):
        if value.kind != kind:
            raise TypeError(f"{value.kind} where {kind} is needed")
        return value
    return RoutineValue(kind, "constant", (float(value) if kind == "real" else int(value),))


def select(condition: RoutineValue, if_true: Operand, if_false: Operand) -> RoutineValue:
    """`if_true` where a condition holds, else `if_false`."""
    return RoutineValue(
        "real", "select", (condition, as_value(if_true, "real"), as_value(if_false, "real"))
    )


def magnitude(value: RoutineValue) -> RoutineValue:
    """Absolute value."""
    return select(value < 0.0, value * -1.0, value)


@dataclass(frozen=True, eq=False)
class ArrayPointer:
    """Position in an argument or local array of a routine, or a function argument.

    Attributes:
        name: Name of the argument or local array.
        offset: Index of the first element.
        layout: Names of its parts, if any.
    """

    name: str
    offset: RoutineValue = field(default_factory=lambda: as_value(0, "integer"))
    layout: Layout | None = None

    def __getitem__(self, index: "int | RoutineValue | str") -> RoutineValue:
        """An element, or the first one of a part."""
        return RoutineValue("real", "element", (self, self._element_index(index)))

    def element_pointer(self, index: "int | RoutineValue | str") -> "ArrayPointer":
        """Pointer to an element or a part."""
        return ArrayPointer(self.name, self.offset + self._element_index(index))

    def row_pointer(self, index: "int | RoutineValue", width: int) -> "ArrayPointer":
        """Pointer to a row."""
        return self.element_pointer(as_value(index, "integer") * width)

    def _element_index(self, index: "int | RoutineValue | str") -> RoutineValue:
        if isinstance(index, str):
            assert self.layout is not None
            index = self.layout.start_index(index)
        return as_value(index, "integer")


class RoutineStatement:
    """Base class of statements."""

    @property
    def reads(self) -> tuple[RoutineValue | ArrayPointer, ...]:
        """Values and arrays that it uses."""
        return ()

    @property
    def writes(self) -> ArrayPointer | None:
        """The array that it writes to by itself, if any."""
        return None

    @property
    def blocks(self) -> "tuple[list[RoutineStatement], ...]":
        """Statements within it."""
        return ()


@dataclass(frozen=True, eq=False)
class AssignmentStatement(RoutineStatement):
    """variable = value."""

    variable: RoutineValue
    value: RoutineValue

    @property
    def reads(self) -> tuple[RoutineValue | ArrayPointer, ...]:
        """See `RoutineStatement`."""
        return (self.value,)


@dataclass(frozen=True, eq=False)
class StoreStatement(RoutineStatement):
    """pointer[0] = value."""

    pointer: ArrayPointer
    value: RoutineValue

    @property
    def reads(self) -> tuple[RoutineValue | ArrayPointer, ...]:
        """See `RoutineStatement`."""
        return self.pointer, self.value

    @property
    def writes(self) -> ArrayPointer:
        """See `RoutineStatement`."""
        return self.pointer


@dataclass(frozen=True, eq=False)
class CopyStatement(RoutineStatement):
    """target[:count] = source[:count]."""

    target: ArrayPointer
    source: ArrayPointer
    count: int

    @property
    def reads(self) -> tuple[RoutineValue | ArrayPointer, ...]:
        """See `RoutineStatement`."""
        return self.target, self.source

    @property
    def writes(self) -> ArrayPointer:
        """See `RoutineStatement`."""
        return self.target


@dataclass(frozen=True, eq=False)
class CallStatement(RoutineStatement):
    """result = function(arguments); a formula has no result.

    Attributes:
        function: Name of a formula, a routine or a function argument.
        arguments: Arrays and integers.
        result: Variable of the returned integer.
        is_argument: Whether the function is an argument of the routine.
    """

    function: str
    arguments: tuple[RoutineValue | ArrayPointer, ...]
    result: RoutineValue | None
    is_argument: bool

    @property
    def reads(self) -> tuple[RoutineValue | ArrayPointer, ...]:
        """See `RoutineStatement`."""
        return self.arguments


@dataclass(frozen=True, eq=False)
class LoopStatement(RoutineStatement):
    """Statements for each index from 0 to count - 1, or without an end if there is no index."""

    index: RoutineValue | None
    count: RoutineValue | None
    body: list[RoutineStatement]

    @property
    def reads(self) -> tuple[RoutineValue | ArrayPointer, ...]:
        """See `RoutineStatement`."""
        return () if self.count is None else (self.count,)

    @property
    def blocks(self) -> tuple[list[RoutineStatement], ...]:
        """See `RoutineStatement`."""
        return (self.body,)


@dataclass(frozen=True, eq=False)
class ConditionStatement(RoutineStatement):
    """Statements for a true condition, and for a false one."""

    test: RoutineValue
    body: list[RoutineStatement]
    otherwise: list[RoutineStatement]

    @property
    def reads(self) -> tuple[RoutineValue | ArrayPointer, ...]:
        """See `RoutineStatement`."""
        return (self.test,)

    @property
    def blocks(self) -> tuple[list[RoutineStatement], ...]:
        """See `RoutineStatement`."""
        return self.body, self.otherwise


@dataclass(frozen=True, eq=False)
class BreakStatement(RoutineStatement):
    """End of the innermost loop."""


@dataclass(frozen=True, eq=False)
class ReturnStatement(RoutineStatement):
    """End of the routine."""

    value: RoutineValue

    @property
    def reads(self) -> tuple[RoutineValue | ArrayPointer, ...]:
        """See `RoutineStatement`."""
        return (self.value,)


class Routine:
    """f(counts, functions, arrays) -> integer, built by the methods below.

    The arguments are attributes. Local arrays (`local_array`) are uninitialized and live until it
    returns, so that any number of threads may execute it. It returns 0 where no statement returns.

    Args:
        name: Its name.
        callees: Formulas and routines that it may call, by name.
        counts: Names of the integer arguments.
        functions: Names of the function arguments.
        arrays: Names of the array arguments, with their layouts.

    Attributes:
        name: Its name.
        argument_kinds: Kinds of the arguments, in their order.
        arguments: Arguments by name, in their order.
        functions: Names of the function arguments.
        local_arrays: Lengths of local arrays by name.
        variables: Variables, in the order of their first use.
        statements: What it does.
    """

    def __init__(
        self,
        name: str,
        callees: Mapping[str, "Formula | Routine"],
        counts: Sequence[str],
        functions: Sequence[str],
        arrays: Mapping[str, Layout | None],
    ):
        self.name, self._callees, self.functions = name, callees, functions
        self.arguments: dict[str, RoutineValue | ArrayPointer] = {
            **{count: RoutineValue("integer", "argument", (count,)) for count in counts},
            **{function: ArrayPointer(function) for function in functions},
            **{array: ArrayPointer(array, layout=layout) for array, layout in arrays.items()},
        }
        self.argument_kinds: tuple[ArgumentKind, ...] = tuple(
            "count" if isinstance(x, RoutineValue) else "array" for x in self.arguments.values()
        )
        self.local_arrays: dict[str, int] = {}
        self.variables: list[RoutineValue] = []
        self.statements: list[RoutineStatement] = []
        self._blocks = [self.statements]  # the statements that are being built, innermost last

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["arguments"][name]
        except KeyError:
            raise AttributeError(f"'{self.name}' has no argument '{name}'") from None

    def local_array(self, name: str, layout: Layout | int) -> ArrayPointer:
        """Add a local array."""
        if name in self.local_arrays or name in self.arguments:
            raise ValueError(f"'{self.name}' has two arrays '{name}'")
        if isinstance(layout, int):
            layout = Layout(all=layout)
        self.local_arrays[name] = layout.size
        return ArrayPointer(name, layout=layout)

    def new_variable(self, value: Operand) -> RoutineValue:
        """Add a variable with an initial value; an integer variable if the value is an int."""
        kind: ValueKind = "integer" if isinstance(value, int) else "real"
        value = as_value(value, value.kind if isinstance(value, RoutineValue) else kind)
        variable = self._add_variable(value.kind)
        self.assign(variable, value)
        return variable

    def assign(self, variable: RoutineValue, value: Operand) -> None:
        """Assign a value to a variable."""
        self._add(AssignmentStatement(variable, as_value(value, variable.kind)))

    def store(self, array: ArrayPointer, index: int | RoutineValue | str, value: Operand) -> None:
        """array[index] = value."""
        self._add(StoreStatement(array.element_pointer(index), as_value(value, "real")))

    def copy(self, target: ArrayPointer, source: ArrayPointer, count: int) -> None:
        """target[:count] = source[:count], of arrays that do not overlap."""
        self._add(CopyStatement(target, source, count))

    def call(self, function: str, *arguments: RoutineValue | ArrayPointer | int) -> RoutineValue:
        """Call a formula, an earlier routine, or a function argument; returns its integer.

        Function arguments of the called routine are left out where they are linked.
        """
        callee = self._callees.get(function)
        if callee is None and function not in self.functions:
            raise ValueError(f"'{self.name}' calls '{function}', which is not there yet")
        if callee is not None:
            expected, linked = len(callee.argument_kinds), len(getattr(callee, "functions", ()))
            if len(arguments) not in (expected, expected - linked):
                raise ValueError(f"'{function}' takes {expected} arguments")
        result = None if isinstance(callee, Formula) else self._add_variable("integer")
        values = tuple(
            x if isinstance(x, ArrayPointer) else as_value(x, "integer") for x in arguments
        )
        self._add(CallStatement(function, values, result, callee is None))
        return as_value(0, "integer") if result is None else result

    @contextmanager
    def loop(self, count: RoutineValue) -> Iterator[RoutineValue]:
        """Context of a loop with an index from 0 to count - 1."""
        loop = LoopStatement(self._add_variable("integer"), count, [])
        self._add(loop)
        with self._block(loop.body):
            assert loop.index is not None
            yield loop.index

    @contextmanager
    def loop_forever(self) -> Iterator[None]:
        """Context of an infinite loop."""
        loop = LoopStatement(None, None, [])
        self._add(loop)
        with self._block(loop.body):
            yield

    @contextmanager
    def if_then(self, condition: RoutineValue) -> Iterator[None]:
        """Context of the statements for a true condition."""
        statement = ConditionStatement(condition, [], [])
        self._add(statement)
        with self._block(statement.body):
            yield

    @contextmanager
    def if_else(self) -> Iterator[None]:
        """Context of the statements for a false condition of the preceding `if_then`."""
        statement = self._blocks[-1][-1]
        assert isinstance(statement, ConditionStatement)
        with self._block(statement.otherwise):
            yield

    def break_loop(self) -> None:
        """Leave the innermost loop."""
        self._add(BreakStatement())

    def return_value(self, value: Operand) -> None:
        """Return an integer."""
        self._add(ReturnStatement(as_value(value, "integer")))

    def _add_variable(self, kind: ValueKind) -> RoutineValue:
        variable = RoutineValue(kind, "variable", (f"x{len(self.variables)}",))
        self.variables.append(variable)
        return variable

    def _add(self, statement: RoutineStatement) -> None:
        self._blocks[-1].append(statement)

    @contextmanager
    def _block(self, statements: list[RoutineStatement]) -> Iterator[None]:
        """Context in which statements are added to a block."""
        self._blocks.append(statements)
        yield
        self._blocks.pop()
