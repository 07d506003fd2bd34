"""Strict reading of YAML: every key known, every value of its kind, every error with its line."""

import errno
import math
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any, overload

import yaml

from crane.common.errors import DescriptionError, suggest_names
from crane.common.package_search import read_plain_file
from crane.description.findings import UnknownNames, error_recovery, report_error
from crane.description.machine_lookup import bundled_machines

ALL_ITEM = "all"  # an item whose keys hold for all beside it
EXTENDS_KEY = "extends"  # the key that names the file a machine file is a variant of


class _LocatedMapping(dict[str, Any]):
    """A mapping that remembers file and line of each key."""

    def __init__(self, file: Path, line: int):
        super().__init__()
        self.file, self.line = file, line
        self.locations: dict[str, tuple[Path, int]] = {}

    def copy_key(self, source: "_LocatedMapping", key: str) -> None:
        """Take over the value of a key, and where it stands."""
        self[key], self.locations[key] = source[key], source.locations[key]

    def update_from_variant(self, variant: "_LocatedMapping") -> None:
        """Put a variant's keys over these: mappings key by key, all else whole, empty ones off."""
        for key, value in variant.items():
            if isinstance(value, _LocatedMapping) and isinstance(self.get(key), _LocatedMapping):
                self[key].update_from_variant(value)
                self.locations[key] = variant.locations[key]
            elif value is None:
                self.pop(key, None)
            else:
                self.copy_key(variant, key)
        self.file, self.line = variant.file, variant.line


class _StrictConstructor(yaml.constructor.SafeConstructor):
    """SafeConstructor with lines, and without silently taking the last of equal keys."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """A value; what cannot be one (a 13th month, 0x without digits) is an error of YAML."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, KeyError, AttributeError, TypeError, OverflowError):
            problem = f"'{node.value}' is no value of its kind, quote it if it is text"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None


class _StrictLoader(_StrictConstructor, yaml.SafeLoader):
    """Reads text, and says best what is wrong with it."""


if yaml.__with_libyaml__:

    class _FastLoader(_StrictConstructor, yaml.CSafeLoader):
        """Reads text in a tenth of the time."""


def _construct_mapping(loader: Any, node: yaml.MappingNode) -> _LocatedMapping:
    file = Path(loader.name)
    data = _LocatedMapping(file, node.start_mark.line + 1)
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        where = f"{file.name}:{line}"
        if key_node.tag == "tag:yaml.org,2002:merge":
            report_error(DescriptionError(f"{where}: '<<' is not supported, write the keys out"))
            continue
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            number = isinstance(key, int) and not isinstance(key, bool)
            hint = ", and decimals with a point" if number else ""
            problem = f"key {_format_value(key)} is not a name, write names in quotes{hint}"
            report_error(DescriptionError(f"{where}: {problem}"))
            continue
        if key in data:
            first_line = data.locations[key][1]
            problem = f"key '{key}' is there twice (first in line {first_line}), keep one"
            report_error(DescriptionError(f"{where}: {problem}"))
            continue
        data[key] = loader.construct_object(value_node, deep=True)
        data.locations[key] = file, line
    return data


_StrictConstructor.add_constructor("tag:yaml.org,2002:map", _construct_mapping)

_NO_VALUE: Any = object()
_BOOLEAN_WORDS = {"on": True, "yes": True, "true": True, "off": False, "no": False, "false": False}
MAX_FILE_SIZE = 2_000_000  # bytes of a file; the reader takes a minute for ten million


def _to_plain_data(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _to_plain_data(item) for key, item in value.items()}
    return [_to_plain_data(item) for item in value] if isinstance(value, list) else value


def _format_value(value: Any) -> str:
    """A value in an error: short, whatever it is."""
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list | tuple | set):
        return "a list"
    if isinstance(value, bool):
        return f"{value} (in YAML, yes, no, on and off mean true and false)"
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) < 60 else f"{text[:60]}..."


def as_float(value: Any) -> float:
    """What a value is as a number, NaN where it is none; PyYAML reads 2e5 as text."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return math.nan
    try:
        return float(value)
    except (ValueError, OverflowError):
        return math.nan


def as_boolean(value: Any) -> bool | None:
    """What a value is as true or false, None where it is neither; YAML's words may be quoted."""
    if isinstance(value, str):
        return _BOOLEAN_WORDS.get(value.strip().lower())
    return value if isinstance(value, bool) else None


def _compose(text: str) -> tuple[Any, yaml.Node | None]:
    """What is in a text, and the loader that constructs it."""
    if yaml.__with_libyaml__ and "\t" not in text:  # which PyYAML refuses in more places
        with suppress(yaml.YAMLError):
            fast_loader = _FastLoader(text)
            return fast_loader, fast_loader.get_single_node()
    loader = _StrictLoader(text)
    return loader, loader.get_single_node()


def _parse_file(file: Path) -> _LocatedMapping:
    """The mapping in a YAML file.

    Raises:
        DescriptionError: The file is missing, not YAML, or no mapping.
    """
    try:
        loader, node = _compose(read_plain_file(file, MAX_FILE_SIZE).decode("utf-8"))
        loader.name = str(file)
        data = None if node is None else loader.construct_document(node)
    except UnicodeDecodeError:
        raise DescriptionError(f"{file.name}: not UTF-8, save it as UTF-8 text") from None
    except OSError as error:
        if error.errno == errno.EFBIG:
            error_text = f"{error.strerror}, which takes too long, shorten it"
            raise DescriptionError(f"{file.name}: {error_text}") from None
        raise DescriptionError(
            f"{file}: cannot be read ({error.strerror}), check the path"
        ) from None
    except yaml.reader.ReaderError as error:
        error_text = f"it holds the control character number {error.character}"
        raise DescriptionError(f"{file.name}: not YAML, {error_text}, remove it") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "broken"
        raise DescriptionError(f"{file.name}{line}: not YAML, {problem}, mend it") from None
    except RecursionError:
        raise DescriptionError(f"{file.name}: nested too deep, simplify it") from None
    if data is None:
        raise DescriptionError(f"{file.name}: the file is empty, write a machine in it")
    if not isinstance(data, _LocatedMapping):
        raise DescriptionError(f"{file.name}: not a machine file, write keys such as 'name:'")
    return data


def _parse_with_base(file: Path, including_files: tuple[Path, ...]) -> _LocatedMapping:
    """A machine file put over the one that it extends, which may extend another.

    Args:
        file: The machine file.
        including_files: The variants that led to it, resolved.
    """
    variant = _parse_file(file)
    if EXTENDS_KEY not in variant:
        return variant
    section = YamlSection(variant, "the machine file")
    base_name = section.text(EXTENDS_KEY)
    base_file = bundled_machines().get(base_name) or section.file(EXTENDS_KEY)
    if base_file.suffix.lower() not in (".yaml", ".yml"):
        raise section.error_at(
            EXTENDS_KEY, f"'{base_name}' is no machine file (.yaml), a variant needs one"
        )
    including_files = (*including_files, file.resolve())
    if base_file in including_files:
        raise section.error_at(
            EXTENDS_KEY, f"'{base_name}' is a variant of this file itself, extend another"
        )
    del variant[EXTENDS_KEY]
    data = _parse_with_base(base_file, including_files)
    data.update_from_variant(variant)
    return data


class YamlSection:
    """A mapping of a machine file.

    Args:
        data: The mapping.
        title: What it is, for errors ("loop 'A1_eye'").
        place: File and line, if not the mapping's own.

    Attributes:
        title: See above.
        is_complete: Whether no item of its lists had to be left out.
    """

    def __init__(
        self, data: _LocatedMapping, title: str, location: tuple[Path, int] | None = None
    ):
        self._data, self.title = data, title
        self.is_complete = True
        self._location = (data.file, data.line) if location is None else location

    @classmethod
    def read(cls, file: Path, keys: Collection[str]) -> "YamlSection":
        """The top level of a YAML file, a variant put over what it extends.

        Raises:
            DescriptionError: A file is missing, not YAML, or not a mapping of these keys.
        """
        data = _parse_with_base(file, ()) if EXTENDS_KEY in keys else _parse_file(file)
        section = cls(data, "the machine file")
        section.check_keys(*keys)
        return section

    def to_plain_data(self) -> dict[str, Any]:
        """All keys and values, without places."""
        found: dict[str, Any] = _to_plain_data(self._data)
        return found

    def check_keys(self, *keys: str) -> None:
        """Raise for any other key.

        Raises:
            DescriptionError: There is an unknown key; the nearest known one is named. Where
                findings are collected, what stands there is read as if it had that name.
        """
        for key in [key for key in self._data if key not in keys]:
            similar = get_close_matches(key, keys, 1, 0.75)
            similar = similar or [known for known in keys if known.lower() == key.lower()]
            is_correctable = bool(similar) and similar[0] not in self._data
            problem = f"unknown key '{key}' in {self.title}, {suggest_names(keys, key)}"
            report_error(self.error_at(key, problem), harmless=True)
            if is_correctable:
                self._data[similar[0]] = self._data[key]
                self._data.locations[similar[0]] = self._data.locations[key]

    def source_location(self, key: str | None = None) -> str:
        """File and line of the section or of one of its keys."""
        file, line = self._data.locations.get(key, self._location) if key else self._location
        return f"{file.name}:{line}"

    def error_at(self, key: str | None, problem: str) -> DescriptionError:
        """An error that points at a key."""
        return DescriptionError(f"{self.source_location(key)}: {problem}")

    def _get_value(self, key: str, default: Any) -> Any:
        value = self._data.get(key, default)
        if value is _NO_VALUE:
            raise self.error_at(None, f"{self.title} has no '{key}', add it")
        if value is None and default is not None:
            raise self.error_at(key, f"'{key}' of {self.title} is empty, give its value")
        return value

    def raw_value(self, key: str) -> Any:
        """A value, whatever it is.

        Raises:
            DescriptionError: There is none.
        """
        value = self._get_value(key, _NO_VALUE)
        if value is None:
            raise self.error_at(key, f"'{key}' of {self.title} is empty, give its value")
        return value

    @overload
    def text(self, key: str, default: str = ...) -> str: ...
    @overload
    def text(self, key: str, default: None) -> str | None: ...
    def text(self, key: str, default: str | None = _NO_VALUE) -> str | None:
        """A non-empty string; empty where it has been noted as wrong."""
        try:
            return self._read_text(key, default)
        except DescriptionError as error:
            report_error(error)
            return ""

    def _read_text(self, key: str, default: str | None) -> str | None:
        value = self._get_value(key, default)
        if value is default:
            return value
        if not isinstance(value, str) or not value.strip():
            raise self.error_at(
                key, f"'{key}' of {self.title} is {_format_value(value)}, give text (or quote it)"
            )
        if not "".join(value.split()).isprintable():
            raise self.error_at(
                key, f"'{key}' of {self.title} holds control characters, remove them"
            )
        return value

    def number(self, key: str, default: float = _NO_VALUE, minimum: float = -math.inf) -> float:
        """A finite number, at least `minimum`; NaN where it has been noted as wrong."""
        try:
            number = self._read_number(key, self._get_value(key, default))
            if number < minimum:
                raise self.error_at(
                    key, f"'{key}' of {self.title} is {number:g}, give at least {minimum:g}"
                )
            return number
        except DescriptionError as error:
            report_error(error)
            return math.nan

    def _read_number(self, key: str, value: Any) -> float:
        number = as_float(value)
        if math.isfinite(number):
            return number
        hint = "give a number"
        if isinstance(value, float):
            hint = "give a finite number"
        elif isinstance(value, str) and "," in value:
            hint = "give a number with a decimal point"
        raise self.error_at(key, f"'{key}' of {self.title} is {_format_value(value)}, {hint}")

    def boolean(self, key: str, default: bool) -> bool:
        """True or false, as on and off, in quotes or without."""
        value = as_boolean(self.raw_value(key)) if key in self._data else default
        if value is None:
            value_text = _format_value(self._data[key])
            raise self.error_at(
                key, f"'{key}' of {self.title} is {value_text}, give true or false"
            )
        return value

    def numbers(self, key: str, default: Any = _NO_VALUE) -> tuple[float, ...]:
        """A list of finite numbers."""
        value = self._get_value(key, default)
        if not isinstance(value, list | tuple) or not value:
            value_text = "empty" if value == [] else _format_value(value)
            raise self.error_at(
                key, f"'{key}' of {self.title} is {value_text}, give a list such as [0, 1]"
            )
        return tuple(self._read_number(key, item) for item in value)

    def rows(self, key: str, default: Any = _NO_VALUE) -> list[list[float]]:
        """A list of finite numbers, or of such lists: one row, or as many."""
        value = self._get_value(key, default)
        nested = isinstance(value, list | tuple) and any(isinstance(x, list) for x in value)
        rows = value if nested else [value]
        if not all(isinstance(row, list | tuple) and row for row in rows):
            hint = "give a list such as [0, 0, 1], or one of such lists"
            raise self.error_at(key, f"'{key}' of {self.title} is {_format_value(value)}, {hint}")
        return [[self._read_number(key, item) for item in row] for row in rows]

    def _read_list(self, key: str, hint: str) -> list[Any]:
        value = self._get_value(key, _NO_VALUE)
        if not isinstance(value, list):
            raise self.error_at(
                key, f"'{key}' of {self.title} is {_format_value(value)}, give {hint}"
            )
        return value

    def names(self, key: str) -> tuple[str, ...]:
        """A list of different names."""
        value = self._read_list(key, "a list such as [q1, q2]")
        for item in value:
            if not isinstance(item, str) or not item:
                raise self.error_at(
                    key, f"'{key}' lists {_format_value(item)}, which is not a name, quote it"
                )
            if value.count(item) > 1:
                raise self.error_at(key, f"'{key}' lists '{item}' twice, list it once")
        return tuple(value)

    def texts(self, key: str) -> tuple[str, ...]:
        """A list of texts, the same ones perhaps several times."""
        value = self._read_list(key, "a list such as [a, b]")
        for item in value:
            if not isinstance(item, str) or not item.isprintable():
                raise self.error_at(
                    key, f"'{key}' lists {_format_value(item)}, which is no text, quote it"
                )
        return tuple(value)

    def pairs(self, key: str) -> list[tuple[str, str]]:
        """A list of pairs of names."""
        value = self._read_list(key, "a list of pairs [[a, b]]")
        for item in value:
            if not (isinstance(item, list) and len(item) == 2):
                raise self.error_at(
                    key, f"'{key}' lists {_format_value(item)}, write pairs as [a, b]"
                )
            invalid = [x for x in item if not isinstance(x, str) or not x.isprintable()]
            if invalid:
                problem = (
                    f"'{key}' lists {_format_value(invalid[0])}, which is not a name, quote it"
                )
                raise self.error_at(key, problem)
        return [(one, two) for one, two in value]

    def file(self, key: str) -> Path:
        """A file, named by its path from the folder of the file that names it."""
        text = self.text(key)
        path = self._data.locations.get(key, self._location)[0].parent / text
        try:
            if path.is_dir():
                raise self.error_at(key, f"'{text}' of {self.title} is a folder, give a file")
            found = path.is_file()
        except OSError:  # a name longer than any file's
            found = False
        if not found:
            raise self.error_at(
                key, f"{self.title}: there is no file '{text}', give its path from this folder"
            )
        return path.resolve()

    def section(self, key: str, title: str) -> "YamlSection | None":
        """A mapping, or None where the key is absent."""
        value = self._get_value(key, None)
        if value is None:
            return None
        if not isinstance(value, _LocatedMapping):
            raise self.error_at(
                key, f"{title} is {_format_value(value)}, give a mapping 'name: value'"
            )
        return YamlSection(value, title, self._data.locations[key])

    def mappings(self, key: str, title: str, *keys: str) -> "Iterator[tuple[str, YamlSection]]":
        """Names and mappings of a mapping of mappings with these keys."""
        outer_section = None
        with error_recovery():
            outer_section = self.section(key, f"'{key}'")
        for name in outer_section._data if outer_section is not None else ():
            assert outer_section is not None
            inner_section = None
            with error_recovery():
                inner_section = outer_section._nonempty_section(name, f"{title} '{name}'", keys)
            if inner_section is not None:
                inner_section.check_keys(*keys)
                yield name, inner_section

    def apply_common_item(self, key: str, names: Iterable[str]) -> None:
        """Let what the item `all` of a mapping of mappings says hold for each of some names.

        What an item says itself stands; one that is not there is made.
        """
        mapping = self._data.get(key)
        if not isinstance(mapping, _LocatedMapping) or not isinstance(
            mapping.get(ALL_ITEM), _LocatedMapping
        ):
            return
        common_item, location = mapping.pop(ALL_ITEM), mapping.locations.pop(ALL_ITEM)
        for name in names:
            item = mapping.get(name, _LocatedMapping(*location))
            if isinstance(item, _LocatedMapping):
                for item_key in common_item:
                    if item_key not in item:
                        item.copy_key(common_item, item_key)
                mapping[name], mapping.locations[name] = (
                    item,
                    mapping.locations.get(name, location),
                )

    def item_names(self, key: str) -> tuple[str, ...]:
        """Names in a mapping, none where there is none."""
        mapping = self._data.get(key)
        return (
            tuple(name for name in mapping if name != ALL_ITEM)
            if isinstance(mapping, _LocatedMapping)
            else ()
        )

    def known_item_names(self, key: str) -> tuple[str, ...]:
        """Names in a mapping of mappings, whatever they are where that or an item is refused."""
        mapping = self._data.get(key)
        if mapping is None:
            return ()
        names = self.item_names(key)
        is_valid = isinstance(mapping, _LocatedMapping) and all(
            isinstance(mapping[x], _LocatedMapping) for x in names
        )
        return names if is_valid else UnknownNames()

    def _nonempty_section(self, key: str, title: str, keys: Iterable[str]) -> "YamlSection":
        """A mapping that is not empty."""
        section = self.section(key, title)
        if section is None or not section._data:
            raise self.error_at(key, f"{title} is empty, its keys are {', '.join(keys)}")
        return section

    def sections(self, key: str, title: str, *keys: str) -> "Iterator[YamlSection]":
        """The mappings of a list, with these keys, any if none; none where it is absent."""
        value = self._get_value(key, None)
        if value is None:
            return
        if not isinstance(value, list):
            problem = f"'{key}' is {_format_value(value)}, give a list, its items with '- '"
            report_error(self.error_at(key, problem))
            self.is_complete = False
            return
        for item in value:
            if not isinstance(item, _LocatedMapping):
                problem = f"'{key}' lists {_format_value(item)}, write each item as {{key: value}}"
                report_error(self.error_at(key, problem))
                self.is_complete = False
                continue
            section = YamlSection(item, _item_title(title, item))
            if keys:
                section.check_keys(*keys)
            yield section

    def __iter__(self) -> Iterator[str]:
        return iter(self._data)


def _item_title(title: str, item: _LocatedMapping) -> str:
    """What errors call an item of a list: by its name, its joint or its two frames."""
    name = item.get("name", item.get("joint", item.get("between")))
    if isinstance(name, list) and all(isinstance(frame, str) for frame in name):
        return f"the {title.removesuffix(' of')} between {' and '.join(map(repr, name))}"
    return f"{title} '{name}'" if isinstance(name, str) else f"a {title}"
