"""Messages that say the same of many things: each kind once, with its number."""

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from crane.common.errors import CraneWarning

MAX_WARNINGS = 5  # warnings of one file
_LOCATION_PATTERN = re.compile(r"^.+?\.\w+:\d+: ")
_QUOTED_PATTERN = re.compile(r"'[^']*'")
_NUMBER_PATTERN = re.compile(r"(?<![\w.])-?\d+(\.\d*)?(e[-+]?\d+)?")


def message_kind(message: str) -> str:
    """A message without its place, and with blanks for names and numbers."""
    return _NUMBER_PATTERN.sub("#", _QUOTED_PATTERN.sub("''", _LOCATION_PATTERN.sub("", message)))


@dataclass
class MessageGroup:
    """Messages of one kind.

    Attributes:
        first_message: The first of them.
        count: How many there are.
    """

    first_message: str
    count: int = 1

    def __str__(self) -> str:
        return (
            self.first_message if self.count == 1 else f"{self.first_message} ({self.count} such)"
        )


def group_messages(messages: Iterable[str]) -> list[MessageGroup]:
    """Messages by kind, in the order in which the kinds came."""
    found: dict[str, MessageGroup] = {}
    for message in messages:
        group = found.get(message_kind(message))
        if group is None:
            found[message_kind(message)] = MessageGroup(message)
        else:
            group.count += 1
    return list(found.values())


@contextmanager
def summarize_warnings() -> Iterator[None]:
    """Warnings from within come at the end: of each kind one, and at most `MAX_WARNINGS`."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CraneWarning)
        yield
    package_messages = [
        str(one.message) for one in caught if issubclass(one.category, CraneWarning)
    ]
    for one in caught:
        if not issubclass(one.category, CraneWarning):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    groups = group_messages(dict.fromkeys(package_messages))
    texts = [str(group) for group in groups]
    if len(texts) > MAX_WARNINGS:
        rest = sum(group.count for group in groups[MAX_WARNINGS - 1 :])
        texts[MAX_WARNINGS - 1 :] = [f"{rest} more warnings: crane check lists them"]
    for text in texts:
        warnings.warn(text, CraneWarning, stacklevel=4)
