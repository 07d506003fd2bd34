"""What goes on while somebody waits, and how far it is.

The library computes without a word. What it is at is read off the main thread's stack: the room of
the package (see CONTRIBUTING.md) that is nearest to what runs now. How far it is only calls know
that take a `progress`: `progress_reporter` gives them one where a bar can be shown, and nobody
gave another.
"""

import sys
import threading
import time
from collections.abc import Callable
from types import FrameType

REPORT_DELAY = 2.0  # [s] from which on something takes long
REPORT_INTERVAL = 0.5  # [s] between two looks
_ACTIVITIES = {
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


class MainThreadMonitor(threading.Thread):
    """Tells what the main thread is at, from `REPORT_DELAY` on.

    Args:
        report: Called every half second with the main thread's innermost call and the seconds
            since the watch has begun.
    """

    def __init__(self, report: Callable[[FrameType | None, float], None]):
        super().__init__(daemon=True)
        self._report, self._stopped = report, threading.Event()
        self._main_thread = threading.main_thread().ident

    def run(self) -> None:
        """Wait, then look every half second."""
        start_time = time.monotonic()
        wait = REPORT_DELAY
        while not self._stopped.wait(wait):
            wait = REPORT_INTERVAL
            frame = sys._current_frames().get(self._main_thread or 0)
            self._report(frame, time.monotonic() - start_time)

    def stop(self) -> None:
        """Say no more."""
        self._stopped.set()
        self.join()


def current_activity(frame: FrameType | None) -> str:
    """What a stack of calls is about, by the innermost room of the package that has a word."""
    while frame is not None:
        package, _, rest = str(frame.f_globals.get("__name__", "")).partition(".")
        if package == "crane" and (activity := _ACTIVITIES.get(rest.partition(".")[0])):
            return activity
        frame = frame.f_back
    return ""


class ProgressTracker:
    """The finished share of the outermost call that tells one."""

    def __init__(self) -> None:
        self.is_enabled = False  # whether somebody shows it
        self._reporting_call: FrameType | None = None
        self._finished_share = 0.0

    def finished_share(self, frame: FrameType | None) -> float | None:
        """That of a stack of calls; None where no call of it has told."""
        return (
            self._finished_share
            if self._reporting_call is not None and _is_on_stack(self._reporting_call, frame)
            else None
        )

    def reset(self) -> None:
        """No call tells any more."""
        self._reporting_call = None

    def start_reporting(self, call: FrameType) -> Callable[[float], None] | None:
        """What a call tells its share to; None within another that tells, or in a thread."""
        if not self.is_enabled or threading.current_thread() is not threading.main_thread():
            return None
        if self._reporting_call is not None and _is_on_stack(self._reporting_call, call):
            return None
        self._reporting_call, self._finished_share = call, 0.0
        return self._set_share

    def _set_share(self, share: float) -> None:
        self._finished_share = share


PROGRESS = ProgressTracker()


def progress_reporter(progress: Callable[[float], None] | None) -> Callable[[float], None] | None:
    """What the calling function tells its finished share to: who was given, or who listens."""
    return PROGRESS.start_reporting(sys._getframe(1)) if progress is None else progress


def _is_on_stack(call: FrameType, frame: FrameType | None) -> bool:
    """Whether a call is on a stack."""
    while frame is not None and frame is not call:
        frame = frame.f_back
    return frame is call
