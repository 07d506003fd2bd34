"""Conversion of symbolic formulas to CasADi expressions, operation by operation."""

from collections.abc import Callable, Sequence
from typing import Any

from crane.codegen.symbolic import Scalar, SymbolicExpression, required_operations
from crane.common.optional_libraries import import_optional_library

_BINARY_OPERATIONS = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / b,
}
_FUNCTION_NAMES = {
    "sin": "sin", "cos": "cos", "exp": "exp", "log": "log", "tanh": "tanh", "sqrt": "sqrt",
    "abs": "fabs", "maximum": "fmax",
}  # fmt: skip


def casadi_expressions(outputs: Sequence[Scalar], arguments: Sequence[Any]) -> list[Any]:
    """Convert symbolic formulas to CasADi scalars.

    Args:
        outputs: (m,) formulas on one tape.
        arguments: Values of each argument of the tape: numbers or CasADi symbols.

    Raises:
        InputError: CasADi is not installed.
    """
    ca = import_optional_library("casadi", "a graph")
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
            found[index] = _casadi_operation(ca, kind)(
                *[found[x] if type(x) is int else ca.SX(x) for x in operands]
            )
    return [
        found[x.index] if isinstance(x, SymbolicExpression) else ca.SX(float(x)) for x in outputs
    ]


def _casadi_operation(ca: Any, kind: str) -> Callable[..., Any]:
    if kind in _BINARY_OPERATIONS:
        return _BINARY_OPERATIONS[kind]
    if kind == "negate":
        return lambda x: -x
    if kind == "copysign":  # ca.copysign has wrong derivatives up to 3.8.0
        return lambda size, sign: ca.fabs(size) * ca.copysign(1.0, sign)
    if kind == "positive":
        return lambda x, yes, no: ca.if_else(x > 0, yes, no)
    if kind == "dot":
        return lambda *x: sum(
            a * b for a, b in zip(x[: len(x) // 2], x[len(x) // 2 :], strict=True)
        )
    return getattr(ca, _FUNCTION_NAMES[kind])
