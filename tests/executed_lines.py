"""Counts the lines of the package that a call executes, independently of the machine's load."""

import sys
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

from crane.closure.compiled_closure import CompiledClosure
from crane.dynamics.compiled_dynamics import CompiledQuantity

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


@contextmanager
def passes(monkeypatch):
    """Count samples: those whose loops are closed, and those at which each quantity is computed.

    Keys are "closed" and the names of `crane.dynamics.compiled_dynamics.QUANTITIES`.
    """
    count, made, quantities = Counter(), CompiledQuantity.__init__, {}

    def named(formula, quantity, *arguments):
        made(formula, quantity, *arguments)
        quantities[id(formula._program)] = quantity

    def counted(kind, name, keys, size):
        function = getattr(kind, name)

        def spied(self, *arguments):
            out = function(self, *arguments)
            for key in keys(self):
                count[key] += size(out, arguments)
            return out

        patch.setattr(kind, name, spied)

    def quantity(formula):
        return quantities.get(id(formula._program), "other")

    with monkeypatch.context() as patch:
        patch.setattr(CompiledQuantity, "__init__", named)
        counted(CompiledClosure, "follow_targets", lambda _: ["closed"], lambda out, _: out)
        counted(
            CompiledQuantity,
            "evaluate_targets",
            lambda x: ["closed", quantity(x)],
            lambda out, _: out,
        )
        counted(
            CompiledQuantity,
            "evaluate_closed",
            lambda x: [quantity(x)],
            lambda _, given: len(given[0]) if given[0].ndim == 2 else 0,
        )
        yield count
