"""How much a call computes: lines of the package that it runs, whatever else the machine does."""

import sys
from contextlib import contextmanager
from pathlib import Path

PACKAGE = str(Path(__file__).parents[1] / "crane")


class TooMuchWorkError(BaseException):
    """More lines have been run than allowed; no `except Exception` holds it up."""


class Work:
    """Lines that have been run so far."""

    lines = 0


@contextmanager
def at_most(limit):
    """End what runs more lines of the package than `limit` within.

    Lines of other packages do not count, nor what C does, so that a loop there is not ended.
    """
    work = Work()

    def within(frame, event, _):
        if event == "line":
            work.lines += 1
            if work.lines > limit:
                sys.settrace(None)
                raise TooMuchWorkError(f"more than {limit} lines, at {frame.f_code.co_qualname}")
        return within

    def enter(frame, event, _):
        return within if frame.f_code.co_filename.startswith(PACKAGE) else None

    before = sys.gettrace()
    sys.settrace(enter)
    try:
        yield work
    finally:
        sys.settrace(before)
