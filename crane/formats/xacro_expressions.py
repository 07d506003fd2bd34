"""Evaluation of the expressions of xacro files, restricted to data.

xacro evaluates `${...}` and `$(eval ...)` as Python with most built-in functions removed, which a
file can get back through attributes of objects. Here an expression is a syntax tree of literals,
names, operators, conditional expressions, indexing, comprehensions, f-strings and calls;
attributes are those of numbers, texts and containers, without leading underscore.
"""

import ast
import builtins
import re
import string
from typing import Any

_NODES = (
    ast.Expression, ast.Constant, ast.Name, ast.Load, ast.Store, ast.BinOp, ast.UnaryOp,
    ast.BoolOp, ast.operator, ast.unaryop, ast.boolop, ast.Compare, ast.cmpop, ast.IfExp,
    ast.Subscript,
    ast.Slice, ast.List, ast.Tuple, ast.Dict, ast.Set, ast.ListComp, ast.SetComp, ast.DictComp,
    ast.GeneratorExp, ast.comprehension, ast.Attribute, ast.Call, ast.keyword, ast.Starred,
    ast.JoinedStr, ast.FormattedValue,
)  # fmt: skip
_DATA = (bool, int, float, complex, str, list, tuple, dict, set, frozenset)
_UNSAFE_FUNCTIONS = ("type", "vars")  # of xacro's namespace `python`: they reach into objects
_ATTRIBUTE_FUNCTION = "__attribute"
_FUNCTIONS = ("list", "dict", "map", "str", "float", "int")  # those of `$(eval ...)`


class UnsafeExpressionError(ValueError):
    """An expression that could do more than compute with data."""


class _FieldFormatter(string.Formatter):
    """`str.format` whose fields are arguments, without attributes and items of these."""

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> Any:
        if not re.fullmatch(r"\w*", field_name):
            raise UnsafeExpressionError(f"'{{{field_name}}}' is not allowed in format")
        return super().get_field(field_name, args, kwargs)


class _AttributeCalls(ast.NodeTransformer):
    """Check of a syntax tree, and replacement of its attributes by calls that check the object."""

    def visit(self, node: ast.AST) -> Any:
        if not isinstance(node, _NODES):
            raise UnsafeExpressionError(f"{type(node).__name__} is not allowed in an expression")
        if isinstance(node, ast.Name) and node.id.startswith("__"):
            raise UnsafeExpressionError(f"the name '{node.id}' is not allowed")
        return super().visit(node)

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        self.generic_visit(node)
        if node.attr.startswith("_"):
            raise UnsafeExpressionError(f"the attribute '{node.attr}' is not allowed")
        function = ast.Name(_ATTRIBUTE_FUNCTION, ast.Load())
        return ast.Call(function, [node.value, ast.Constant(node.attr)], [])


def restrict_expressions(xacro: Any, substitution: Any) -> None:
    """Make xacro evaluate expressions by the rules of this module.

    Args:
        xacro: The module xacro.
        substitution: Its module `substitution_args`, which evaluates `$(eval ...)`.
    """
    data = (*_DATA, xacro.YamlListWrapper, xacro.YamlDictWrapper, xacro.NameSpace)

    def attribute(value: object, name: str) -> Any:
        if type(value) not in data or name == "format_map":
            raise UnsafeExpressionError(f"'{name}' of {type(value).__name__} is not allowed")
        if type(value) is str and name == "format":
            return lambda *args, **kwargs: _FieldFormatter().vformat(value, args, kwargs)
        return getattr(value, name)

    functions = {name: getattr(builtins, name) for name in _FUNCTIONS}
    functions[_ATTRIBUTE_FUNCTION] = attribute

    def evaluate(text: str, symbols: dict[str, Any], more_symbols: Any = None) -> Any:
        symbols.update(__builtins__=functions)
        tree = _AttributeCalls().visit(ast.parse(text.strip(), "<expression>", "eval"))
        code = compile(ast.fix_missing_locations(tree), "<expression>", "eval")
        return eval(code, symbols, more_symbols)

    for name in _UNSAFE_FUNCTIONS:
        dict.pop(xacro._global_symbols["python"], name)
    xacro.safe_eval = substitution.eval = evaluate
