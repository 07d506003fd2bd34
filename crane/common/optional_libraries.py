"""Optional libraries, which extras of the package install."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from crane.common.errors import InputError

# Module: name of the library, and the extra of pyproject.toml that installs it.
_LIBRARIES = {
    "casadi": ("CasADi", "casadi"),
    "control": ("python-control", "control"),
    "cvxpy": ("CVXPY", "feasible"),
    "distributed": ("Dask", "cluster"),
    "fmpy": ("FMPy", "fmu"),
    "mujoco": ("MuJoCo", "mjcf"),
    "pypdfium2": ("pypdfium2", "draw"),
    "viser": ("viser", "live"),
}


def import_optional_library(module: str, purpose: str) -> Any:
    """Import the library of an extra.

    Args:
        module: Its module name.
        purpose: The feature that needs it, for the error.

    Raises:
        InputError: It is not installed.
    """
    name, extra = _LIBRARIES[module]
    try:
        return import_module(module)
    except ImportError:
        raise InputError(f"{purpose} needs {name}, {installation_hint(extra)}") from None


def is_installed(module: str) -> bool:
    """Whether an optional library is installed."""
    return find_spec(module) is not None


def installation_hint(extra: str) -> str:
    """How to install an extra of pyproject.toml, from the repository.

    The hint does not use the package's name: it is not registered on PyPI, and whoever registers
    it would be installed.
    """
    return f"install it in the repository's folder: pip install '.[{extra}]'"
