"""Shapes of visuals and collisions of a URDF, and the mesh files that they name.

A shape that cannot be drawn is reported and left out; it is no reason to refuse a machine.
"""

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common import file_cache
from crane.common.errors import DescriptionError
from crane.common.package_search import find_file
from crane.common.samples import Array
from crane.description.findings import raise_errors
from crane.description.pinocchio_conversion import se3_from_xyz_rpy
from crane.formats.visuals import mesh_process
from crane.formats.xml_file import XmlFile

Colour = tuple[float, float, float, float]

DEFAULT_COLOUR: Colour = (0.62, 0.64, 0.67, 1.0)  # of shapes without a colour
_SHAPE_TAGS = ("box", "cylinder", "sphere", "capsule", "mesh")
_MAX_DISTANCE = 1e6  # [m] of a shape that is drawn
_MAX_NAME_LENGTH = 100  # characters shown
_MAX_FILE_SIZE = 200e6  # bytes
_MAX_CACHED_SIZE = 4 << 20  # bytes of a cached file, and of its answer
_MAX_ATTEMPTS = 3
_DAMAGE_ERRORS = ValueError, KeyError, TypeError, EOFError  # of an answer that is not complete
_TIMEOUT_PER_FILE = 10 * mesh_process.MAX_SECONDS  # [s], for systems without CPU limits


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles of one colour.

    Attributes:
        vertices: (V, 3) [units of the file].
        faces: (F, 3) indices of vertices.
        colour: Red, green, blue, opacity, 0 to 1; None if the file has none.
    """

    vertices: Array
    faces: np.ndarray
    colour: tuple[float, float, float, float] | None


def find_mesh_file(name: str, folder: Path) -> Path | None:
    """Return the file that a mesh is in, None if it does not exist.

    Args:
        name: As in `<mesh filename>`, see `find_file`.
        folder: Folder of the URDF.
    """
    found = find_file(name, folder)
    return found if found is not None and found.is_file() else None


def read_meshes(files: Iterable[Path]) -> dict[Path, tuple[MeshPart, ...] | str]:
    """Return the triangles of mesh files by path, or in a few words why a file cannot be read.

    Files may be damaged or declare sizes beyond all memory, so another process reads them, with 20
    s of computing and 2 GB for each file. If it crashes, it is restarted after the file that
    caused it, up to twice. Its results for small files are cached, because the process takes
    longer to start than to read the meshes of a robot.
    """
    found: dict[Path, tuple[MeshPart, ...] | str] = {}
    entry_names: dict[Path, str | None] = {}  # of the cache
    for file in dict.fromkeys(files):
        size = file.stat().st_size
        if size > _MAX_FILE_SIZE:
            found[file] = f"{size / 1e6:.0f} MB, more than {_MAX_FILE_SIZE / 1e6:.0f}"
            continue
        name = _cache_entry_name(file) if size <= _MAX_CACHED_SIZE else None
        cached = None if name is None else file_cache.read_entry(name)
        entry_names[file] = name
        if cached is not None:
            with suppress(*_DAMAGE_ERRORS):  # else it is read anew
                found[file], _ = _parse_answer(io.BytesIO(cached))
                del entry_names[file]
    for _ in range(_MAX_ATTEMPTS):
        remaining_triangles = mesh_process.MAX_TRIANGLES - sum(
            len(part.faces)
            for parts in found.values()
            if not isinstance(parts, str)
            for part in parts
        )
        answers = _run_mesh_process(list(entry_names), remaining_triangles) if entry_names else []
        for (file, name), answer in zip(list(entry_names.items()), answers, strict=False):
            found[file], is_self_contained = _parse_answer(io.BytesIO(answer))
            del entry_names[file]
            is_small = len(answer) <= _MAX_CACHED_SIZE
            if name and is_small and is_self_contained and name == _cache_entry_name(file):
                file_cache.write_entry(name, answer)
    return found | dict.fromkeys(
        entry_names, f"not tried after {_MAX_ATTEMPTS} that ended the reader"
    )


def _cache_entry_name(file: Path) -> str:
    """Return the cache entry of a file, by its content and by the versions of the reader."""
    builds = [file_cache.package_build(package) for package in ("trimesh", "collada")]
    program = Path(mesh_process.__file__).read_bytes()
    return file_cache.entry_name(
        repr((sys.version, builds, program, file.suffix, file.read_bytes())), "mesh"
    )


def _run_mesh_process(files: list[Path], max_triangles: int) -> list[bytes]:
    """Return the answers of the process, at least one."""
    program = [sys.executable, "-P", mesh_process.__file__]  # without its folder in sys.path
    request = {"files": [str(file.resolve()) for file in files], "triangles": max_triangles}
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # threads count as memory
    try:
        completed = subprocess.run(
            program,
            input=json.dumps(request).encode(),
            capture_output=True,
            env=environment,
            timeout=_TIMEOUT_PER_FILE * len(files),
        )
        output, status = completed.stdout, completed.returncode
    except subprocess.TimeoutExpired as late:
        output, status = late.stdout or b"", -signal.SIGTERM
    answers, stream = [], io.BytesIO(output)
    with suppress(*_DAMAGE_ERRORS):  # after the complete answers
        for _ in files:
            start = stream.tell()
            _parse_answer(stream)
            answers.append(output[start : stream.tell()])
    if len(answers) < len(files):
        reason = "damaged"
        if status in (-signal.SIGTERM, -signal.SIGXCPU):
            reason = f"reading it takes more than {mesh_process.MAX_SECONDS} s"
        answers.append(json.dumps({"wrong": reason}).encode() + b"\n")
    return answers


def _parse_answer(answer: io.BytesIO) -> tuple[tuple[MeshPart, ...] | str, bool]:
    """Return the triangles of an answer, or its error text, and whether no other file was read."""
    header = json.loads(answer.readline())
    if "wrong" in header:
        return str(header["wrong"]), False
    parts = tuple(
        MeshPart(np.load(answer), np.load(answer), part["colour"] and tuple(part["colour"]))
        for part in header["parts"]
    )
    return parts, bool(header.get("alone"))


@dataclass(frozen=True)
class BoxShape:
    """Box about the origin, edges (3,) [m]."""

    size: tuple[float, float, float]


@dataclass(frozen=True)
class CylinderShape:
    """Cylinder about the origin along z [m]."""

    radius: float
    length: float


@dataclass(frozen=True)
class SphereShape:
    """Sphere about the origin [m]."""

    radius: float


@dataclass(frozen=True, eq=False)
class MeshShape:
    """Triangles: vertices (V, 3) [m], faces (F, 3)."""

    vertices: Array
    faces: np.ndarray


Shape = BoxShape | CylinderShape | SphereShape | MeshShape


@dataclass(frozen=True)
class Visual:
    """One coloured shape on a link.

    Attributes:
        link: Name of the link.
        shape: The shape.
        placement: (4, 4) pose of the shape in the link's frame.
        colour: Red, green, blue, opacity, 0 to 1.
        mesh_label: File, line and name of the mesh that the shape belongs to; "" for other shapes.
    """

    link: str
    shape: Shape
    placement: Array
    colour: Colour
    mesh_label: str = ""

    def bounding_corners(self) -> Array:
        """Return the corners (8, 3) of a box around the shape, in the link's frame."""
        match self.shape:
            case BoxShape(size):
                high = np.array(size) / 2
            case CylinderShape(radius, length):
                high = np.array([radius, radius, length / 2])
            case SphereShape(radius):
                high = np.full(3, radius)
            case MeshShape(vertices):
                high = vertices.max(axis=0)
        low = self.shape.vertices.min(axis=0) if isinstance(self.shape, MeshShape) else -high
        corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(8, 3)
        return corners @ self.placement[:3, :3].T + self.placement[:3, 3]


@dataclass(frozen=True)
class _UnloadedMesh:
    """A mesh on a link that is not read yet: its name, scale (3,) and file."""

    link: str
    name: str
    scale: tuple[float, ...]
    file: Path | None
    placement: Array
    colour: Colour | None
    source_location: str


class UrdfShapes:
    """The shapes of a URDF that can be drawn, and the problems with others.

    Args:
        xml: The file.
        tags: Tags of the elements of links to read: visual, collision.
        replacement: Shape in place of a mesh that cannot be read; None to leave it out.

    Attributes:
        shapes: Shapes by tag.
        missing_meshes: File and line by name of each mesh whose file does not exist.
        problems: Other problems, with file, line, consequence and advice.
    """

    def __init__(
        self,
        xml: XmlFile,
        tags: Sequence[str] = ("visual",),
        replacement: BoxShape | None = None,
    ):
        self._xml, self._replacement = xml, replacement
        self.missing_meshes: dict[str, str] = {}
        self._damaged_meshes: dict[str, str] = {}
        self.problems: list[str] = []
        with raise_errors():
            self._colours = {
                material.get("name", "").strip(): colour
                # the first of a name applies
                for material in reversed(list(xml.root.iter("material")))
                if (colour := self._read_colour(material)) is not None
            }
        self.problems.clear()  # reported for the visuals that use them
        found = {tag: self._read_elements(tag) for tag in tags}
        meshes = read_meshes(
            shape.file
            for shapes in found.values()
            for shape in shapes
            if isinstance(shape, _UnloadedMesh) and shape.file is not None
        )
        self.shapes: Mapping[str, Sequence[Visual]] = {
            tag: [x for shape in shapes for x in self._create_visuals(shape, meshes)]
            for tag, shapes in found.items()
        }
        self.problems = list(dict.fromkeys(self.problems))

    def _read_elements(self, tag: str) -> list[Visual | _UnloadedMesh]:
        """Return the shapes of elements with a tag."""
        found: list[Visual | _UnloadedMesh] = []
        for element in self._xml.root.iterfind(f"link/{tag}"):
            link = element.getparent().get("name", "").strip()
            try:
                found += self._read_element(element, link, f"a {tag} of link '{link}'")
            except DescriptionError as error:
                self.problems.append(f"{error}; it is not drawn")
        return found

    @raise_errors()
    def _read_element(
        self, element: etree._Element, link: str, label: str
    ) -> Sequence[Visual | _UnloadedMesh]:
        xyz, rpy = self._xml.placement(element, label)
        self._check_distance(element, label, xyz)
        placement = se3_from_xyz_rpy(xyz, rpy)
        material = self._xml.single_child(element, "material", label)
        colour = None
        if material is not None:
            colour = self._read_colour(material) or self._colours.get(
                material.get("name", "").strip()
            )
        geometry = self._xml.single_child(element, "geometry", label)
        shapes = [] if geometry is None else list(geometry)
        if len(shapes) != 1 or shapes[0].tag not in _SHAPE_TAGS:
            shape_text = ", ".join(f"<{shape.tag}>" for shape in shapes[:4]) or "no shape"
            listed = ", ".join(f"<{shape}>" for shape in _SHAPE_TAGS)
            raise self._xml.error_at(element, f"{label} has {shape_text}, give one of {listed}")
        shape = shapes[0]
        if shape.tag == "mesh":
            if not (name := shape.get("filename", "")):
                raise self._xml.error_at(shape, f'{label} names no mesh, add filename="..."')
            scale = self._xml.vector(shape, "scale", label, 3, (1.0, 1.0, 1.0))
            file, place = (
                find_mesh_file(name, self._xml.file.parent),
                self._xml.source_location(shape),
            )
            return [_UnloadedMesh(link, name, scale, file, placement.homogeneous, colour, place)]
        return [
            Visual(link, part, (placement * offset).homogeneous, colour or DEFAULT_COLOUR)
            for part, offset in self._read_shape(shape, label)
        ]

    def _read_shape(self, shape: etree._Element, label: str) -> list[tuple[Shape, pin.SE3]]:
        """Return the parts of a shape, each with its pose."""
        centre = pin.SE3.Identity()
        if shape.tag == "box":
            x, y, z = self._read_sizes(shape, "size", label, 3)
            return [(BoxShape((x, y, z)), centre)]
        (radius,) = self._read_sizes(shape, "radius", label, 1)
        sphere = SphereShape(radius)
        if shape.tag == "sphere":
            return [(sphere, centre)]
        (length,) = self._read_sizes(shape, "length", label, 1)
        # the length of a capsule is between the centres of its spheres
        heights = (-length / 2, length / 2) if shape.tag == "capsule" else ()
        ends = [(sphere, pin.SE3(np.eye(3), np.array([0.0, 0.0, z]))) for z in heights]
        return [(CylinderShape(radius, length), centre), *ends]

    def _read_sizes(
        self, shape: etree._Element, key: str, label: str, count: int
    ) -> tuple[float, ...]:
        sizes = self._xml.vector(shape, key, label, count)
        if min(sizes) <= 0:
            raise self._xml.error_at(
                shape, f'{key}="{shape.get(key)}" of {label} is not positive, give metres'
            )
        self._check_distance(shape, label, sizes)
        return sizes

    def _check_distance(
        self, element: etree._Element, label: str, lengths: Sequence[float]
    ) -> None:
        largest = max(lengths, key=abs)
        if abs(largest) > _MAX_DISTANCE:
            raise self._xml.error_at(
                element, f"{label} has a length of {largest:g} m, give metres"
            )

    def _read_colour(self, material: etree._Element) -> Colour | None:
        """Return the colour of a material, None if it has no valid one."""
        colour = material.find("color")
        if colour is None:
            return None
        try:
            rgba = self._xml.vector(colour, "rgba", "a colour", 4)
            if not 0 <= min(rgba) <= max(rgba) <= 1:
                given = f'rgba="{colour.get("rgba")}"'
                raise self._xml.error_at(
                    colour, f"{given} of a colour is not within 0 to 1, correct it"
                )
        except DescriptionError as error:
            self.problems.append(f"{error}; grey is drawn")
            return None
        red, green, blue, opacity = rgba
        return red, green, blue, opacity

    def _create_visuals(
        self, mesh: Visual | _UnloadedMesh, meshes: Mapping[Path, tuple[MeshPart, ...] | str]
    ) -> list[Visual]:
        """Return a shape with the triangles of its mesh."""
        if isinstance(mesh, Visual):
            return [mesh]
        name, colour = mesh.name, mesh.colour or DEFAULT_COLOUR
        if len(name) >= _MAX_NAME_LENGTH:
            name = f"...{name[-_MAX_NAME_LENGTH:]}"
        mesh_label = f"{mesh.source_location}: mesh '{name}'"
        shapes = [] if self._replacement is None else [self._replacement]
        box = [Visual(mesh.link, shape, mesh.placement, colour) for shape in shapes]
        if mesh.file is None:
            self.missing_meshes.setdefault(name, mesh.source_location)
            return box
        parts = meshes[mesh.file]
        if isinstance(parts, str):
            first_location = self._damaged_meshes.setdefault(name, mesh.source_location)
            self.problems.append(
                f"{first_location}: mesh file '{name}' cannot be read ({parts}), export "
                "it again; a box is drawn instead"
            )
            return box
        if any(_largest_coordinate(part, mesh.scale) > _MAX_DISTANCE for part in parts):
            self.problems.append(
                f"{mesh_label} is far larger than a machine, scale it; a box is drawn instead"
            )
            return box
        return [
            Visual(
                mesh.link,
                MeshShape(part.vertices * mesh.scale, part.faces),
                mesh.placement,
                mesh.colour or part.colour or DEFAULT_COLOUR,
                mesh_label,
            )
            for part in parts
        ]


def _largest_coordinate(part: MeshPart, scale: tuple[float, ...]) -> float:
    with np.errstate(over="ignore"):
        return float(np.abs(part.vertices * scale).max())
