"""Machine code from traced arithmetic."""

from crane.codegen.fallback_driver import run_with_fallback
from crane.codegen.intermediate_representation import ArrayPointer, Routine, RoutineValue, select
from crane.codegen.layout import Layout, LayoutView
from crane.codegen.program import BoundFunction, FormulaTooLongError, Program
from crane.codegen.python_callback import PythonCallback
from crane.codegen.result_cache import cached_result
from crane.codegen.symbolic import Scalar, SymbolicExpression, Tape, max_abs, maximum

__all__ = [
    "ArrayPointer",
    "BoundFunction",
    "PythonCallback",
    "SymbolicExpression",
    "Layout",
    "Scalar",
    "LayoutView",
    "Program",
    "Routine",
    "Tape",
    "FormulaTooLongError",
    "RoutineValue",
    "run_with_fallback",
    "cached_result",
    "max_abs",
    "maximum",
    "select",
]
