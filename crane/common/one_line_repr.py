"""How an object is shown: in one line at a prompt, as HTML in a notebook."""

from collections.abc import Callable, Sized
from typing import Any

MAX_LINE_LENGTH = 200  # letters of a line


def _no_html(_: Any) -> str | None:
    return None


# What makes HTML of an object, or None where it has none: `crane.view.notebook.to_html`. The
# package
# puts it here, because views stand above nothing (see CONTRIBUTING.md).
to_html: Callable[[Any], str | None] = _no_html


class OneLineRepr:
    """A `repr` of at most `MAX_LINE_LENGTH` letters: shapes of arrays, lengths of lists."""

    def __repr__(self) -> str:
        """One line, cut where it is too long."""
        return shorten_to_line(self._one_line())

    def _repr_html_(self) -> str | None:
        """What notebooks show."""
        return to_html(self)

    def _one_line(self) -> str:
        """Class and fields."""
        words = []
        for name, value in vars(self).items():
            if name.startswith("_"):
                continue
            if isinstance(value, str | int | float | bool) or value is None:
                words.append(f"{name}={value!r}")
            elif isinstance(shape := getattr(value, "shape", None), tuple):
                words.append(f"{name}={shape}")
            elif isinstance(title := getattr(value, "name", None), str):
                words.append(f"{name}={title!r}")
            elif isinstance(value, Sized) and not isinstance(value, OneLineRepr):
                words.append(f"{name}: {len(value)}")
        return f"{type(self).__name__}({', '.join(words)})"


def shorten_to_line(text: str) -> str:
    """A text in one line of at most `MAX_LINE_LENGTH` letters."""
    line = "".join(letter if letter.isprintable() else " " for letter in text)
    return line if len(line) <= MAX_LINE_LENGTH else f"{line[: MAX_LINE_LENGTH - 1]}\u2026"


def format_count(count: int, singular: str, plural: str = "") -> str:
    """A number with its noun: "1 loop", "3 loops"."""
    return f"{count} {singular if count == 1 else plural or f'{singular}s'}"
