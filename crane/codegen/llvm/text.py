"""A program in LLVM's language."""

from collections.abc import Iterable

from crane.codegen.llvm.formulas import formula_text
from crane.codegen.llvm.functions import definitions
from crane.codegen.llvm.routines import routine_text
from crane.codegen.representation import Formula, Routine

ENTRY = "{}.entry"  # the function that takes all arguments by one pointer
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
            texts += [formula_text(function, called), _entry(function, "void")]
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
