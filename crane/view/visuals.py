"""What the URDFs of a machine look like: primitives and meshes with colours."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from crane.description.mesh_file import mesh_file
from crane.description.xml import XmlFile
from crane.errors import CraneWarning
from crane.machine import Machine
from crane.samples import Array

Colour = tuple[float, float, float, float]

PLAIN: Colour = (0.62, 0.64, 0.67, 1.0)  # where a URDF names no colour


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
    """

    link: str
    shape: Shape
    placement: Array
    colour: Colour

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


def read_visuals(machine: Machine) -> list[Visual]:
    """The visuals of every link, or a skeleton where no URDF has any.

    A mesh whose file is missing is a box, with a warning; where nothing but boxes would be left,
    the skeleton is there, too.
    """
    import yourdfpy

    visuals: list[Visual] = []
    missing: list[str] = []
    box = Box((0.15 * _reach(machine),) * 3)
    for chain in machine.chains:
        if XmlFile(chain.urdf).root.tag != "robot":  # MJCF, whose shapes are not drawn
            continue
        robot = yourdfpy.URDF.load(
            str(chain.urdf),
            build_scene_graph=False,
            build_collision_scene_graph=False,
            load_meshes=False,
        ).robot
        colours = {m.name: _colour(m) for m in robot.materials}
        for link in robot.links:
            for visual in link.visuals:
                placement = np.eye(4) if visual.origin is None else visual.origin
                named = visual.material
                colour = None if named is None else _colour(named) or colours.get(named.name)
                for shape, own in _shapes(visual.geometry, chain.urdf, missing, box):
                    visuals.append(Visual(link.name, shape, placement, colour or own or PLAIN))
    if missing:
        warnings.warn(
            f"{machine.name}: {len(missing)} mesh files are not there and are drawn as boxes "
            f"({missing[0]}), install the package that has them",
            CraneWarning,
            stacklevel=2,
        )
    if all(visual.shape is box for visual in visuals):
        visuals += skeleton(machine)
    return visuals


def _reach(machine: Machine) -> float:
    """Largest distance between two joints on one body [m]; 1 where all are in one place."""
    places = machine.model.jointPlacements
    return max(float(np.linalg.norm(place.translation)) for place in places) or 1.0


def skeleton(machine: Machine) -> list[Visual]:
    """Bars from each joint to the joints and frames of the body it moves."""
    model = machine.model
    links: dict[int, str] = {}  # joint -> the first link of the body it moves
    ends: list[tuple[int, Array]] = []
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            links.setdefault(frame.parentJoint, frame.name)
            ends.append((frame.parentJoint, frame.placement.translation))
    for joint in range(1, model.njoints):
        ends.append((model.parents[joint], model.jointPlacements[joint].translation))
    radius = 0.03 * max(float(np.linalg.norm(end)) for _, end in ends) or 0.02
    visuals = []
    for body, end in ends:
        in_link = model.frames[machine.frame(links[body])].placement.inverse()
        ball = in_link.homogeneous
        ball[:3, 3] = in_link.act(end)
        visuals.append(Visual(links[body], Sphere(1.5 * radius), ball, PLAIN))
        if length := float(np.linalg.norm(end)):
            along = pin.Quaternion.FromTwoVectors(pin.ZAxis, end)
            bar = (in_link * pin.SE3(along, end / 2)).homogeneous
            visuals.append(Visual(links[body], Cylinder(radius, length), bar, PLAIN))
    return visuals


def _colour(material: Any) -> Colour | None:
    if material.color is None:
        return None
    red, green, blue, opacity = (float(value) for value in material.color.rgba)
    return red, green, blue, opacity


def _shapes(
    geometry: Any, urdf: Path, missing: list[str], box: Box
) -> list[tuple[Shape, Colour | None]]:
    """The shapes of a geometry, each with its own colour if its file has one."""
    if geometry.box is not None:
        x, y, z = (float(value) for value in geometry.box.size)
        return [(Box((x, y, z)), None)]
    if geometry.cylinder is not None:
        cylinder = geometry.cylinder
        return [(Cylinder(float(cylinder.radius), float(cylinder.length)), None)]
    if geometry.sphere is not None:
        return [(Sphere(float(geometry.sphere.radius)), None)]
    return _meshes(geometry.mesh, urdf, missing, box)


def _meshes(
    mesh: Any, urdf: Path, missing: list[str], box: Box
) -> list[tuple[Shape, Colour | None]]:
    import trimesh

    file = mesh_file(mesh.filename, urdf.parent)
    if file is None:
        missing.append(mesh.filename)
        return [(box, None)]
    # unmerged vertices keep the edges of the drawing sharp
    scene = trimesh.load_scene(file, process=False)
    scale = np.eye(4)
    scale[:3, :3] *= 1.0 if mesh.scale is None else np.asarray(mesh.scale, dtype=float)
    found: list[tuple[Shape, Colour | None]] = []
    for node in scene.graph.nodes_geometry:
        placement, name = scene.graph[node]
        part = scene.geometry[name]
        if not isinstance(part, trimesh.Trimesh):
            continue
        vertices = trimesh.transform_points(part.vertices, scale @ placement)
        look: Any = part.visual
        colour = None
        if look.defined:
            painted = getattr(look, "material", look)
            red, green, blue, opacity = (float(value) / 255 for value in painted.main_color)
            colour = (red, green, blue, opacity)
        found.append((Mesh(vertices, np.asarray(part.faces)), colour))
    return found
