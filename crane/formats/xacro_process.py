"""A process that expands a xacro file, so that the file can crash only this process.

`crane.formats.robot_files` runs it with its request as JSON on the standard input; it writes a
line of JSON. Time and memory are limited. Unless the request trusts the file, its expressions are
restricted to data, it reads files of its own package, of packages that it names and of the folders
of the user, and no environment variables but those of ROS's version.

xacro evaluates `${...}` and `$(eval ...)` as Python with most built-in functions removed, which a
file can get back through attributes of objects. Here an expression is a syntax tree of literals,
names, operators, conditional expressions, indexing, comprehensions, f-strings and calls;
attributes are those of numbers, texts and containers, without leading underscore.

The attribute `LOCATION_ATTRIBUTE` of every element of the result contains index of the file and
line.
"""

import ast
import builtins
import errno
import json
import os
import re
import string
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.dom import expatbuilder
from xml.parsers.expat import ExpatError

_WORKSPACE_LEVELS = 3  # from the folder of a file to that of its package's neighbours
MAX_LENGTH = 50_000_000  # characters of an expanded file
LOCATION_ATTRIBUTE = "crane_place"
_XACRO_PREFIX = "xacro:"
_VARIABLES = ("ROS_DISTRO", "ROS_VERSION", "ROS_PYTHON_VERSION")  # that each file may read


def main() -> None:
    """Expand the file of the request."""
    output = os.fdopen(os.dup(1), "w", encoding="utf-8")
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)  # expressions cannot write into the output
    os.dup2(null_device, 2)
    request = json.load(sys.stdin)
    sys.path.insert(0, request["root"])
    try:
        import xacro
    except ImportError:
        answer: dict[str, Any] = {"missing": True}
    else:
        answer = _expand(xacro, request)
    output.write(json.dumps(answer) + "\n")
    output.flush()


class _ReadableFolders:
    """The folders whose files a xacro file may read.

    Args:
        file: The first file; its package, or without one its folder, is readable.
        packages: Folders that the user gave.
    """

    def __init__(self, file: Path, packages: list[str]) -> None:
        from crane.common.package_search import enclosing_package

        self._file, self._enclosing_package = file.resolve(), enclosing_package
        self._folders = {Path(package).resolve() for package in packages}
        for folder in (file.absolute().parent, self._file.parent):
            self._folders.add((enclosing_package(folder) or folder).resolve())

    def add_package(self, folder: Path) -> None:
        """Add a package, and its source if it is installed by links.

        Any folder has the name of a package, so one without a manifest is added only if it is near
        the first file: it contains the file, or is in one of the folders that do, at most
        `_WORKSPACE_LEVELS` above it and below the user's home.
        """
        if self._enclosing_package(folder) == folder:
            self._folders |= {folder.resolve(), (folder / "package.xml").resolve().parent}
            return
        nearby = self._file.parents[: _WORKSPACE_LEVELS + 1]
        workspace = [x for x in nearby if not Path.home().is_relative_to(x)]
        if {folder.resolve(), folder.resolve().parent} & {*workspace}:
            self._folders.add(folder.resolve())

    def check(self, file: str | Path) -> Path:
        """Return a path if it is in one of the folders.

        Raises:
            PermissionError: It is not.
        """
        if not any(Path(file).resolve().is_relative_to(folder) for folder in self._folders):
            reason = "not in its package, give --packages FOLDER or --trust-xacro"
            raise PermissionError(errno.EACCES, reason, str(file))
        return Path(file)


class _LocationBuilder(expatbuilder.ExpatBuilderNS):
    """Builds the document of a file with the locations of all elements but those of xacro.

    Args:
        number: Index of the file.
        arguments: Receives the arguments of the file.
    """

    def __init__(self, number: int, arguments: dict[str, None]):
        super().__init__()
        self._number, self._arguments = number, arguments

    def start_element_handler(self, name: str, attributes: list[str]) -> None:
        """Called at each element."""
        super().start_element_handler(name, attributes)
        element: Any = self.curNode
        if not element.tagName.startswith(_XACRO_PREFIX):
            element.setAttribute(
                LOCATION_ATTRIBUTE, f"{self._number}:{self.getParser().CurrentLineNumber}"
            )
        elif element.localName == "arg":
            self._arguments[element.getAttribute("name")] = None


def _expand(xacro: Any, request: dict[str, Any]) -> dict[str, Any]:
    from crane.formats.visuals.mesh_process import MAX_MEMORY, limit_resources

    limit_resources()
    folders = _ReadableFolders(Path(request["file"]), request["packages"])
    readable_path: Callable[[str], Path] = Path if request["trust"] else folders.check
    names: list[str] = []
    arguments: dict[str, None] = {}
    missing: list[str] = []
    _provide_package_search(request, folders, missing, xacro)
    if not request["trust"]:
        _restrict(xacro, folders)

    def parse(inp: Any, filename: str | None = None) -> Any:
        if filename is None:
            return inp
        names.append(filename)
        try:
            builder = _LocationBuilder(len(names) - 1, arguments)
            return builder.parseString(readable_path(filename).read_bytes())
        except OSError as error:
            xacro.filestack.pop()
            raise xacro.XacroException(f"{error.strerror}: {filename}", exc=error) from None

    xacro.parse = parse
    found: dict[str, Any] = {}
    try:
        text = xacro.process_file(request["file"], mappings=dict(request["arguments"])).toxml()
        if len(text) > MAX_LENGTH:
            return {"wrong": f"it grows beyond {MAX_LENGTH} characters", "file": request["file"]}
        found["text"] = text
    except ExpatError as error:
        words = str(error).partition(": line")[0]
        found = {"wrong": f"not XML, {words}", "file": names[-1], "line": error.lineno}
    except MemoryError:
        found["wrong"] = f"expanding it takes more than {MAX_MEMORY >> 30} GB"
    except RecursionError:
        found["wrong"] = "its macros or files use themselves without end"
    except Exception as error:  # xacro and expressions raise anything
        found["wrong"] = " ".join(str(error).split())[:300] or type(error).__name__
        if not request["trust"]:  # few variables are known
            hint = r"the \1 is not read, give --trust-xacro"
            found["wrong"] = re.sub(r".*(environment variable '\w*') is .*", hint, found["wrong"])
    if "wrong" in found and missing:
        found |= {"package": missing[0]}
    stack = [name for name in (getattr(xacro, "filestack", None) or []) if name]
    return {"file": stack[-1] if stack else request["file"], "files": names,
            "arguments": list(arguments), **found}  # fmt: skip


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
        return ast.Call(
            ast.Name(_ATTRIBUTE_FUNCTION, ast.Load()), [node.value, ast.Constant(node.attr)], []
        )


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


def _restrict(xacro: Any, folders: _ReadableFolders) -> None:
    """Restrict xacro to expressions of data, to readable folders, and to few variables."""
    from xacro import substitution_args

    restrict_expressions(xacro, substitution_args)
    xacro.open = lambda file: folders.check(file).open()  # for `load_yaml`
    variables = {name: os.environ[name] for name in _VARIABLES if name in os.environ}
    substitution_args.os = types.SimpleNamespace(environ=variables, path=os.path)


def _provide_package_search(
    request: dict[str, Any], folders: _ReadableFolders, missing_packages: list[str], xacro: Any
) -> None:
    """Make xacro find packages as this package does, whether ROS is installed or not."""
    from crane.common.package_search import find_file, find_package, use_load_options

    folder, packages = Path(request["file"]).parent, request["packages"]
    original_function = xacro.abs_filename_spec

    def share(name: str) -> str:
        here = Path(next((x for x in reversed(xacro.filestack or []) if x), folder / "x")).parent
        with use_load_options(packages):
            found = find_package(name, here) or find_package(name, folder)
        if found is None:
            missing_packages.append(name)
            raise LookupError(f"package '{name}' is not found")
        folders.add_package(found)
        return str(found)

    def absolute(name: str) -> str:
        if "://" not in name:
            return str(original_function(name))
        package = name.partition("://")[2].partition("/")[0]
        with use_load_options(packages):
            found, package_folder = find_file(name, folder), find_package(package, folder)
        if package_folder is not None:
            folders.add_package(package_folder)
        elif found is None:
            missing_packages.append(package)
        if found is None:
            raise LookupError(f"there is no '{name}'")
        return str(found)

    replacement_module = types.ModuleType("ament_index_python.packages")
    replacement_module.get_package_share_directory = share  # type: ignore[attr-defined]
    sys.modules["ament_index_python"] = types.ModuleType("ament_index_python")
    sys.modules["ament_index_python.packages"] = replacement_module
    xacro.abs_filename_spec = absolute


if __name__ == "__main__":
    main()
