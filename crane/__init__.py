"""crane: dynamics, simulation and identification of machines with closed kinematic chains.

The root has what short programs need. All else stands in submodules: `closure`, `control`,
`description`, `dynamics`, `export`, `formats`, `hydraulics`, `identification`, `machine`,
`motion`, `ratings`, `recordings`, `simulation`, `studies` and `view`. Names are listed in the stub
beside this file, and imported when they are first used.
"""

import sys
import time
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import lazy_loader

__version__ = "0.3.0"
LOADED = time.time()  # before any other file of the package was read

from crane.common import one_line_repr as _one_line_repr  # noqa: E402
from crane.common import result as _result  # noqa: E402

_lazy_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name in __all__ or name.startswith("_") or find_spec(f"crane.{name}"):
        return _lazy_attribute(name)
    rooms = [f"crane.{x}" for x in __all__ if find_spec(f"crane.{x}")]
    homes = [room for room in rooms if name in import_module(room).__all__]
    hint = f"use {homes[0]}.{name}" if homes else "docs/names_0_3.md lists names of 0.2 and of 0.3"
    raise AttributeError(f"module 'crane' has no attribute '{name}', {hint}")


def _to_html(what: Any) -> str | None:
    from crane.view.notebook import to_html

    return to_html(what)


def _watch_cells() -> None:
    """Show the progress of long calls in a notebook."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if hasattr(shell, "kernel"):
        from crane.view.notebook_progress import show_cell_progress

        show_cell_progress(shell)


def _write_result(*arguments: Any, **options: Any) -> str:
    from crane.view.result_files import write_result

    return write_result(*arguments, **options)


_one_line_repr.to_html = _to_html
_result.write_result = _write_result
_watch_cells()
