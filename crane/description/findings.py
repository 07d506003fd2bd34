"""What is wrong with a description: all of it where it is checked, else the first.

Readers raise at the first problem. Within `collecting` they go on instead: `recoverable` writes an
error down and ends only the part that has it, a link or an item of a section; `flag` does not end
even that.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import Any

from crane.common.errors import CraneError
from crane.common.packages import given

MOST = 200  # findings in one run: who has more has one cause for most of them


class FollowUpError(CraneError):
    """Follows from an error that was noted before: not worth a line of its own."""


class TooManyError(CraneError):
    """Enough has been found."""


class Anything(tuple[Any, ...]):
    """Names that could not be read: whatever is asked for is among them."""

    def __contains__(self, _: object) -> bool:
        return True

    def __bool__(self) -> bool:
        return True

    def __add__(self, _: object) -> "Anything":
        return self

    __radd__ = __add__


class Findings:
    """What a check has found so far.

    Attributes:
        errors: In the order in which they were found.
        files: URDFs that could be parsed.
        usable: Whether the machine can be assembled in spite of the errors.
        full: Whether there were more than are noted.
    """

    def __init__(self) -> None:
        self.errors: list[CraneError] = []
        self.files: list[Any] = []
        self.usable = True
        self.full = False
        self.harmless = 0  # open blocks whose errors do not keep it from being assembled

    def add(self, error: CraneError) -> None:
        """Write an error down, once.

        Raises:
            TooManyError: These are enough.
        """
        if not self.harmless:
            self.usable = False
        if isinstance(error, FollowUpError) or str(error) in map(str, self.errors):
            return
        if len(self.errors) == MOST:
            self.full = True
            raise TooManyError(f"more than {MOST} errors")
        self.errors.append(error)


_current: ContextVar[Findings | None] = ContextVar("findings", default=None)


@contextmanager
def collecting() -> Iterator[Findings]:
    """Collect what goes wrong within, as far as it is raised within `recoverable`."""
    found = Findings()
    token = _current.set(found)
    try:
        yield found
    except TooManyError:
        pass
    finally:
        _current.reset(token)


class recoverable:  # noqa: N801  read as a word: `with recoverable():`
    """A part of a description whose errors end only this part while findings are collected.

    An error after others of the same part follows from them and is not noted.

    Args:
        harmless: Whether the machine can be assembled without this part.
    """

    def __init__(self, harmless: bool = False):
        self._harmless = harmless
        self._found: Findings | None = None
        self._before = 0

    def __enter__(self) -> None:
        self._found = _current.get()
        if self._found is not None:
            self._before = len(self._found.errors)
            self._found.harmless += self._harmless

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        found = self._found
        if found is None:
            return False
        try:
            if not isinstance(error, CraneError) or isinstance(error, TooManyError):
                return False
            if len(found.errors) > self._before:
                found.usable &= bool(found.harmless)
            else:
                found.add(error)
            return True
        finally:
            found.harmless -= self._harmless


def flag(error: CraneError, harmless: bool = False) -> None:
    """Raise an error, or write it down where findings are collected.

    Args:
        error: The error.
        harmless: Whether the machine can be assembled in spite of it.

    Raises:
        CraneError: The error, where findings are not collected.
    """
    found = _current.get()
    if found is None:
        raise error
    with recoverable(harmless):
        raise error


@contextmanager
def aside() -> Iterator[None]:
    """Whatever is raised within is raised, and not written down."""
    token = _current.set(None)
    try:
        yield
    finally:
        _current.reset(token)


def remember_file(file: object) -> None:
    """Keep a parsed file for further checks."""
    if (found := _current.get()) is not None:
        found.files.append(file)


def is_strict() -> bool:
    """Whether what only has an odd form is an error: in a check, and where the user says so."""
    return going_on() or given().strict


def going_on() -> bool:
    """Whether findings are collected, so that reading goes on after errors."""
    return _current.get() is not None
