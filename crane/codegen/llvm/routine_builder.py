"""Routines: functions with loops and conditions around formulas, written in LLVM IR.

Statements are written where they are built; variables live in memory, and LLVM moves them to
registers.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partialmethod
from typing import Any, Literal

from crane.codegen.llvm.vector_functions import format_real
from crane.codegen.vector_layout import ArgumentKind, Formula, Layout

ValueKind = Literal["real", "integer", "truth"]

_TYPES = {"real": "double", "integer": "i64", "truth": "i1"}
_ARITHMETIC = {
    "real": {"+": "fadd", "-": "fsub", "*": "fmul", "/": "fdiv"},
    "integer": {"+": "add", "-": "sub", "*": "mul"},
}
_COMPARISONS = {
    "real": {"<": "fcmp olt", "<=": "fcmp ole", ">": "fcmp ogt", ">=": "fcmp oge"},
    "integer": {"<": "icmp slt", "<=": "icmp sle", ">": "icmp sgt", ">=": "icmp sge"},
}


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


class Routine:
    """f(counts, functions, arrays) -> integer, built by the methods below.

    The arguments are attributes. Local arrays (`local_array`) are uninitialized and live until it
    returns, so that any number of threads may execute it.

    Args:
        name: Its name.
        callees: Formulas and routines that it may call, by name.
        counts: Names of the integer arguments.
        functions: Names of the function arguments.
        arrays: Names of the array arguments, with their layouts.

    Attributes:
        name: Its name.
        argument_kinds: Kinds of the arguments, in their order.
    """

    def __init__(
        self,
        name: str,
        callees: Mapping[str, "Formula | Routine"],
        counts: Sequence[str],
        functions: Sequence[str],
        arrays: Mapping[str, Layout | None],
    ):
        self.name, self._callees, self._functions = name, callees, functions
        self._arguments: dict[str, RoutineValue | ArrayPointer] = {
            **{count: RoutineValue("integer", "argument", (count,)) for count in counts},
            **{function: ArrayPointer(function) for function in functions},
            **{array: ArrayPointer(array, layout=layout) for array, layout in arrays.items()},
        }
        self.argument_kinds: tuple[ArgumentKind, ...] = tuple(
            "count" if isinstance(x, RoutineValue) else "array" for x in self._arguments.values()
        )
        self._local_arrays: dict[str, int] = {}
        self._variables: list[RoutineValue] = []
        self._lines: list[str] = []
        self._number = 0  # of the next register or label
        self._loop_end_labels: list[str] = []  # of the enclosing loops
        self._open_condition: str | None = None  # end label of a condition that may have an `else`

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["_arguments"][name]
        except KeyError:
            raise AttributeError(f"'{self.name}' has no argument '{name}'") from None

    def text(self) -> str:
        """The routine as a function."""
        arguments = ", ".join(
            f"{'i64' if isinstance(x, RoutineValue) else 'ptr'} %{name}"
            for name, x in self._arguments.items()
        )
        self._close_condition()
        lines = [
            f"define i64 @{self.name}({arguments}) {{",
            "entry:",
            *(
                f"  %{name} = alloca [{size} x double], align 64"
                for name, size in self._local_arrays.items()
            ),
            *(f"  %{v.operands[0]} = alloca {_TYPES[v.kind]}" for v in self._variables),
            *self._lines,
            "  ret i64 0",  # unreachable, or 0 items done
            "}",
        ]
        return "\n".join(lines)

    def local_array(self, name: str, layout: Layout | int) -> ArrayPointer:
        """Add a local array."""
        if name in self._local_arrays or name in self._arguments:
            raise ValueError(f"'{self.name}' has two arrays '{name}'")
        if isinstance(layout, int):
            layout = Layout(all=layout)
        self._local_arrays[name] = layout.size
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
        self._emit_assignment(variable, self._evaluate(as_value(value, variable.kind)))

    def store(self, array: ArrayPointer, index: int | RoutineValue | str, value: Operand) -> None:
        """array[index] = value."""
        word = self._evaluate(as_value(value, "real"))
        self._emit_line(
            f"store double {word}, ptr {self._emit_pointer(array.element_pointer(index))}"
        )

    def copy(self, target: ArrayPointer, source: ArrayPointer, count: int) -> None:
        """target[:count] = source[:count], of arrays that do not overlap."""
        pointers = f"ptr {self._emit_pointer(target)}, ptr {self._emit_pointer(source)}"
        self._emit_line(f"call void @llvm.memcpy.p0.p0.i64({pointers}, i64 {8 * count}, i1 false)")

    def call(self, function: str, *arguments: RoutineValue | ArrayPointer | int) -> RoutineValue:
        """Call a formula, an earlier routine, or a function argument; returns its integer."""
        callee = self._callees.get(function)
        if callee is None and function not in self._functions:
            raise ValueError(f"'{self.name}' calls '{function}', which is not there yet")
        if callee is not None and len(arguments) != len(callee.argument_kinds):
            raise ValueError(f"'{function}' takes {len(callee.argument_kinds)} arguments")
        answer = None if isinstance(callee, Formula) else self._add_variable("integer")
        words = [
            f"ptr {self._emit_pointer(x)}"
            if isinstance(x, ArrayPointer)
            else f"i64 {self._evaluate(as_value(x, 'integer'))}"
            for x in arguments
        ]
        call = f"{'@' if callee else '%'}{function}({', '.join(words)})"
        if answer is None:
            self._emit_line(f"call void {call}")
            return as_value(0, "integer")
        self._emit_assignment(answer, self._emit_value(f"call i64 {call}"))
        return answer

    @contextmanager
    def loop(self, count: RoutineValue) -> Iterator[RoutineValue]:
        """Context of a loop with an index from 0 to count - 1."""
        index = self._add_variable("integer")
        start, end = self._new_label(), self._new_label()
        self._emit_assignment(index, "0")
        self._end_block(f"br label %{start}", start)
        inside = self._new_label()
        more = self._evaluate(index < count)
        self._end_block(f"br i1 {more}, label %{inside}, label %{end}", inside)
        self._loop_end_labels.append(end)
        yield index
        self._loop_end_labels.pop()
        self._emit_assignment(index, self._evaluate(index + 1))
        self._end_block(f"br label %{start}", end)

    @contextmanager
    def loop_forever(self) -> Iterator[None]:
        """Context of an infinite loop."""
        start, end = self._new_label(), self._new_label()
        self._end_block(f"br label %{start}", start)
        self._loop_end_labels.append(end)
        yield
        self._loop_end_labels.pop()
        self._end_block(f"br label %{start}", end)

    @contextmanager
    def if_then(self, condition: RoutineValue) -> Iterator[None]:
        """Context of the statements for a true condition."""
        yes, no, end = self._new_label(), self._new_label(), self._new_label()
        self._end_block(f"br i1 {self._evaluate(condition)}, label %{yes}, label %{no}", yes)
        yield
        self._end_block(f"br label %{end}", no)
        self._open_condition = end

    @contextmanager
    def if_else(self) -> Iterator[None]:
        """Context of the statements for a false condition of the preceding `if_then`."""
        end, self._open_condition = self._open_condition, None
        assert end is not None
        yield
        self._end_block(f"br label %{end}", end)

    def break_loop(self) -> None:
        """Leave the innermost loop."""
        # unreachable code needs a block
        self._end_block(f"br label %{self._loop_end_labels[-1]}", self._new_label())

    def return_value(self, value: Operand) -> None:
        """Return an integer."""
        word = self._evaluate(as_value(value, "integer"))
        self._end_block(f"ret i64 {word}", self._new_label())

    def _add_variable(self, kind: ValueKind) -> RoutineValue:
        variable = RoutineValue(kind, "variable", (f"x{len(self._variables)}",))
        self._variables.append(variable)
        return variable

    def _new_label(self) -> str:
        self._number += 1
        return f"l{self._number}"

    def _end_block(self, terminator: str, next_label: str) -> None:
        self._emit_line(terminator)
        self._lines.append(f"{next_label}:")

    def _close_condition(self) -> None:
        """Continue after a condition that has no `else`."""
        end, self._open_condition = self._open_condition, None
        if end is not None:
            self._end_block(f"br label %{end}", end)

    def _emit_line(self, text: str) -> None:
        self._close_condition()
        self._lines.append(f"  {text}")

    def _emit_assignment(self, variable: RoutineValue, word: str) -> None:
        self._emit_line(f"store {_TYPES[variable.kind]} {word}, ptr %{variable.operands[0]}")

    def _emit_value(self, text: str) -> str:
        self._number += 1
        name = f"%t{self._number - 1}"
        self._emit_line(f"{name} = {text}")
        return name

    def _emit_pointer(self, array: ArrayPointer) -> str:
        offset = self._evaluate(array.offset)
        if offset == "0":
            return f"%{array.name}"
        return self._emit_value(f"getelementptr double, ptr %{array.name}, i64 {offset}")

    def _evaluate(self, value: RoutineValue) -> str:
        """Emit the computation of a value; returns its register or constant."""
        kind, operands = _TYPES[value.kind], value.operands
        match value.operation:
            case "constant":
                return format_real(operands[0]) if value.kind == "real" else str(operands[0])
            case "argument":
                return f"%{operands[0]}"
            case "variable":
                return self._emit_value(f"load {kind}, ptr %{operands[0]}")
            case "element":
                array, index = operands
                pointer = self._emit_pointer(array.element_pointer(index))
                return self._emit_value(f"load double, ptr {pointer}")
            case "select":
                test, yes, no = (self._evaluate(x) for x in operands)
                return self._emit_value(f"select i1 {test}, double {yes}, double {no}")
            case "not":
                return self._emit_value(f"xor i1 {self._evaluate(operands[0])}, true")
            case "and" | "or":
                a, b = (self._evaluate(x) for x in operands)
                return self._emit_value(f"{value.operation} i1 {a}, {b}")
        a, b = (self._evaluate(x) for x in operands)
        of = operands[0].kind
        word = (_COMPARISONS if value.kind == "truth" else _ARITHMETIC)[of][value.operation]
        return self._emit_value(f"{word} {_TYPES[of]} {a}, {b}")
