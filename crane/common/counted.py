"""Messages that say the same of many things: each kind once, with its number."""

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from crane.common.errors import CraneWarning

MOST = 5  # warnings of one file
_PLACE = re.compile(r"^.+?\.\w+:\d+: ")
_QUOTED = re.compile(r"'[^']*'")
_NUMBER = re.compile(r"(?<![\w.])-?\d+(\.\d*)?(e[-+]?\d+)?")


def kind(message: str) -> str:
    """A message without its place, and with blanks for names and numbers."""
    return _NUMBER.sub("#", _QUOTED.sub("''", _PLACE.sub("", message)))


@dataclass
class Group:
    """Messages of one kind.

    Attributes:
        first: The first of them.
        count: How many there are.
    """

    first: str
    count: int = 1

    def __str__(self) -> str:
        return self.first if self.count == 1 else f"{self.first} ({self.count} such)"


def grouped(messages: Iterable[str]) -> list[Group]:
    """Messages by kind, in the order in which the kinds came."""
    found: dict[str, Group] = {}
    for message in messages:
        group = found.get(kind(message))
        if group is None:
            found[kind(message)] = Group(message)
        else:
            group.count += 1
    return list(found.values())


@contextmanager
def few_warnings() -> Iterator[None]:
    """Warnings from within come at the end: of each kind one, and at most `MOST`."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", CraneWarning)
        yield
    ours = [str(one.message) for one in heard if issubclass(one.category, CraneWarning)]
    for one in heard:
        if not issubclass(one.category, CraneWarning):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    groups = grouped(dict.fromkeys(ours))
    told = [str(group) for group in groups]
    if len(told) > MOST:
        rest = sum(group.count for group in groups[MOST - 1 :])
        told[MOST - 1 :] = [f"{rest} more warnings: crane check lists them"]
    for text in told:
        warnings.warn(text, CraneWarning, stacklevel=4)
