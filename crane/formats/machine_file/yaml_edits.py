"""Changes of values in the text of a machine file, whose other text stays unchanged."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import yaml

from crane.common.errors import OutputError
from crane.common.unit_conversions import KeyPath

TextEdit = tuple[int, int, str]  # start, end, new text
_SHARING_TOKENS = yaml.AnchorToken, yaml.AliasToken


def apply_edits(text: str, edits: Iterable[TextEdit]) -> str:
    """Return a text after edits that do not overlap."""
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


def edit_yaml(
    text: str, changes: Mapping[str, Any], new_names: Mapping[KeyPath, str] | None = None
) -> str:
    """Return the text of a machine file after changes; comments and other values stay as written.

    Args:
        text: Of a mapping.
        changes: New values by key. A mapping changes the mapping that is there, None removes a
            key, and other values replace what is there or are added at the end.
        new_names: New names of keys, by the paths to them; `changes` has the old names.

    Raises:
        OutputError: A mapping to be changed shares values with others by anchors (&, *).
    """
    top: Any = yaml.compose(text, yaml.SafeLoader)
    shared = [x.start_mark.index for x in yaml.scan(text) if isinstance(x, _SHARING_TOKENS)]
    for key, value in top.value:
        span = range(key.start_mark.index, value.end_mark.index)
        if key.value in changes and any(x in span for x in shared):
            raise OutputError(
                f"'{key.value}' shares values with other keys (&, *), write its values out first"
            )
    return apply_edits(text, _YamlEditor(text, new_names or {}).mapping_edits(top, changes, ()))


class _YamlEditor:
    """Finds the edits of a text."""

    def __init__(self, text: str, new_names: Mapping[KeyPath, str]):
        self._text, self._new_names = text, new_names
        self._line_break = "\r\n" if "\r\n" in text else "\n"

    def mapping_edits(
        self, node: Any, changes: Mapping[str, Any], path: KeyPath
    ) -> Iterator[TextEdit]:
        """Yield the edits of a mapping."""
        kept = False
        for i, (key, value) in enumerate(node.value):
            change, inner_path = changes.get(key.value, self), (*path, key.value)
            if inner_path in self._new_names:
                new_name = flow_text(self._new_names[inner_path])
                yield key.start_mark.index, key.end_mark.index, new_name
            if change is None:
                yield self._removal(node, i, kept)
                continue
            kept = True
            if isinstance(change, Mapping) and isinstance(value, yaml.MappingNode):
                yield from self.mapping_edits(value, change, inner_path)
            elif change is not self:
                start = self._text.index(":", key.end_mark.index) + 1
                column = None if node.flow_style else key.start_mark.column
                yield start, self._end(value), self._value_text(change, len(path), column)
        present = {key.value for key, _ in node.value}
        if added := {x: y for x, y in changes.items() if x not in present and y is not None}:
            yield self._addition(node, added, len(path), kept)

    def _removal(self, node: Any, i: int, has_items: bool) -> TextEdit:
        key, value = node.value[i]
        if not node.flow_style:
            start = self._text.rfind("\n", 0, key.start_mark.index) + 1
            return start, self._line_end(value), ""
        if has_items:
            return self._end(node.value[i - 1][1]), self._end(value), ""
        is_last = i + 1 == len(node.value)
        end = node.end_mark.index - 1 if is_last else node.value[i + 1][0].start_mark.index
        return key.start_mark.index, end, ""

    def _addition(self, node: Any, added: Any, depth: int, has_items: bool) -> TextEdit:
        if node.flow_style:
            end = self._end(node.value[-1][1]) if has_items else node.end_mark.index - 1
            return end, end, ", " * has_items + flow_text(added)[1:-1]
        end = self._line_end(node) if depth else node.end_mark.index
        lines = self._lines(added, depth, node.start_mark.column) + self._line_break
        return end, end, lines.removeprefix(self._line_break * (self._text[end - 1] == "\n"))

    def _lines(self, items: Mapping[str, Any], depth: int, column: int) -> str:
        return "".join(
            f"{self._line_break}{' ' * column}{flow_text(name)}:"
            f"{self._value_text(value, depth, column)}"
            for name, value in items.items()
        )

    def _value_text(self, value: Any, depth: int, column: int | None) -> str:
        """Return a value behind its colon: sections and their items have lines of their own."""
        is_section = isinstance(value, Mapping) and bool(value) and depth < 2
        if is_section and depth:
            is_section = all(isinstance(x, Mapping | list) for x in value.values())
        if is_section and column is not None:
            return self._lines(value, depth + 1, column + 2)
        return f" {flow_text(value)}"

    def _end(self, node: Any) -> int:
        """Return the end of a node, without comments that follow it."""
        while isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
            node = node.value[-1][1] if isinstance(node, yaml.MappingNode) else node.value[-1]
        return int(node.end_mark.index)

    def _line_end(self, node: Any) -> int:
        return (self._text.find("\n", self._end(node)) + 1) or len(self._text)


def flow_text(value: Any) -> str:
    """Return a value as YAML in one line."""
    layout: Any = {"default_flow_style": True, "width": 10**6, "allow_unicode": True}
    return str(yaml.safe_dump([value], sort_keys=False, **layout)).strip()[1:-1]
