"""Derivatives of symbolic formulas, as symbolic formulas: forward and reverse mode."""

from collections.abc import Callable, Mapping, Sequence

from crane.codegen.symbolic import (
    Scalar,
    SymbolicExpression,
    Tape,
    apply_function,
    copysign,
    dot,
    where_positive,
)  # fmt: skip

# Unary functions: f'(x) from x and y = f(x).
_UNARY_DERIVATIVES: dict[str, Callable[[SymbolicExpression, SymbolicExpression], Scalar]] = {
    "sin": lambda x, y: apply_function("cos", x),
    "cos": lambda x, y: -apply_function("sin", x),
    "exp": lambda x, y: y,
    "log": lambda x, y: 1.0 / x,
    "tanh": lambda x, y: 1.0 - y * y,
    "sqrt": lambda x, y: 0.5 / y,
    "abs": lambda x, y: copysign(1.0, x),
}


def differentiate(
    outputs: Sequence[Scalar], variables: Sequence[SymbolicExpression]
) -> list[list[Scalar]]:
    """Jacobian of formulas; entries that vanish are the number 0.

    At a kink it is that of one of the two sides.

    Args:
        outputs: (m,) formulas on one tape.
        variables: (n,) loaded values, or any expressions on the tape that are independent.

    Returns:
        (m, n) formulas on the same tape.
    """
    if not variables:
        return [[] for _ in outputs]
    columns = [directional_derivative(outputs, {variable.index: 1.0}) for variable in variables]
    return [list(row) for row in zip(*columns, strict=True)]


def directional_derivative(outputs: Sequence[Scalar], seeds: Mapping[int, Scalar]) -> list[Scalar]:
    """Derivatives of formulas along a direction (forward mode); see `differentiate`.

    Args:
        outputs: (m,) formulas on one tape.
        seeds: Derivatives of independent expressions on it, by their index.

    Returns:
        (m,) formulas on the same tape.
    """
    found = [x for x in outputs if isinstance(x, SymbolicExpression)]
    tangents = {i: change for i, change in seeds.items() if not _is_zero(change)}
    if not found or not tangents:
        return [0.0] * len(outputs)
    tape, last = found[0].tape, max(x.index for x in found)
    for index in range(min(tangents) + 1, last + 1):
        kind, *operands = tape.operations[index]
        if kind == "load" or index in seeds:
            continue
        if not any(type(x) is int and x in tangents for x in operands):
            continue
        tangent = _forward_rule(tape, index, kind, operands, tangents)
        if not _is_zero(tangent):
            tangents[index] = tangent
    return [
        tangents.get(x.index, 0.0) if isinstance(x, SymbolicExpression) else 0.0 for x in outputs
    ]


def weighted_gradient(
    outputs: Sequence[Scalar], weights: Sequence[Scalar], variables: Sequence[SymbolicExpression]
) -> list[Scalar]:
    """Gradient of a weighted sum of formulas (reverse mode).

    It takes a small multiple of the formulas' operations, for any number of variables (Griewank
    and Walther, Evaluating Derivatives, 2008, section 3.2).

    Args:
        outputs: (m,) formulas on one tape.
        weights: (m,) numbers or expressions on it, which are treated as constant.
        variables: (n,) loaded values, or any expressions on the tape that are independent.

    Returns:
        (n,) formulas on the same tape, sum over i of weights_i d outputs_i / d variable.
    """
    gradient: dict[int, Scalar] = {}

    def accumulate(operand: object, change: Scalar) -> None:
        if type(operand) is int and operand in dependent and not _is_zero(change):
            gradient[operand] = gradient.get(operand, 0.0) + change

    found = [x.index for x in outputs if isinstance(x, SymbolicExpression)]
    variable_indices = {variable.index for variable in variables}
    if not found or not variable_indices:
        return [0.0] * len(variables)
    tape = variables[0].tape
    dependent = _dependent_operations(tape, variable_indices, max(found))
    for output, weight in zip(outputs, weights, strict=True):
        accumulate(output.index if isinstance(output, SymbolicExpression) else None, weight)
    for index in sorted(dependent - variable_indices, reverse=True):
        if index not in gradient:
            continue
        kind, *operands = tape.operations[index]
        adjoints = _reverse_rule(tape, index, kind, operands, gradient[index])
        for operand, change in zip(operands, adjoints, strict=True):
            accumulate(operand, change)
    return [gradient.get(variable.index, 0.0) for variable in variables]


def _dependent_operations(tape: Tape, variable_indices: set[int], last: int) -> set[int]:
    """Indices up to `last` of operations that depend on the variables, which are included."""
    dependent = set(variable_indices)
    for index in range(min(variable_indices) + 1, last + 1):
        kind, *operands = tape.operations[index]
        if kind != "load" and any(type(x) is int and x in dependent for x in operands):
            dependent.add(index)
    return dependent


def _is_zero(change: Scalar) -> bool:
    return not isinstance(change, SymbolicExpression) and change == 0


def _forward_rule(
    tape: Tape, index: int, kind: str, operands: list, tangents: dict[int, Scalar]
) -> Scalar:
    value: list[Scalar] = [SymbolicExpression(tape, x) if type(x) is int else x for x in operands]
    operand_tangents: list[Scalar] = [
        tangents.get(x, 0.0) if type(x) is int else 0.0 for x in operands
    ]
    a, da = value[0], operand_tangents[0]
    b, db = (value[1], operand_tangents[1]) if len(value) > 1 else (0.0, 0.0)
    half = len(value) // 2
    match kind:
        case "negate":
            return -da
        case "dot":
            return dot(operand_tangents[:half], value[half:]) + dot(
                value[:half], operand_tangents[half:]
            )
        case "add":
            return da + db
        case "subtract":
            return da - db
        case "multiply":
            return da * b + a * db
        case "divide":
            return (da - SymbolicExpression(tape, index) * db) / b
        case "maximum":
            return where_positive(a - b, da, db)
        case "copysign":
            return da * _copysign_derivative(a, b)
        case "positive":
            return where_positive(a, db, operand_tangents[2])
    assert isinstance(a, SymbolicExpression)
    return da * _UNARY_DERIVATIVES[kind](a, SymbolicExpression(tape, index))


def _copysign_derivative(a: Scalar, b: Scalar) -> Scalar:
    """Derivative of |a| with the sign of b: 1 if both have one sign, else -1."""
    sign = copysign(1.0, b)
    return sign * copysign(1.0, a) if isinstance(a, SymbolicExpression) else sign


def _reverse_rule(
    tape: Tape, index: int, kind: str, operands: list, adjoint: Scalar
) -> tuple[Scalar, ...]:
    """Adjoints of the operands of an operation: the transpose of `_forward_rule`."""
    value: list[Scalar] = [SymbolicExpression(tape, x) if type(x) is int else x for x in operands]
    a, b, half = value[0], value[1] if len(value) > 1 else 0.0, len(value) // 2
    match kind:
        case "negate":
            return (-adjoint,)
        case "dot":
            return tuple(adjoint * x for x in (*value[half:], *value[:half]))
        case "add":
            return adjoint, adjoint
        case "subtract":
            return adjoint, -adjoint
        case "multiply":
            return adjoint * b, adjoint * a
        case "divide":
            share = adjoint / b
            return share, -(SymbolicExpression(tape, index) * share)
        case "maximum":
            difference = a - b
            return where_positive(difference, adjoint, 0.0), where_positive(
                difference, 0.0, adjoint
            )
        case "copysign":
            return adjoint * _copysign_derivative(a, b), 0.0
        case "positive":
            return 0.0, where_positive(a, adjoint, 0.0), where_positive(a, 0.0, adjoint)
    assert isinstance(a, SymbolicExpression)
    return (adjoint * _UNARY_DERIVATIVES[kind](a, SymbolicExpression(tape, index)),)
