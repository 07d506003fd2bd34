"""Symbolic formulas, routines that call them, and their translation to machine code."""

from crane.codegen.program import (
    FormulaTooLongError,
    Program,
    PythonCallback,
    run_with_fallback,
)
from crane.codegen.program_cache import cached_result
from crane.codegen.routine_statements import ArrayPointer, Routine, RoutineValue, select
from crane.codegen.symbolic import Scalar, SymbolicExpression, Tape, max_abs, maximum
from crane.codegen.vector_layout import Layout, LayoutView

__all__ = [
    "ArrayPointer",
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
