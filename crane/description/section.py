"""Strict reading of YAML: every key known, every value of its kind, every error with its line."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from crane.errors import DescriptionError, known


class _Map(dict[str, Any]):
    """A mapping that remembers the line of each key."""

    def __init__(self, line: int):
        super().__init__()
        self.line = line
        self.lines: dict[str, int] = {}


class _Loader(yaml.SafeLoader):
    """SafeLoader with lines, and without silently taking the last of equal keys."""


def _construct_map(loader: _Loader, node: yaml.MappingNode) -> _Map:
    data = _Map(node.start_mark.line + 1)
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, deep=True)
        line = key_node.start_mark.line + 1
        where = f"{Path(loader.name).name}:{line}"
        if not isinstance(key, str):
            raise DescriptionError(f"{where}: key {key!r} is not a name, write it in quotes")
        if key in data:
            raise DescriptionError(f"{where}: key '{key}' is there twice, keep one")
        data[key] = loader.construct_object(value_node, deep=True)
        data.lines[key] = line
    return data


_Loader.add_constructor("tag:yaml.org,2002:map", _construct_map)

_MISSING: Any = object()


class Section:
    """A mapping of a machine file, of which every key must be asked for.

    Args:
        data: The mapping.
        title: What it is, for errors ("loop 'A1_eye'").
        file: The file it stands in.
    """

    def __init__(self, data: _Map, title: str, file: Path):
        self._data, self._title, self._file = data, title, file
        self._asked: list[str] = []

    @classmethod
    def read(cls, file: Path) -> "Section":
        """The top level of a YAML file.

        Raises:
            DescriptionError: The file is missing, not YAML, or not a mapping.
        """
        try:
            with file.open(encoding="utf-8") as stream:
                data = yaml.load(stream, _Loader)  # noqa: S506 (a SafeLoader)
        except FileNotFoundError:
            raise DescriptionError(f"{file}: no such file, check the path") from None
        except (OSError, UnicodeDecodeError) as error:
            raise DescriptionError(f"{file}: cannot be read ({error}), check the file") from None
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            line = f":{mark.line + 1}" if mark else ""
            problem = getattr(error, "problem", None) or str(error).splitlines()[0]
            raise DescriptionError(f"{file.name}{line}: not YAML, {problem}, mend it") from None
        except RecursionError:
            raise DescriptionError(f"{file.name}: nested too deep, simplify it") from None
        if not isinstance(data, _Map):
            raise DescriptionError(f"{file.name}: not a machine file, it must start with 'name:'")
        return cls(data, "machine file", file)

    def where(self, key: str | None = None) -> str:
        """File and line of the section or of one of its keys."""
        line = self._data.lines.get(key, self._data.line) if key else self._data.line
        return f"{self._file.name}:{line}"

    def fail(self, key: str | None, what: str) -> DescriptionError:
        """An error that points at a key."""
        return DescriptionError(f"{self.where(key)}: {what}")

    def _take(self, key: str, default: Any) -> Any:
        self._asked.append(key)
        value = self._data.get(key, default)
        if value is _MISSING or (value is None and default is _MISSING):
            raise self.fail(None, f"{self._title} has no '{key}', add it")
        return default if value is None else value

    def text(self, key: str, default: str | None = _MISSING) -> str:
        """A non-empty string."""
        value = self._take(key, default)
        if value is default and default is not _MISSING:
            return value
        if not isinstance(value, str) or not value.strip():
            raise self.fail(key, f"'{key}' of {self._title} must be text, not {value!r}")
        return value

    def number(self, key: str, default: float = _MISSING, minimum: float = -math.inf) -> float:
        """A finite number, at least `minimum`."""
        number = self._number(key, self._take(key, default))
        if number < minimum:
            raise self.fail(key, f"'{key}' of {self._title} is {number}, at least {minimum:g}")
        return number

    def _number(self, key: str, value: Any) -> float:
        # PyYAML reads 2e5 as text
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise self.fail(key, f"'{key}' of {self._title} must be a number, not {value!r}")
        try:
            number = float(value)
        except (ValueError, OverflowError):
            number = math.nan
        if not math.isfinite(number):
            raise self.fail(key, f"'{key}' of {self._title} must be a number, not {value!r}")
        return number

    def numbers(self, key: str, default: Any = _MISSING) -> tuple[float, ...]:
        """A list of finite numbers."""
        value = self._take(key, default)
        if not isinstance(value, list | tuple) or not value:
            raise self.fail(
                key, f"'{key}' of {self._title} must be a list of numbers, not {value!r}"
            )
        return tuple(self._number(key, item) for item in value)

    def names(self, key: str) -> tuple[str, ...]:
        """A list of different names."""
        value = self._take(key, _MISSING)
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self.fail(key, f"'{key}' of {self._title} must be a list of names")
        twice = sorted({item for item in value if value.count(item) > 1})
        if twice:
            raise self.fail(key, f"'{key}' names {', '.join(twice)} twice, name it once")
        return tuple(value)

    def section(self, key: str, title: str | None = None) -> "Section | None":
        """A mapping, or None where the key is absent."""
        value = self._take(key, None)
        if value is None:
            return None
        if not isinstance(value, _Map):
            raise self.fail(key, f"'{key}' of {self._title} must be a mapping 'name: value'")
        return Section(value, title or f"'{key}'", self._file)

    def sections(self, key: str, title: str) -> Iterator["Section"]:
        """The mappings of a list; none where the key is absent."""
        value = self._take(key, [])
        if not isinstance(value, list):
            raise self.fail(key, f"'{key}' of {self._title} must be a list, its items with '- '")
        for item in value:
            if not isinstance(item, _Map):
                raise self.fail(key, f"'{key}' holds {item!r}, each item must be a mapping")
            name = item.get("name", item.get("joint"))
            yield Section(item, f"{title} '{name}'" if name else f"a {title}", self._file)

    def keys(self) -> list[str]:
        """The keys that are there."""
        return list(self._data)

    def done(self) -> None:
        """Raise for keys that nobody asked for.

        Raises:
            DescriptionError: There is an unknown key; the nearest known one is named.
        """
        for key in self._data:
            if key not in self._asked:
                hint = known(self._asked, key)
                raise self.fail(key, f"unknown key '{key}' in {self._title}, {hint}")
