"""Expressions of measures: parsed once, evaluated with whatever has arithmetic."""

import ast
from collections.abc import Callable
from typing import Any

from crane.common.errors import InputError

_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: lambda a, b: a**b,
}
_MAX_CONSTANT = 1e100
_MAX_LENGTH, _MAX_NODES = 2000, 500  # characters, parts
_COMPARISONS = ("<=", ">=", "==")


class MeasureExpression:
    """An expression such as "load(4, 0) / mass" or "min(reach, 6.2) * 2".

    Numbers, + - * / **, parentheses, calls of functions, and names, which may have dots:
    numbers of the machine such as boom_eye.x. Arguments of functions are numbers, or names in
    quotes.

    Args:
        text: As it is written.

    Raises:
        InputError: It is no such expression.
    """

    def __init__(self, text: str):
        self.text = text.strip()
        if not self.text or len(self.text) > _MAX_LENGTH:
            raise InputError(
                f"an expression has {len(self.text)} characters, give 1 to {_MAX_LENGTH}"
            )
        try:
            self._tree = ast.parse(self.text, mode="eval").body
        except (SyntaxError, ValueError, MemoryError, RecursionError):
            raise InputError(
                f"'{self.text[:80]}' is no expression, write such as 2*peak_X + 1"
            ) from None
        if sum(1 for _ in ast.walk(self._tree)) > _MAX_NODES:
            raise InputError(f"an expression has more than {_MAX_NODES} parts, make it shorter")
        self._check_node(self._tree)

    def __repr__(self) -> str:
        return f"Expression '{self.text}'"

    def __call__(
        self,
        evaluate_name: Callable[[str], Any],
        evaluate_call: Callable[[str, tuple[Any, ...]], Any],
        constant: Callable[[float], Any] = float,
    ) -> Any:
        """Its value.

        Args:
            evaluate_name: What a name stands for.
            evaluate_call: What a function gives, of its arguments.
            constant: What a number becomes.

        Raises:
            InputError: What it asks for is not a number: a root of something negative.
        """
        try:
            result = self._evaluate_node(self._tree, evaluate_name, evaluate_call, constant)
        except (ArithmeticError, ValueError, TypeError) as error:
            raise InputError(f"'{self.text}' has no value: {error}") from None
        value = getattr(result, "value", result)
        if isinstance(value, complex | str):
            raise InputError(f"'{self.text}' has no value: it is {value!r}, no number")
        return result

    def _evaluate_node(
        self, node: ast.AST, evaluate_name: Any, evaluate_call: Any, constant: Any
    ) -> Any:
        match node:
            case ast.Constant(value=str(word)):
                return word
            case ast.Constant(value=int(number) | float(number)):
                return constant(float(number))
            case ast.Name() | ast.Attribute():
                return evaluate_name(_dotted_name(node))
            case ast.UnaryOp(op=op, operand=operand):
                value = self._evaluate_node(operand, evaluate_name, evaluate_call, constant)
                return -value if isinstance(op, ast.USub) else value
            case ast.BinOp(left=left, op=op, right=right):
                operands = [
                    self._evaluate_node(side, evaluate_name, evaluate_call, constant)
                    for side in (left, right)
                ]
                return _OPERATORS[type(op)](*operands)
            case ast.Call(func=func, args=args):
                arguments = tuple(
                    self._evaluate_node(x, evaluate_name, evaluate_call, constant) for x in args
                )
                return evaluate_call(_dotted_name(func), arguments)
        raise AssertionError(node)

    def _check_node(self, node: ast.AST) -> None:
        def create_error(what: str) -> InputError:
            return InputError(
                f"'{self.text}' has {what}, write numbers, names, + - * / ** and f(x)"
            )

        match node:
            case ast.Constant(value=value):
                if isinstance(value, bool) or not isinstance(value, int | float | str):
                    raise create_error(f"{value!r}")
                if not isinstance(value, str) and not abs(value) < _MAX_CONSTANT:
                    raise create_error("a number that is not finite")
            case ast.Name() | ast.Attribute():
                _dotted_name(node)
            case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
                self._check_node(operand)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                self._check_node(left)
                self._check_node(right)
            case ast.Call(func=ast.Name(), args=args, keywords=[]):
                for x in args:
                    if isinstance(x, ast.Starred):
                        raise create_error("a star")
                    self._check_node(x)
            case _:
                raise create_error(f"'{ast.unparse(node)}'")


def parse_requirement(text: str) -> tuple[MeasureExpression, bool]:
    """What has to be at least 0, or 0, from "A >= B", "A <= B" or "A == B"; and whether it is 0.

    Raises:
        InputError: It is no such comparison.
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
