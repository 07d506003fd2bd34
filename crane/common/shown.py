"""How an object is shown: in one line at a prompt, as HTML in a notebook."""

from collections.abc import Callable, Sized
from typing import Any

MOST = 200  # letters of a line


def _nothing(_: Any) -> str | None:
    return None


# What makes HTML of an object, or None where it has none: `crane.view.notebook.html`. The package
# puts it here, because views stand above nothing (see CONTRIBUTING.md).
to_html: Callable[[Any], str | None] = _nothing


class Brief:
    """Shown in one line of at most `MOST` letters: arrays by shapes, collections by lengths."""

    def __repr__(self) -> str:
        """One line, cut where it is too long."""
        return shortened(self._line())

    def _repr_html_(self) -> str | None:
        """What notebooks show."""
        return to_html(self)

    def _line(self) -> str:
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
            elif isinstance(value, Sized) and not isinstance(value, Brief):
                words.append(f"{name}: {len(value)}")
        return f"{type(self).__name__}({', '.join(words)})"


def shortened(text: str) -> str:
    """A text in one line of at most `MOST` letters."""
    line = "".join(letter if letter.isprintable() else " " for letter in text)
    return line if len(line) <= MOST else f"{line[: MOST - 1]}\u2026"


def counted(number: int, one: str, many: str = "") -> str:
    """A number with its noun: "1 loop", "3 loops"."""
    return f"{number} {one if number == 1 else many or f'{one}s'}"
