"""Functions, files and nesting stay within what one reads in one go."""

import ast

from package_source import PACKAGE, nodes

MAX_FUNCTION_LINES = 80  # without the docstring
MAX_FILE_LINES = 450
MAX_DEEP_SHARE = 0.03  # of functions with three levels of nesting or more; `elif` is one
MAX_STATEMENTS = 53_508
_BLOCKS = ast.If | ast.For | ast.While | ast.With | ast.Try | ast.Match


def functions():
    """Each function of the package with its file."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef):
                yield path, node


def length(function):
    """Lines of a function without its docstring."""
    lines = function.end_lineno - function.lineno + 1
    if ast.get_docstring(function):
        lines -= function.body[0].end_lineno - function.body[0].lineno + 1
    return lines


def depth(node):
    """Levels of blocks in a node, functions in it aside; each `elif` is a level."""
    deepest = 0
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.ClassDef | ast.Lambda):
            continue
        deepest = max(deepest, isinstance(child, _BLOCKS) + depth(child))
    return deepest


def test_no_function_is_longer_than_a_screen():
    long = {f"{p.name}:{f.name}": length(f) for p, f in functions()}
    assert {name: n for name, n in long.items() if n > MAX_FUNCTION_LINES} == {}


def test_no_file_is_longer_than_its_limit():
    lines = {p.name: len(p.read_text().splitlines()) for p in PACKAGE.rglob("*.py")}
    assert {name: n for name, n in lines.items() if n > MAX_FILE_LINES} == {}


def test_few_functions_are_nested_deeply():
    depths = [depth(f) for _, f in functions()]
    assert sum(d >= 3 for d in depths) <= MAX_DEEP_SHARE * len(depths)


def test_the_package_does_not_grow():
    count = sum(isinstance(x, ast.stmt) for p in PACKAGE.rglob("*.py") for x in nodes(p))
    assert count <= MAX_STATEMENTS
