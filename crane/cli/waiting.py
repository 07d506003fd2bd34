"""What takes long says so: one line on the terminal, two seconds after a command has begun.

The library computes without a word. What it is at is read off the main thread's stack: the room of
the package (see CONTRIBUTING.md) that is nearest to what runs now. Into pipes and files nothing
is written.
"""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TextIO

_AFTER = 2.0  # [s] from which on a command takes long
_EVERY = 0.5  # [s] between two looks
_DOING = {
    "formats": "reading",
    "closure": "closing the loops",
    "codegen": "compiling",
    "dynamics": "computing forces",
    "motion": "computing motions",
    "simulation": "simulating",
    "identification": "identifying",
    "studies": "computing variants",
    "view": "drawing",
}

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


class _Watch(threading.Thread):
    """Tells what the main thread is at, as long as nothing else does."""

    def __init__(self, what: str, line: _Line):
        super().__init__(daemon=True)
        self._what, self._line, self._over = what, line, threading.Event()
        self._main = threading.main_thread().ident

    def run(self) -> None:
        """Wait, then look every half second."""
        begun = time.monotonic()
        wait = _AFTER
        while not self._over.wait(wait):
            wait = _EVERY
            if _shown.is_set():
                continue
            frame = sys._current_frames().get(self._main or 0)
            self._line.draw(f"{self._what}: {doing(frame)}, {time.monotonic() - begun:.0f} s")

    def end(self) -> None:
        """Say no more, and take the line away."""
        self._over.set()
        self.join()
        self._line.erase()


def doing(frame: FrameType | None) -> str:
    """What a stack of calls is about, by the innermost room of the package that has a word."""
    while frame is not None:
        package, _, rest = str(frame.f_globals.get("__name__", "")).partition(".")
        if package == "crane" and (word := _DOING.get(rest.partition(".")[0])):
            return word
        frame = frame.f_back
    return "working"


@contextmanager
def watched(what: str) -> Iterator[None]:
    """Tell on a terminal what goes on, once it has taken two seconds.

    Args:
        what: Who says so, as "crane check".
    """
    out, errors = sys.stdout, sys.stderr
    if errors is None or not errors.isatty():
        yield
        return
    line = _Line(errors)
    watch = _Watch(what, line)
    sys.stderr = _Stream(errors, line)
    if out is not None:
        sys.stdout = _Stream(out, line)
    watch.start()
    try:
        yield
    finally:
        watch.end()
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
