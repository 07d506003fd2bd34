"""Expressions of measures, dual numbers for their derivatives, and measures of users."""

import ast
import importlib.util
import inspect
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from crane.common.errors import InputError
from crane.common.number_text import parse_expression
from crane.common.samples import Array
from crane.machine.machine import Machine


@dataclass(frozen=True, eq=False)
class DualNumber:
    """A value with its derivatives by k variables; arithmetic propagates both exactly.

    Attributes:
        value: The value.
        derivatives: (k,) derivatives.
    """

    value: float
    derivatives: Array

    def __add__(self, other: "DualNumber") -> "DualNumber":
        return DualNumber(self.value + other.value, self.derivatives + other.derivatives)

    def __neg__(self) -> "DualNumber":
        return DualNumber(-self.value, -self.derivatives)

    def __sub__(self, other: "DualNumber") -> "DualNumber":
        return self + -other

    def __mul__(self, other: "DualNumber") -> "DualNumber":
        return DualNumber(
            self.value * other.value,
            self.value * other.derivatives + other.value * self.derivatives,
        )

    def __truediv__(self, other: "DualNumber") -> "DualNumber":
        value = self.value / other.value
        return DualNumber(value, (self.derivatives - value * other.derivatives) / other.value)

    def __pow__(self, power: "DualNumber") -> "DualNumber":
        if power.derivatives.any():
            return _exp(power * _log(self))
        exponent = power.value
        root = _elementary(
            lambda x: x**exponent, lambda x: exponent * x ** (exponent - 1.0) if exponent else 0.0
        )
        return root(self)

    def __abs__(self) -> "DualNumber":
        return -self if self.value < 0 else self


def _elementary(
    function: Callable[[float], float], derivative: Callable[[float], float]
) -> Callable[[DualNumber], DualNumber]:
    """Return a function of dual numbers, by the chain rule; what is constant stays constant."""

    def apply(x: DualNumber) -> DualNumber:
        value, varies = function(x.value), x.derivatives != 0
        slope = derivative(x.value) if varies.any() else 0.0
        changes = slope * np.where(varies, x.derivatives, 1.0)
        return DualNumber(value, np.where(varies, changes, 0.0))

    return apply


_exp = _elementary(math.exp, math.exp)
_log = _elementary(math.log, lambda x: 1.0 / x)
DUAL_FUNCTIONS: dict[str, Callable[..., DualNumber]] = {
    "sqrt": _elementary(math.sqrt, lambda x: 0.5 / math.sqrt(x) if x else math.inf),
    "exp": _exp,
    "log": _log,
    "sin": _elementary(math.sin, math.cos),
    "cos": _elementary(math.cos, lambda x: -math.sin(x)),
    "degrees": _elementary(math.degrees, lambda x: math.degrees(1.0)),
    "abs": abs,
    "min": partial(min, key=operator.attrgetter("value")),
    "max": partial(max, key=operator.attrgetter("value")),
}


_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_MAX_CONSTANT = 1e100
_MAX_LENGTH, _MAX_NODES = 2000, 500  # characters, parts
_COMPARISONS = ("<=", ">=", "==")


class MeasureExpression:
    """An expression such as "load(4, 0) / mass" or "min(reach, 6.2) * 2".

    It consists of numbers, + - * / **, parentheses, function calls, and names, which may have
    dots: parameters of the machine such as boom_eye.x. Arguments of functions are expressions, or
    names in quotes.

    Args:
        text: The expression.

    Raises:
        InputError: The text is not a valid expression.
    """

    def __init__(self, text: str):
        self.text = text.strip()
        if not self.text or len(self.text) > _MAX_LENGTH:
            raise InputError(
                f"an expression has {len(self.text)} characters, give 1 to {_MAX_LENGTH}"
            )
        try:
            self._tree = parse_expression(self.text)
        except ValueError as error:
            raise InputError(f"{error}, write such as 2*peak_X + 1") from None
        if sum(1 for _ in ast.walk(self._tree)) > _MAX_NODES:
            raise InputError(f"an expression has more than {_MAX_NODES} parts, make it shorter")
        self(lambda name: np.nan, lambda name, arguments: np.nan, lambda number: np.nan)

    def __call__(
        self,
        evaluate_name: Callable[[str], Any],
        evaluate_call: Callable[[str, tuple[Any, ...]], Any],
        constant: Callable[[float], Any] = float,
    ) -> Any:
        """Evaluate the expression.

        Args:
            evaluate_name: Returns the value of a name.
            evaluate_call: Returns the value of a function for its arguments.
            constant: Converts a number.

        Raises:
            InputError: The result is not a number, such as the root of a negative number.
        """

        def invalid(what: str) -> InputError:
            return InputError(
                f"'{self.text}' has {what}, write numbers, names, + - * / ** and f(x)"
            )

        def evaluate(node: ast.AST) -> Any:
            match node:
                case ast.Constant(value=str(word)):
                    return word
                case ast.Constant(value=int(number) | float(number)) if not isinstance(
                    number, bool
                ):
                    if not abs(number) < _MAX_CONSTANT:
                        raise invalid("a number that is not finite")
                    return constant(float(number))
                case ast.Constant(value=value):
                    raise invalid(f"{value!r}")
                case ast.UnaryOp(op=ast.USub(), operand=operand):
                    return -evaluate(operand)
                case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                    return evaluate(operand)
                case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                    return _OPERATORS[type(op)](evaluate(left), evaluate(right))
                case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                    return evaluate_call(name, tuple(map(evaluate, args)))
                case ast.Name() | ast.Attribute():
                    return evaluate_name(_dotted_name(node))
                case ast.Starred():
                    raise invalid("a star")
            raise invalid(f"'{ast.unparse(node)}'")

        try:
            result = evaluate(self._tree)
        except (ArithmeticError, ValueError, TypeError) as error:
            raise InputError(f"'{self.text}' has no value: {error}") from None
        value = getattr(result, "value", result)
        if isinstance(value, complex | str):
            raise InputError(f"'{self.text}' has no value: it is {value!r}, no number")
        return result


def parse_requirement(text: str) -> tuple[MeasureExpression, bool]:
    """Parse "A >= B", "A <= B" or "A == B".

    Returns:
        The expression that must not be negative, or that must be 0, and whether it must be 0.

    Raises:
        InputError: The text is no such comparison.
    """
    comparisons = [sign for sign in _COMPARISONS if sign in text]
    sides = text.split(comparisons[0]) if len(comparisons) == 1 else []
    if len(sides) != 2:
        raise InputError(f"'{text}' requires nothing, write A >= B, A <= B or A == B")
    larger, smaller = reversed(sides) if comparisons[0] == "<=" else sides
    for side in sides:
        MeasureExpression(side)
    return MeasureExpression(f"({larger.strip()}) - ({smaller.strip()})"), comparisons[0] == "=="


def _dotted_name(node: ast.AST) -> str:
    match node:
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=value, attr=name):
            return f"{_dotted_name(value)}.{name}"
    raise InputError(f"'{ast.unparse(node)}' is no name")


MeasureFunction = Callable[[Machine], float]


def load_user_measures(
    source: str | Path | Mapping[str, MeasureFunction] | None,
) -> dict[str, MeasureFunction]:
    """Return functions of a machine by name: those given, or all public ones of a Python file.

    The file is executed without restrictions; load only files that you trust.

    Raises:
        InputError: The file does not exist, raises, or has no function of one machine.
    """
    if source is None:
        return {}
    if isinstance(source, Mapping):
        return dict(source)
    path = Path(source)
    if not path.is_file():
        raise InputError(f"there is no file '{path}' of measures")
    spec = importlib.util.spec_from_file_location(f"crane_measures_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError(f"'{path}' is no Python file, call it {path.stem}.py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{path}: {type(error).__name__}: {error}") from error
    functions: dict[str, MeasureFunction] = {
        name: function
        for name, function in vars(module).items()
        if inspect.isfunction(function)
        and function.__module__ == module.__name__
        and not name.startswith("_")
        and len(inspect.signature(function).parameters) == 1
    }
    if not functions:
        raise InputError(
            f"{path} has no function of a machine, write: def name(machine): return ..."
        )
    return functions


def transferable_measures(
    source: str | Path | Mapping[str, MeasureFunction] | None,
) -> str | Mapping[str, MeasureFunction] | None:
    """Return measures for another process, which may run in another folder."""
    return source if source is None or isinstance(source, Mapping) else str(Path(source).resolve())


def measure_source(
    source: str | Path | Mapping[str, MeasureFunction] | None,
) -> str | Mapping[str, MeasureFunction]:
    """Return what determines measures: their functions, or the text of the file."""
    if isinstance(source, Mapping):
        return source
    return "" if source is None else Path(source).read_text(encoding="utf-8", errors="replace")


def evaluate_user_measure(name: str, function: MeasureFunction, machine: Machine) -> float:
    """Return the value of a user's function for a machine.

    Raises:
        InputError: The function raises, or does not return a number.
    """
    try:
        return float(function(machine))
    except Exception as error:
        raise InputError(f"measure '{name}': {type(error).__name__}: {error}") from error
