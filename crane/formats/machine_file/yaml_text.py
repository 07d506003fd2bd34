"""YAML of machine files: parsed into mappings that know their lines, and written with notes."""

import errno
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import yaml

from crane.common.errors import DescriptionError, format_one_line
from crane.common.package_search import read_plain_file
from crane.common.unit_conversions import NUMBER_PATTERN, KeyPath, WrittenNumber, is_quantity
from crane.description.findings import report_error

MAX_FILE_SIZE = 2_000_000  # bytes of a file; parsing ten million takes a minute


def format_yaml(
    data: Mapping[str, Any],
    notes: Mapping[KeyPath, str],
    written_numbers: Mapping[KeyPath, WrittenNumber],
) -> str:
    """The text of a machine file.

    A number with a note stands in a line of its own, at whose end the note is a comment.

    Args:
        data: What it says, numbers in SI units.
        notes: By the way to a number; in SI units.
        written_numbers: Numbers whose units are kept, see `written_numbers_by_path`.
    """
    in_units = with_written_units(dict(data), written_numbers)
    plain: Any = data
    layout: Any = {"allow_unicode": True, "width": 100}
    text = str(yaml.safe_dump(in_units, sort_keys=False, default_flow_style=None, **layout))
    if not notes:
        return text
    top = yaml.compose(text, yaml.SafeLoader)
    for key_path in notes:
        _node_at(top, key_path[:-1]).flow_style = False
    text = str(yaml.serialize(top, **layout))
    lines, top = text.split("\n"), yaml.compose(text, yaml.SafeLoader)
    for key_path, note in notes.items():
        node, value = _node_at(top, key_path), reduce(getitem, key_path, plain)
        in_si = f"{value:.6g} in SI units, " if is_quantity(node.value) else ""
        lines[node.end_mark.line] += f"  # {in_si}{format_one_line(note)}"
    return "\n".join(lines)


def _node_at(node: Any, key_path: KeyPath) -> Any:
    for key in key_path:
        node = (
            node.value[key]
            if isinstance(key, int)
            else next(value for name, value in node.value if name.value == key)
        )
    return node


class LocatedMapping(dict[str, Any]):
    """A mapping that remembers file and line of each key, and its numbers as they are written."""

    def __init__(self, file: Path, line: int):
        super().__init__()
        self.file, self.line = file, line
        self.locations: dict[str, tuple[Path, int]] = {}
        self.written_numbers: dict[KeyPath, WrittenNumber] = {}

    def copy_key(self, source: "LocatedMapping", key: str) -> None:
        """Take over the value of a key, and where it stands."""
        self[key], self.locations[key] = source[key], source.locations[key]

    def update_from_variant(self, variant: "LocatedMapping") -> None:
        """Put a variant's keys over these: mappings key by key, all else whole, empty ones off."""
        for key, value in variant.items():
            if isinstance(value, LocatedMapping) and isinstance(self.get(key), LocatedMapping):
                self[key].update_from_variant(value)
                self.locations[key] = variant.locations[key]
                continue
            if value is None:
                self.pop(key, None)
            else:
                self.copy_key(variant, key)
        self.file, self.line = variant.file, variant.line


def written_numbers_by_path(
    data: LocatedMapping, path: KeyPath = ()
) -> dict[KeyPath, WrittenNumber]:
    """The numbers that were read of a machine file, as written, by the ways to them."""
    found = {(*path, *place): quantity for place, quantity in data.written_numbers.items()}
    for key, value in data.items():
        if isinstance(value, LocatedMapping):
            found |= written_numbers_by_path(value, (*path, key))
        items = value if isinstance(value, list) else []
        for label, item in zip(_item_labels(items), items, strict=True):
            if isinstance(item, LocatedMapping):
                found |= written_numbers_by_path(item, (*path, key, label))
    return found


def with_written_units(
    data: Any, written_numbers: Mapping[KeyPath, WrittenNumber], path: KeyPath = ()
) -> Any:
    """The same with numbers in the units in which a machine file had them, to the last bit.

    Args:
        data: What a machine file says.
        written_numbers: As `written_numbers_by_path` returns them.
        path: The way to the data.
    """
    if isinstance(data, dict):
        return {
            key: with_written_units(value, written_numbers, (*path, key))
            for key, value in data.items()
        }
    if isinstance(data, list):
        return [
            with_written_units(value, written_numbers, (*path, label))
            for label, value in zip(_item_labels(data), data, strict=True)
        ]
    is_number = isinstance(data, int | float) and not isinstance(data, bool)
    return written_numbers[path].write(data) if is_number and path in written_numbers else data


def _item_labels(items: list[Any]) -> list[str | int]:
    """What tells the items of a list apart where some are gone: names, else their numbers."""
    labels: list[str | int] = []
    for i, item in enumerate(items):
        names = item if isinstance(item, dict) else {}
        key = next((x for x in ("name", "joint", "between", "frame") if names.get(x)), None)
        label = i if key is None else f"{names[key]}"
        labels.append(i if label in labels else label)
    return labels


class _StrictConstructor(yaml.constructor.SafeConstructor):
    """SafeConstructor with lines, and without silently taking the last of equal keys.

    Numbers are those of YAML 1.2: 3:1 is no number in base 60, 012 is none in base 8.
    """

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """A value; what cannot be one (a 13th month, 0x without digits) is an error of YAML."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, KeyError, AttributeError, TypeError, OverflowError):
            raise yaml.constructor.ConstructorError(
                None,
                None,
                f"'{node.value}' is no value of its kind, quote it if it is text",
                node.start_mark,
            ) from None


class _StrictLoader(_StrictConstructor, yaml.SafeLoader):
    """Reads text, and says best what is wrong with it."""


_LOADERS: list[Any] = [_StrictLoader]
if yaml.__with_libyaml__:

    class _FastLoader(_StrictConstructor, yaml.CSafeLoader):
        """Reads text in a tenth of the time."""

    _LOADERS.append(_FastLoader)


def _construct_mapping(loader: Any, node: yaml.MappingNode) -> LocatedMapping:
    file = Path(loader.name)
    data = LocatedMapping(file, node.start_mark.line + 1)
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        where = f"{file.name}:{line}"
        if key_node.tag == "tag:yaml.org,2002:merge":
            report_error(DescriptionError(f"{where}: '<<' is not supported, write the keys out"))
            continue
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            hint = (
                ", and decimals with a point"
                if (isinstance(key, int) and not isinstance(key, bool))
                else ""
            )
            problem = f"key {format_value(key)} is not a name, write names in quotes{hint}"
            report_error(DescriptionError(f"{where}: {problem}"))
            continue
        if key in data:
            problem = f"is there twice (first in line {data.locations[key][1]}), keep one"
            report_error(DescriptionError(f"{where}: key '{key}' {problem}"))
            continue
        data[key] = loader.construct_object(value_node, deep=True)
        data.locations[key] = file, line
    return data


_StrictConstructor.add_constructor("tag:yaml.org,2002:map", _construct_mapping)
_StrictConstructor.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))
_FLOAT_PATTERN = rf"{NUMBER_PATTERN}|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
for _loader in _LOADERS:
    _loader.yaml_implicit_resolvers = {
        first: [x for x in resolvers if x[0].rpartition(":")[2] not in ("int", "float")]
        for first, resolvers in _loader.yaml_implicit_resolvers.items()
    }
    for _kind, _pattern in (("int", "[-+]?[0-9]+"), ("float", _FLOAT_PATTERN)):
        _loader.add_implicit_resolver(
            f"tag:yaml.org,2002:{_kind}", re.compile(rf"(?:{_pattern})\Z"), list("-+.0123456789")
        )


def format_value(value: Any) -> str:
    """A value in an error: short, whatever it is."""
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list | tuple | set):
        return "a list"
    if isinstance(value, bool):
        return f"{value} (in YAML, yes, no, on and off mean true and false)"
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) < 60 else f"{text[:60]}..."


def _compose(text: str) -> tuple[Any, yaml.Node | None]:
    """What is in a text, and the loader that constructs it."""
    if yaml.__with_libyaml__ and "\t" not in text:  # which PyYAML refuses in more places
        with suppress(yaml.YAMLError):
            fast_loader = _FastLoader(text)
            return fast_loader, fast_loader.get_single_node()
    loader = _StrictLoader(text)
    return loader, loader.get_single_node()


def parse_yaml_file(file: Path) -> LocatedMapping:
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
        raise DescriptionError(f"{file.name}{line}: not YAML, {problem}, correct it") from None
    except RecursionError:
        raise DescriptionError(f"{file.name}: nested too deep, simplify it") from None
    if data is None:
        raise DescriptionError(f"{file.name}: the file is empty, write a machine in it")
    if not isinstance(data, LocatedMapping):
        raise DescriptionError(f"{file.name}: not a machine file, write keys such as 'name:'")
    return data
