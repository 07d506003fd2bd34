"""Measures of a user's own: Python functions of a machine."""

import importlib.util
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path

from crane.common.errors import InputError
from crane.machine import Machine

MeasureFunction = Callable[[Machine], float]


def load_user_measures(
    source: str | Path | Mapping[str, MeasureFunction] | None,
) -> dict[str, MeasureFunction]:
    """Functions of a machine by name: given, or all public ones that a Python file defines.

    The file is run: whoever wrote it does what Python can.

    Raises:
        InputError: There is no such file, it raises, or it has no function of one machine.
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
    """The same for another process, which may stand in another folder."""
    return source if source is None or isinstance(source, Mapping) else str(Path(source).resolve())


def evaluate_user_measure(name: str, function: MeasureFunction, machine: Machine) -> float:
    """What a user's function says of a machine.

    Raises:
        InputError: It raises, or says no number.
    """
    try:
        return float(function(machine))
    except Exception as error:
        raise InputError(f"measure '{name}': {type(error).__name__}: {error}") from error
