"""What goes on while somebody waits, and how far it is.

The library computes without a word. What it is at is read off the main thread's stack: the room of
the package (see CONTRIBUTING.md) that is nearest to what runs now. How far it is only calls know
that take a `progress`: `telling` gives them one where a bar can be shown, and nobody gave another.
"""

import sys
import threading
import time
from collections.abc import Callable
from types import FrameType

AFTER = 2.0  # [s] from which on something takes long
EVERY = 0.5  # [s] between two looks
_DOING = {
    "formats": "reading",
    "closure": "closing the loops",
    "codegen": "compiling",
    "dynamics": "computing forces",
    "motion": "computing motions",
    "ratings": "rating",
    "simulation": "simulating",
    "identification": "identifying",
    "studies": "computing variants",
    "view": "drawing",
}


class Watch(threading.Thread):
    """Tells what the main thread is at, from `AFTER` on.

    Args:
        tell: Called every half second with the main thread's innermost call and the seconds since
            the watch has begun.
    """

    def __init__(self, tell: Callable[[FrameType | None, float], None]):
        super().__init__(daemon=True)
        self._tell, self._over = tell, threading.Event()
        self._main = threading.main_thread().ident

    def run(self) -> None:
        """Wait, then look every half second."""
        begun = time.monotonic()
        wait = AFTER
        while not self._over.wait(wait):
            wait = EVERY
            frame = sys._current_frames().get(self._main or 0)
            self._tell(frame, time.monotonic() - begun)

    def end(self) -> None:
        """Say no more."""
        self._over.set()
        self.join()


def doing(frame: FrameType | None) -> str:
    """What a stack of calls is about, by the innermost room of the package that has a word."""
    while frame is not None:
        package, _, rest = str(frame.f_globals.get("__name__", "")).partition(".")
        if package == "crane" and (word := _DOING.get(rest.partition(".")[0])):
            return word
        frame = frame.f_back
    return ""


class Shares:
    """The finished share of the outermost call that tells one."""

    def __init__(self) -> None:
        self.listening = False  # whether somebody shows it
        self._call: FrameType | None = None
        self._share = 0.0

    def of(self, frame: FrameType | None) -> float | None:
        """That of a stack of calls; None where no call of it has told."""
        return self._share if self._call is not None and _within(self._call, frame) else None

    def forget(self) -> None:
        """No call tells any more."""
        self._call = None

    def teller(self, call: FrameType) -> Callable[[float], None] | None:
        """What a call tells its share to; None within another that tells, or in a thread."""
        if not self.listening or threading.current_thread() is not threading.main_thread():
            return None
        if self._call is not None and _within(self._call, call):
            return None
        self._call, self._share = call, 0.0
        return self._told

    def _told(self, share: float) -> None:
        self._share = share


SHARES = Shares()


def telling(progress: Callable[[float], None] | None) -> Callable[[float], None] | None:
    """What the calling function tells its finished share to: who was given, or who listens."""
    return SHARES.teller(sys._getframe(1)) if progress is None else progress


def _within(call: FrameType, frame: FrameType | None) -> bool:
    """Whether a call is on a stack."""
    while frame is not None and frame is not call:
        frame = frame.f_back
    return frame is call
