"""What does not come with the package by itself."""

from importlib import import_module
from typing import Any

from crane.common.errors import InputError

# Module: what its library is called, and the extra of pyproject.toml that brings it.
_LIBRARIES = {
    "casadi": ("CasADi", "casadi"),
    "control": ("python-control", "control"),
    "cvxpy": ("CVXPY", "feasible"),
    "distributed": ("Dask", "cluster"),
    "mujoco": ("MuJoCo", "mjcf"),
    "viser": ("viser", "live"),
}


def import_optional_library(module: str, purpose: str) -> Any:
    """A library of an extra, imported.

    Args:
        module: Its name in Python.
        purpose: What needs it, for the error.

    Raises:
        InputError: It is not installed.
    """
    name, extra = _LIBRARIES[module]
    try:
        return import_module(module)
    except ImportError:
        raise InputError(f"{purpose} needs {name}, {installation_hint(extra)}") from None


def installation_hint(extra: str) -> str:
    """How to install an extra of pyproject.toml, from the repository.

    The package is on no index, and whoever registers its name there would be installed: the name
    is not told.
    """
    return f"install it in the repository's folder: pip install '.[{extra}]'"
