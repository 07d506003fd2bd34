"""Intermediate representation of programs: layouts, straight-line formulas, routines with loops.

It does not depend on the target language; an emitter translates it.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partialmethod
from typing import Any, Literal

from crane.codegen.symbolic import Scalar


class Layout:
    """Named consecutive parts of a vector.

    Args:
        parts: Lengths by name; a length may be 0.

    Attributes:
        parts: Lengths by name.
        size: Length of the vector.
    """

    def __init__(self, **parts: int):
        self.parts: Mapping[str, int] = parts
        self._start_indices: dict[str, int] = {}
        at = 0
        for name, length in parts.items():
            self._start_indices[name] = at
            at += length
        self.size = at

    def __repr__(self) -> str:
        return f"Layout({', '.join(f'{name}={length}' for name, length in self.parts.items())})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and [*self.parts.items()] == [*other.parts.items()]

    def __hash__(self) -> int:
        return hash(tuple(self.parts.items()))

    def __getitem__(self, name: str) -> slice:
        """Where a part is."""
        return slice(self._start_indices[name], self._start_indices[name] + self.parts[name])

    def start_index(self, name: str) -> int:
        """Index of a part's first element."""
        return self._start_indices[name]

    def view(self, array: Any) -> "LayoutView":
        """The parts of an array (..., size) or of a sequence, by name."""
        return LayoutView(self, array)


class LayoutView:
    """Parts of one array as attributes; see `Layout.view`."""

    def __init__(self, layout: Layout, array: Any):
        self.__dict__.update(
            {
                name: array[layout[name]] if isinstance(array, list) else array[..., layout[name]]
                for name in layout.parts
            }
        )

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"no part '{name}', there are {', '.join(vars(self))}")


def layout_of(parts: Mapping[str, Sequence]) -> Layout:
    """The layout of concatenated sequences."""
    return Layout(**{name: len(values) for name, values in parts.items()})


ValueKind = Literal["real", "integer", "truth"]
ArgumentKind = Literal["count", "function", "array"]


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

    @property
    def _is_zero(self) -> bool:
        return self.kind == "integer" and self.operation == "constant" and not self.operands[0]

    def _arithmetic_operation(self, operator: str, other: "Operand") -> "RoutineValue":
        second = as_value(other, self.kind)
        if self.kind == "integer" and self.operation == second.operation == "constant":
            a, b = self.operands[0], second.operands[0]
            return as_value({"+": a + b, "-": a - b, "*": a * b}[operator], "integer")
        if operator == "+" and self._is_zero:
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


@dataclass(frozen=True, eq=False)
class ArrayPointer:
    """Position in an argument or local array of a routine.

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

    def element_pointer(
        self, index: "int | RoutineValue | str", layout: Layout | None = None
    ) -> "ArrayPointer":
        """Pointer to an element or a part."""
        return ArrayPointer(self.name, self.offset + self._element_index(index), layout)

    def row_pointer(
        self, index: "int | RoutineValue", width: int, layout: Layout | None = None
    ) -> "ArrayPointer":
        """Pointer to a row."""
        return self.element_pointer(as_value(index, "integer") * width, layout)

    def _element_index(self, index: "int | RoutineValue | str") -> RoutineValue:
        if isinstance(index, str):
            assert self.layout is not None
            index = self.layout.start_index(index)
        return as_value(index, "integer")


@dataclass(frozen=True)
class FunctionArgument:
    """A function that is an argument of a routine."""

    name: str


@dataclass(frozen=True)
class Assign:
    """variable = value."""

    variable: RoutineValue
    value: RoutineValue


@dataclass(frozen=True)
class Store:
    """array[0] = value."""

    target: ArrayPointer
    value: RoutineValue


@dataclass(frozen=True)
class Copy:
    """Copy elements between arrays that do not overlap."""

    target: ArrayPointer
    source: ArrayPointer
    count: int


@dataclass(frozen=True)
class Call:
    """Call of a formula, routine or function argument; `variable` receives the result."""

    function: str
    arguments: tuple["RoutineValue | ArrayPointer | FunctionArgument", ...]
    variable: RoutineValue | None


@dataclass(frozen=True)
class Loop:
    """Infinite loop, or loop with `variable` from 0 to `count` - 1."""

    body: list["Statement"]
    variable: RoutineValue | None = None
    count: RoutineValue | None = None


@dataclass(frozen=True)
class If:
    """Conditional statements."""

    condition: RoutineValue
    then_body: list["Statement"]
    else_body: list["Statement"]


@dataclass(frozen=True)
class Break:
    """Leave the innermost loop."""


@dataclass(frozen=True)
class Return:
    """Return an integer."""

    value: RoutineValue


Statement = Assign | Store | Copy | Call | Loop | If | Break | Return


@dataclass(frozen=True, eq=False)
class Formula:
    """f(in_0, in_1, ..., out), straight-line code.

    Attributes:
        name: Its name.
        input_count: Number of input arguments.
        outputs: Output expressions, (m,).
        layout: Layout of the outputs.
    """

    name: str
    input_count: int
    outputs: Sequence[Scalar]
    layout: Layout

    @property
    def argument_kinds(self) -> tuple[ArgumentKind, ...]:
        """Kinds of the arguments."""
        return tuple("array" for _ in range(self.input_count + 1))


class Routine:
    """f(counts, functions, arrays) -> integer, built by the methods below.

    The arguments are attributes. Local arrays (`local_array`) are uninitialized and live until it
    returns, so that any number of threads may execute it.

    Attributes:
        name: Its name.
        counts: Names of the integer arguments.
        functions: Names of the function arguments.
        arrays: Names of the array arguments.
        local_arrays: Length of each local array.
        body: Statements.
        variables: Values with the operation "variable".
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
        self.local_arrays: dict[str, int] = {}
        self.body: list[Statement] = []
        self.variables: list[RoutineValue] = []
        self._open_blocks = [self.body]
        self._arguments: dict[str, RoutineValue | ArrayPointer | FunctionArgument] = {
            **{function: FunctionArgument(function) for function in functions},
            **{count: RoutineValue("integer", "argument", (count,)) for count in counts},
            **{array: ArrayPointer(array, layout=layout) for array, layout in arrays.items()},
        }

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["_arguments"][name]
        except KeyError:
            raise AttributeError(f"'{self.name}' has no argument '{name}'") from None

    @property
    def argument_kinds(self) -> tuple[ArgumentKind, ...]:
        """Kinds of the arguments, in their order."""
        kinds: list[ArgumentKind] = ["count" for _ in self.counts]
        kinds += ["function" for _ in self.functions]
        kinds += ["array" for _ in self.arrays]
        return tuple(kinds)

    def local_array(self, name: str, layout: Layout | int) -> ArrayPointer:
        """Add a local array."""
        size = layout if isinstance(layout, int) else layout.size
        if name in self.local_arrays or name in self._arguments:
            raise ValueError(f"'{self.name}' has two arrays '{name}'")
        self.local_arrays[name] = size
        return ArrayPointer(name, layout=layout if isinstance(layout, Layout) else None)

    def new_variable(self, value: Operand) -> RoutineValue:
        """Add a variable with an initial value; an integer variable if the value is an int."""
        kind: ValueKind = "integer" if isinstance(value, int) else "real"
        value = as_value(value, value.kind if isinstance(value, RoutineValue) else kind)
        variable = self._add_variable(value.kind)
        self.assign(variable, value)
        return variable

    def assign(self, variable: RoutineValue, value: Operand) -> None:
        """Assign a value to a variable."""
        self._append_statement(Assign(variable, as_value(value, variable.kind)))

    def store(self, array: ArrayPointer, index: int | RoutineValue | str, value: Operand) -> None:
        """array[index] = value."""
        self._append_statement(Store(array.element_pointer(index), as_value(value, "real")))

    def copy(self, target: ArrayPointer, source: ArrayPointer, count: int) -> None:
        """target[:count] = source[:count]."""
        self._append_statement(Copy(target, source, count))

    def call(
        self, function: str, *arguments: "RoutineValue | ArrayPointer | FunctionArgument | int"
    ) -> RoutineValue:
        """Call a formula, an earlier routine, or a function argument; returns its integer."""
        ready = tuple(as_value(x, "integer") if isinstance(x, int) else x for x in arguments)
        callee = self._callees.get(function)
        if callee is None and function not in self.functions:
            raise ValueError(f"'{self.name}' calls '{function}', which is not there yet")
        if callee is not None and len(ready) != len(callee.argument_kinds):
            raise ValueError(f"'{function}' takes {len(callee.argument_kinds)} arguments")
        if isinstance(callee, Formula):
            self._append_statement(Call(function, ready, None))
            return as_value(0, "integer")
        answer = self._add_variable("integer")
        self._append_statement(Call(function, ready, answer))
        return answer

    @contextmanager
    def loop(self, count: RoutineValue) -> Iterator[RoutineValue]:
        """Context of a loop with an index from 0 to count - 1."""
        variable = self._add_variable("integer")
        loop = Loop([], variable, count)
        self._append_statement(loop)
        with self._inside_block(loop.body):
            yield variable

    @contextmanager
    def loop_forever(self) -> Iterator[None]:
        """Context of an infinite loop."""
        loop = Loop([])
        self._append_statement(loop)
        with self._inside_block(loop.body):
            yield

    @contextmanager
    def if_then(self, condition: RoutineValue) -> Iterator[None]:
        """Context of the statements for a true condition."""
        when = If(condition, [], [])
        self._append_statement(when)
        with self._inside_block(when.then_body):
            yield

    @contextmanager
    def if_else(self) -> Iterator[None]:
        """Context of the statements for a false condition of the preceding `if_then`."""
        when = self._open_blocks[-1][-1]
        assert isinstance(when, If)
        with self._inside_block(when.else_body):
            yield

    def break_loop(self) -> None:
        """Leave the innermost loop."""
        self._append_statement(Break())

    def return_value(self, value: Operand) -> None:
        """Return an integer."""
        self._append_statement(Return(as_value(value, "integer")))

    def _add_variable(self, kind: ValueKind) -> RoutineValue:
        variable = RoutineValue(kind, "variable", (f"x{len(self.variables)}",))
        self.variables.append(variable)
        return variable

    def _append_statement(self, statement: Statement) -> None:
        self._open_blocks[-1].append(statement)

    @contextmanager
    def _inside_block(self, body: list[Statement]) -> Iterator[None]:
        self._open_blocks.append(body)
        yield
        self._open_blocks.pop()
