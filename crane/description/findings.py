"""Errors of a description: all of them while it is checked, else the first.

Readers raise at the first error. Within `collect_findings` they continue: `error_recovery` records
an error and ends only the affected part, a link or an item of a section; `report_error` does not
end even that.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from crane.common.errors import CraneError
from crane.common.package_search import load_options

MAX_FINDINGS = 200  # more of them have few causes


class FollowUpError(CraneError):
    """An error that follows from a recorded error and is not reported."""


class TooManyFindingsError(CraneError):
    """The maximum number of errors was reached."""


class UnknownNames(tuple[Any, ...]):
    """Names that could not be read: every name counts as one of them."""

    def __contains__(self, _: object) -> bool:
        return True

    def __bool__(self) -> bool:
        return True

    def __add__(self, _: object) -> "UnknownNames":
        return self

    __radd__ = __add__


class Findings:
    """Errors recorded by a check.

    Attributes:
        errors: Errors in the order in which they occurred.
        parsed_files: URDFs that could be parsed.
        can_be_assembled: Whether the machine can be assembled in spite of the errors.
        is_truncated: Whether there were more errors than recorded.
    """

    def __init__(self) -> None:
        self.errors: list[CraneError] = []
        self.parsed_files: list[Any] = []
        self.can_be_assembled = True
        self.is_truncated = False
        self.harmless_depth = 0  # nested contexts with harmless errors

    def add(self, error: CraneError) -> None:
        """Record an error, once.

        Raises:
            TooManyFindingsError: The maximum number is reached.
        """
        if not self.harmless_depth:
            self.can_be_assembled = False
        if isinstance(error, FollowUpError) or str(error) in map(str, self.errors):
            return
        if len(self.errors) == MAX_FINDINGS:
            self.is_truncated = True
            raise TooManyFindingsError(f"more than {MAX_FINDINGS} errors")
        self.errors.append(error)


_current_findings: ContextVar[Findings | None] = ContextVar("findings", default=None)


@contextmanager
def collect_findings() -> Iterator[Findings]:
    """Collect the errors that are raised within `error_recovery`."""
    findings = Findings()
    token = _current_findings.set(findings)
    try:
        yield findings
    except TooManyFindingsError:
        pass
    finally:
        _current_findings.reset(token)


@contextmanager
def error_recovery(harmless: bool = False) -> Iterator[None]:
    """Context of a part of a description; while findings are collected, errors end only this part.

    An error after other errors of the same part follows from them and is not recorded.

    Args:
        harmless: Whether the machine can be assembled without this part.
    """
    findings = _current_findings.get()
    if findings is None:
        yield
        return
    initial_error_count = len(findings.errors)
    findings.harmless_depth += harmless
    try:
        yield
    except TooManyFindingsError:
        raise
    except CraneError as error:
        if len(findings.errors) > initial_error_count:
            findings.can_be_assembled &= bool(findings.harmless_depth)
        else:
            findings.add(error)
    finally:
        findings.harmless_depth -= harmless


def report_error(error: CraneError, harmless: bool = False) -> None:
    """Raise an error, or record it while findings are collected.

    Args:
        error: The error.
        harmless: Whether the machine can be assembled in spite of it.

    Raises:
        CraneError: The error, if findings are not collected.
    """
    with error_recovery(harmless):
        raise error


@contextmanager
def raise_errors() -> Iterator[None]:
    """Raise errors within, even while findings are collected."""
    token = _current_findings.set(None)
    try:
        yield
    finally:
        _current_findings.reset(token)


def record_parsed_file(file: object) -> None:
    """Keep a parsed file for further checks."""
    if (found := _current_findings.get()) is not None:
        found.parsed_files.append(file)


def is_strict() -> bool:
    """Whether formal errors are errors: in a check, and if the load options request it."""
    return _current_findings.get() is not None or load_options().strict
