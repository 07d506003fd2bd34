"""Derivatives of traced formulas, as formulas."""

from collections.abc import Callable, Mapping, Sequence

from crane.codegen.scalar import (
    Expression,
    Number,
    Tape,
    apply,
    dot,
    where_positive,
    with_sign_of,
)  # fmt: skip

# Of functions of one number: f'(x) by x and y = f(x).
_ONE: dict[str, Callable[[Expression, Expression], Number]] = {
    "sin": lambda x, y: apply("cos", x),
    "cos": lambda x, y: -apply("sin", x),
    "exp": lambda x, y: y,
    "log": lambda x, y: 1.0 / x,
    "tanh": lambda x, y: 1.0 - y * y,
    "sqrt": lambda x, y: 0.5 / y,
    "abs": lambda x, y: with_sign_of(1.0, x),
}


def derivatives(outputs: Sequence[Number], by: Sequence[Expression]) -> list[list[Number]]:
    """Jacobian of formulas, the derivative that is not there being the number 0.

    At a kink it is that of one of the two sides.

    Args:
        outputs: (m,) formulas on one tape.
        by: (n,) what was loaded, or any expressions on the tape that count as independent.

    Returns:
        (m, n) formulas on the same tape.
    """
    if not by:
        return [[] for _ in outputs]
    columns = [along(outputs, {variable.index: 1.0}) for variable in by]
    return [list(row) for row in zip(*columns, strict=True)]


def along(outputs: Sequence[Number], seeds: Mapping[int, Number]) -> list[Number]:
    """Derivatives of formulas along a direction; see `derivatives`.

    Args:
        outputs: (m,) formulas on one tape.
        seeds: How expressions on it change that count as independent, by their index.

    Returns:
        (m,) formulas on the same tape.
    """
    found = [x for x in outputs if isinstance(x, Expression)]
    slope = {i: change for i, change in seeds.items() if not _none(change)}
    if not found or not slope:
        return [0.0] * len(outputs)
    tape, last = found[0].tape, max(x.index for x in found)
    for index in range(min(slope) + 1, last + 1):
        kind, *operands = tape.operations[index]
        if kind == "load" or index in seeds:
            continue
        if not any(type(x) is int and x in slope for x in operands):
            continue
        change = _change(tape, index, kind, operands, slope)
        if not _none(change):
            slope[index] = change
    return [slope.get(x.index, 0.0) if isinstance(x, Expression) else 0.0 for x in outputs]


def against(
    outputs: Sequence[Number], weights: Sequence[Number], by: Sequence[Expression]
) -> list[Number]:
    """Gradient of a weighted sum of formulas, in one pass against their order.

    It takes a small multiple of the formulas' own operations, however many variables there are
    (Griewank and Walther, Evaluating Derivatives, 2008, section 3.2).

    Args:
        outputs: (m,) formulas on one tape.
        weights: (m,) numbers or expressions on it, which count as constant.
        by: (n,) what was loaded, or any expressions on the tape that count as independent.

    Returns:
        (n,) formulas on the same tape, the sum over i of weights_i d outputs_i / d by.
    """
    gradient: dict[int, Number] = {}

    def gather(operand: object, change: Number) -> None:
        if type(operand) is int and operand in moved and not _none(change):
            gradient[operand] = gradient.get(operand, 0.0) + change

    found = [x.index for x in outputs if isinstance(x, Expression)]
    ends = {variable.index for variable in by}
    if not found or not ends:
        return [0.0] * len(by)
    tape = by[0].tape
    moved = _moved(tape, ends, max(found))
    for output, weight in zip(outputs, weights, strict=True):
        gather(output.index if isinstance(output, Expression) else None, weight)
    for index in sorted(moved - ends, reverse=True):
        if index in gradient:
            kind, *operands = tape.operations[index]
            changes = _returned(tape, index, kind, operands, gradient[index])
            for operand, change in zip(operands, changes, strict=True):
                gather(operand, change)
    return [gradient.get(variable.index, 0.0) for variable in by]


def _moved(tape: Tape, ends: set[int], last: int) -> set[int]:
    """Indices up to the last of what depends on independent ones, which are among them."""
    moved = set(ends)
    for index in range(min(ends) + 1, last + 1):
        kind, *operands = tape.operations[index]
        if kind != "load" and any(type(x) is int and x in moved for x in operands):
            moved.add(index)
    return moved


def _none(change: Number) -> bool:
    return not isinstance(change, Expression) and change == 0


def _change(tape: Tape, index: int, kind: str, operands: list, slope: dict[int, Number]) -> Number:
    value: list[Number] = [Expression(tape, x) if type(x) is int else x for x in operands]
    moved: list[Number] = [slope.get(x, 0.0) if type(x) is int else 0.0 for x in operands]
    a, da = value[0], moved[0]
    if kind == "negate":
        return -da
    if kind in _ONE:
        assert isinstance(a, Expression)
        return da * _ONE[kind](a, Expression(tape, index))
    if kind == "dot":
        half = len(value) // 2
        return dot(moved[:half], value[half:]) + dot(value[:half], moved[half:])
    b, db = value[1], moved[1]
    if kind == "add":
        return da + db
    if kind == "subtract":
        return da - db
    if kind == "multiply":
        return da * b + a * db
    if kind == "divide":
        return (da - Expression(tape, index) * db) / b
    if kind == "maximum":
        return where_positive(a - b, da, db)
    if kind == "copysign":
        # |a| with the sign of b: as a changes while both have one sign, else against it
        assert isinstance(b, Expression)
        flipped = with_sign_of(1.0, b)
        if isinstance(a, Expression):
            flipped = flipped * with_sign_of(1.0, a)
        return da * flipped
    assert kind == "positive"
    return where_positive(a, db, moved[2])


def _returned(
    tape: Tape, index: int, kind: str, operands: list, weight: Number
) -> tuple[Number, ...]:
    """What a weight of an operation gives its operands: the transpose of `_change`."""
    value: list[Number] = [Expression(tape, x) if type(x) is int else x for x in operands]
    a = value[0]
    if kind == "negate":
        return (-weight,)
    if kind in _ONE:
        assert isinstance(a, Expression)
        return (weight * _ONE[kind](a, Expression(tape, index)),)
    if kind == "dot":
        half = len(value) // 2
        return tuple(weight * x for x in (*value[half:], *value[:half]))
    b = value[1]
    if kind == "add":
        return weight, weight
    if kind == "subtract":
        return weight, -weight
    if kind == "multiply":
        return weight * b, weight * a
    if kind == "divide":
        share = weight / b
        return share, -(Expression(tape, index) * share)
    if kind == "maximum":
        return where_positive(a - b, weight, 0.0), where_positive(a - b, 0.0, weight)
    if kind == "copysign":
        assert isinstance(b, Expression)
        flipped = with_sign_of(1.0, b)
        if isinstance(a, Expression):
            flipped = flipped * with_sign_of(1.0, a)
        return weight * flipped, 0.0
    assert kind == "positive"
    return 0.0, where_positive(a, weight, 0.0), where_positive(a, 0.0, weight)
