"""Cells of a notebook that take long say what goes on: one line with a bar, gone in the end."""

from types import FrameType
from typing import Any

from crane.common.waiting import SHARES, Watch, doing


def watch_cells(shell: Any) -> None:
    """From this cell of a notebook on, tell what goes on in those that take long.

    Args:
        shell: IPython's, of a kernel.
    """
    bar = _Bar()
    shell.events.register("pre_run_cell", lambda *_: bar.begin())
    shell.events.register("post_run_cell", lambda *_: bar.end())
    SHARES.listening = True
    bar.begin()


class _Bar:
    """The line of a cell."""

    def __init__(self) -> None:
        self._watch: Watch | None = None
        self._handle: Any = None

    def begin(self) -> None:
        """A cell begins."""
        self.end()
        self._watch = Watch(self._tell)
        self._watch.start()

    def end(self) -> None:
        """It is over: no line stays."""
        if self._watch is not None:
            self._watch.end()
        if self._handle is not None:
            self._handle.update(_Line(""))
        self._watch = self._handle = None
        SHARES.forget()

    def _tell(self, frame: FrameType | None, seconds: float) -> None:
        if not (what := doing(frame)):
            return  # of what is not the package's nothing is known
        share = SHARES.of(frame)
        value = "" if share is None else f' value="{share:.3f}"'
        done = "" if share is None else f"{share:.0%}, "
        line = _Line(f"<progress{value}></progress> {what}, {done}{seconds:.0f} s")
        if self._handle is None:
            from IPython.display import display

            self._handle = display(line, display_id=True)
        else:
            self._handle.update(line)


class _Line:
    """A line of HTML."""

    def __init__(self, html: str):
        self._html = html

    def __repr__(self) -> str:
        return ""

    def _repr_html_(self) -> str:
        return self._html
