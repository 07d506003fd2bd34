"""The syntax trees of the package's files, each parsed once."""

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "crane"


@cache
def tree(path: Path) -> ast.Module:
    """Syntax tree of a file."""
    return ast.parse(path.read_text())


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All nodes of a file."""
    return tuple(ast.walk(tree(path)))
