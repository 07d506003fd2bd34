"""Progress of long notebook cells: one line with a bar that disappears at the end."""

from types import FrameType
from typing import Any

from crane.common.progress import PROGRESS, MainThreadMonitor, current_activity


def show_cell_progress(shell: Any) -> None:
    """Show the progress of long cells of a notebook from now on.

    Args:
        shell: IPython shell of the kernel.
    """
    bar = _CellProgressBar()
    shell.events.register("pre_run_cell", lambda *_: bar.start())
    shell.events.register("post_run_cell", lambda *_: bar.stop())
    PROGRESS.is_enabled = True
    bar.start()


class _CellProgressBar:
    """Progress line of a cell."""

    def __init__(self) -> None:
        self._monitor: MainThreadMonitor | None = None
        self._display_handle: Any = None

    def start(self) -> None:
        """Start the progress of a cell."""
        self.stop()
        self._monitor = MainThreadMonitor(self._show_progress)
        self._monitor.start()

    def stop(self) -> None:
        """Stop the progress and remove the line."""
        if self._monitor is not None:
            self._monitor.stop()
        if self._display_handle is not None:
            self._display_handle.update(_html_line(""), raw=True)
        self._monitor = self._display_handle = None
        PROGRESS.reset()

    def _show_progress(self, frame: FrameType | None, seconds: float) -> None:
        if not (activity := current_activity(frame)):
            return  # progress is known only inside the package
        share = PROGRESS.finished_share(frame)
        value = "" if share is None else f' value="{share:.3f}"'
        share_text = "" if share is None else f"{share:.0%}, "
        text = f"<progress{value}></progress> {activity}, {share_text}{seconds:.0f} s"
        if self._display_handle is None:
            from IPython.display import display

            self._display_handle = display(_html_line(text), raw=True, display_id=True)
        else:
            self._display_handle.update(_html_line(text), raw=True)


def _html_line(html: str) -> dict[str, str]:
    """Return what is displayed: HTML, and nothing where only text can be."""
    return {"text/html": html, "text/plain": ""}
