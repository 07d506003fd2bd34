"""Routines in LLVM's language."""

from crane.codegen.llvm.functions import real
from crane.codegen.representation import (
    Array,
    Assign,
    Call,
    Copy,
    Give,
    Leave,
    Loop,
    Routine,
    Statement,
    Store,
    Value,
    When,
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


def routine_text(routine: Routine) -> str:
    """A routine as a function."""
    return _Writer(routine).text()


class _Writer:
    """Writes one routine; variables live in memory, from which LLVM takes them."""

    def __init__(self, routine: Routine):
        self._routine = routine
        self._lines: list[str] = []
        self._count = 0
        self._ends: list[str] = []  # labels behind the loops that are open

    def text(self) -> str:
        """The function."""
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
                for name, size in routine.own.items()
            ),
            *(f"  %{v.operands[0]} = alloca {_TYPES[v.kind]}" for v in routine.variables),
        ]
        self._sequence(routine.body)
        # what is behind the last statement is not reached, or returns nothing done
        return "\n".join([*head, *self._lines, "  ret i64 0", "}"])

    def _sequence(self, statements: list[Statement]) -> None:
        for statement in statements:
            getattr(self, f"_{type(statement).__name__.lower()}")(statement)

    def _line(self, text: str) -> None:
        self._lines.append(f"  {text}")

    def _new(self, text: str) -> str:
        name = f"%t{self._count}"
        self._count += 1
        self._line(f"{name} = {text}")
        return name

    def _label(self) -> str:
        self._count += 1
        return f"l{self._count}"

    def _begin(self, label: str) -> None:
        self._lines.append(f"{label}:")

    def _assign(self, s: Assign) -> None:
        self._line(
            f"store {_TYPES[s.value.kind]} {self._value(s.value)}, ptr %{s.variable.operands[0]}"
        )

    def _store(self, s: Store) -> None:
        self._line(f"store double {self._value(s.value)}, ptr {self._pointer(s.target)}")

    def _copy(self, s: Copy) -> None:
        target, source = self._pointer(s.target), self._pointer(s.source)
        self._line(
            f"call void @llvm.memcpy.p0.p0.i64(ptr {target}, ptr {source}, i64 {8 * s.count}, "
            "i1 false)"
        )

    def _call(self, s: Call) -> None:
        words = []
        for argument in s.arguments:
            if isinstance(argument, Value):
                words.append(f"i64 {self._value(argument)}")
            elif isinstance(argument, Array):
                words.append(f"ptr {self._pointer(argument)}")
            else:
                words.append(f"ptr %{argument.name}")
        sign = "%" if s.function in self._routine.functions else "@"
        call = f"{sign}{s.function}({', '.join(words)})"
        if s.variable is None:
            self._line(f"call void {call}")
        else:
            answer = self._new(f"call i64 {call}")
            self._line(f"store i64 {answer}, ptr %{s.variable.operands[0]}")

    def _loop(self, s: Loop) -> None:
        start, end = self._label(), self._label()
        if s.variable is not None:
            self._line(f"store i64 0, ptr %{s.variable.operands[0]}")
        self._line(f"br label %{start}")
        self._begin(start)
        if s.variable is not None and s.count is not None:
            inside = self._label()
            more = self._value(s.variable < s.count)
            self._line(f"br i1 {more}, label %{inside}, label %{end}")
            self._begin(inside)
        self._ends.append(end)
        self._sequence(s.body)
        self._ends.pop()
        if s.variable is not None:
            self._line(f"store i64 {self._value(s.variable + 1)}, ptr %{s.variable.operands[0]}")
        self._line(f"br label %{start}")
        self._begin(end)

    def _when(self, s: When) -> None:
        yes, no, end = self._label(), self._label(), self._label()
        self._line(f"br i1 {self._value(s.test)}, label %{yes}, label %{no}")
        for label, body in ((yes, s.yes), (no, s.no)):
            self._begin(label)
            self._sequence(body)
            self._line(f"br label %{end}")
        self._begin(end)

    def _leave(self, s: Leave) -> None:
        self._line(f"br label %{self._ends[-1]}")
        self._begin(self._label())  # what follows is not reached

    def _give(self, s: Give) -> None:
        self._line(f"ret i64 {self._value(s.value)}")
        self._begin(self._label())

    def _pointer(self, array: Array) -> str:
        offset = self._value(array.offset)
        if offset == "0":
            return f"%{array.name}"
        return self._new(f"getelementptr double, ptr %{array.name}, i64 {offset}")

    def _value(self, value: Value) -> str:
        """A word that stands for a value, computed here."""
        kind, operands = _TYPES[value.kind], value.operands
        match value.operation:
            case "constant":
                return real(operands[0]) if value.kind == "real" else str(operands[0])
            case "argument":
                return f"%{operands[0]}"
            case "variable":
                return self._new(f"load {kind}, ptr %{operands[0]}")
            case "element":
                array, index = operands
                return self._new(f"load double, ptr {self._pointer(array.at(index))}")
            case "select":
                test, yes, no = (self._value(x) for x in operands)
                return self._new(f"select i1 {test}, double {yes}, double {no}")
            case "not":
                return self._new(f"xor i1 {self._value(operands[0])}, true")
            case "and" | "or":
                a, b = (self._value(x) for x in operands)
                return self._new(f"{value.operation} i1 {a}, {b}")
        a, b = (self._value(x) for x in operands)
        of = operands[0].kind
        word = (_COMPARISONS if value.kind == "truth" else _ARITHMETIC)[of][value.operation]
        return self._new(f"{word} {_TYPES[of]} {a}, {b}")
