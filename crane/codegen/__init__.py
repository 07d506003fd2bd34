"""Machine code from traced arithmetic."""

from crane.codegen.callback import Callback
from crane.codegen.driver import carefully
from crane.codegen.layout import Layout, Parts
from crane.codegen.program import Bound, Program, TooLongError
from crane.codegen.representation import Array, Routine, Value, select
from crane.codegen.results import kept_result
from crane.codegen.scalar import Expression, Number, Tape, largest, maximum

__all__ = [
    "Array", "Bound", "Callback", "Expression", "Layout", "Number", "Parts", "Program", "Routine",
    "Tape", "TooLongError", "Value", "carefully", "kept_result", "largest", "maximum", "select",
]  # fmt: skip
