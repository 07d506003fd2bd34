"""A program in LLVM's language."""

from collections.abc import Iterable, Sequence
from typing import Any

from crane.codegen.llvm.functions import VECTOR, WIDEST, definitions, real
from crane.codegen.llvm.routines import routine_text
from crane.codegen.representation import Formula, Routine
from crane.codegen.scalar import Expression, needed

ENTRY = "{}.entry"  # the function that takes all arguments by one pointer
# Products may be fused with sums. Reordering sums would gain nothing and let NaN cancel.
_FAST = "nsz arcp contract"
_ARITHMETIC = {"add": "fadd", "subtract": "fsub", "multiply": "fmul", "divide": "fdiv"}
_CALLS = {
    "sqrt": "@llvm.sqrt.f64", "abs": "@llvm.fabs.f64", "maximum": "@larger",
    "copysign": "@llvm.copysign.f64", "positive": "@chosen",
}  # fmt: skip
_DECLARATIONS = """
declare double @llvm.sqrt.f64(double)
declare double @llvm.fabs.f64(double)
declare double @llvm.copysign.f64(double, double)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
define internal double @chosen(double %x, double %yes, double %no) alwaysinline {
  %positive = fcmp ogt double %x, 0.0
  %out = select i1 %positive, double %yes, double %no
  ret double %out
}
define internal double @larger(double %a, double %b) alwaysinline {
  %more = fcmp oge double %a, %b
  %out = select i1 %more, double %a, double %b
  %odd = fcmp uno double %a, %a
  %seen = select i1 %odd, double %a, double %out
  ret double %seen
}
"""


def text_of(functions: Iterable[Formula | Routine]) -> str:
    """The whole module."""
    called: set[tuple[str, int]] = set()
    texts = [_DECLARATIONS]
    for function in functions:
        if isinstance(function, Formula):
            texts += [_formula(function, called), _entry(function, "void")]
        else:
            texts += [routine_text(function), _entry(function, "i64")]
    return "\n".join([*texts, definitions(called)])


def _entry(function: Formula | Routine, answer: str) -> str:
    """What takes one pointer to all arguments."""
    lines, words = [f"define i64 @{ENTRY.format(function.name)}(ptr %a) {{"], []
    for i, argument in enumerate(function.kinds):
        kind = "i64" if argument == "count" else "ptr"
        lines.append(f"  %p{i} = getelementptr i64, ptr %a, i64 {i}")
        lines.append(f"  %v{i} = load {kind}, ptr %p{i}")
        words.append(f"{kind} %v{i}")
    call = f"call {answer} @{function.name}({', '.join(words)})"
    if answer == "void":
        return "\n".join([*lines, f"  {call}", "  ret i64 0", "}"])
    return "\n".join([*lines, f"  %answer = {call}", "  ret i64 %answer", "}"])


def _formula(formula: Formula, functions: set[tuple[str, int]]) -> str:
    """A straight function; adds to `functions` what it calls of `definitions`."""
    arguments = [f"ptr noalias readonly %in{i}" for i in range(formula.arrays)]
    lines = [f"define void @{formula.name}({', '.join([*arguments, 'ptr noalias %out'])}) {{"]
    tapes = {value.tape for value in formula.outputs if isinstance(value, Expression)}
    operations = tapes.pop().operations if tapes else []
    for level in _levels(operations, needed(formula.outputs)):
        lines += _at_once([(i, operations[i]) for i in level if _vector(operations[i])], functions)
        for index in [i for i in level if not _vector(operations[i])]:
            lines += _single(index, *operations[index])
    for i, value in enumerate(formula.outputs):
        word = _operand(value.index if isinstance(value, Expression) else float(value))
        lines.append(f"  %q{i} = getelementptr double, ptr %out, i64 {i}")
        lines.append(f"  store double {word}, ptr %q{i}")
    return "\n".join([*lines, "  ret void", "}"])


def _vector(operation: tuple) -> bool:
    return operation[0] in VECTOR


def _levels(operations: Sequence[tuple], indices: Sequence[int]) -> list[list[int]]:
    """Operations by how many of `VECTOR` come after each other on the way to them."""
    level: dict[int, int] = {}
    out: list[list[int]] = []
    for index in indices:
        operation = operations[index]
        used = [] if operation[0] == "load" else [x for x in operation[1:] if isinstance(x, int)]
        level[index] = max((level[x] for x in used), default=0) + _vector(operation)
        while len(out) <= level[index]:
            out.append([])
        out[level[index]].append(index)
    return out


def _at_once(calls: list[tuple[int, tuple]], functions: set[tuple[str, int]]) -> list[str]:
    """Functions of `VECTOR`, each of as many numbers as there are."""
    lines = []
    for name in sorted({operation[0] for _, operation in calls}):
        same = [(index, operand) for index, (kind, operand) in calls if kind == name]
        for start in range(0, len(same), WIDEST):
            part = same[start : start + WIDEST]
            width = 1 << (len(part) - 1).bit_length()
            functions.add((name, width))
            lines += _call_at_once(name, width, part)
    return lines


def _call_at_once(name: str, width: int, calls: list[tuple[int, Any]]) -> list[str]:
    """One call of a function of `width` numbers, of which there may be fewer."""
    lines = []
    kind, vector = f"<{width} x double>", "poison"
    for lane in range(width):  # the first once more where there are too few
        _, operand = calls[lane] if lane < len(calls) else calls[0]
        word, made = _operand(operand), f"%{name}{calls[0][0]}_{lane}"
        lines.append(f"  {made} = insertelement {kind} {vector}, double {word}, i32 {lane}")
        vector = made
    result = f"%{name}{calls[0][0]}"
    lines.append(f"  {result} = call {kind} @{name}{width}({kind} {vector})")
    lines += [
        f"  %v{index} = extractelement {kind} {result}, i32 {lane}"
        for lane, (index, _) in enumerate(calls)
    ]
    return lines


def _single(index: int, kind: str, *operands: Any) -> list[str]:
    """One operation of one number."""
    if kind == "load":
        array, at = operands
        return [
            f"  %p{index} = getelementptr double, ptr %in{array}, i64 {at}",
            f"  %v{index} = load double, ptr %p{index}",
        ]
    words = [_operand(operand) for operand in operands]
    if kind == "negate":
        return [f"  %v{index} = fneg double {words[0]}"]
    if kind in _CALLS:
        typed = ", ".join(f"double {word}" for word in words)
        return [f"  %v{index} = call double {_CALLS[kind]}({typed})"]
    return [f"  %v{index} = {_ARITHMETIC[kind]} {_FAST} double {words[0]}, {words[1]}"]


def _operand(operand: float | int) -> str:
    if isinstance(operand, int):
        return f"%v{operand}"
    return real(operand)
