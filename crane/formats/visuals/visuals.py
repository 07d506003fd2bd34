"""What URDFs draw: the shapes of visuals and collisions, read in one place.

A shape that cannot be drawn is no reason to refuse a machine: it is told and left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import DescriptionError
from crane.common.samples import Array
from crane.description.findings import aside
from crane.formats.visuals.meshes import Part, mesh_file, read_meshes
from crane.formats.xml import XmlFile

Colour = tuple[float, float, float, float]

PLAIN: Colour = (0.62, 0.64, 0.67, 1.0)  # where a URDF names no colour
_SHAPES = ("box", "cylinder", "sphere", "capsule", "mesh")
_FARTHEST = 1e6  # [m], beyond which nothing is drawn
_LONG = 100  # characters of a name that are shown


@dataclass(frozen=True)
class Box:
    """Box about the origin, edges (3,) [m]."""

    size: tuple[float, float, float]


@dataclass(frozen=True)
class Cylinder:
    """Cylinder about the origin along z [m]."""

    radius: float
    length: float


@dataclass(frozen=True)
class Sphere:
    """Sphere about the origin [m]."""

    radius: float


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices (V, 3) [m], faces (F, 3)."""

    vertices: Array
    faces: np.ndarray


Shape = Box | Cylinder | Sphere | Mesh


@dataclass(frozen=True)
class Visual:
    """One coloured shape on a link.

    Attributes:
        link: Name of the link.
        shape: What is drawn.
        placement: (4, 4) pose of the shape in the link's frame.
        colour: Red, green, blue, opacity, 0 to 1.
        mesh: Name of the mesh that the shape is a part of, with file and line before it; "" for
            other shapes.
    """

    link: str
    shape: Shape
    placement: Array
    colour: Colour
    mesh: str = ""

    def corners(self) -> Array:
        """(8, 3) corners, in the link's frame, of a box that encloses the shape."""
        match self.shape:
            case Box(size):
                high = np.array(size) / 2
            case Cylinder(radius, length):
                high = np.array([radius, radius, length / 2])
            case Sphere(radius):
                high = np.full(3, radius)
            case Mesh(vertices):
                high = vertices.max(axis=0)
        low = self.shape.vertices.min(axis=0) if isinstance(self.shape, Mesh) else -high
        corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(8, 3)
        return corners @ self.placement[:3, :3].T + self.placement[:3, 3]


@dataclass(frozen=True)
class Drawn:
    """What a URDF draws.

    Attributes:
        shapes: Of each tag that was asked for.
        missing: Names of the meshes whose files are not there, each with its place, file and line.
        problems: What else cannot be drawn as it is, with file and line, what becomes of it, and
            what to do.
    """

    shapes: Mapping[str, Sequence[Visual]]
    missing: Mapping[str, str]
    problems: Sequence[str]


@dataclass(frozen=True)
class _MeshShape:
    """A mesh that is to be read: its scale (3,) and file."""

    name: str
    scale: tuple[float, ...]
    file: Path | None


def read_drawn(
    xml: XmlFile, tags: Sequence[str] = ("visual",), instead: Box | None = None
) -> Drawn:
    """The shapes in a URDF that can be drawn.

    Args:
        xml: The file.
        tags: Of elements in links that have shapes, visual and collision.
        instead: Is drawn in the place of a mesh that cannot be read; None to leave it out.
    """
    reader = _Reader(xml)
    shapes = {tag: reader.read(tag) for tag in tags}
    meshes = read_meshes(
        drawn.shape.file
        for found in shapes.values()
        for drawn in found
        if isinstance(drawn.shape, _MeshShape) and drawn.shape.file is not None
    )
    return Drawn(
        {
            tag: [visual for drawn in found for visual in reader.visuals(drawn, meshes, instead)]
            for tag, found in shapes.items()
        },
        reader.missing,
        tuple(dict.fromkeys(reader.problems)),
    )


@dataclass(frozen=True)
class _Drawn:
    """A shape where it stands, before its mesh is read."""

    link: str
    shape: Shape | _MeshShape
    placement: Array
    colour: Colour | None
    where: str


class _Reader:
    """Reads a file, and remembers what is wrong with it."""

    def __init__(self, xml: XmlFile):
        self.xml = xml
        self.missing: dict[str, str] = {}
        self._damaged: dict[str, str] = {}
        self.problems: list[str] = []
        with aside():
            self._colours = {
                material.get("name", "").strip(): colour
                for material in reversed(list(xml.root.iter("material")))  # the first one counts
                if (colour := self._colour(material)) is not None
            }
        self.problems.clear()  # which are told where they are used

    def read(self, tag: str) -> list[_Drawn]:
        """Shapes of elements with a tag."""
        found: list[_Drawn] = []
        for element in self.xml.root.iterfind(f"link/{tag}"):
            link = element.getparent().get("name", "").strip()
            try:
                found += self._drawn(element, link, f"a {tag} of link '{link}'")
            except DescriptionError as error:
                self.problems.append(f"{error}; it is not drawn")
        return found

    @aside()
    def _drawn(self, element: etree._Element, link: str, what: str) -> list[_Drawn]:
        xyz, rpy = self.xml.placement(element, what)
        self._check_near(element, what, xyz)
        placement = _placement(xyz, rpy)
        material = self.xml.only(element, "material", what)
        colour = None
        if material is not None:
            colour = self._colour(material) or self._colours.get(material.get("name", "").strip())
        geometry = self.xml.only(element, "geometry", what)
        shapes = [] if geometry is None else [x for x in geometry if isinstance(x.tag, str)]
        if len(shapes) != 1 or shapes[0].tag not in _SHAPES:
            has = ", ".join(f"<{shape.tag}>" for shape in shapes[:4]) or "no shape"
            listed = ", ".join(f"<{shape}>" for shape in _SHAPES)
            raise self.xml.fail(element, f"{what} has {has}, give one of {listed}")
        where = self.xml.where(shapes[0])
        return [
            _Drawn(link, shape, placement @ offset, colour, where)
            for shape, offset in self._shapes(shapes[0], what)
        ]

    def _shapes(self, shape: etree._Element, what: str) -> list[tuple[Shape | _MeshShape, Array]]:
        """A shape, each part with its pose (4, 4) in it."""
        here = np.eye(4)
        if shape.tag == "mesh":
            name = shape.get("filename", "")
            if not name:
                raise self.xml.fail(shape, f'{what} names no mesh, add filename="..."')
            scale = self.xml.vector(shape, "scale", what, 3, (1.0, 1.0, 1.0))
            folder = self.xml.file.parent
            return [(_MeshShape(name, scale, mesh_file(name, folder)), here)]
        if shape.tag == "box":
            x, y, z = self._sizes(shape, "size", what, 3)
            return [(Box((x, y, z)), here)]
        (radius,) = self._sizes(shape, "radius", what, 1)
        if shape.tag == "sphere":
            return [(Sphere(radius), here)]
        (length,) = self._sizes(shape, "length", what, 1)
        parts: list[tuple[Shape | _MeshShape, Array]] = [(Cylinder(radius, length), here)]
        if shape.tag == "capsule":  # whose length is that between the centres of its balls
            for end in (-length / 2, length / 2):
                parts.append((Sphere(radius), _placement((0.0, 0.0, end))))
        return parts

    def _sizes(self, shape: etree._Element, key: str, what: str, count: int) -> tuple[float, ...]:
        sizes = self.xml.vector(shape, key, what, count)
        if min(sizes) <= 0:
            given = f'{key}="{shape.get(key)}"'
            raise self.xml.fail(shape, f"{given} of {what} is not positive, give metres")
        self._check_near(shape, what, sizes)
        return sizes

    def _check_near(self, element: etree._Element, what: str, lengths: Sequence[float]) -> None:
        far = max(lengths, key=abs)
        if abs(far) > _FARTHEST:
            raise self.xml.fail(element, f"{what} has a length of {far:g} m, give metres")

    def _colour(self, material: etree._Element) -> Colour | None:
        """The colour of a material, if it has one that is one."""
        colour = material.find("color")
        if colour is None:
            return None
        try:
            shares = self.xml.vector(colour, "rgba", "a colour", 4)
            if not 0 <= min(shares) <= max(shares) <= 1:
                given = f'rgba="{colour.get("rgba")}"'
                raise self.xml.fail(
                    colour, f"{given} of a colour is not within 0 to 1, correct it"
                )
        except DescriptionError as error:
            self.problems.append(f"{error}; grey is drawn")
            return None
        red, green, blue, opacity = shares
        return red, green, blue, opacity

    def visuals(
        self, drawn: _Drawn, meshes: Mapping[Path, tuple[Part, ...] | str], instead: Box | None
    ) -> list[Visual]:
        """A shape with what its mesh holds, if it is one."""
        shape = drawn.shape
        if not isinstance(shape, _MeshShape):
            return [Visual(drawn.link, shape, drawn.placement, drawn.colour or PLAIN)]
        shown = shape.name if len(shape.name) < _LONG else f"...{shape.name[-_LONG:]}"
        place = f"{drawn.where}: mesh '{shown}'"
        parts = () if shape.file is None else meshes[shape.file]
        if shape.file is None:
            self.missing.setdefault(shown, drawn.where)
        elif isinstance(parts, str):
            first = self._damaged.setdefault(shown, drawn.where)
            self.problems.append(
                f"{first}: mesh file '{shown}' cannot be read ({parts}), export it again; a box "
                "is drawn instead"
            )
        elif any(_reach(part, shape.scale) > _FARTHEST for part in parts):
            self.problems.append(f"{place} is far larger than a machine, scale it; a box is drawn "
                                 "instead")  # fmt: skip
        else:
            return [
                Visual(
                    drawn.link,
                    Mesh(part.vertices * shape.scale, part.faces),
                    drawn.placement,
                    drawn.colour or part.colour or PLAIN,
                    place,
                )
                for part in parts
            ]
        if instead is None:
            return []
        return [Visual(drawn.link, instead, drawn.placement, drawn.colour or PLAIN)]


def _reach(part: Part, scale: tuple[float, ...]) -> float:
    with np.errstate(over="ignore"):
        return float(np.abs(part.vertices * scale).max())


def _placement(xyz: Sequence[float], rpy: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
    """(4, 4) pose; angles about the fixed axes x, y, z."""
    return np.asarray(pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(xyz)).homogeneous)
