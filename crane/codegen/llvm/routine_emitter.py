"""Routines in LLVM IR; variables live in memory, and LLVM moves them to registers."""

from collections.abc import Mapping, Sequence

from crane.codegen.linked_functions import LinkedFunction
from crane.codegen.llvm.vector_functions import format_real
from crane.codegen.routine_statements import (
    ArrayPointer,
    AssignmentStatement,
    BreakStatement,
    CallStatement,
    ConditionStatement,
    CopyStatement,
    LoopStatement,
    ReturnStatement,
    Routine,
    RoutineStatement,
    RoutineValue,
    StoreStatement,
)

_TYPES = {"real": "double", "integer": "i64", "truth": "i1"}
_ARITHMETIC = {
    "real": {"+": "fadd", "-": "fsub", "*": "fmul", "/": "fdiv"},
    "integer": {"+": "add", "-": "sub", "*": "mul"},
}
_COMPARISONS = {
    "real": {"<": "fcmp olt", "<=": "fcmp ole", ">": "fcmp ogt", ">=": "fcmp oge"},
    "integer": {"<": "icmp slt", "<=": "icmp sle", ">": "icmp sgt", ">=": "icmp sge"},
}


def emit_routine(routine: Routine, linked: LinkedFunction | None = None) -> str:
    """A routine as a function, or an internal one that is linked with others."""
    names = routine.arguments if linked is None else linked.arguments
    arguments = ", ".join(
        f"{'i64' if isinstance(routine.arguments[x], RoutineValue) else 'ptr'} %{x}" for x in names
    )
    head = f"i64 @{routine.name}" if linked is None else f"internal i64 @{linked.name}"
    lines = [
        f"define {head}({arguments}) {{",
        "entry:",
        *(
            f"  %{name} = alloca [{size} x double], align 64"
            for name, size in routine.local_arrays.items()
        ),
        *(f"  %{v.operands[0]} = alloca {_TYPES[v.kind]}" for v in routine.variables),
        *_RoutineEmitter(linked.callees if linked else {}).lines_of(routine.statements),
        "  ret i64 0",  # unreachable, or 0 items done
        "}",
    ]
    return "\n".join(lines)


class _RoutineEmitter:
    """Writes the statements of a routine."""

    def __init__(self, callees: Mapping[str, LinkedFunction]):
        self._callees = callees
        self._lines: list[str] = []
        self._number = 0  # of the next register or label
        self._loop_end_labels: list[str] = []  # of the enclosing loops

    def lines_of(self, statements: Sequence[RoutineStatement]) -> list[str]:
        """The lines of all statements."""
        self._emit_block(statements)
        return self._lines

    def _emit_block(self, statements: Sequence[RoutineStatement]) -> None:
        for statement in statements:
            self._emit(statement)

    def _emit(self, statement: RoutineStatement) -> None:
        match statement:
            case AssignmentStatement(variable, value):
                self._emit_assignment(variable, self._evaluate(value))
            case StoreStatement(pointer, value):
                word = self._evaluate(value)
                self._emit_line(f"store double {word}, ptr {self._emit_pointer(pointer)}")
            case CopyStatement(target, source, count):
                to, at = (self._emit_pointer(x) for x in (target, source))
                copied = f"ptr {to}, ptr {at}, i64 {8 * count}, i1 false"
                self._emit_line(f"call void @llvm.memcpy.p0.p0.i64({copied})")
            case CallStatement(function, arguments, result, is_argument):
                sigil = "%" if is_argument else "@"
                if (callee := self._callees.get(function)) is not None:
                    sigil, function = "@", callee.name
                    arguments = (*callee.passed(arguments),)
                words = [
                    f"ptr {self._emit_pointer(x)}"
                    if isinstance(x, ArrayPointer)
                    else f"i64 {self._evaluate(x)}"
                    for x in arguments
                ]
                call = f"{sigil}{function}({', '.join(words)})"
                if result is None:
                    self._emit_line(f"call void {call}")
                else:
                    self._emit_assignment(result, self._emit_value(f"call i64 {call}"))
            case LoopStatement(index, count, body):
                start, end = self._new_label(), self._new_label()
                if index is not None:
                    self._emit_assignment(index, "0")
                self._end_block(f"br label %{start}", start)
                if index is not None and count is not None:
                    inside = self._new_label()
                    more = self._evaluate(index < count)
                    self._end_block(f"br i1 {more}, label %{inside}, label %{end}", inside)
                self._loop_end_labels.append(end)
                self._emit_block(body)
                self._loop_end_labels.pop()
                if index is not None:
                    self._emit_assignment(index, self._evaluate(index + 1))
                self._end_block(f"br label %{start}", end)
            case ConditionStatement(test, body, otherwise):
                yes, no, end = self._new_label(), self._new_label(), self._new_label()
                word = self._evaluate(test)
                self._end_block(f"br i1 {word}, label %{yes}, label %{no}", yes)
                self._emit_block(body)
                self._end_block(f"br label %{end}", no)
                self._emit_block(otherwise)
                self._end_block(f"br label %{end}", end)
            case BreakStatement():
                # unreachable code needs a block
                self._end_block(f"br label %{self._loop_end_labels[-1]}", self._new_label())
            case ReturnStatement(value):
                word = self._evaluate(value)
                self._end_block(f"ret i64 {word}", self._new_label())

    def _new_label(self) -> str:
        self._number += 1
        return f"l{self._number}"

    def _end_block(self, terminator: str, next_label: str) -> None:
        self._emit_line(terminator)
        self._lines.append(f"{next_label}:")

    def _emit_line(self, text: str) -> None:
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
