"""What takes long says so: one line on the terminal, two seconds after a command has begun.

Into pipes and files nothing is written.
"""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TextIO

from crane.common.progress import MainThreadMonitor, current_activity

_ERASE = "\r\x1b[2K"

_shown = threading.Event()  # that something else tells how far it is


class _Line:
    """The last line of a terminal, which gives way to whatever else is written."""

    def __init__(self, terminal: TextIO):
        self._terminal, self._lock = terminal, threading.Lock()
        self._drawn, self.free = False, True  # whether the cursor is where a line begins

    def draw(self, text: str) -> None:
        """Put a text there, or another in its place."""
        with self._lock:
            if self.free:
                self._terminal.write(f"{_ERASE}{text}")
                self._terminal.flush()
                self._drawn = True

    def erase(self) -> None:
        """Leave the line as if nothing had been there."""
        with self._lock:
            if self._drawn:
                self._terminal.write(_ERASE)
                self._terminal.flush()
            self._drawn = False


class _Stream:
    """A stream that erases the line before it writes."""

    def __init__(self, stream: TextIO, line: _Line):
        self._stream, self._line = stream, line

    def write(self, text: str) -> int:
        """Write a text where the line was."""
        self._line.erase()
        if text:
            self._line.free = text.endswith("\n")
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def on_terminal() -> bool:
    """Whether somebody may watch."""
    return sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def watched(what: str) -> Iterator[None]:
    """Tell on a terminal what goes on, once it has taken two seconds.

    Args:
        what: Who says so, as "crane check".
    """
    if not on_terminal():
        yield
        return
    out, errors = sys.stdout, sys.stderr
    line = _Line(errors)

    def tell(frame: FrameType | None, seconds: float) -> None:
        if not _shown.is_set():
            line.draw(f"{what}: {current_activity(frame) or 'working'}, {seconds:.0f} s")

    watch = MainThreadMonitor(tell)
    sys.stderr = _Stream(errors, line)
    if out is not None:
        sys.stdout = _Stream(out, line)
    watch.start()
    try:
        yield
    finally:
        watch.stop()
        line.erase()
        sys.stdout, sys.stderr = out, errors


@contextmanager
def shown() -> Iterator[None]:
    """While something else tells how far it is, or nothing is to be waited for."""
    if (line := sys.stderr) is not None and isinstance(line, _Stream):
        line.write("")
    _shown.set()
    try:
        yield
    finally:
        _shown.clear()
