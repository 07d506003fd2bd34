"""Exceptions and warnings of the package, and the summary of similar warnings.

A message is one line that says what is wrong, where, and what to do about it.
"""

import re
import warnings
from collections.abc import Collection, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from difflib import SequenceMatcher, get_close_matches
from typing import Any

_MAX_WORD_LENGTH, _MAX_LINE_LENGTH = (
    1000,
    4000,
)  # characters of a word and of a line that anybody reads


def format_one_line(text: str) -> str:
    """Text as one printable line.

    Characters that cannot be printed become spaces, bytes of paths that are no text are escaped;
    very long words and lines are shortened in the middle.
    """
    text = text.encode(errors="backslashreplace").decode()
    text = "".join(c if c.isprintable() else " " for c in text)
    if len(text) > _MAX_WORD_LENGTH:
        text = " ".join(_shorten(word, _MAX_WORD_LENGTH) for word in text.split(" "))
    return _shorten(text, _MAX_LINE_LENGTH)


def is_one_line(text: str) -> bool:
    """Whether a text is one printable line; paths in it may have bytes that are no text."""
    return text.encode(errors="backslashreplace").decode().isprintable()


def prefix_location(location: str, error: Exception) -> str:
    """Message of an error with its location in front, unless it begins with it."""
    text = str(error)
    return text if text.startswith(location) else f"{location}: {text}"


def _shorten(text: str, max_length: int) -> str:
    return (
        text
        if len(text) <= max_length
        else f"{text[: max_length // 2]}...{text[-max_length // 4 :]}"
    )


class CraneError(Exception):
    """Base class of all exceptions that this package raises intentionally.

    Args:
        message: One line, see `format_one_line`.
    """

    def __init__(self, message: str):
        super().__init__(format_one_line(message))


class DescriptionError(CraneError):
    """A machine file or URDF contains invalid or contradictory data."""


class MechanismError(CraneError):
    """The parts are valid, but do not form a machine that can be driven.

    Args:
        message: See `CraneError`.
        subject: The part of the description concerned: "active", "home", or "loop" and its name.
        configuration: (nq,) where the loops close, if it was found.
    """

    def __init__(self, message: str, subject: str = "", configuration: Any = None):
        super().__init__(message)
        self.subject = subject
        self.configuration = configuration


class SingularMassMatrixError(MechanismError):
    """Some motion moves no inertia, so that forces do not determine accelerations."""


class InputError(CraneError):
    """An argument has a wrong shape, is not finite, or names something unknown."""


class LimitError(CraneError):
    """A commanded active coordinate lies outside of its limits."""


class ClosureError(CraneError):
    """The loops cannot be closed as requested."""


class OutOfReachError(ClosureError):
    """No configuration closes the loops at these active coordinates."""


class SingularConfigurationError(ClosureError):
    """The loops close, but at a configuration where the passive joints are not determined."""


class WrongBranchError(ClosureError):
    """The loops close, but on another branch than that of the home configuration."""


class UnreachableTipError(CraneError):
    """No active coordinates within their limits put the tip at the requested position."""


class RecordingError(CraneError):
    """A recording is malformed."""


class SimulationError(CraneError):
    """A simulation could not continue.

    Attributes:
        recording: The recording up to the error, whose `stopped` gives place and reason; None if
            the simulation did not start, or nothing was to be recorded.
    """

    recording: Any = None


class TerminatedWorkerError(CraneError):
    """Worker processes ended before their time; a checkpoint has what is finished."""


class OutputError(CraneError):
    """A result cannot be written to the requested path."""


class CraneWarning(UserWarning):
    """Something unusual that is not an error."""


def warn(text: str, stacklevel: int = 2) -> None:
    """Issue a `CraneWarning`; `stacklevel` as for `warnings.warn`."""
    warnings.warn(text, CraneWarning, stacklevel=stacklevel + 1)


def ignore_warnings() -> AbstractContextManager[object]:
    """Context in which no `CraneWarning` is issued."""
    return warnings.catch_warnings(action="ignore", category=CraneWarning)


_MAX_SEARCHED_NAMES = 2000  # largest number of names to search for a similar one
_HOLDS = 0.7  # likeness of names of which one contains the other
_MAX_LISTED_NAMES, _NEAREST = (
    20,
    8,
)  # names that a line has of all, and of many: those like the wanted one


def suggest_names(names: Iterable[str], unknown_name: str | None = None) -> str:
    """End of an error message: the most similar name, all names, or the nearest of many.

    Args:
        names: Valid names.
        unknown_name: The name that is not valid.
    """
    names = list(names)
    if not names:
        return "there are none"
    is_searchable = len(names) <= _MAX_SEARCHED_NAMES
    if (
        is_searchable
        and unknown_name is not None
        and (similar := get_close_matches(unknown_name, names, 1, 0.75))
    ):
        return f"did you mean '{similar[0]}'?"
    if len(names) <= _MAX_LISTED_NAMES:
        return "known: " + ", ".join(sorted(names))
    if unknown_name is None or not is_searchable:
        return f"known: {', '.join(sorted(names)[:_NEAREST])} and {len(names) - _NEAREST} more"
    listed = sorted(names, key=lambda name: (-_likeness(name, unknown_name), name))[:_NEAREST]
    return f"the nearest of {len(names)} known ones are {', '.join(listed)}"


def check_name(
    name: str, names: Collection[str], problem: str, error: type[CraneError] = InputError
) -> None:
    """Check that a name is among those that are known.

    Args:
        name: The name.
        names: Those that are known.
        problem: What is wrong if it is not; the names that are meant are appended.
        error: Class of the error.

    Raises:
        CraneError: The name is not known.
    """
    if name not in names:
        raise error(f"{problem}, {suggest_names(names, name)}")


def _likeness(name: str, wanted: str) -> float:
    """Similarity of two names, 0 to 1, ignoring case; at least 0.7 if one contains the other."""
    name, wanted = name.lower(), wanted.lower()
    alike = SequenceMatcher(None, name, wanted).ratio()
    return max(alike, _HOLDS) if wanted and (wanted in name or name in wanted) else alike


MAX_WARNINGS = 5  # per file
_LOCATION_PATTERN = re.compile(r"^.+?\.\w+:\d+: ")
_QUOTED_PATTERN = re.compile(r"'[^']*'")
_NUMBER_PATTERN = re.compile(r"(?<![\w.])-?\d+(\.\d*)?(e[-+]?\d+)?")


def message_kind(message: str) -> str:
    """A message without its location, with placeholders for names and numbers."""
    return _NUMBER_PATTERN.sub("#", _QUOTED_PATTERN.sub("''", _LOCATION_PATTERN.sub("", message)))


@contextmanager
def summarize_warnings() -> Iterator[None]:
    """Context that delays warnings to its end: one per kind, and at most `MAX_WARNINGS`."""
    with warnings.catch_warnings(record=True, action="always", category=CraneWarning) as caught:
        yield
    by_kind: dict[str, dict[str, None]] = {}  # different messages, in order
    for one in caught:
        if issubclass(one.category, CraneWarning):
            text = str(one.message)
            by_kind.setdefault(message_kind(text), {})[text] = None
        else:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    groups = [list(messages) for messages in by_kind.values()]
    texts = [x[0] if len(x) == 1 else f"{x[0]} ({len(x)} such)" for x in groups]
    if len(texts) > MAX_WARNINGS:
        rest = sum(map(len, groups[MAX_WARNINGS - 1 :]))
        texts[MAX_WARNINGS - 1 :] = [f"{rest} more warnings: crane check lists them"]
    for text in texts:
        warnings.warn(text, CraneWarning, stacklevel=4)
