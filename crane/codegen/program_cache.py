"""Cache of programs and results between processes, and the digest of the package's source files.

A program's record is found by what its formulas depend on, so that a later process need not trace
them. It says how to call the functions, and the name of the machine code.
"""

import functools
import hashlib
import json
import operator
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import FunctionType, ModuleType
from typing import Any, TypeVar

import numpy as np

import crane
from crane.codegen.llvm.machine_code import compiler_settings
from crane.codegen.vector_layout import Layout
from crane.common import file_cache
from crane.common.serialization import deserialize, serialize

_PACKAGE_ROOT = os.path.dirname(os.path.abspath(crane.__file__))
_CLOCK_RESOLUTION = 2.0  # [s] resolution of file times
_FORMULA_PACKAGES = (
    "codegen",
    "hydraulics",
    "closure",
    "dynamics",
    "motion",
    "control",
    "simulation",
)
_CODE_TYPES, _METHOD_TYPES = (FunctionType, type), (staticmethod, classmethod)
_TRUSTED_PACKAGES = sys.stdlib_module_names | {
    "crane", "lazy_loader", "llvmlite", "numpy", "pinocchio", "scipy",
}  # fmt: skip


def package_digest() -> str | None:
    """A digest of all files of the package; None if other code runs.

    That is the case where a file has changed since the package was loaded, or where a function or
    class of another package replaces one in a module that creates formulas (a monkeypatch).
    Changed constants are not detected.
    """
    return None if is_patched() else _files_digest()


def package_files_changed() -> bool:
    """Whether a file may have changed since the package was loaded, or there are none."""
    try:
        times = [max(file.st_mtime, file.st_ctime) for file in map(os.stat, _package_files())]
    except OSError:
        return True
    return not times or max(times) > crane.LOADED - _CLOCK_RESOLUTION


def is_patched() -> bool:
    """Whether functions or classes in the modules that create formulas have been replaced."""
    for name, module in list(sys.modules.items()):
        if (
            name.startswith("crane.")
            and name.split(".")[1] in _FORMULA_PACKAGES
            and not _is_unchanged(name, module)
        ):
            tables = _module_tables(name, module)
            if any(_is_foreign(x) for table in tables for x in list(table.values())):
                return True
            _unpatched_tables[name] = [(table, list(table.values())) for table in tables]
    return False


# values in the tables of modules that were checked and not patched
_unpatched_tables: dict[str, list[tuple[Mapping[str, Any], list[Any]]]] = {}


def _is_unchanged(name: str, module: ModuleType) -> bool:
    """Whether the tables of a module still contain the values that were checked before."""
    before = _unpatched_tables.get(name)
    return (
        before is not None
        and before[0][0] is vars(module)
        and all(
            len(table) == len(values) and all(map(operator.is_, list(table.values()), values))
            for table, values in before
        )
    )


def _module_tables(name: str, module: ModuleType) -> list[Mapping[str, Any]]:
    """The namespace of a module, its dicts, and the namespaces of its classes."""
    found: list[Mapping[str, Any]] = [vars(module)]
    for word, value in list(vars(module).items()):
        if isinstance(value, dict) and word != "__builtins__":
            found.append(value)
        if isinstance(value, type) and value.__module__ == name:
            found.append(vars(value))
    return found


def _is_foreign(value: Any) -> bool:
    """Whether a value, or the function of a property or method, is code of another package."""
    if isinstance(value, property):
        return _is_foreign(value.fget)
    if isinstance(value, functools.cached_property):
        value = value.func
    elif isinstance(value, _METHOD_TYPES):
        value = value.__func__
    return isinstance(value, _CODE_TYPES) and not _is_trusted(value.__module__)


@functools.cache
def _is_trusted(module: str | None) -> bool:
    root = str(module).partition(".")[0]
    return root in _TRUSTED_PACKAGES or root.startswith("namedtuple_")


@functools.cache
def _files_digest() -> str | None:
    """Digest of names and contents; None if they may not be those that were loaded."""
    digest = hashlib.sha256()
    for path in _package_files():
        try:
            with open(path, "rb", buffering=0) as file:
                text = file.read()
        except OSError:
            return None
        digest.update(f"{path[len(_PACKAGE_ROOT) :]} {len(text)} ".encode() + text)
    return None if package_files_changed() else digest.hexdigest()


@functools.cache
def _package_files() -> list[str]:
    found = []
    for folder, _, names in os.walk(_PACKAGE_ROOT):
        found += [os.path.join(folder, name) for name in names if name.endswith(".py")]
    return sorted(found)


# number of a function's arguments, and layout of a formula's outputs; None for a routine
FunctionSignature = tuple[int, Layout | None]


def cache_entry_name(dependencies: Any, kind: str = "note") -> str | None:
    """The name of a program's cache record, or None if it cannot be cached.

    It also depends on the package's files, on Python and numpy, and on the compiler.

    Args:
        dependencies: Numbers, texts, bytes, arrays, dataclasses and tuples of them: everything
            else that the program's formulas depend on; None if they depend on other code.
        kind: Kind of the entry.

    Raises:
        TypeError: A dependency of another type, which may not be the same in another process.
    """
    if dependencies is None:
        return None
    content = serialize(dependencies)
    package = package_digest()
    if package is None:
        return None
    return file_cache.entry_name(
        repr((package, (sys.version, np.__version__), compiler_settings(), content)), kind
    )


@dataclass(frozen=True)
class ProgramRecord:
    """Cache record of a program, without its machine code.

    Attributes:
        code_name: Name of the machine code, empty for a program that is too long to compile.
        max_formula_length: Number of operations of its longest formula.
        signatures: Signature of each function, by name.
    """

    code_name: str
    max_formula_length: int
    signatures: Mapping[str, FunctionSignature]

    @classmethod
    def from_cache(cls, entry_name: str | None) -> "ProgramRecord | None":
        """The record with a name, if there is one."""
        text = None if entry_name is None else file_cache.read_entry(entry_name)
        if text is None:
            return None
        with suppress(ValueError, KeyError, TypeError, AttributeError):  # else it is made anew
            stored = json.loads(text)
            functions = {
                name: (count, None if parts is None else Layout(**parts))
                for name, (count, parts) in stored["functions"].items()
            }
            return cls(stored["code"], stored["longest"], functions)
        return None

    def write_to_cache(self, entry_name: str | None) -> None:
        """Write the record, unless the package has changed while the program was built."""
        if entry_name is None or package_files_changed():
            return
        functions = {
            name: (count, None if outputs is None else outputs.parts)
            for name, (count, outputs) in self.signatures.items()
        }
        stored = {
            "code": self.code_name,
            "longest": self.max_formula_length,
            "functions": functions,
        }
        file_cache.write_entry(entry_name, json.dumps(stored).encode())


Result = TypeVar("Result")


def cached_result(
    dependencies: Any, compute: Callable[[], Result], avoided_import: str, classes: Sequence[type]
) -> Result:
    """The result of a function, from the cache if an earlier process has computed it.

    A process that has already imported the slow module computes it: of the thousands of machines
    of a study only one is cached.

    Args:
        dependencies: Everything that it depends on besides code, see `cache_entry_name`.
        compute: Computes it; a value that `crane.common.serialization` can write.
        avoided_import: The slow module of scipy whose import the cache avoids.
        classes: Classes of the objects in the result.
    """
    if avoided_import in sys.modules:
        return compute()
    entry_name = cache_entry_name(
        (dependencies, file_cache.package_build("scipy"), file_cache.package_build("pinocchio")),
        "result",
    )
    cached = None if entry_name is None else file_cache.read_entry(entry_name)
    if cached is not None:
        with suppress(Exception):  # whatever is wrong with it, it is made anew
            found: Result = deserialize(cached, classes)
            return found
    result = compute()
    if entry_name is not None and not package_files_changed():
        file_cache.write_entry(entry_name, serialize(result, classes))
    return result
