"""Progress of calls that take long.

The library itself prints nothing. The current activity is found on the stack of the main thread:
the room of the package (see CONTRIBUTING.md) of the innermost call. The finished share is known
for calls with a `progress` argument only: `progress_reporter` sets it where a progress bar can be
shown and the caller gave none.
"""

import sys
import threading
import time
from collections.abc import Callable
from types import FrameType

Progress = Callable[[float], None]  # called with the finished share, 0 to 1
REPORT_DELAY = 2.0  # [s] before the first report
REPORT_INTERVAL = 0.5  # [s] between two reports
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
    """Reports the activity of the main thread, beginning after `REPORT_DELAY`.

    Args:
        report: Called every half second with the main thread's innermost frame and the seconds
            since the start.
    """

    def __init__(self, report: Callable[[FrameType | None, float], None]):
        super().__init__(daemon=True)
        self._report, self._stopped = report, threading.Event()
        self._main_thread = threading.main_thread().ident

    def run(self) -> None:
        """Wait, then report every half second."""
        start_time = time.monotonic()
        wait = REPORT_DELAY
        while not self._stopped.wait(wait):
            wait = REPORT_INTERVAL
            frame = sys._current_frames().get(self._main_thread or 0)
            self._report(frame, time.monotonic() - start_time)

    def stop(self) -> None:
        """Stop reporting."""
        self._stopped.set()
        self.join()


def current_activity(frame: FrameType | None) -> str:
    """The activity of a call stack: that of the innermost room that has one."""
    while frame is not None:
        package, _, rest = str(frame.f_globals.get("__name__", "")).partition(".")
        if package == "crane" and (activity := _ACTIVITIES.get(rest.partition(".")[0])):
            return activity
        frame = frame.f_back
    return ""


class ProgressTracker:
    """The finished share of the outermost call that reports one."""

    def __init__(self) -> None:
        self.is_enabled = False  # whether a progress bar is shown
        self._reporting_call: FrameType | None = None
        self._finished_share = 0.0

    def finished_share(self, frame: FrameType | None) -> float | None:
        """The share for a call stack; None if no call on it reports one."""
        return (
            self._finished_share
            if self._reporting_call is not None and _is_on_stack(self._reporting_call, frame)
            else None
        )

    def reset(self) -> None:
        """Forget the reporting call."""
        self._reporting_call = None

    def start_reporting(self, call: FrameType) -> Callable[[float], None] | None:
        """The function by which a call reports its share; None in nested calls and threads."""
        is_main_thread = threading.current_thread() is threading.main_thread()
        is_nested = self.finished_share(call) is not None
        if not self.is_enabled or not is_main_thread or is_nested:
            return None
        self._reporting_call, self._finished_share = call, 0.0
        return self._set_share

    def _set_share(self, share: float) -> None:
        self._finished_share = share


PROGRESS = ProgressTracker()


def ignore_progress(share: float) -> None:
    """In place of a reporter where nobody asks for the finished share."""


def progress_reporter(progress: Progress | None) -> Progress:
    """The function by which the caller reports its finished share: given, or the tracker's."""
    return progress or PROGRESS.start_reporting(sys._getframe(1)) or ignore_progress


def _is_on_stack(call: FrameType, frame: FrameType | None) -> bool:
    while frame is not None and frame is not call:
        frame = frame.f_back
    return frame is call
