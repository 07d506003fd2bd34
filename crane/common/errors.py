"""Every exception and warning of the package.

A message is one line that says what is wrong, where, and what to do about it.
"""

from collections.abc import Iterable
from difflib import SequenceMatcher, get_close_matches
from typing import Any

_MAX_WORD_LENGTH, _MAX_LINE_LENGTH = (
    1000,
    4000,
)  # characters of a word and of a line that anybody reads


def format_one_line(text: str) -> str:
    """Text as one line that can be read.

    What cannot be printed (a name may hold it) becomes a space; of words and lines without end
    the middle is left out.
    """
    text = "".join(c if c.isprintable() else " " for c in text)
    if len(text) > _MAX_WORD_LENGTH:
        text = " ".join(_shorten(word, _MAX_WORD_LENGTH) for word in text.split(" "))
    return _shorten(text, _MAX_LINE_LENGTH)


def prefix_location(location: str, error: Exception) -> str:
    """`place: message`, and the message alone where that begins with the place."""
    text = str(error)
    return text if text.startswith(location) else f"{location}: {text}"


def _shorten(text: str, max_length: int) -> str:
    return (
        text
        if len(text) <= max_length
        else f"{text[: max_length // 2]}...{text[-max_length // 4 :]}"
    )


class CraneError(Exception):
    """Base class of everything this package raises on purpose.

    Args:
        message: One line, see `format_one_line`.
    """

    def __init__(self, message: str):
        super().__init__(format_one_line(message))


class DescriptionError(CraneError):
    """A machine file or a URDF says something that cannot be."""


class MechanismError(CraneError):
    """The parts are well described, but do not make a machine that can be driven.

    Args:
        message: See `CraneError`.
        subject: What of the description it is about: "active", "home", or "loop" and its name.
        configuration: (nq,) where the loops close, if that was found.
    """

    def __init__(self, message: str, subject: str = "", configuration: Any = None):
        super().__init__(message)
        self.subject = subject
        self.configuration = configuration


class InputError(CraneError):
    """An argument has a wrong shape, is not finite, or names something unknown."""


class LimitError(CraneError):
    """A commanded active coordinate lies outside of its limits."""


class ClosureError(CraneError):
    """The loops cannot be closed as asked."""


class OutOfReachError(ClosureError):
    """No posture closes the loops at these active coordinates."""


class SingularConfigurationError(ClosureError):
    """The loops close, but at a posture where the passive joints are not determined."""


class WrongBranchError(ClosureError):
    """The loops close, but in another assembly branch than the home posture's."""


class UnreachableTipError(CraneError):
    """No active coordinates within their limits put the tip where it was asked to be."""


class RecordingError(CraneError):
    """A recording is malformed."""


class SimulationError(CraneError):
    """A simulation could not go on.

    Attributes:
        recording: What there is of it, whose `stopped` says where and why it ended; None where it
            did not begin, or where nothing was to be recorded.
    """

    recording: Any = None


class OutputError(CraneError):
    """A result cannot be written where it was asked to be."""


class CraneWarning(UserWarning):
    """Something is unusual enough to be told, and not wrong enough to refuse."""


_MAX_SEARCHED_NAMES = 2000  # names to search for a similar one
_HOLDS = 0.7  # likeness of names of which one holds the other
_MAX_LISTED_NAMES, _NEAREST = (
    20,
    8,
)  # names that a line has of all, and of many: those like the wanted one


def suggest_names(names: Iterable[str], unknown_name: str | None = None) -> str:
    """Words an error ends with: the name that was meant, all there are, or of many the nearest.

    Args:
        names: Those that exist.
        unknown_name: What was asked for, and is none of them.
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


def _likeness(name: str, wanted: str) -> float:
    """How alike two names are, 0 to 1, whatever their case; more if one holds the other."""
    name, wanted = name.lower(), wanted.lower()
    alike = SequenceMatcher(None, name, wanted).ratio()
    return max(alike, _HOLDS) if wanted and (wanted in name or name in wanted) else alike
