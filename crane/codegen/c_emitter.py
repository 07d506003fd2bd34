"""Linked functions in C99: no allocation, no static data, no recursion.

The type `real`, double or float, and the macro R(x) for constants are defined by what includes the
functions. MATH1 and MATH2 call those of that type, because <tgmath.h> needs complex functions that
C libraries of microcontrollers lack.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from crane.codegen.linked_functions import LinkedFunction, variables_read
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
from crane.codegen.symbolic import SymbolicExpression
from crane.codegen.vector_layout import Formula, assign_memory_slots

C_PRELUDE = """\
#define MATH1(name, x) (sizeof(real) < 8 ? (real)name##f((float)(x)) : (real)name(x))
#define MATH2(name, x, y) \\
    (sizeof(real) < 8 ? (real)name##f((float)(x), (float)(y)) : (real)name(x, y))
#define TOLERANCE(x, single) ((real)(sizeof(real) < 8 ? (single) : (x)))

static inline real maximum_of(real a, real b)
{
    return b != b ? b : (b > a ? b : a);
}
/* sin(x + n pi / 2) to 2.5 units in the last place, without branches, NaN from 3e9 on. By the
   coefficients of FDLIBM (k_sin.c, k_cos.c), and pi / 2 in parts of 22 bits. */
static inline real turned_sine(real x, unsigned n)
{
    const real shifted = x * R(0.6366197723675814) + R(6755399441055744.0);
    const real k = shifted - R(6755399441055744.0);
    const real y = x - k * R(1.570796012878418) - k * R(3.139164164167596e-07)
        - k * R(6.223371969669989e-14) - k * R(2.0222662487959506e-21), z = y * y;
    const real s = y + y * z * (R(-0.16666666666666632) + z * (R(0.00833333333332249) + z
        * (R(-0.0001984126982985795) + z * (R(2.7557313707070068e-06) + z
        * (R(-2.5050760253406863e-08) + z * R(1.58969099521155e-10))))));
    const real c = R(1.0) - z * (R(0.5) - z * (R(0.0416666666666666) + z
        * (R(-0.001388888888887411) + z * (R(2.480158728947673e-05) + z
        * (R(-2.7557314351390663e-07) + z * (R(2.087572321298175e-09) + z
        * R(-1.1359647557788195e-11)))))));
    unsigned long long bits = 0;
    memcpy(&bits, &shifted, sizeof shifted);
    const real r = ((bits + n) & 1) != 0 ? c : s;
    return !(x < R(3e9) && x > R(-3e9)) ? NAN : ((bits + n) & 2) != 0 ? -r : r;
}
#define SIN(x) (sizeof(real) < 8 ? MATH1(sin, x) : turned_sine(x, 0))
#define COS(x) (sizeof(real) < 8 ? MATH1(cos, x) : turned_sine(x, 1))
"""  # NaN if one is NaN

_LARGEST_TOLERANCE = 1e-5
# of the digits of double precision, that single precision has
_DIGITS_SHARE = math.log(2.0**-23) / math.log(2.0**-52)
_LEAST_SINGLE = 1e-37
PIECE_LENGTH = 2000  # operations of a C function; compilers need more than linear time
_INFIX = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/"}
_TYPES = {"real": "real", "integer": "int", "truth": "int"}
_OPERATORS = {"and": "&&", "or": "||"}


def format_c_real(value: float) -> str:
    """A number in C, exact in double precision."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    return f"R({value!r})"


def single_precision_tolerance(value: float) -> float:
    """A tolerance t, or 1 - t, with the same share of the digits in single precision.

    t^s with s = log(2^-23) / log(2^-52): rounding becomes rounding, 1e-10 becomes 4e-5. Other
    numbers stay.
    """
    size = abs(value)
    if 0.0 < size <= _LARGEST_TOLERANCE:
        size = max(size**_DIGITS_SHARE, _LEAST_SINGLE)
    elif 0.0 < 1.0 - size <= _LARGEST_TOLERANCE:
        size = 1.0 - (1.0 - size) ** _DIGITS_SHARE
    return math.copysign(size, value)


def emit_c_function(linked: LinkedFunction) -> str:
    """A linked function as static functions in C."""
    if isinstance(linked.function, Formula):
        return _emit_formula(linked, linked.function)
    return _CRoutineEmitter(linked, linked.function).text()


def c_parameters(linked: LinkedFunction) -> str:
    """The parameters of a function in C."""
    counts = linked.function.arguments if isinstance(linked.function, Routine) else {}
    words = []
    for name in linked.arguments:
        if isinstance(counts.get(name), RoutineValue):
            words.append(f"int {name}")
        else:
            words.append(f"{'' if name in linked.written else 'const '}real *{name}")
    return ", ".join(words)


def _emit_formula(linked: LinkedFunction, formula: Formula) -> str:
    name, order, operations = linked.name, formula.order, formula.operations
    pieces = [order[i : i + PIECE_LENGTH] for i in range(0, len(order), PIECE_LENGTH)] or [[]]
    slots = assign_memory_slots(pieces, operations)
    targets = {index: [f"w[{slot}]"] for index, slot in slots.items()}
    copies, computed = [], {*order}
    for i, x in enumerate(formula.outputs):
        if isinstance(x, SymbolicExpression) and x.index in computed:
            targets.setdefault(x.index, []).append(f"out[{i}]")
        else:
            copied = x.index if isinstance(x, SymbolicExpression) else float(x)
            copies.append(f"out[{i}] = {_operand(copied, operations, slots, computed)};")
    inputs = list(linked.arguments[:-1])
    parameters = ", ".join([*(f"const real *restrict {x}" for x in inputs), "real *restrict out"])
    texts, calls = [], []
    for number, piece in enumerate(pieces):
        lines = _piece_lines(operations, piece, slots, targets)
        lines += copies if number == len(pieces) - 1 else []
        if len(pieces) == 1:
            return _function_text(f"void {name}({parameters})", [*inputs, "out"], lines)
        head = f"void {name}_{number}({parameters}, real *restrict w)"
        texts.append(_function_text(head, [*inputs, "out", "w"], lines))
        calls.append(f"{name}_{number}({', '.join([*inputs, 'out', 'w'])});")
    size = 1 + max(slots.values(), default=0)
    texts.append(_function_text(f"void {name}({parameters})", [], [f"real w[{size}];", *calls]))
    return "\n".join(texts)


def _piece_lines(
    operations: Sequence[tuple],
    piece: Sequence[int],
    slots: Mapping[int, int],
    targets: Mapping[int, Sequence[str]],
) -> list[str]:
    local, lines = {*piece}, []
    for index in piece:
        kind, *operands = operations[index]
        words = [_operand(x, operations, slots, local) for x in operands]
        lines.append(f"const real v{index} = {_operation_text(kind, words)};")
        lines += [f"{target} = v{index};" for target in targets.get(index, ())]
    return lines


def _operation_text(kind: str, words: list[str]) -> str:
    if kind in _INFIX:
        return f"{words[0]} {_INFIX[kind]} {words[1]}"
    if kind == "negate":
        return f"-{words[0]}"
    if kind == "positive":
        return f"{words[0]} > R(0.0) ? {words[1]} : {words[2]}"
    if kind == "dot":
        half = len(words) // 2
        return " + ".join(f"{x} * {y}" for x, y in zip(words[:half], words[half:], strict=True))
    if kind == "maximum":
        return f"maximum_of({', '.join(words)})"
    if kind in ("sin", "cos"):
        return f"{kind.upper()}({words[0]})"
    function = "fabs" if kind == "abs" else kind  # others have the names of C
    return f"MATH{len(words)}({function}, {', '.join(words)})"


def _operand(
    x: int | float, operations: Sequence[tuple], slots: Mapping[int, int], local: set[int]
) -> str:
    if not isinstance(x, int):
        return format_c_real(x) if x >= 0 else f"({format_c_real(x)})"
    kind, *where = operations[x]
    if kind == "load":
        return f"in{where[0]}[{where[1]}]"
    return f"v{x}" if x in local else f"w[{slots[x]}]"


def _function_text(head: str, parameters: Sequence[str], lines: Sequence[str]) -> str:
    """A static function; parameters that no line uses are named, for compilers that warn."""
    unused = [f"(void){x};" for x in parameters if not _has_word(lines, x)]
    return "\n".join([f"static {head}", "{", *(f"    {x}" for x in (*unused, *lines)), "}", ""])


def _has_word(lines: Sequence[str], word: str) -> bool:
    return any(re.search(rf"\b{word}\b", line) for line in lines)


class _CRoutineEmitter:
    """Writes a routine."""

    def __init__(self, linked: LinkedFunction, routine: Routine):
        self._linked, self._routine = linked, routine
        self._lines: list[str] = []
        self._indent = 0

    def text(self) -> str:
        """The routine as a function."""
        routine, linked, read = self._routine, self._linked, variables_read(self._routine)
        self._emit_block(routine.statements)
        arrays = [(x, n) for x, n in routine.local_arrays.items() if _has_word(self._lines, x)]
        names = [(_TYPES[x.kind], x.operands[0]) for x in routine.variables]
        lines = [f"real {name}[{max(1, n)}];" for name, n in arrays]
        lines += [f"{kind} {name};" for kind, name in names]
        lines += self._lines
        lines += [f"(void){name};" for _, name in names if name not in read]
        head = f"int {linked.name}({c_parameters(linked)})"
        return _function_text(head, linked.arguments, [*lines, "return 0;"])

    def _emit_block(self, statements: Sequence[RoutineStatement]) -> None:
        for statement in statements:
            self._emit(statement)

    def _line(self, text: str) -> None:
        self._lines.append("    " * self._indent + text)

    def _emit_body(self, head: str, statements: Sequence[RoutineStatement]) -> None:
        self._line(f"{head} {{")
        self._indent += 1
        self._emit_block(statements)
        self._indent -= 1
        self._line("}")

    def _emit(self, statement: RoutineStatement) -> None:
        match statement:
            case AssignmentStatement(variable, value):
                self._line(f"{variable.operands[0]} = {_value(value)};")
            case StoreStatement(pointer, value):
                self._line(f"{_element(pointer)} = {_value(value)};")
            case CopyStatement(target, source, count) if count:
                size = f"{count} * sizeof(real)"
                self._line(f"memcpy({_pointer(target)}, {_pointer(source)}, {size});")
            case CallStatement(function, arguments, result):
                callee = self._linked.callees[function]
                passed = callee.passed(arguments)
                words = [_pointer(x) if isinstance(x, ArrayPointer) else _value(x) for x in passed]
                call = f"{callee.name}({', '.join(words)});"
                self._line(call if result is None else f"{result.operands[0]} = {call}")
            case LoopStatement(index, count, body):
                head = "for (;;)"
                if index is not None and count is not None:
                    x = index.operands[0]
                    head = f"for ({x} = 0; {x} < {_value(count)}; ++{x})"
                self._emit_body(head, body)
            case ConditionStatement(test, body, otherwise):
                self._emit_body(f"if ({_value(test)})", body)
                if otherwise:
                    self._emit_body("else", otherwise)
            case BreakStatement():
                self._line("break;")
            case ReturnStatement(value):
                self._line(f"return {_value(value)};")


def _pointer(array: ArrayPointer) -> str:
    offset = _value(array.offset)
    return array.name if offset == "0" else f"{array.name} + {offset}"


def _element(array: ArrayPointer) -> str:
    return f"{array.name}[{_value(array.offset).removeprefix('(').removesuffix(')')}]"


def _value(value: RoutineValue) -> str:
    """A value as an expression, in parentheses where it has an operator."""
    operands: tuple[Any, ...] = value.operands
    match value.operation:
        case "constant":
            return _routine_constant(operands[0]) if value.kind == "real" else str(operands[0])
        case "argument" | "variable":
            return str(operands[0])
        case "element":
            return _element(operands[0].element_pointer(operands[1]))
        case "select":
            test, yes, no = (_value(x) for x in operands)
            return f"({test} ? {yes} : {no})"
        case "not":
            return f"!{_value(operands[0])}"
    a, b = (_value(x) for x in operands)
    return f"({a} {_OPERATORS.get(value.operation, value.operation)} {b})"


def _routine_constant(value: float) -> str:
    """A constant of a routine; those near 0 or 1 are tolerances."""
    single = single_precision_tolerance(value)
    same = single == value or math.isnan(value)
    return format_c_real(value) if same else f"TOLERANCE({value!r}, {single:.8g})"
