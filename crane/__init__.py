"""crane: dynamics, simulation and identification of machines with closed kinematic chains.

The root has what short programs need. All else stands in submodules: `closure`, `control`,
`description`, `dynamics`, `formats`, `hydraulics`, `identification`, `machine`, `motion`,
`ratings`, `recordings`, `simulation`, `studies` and `view`. Names are listed in the stub beside
this file, and imported when they are first used.
"""

import sys
import time
from typing import Any

import lazy_loader

__version__ = "0.3.0"
LOADED = time.time()  # before any other file of the package was read

from crane.common import one_line_repr as _one_line_repr  # noqa: E402
from crane.common import result as _result  # noqa: E402

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


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
