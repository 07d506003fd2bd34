"""Conversion of symbolic formulas to CasADi expressions, operation by operation."""

import operator
from collections.abc import Callable, Sequence
from typing import Any

from crane.codegen.symbolic import Scalar, SymbolicExpression, required_operations
from crane.common.optional_libraries import import_optional_library


def casadi_expressions(outputs: Sequence[Scalar], arguments: Sequence[Any]) -> list[Any]:
    """Convert symbolic formulas to CasADi scalars.

    Args:
        outputs: (m,) formulas on one tape.
        arguments: Values of each argument of the tape: numbers or CasADi symbols.

    Raises:
        InputError: CasADi is not installed.
    """
    ca = import_optional_library("casadi", "a graph")
    functions: dict[str, Callable[..., Any]] = {  # others have CasADi's names
        "add": operator.add, "subtract": operator.sub, "multiply": operator.mul,
        "divide": operator.truediv, "negate": operator.neg, "abs": ca.fabs, "maximum": ca.fmax,
        # ca.copysign has wrong derivatives up to 3.8.0
        "copysign": lambda size, sign: ca.fabs(size) * ca.copysign(1.0, sign),
        "positive": lambda x, yes, no: ca.if_else(x > 0, yes, no),
        "dot": lambda *x: sum(map(operator.mul, x[: len(x) // 2], x[len(x) // 2 :])),
    }  # fmt: skip
    operations = next(
        (x.tape.operations for x in outputs if isinstance(x, SymbolicExpression)), []
    )
    found: dict[int, Any] = {}
    for index in required_operations(outputs):
        kind, *operands = operations[index]
        if kind == "load":
            array, place = operands
            value = arguments[array][place]
            found[index] = value if isinstance(value, ca.SX) else ca.SX(float(value))
        else:
            values = [found[x] if type(x) is int else ca.SX(x) for x in operands]
            found[index] = (functions.get(kind) or getattr(ca, kind))(*values)
    return [
        found[x.index] if isinstance(x, SymbolicExpression) else ca.SX(float(x)) for x in outputs
    ]
