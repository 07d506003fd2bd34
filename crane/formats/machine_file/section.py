"""Strict reading of YAML: every key known, every value of its kind, every error with its line."""

import errno
import math
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any, overload

import yaml

from crane.common.errors import DescriptionError, known
from crane.common.inputs import content
from crane.description.findings import Anything, flag, recoverable
from crane.description.sources import bundled

ALL = "all"  # an item whose keys hold for all beside it
EXTENDS = "extends"  # the key that names the file a machine file is a variant of


class _Map(dict[str, Any]):
    """A mapping that remembers file and line of each key."""

    def __init__(self, file: Path, line: int):
        super().__init__()
        self.file, self.line = file, line
        self.places: dict[str, tuple[Path, int]] = {}

    def put(self, other: "_Map", key: str) -> None:
        """Take over the value of a key, and where it stands."""
        self[key], self.places[key] = other[key], other.places[key]

    def extended(self, own: "_Map") -> None:
        """Put a variant's keys over these: mappings key by key, all else whole, empty ones off."""
        for key, value in own.items():
            if isinstance(value, _Map) and isinstance(self.get(key), _Map):
                self[key].extended(value)
                self.places[key] = own.places[key]
            elif value is None:
                self.pop(key, None)
            else:
                self.put(own, key)
        self.file, self.line = own.file, own.line


class _Strict(yaml.constructor.SafeConstructor):
    """SafeConstructor with lines, and without silently taking the last of equal keys."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """A value; what cannot be one (a 13th month, 0x without digits) is an error of YAML."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, KeyError, AttributeError, TypeError, OverflowError):
            problem = f"'{node.value}' is no value of its kind, quote it if it is text"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None


class _Loader(_Strict, yaml.SafeLoader):
    """Reads text, and says best what is wrong with it."""


if yaml.__with_libyaml__:

    class _Fast(_Strict, yaml.CSafeLoader):
        """Reads text in a tenth of the time."""


def _construct_map(loader: Any, node: yaml.MappingNode) -> _Map:
    file = Path(loader.name)
    data = _Map(file, node.start_mark.line + 1)
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        where = f"{file.name}:{line}"
        if key_node.tag == "tag:yaml.org,2002:merge":
            flag(DescriptionError(f"{where}: '<<' is not supported, write the keys out"))
            continue
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            number = isinstance(key, int) and not isinstance(key, bool)
            hint = ", and decimals with a point" if number else ""
            problem = f"key {_shown(key)} is not a name, write names in quotes{hint}"
            flag(DescriptionError(f"{where}: {problem}"))
            continue
        if key in data:
            first = data.places[key][1]
            problem = f"key '{key}' is there twice (first in line {first}), keep one"
            flag(DescriptionError(f"{where}: {problem}"))
            continue
        data[key] = loader.construct_object(value_node, deep=True)
        data.places[key] = file, line
    return data


_Strict.add_constructor("tag:yaml.org,2002:map", _construct_map)

_MISSING: Any = object()
_TRUTHS = {"on": True, "yes": True, "true": True, "off": False, "no": False, "false": False}
LARGEST = 2_000_000  # bytes of a file; the reader takes a minute for ten million


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list) else value


def _shown(value: Any) -> str:
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


def as_truth(value: Any) -> bool | None:
    """What a value is as true or false, None where it is neither; YAML's words may be quoted."""
    if isinstance(value, str):
        return _TRUTHS.get(value.strip().lower())
    return value if isinstance(value, bool) else None


def _composed(text: str) -> tuple[Any, yaml.Node | None]:
    """What is in a text, and the loader that constructs it."""
    if yaml.__with_libyaml__ and "\t" not in text:  # which PyYAML refuses in more places
        with suppress(yaml.YAMLError):
            fast = _Fast(text)
            return fast, fast.get_single_node()
    loader = _Loader(text)
    return loader, loader.get_single_node()


def _parsed(file: Path) -> _Map:
    """The mapping in a YAML file.

    Raises:
        DescriptionError: The file is missing, not YAML, or no mapping.
    """
    try:
        loader, node = _composed(content(file, LARGEST).decode("utf-8"))
        loader.name = str(file)
        data = None if node is None else loader.construct_document(node)
    except UnicodeDecodeError:
        raise DescriptionError(f"{file.name}: not UTF-8, save it as UTF-8 text") from None
    except OSError as error:
        if error.errno == errno.EFBIG:
            what = f"{error.strerror}, which takes too long, shorten it"
            raise DescriptionError(f"{file.name}: {what}") from None
        raise DescriptionError(
            f"{file}: cannot be read ({error.strerror}), check the path"
        ) from None
    except yaml.reader.ReaderError as error:
        what = f"it holds the control character number {error.character}"
        raise DescriptionError(f"{file.name}: not YAML, {what}, remove it") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "broken"
        raise DescriptionError(f"{file.name}{line}: not YAML, {problem}, mend it") from None
    except RecursionError:
        raise DescriptionError(f"{file.name}: nested too deep, simplify it") from None
    if data is None:
        raise DescriptionError(f"{file.name}: the file is empty, write a machine in it")
    if not isinstance(data, _Map):
        raise DescriptionError(f"{file.name}: not a machine file, write keys such as 'name:'")
    return data


def _merged(file: Path, above: tuple[Path, ...]) -> _Map:
    """A machine file put over the one that it extends, which may extend another.

    Args:
        file: The machine file.
        above: The variants that led to it, resolved.
    """
    own = _parsed(file)
    if EXTENDS not in own:
        return own
    section = Section(own, "the machine file")
    named = section.text(EXTENDS)
    base = bundled().get(named) or section.file(EXTENDS)
    if base.suffix.lower() not in (".yaml", ".yml"):
        raise section.fail(EXTENDS, f"'{named}' is no machine file (.yaml), a variant needs one")
    above = (*above, file.resolve())
    if base in above:
        raise section.fail(EXTENDS, f"'{named}' is a variant of this file itself, extend another")
    del own[EXTENDS]
    data = _merged(base, above)
    data.extended(own)
    return data


class Section:
    """A mapping of a machine file.

    Args:
        data: The mapping.
        title: What it is, for errors ("loop 'A1_eye'").
        place: File and line, if not the mapping's own.

    Attributes:
        title: See above.
        complete: Whether no item of its lists had to be left out.
    """

    def __init__(self, data: _Map, title: str, place: tuple[Path, int] | None = None):
        self._data, self.title = data, title
        self.complete = True
        self._place = (data.file, data.line) if place is None else place

    @classmethod
    def read(cls, file: Path, keys: Collection[str]) -> "Section":
        """The top level of a YAML file, a variant put over what it extends.

        Raises:
            DescriptionError: A file is missing, not YAML, or not a mapping of these keys.
        """
        data = _merged(file, ()) if EXTENDS in keys else _parsed(file)
        section = cls(data, "the machine file")
        section.only(*keys)
        return section

    def plain(self) -> dict[str, Any]:
        """All keys and values, without places."""
        found: dict[str, Any] = _plain(self._data)
        return found

    def only(self, *keys: str) -> None:
        """Raise for any other key.

        Raises:
            DescriptionError: There is an unknown key; the nearest known one is named. Where
                findings are collected, what stands there is read as if it had that name.
        """
        for key in [key for key in self._data if key not in keys]:
            near = get_close_matches(key, keys, 1, 0.75)
            near = near or [known for known in keys if known.lower() == key.lower()]
            meant = bool(near) and near[0] not in self._data
            problem = f"unknown key '{key}' in {self.title}, {known(keys, key)}"
            flag(self.fail(key, problem), harmless=True)
            if meant:
                self._data[near[0]] = self._data[key]
                self._data.places[near[0]] = self._data.places[key]

    def where(self, key: str | None = None) -> str:
        """File and line of the section or of one of its keys."""
        file, line = self._data.places.get(key, self._place) if key else self._place
        return f"{file.name}:{line}"

    def fail(self, key: str | None, what: str) -> DescriptionError:
        """An error that points at a key."""
        return DescriptionError(f"{self.where(key)}: {what}")

    def _take(self, key: str, default: Any) -> Any:
        value = self._data.get(key, default)
        if value is _MISSING:
            raise self.fail(None, f"{self.title} has no '{key}', add it")
        if value is None and default is not None:
            raise self.fail(key, f"'{key}' of {self.title} is empty, give its value")
        return value

    def raw(self, key: str) -> Any:
        """A value, whatever it is.

        Raises:
            DescriptionError: There is none.
        """
        value = self._take(key, _MISSING)
        if value is None:
            raise self.fail(key, f"'{key}' of {self.title} is empty, give its value")
        return value

    @overload
    def text(self, key: str, default: str = ...) -> str: ...
    @overload
    def text(self, key: str, default: None) -> str | None: ...
    def text(self, key: str, default: str | None = _MISSING) -> str | None:
        """A non-empty string; empty where it has been noted as wrong."""
        try:
            return self._text(key, default)
        except DescriptionError as error:
            flag(error)
            return ""

    def _text(self, key: str, default: str | None) -> str | None:
        value = self._take(key, default)
        if value is default:
            return value
        if not isinstance(value, str) or not value.strip():
            raise self.fail(
                key, f"'{key}' of {self.title} is {_shown(value)}, give text (or quote it)"
            )
        if not "".join(value.split()).isprintable():
            raise self.fail(key, f"'{key}' of {self.title} holds control characters, remove them")
        return value

    def number(self, key: str, default: float = _MISSING, minimum: float = -math.inf) -> float:
        """A finite number, at least `minimum`; NaN where it has been noted as wrong."""
        try:
            number = self._number(key, self._take(key, default))
            if number < minimum:
                raise self.fail(
                    key, f"'{key}' of {self.title} is {number:g}, give at least {minimum:g}"
                )
            return number
        except DescriptionError as error:
            flag(error)
            return math.nan

    def _number(self, key: str, value: Any) -> float:
        number = as_float(value)
        if math.isfinite(number):
            return number
        hint = "give a number"
        if isinstance(value, float):
            hint = "give a finite number"
        elif isinstance(value, str) and "," in value:
            hint = "give a number with a decimal point"
        raise self.fail(key, f"'{key}' of {self.title} is {_shown(value)}, {hint}")

    def truth(self, key: str, default: bool) -> bool:
        """True or false, as on and off, in quotes or without."""
        value = as_truth(self.raw(key)) if key in self._data else default
        if value is None:
            shown = _shown(self._data[key])
            raise self.fail(key, f"'{key}' of {self.title} is {shown}, give true or false")
        return value

    def numbers(self, key: str, default: Any = _MISSING) -> tuple[float, ...]:
        """A list of finite numbers."""
        value = self._take(key, default)
        if not isinstance(value, list | tuple) or not value:
            shown = "empty" if value == [] else _shown(value)
            raise self.fail(key, f"'{key}' of {self.title} is {shown}, give a list such as [0, 1]")
        return tuple(self._number(key, item) for item in value)

    def rows(self, key: str, default: Any = _MISSING) -> list[list[float]]:
        """A list of finite numbers, or of such lists: one row, or as many."""
        value = self._take(key, default)
        nested = isinstance(value, list | tuple) and any(isinstance(x, list) for x in value)
        rows = value if nested else [value]
        if not all(isinstance(row, list | tuple) and row for row in rows):
            wanted = "give a list such as [0, 0, 1], or one of such lists"
            raise self.fail(key, f"'{key}' of {self.title} is {_shown(value)}, {wanted}")
        return [[self._number(key, item) for item in row] for row in rows]

    def _list(self, key: str, wanted: str) -> list[Any]:
        value = self._take(key, _MISSING)
        if not isinstance(value, list):
            raise self.fail(key, f"'{key}' of {self.title} is {_shown(value)}, give {wanted}")
        return value

    def names(self, key: str) -> tuple[str, ...]:
        """A list of different names."""
        value = self._list(key, "a list such as [q1, q2]")
        for item in value:
            if not isinstance(item, str) or not item:
                raise self.fail(
                    key, f"'{key}' lists {_shown(item)}, which is not a name, quote it"
                )
            if value.count(item) > 1:
                raise self.fail(key, f"'{key}' lists '{item}' twice, list it once")
        return tuple(value)

    def texts(self, key: str) -> tuple[str, ...]:
        """A list of texts, the same ones perhaps several times."""
        value = self._list(key, "a list such as [a, b]")
        for item in value:
            if not isinstance(item, str) or not item.isprintable():
                raise self.fail(key, f"'{key}' lists {_shown(item)}, which is no text, quote it")
        return tuple(value)

    def pairs(self, key: str) -> list[tuple[str, str]]:
        """A list of pairs of names."""
        value = self._list(key, "a list of pairs [[a, b]]")
        for item in value:
            if not (isinstance(item, list) and len(item) == 2):
                raise self.fail(key, f"'{key}' lists {_shown(item)}, write pairs as [a, b]")
            strange = [x for x in item if not isinstance(x, str) or not x.isprintable()]
            if strange:
                problem = f"'{key}' lists {_shown(strange[0])}, which is not a name, quote it"
                raise self.fail(key, problem)
        return [(one, two) for one, two in value]

    def file(self, key: str) -> Path:
        """A file, named by its path from the folder of the file that names it."""
        text = self.text(key)
        path = self._data.places.get(key, self._place)[0].parent / text
        try:
            if path.is_dir():
                raise self.fail(key, f"'{text}' of {self.title} is a folder, give a file")
            found = path.is_file()
        except OSError:  # a name longer than any file's
            found = False
        if not found:
            raise self.fail(
                key, f"{self.title}: there is no file '{text}', give its path from this folder"
            )
        return path.resolve()

    def section(self, key: str, title: str) -> "Section | None":
        """A mapping, or None where the key is absent."""
        value = self._take(key, None)
        if value is None:
            return None
        if not isinstance(value, _Map):
            raise self.fail(key, f"{title} is {_shown(value)}, give a mapping 'name: value'")
        return Section(value, title, self._data.places[key])

    def mappings(self, key: str, title: str, *keys: str) -> "Iterator[tuple[str, Section]]":
        """Names and mappings of a mapping of mappings with these keys."""
        outer = None
        with recoverable():
            outer = self.section(key, f"'{key}'")
        for name in outer._data if outer is not None else ():
            assert outer is not None
            inner = None
            with recoverable():
                inner = outer._filled(name, f"{title} '{name}'", keys)
            if inner is not None:
                inner.only(*keys)
                yield name, inner

    def spread(self, key: str, names: Iterable[str]) -> None:
        """Let what the item `all` of a mapping of mappings says hold for each of some names.

        What an item says itself stands; one that is not there is made.
        """
        outer = self._data.get(key)
        if not isinstance(outer, _Map) or not isinstance(outer.get(ALL), _Map):
            return
        common, place = outer.pop(ALL), outer.places.pop(ALL)
        for name in names:
            own = outer.get(name, _Map(*place))
            if isinstance(own, _Map):
                for word in common:
                    if word not in own:
                        own.put(common, word)
                outer[name], outer.places[name] = own, outer.places.get(name, place)

    def listed(self, key: str) -> tuple[str, ...]:
        """Names in a mapping, none where there is none."""
        outer = self._data.get(key)
        return tuple(name for name in outer if name != ALL) if isinstance(outer, _Map) else ()

    def judged(self, key: str) -> tuple[str, ...]:
        """Names in a mapping of mappings, whatever they are where that or an item is refused."""
        outer = self._data.get(key)
        if outer is None:
            return ()
        names = self.listed(key)
        right = isinstance(outer, _Map) and all(isinstance(outer[x], _Map) for x in names)
        return names if right else Anything()

    def _filled(self, key: str, title: str, keys: Iterable[str]) -> "Section":
        """A mapping that is not empty."""
        section = self.section(key, title)
        if section is None or not section._data:
            raise self.fail(key, f"{title} is empty, its keys are {', '.join(keys)}")
        return section

    def sections(self, key: str, title: str, *keys: str) -> "Iterator[Section]":
        """The mappings of a list, with these keys, any if none; none where it is absent."""
        value = self._take(key, None)
        if value is None:
            return
        if not isinstance(value, list):
            problem = f"'{key}' is {_shown(value)}, give a list, its items with '- '"
            flag(self.fail(key, problem))
            self.complete = False
            return
        for item in value:
            if not isinstance(item, _Map):
                problem = f"'{key}' lists {_shown(item)}, write each item as {{key: value}}"
                flag(self.fail(key, problem))
                self.complete = False
                continue
            section = Section(item, _titled(title, item))
            if keys:
                section.only(*keys)
            yield section

    def __iter__(self) -> Iterator[str]:
        return iter(self._data)


def _titled(title: str, item: _Map) -> str:
    """What errors call an item of a list: by its name, its joint or its two frames."""
    name = item.get("name", item.get("joint", item.get("between")))
    if isinstance(name, list) and all(isinstance(frame, str) for frame in name):
        return f"the {title.removesuffix(' of')} between {' and '.join(map(repr, name))}"
    return f"{title} '{name}'" if isinstance(name, str) else f"a {title}"
