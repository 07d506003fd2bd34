"""One-line `repr` of objects, and their HTML representation in notebooks."""

from collections.abc import Callable, Sequence, Sized
from typing import Any

MAX_LINE_LENGTH = 200  # characters


# Converts an object to HTML, or returns None. `crane.view.notebook` sets it, because this room may
# not import that one (see CONTRIBUTING.md).
to_html: Callable[[Any], str | None]


class OneLineRepr:
    """Base class with a one-line `repr` of at most `MAX_LINE_LENGTH` characters."""

    def __repr__(self) -> str:
        """One line, shortened if necessary."""
        return shorten_to_line(self._one_line())

    def _repr_html_(self) -> str | None:
        return to_html(self)  # noqa: F821 - set by the package

    def _one_line(self) -> str:
        """Class name and public fields: values, shapes of arrays, lengths of sequences."""
        words = [_field_text(k, x) for k, x in vars(self).items() if not k.startswith("_")]
        return f"{type(self).__name__}({', '.join(filter(None, words))})"


def _field_text(name: str, value: Any) -> str:
    """A field by its value, shape, name or length; "" if it has none of them."""
    if isinstance(value, str | int | float | bool) or value is None:
        return f"{name}={value!r}"
    if isinstance(shape := getattr(value, "shape", None), tuple):
        return f"{name}={shape}"
    if isinstance(title := getattr(value, "name", None), str):
        return f"{name}={title!r}"
    if isinstance(value, Sized) and not isinstance(value, OneLineRepr):
        return f"{name}: {len(value)}"
    return ""


def shorten_to_line(text: str) -> str:
    """A text as one line of at most `MAX_LINE_LENGTH` characters."""
    line = "".join(letter if letter.isprintable() else " " for letter in text)
    return line if len(line) <= MAX_LINE_LENGTH else f"{line[: MAX_LINE_LENGTH - 1]}\u2026"


def list_first(words: Sequence[str], kind: str, limit: int) -> str:
    """The first of some words, and how many more of a kind there are: "'a', 'b' and 2 more x"."""
    more = f" and {len(words) - limit} more {kind}" if len(words) > limit else ""
    return ", ".join(words[:limit]) + more


def format_count(count: int, singular: str, plural: str = "") -> str:
    """A number with its noun: "1 loop", "3 loops"."""
    return f"{count} {singular if count == 1 else plural or f'{singular}s'}"
