"""Numbers read from texts: digits 0 to 9, a point and an exponent, in every file and option.

Python also reads other scripts' digits and underscores between digits (1_000), and in expressions
other bases (0x10); tables of numbers do not, and a number shall mean the same everywhere.
"""

import ast
import re


def parse_float(text: str) -> float:
    """The number that a text is.

    Raises:
        ValueError: It is none.
    """
    check_digits(text)
    return float(text)


def check_digits(text: str) -> None:
    """Check that a text has no digits and separators that only Python reads.

    Raises:
        ValueError: It has.
    """
    if not text.isascii() or "_" in text:
        raise ValueError(f"'{text}' is not a number")


def parse_expression(text: str) -> ast.expr:
    """Syntax tree of a Python expression whose numbers are those of `parse_float`.

    Raises:
        ValueError: It is no expression, or a number is none.
    """
    try:
        tree = ast.parse(text, mode="eval").body
    except (SyntaxError, MemoryError, RecursionError):
        raise ValueError(f"'{text[:80]}' is no expression") from None
    numbers = [
        ast.get_source_segment(text, node) or ""
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and type(node.value) in (int, float)
    ]
    if wrong := [x for x in numbers if re.fullmatch("[0-9.eE+-]+", x) is None]:
        raise ValueError(f"'{wrong[0]}' is not a number")
    return tree
