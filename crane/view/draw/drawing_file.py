"""The machine file of a drawing: read for the page, and edited as the page asks."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from crane.common.atomic_output import replace_file
from crane.common.errors import OutputError
from crane.common.unit_conversions import KeyPath
from crane.description.machine_schema import MACHINE
from crane.formats.drawing.body_placement import read_point
from crane.formats.machine_file.yaml_edits import edit_yaml
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.machine_file.yaml_text import parse_yaml_file

ITEM_SECTIONS = ("points", "bodies", "pins", "cylinders", "slides")
NewNames = Mapping[str, Mapping[str, str]]  # by section the names in the file, by new names


class DrawingFile:
    """A machine file with a drawing.

    Args:
        path: The file to write.
        source: The file to read; None for a new drawing.

    Attributes:
        path: As given.
        data: What it has of a drawing: `name`, `tip` and `drawing`, with points in metres.

    Raises:
        DescriptionError: The file has no section `drawing`, or one that cannot be read.
    """

    def __init__(self, path: Path, source: Path | None = None):
        self.path, self._text = path, f"name: {path.stem}\n"
        self.data: dict[str, Any] = {"name": path.stem}
        if source is not None:
            self.data = read_drawing_data(source)
            self._text = source.read_bytes().decode("utf-8").lstrip("\ufeff")
        self._content = path.read_bytes() if path.exists() else None

    def write(self, data: Mapping[str, Any], new_names: NewNames) -> None:
        """Write a drawing; other sections, comments and unchanged values stay as written.

        Raises:
            OutputError: The file cannot be written, or was changed by another program.
        """
        if self._content != (self.path.read_bytes() if self.path.exists() else None):
            raise OutputError(
                f"{self.path}: another program has changed it, start crane draw again to read it"
            )
        old, drawing = self.data.get("drawing", {}), dict(data["drawing"])
        paths: dict[KeyPath, str] = {
            ("drawing", section, before): name
            for section, names in new_names.items()
            for name, before in names.items()
            if name in drawing.get(section, ()) and before in old.get(section, ())
        }
        for (_, section, before), name in list(paths.items()):
            items = {before if x == name else x: item for x, item in drawing[section].items()}
            drawing[section] = items
        text = edit_yaml(self._text, _differences(self.data, {**data, "drawing": drawing}), paths)
        with replace_file(self.path) as part:
            part.write_bytes(text.encode())
            if self.path.exists():
                shutil.copymode(self.path, part)
            if read_drawing_data(part) != data:
                raise OutputError(f"{self.path}: cannot be edited, write another file (--out)")
        self._text, self._content, self.data = text, text.encode(), dict(data)


def read_drawing_data(file: Path) -> dict[str, Any]:
    """Return what a machine file has of a drawing, see `DrawingFile`.

    Raises:
        DescriptionError: It has no section `drawing`, or a point, a body or the like is not read.
    """
    content = parse_yaml_file(file)
    top = YamlSection(content, MACHINE)
    section = top.section("drawing")
    if section is None:
        raise top.error_at(None, "has no section 'drawing', give a machine that is drawn by pins")
    drawing = {key: value for key, value in content["drawing"].items() if value is not None}
    for key in drawing.keys() & {*ITEM_SECTIONS[1:]}:
        drawing[key] = section.read_map(key, _item_values)
    drawing["points"] = section.value_map("points", _coordinates)
    # what JSON has no word for becomes text
    data = {key: content[key] for key in ("name", "tip") if key in content} | {"drawing": drawing}
    return dict(json.loads(json.dumps(data, default=str), parse_constant=str))


def _coordinates(points: YamlSection, name: str) -> list[float]:
    """Return x and z of a point, or x, y and z if it is off the plane [m]."""
    place: list[float] = read_point(points, name).tolist()
    return place if place[1] else place[::2]


def _item_values(_: str, item: YamlSection) -> dict[str, Any]:
    """Return the values of a body and the like, whose names are lists of texts."""
    if "points" in item and isinstance(item.raw_value("points"), dict):
        problem = "has coordinates of its own, which 'crane draw' cannot edit: list its points"
        raise item.error_at("points", f"{item.title} {problem} and give them to the drawing")
    names = {key: list(item.names(key)) for key in item if key in ("points", "bodies")}
    return {key: item.raw_value(key) for key in item} | names


def _differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return what has to be set in a nested mapping, with all mappings; None removes a key."""
    return {key: None for key in old if key not in new} | {
        key: _differences(old[key], value)
        if isinstance(value, dict) and isinstance(old.get(key), dict)
        else value
        for key, value in new.items()
        if isinstance(value, dict) or key not in old or old[key] != value
    }
