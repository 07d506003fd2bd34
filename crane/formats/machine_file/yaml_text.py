"""The text of a machine file, with notes beside its numbers."""

from collections.abc import Mapping
from typing import Any

import yaml

from crane.common.errors import format_one_line

KeyPath = tuple[str | int, ...]  # keys and indices down to a number


class _BlockMapping(dict[str, Any]):
    """A mapping of which each number has a line of its own."""


class _MachineFileDumper(yaml.SafeDumper):
    """Innermost mappings and lists in a line, but for `_BlockMapping`."""


def _represent_block_mapping(dumper: _MachineFileDumper, data: _BlockMapping) -> yaml.Node:
    return dumper.represent_mapping("tag:yaml.org,2002:map", data.items(), flow_style=False)


_MachineFileDumper.add_representer(_BlockMapping, _represent_block_mapping)


def format_yaml(data: Mapping[str, Any], notes: Mapping[KeyPath, str] | None = None) -> str:
    """The text of a machine file.

    A number with a note stands in a line of its own, at whose end the note is a comment.

    Args:
        data: What it says.
        notes: By the way to a number.
    """
    notes = notes or {}
    block_data = _with_block_mappings(dict(data), (), {way[:-1] for way in notes})
    text = str(
        yaml.dump(
            block_data, Dumper=_MachineFileDumper, sort_keys=False, allow_unicode=True, width=100,
            default_flow_style=None,
        )
    )  # fmt: skip
    if not notes:
        return text
    lines, top = text.split("\n"), yaml.compose(text, yaml.SafeLoader)
    assert top is not None, "it was just written"
    for key_path, note in notes.items():
        node: Any = top
        for key in key_path:
            if isinstance(key, int):
                node = node.value[key]
            else:
                node = next(value for name, value in node.value if name.value == key)
        lines[node.end_mark.line] += f"  # {format_one_line(note)}"
    return "\n".join(lines)


def _with_block_mappings(item: Any, key_path: KeyPath, block_paths: set[KeyPath]) -> Any:
    """The same with `_BlockMapping` where numbers with notes are."""
    if isinstance(item, dict):
        found = {
            key: _with_block_mappings(value, (*key_path, key), block_paths)
            for key, value in item.items()
        }
        return _BlockMapping(found) if key_path in block_paths else found
    if isinstance(item, list):
        return [
            _with_block_mappings(value, (*key_path, i), block_paths)
            for i, value in enumerate(item)
        ]
    return item
