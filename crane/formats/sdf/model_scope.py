"""Elements of SDF, nested models with the names in each, and included files."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import DescriptionError, suggest_names
from crane.common.package_search import find_file
from crane.description.pinocchio_conversion import rotation_from_rpy
from crane.description.specification import unit_vector
from crane.formats.xml_file import XmlFile

_QUATERNION = "quat_xyzw"
_MAX_DEPTH = 20  # of nested models
_MAX_MODELS = 2000

NoteFunction = Callable[[str, str], None]  # arguments: unsupported feature, name


@dataclass(frozen=True)
class SdfElement:
    """An element of SDF in its file.

    Attributes:
        xml: The file.
        element: The element.
        label: Name of the element in errors.
        base_frame: The frame that its poses are relative to by default.
        merged_model: The model if it is the frame of one whose parts were merged into another.
    """

    xml: XmlFile
    element: etree._Element
    label: str
    base_frame: str = "__model__"
    merged_model: "ModelScope | None" = None

    @property
    def source_location(self) -> str:
        """File and line."""
        return self.xml.source_location(self.element)

    @property
    def name(self) -> str:
        """Its name, "" without one."""
        return self.attribute("name")

    def attribute(self, key: str) -> str:
        """Return an attribute without surrounding blanks, "" if there is none."""
        return str(self.element.get(key, "")).strip()

    def error(self, problem: str) -> DescriptionError:
        """Return an error with the source location of the element."""
        return self.xml.error_at(self.element, problem)

    def wrap(self, element: etree._Element, label: str) -> "SdfElement":
        """Return another element of the same file with the same base frame."""
        return SdfElement(self.xml, element, label, self.base_frame)

    def single_child(self, tag: str) -> "SdfElement | None":
        """Return the child with a tag, None if there is none.

        Raises:
            DescriptionError: There are several.
        """
        child = self.xml.single_child(self.element, tag, self.label)
        return None if child is None else self.wrap(child, self.label)

    def text(self, tag: str, default: str = "") -> str:
        """Return the text of a child."""
        child = self.single_child(tag)
        return default if child is None else (child.element.text or "").strip() or default

    def numbers(self, tag: str, count: int, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return the numbers in the text of a child.

        Args:
            tag: Tag of the child.
            count: How many numbers there have to be.
            default: Result without a child or text.

        Raises:
            DescriptionError: The text is something else.
        """
        child = self.single_child(tag)
        if child is None or not (child.element.text or "").strip():
            return default
        return child.parse_numbers(count, f"<{tag}>")

    def number(self, tag: str, default: float) -> float:
        """Return the number in the text of a child, which may be `inf`; see `numbers`."""
        text = self.text(tag).lower()
        if text.lstrip("+-") in ("inf", "infinity"):
            return -math.inf if text.startswith("-") else math.inf
        return self.numbers(tag, 1, (default,))[0]

    def parse_numbers(self, count: int, description: str) -> tuple[float, ...]:
        """Return the numbers in the text of this element."""
        return self.xml.parse_numbers(
            self.element, self.element.text or "", f"{description} of {self.label}", count
        )

    def direction(self, tag: str) -> np.ndarray:
        """Return the unit vector (3,) of a child, z without one.

        Raises:
            DescriptionError: It is zero or malformed.
        """
        unit = unit_vector(self.numbers(tag, 3, (0.0, 0.0, 1.0)))
        if unit is None:
            raise self.error(f"the axis of {self.label} is zero, give a direction")
        return np.array(unit)

    def read_pose(self) -> tuple[pin.SE3, str]:
        """Return the pose, and the frame that it is relative to, "" for the default."""
        child = self.single_child("pose")
        if child is None:
            return pin.SE3.Identity(), ""
        attributes = child.element.attrib
        relative_frame = attributes.get("relative_to", attributes.get("frame", "")).strip()
        if not (child.element.text or "").strip():
            return pin.SE3.Identity(), relative_frame
        if attributes.get("rotation_format") == _QUATERNION:
            *xyz, qx, qy, qz, qw = child.parse_numbers(7, "<pose>")
            length = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
            if length == 0:
                raise child.error(f"the pose of {self.label} has no rotation")
            quaternion = pin.Quaternion(qw / length, qx / length, qy / length, qz / length)
            return pin.SE3(quaternion.toRotationMatrix(), np.array(xyz)), relative_frame
        *xyz, roll, pitch, yaw = child.parse_numbers(6, "<pose>")
        if attributes.get("degrees", "").lower() in ("true", "1"):
            roll, pitch, yaw = (math.radians(angle) for angle in (roll, pitch, yaw))
        return pin.SE3(rotation_from_rpy((roll, pitch, yaw)), np.array(xyz)), relative_frame


@dataclass
class ModelScope:
    """A model, or the world, with the names that it defines.

    Attributes:
        item: Its element; for an included model the element in the included file.
        prefix: Prefix of the names of its links in the whole machine.
        parent: The scope that contains it.
        links: Links by name.
        joints: Joints by name.
        frames: Frames by name.
        models: Nested models by name.
        include_element: The `<include>` of an included model.
    """

    item: SdfElement
    prefix: str
    parent: "ModelScope | None"
    links: dict[str, SdfElement] = field(default_factory=dict)
    joints: dict[str, SdfElement] = field(default_factory=dict)
    frames: dict[str, SdfElement] = field(default_factory=dict)
    models: dict[str, "ModelScope"] = field(default_factory=dict)
    include_element: SdfElement | None = None

    @property
    def name(self) -> str:
        """Its name in the parent scope."""
        given = "" if self.include_element is None else self.include_element.text("name")
        return given or self.item.name

    @property
    def is_static(self) -> bool:
        """Whether all of it is fixed to the world."""
        return self._element_with("static").text("static").lower() in ("true", "1")

    @property
    def pose_element(self) -> SdfElement:
        """The element with its pose: the `<include>` if that has one."""
        return self._element_with("pose")

    def _element_with(self, tag: str) -> SdfElement:
        """Return the `<include>` if that has a child with a tag, else the model."""
        include = self.include_element
        return self.item if include is None or include.single_child(tag) is None else include

    @property
    def placement_frame(self) -> str:
        """The frame of the model that its pose places, "" for its own frame."""
        placed = self.pose_element
        if placed is self.include_element and (given := placed.text("placement_frame")):
            return given
        return self.item.attribute("placement_frame")

    def names(self) -> list[str]:
        """Return all names that it defines."""
        return [*self.links, *self.joints, *self.frames, *self.models]

    def nested_scopes(self) -> list["ModelScope"]:
        """Return this scope and those of all nested models."""
        return [
            self,
            *(inner for model in self.models.values() for inner in model.nested_scopes()),
        ]


class ModelReader:
    """Reads models and the files that they include.

    Args:
        xml: The main file.
        note: Receives unsupported features.
    """

    def __init__(self, xml: XmlFile, note: NoteFunction):
        self.xml, self._note_unsupported = xml, note
        self._files: dict[Path, XmlFile] = {}
        self._model_count = 0

    def read_world(self) -> ModelScope:
        """Return the scope of all models of the file, in its world or outside.

        Raises:
            DescriptionError: There is no model, or there are several worlds.
        """
        root = self.xml.root
        worlds = root.findall("world")
        if len(worlds) > 1:
            raise self.xml.error_at(worlds[1], f"{len(worlds)} worlds in one file, keep one")
        top = SdfElement(self.xml, worlds[0] if worlds else root, "the world")
        scope = ModelScope(top, "", None)
        self._read_children(scope, scope.item, 0)
        if not scope.models:
            raise self.xml.error_at(
                root, "there is no <model> in this file, or none that is found: add one"
            )
        return scope

    def _read_children(self, scope: ModelScope, item: SdfElement, depth: int) -> None:
        self._model_count += 1
        if depth > _MAX_DEPTH or self._model_count > _MAX_MODELS:
            raise item.error("models include each other without end, break it")
        parts_by_tag = {"link": scope.links, "joint": scope.joints, "frame": scope.frames}
        for child in item.element:
            tag = child.tag
            part = item.wrap(child, f"{tag} '{child.get('name', '')}'")
            if tag == "model":
                self._add_model(scope, part, None, depth)
            if tag == "include":
                self._read_include(scope, item.wrap(child, "an include"), depth)
            if tag not in parts_by_tag:
                continue
            if not part.name:
                raise part.error(f'a {tag} has no name, add name="..."')
            if (first := parts_by_tag[tag].setdefault(part.name, part)) is not part:
                raise part.error(
                    f"{part.label} is there twice (first in {first.source_location}), rename one"
                )

    def _add_model(
        self,
        parent_scope: ModelScope,
        item: SdfElement,
        include: SdfElement | None,
        depth: int,
    ) -> None:
        scope = ModelScope(item, "", parent_scope, include_element=include)
        name = scope.name
        if not name:
            raise item.error('a model has no name, add name="..."')
        if name in parent_scope.models:
            raise (include or item).error(f"model '{name}' is there twice, rename one")
        scope.prefix = f"{parent_scope.prefix}{name}::" if parent_scope.parent is not None else ""
        parent_scope.models[name] = scope
        self._read_children(scope, SdfElement(item.xml, item.element, item.label), depth + 1)

    def _read_include(self, scope: ModelScope, include: SdfElement, depth: int) -> None:
        """Add a model of another file; a missing model of a world is noted."""
        uri = include.text("uri")
        file = find_file(uri, include.xml.file.parent) if uri else None
        if file is not None and not file.is_file():
            file = _file_from_config(file)
        if file is None or not file.is_file():
            if scope.parent is None:
                self._note_unsupported("models that are not found", uri)
                return
            raise include.error(
                f"there is no model '{uri}', say where it is: --packages FOLDER, packages=[...] "
                "in Python",
            )
        file = file.resolve()
        if file not in self._files:
            self._files[file] = XmlFile(file)
        xml = self._files[file]
        if xml.root.tag != "sdf":
            raise xml.error_at(
                xml.root, f"an SDF starts with <sdf>, this file with <{xml.root.tag}>"
            )
        models = xml.root.findall("model")
        if len(models) != 1:
            if scope.parent is None and (xml.root.find("light") is not None):
                return
            raise include.error(f"'{uri}' has {len(models)} models, include a file with one")
        item = SdfElement(
            xml, models[0], f"model '{models[0].get('name', '')}'", include.base_frame
        )
        if include.element.get("merge", "").lower() in ("true", "1"):
            self._merge_model(scope, item, include, depth)
            return
        self._add_model(scope, item, include, depth)

    def _merge_model(
        self, scope: ModelScope, item: SdfElement, include: SdfElement, depth: int
    ) -> None:
        """Add the parts of a model to the including model, with a frame for its pose."""
        name = f"_merged__{include.text('name') or item.name}__model__"
        inner = ModelScope(item, scope.prefix, scope, include_element=include)
        self._read_children(inner, SdfElement(item.xml, item.element, item.label, name), depth + 1)
        placed = inner.pose_element
        scope.frames[name] = SdfElement(
            placed.xml, placed.element, placed.label, include.base_frame, inner
        )
        for own_parts, parts in (
            (scope.links, inner.links), (scope.joints, inner.joints), (scope.frames, inner.frames),
        ):  # fmt: skip
            for key, part in parts.items():
                if own_parts.setdefault(key, part) is not part:
                    raise include.error(f"merging brings a second '{key}', rename one")
        scope.models |= inner.models


def _file_from_config(folder: Path) -> Path:
    """Return the file of the newest version in model.config, else model.sdf."""
    config, existing = folder / "model.config", {}
    for element in XmlFile(config).root.iterfind("sdf") if config.is_file() else ():
        file = folder / (element.text or "").strip()
        if file.is_file():
            existing[sdf_version(element)] = file
    return existing[max(existing)] if existing else folder / "model.sdf"


def sdf_version(element: etree._Element) -> tuple[int, int]:
    """Return the SDF version that an element names, by default 1.6."""
    major, _, minor = element.get("version", "").strip().partition(".")
    try:
        return int(major), int(minor.partition(".")[0])
    except ValueError:
        return 1, 6


def find_scope(scope: ModelScope, name: str, referrer: SdfElement) -> tuple[ModelScope, str]:
    """Find the scope that defines a name with `::`.

    Args:
        scope: The scope in which the name is used.
        name: The name.
        referrer: The element that uses the name, for errors.

    Returns:
        The scope, and the name in it.

    Raises:
        DescriptionError: It is unknown.
    """
    if name in scope.names() or name == "__model__":
        return scope, name
    parts = name.split("::")
    for cut in range(len(parts) - 1, 0, -1):
        first, rest = "::".join(parts[:cut]), "::".join(parts[cut:])
        if first in scope.models:
            return find_scope(scope.models[first], rest, referrer)
    if len(parts) > 1 and parts[0] == scope.name and not scope.prefix:  # some files do so
        return find_scope(scope, "::".join(parts[1:]), referrer)
    raise referrer.error(
        f"{referrer.label} names '{name}', which is unknown, {suggest_names(scope.names(), name)}",
    )
