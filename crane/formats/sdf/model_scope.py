"""Models of SDF within each other: the names in each, and what `<include>` brings into it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from crane.common.errors import DescriptionError, suggest_names
from crane.common.package_search import find_file
from crane.formats.sdf.sdf_element import SdfElement
from crane.formats.xml_file import XmlFile

_MAX_DEPTH = 20  # models within each other
_MAX_MODELS = 2000  # models in all

NoteFunction = Callable[[str, str], None]  # what is left out, and its name


@dataclass
class ModelScope:
    """A model, or the world, with what has a name in it.

    Attributes:
        item: Its element; of an included model that in its own file.
        prefix: Before the names of its links in the whole machine.
        parent: The scope that it is in.
        version: Of the file it is written in.
        links: By name.
        joints: By name.
        frames: By name.
        models: By name.
        include_element: The element that brought it here.
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
        """Its name in the scope above."""
        given = "" if self.include_element is None else self.include_element.text("name")
        return given or self.item.name

    @property
    def is_static(self) -> bool:
        """Whether nothing in it moves."""
        if (
            self.include_element is not None
            and self.include_element.single_child("static") is not None
        ):
            return self.include_element.is_true("static")
        return self.item.is_true("static")

    @property
    def pose_element(self) -> SdfElement:
        """What says where it is: the `<include>` if that has a pose."""
        if (
            self.include_element is not None
            and self.include_element.single_child("pose") is not None
        ):
            return self.include_element
        return self.item

    @property
    def placement_frame(self) -> str:
        """The frame of it that its pose places, empty for its own."""
        placed = self.pose_element
        if placed is self.include_element and (given := placed.text("placement_frame")):
            return given
        return str(self.item.element.get("placement_frame", "")).strip()

    def names(self) -> list[str]:
        """All that has a name in it."""
        return [*self.links, *self.joints, *self.frames, *self.models]

    def nested_scopes(self) -> list["ModelScope"]:
        """It and all models within."""
        return [
            self,
            *(inner for model in self.models.values() for inner in model.nested_scopes()),
        ]

    @property
    def can_move(self) -> bool:
        """Whether it has a joint that is not fixed."""
        return not self.is_static and any(
            joint.element.get("type") != "fixed"
            for scope in self.nested_scopes() for joint in scope.joints.values()
        )  # fmt: skip


class ModelReader:
    """Reads models, with the files that they include.

    Args:
        xml: The file to begin with.
        note: Takes what is left out.
    """

    def __init__(self, xml: XmlFile, note: NoteFunction):
        self.xml, self._note_unsupported = xml, note
        self._files: dict[Path, XmlFile] = {}
        self._model_count = 0

    def read_world(self) -> ModelScope:
        """All models of the file, those of its only world or those beside it.

        Raises:
            DescriptionError: There is no model, or several worlds.
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
        """Put what an element holds into a scope."""
        parts_by_tag = {"link": scope.links, "joint": scope.joints, "frame": scope.frames}
        for child in item.element:
            tag = child.tag
            if tag in parts_by_tag:
                part = SdfElement(
                    item.xml, child, f"{tag} '{child.get('name', '')}'", item.base_frame
                )
                self._add_part(scope, part, parts_by_tag[tag])
            elif tag == "model":
                inner = SdfElement(
                    item.xml, child, f"model '{child.get('name', '')}'", item.base_frame
                )
                self._add_model(scope, inner, None, scope.version, depth)
            elif tag == "include":
                self._read_include(
                    scope, SdfElement(item.xml, child, "an include", item.base_frame), depth
                )

    def _add_part(
        self, scope: ModelScope, part: SdfElement, same_kind: dict[str, SdfElement]
    ) -> None:
        name = part.name
        if not name:
            raise part.xml.error_at(
                part.element, f'a {part.element.tag} has no name, add name="..."'
            )
        if name in same_kind:
            raise part.xml.error_at(
                part.element,
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
            raise item.xml.error_at(
                item.element, "models include each other without end, break it"
            )
        scope = ModelScope(item, "", parent_scope, version, include_element=include)
        name = scope.name
        if not name:
            raise item.xml.error_at(item.element, 'a model has no name, add name="..."')
        if name in parent_scope.models:
            location = (include or item).source_location
            raise DescriptionError(f"{location}: model '{name}' is there twice, rename one")
        scope.prefix = f"{parent_scope.prefix}{name}::" if parent_scope.parent is not None else ""
        parent_scope.models[name] = scope
        self._read_children(scope, SdfElement(item.xml, item.element, item.label), depth + 1)

    def _read_include(self, scope: ModelScope, include: SdfElement, depth: int) -> None:
        """A model of another file, in a world perhaps one that is not there."""
        uri = include.text("uri")
        file = self._find_model_file(uri, include)
        if file is None:
            if scope.parent is None:
                self._note_unsupported("models that are not found", uri)
                return
            raise include.xml.error_at(
                include.element,
                f"there is no model '{uri}', say where it is: --packages FOLDER, packages=[...] "
                "in Python",
            )
        xml = self._open_file(file)
        models = xml.root.findall("model")
        if len(models) != 1:
            if scope.parent is None and (xml.root.find("light") is not None):
                return
            raise include.xml.error_at(
                include.element, f"'{uri}' has {len(models)} models, include a file with one"
            )
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
        """The parts of a model as parts of the one that includes it, with a frame of their own."""
        if depth > _MAX_DEPTH:
            raise item.xml.error_at(
                item.element, "models include each other without end, break it"
            )
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
        """The SDF that a URI names: a file, or one in the folder of a model."""
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
    """The frame of a model whose parts were merged into another."""

    merged_model: ModelScope | None = None

    @classmethod
    def from_scope(cls, scope: ModelScope) -> "MergedFrame":
        """The frame of a model."""
        placed = scope.pose_element
        base = (
            scope.include_element.base_frame if scope.include_element is not None else "__model__"
        )
        return cls(placed.xml, placed.element, placed.label, base, scope)


def _file_from_config(folder: Path) -> Path | None:
    """The newest file that a model.config lists, else model.sdf."""
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
    """The version of SDF that a file is written in."""
    return _parse_version(xml.root.get("version", ""))


def _parse_version(text: str) -> tuple[int, int]:
    major, _, minor = text.strip().partition(".")
    try:
        return int(major), int(minor.partition(".")[0])
    except ValueError:
        return 1, 6


def find_scope(scope: ModelScope, name: str, referrer: SdfElement) -> tuple[ModelScope, str]:
    """The scope in which a name with `::` is, and the rest of it.

    Raises:
        DescriptionError: It is unknown.
    """
    if name in scope.links or name in scope.joints or name in scope.frames:
        return scope, name
    if name in scope.models or name == "__model__":
        return scope, name
    parts = name.split("::")
    for cut in range(len(parts) - 1, 0, -1):
        first, rest = "::".join(parts[:cut]), "::".join(parts[cut:])
        if first in scope.models:
            return find_scope(scope.models[first], rest, referrer)
    if len(parts) > 1 and parts[0] == scope.name and not scope.prefix:  # as some write it
        return find_scope(scope, "::".join(parts[1:]), referrer)
    raise referrer.xml.error_at(
        referrer.element,
        f"{referrer.label} names '{name}', which is unknown, {suggest_names(scope.names(), name)}",
    )
