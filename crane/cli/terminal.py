"""Progress and messages on the terminal: activity line, progress bar, status.

They are shown while somebody can see them: nothing is written into pipes and files.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any, TextIO

from crane.common.progress import MainThreadMonitor, current_activity

INTERRUPTED = 130  # exit status of an interrupted command
_ENDING_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")  # Ctrl-C, kill, a closed terminal
_RETRY_DELAY = 0.05  # [s] until an interruption that Python has ignored is repeated
_ERASE = "\r\x1b[2K"
_BAR_DELAY = 0.3  # [s] until a progress bar appears

_line_is_hidden = threading.Event()  # while a progress bar, a status or nothing is shown instead


class _ActivityLine:
    """The last line of a terminal, which is erased before anything else is written."""

    def __init__(self, terminal: TextIO):
        self._terminal, self._lock = terminal, threading.Lock()
        self._is_drawn = False
        self.is_free = True  # whether the cursor is at the start of a line

    def draw(self, text: str) -> None:
        """Draw a text, in place of the one before."""
        with self._lock:
            if self.is_free:
                self._terminal.write(f"{_ERASE}{text}")
                self._terminal.flush()
                self._is_drawn = True

    def erase(self) -> None:
        """Erase the text."""
        with self._lock:
            if self._is_drawn:
                self._terminal.write(_ERASE)
                self._terminal.flush()
            self._is_drawn = False


class _Stream:
    """A stream that erases the activity line before it writes."""

    def __init__(self, stream: TextIO, line: _ActivityLine):
        self._stream, self._line = stream, line

    def write(self, text: str) -> int:
        """Write a text in place of the activity line."""
        self._line.erase()
        if text:
            self._line.is_free = text.endswith("\n")
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def on_terminal() -> bool:
    """Whether the error output is a terminal."""
    return sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def activity_line(command: str) -> Iterator[None]:
    """Show on a terminal what is being computed, once the block has taken two seconds.

    Args:
        command: Start of the line, as "crane check".
    """
    if not on_terminal():
        yield
        return
    out, errors = sys.stdout, sys.stderr
    line = _ActivityLine(errors)

    def show(frame: FrameType | None, seconds: float) -> None:
        if not _line_is_hidden.is_set():
            line.draw(f"{command}: {current_activity(frame) or 'working'}, {seconds:.0f} s")

    monitor = MainThreadMonitor(show)
    sys.stderr = _Stream(errors, line)
    if out is not None:
        sys.stdout = _Stream(out, line)
    monitor.start()
    try:
        yield
    finally:
        monitor.stop()
        line.erase()
        sys.stdout, sys.stderr = out, errors


@contextmanager
def hide_activity_line() -> Iterator[None]:
    """Show no activity line during the block: another display shows the progress, or none."""
    if (line := sys.stderr) is not None and isinstance(line, _Stream):
        line.write("")
    _line_is_hidden.set()
    try:
        yield
    finally:
        _line_is_hidden.clear()


@contextmanager
def progress_bar(activity: str) -> Iterator[Callable[[float], None]]:
    """A function of the finished share, 0 to 1, which draws a bar on a terminal.

    Args:
        activity: Text before the bar.
    """
    start = time.monotonic()
    with ExitStack() as stack:
        draw: Callable[[float], None] | None = None

        def report(share: float) -> None:
            nonlocal draw
            if draw is None and on_terminal() and time.monotonic() - start > _BAR_DELAY:
                draw = stack.enter_context(_bar(activity))
            if draw is not None:
                draw(share)

        yield report


@contextmanager
def _bar(activity: str) -> Iterator[Callable[[float], None]]:
    from rich.console import Console
    from rich.progress import Progress

    with hide_activity_line(), Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(activity, total=1.0)
        yield lambda share: bar.update(task, completed=share)


@contextmanager
def status(activity: str) -> Iterator[None]:
    """Show on a terminal what is being computed during the block."""
    if not on_terminal():
        yield
        return
    from rich.console import Console

    with hide_activity_line(), Console(stderr=True).status(activity):
        yield


def print_message(text: str) -> None:
    """Print a message to the user on the error output, apart from the results."""
    print(text, file=sys.stderr)


@contextmanager
def ending_signals() -> Iterator[list[int]]:
    """Let signals that end a process interrupt the block, as Ctrl-C does: it leaves nothing.

    Python ignores an exception where it can be raised nowhere, as when an object is removed: the
    signal is then repeated. Elsewhere a library may raise another exception in its place.

    Yields:
        Numbers of the signals that have come, as they come.
    """
    received: list[int] = []
    repetitions: list[threading.Timer] = []

    def interrupt(number: int, _: object) -> None:
        received.append(number)
        raise KeyboardInterrupt

    def repeat(unraisable: Any) -> None:
        if not received or not issubclass(unraisable.exc_type, KeyboardInterrupt):
            report_unraisable(unraisable)
            return
        repetitions.append(threading.Timer(_RETRY_DELAY, os.kill, (os.getpid(), received[-1])))
        repetitions[-1].start()

    report_unraisable, handlers = sys.unraisablehook, dict[int, Any]()
    if threading.current_thread() is threading.main_thread():
        numbers = [getattr(signal, name) for name in _ENDING_SIGNALS if hasattr(signal, name)]
        handlers = {number: signal.getsignal(number) for number in numbers}
    # those that are ignored stay so, as behind `nohup`
    handlers = {number: x for number, x in handlers.items() if x is not signal.SIG_IGN}
    sys.unraisablehook = repeat
    try:
        for number in handlers:
            signal.signal(number, interrupt)
        yield received
    finally:
        for timer in repetitions:
            timer.cancel()
        for number, handler in handlers.items():
            signal.signal(number, handler)
        sys.unraisablehook = report_unraisable
