"""Warnings about parts of a file that a conversion between formats leaves out or changes."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from crane.common.errors import warn


class ConversionNotes:
    """Notes taken while a file is read, for one warning of each kind at the end.

    Args:
        file: The file that is read.
        format_name: What warnings call its format.
        max_names: Names that a warning lists at most for one feature.

    Attributes:
        file: The file.
    """

    def __init__(self, file: Path, format_name: str, max_names: int):
        self.file = file
        self._max_names = max_names
        self._notes: Mapping[str, dict[str, list[str]]] = {
            f"left out of what {format_name} has": {},
            f"otherwise than in {format_name}": {},
        }
        self._unsupported, self._differences = self._notes.values()

    def note_unsupported(self, feature: str, *names: str) -> None:
        """Note a feature that is left out, with the names of the elements that have it."""
        self._unsupported.setdefault(feature, []).extend(names)

    def note_difference(self, difference: str, *names: str) -> None:
        """Note that elements are interpreted differently than in the format."""
        self._differences.setdefault(difference, []).extend(names)

    def warn_about_notes(self) -> None:
        """Issue one warning for the omitted features and one for the differences."""
        for heading, notes in self._notes.items():
            if notes:
                words = [f"{what}{self._names_text(names)}" for what, names in notes.items()]
                self.warn(f"{heading}: {'; '.join(words)}")

    def warn(self, text: str) -> None:
        """Issue a warning about the file."""
        warn(f"{self.file.name}: {text}", stacklevel=3)

    def _names_text(self, names: Iterable[str]) -> str:
        listed = list(dict.fromkeys(filter(None, names)))
        if (more := len(listed) - self._max_names) > 0:
            listed[self._max_names :] = [f"{more} more"]
        return f" ({', '.join(listed)})" if listed else ""
