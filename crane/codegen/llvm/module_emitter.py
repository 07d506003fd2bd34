"""A program in LLVM's language."""

from collections.abc import Iterable

from crane.codegen.intermediate_representation import Formula, Routine
from crane.codegen.llvm.formula_emitter import emit_formula
from crane.codegen.llvm.routine_emitter import emit_routine
from crane.codegen.llvm.vector_functions import define_functions

ENTRY_POINT_NAME = "{}.entry"  # the function that takes all arguments by one pointer
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


def emit_module(functions: Iterable[Formula | Routine]) -> str:
    """The whole module."""
    vector_functions: set[tuple[str, int]] = set()
    texts = [_DECLARATIONS]
    for function in functions:
        if isinstance(function, Formula):
            texts += [
                emit_formula(function, vector_functions),
                _emit_entry_point(function, "void"),
            ]
        else:
            texts += [emit_routine(function), _emit_entry_point(function, "i64")]
    return "\n".join([*texts, define_functions(vector_functions)])


def _emit_entry_point(function: Formula | Routine, return_type: str) -> str:
    """What takes one pointer to all arguments."""
    lines, words = [f"define i64 @{ENTRY_POINT_NAME.format(function.name)}(ptr %a) {{"], []
    for i, argument in enumerate(function.argument_kinds):
        kind = "i64" if argument == "count" else "ptr"
        lines.append(f"  %p{i} = getelementptr i64, ptr %a, i64 {i}")
        lines.append(f"  %v{i} = load {kind}, ptr %p{i}")
        words.append(f"{kind} %v{i}")
    call = f"call {return_type} @{function.name}({', '.join(words)})"
    if return_type == "void":
        return "\n".join([*lines, f"  {call}", "  ret i64 0", "}"])
    return "\n".join([*lines, f"  %answer = {call}", "  ret i64 %answer", "}"])
