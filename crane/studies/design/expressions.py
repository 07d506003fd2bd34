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
_LARGEST = 1e100
_LONGEST, _MOST = 2000, 500  # characters, parts
_COMPARES = ("<=", ">=", "==")


class Expression:
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
        if not self.text or len(self.text) > _LONGEST:
            raise InputError(
                f"an expression has {len(self.text)} characters, give 1 to {_LONGEST}"
            )
        try:
            self._tree = ast.parse(self.text, mode="eval").body
        except (SyntaxError, ValueError, MemoryError, RecursionError):
            raise InputError(
                f"'{self.text[:80]}' is no expression, write such as 2*peak_X + 1"
            ) from None
        if sum(1 for _ in ast.walk(self._tree)) > _MOST:
            raise InputError(f"an expression has more than {_MOST} parts, make it shorter")
        self._check(self._tree)

    def __repr__(self) -> str:
        return f"Expression '{self.text}'"

    def __call__(
        self,
        named: Callable[[str], Any],
        called: Callable[[str, tuple[Any, ...]], Any],
        constant: Callable[[float], Any] = float,
    ) -> Any:
        """Its value.

        Args:
            named: What a name stands for.
            called: What a function gives, of its arguments.
            constant: What a number becomes.

        Raises:
            InputError: What it asks for is not a number: a root of something negative.
        """
        try:
            found = self._value(self._tree, named, called, constant)
        except (ArithmeticError, ValueError, TypeError) as error:
            raise InputError(f"'{self.text}' has no value: {error}") from None
        value = getattr(found, "value", found)
        if isinstance(value, complex | str):
            raise InputError(f"'{self.text}' has no value: it is {value!r}, no number")
        return found

    def _value(self, node: ast.AST, named: Any, called: Any, constant: Any) -> Any:
        match node:
            case ast.Constant(value=str(word)):
                return word
            case ast.Constant(value=int(number) | float(number)):
                return constant(float(number))
            case ast.Name() | ast.Attribute():
                return named(_dotted(node))
            case ast.UnaryOp(op=op, operand=operand):
                value = self._value(operand, named, called, constant)
                return -value if isinstance(op, ast.USub) else value
            case ast.BinOp(left=left, op=op, right=right):
                two = [self._value(side, named, called, constant) for side in (left, right)]
                return _OPERATORS[type(op)](*two)
            case ast.Call(func=func, args=args):
                given = tuple(self._value(x, named, called, constant) for x in args)
                return called(_dotted(func), given)
        raise AssertionError(node)

    def _check(self, node: ast.AST) -> None:
        def refuse(what: str) -> InputError:
            return InputError(
                f"'{self.text}' has {what}, write numbers, names, + - * / ** and f(x)"
            )

        match node:
            case ast.Constant(value=value):
                if isinstance(value, bool) or not isinstance(value, int | float | str):
                    raise refuse(f"{value!r}")
                if not isinstance(value, str) and not abs(value) < _LARGEST:
                    raise refuse("a number that is not finite")
            case ast.Name() | ast.Attribute():
                _dotted(node)
            case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
                self._check(operand)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                self._check(left)
                self._check(right)
            case ast.Call(func=ast.Name(), args=args, keywords=[]):
                for x in args:
                    if isinstance(x, ast.Starred):
                        raise refuse("a star")
                    self._check(x)
            case _:
                raise refuse(f"'{ast.unparse(node)}'")


def requirement(text: str) -> tuple[Expression, bool]:
    """What has to be at least 0, or 0, from "A >= B", "A <= B" or "A == B"; and whether it is 0.

    Raises:
        InputError: It is no such comparison.
    """
    signs = [sign for sign in _COMPARES if sign in text]
    sides = text.split(signs[0]) if len(signs) == 1 else []
    if len(sides) != 2:
        raise InputError(f"'{text}' requires nothing, write A >= B, A <= B or A == B")
    one, two = reversed(sides) if signs[0] == "<=" else sides
    for side in sides:
        Expression(side)
    return Expression(f"({one.strip()}) - ({two.strip()})"), signs[0] == "=="


def _dotted(node: ast.AST) -> str:
    match node:
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=value, attr=name):
            return f"{_dotted(value)}.{name}"
    raise InputError(f"'{ast.unparse(node)}' is no name")
