"""Models of SDF within each other: the names in each, and what `<include>` brings into it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from crane.common.errors import DescriptionError, known
from crane.common.packages import find_file
from crane.formats.sdf.values import Item
from crane.formats.xml import XmlFile

_DEEP = 20  # models within each other
_MANY = 2000  # models in all

Note = Callable[[str, str], None]  # what is left out, and its name


@dataclass
class Scope:
    """A model, or the world, with what has a name in it.

    Attributes:
        item: Its element; of an included model that in its own file.
        prefix: Before the names of its links in the whole machine.
        above: The scope that it is in.
        version: Of the file it is written in.
        links: By name.
        joints: By name.
        frames: By name.
        models: By name.
        include: The element that brought it here.
    """

    item: Item
    prefix: str
    above: "Scope | None"
    version: tuple[int, int]
    links: dict[str, Item] = field(default_factory=dict)
    joints: dict[str, Item] = field(default_factory=dict)
    frames: dict[str, Item] = field(default_factory=dict)
    models: dict[str, "Scope"] = field(default_factory=dict)
    include: Item | None = None

    @property
    def name(self) -> str:
        """Its name in the scope above."""
        given = "" if self.include is None else self.include.text("name")
        return given or self.item.name

    @property
    def is_static(self) -> bool:
        """Whether nothing in it moves."""
        if self.include is not None and self.include.only("static") is not None:
            return self.include.is_true("static")
        return self.item.is_true("static")

    @property
    def placed(self) -> Item:
        """What says where it is: the `<include>` if that has a pose."""
        if self.include is not None and self.include.only("pose") is not None:
            return self.include
        return self.item

    @property
    def placement_frame(self) -> str:
        """The frame of it that its pose places, empty for its own."""
        placed = self.placed
        if placed is self.include and (given := placed.text("placement_frame")):
            return given
        return str(self.item.element.get("placement_frame", "")).strip()

    def names(self) -> list[str]:
        """All that has a name in it."""
        return [*self.links, *self.joints, *self.frames, *self.models]

    def every(self) -> list["Scope"]:
        """It and all models within."""
        return [self, *(inner for model in self.models.values() for inner in model.every())]

    @property
    def can_move(self) -> bool:
        """Whether it has a joint that is not fixed."""
        return not self.is_static and any(
            joint.element.get("type") != "fixed"
            for scope in self.every() for joint in scope.joints.values()
        )  # fmt: skip


class Reader:
    """Reads models, with the files that they include.

    Args:
        xml: The file to begin with.
        note: Takes what is left out.
    """

    def __init__(self, xml: XmlFile, note: Note):
        self.xml, self._note = xml, note
        self._files: dict[Path, XmlFile] = {}
        self._count = 0

    def world(self) -> Scope:
        """All models of the file, those of its only world or those beside it.

        Raises:
            DescriptionError: There is no model, or several worlds.
        """
        root = self.xml.root
        version = version_of(self.xml)
        worlds = root.findall("world")
        if len(worlds) > 1:
            raise self.xml.fail(worlds[1], f"{len(worlds)} worlds in one file, keep one")
        top = worlds[0] if worlds else root
        scope = Scope(Item(self.xml, top, "the world"), "", None, version)
        self._fill(scope, scope.item, 0)
        if not scope.models:
            raise self.xml.fail(root, "no <model> in this file that is there, add one")
        return scope

    def _fill(self, scope: Scope, item: Item, depth: int) -> None:
        """Put what an element holds into a scope."""
        within = {"link": scope.links, "joint": scope.joints, "frame": scope.frames}
        for child in item.element:
            tag = child.tag
            if tag in within:
                part = Item(item.xml, child, f"{tag} '{child.get('name', '')}'", item.base)
                self._add(scope, part, within[tag])
            elif tag == "model":
                inner = Item(item.xml, child, f"model '{child.get('name', '')}'", item.base)
                self._nest(scope, inner, None, scope.version, depth)
            elif tag == "include":
                self._include(scope, Item(item.xml, child, "an include", item.base), depth)

    def _add(self, scope: Scope, part: Item, kind: dict[str, Item]) -> None:
        name = part.name
        if not name:
            raise part.xml.fail(part.element, f'a {part.element.tag} has no name, add name="..."')
        if name in kind:
            raise part.xml.fail(
                part.element,
                f"{part.what} is there twice (first in {kind[name].where}), rename one",
            )
        kind[name] = part

    def _nest(
        self, above: Scope, item: Item, include: Item | None, version: tuple[int, int], depth: int
    ) -> None:
        self._count += 1
        if depth > _DEEP or self._count > _MANY:
            raise item.xml.fail(item.element, "models include each other without end, break it")
        scope = Scope(item, "", above, version, include=include)
        name = scope.name
        if not name:
            raise item.xml.fail(item.element, 'a model has no name, add name="..."')
        if name in above.models:
            place = (include or item).where
            raise DescriptionError(f"{place}: model '{name}' is there twice, rename one")
        scope.prefix = f"{above.prefix}{name}::" if above.above is not None else ""
        above.models[name] = scope
        self._fill(scope, Item(item.xml, item.element, item.what), depth + 1)

    def _include(self, scope: Scope, include: Item, depth: int) -> None:
        """A model of another file, in a world perhaps one that is not there."""
        uri = include.text("uri")
        file = self._find(uri, include)
        if file is None:
            if scope.above is None:
                self._note("models that are not found", uri)
                return
            raise include.xml.fail(
                include.element,
                f"there is no model '{uri}', say where it is: --packages FOLDER, packages=[...] "
                "in Python",
            )
        xml = self._opened(file)
        models = xml.root.findall("model")
        if len(models) != 1:
            if scope.above is None and (xml.root.find("light") is not None):
                return
            raise include.xml.fail(
                include.element, f"'{uri}' has {len(models)} models, include a file with one"
            )
        item = Item(xml, models[0], f"model '{models[0].get('name', '')}'", include.base)
        if include.element.get("merge", "").lower() in ("true", "1"):
            self._merge(scope, item, include, depth)
            return
        self._nest(scope, item, include, version_of(xml), depth)

    def _merge(self, scope: Scope, item: Item, include: Item, depth: int) -> None:
        """The parts of a model as parts of the one that includes it, with a frame of their own."""
        if depth > _DEEP:
            raise item.xml.fail(item.element, "models include each other without end, break it")
        name = f"_merged__{include.text('name') or item.name}__model__"
        inner = Scope(item, scope.prefix, scope, version_of(item.xml), include=include)
        self._fill(inner, Item(item.xml, item.element, item.what, name), depth + 1)
        scope.frames[name] = MergedFrame.of(inner)
        for here, there in (
            (scope.links, inner.links), (scope.joints, inner.joints), (scope.frames, inner.frames),
        ):  # fmt: skip
            for key, part in there.items():
                if key in here:
                    raise DescriptionError(
                        f"{include.where}: merging brings a second '{key}', rename one"
                    )
                here[key] = part
        scope.models |= inner.models

    def _find(self, uri: str, include: Item) -> Path | None:
        """The SDF that a URI names: a file, or one in the folder of a model."""
        found = find_file(uri, include.xml.file.parent) if uri else None
        if found is None or found.is_file():
            return found
        listed = _listed(found)
        return listed if listed is not None and listed.is_file() else None

    def _opened(self, file: Path) -> XmlFile:
        file = file.resolve()
        if file not in self._files:
            self._files[file] = xml = XmlFile(file)
            if xml.root.tag != "sdf":
                raise xml.fail(
                    xml.root, f"an SDF starts with <sdf>, this file with <{xml.root.tag}>"
                )
        return self._files[file]


@dataclass(frozen=True)
class MergedFrame(Item):
    """The frame of a model whose parts were merged into another."""

    frame_of: Scope | None = None

    @classmethod
    def of(cls, scope: Scope) -> "MergedFrame":
        """The frame of a model."""
        placed = scope.placed
        base = scope.include.base if scope.include is not None else "__model__"
        return cls(placed.xml, placed.element, placed.what, base, scope)


def _listed(folder: Path) -> Path | None:
    """The newest file that a model.config lists, else model.sdf."""
    config = folder / "model.config"
    if not config.is_file():
        return folder / "model.sdf"
    versions = {}
    for element in XmlFile(config).root.iterfind("sdf"):
        if name := (element.text or "").strip():
            versions[_version(element.get("version", ""))] = folder / name
    there = {version: file for version, file in versions.items() if file.is_file()}
    return there[max(there)] if there else folder / "model.sdf"


def version_of(xml: XmlFile) -> tuple[int, int]:
    """The version of SDF that a file is written in."""
    return _version(xml.root.get("version", ""))


def _version(text: str) -> tuple[int, int]:
    major, _, minor = text.strip().partition(".")
    try:
        return int(major), int(minor.partition(".")[0])
    except ValueError:
        return 1, 6


def lookup(scope: Scope, name: str, asker: Item) -> tuple[Scope, str]:
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
            return lookup(scope.models[first], rest, asker)
    if len(parts) > 1 and parts[0] == scope.name and not scope.prefix:  # as some write it
        return lookup(scope, "::".join(parts[1:]), asker)
    raise asker.xml.fail(
        asker.element,
        f"{asker.what} names '{name}', which is unknown, {known(scope.names(), name)}",
    )
