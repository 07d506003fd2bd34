"""Values of a machine file, read as their schema says, every error with its file and line."""

import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from crane.common.errors import DescriptionError, check_name, suggest_names
from crane.common.number_text import parse_float
from crane.common.unit_conversions import (
    KeyPath,
    UnitError,
    WrittenNumber,
    parse_quantity,
)
from crane.description.findings import UnknownNames, error_recovery, report_error
from crane.description.key_types import (
    REQUIRED,
    FileKey,
    FlagKey,
    Key,
    NameListKey,
    NumberKey,
    NumberListKey,
    RowListKey,
    SectionSchema,
    TextKey,
)
from crane.formats.machine_file.yaml_text import (
    LocatedMapping,
    format_value,
    written_numbers_by_path,
)

_BOOLEAN_WORDS = {"on": True, "yes": True, "true": True, "off": False, "no": False, "false": False}


def as_float(value: Any) -> float:
    """A value as a number, NaN where it is none; in quotes it is a text."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return math.nan
    try:
        return parse_float(value) if isinstance(value, str) else float(value)
    except (ValueError, OverflowError):
        return math.nan


def as_boolean(value: Any) -> bool | None:
    """A value as true or false, None where it is neither; words of YAML may be quoted."""
    if isinstance(value, str):
        return _BOOLEAN_WORDS.get(value.strip().lower())
    return value if isinstance(value, bool) else None


class YamlValues:
    """A mapping of a machine file, and its values that are no mappings.

    Args:
        data: The mapping.
        schema: Its keys.
        title: What errors call it; "": the title of the schema.
        location: File and line, if not the mapping's own.
        name: Key of the mapping in the one that holds it, often that of a joint.
        turns: Whether joints and coordinates turn, by name, for the units of their numbers.

    Attributes:
        schema: See above.
        title: See above.
        turns: See above; shared with the sections in this one.
        is_complete: Whether no item of its lists had to be left out.
    """

    def __init__(
        self,
        data: LocatedMapping,
        schema: SectionSchema,
        title: str = "",
        location: tuple[Path, int] | None = None,
        name: str = "",
        turns: dict[str, bool] | None = None,
    ):
        self._data, self.schema, self._name = data, schema, name
        self.turns: dict[str, bool] = {} if turns is None else turns
        self.title = title or schema.title
        self.is_complete = True
        self._location = (data.file, data.line) if location is None else location

    def __iter__(self) -> Iterator[str]:
        return iter(self._data)

    def check_keys(self, names: Iterable[str]) -> None:
        """Raise for a key that is not among these.

        Raises:
            DescriptionError: The nearest known key is named. Where findings are collected, the
                value is read as if it had that name.
        """
        if isinstance(names, UnknownNames):
            return
        names = tuple(names)
        for key in [key for key in self._data if key not in names]:
            near = get_close_matches(key, names, 1, 0.75)
            near = near or [name for name in names if name.lower() == key.lower()]
            is_meant = bool(near) and near[0] not in self._data
            report_error(
                self.error_at(
                    key, f"unknown key '{key}' in {self.title}, {suggest_names(names, key)}"
                ),
                harmless=True,
            )
            if is_meant:
                self._data[near[0]] = self._data[key]
                self._data.locations[near[0]] = self._data.locations[key]

    def written_numbers(self) -> dict[KeyPath, WrittenNumber]:
        """The numbers that were read of the section, as written, by the ways to them."""
        return written_numbers_by_path(self._data)

    def source_location(self, key: str | None = None) -> str:
        """File and line of the section or of one of its keys."""
        file, line = self._data.locations.get(key, self._location) if key else self._location
        return f"{file.name}:{line}"

    def error_at(self, key: str | None, problem: str) -> DescriptionError:
        """An error that points at a key."""
        return DescriptionError(f"{self.source_location(key)}: {problem}")

    def check_name(self, key: str, name: str, names: Collection[str], problem: str) -> None:
        """Raise for a name in the value of a key that is not among some."""
        check_name(name, names, f"{self.source_location(key)}: {problem}", DescriptionError)

    def _value_error(self, key: str, value_text: str, hint: str) -> DescriptionError:
        return self.error_at(key, f"'{key}' of {self.title} is {value_text}, {hint}")

    def _key(self, name: str) -> Key:
        return self.schema.keys.get(name) or self.schema.others or Key()

    def raw_value(self, key: str) -> Any:
        """A value, whatever it is.

        Raises:
            DescriptionError: There is none.
        """
        value = self._data.get(key, self._key(key).default)
        if value is None and key in self._data:
            raise self.error_at(key, f"'{key}' of {self.title} is empty, give its value")
        if value is None or value is REQUIRED:
            raise self.error_at(None, f"{self.title} has no '{key}', add it")
        return value

    def values(self, *excluded: str) -> dict[str, Any]:
        """Values of the keys that are given, by the names of the fields that they are.

        Mappings, lists of mappings and values of mixed types are left to other methods.

        Args:
            excluded: Keys to leave out.

        Raises:
            DescriptionError: A value is not of its type, a key is missing, or two keys exclude
                each other.
        """
        self.check_exclusive_keys()
        found = {}
        for name, key in self.schema.keys.items():
            reader = _READERS.get(type(key))
            if reader is None or name in excluded:
                continue
            alternatives = self.schema.alternatives(name)
            is_missing = key.default is REQUIRED and self._data.keys().isdisjoint(alternatives)
            value = reader(self, name) if name in self._data or is_missing else None
            if value is not None:
                found[key.attribute or name] = value
        return found

    def check_exclusive_keys(self) -> None:
        """Raise for two keys of which the schema allows one."""
        for first, second, problem in self.schema.exclusive:
            key = next((x for x in first if x in self._data), None)
            other = next((x for x in second if x in self._data and x != key), None)
            if key is not None and other is not None:
                names = {"key": key, "other": other, "title": self.title}
                raise self.error_at(
                    (None if first == second else key), problem.format_map(self._data | names)
                )

    def text(self, key: str) -> Any:
        """A non-empty string, None where there may be none; empty where its error is reported."""
        with error_recovery():
            default = self._key(key).default
            if default is not REQUIRED and self._data.get(key, default) is default:
                return default
            value = self.raw_value(key)
            if not isinstance(value, str) or not value.strip():
                raise self._value_error(key, format_value(value), "give text (or quote it)")
            if not "".join(value.split()).isprintable():
                raise self.error_at(
                    key, f"'{key}' of {self.title} holds control characters, remove them"
                )
            self._check_choice(key, value)
            return value
        return ""

    def _check_choice(self, key: str, value: str) -> None:
        choices = self._key(key).choices or (value,)
        self.check_name(key, value, choices, f"'{key}' of {self.title}: '{value}' is unknown")

    def number(self, key: str) -> float:
        """A finite number within its bounds; NaN where its error is reported."""
        with error_recovery():
            number = self._read_number(key, self.raw_value(key))
            spec = self._number_key(key, NumberKey)
            if not isinstance(spec, NumberKey):
                return number
            if spec.minimum is not None and number < spec.minimum:
                raise self._value_error(key, f"{number:g}", f"give at least {spec.minimum:g}")
            if number == 0 and spec.zero_error:
                raise self.error_at(key, spec.zero_error.format(key=key, title=self.title))
            return number
        return math.nan

    def _number_key(self, key: str, *kinds: type[Key]) -> Key:
        """The type of a key, that of numbers of one that may have several."""
        spec = self._key(key)
        return next((x for x in getattr(spec, "types", ()) if type(x) in kinds), spec)

    def si_units(self, key: str, position: Sequence[int] = ()) -> tuple[str, ...]:
        """SI unit of a number, that of its joint; both, where its joint is not known.

        Args:
            key: The key.
            position: Where it is in the list or the rows of the key.
        """
        spec = self._number_key(key, *((NumberListKey, RowListKey) if position else (NumberKey,)))
        if not isinstance(spec, NumberKey):
            return ("",)
        coordinate = key if key not in self.schema.keys else ""
        joints = self._data.get("joints")
        names = [coordinate, self._name, self._data.get("joint")]
        names += joints if isinstance(joints, dict | list) else ()
        kinds = {self.turns[x] for x in names if isinstance(x, str) and x in self.turns}
        turns = kinds.pop() if len(kinds) == 1 else None
        if "between" in self._data:
            turns = False
        return spec.si_units(turns, position)

    def _read_number(self, key: str, value: Any, *position: int) -> float:
        written = WrittenNumber(as_float(value))
        if isinstance(value, str) and "," in value:
            raise self._value_error(key, format_value(value), "give a number with a decimal point")
        if isinstance(value, str):
            try:
                written = parse_quantity(value, self.si_units(key, position))
            except UnitError as error:
                raise self._value_error(key, format_value(value), str(error)) from None
        if not math.isfinite(written.value):
            hint = f"give a {'finite ' if isinstance(value, float) else ''}number"
            raise self._value_error(key, format_value(value), hint)
        self._data.written_numbers[key, *position] = written
        return written.value

    def boolean(self, key: str) -> bool:
        """True or false, as on and off, in quotes or without."""
        value = self.raw_value(key)
        found = as_boolean(value)
        if found is None:
            raise self._value_error(key, format_value(value), "give true or false")
        return found

    def numbers(self, key: str) -> tuple[float, ...]:
        """A list of finite numbers."""
        value = self.raw_value(key)
        if not isinstance(value, list | tuple) or not value:
            raise self._value_error(
                key,
                ("empty" if value == [] else format_value(value)),
                "give a list such as [0, 1]",
            )
        return tuple(self._read_number(key, item, i) for i, item in enumerate(value))

    def rows(self, key: str) -> list[list[float]]:
        """A list of finite numbers, or of such lists: one row, or as many."""
        value = self.raw_value(key)
        is_nested = isinstance(value, list | tuple) and any(isinstance(x, list) for x in value)
        rows = value if is_nested else [value]
        if not all(isinstance(row, list | tuple) and row for row in rows):
            raise self._value_error(
                key, format_value(value), "give a list such as [0, 0, 1], or one of such lists"
            )
        return [
            [
                self._read_number(key, item, *([i] if is_nested else []), j)
                for j, item in enumerate(row)
            ]
            for i, row in enumerate(rows)
        ]

    def read_list(
        self, key: str, hint: str, is_item: Callable[[Any], bool], item_hint: str
    ) -> list[Any]:
        """A list whose items pass a test; else the errors have these hints."""
        value = self.raw_value(key)
        if not isinstance(value, list):
            raise self._value_error(key, format_value(value), hint)
        for item in value:
            if not is_item(item):
                raise self.error_at(key, f"'{key}' lists {format_value(item)}, {item_hint}")
        return value

    def names(self, key: str) -> tuple[str, ...]:
        """A list of different names, empty where the key is absent."""
        if key not in self._data and self._key(key).default is not REQUIRED:
            return ()
        value = self.read_list(
            key, "give a list such as [q1, q2]", lambda x: isinstance(x, str) and x != "",
            "which is not a name, quote it",
        )  # fmt: skip
        for item in value:
            if value.count(item) > 1:
                raise self.error_at(key, f"'{key}' lists '{item}' twice, list it once")
            self._check_choice(key, item)
        return tuple(value)

    def file(self, key: str) -> Path:
        """A file, named by its path from the folder of the file that names it."""
        text = self.text(key)
        path = self._data.locations.get(key, self._location)[0].parent / text
        if os.path.isdir(path):
            raise self.error_at(key, f"'{text}' of {self.title} is a folder, give a file")
        if not os.path.isfile(path):  # also for invalid names
            raise self.error_at(
                key, f"{self.title}: there is no file '{text}', give its path from this folder"
            )
        return path.resolve()


_READERS: dict[type[Key], Callable[[YamlValues, str], Any]] = {
    TextKey: YamlValues.text,
    FileKey: YamlValues.file,
    FlagKey: YamlValues.boolean,
    NumberKey: YamlValues.number,
    NumberListKey: YamlValues.numbers,
    NameListKey: YamlValues.names,
}
