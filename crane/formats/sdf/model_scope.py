"""Nested models of SDF, the names in each, and included files."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from crane.common.errors import DescriptionError, suggest_names
from crane.common.package_search import find_file
from crane.formats.sdf.sdf_element import SdfElement
from crane.formats.xml_file import XmlFile

_MAX_DEPTH = 20  # of nested models
_MAX_MODELS = 2000

NoteFunction = Callable[[str, str], None]  # arguments: unsupported feature, name


@dataclass
class ModelScope:
    """A model, or the world, with the names that it defines.

    Attributes:
        item: Its element; for an included model the element in the included file.
        prefix: Prefix of the names of its links in the whole machine.
        parent: The scope that contains it.
        version: SDF version of its file.
        links: Links by name.
        joints: Joints by name.
        frames: Frames by name.
        models: Nested models by name.
        include_element: The `<include>` of an included model.
    """

    item: SdfElement
    prefix: str
    parent: "ModelScope | None"
    version: tuple[int, int]
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
        return self._element_with("static").is_true("static")

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

    @property
    def can_move(self) -> bool:
        """Whether it has a movable joint."""
        return not self.is_static and any(
            joint.element.get("type") != "fixed"
            for scope in self.nested_scopes() for joint in scope.joints.values()
        )  # fmt: skip


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
        version = sdf_version(self.xml)
        worlds = root.findall("world")
        if len(worlds) > 1:
            raise self.xml.error_at(worlds[1], f"{len(worlds)} worlds in one file, keep one")
        top = worlds[0] if worlds else root
        scope = ModelScope(SdfElement(self.xml, top, "the world"), "", None, version)
        self._read_children(scope, scope.item, 0)
        if not scope.models:
            raise self.xml.error_at(
                root, "there is no <model> in this file, or none that is found: add one"
            )
        return scope

    def _read_children(self, scope: ModelScope, item: SdfElement, depth: int) -> None:
        """Add the children of an element to a scope."""
        parts_by_tag = {"link": scope.links, "joint": scope.joints, "frame": scope.frames}
        for child in item.element:
            tag = child.tag
            part = item.wrap(child, f"{tag} '{child.get('name', '')}'")
            if tag in parts_by_tag:
                self._add_part(part, parts_by_tag[tag])
            elif tag == "model":
                self._add_model(scope, part, None, scope.version, depth)
            elif tag == "include":
                self._read_include(scope, item.wrap(child, "an include"), depth)

    def _add_part(self, part: SdfElement, same_kind: dict[str, SdfElement]) -> None:
        name = part.name
        if not name:
            raise part.error(f'a {part.element.tag} has no name, add name="..."')
        if name in same_kind:
            raise part.error(
                f"{part.label} is there twice (first in {same_kind[name].source_location}), "
                f"rename one",
            )
        same_kind[name] = part

    def _add_model(
        self,
        parent_scope: ModelScope,
        item: SdfElement,
        include: SdfElement | None,
        version: tuple[int, int],
        depth: int,
    ) -> None:
        self._model_count += 1
        if depth > _MAX_DEPTH or self._model_count > _MAX_MODELS:
            raise item.error("models include each other without end, break it")
        scope = ModelScope(item, "", parent_scope, version, include_element=include)
        name = scope.name
        if not name:
            raise item.error('a model has no name, add name="..."')
        if name in parent_scope.models:
            location = (include or item).source_location
            raise DescriptionError(f"{location}: model '{name}' is there twice, rename one")
        scope.prefix = f"{parent_scope.prefix}{name}::" if parent_scope.parent is not None else ""
        parent_scope.models[name] = scope
        self._read_children(scope, SdfElement(item.xml, item.element, item.label), depth + 1)

    def _read_include(self, scope: ModelScope, include: SdfElement, depth: int) -> None:
        """Add a model of another file; a missing model of a world is noted."""
        uri = include.text("uri")
        file = self._find_model_file(uri, include)
        if file is None:
            if scope.parent is None:
                self._note_unsupported("models that are not found", uri)
                return
            raise include.error(
                f"there is no model '{uri}', say where it is: --packages FOLDER, packages=[...] "
                "in Python",
            )
        xml = self._open_file(file)
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
        self._add_model(scope, item, include, sdf_version(xml), depth)

    def _merge_model(
        self, scope: ModelScope, item: SdfElement, include: SdfElement, depth: int
    ) -> None:
        """Add the parts of a model to the including model, with a frame for its pose."""
        if depth > _MAX_DEPTH:
            raise item.error("models include each other without end, break it")
        name = f"_merged__{include.text('name') or item.name}__model__"
        inner = ModelScope(
            item, scope.prefix, scope, sdf_version(item.xml), include_element=include
        )
        self._read_children(inner, SdfElement(item.xml, item.element, item.label, name), depth + 1)
        scope.frames[name] = MergedFrame.from_scope(inner)
        for own_parts, merged_parts in (
            (scope.links, inner.links), (scope.joints, inner.joints), (scope.frames, inner.frames),
        ):  # fmt: skip
            for key, part in merged_parts.items():
                if key in own_parts:
                    raise DescriptionError(
                        f"{include.source_location}: merging brings a second '{key}', rename one"
                    )
                own_parts[key] = part
        scope.models |= inner.models

    def _find_model_file(self, uri: str, include: SdfElement) -> Path | None:
        """Return the SDF file of a URI, which names a file or the folder of a model."""
        found = find_file(uri, include.xml.file.parent) if uri else None
        if found is None or found.is_file():
            return found
        model_file = _file_from_config(found)
        return model_file if model_file is not None and model_file.is_file() else None

    def _open_file(self, file: Path) -> XmlFile:
        file = file.resolve()
        if file not in self._files:
            self._files[file] = xml = XmlFile(file)
            if xml.root.tag != "sdf":
                raise xml.error_at(
                    xml.root, f"an SDF starts with <sdf>, this file with <{xml.root.tag}>"
                )
        return self._files[file]


@dataclass(frozen=True)
class MergedFrame(SdfElement):
    """The frame of a model whose parts were merged into another model."""

    merged_model: ModelScope | None = None

    @classmethod
    def from_scope(cls, scope: ModelScope) -> "MergedFrame":
        """Return the frame of a merged model."""
        placed = scope.pose_element
        base = (
            scope.include_element.base_frame if scope.include_element is not None else "__model__"
        )
        return cls(placed.xml, placed.element, placed.label, base, scope)


def _file_from_config(folder: Path) -> Path | None:
    """Return the file of the newest version in model.config, else model.sdf."""
    config = folder / "model.config"
    if not config.is_file():
        return folder / "model.sdf"
    versions = {}
    for element in XmlFile(config).root.iterfind("sdf"):
        if name := (element.text or "").strip():
            versions[_parse_version(element.get("version", ""))] = folder / name
    existing = {version: file for version, file in versions.items() if file.is_file()}
    return existing[max(existing)] if existing else folder / "model.sdf"


def sdf_version(xml: XmlFile) -> tuple[int, int]:
    """Return the SDF version of a file."""
    return _parse_version(xml.root.get("version", ""))


def _parse_version(text: str) -> tuple[int, int]:
    major, _, minor = text.strip().partition(".")
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
