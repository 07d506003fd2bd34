"""What the package's own files say, as far as that is what runs."""

import functools
import hashlib
import operator
import os
import sys
from collections.abc import Mapping
from types import FunctionType, ModuleType
from typing import Any

import crane

_PACKAGE_ROOT = os.path.dirname(os.path.abspath(crane.__file__))
_CLOCK_RESOLUTION = 2.0  # [s] by which the times of files may be coarse
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
    "crane", "llvmlite", "numpy", "pinocchio", "scipy",
}  # fmt: skip


def package_digest() -> str | None:
    """A digest of all files of the package; None where something else runs.

    That is where a file has changed since the package was loaded, or where a function or a class
    of someone else's has been put into one of the modules that make formulas. Numbers put in place
    of the package's own while Python runs are not noticed.
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
    """Whether functions or classes of the modules that make formulas are not theirs."""
    for name, module in list(sys.modules.items()):
        if (
            name.startswith("crane.")
            and name.split(".")[1] in _FORMULA_PACKAGES
            and not _is_unchanged(name, module)
        ):
            tables = _module_tables(name, module)
            if any(
                _is_foreign(_underlying_function(x))
                for table in tables
                for x in list(table.values())
            ):
                return True
            _unpatched_tables[name] = [(table, list(table.values())) for table in tables]
    return False


# of modules in which all was theirs, what stood in their tables
_unpatched_tables: dict[str, list[tuple[Mapping[str, Any], list[Any]]]] = {}


def _is_unchanged(name: str, module: ModuleType) -> bool:
    """Whether in a module that was sound stands what stood there."""
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
    """The names of a module, its tables, and what is in the classes that it defines."""
    found: list[Mapping[str, Any]] = [vars(module)]
    for word, value in list(vars(module).items()):
        if isinstance(value, dict) and word != "__builtins__":
            found.append(value)
        elif isinstance(value, type) and value.__module__ == name:
            found.append(vars(value))
    return found


def _underlying_function(value: Any) -> Any:
    """What stands behind a property or a method of a class."""
    if isinstance(value, property):
        return value.fget
    if isinstance(value, functools.cached_property):
        return value.func
    return value.__func__ if isinstance(value, _METHOD_TYPES) else value


def _is_foreign(value: Any) -> bool:
    return isinstance(value, _CODE_TYPES) and not _is_trusted(value.__module__)


@functools.cache
def _is_trusted(module: str | None) -> bool:
    root = str(module).partition(".")[0]
    return root in _TRUSTED_PACKAGES or root.startswith("namedtuple_")


@functools.cache
def _files_digest() -> str | None:
    """Of names and contents; None where they may not be those that were loaded."""
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
