"""The text of a machine file, with notes beside its numbers."""

from collections.abc import Mapping
from typing import Any

import yaml

from crane.common.errors import one_line

Way = tuple[str | int, ...]  # keys and indices down to a number


class _Lines(dict[str, Any]):
    """A mapping of which each number has a line of its own."""


class _Dumper(yaml.SafeDumper):
    """Innermost mappings and lists in a line, but for `_Lines`."""


def _in_lines(dumper: _Dumper, data: _Lines) -> yaml.Node:
    return dumper.represent_mapping("tag:yaml.org,2002:map", data.items(), flow_style=False)


_Dumper.add_representer(_Lines, _in_lines)


def yaml_text(data: Mapping[str, Any], notes: Mapping[Way, str] | None = None) -> str:
    """The text of a machine file.

    A number with a note stands in a line of its own, at whose end the note is a comment.

    Args:
        data: What it says.
        notes: By the way to a number.
    """
    notes = notes or {}
    whole = _with_lines(dict(data), (), {way[:-1] for way in notes})
    text = str(
        yaml.dump(
            whole, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100,
            default_flow_style=None,
        )
    )  # fmt: skip
    if not notes:
        return text
    lines, top = text.split("\n"), yaml.compose(text, yaml.SafeLoader)
    assert top is not None, "it was just written"
    for way, note in notes.items():
        lines[_node(top, way).end_mark.line] += f"  # {one_line(note)}"
    return "\n".join(lines)


def _with_lines(item: Any, way: Way, parents: set[Way]) -> Any:
    """The same with `_Lines` where numbers with notes are."""
    if isinstance(item, dict):
        found = {key: _with_lines(value, (*way, key), parents) for key, value in item.items()}
        return _Lines(found) if way in parents else found
    if isinstance(item, list):
        return [_with_lines(value, (*way, i), parents) for i, value in enumerate(item)]
    return item


def _node(top: yaml.Node, way: Way) -> yaml.Node:
    for key in way:
        if isinstance(key, int):
            top = top.value[key]
        else:
            top = next(value for name, value in top.value if name.value == key)
    return top
