"""Routines in LLVM IR."""

from crane.codegen.intermediate_representation import (
    ArrayPointer,
    Assign,
    Break,
    Call,
    Copy,
    If,
    Loop,
    Return,
    Routine,
    RoutineValue,
    Statement,
    Store,
)
from crane.codegen.llvm.vector_functions import format_real

_TYPES = {"real": "double", "integer": "i64", "truth": "i1"}
_ARITHMETIC = {
    "real": {"+": "fadd", "-": "fsub", "*": "fmul", "/": "fdiv"},
    "integer": {"+": "add", "-": "sub", "*": "mul"},
}
_COMPARISONS = {
    "real": {"<": "fcmp olt", "<=": "fcmp ole", ">": "fcmp ogt", ">=": "fcmp oge"},
    "integer": {"<": "icmp slt", "<=": "icmp sle", ">": "icmp sgt", ">=": "icmp sge"},
}


def emit_routine(routine: Routine) -> str:
    """A routine as a function."""
    return _RoutineWriter(routine).emit()


class _RoutineWriter:
    """Writes one routine; variables live in memory, and LLVM moves them to registers."""

    def __init__(self, routine: Routine):
        self._routine = routine
        self._lines: list[str] = []
        self._count = 0
        self._loop_end_labels: list[str] = []  # end labels of the enclosing loops

    def emit(self) -> str:
        """The lines of the function."""
        routine = self._routine
        arguments = [
            *(f"i64 %{name}" for name in routine.counts),
            *(f"ptr %{name}" for name in (*routine.functions, *routine.arrays)),
        ]
        head = [
            f"define i64 @{routine.name}({', '.join(arguments)}) {{",
            "entry:",
            *(
                f"  %{name} = alloca [{size} x double], align 64"
                for name, size in routine.local_arrays.items()
            ),
            *(f"  %{v.operands[0]} = alloca {_TYPES[v.kind]}" for v in routine.variables),
        ]
        self._emit_statements(routine.body)
        # unreachable, or 0 items done
        return "\n".join([*head, *self._lines, "  ret i64 0", "}"])

    def _emit_statements(self, statements: list[Statement]) -> None:
        for statement in statements:
            getattr(self, f"_{type(statement).__name__.lower()}")(statement)

    def _emit_line(self, text: str) -> None:
        self._lines.append(f"  {text}")

    def _emit_value(self, text: str) -> str:
        name = f"%t{self._count}"
        self._count += 1
        self._emit_line(f"{name} = {text}")
        return name

    def _new_label(self) -> str:
        self._count += 1
        return f"l{self._count}"

    def _begin_block(self, label: str) -> None:
        self._lines.append(f"{label}:")

    def _assign(self, s: Assign) -> None:
        self._emit_line(
            f"store {_TYPES[s.value.kind]} {self._evaluate(s.value)}, ptr "
            f"%{s.variable.operands[0]}"
        )

    def _store(self, s: Store) -> None:
        self._emit_line(
            f"store double {self._evaluate(s.value)}, ptr {self._emit_pointer(s.target)}"
        )

    def _copy(self, s: Copy) -> None:
        target, source = self._emit_pointer(s.target), self._emit_pointer(s.source)
        self._emit_line(
            f"call void @llvm.memcpy.p0.p0.i64(ptr {target}, ptr {source}, i64 {8 * s.count}, "
            "i1 false)"
        )

    def _call(self, s: Call) -> None:
        words = []
        for argument in s.arguments:
            if isinstance(argument, RoutineValue):
                words.append(f"i64 {self._evaluate(argument)}")
            elif isinstance(argument, ArrayPointer):
                words.append(f"ptr {self._emit_pointer(argument)}")
            else:
                words.append(f"ptr %{argument.name}")
        sign = "%" if s.function in self._routine.functions else "@"
        call = f"{sign}{s.function}({', '.join(words)})"
        if s.variable is None:
            self._emit_line(f"call void {call}")
        else:
            answer = self._emit_value(f"call i64 {call}")
            self._emit_line(f"store i64 {answer}, ptr %{s.variable.operands[0]}")

    def _loop(self, s: Loop) -> None:
        start, end = self._new_label(), self._new_label()
        if s.variable is not None:
            self._emit_line(f"store i64 0, ptr %{s.variable.operands[0]}")
        self._emit_line(f"br label %{start}")
        self._begin_block(start)
        if s.variable is not None and s.count is not None:
            inside = self._new_label()
            more = self._evaluate(s.variable < s.count)
            self._emit_line(f"br i1 {more}, label %{inside}, label %{end}")
            self._begin_block(inside)
        self._loop_end_labels.append(end)
        self._emit_statements(s.body)
        self._loop_end_labels.pop()
        if s.variable is not None:
            self._emit_line(
                f"store i64 {self._evaluate(s.variable + 1)}, ptr %{s.variable.operands[0]}"
            )
        self._emit_line(f"br label %{start}")
        self._begin_block(end)

    def _if(self, s: If) -> None:
        yes, no, end = self._new_label(), self._new_label(), self._new_label()
        self._emit_line(f"br i1 {self._evaluate(s.condition)}, label %{yes}, label %{no}")
        for label, body in ((yes, s.then_body), (no, s.else_body)):
            self._begin_block(label)
            self._emit_statements(body)
            self._emit_line(f"br label %{end}")
        self._begin_block(end)

    def _break(self, s: Break) -> None:
        self._emit_line(f"br label %{self._loop_end_labels[-1]}")
        self._begin_block(self._new_label())  # unreachable code needs a block

    def _return(self, s: Return) -> None:
        self._emit_line(f"ret i64 {self._evaluate(s.value)}")
        self._begin_block(self._new_label())

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
                return self._emit_value(
                    f"load double, ptr {self._emit_pointer(array.element_pointer(index))}"
                )
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
