"""Translation of a drawing to URDF with loops, independent joints and the posture drawn.

Links have the axes of the drawing: x forward, z up. A pin becomes a joint or a loop of its name; a
cylinder NAME the links NAME_barrel and NAME_rod, the joint NAME between them, the joint
NAME_barrel at its first pin and the loop NAME_eye at its second. A point of one body is a frame of
its name, a pin the frame BODY_PIN of each of its bodies.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from lxml import etree
from scipy.cluster.hierarchy import DisjointSet

from crane.common.errors import DescriptionError
from crane.common.samples import Array
from crane.description.kinematic_tree import (
    Y_AXIS,
    Z_AXIS,
    Joint,
    Limits,
    Link,
    Vector,
    to_vector,
)
from crane.description.machine_schema import MACHINE
from crane.description.pinocchio_conversion import inertial_from_inertia, xyz_rpy_from_se3
from crane.formats.drawing.body_inertia import rigid_inertia
from crane.formats.drawing.body_shapes import BarShape
from crane.formats.drawing.drawing import Drawing, DrawnPin, DrawnSlide, read_drawing
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.steel_cylinder import SteelCylinder, add_cylinder_visuals, sum_inertias
from crane.formats.xml_file import (
    XmlFile,
    add_joint,
    add_link,
    add_origin,
    format_numbers,
    set_source_location,
)

_ANGLE_TOLERANCE = 1e-9  # sine, above which a cylinder is not perpendicular to a pin
_COLOURS = {"body": "0.95 0.70 0.10 1", "barrel": "0.15 0.16 0.18 1", "rod": "0.80 0.82 0.85 1"}
_NO_ROTATION = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _BodyConnection:
    """A pin or a slide between two bodies.

    Attributes:
        name: Name of its joint or loop.
        bodies: The two bodies.
        point: Where it is; of a slide, the names of both points.
        constraint: What it permits.
    """

    name: str
    bodies: tuple[str, str]
    points: tuple[str, ...]
    constraint: DrawnPin | DrawnSlide


def open_drawing(file: Path) -> XmlFile:
    """Return the drawing of a machine file as URDF.

    Raises:
        DescriptionError: With file and line, in the terms of the drawing.
    """
    top = YamlSection.read(file, MACHINE)
    section = top.section("drawing")
    if section is None:
        raise top.error_at(None, "this is no URDF and has no section 'drawing'")
    return _DrawingTranslation(read_drawing(section), top.text("name")).build_robot(file)


class _DrawingTranslation:
    """Builds the URDF of a drawing."""

    def __init__(self, drawing: Drawing, name: str):
        self._drawing, self._locations = drawing, {drawing.location: 0}
        self._robot = etree.Element("robot", name=name)
        self._origins: dict[str, Array] = {drawing.base: np.zeros(3)}  # of links, as drawn
        self._home: dict[str, float] = {}

    def build_robot(self, file: Path) -> XmlFile:
        """Return the URDF."""
        for name, colour in _COLOURS.items():
            material = etree.SubElement(self._robot, "material", name=name)
            etree.SubElement(material, "color", rgba=colour)
        edges = list(self._edges())
        tree, loops = _spanning_edges(edges)
        ordered = list(self._directed(tree))
        self._add_bodies()
        for edge, parent, child in ordered:
            self._add_tree_joint(edge, parent, child)
        for edge in loops:
            self._add_body_loop(edge)
        state = etree.SubElement(self._robot, "group_state", name="home", group="all")
        for joint, value in self._home.items():
            etree.SubElement(state, "joint", name=joint, value=repr(value))
        return XmlFile(file, self._robot, self._locations)

    def _edges(self) -> Iterator[_BodyConnection]:
        """Yield slides of bodies and pins, those with a drive first, and at last cylinders."""
        drawing = self._drawing
        edges = [
            _BodyConnection(name, (slide.bodies[0], slide.bodies[1]), slide.points, slide)
            for name, slide in drawing.slides.items()
            if slide.bodies
        ]
        for point in drawing.points:
            first, *others = drawing.bodies_at(point) or [""]
            for other in others:
                name = point if len(others) == 1 else f"{point}_{other}"
                edges.append(_BodyConnection(name, (first, other), (point,), self._pin(point)))
        yield from sorted(edges, key=lambda edge: not edge.constraint.is_driven)
        for name, slide in drawing.slides.items():
            if slide.cylinder is not None:
                first, second = (self._body_of_end(name, slide, x) for x in slide.points)
                yield _BodyConnection(name, (first, second), slide.points, slide)

    def _pin(self, point: str) -> DrawnPin:
        return self._drawing.pins.get(point) or DrawnPin(
            np.array([0.0, -1.0, 0.0]), location=self._drawing.location
        )

    def _directed(self, tree: list[_BodyConnection]) -> Iterator[tuple[_BodyConnection, str, str]]:
        """Yield the edges of the tree from the base on, with parent and child."""
        pending = [self._drawing.base]
        for parent in pending:
            edges = [edge for edge in tree if parent in edge.bodies]
            ends = [(edge, edge.bodies[0] == parent) for edge in edges]
            new = [(edge, i) for edge, i in ends if edge.bodies[i] not in self._origins]
            for edge, i in new:
                child = edge.bodies[i]
                self._origins[child] = self._drawing.points[edge.points[-i]]
                pending.append(child)
                yield edge, parent, child
        for name, body in self._drawing.bodies.items():
            if name not in self._origins:
                raise DescriptionError(
                    f"{body.location}: body '{name}' shares no point with a body that is joined "
                    f"to '{self._drawing.base}', name a pin among its points"
                )

    def _locate(self, element: etree._Element, location: str) -> etree._Element:
        for inner in element.iter(etree.Element):
            set_source_location(inner, location, self._locations)
        return element

    def _add_bodies(self) -> None:
        drawing = self._drawing
        for name in self._origins:
            body, origin = drawing.bodies[name], self._origins[name]
            inertia = rigid_inertia(
                body.inertia.mass, body.inertia.lever - origin, body.inertia.inertia
            )
            link = add_link(self._robot, Link(name, "", inertial_from_inertia(inertia)))
            for bar in body.bars:
                _add_bar(link, bar, origin)
            self._locate(link, body.location)
        frames = [(name, point) for name in self._origins for point in drawing.bodies[name].points]
        for name, point in frames:
            frame = drawing.frame_name(name, point)
            location = drawing.bodies[name].location
            if frame in drawing.bodies:
                raise DescriptionError(
                    f"{location}: a point and a body are named '{frame}', rename one"
                )
            self._locate(add_link(self._robot, Link(frame, "")), location)
            place = to_vector(drawing.points[point] - self._origins[name])
            self._add_joint(Joint(f"{frame}_fixed", "fixed", name, frame, "", place), location)

    def _add_joint(
        self, joint: Joint, location: str, is_driven: bool = False, home: float | None = None
    ) -> None:
        element = add_joint(self._robot, joint)
        if joint.is_movable:
            element.set("independent", str(is_driven).lower())
        if home is not None:
            self._home[joint.name] = home
        self._locate(element, location)

    def _add_tree_joint(self, edge: _BodyConnection, parent: str, child: str) -> None:
        part, origin = edge.constraint, self._origins[child] - self._origins[parent]
        if isinstance(part, DrawnSlide) and part.cylinder is not None:
            self._add_cylinder(edge, part, parent, is_tree=True)
            return
        home: float | None = 0.0
        if isinstance(part, DrawnSlide):
            kind, axis = "prismatic", self._direction(part)
            axis = axis if child == edge.bodies[1] else -axis
            home, limits = self._drawing.distance(part.points) - part.shortest, part.limits
            origin = origin - home * axis
        elif part.axis is None:
            kind, axis, limits, home = "spherical", np.array(Z_AXIS), Limits(), None
        else:
            kind, axis, limits = "revolute", part.axis, part.limits
        joint = Joint(
            edge.name, kind, parent, child, "", to_vector(origin), axis=to_vector(axis),
            limits=limits,
        )  # fmt: skip
        self._add_joint(joint, part.location, part.is_driven, home)

    def _direction(self, slide: DrawnSlide) -> Array:
        first, second = (self._drawing.points[point] for point in slide.points)
        return np.asarray((second - first) / np.linalg.norm(second - first))

    def _add_body_loop(self, edge: _BodyConnection) -> None:
        part = edge.constraint
        if edge.bodies[0] == edge.bodies[1]:
            raise DescriptionError(
                f"{part.location}: cylinder '{edge.name}' has both pins on '{edge.bodies[0]}', "
                "which is rigid"
            )
        if isinstance(part, DrawnSlide) and part.cylinder is not None:
            self._add_cylinder(edge, part, edge.bodies[0], is_tree=False)
            return
        if part.is_driven:
            raise DescriptionError(
                f"{part.location}: '{edge.name}' is driven and closes a loop of other drives, "
                "leave one of them out"
            )
        if isinstance(part, DrawnSlide):
            kind, axis = "prismatic", to_vector(self._direction(part))
        else:
            kind = "spherical" if part.axis is None else "revolute"
            axis = Z_AXIS if part.axis is None else to_vector(part.axis)
        place = self._drawing.points[edge.points[0]]
        ends = {
            body: (to_vector(place - self._origins[body]), _NO_ROTATION) for body in edge.bodies
        }
        self._add_loop(edge.name, kind, ends, axis, part.location)

    def _add_loop(
        self,
        name: str,
        kind: str,
        ends: Mapping[str, tuple[Vector, Vector]],
        axis: Vector,
        location: str,
    ) -> None:
        loop = etree.SubElement(self._robot, "loop", name=name, type=kind)
        for tag, (link, placement) in zip(("predecessor", "successor"), ends.items(), strict=True):
            add_origin(etree.SubElement(loop, tag, link=link), *placement)
        etree.SubElement(loop, "axis", xyz=format_numbers(axis))
        self._locate(loop, location)

    def _add_cylinder(
        self, edge: _BodyConnection, slide: DrawnSlide, parent: str, is_tree: bool
    ) -> None:
        """Add barrel and rod from the body of one end; the other end is a joint or a loop."""
        assert slide.cylinder is not None
        name, location = edge.name, slide.location
        rotation, is_planar = self._cylinder_axes(slide)
        near = int(parent != edge.bodies[0])  # 0: barrel, 1: rod
        links, sign = (f"{name}_barrel", f"{name}_rod"), -1.0 if near else 1.0
        ends = f"{name}_barrel", f"{name}_eye"
        self._add_cylinder_links(links, slide, slide.cylinder)
        points = [self._drawing.points[point] for point in slide.points]
        placement = xyz_rpy_from_se3(pin.SE3(rotation, points[near] - self._origins[parent]))
        if is_planar:
            pins = [Joint(ends[near], "revolute", parent, links[near], "", *placement, Y_AXIS)]
        else:
            cross = Link(f"{name}_cross", "", composite_joint=ends[near])
            self._locate(add_link(self._robot, cross), location)
            first, second = f"{ends[near]}_y", f"{ends[near]}_z"
            pins = [
                Joint(first, "revolute", parent, cross.name, "", *placement, Y_AXIS),
                Joint(second, "revolute", cross.name, links[near], "", axis=Z_AXIS),
            ]
        for joint in pins:
            self._add_joint(joint, location, home=0.0)
        limits = Limits(0.0, slide.stroke, slide.cylinder.max_force * len(slide.offsets))
        position = self._drawing.distance(slide.points) - slide.shortest
        self._add_joint(
            Joint(
                name, "prismatic", links[near], links[1 - near], "",
                (sign * slide.shortest, 0.0, 0.0), axis=(sign, 0.0, 0.0), limits=limits,
            ), location, slide.is_driven, position,
        )  # fmt: skip
        far, other = links[1 - near], edge.bodies[1 - near]
        if is_tree:
            back = xyz_rpy_from_se3(pin.SE3(rotation.T, np.zeros(3)))
            kind, axis = ("revolute" if is_planar else "spherical"), to_vector(rotation[:, 1])
            joint = Joint(ends[1 - near], kind, far, other, "", *back, axis)
            self._add_joint(joint, location, home=0.0 if is_planar else None)
            return
        place = xyz_rpy_from_se3(pin.SE3(rotation, points[1 - near] - self._origins[other]))
        loop_ends = {far: ((0.0, 0.0, 0.0), _NO_ROTATION), other: place}
        kind = "revolute" if is_planar else "spherical"
        self._add_loop(ends[1 - near], kind, loop_ends, Y_AXIS, location)

    def _add_cylinder_links(
        self, names: tuple[str, str], slide: DrawnSlide, cylinder: SteelCylinder
    ) -> None:
        inertias = cylinder.barrel_inertia, cylinder.rod_inertia
        links = [
            add_link(self._robot, Link(name, "", inertial_from_inertia(
                sum_inertias(*(
                    rigid_inertia(inertia.mass, inertia.lever + [0.0, y, 0.0], inertia.inertia)
                    for y in slide.offsets
                )))))
            for name, inertia in zip(names, inertias, strict=True)
        ]  # fmt: skip
        add_cylinder_visuals(links[0], links[1], cylinder, slide.offsets)
        for link, colour in zip(links, ("barrel", "rod"), strict=True):
            for visual in link.iterfind("visual"):
                etree.SubElement(visual, "material", name=colour)
            self._locate(link, slide.location)

    def _body_of_end(self, name: str, slide: DrawnSlide, point: str) -> str:
        bodies = self._drawing.bodies_at(point)
        if not bodies:
            raise DescriptionError(
                f"{slide.location}: cylinder '{name}' ends at {point}, which is on no body: add "
                "it to the points of one"
            )
        return bodies[0]

    def _cylinder_axes(self, slide: DrawnSlide) -> tuple[Array, bool]:
        """Return x along a cylinder and y along its pins, and whether they permit that."""
        direction = self._direction(slide)
        axes = [self._pin(point).axis for point in slide.points]
        normal = axes[0]
        is_planar = (
            normal is not None
            and axes[1] is not None
            and bool(np.linalg.norm(np.cross(normal, axes[1])) <= _ANGLE_TOLERANCE)
            and abs(float(direction @ normal)) <= _ANGLE_TOLERANCE
        )
        if normal is None or not is_planar:
            normal = np.eye(3)[np.abs(direction).argmin()]
            normal = normal - (normal @ direction) * direction
            normal /= np.linalg.norm(normal)
        return np.column_stack([direction, normal, np.cross(direction, normal)]), is_planar


def _spanning_edges(
    edges: list[_BodyConnection],
) -> tuple[list[_BodyConnection], list[_BodyConnection]]:
    """Return edges of a spanning tree, earlier ones first, and those that close loops."""
    bodies = DisjointSet(body for edge in edges for body in edge.bodies)
    tree, loops = list[_BodyConnection](), list[_BodyConnection]()
    for edge in edges:
        (tree if bodies.merge(*edge.bodies) else loops).append(edge)
    return tree, loops


def _add_bar(link: etree._Element, bar: BarShape, origin: Array) -> None:
    """Add the shape of a bar to a link at an origin."""
    axis = bar.ends[1] - bar.ends[0]
    length = float(np.linalg.norm(axis))
    direction = axis / length
    side = np.eye(3)[1 if abs(direction[1]) < 0.9 else 0]
    side = side - (side @ direction) * direction
    side /= np.linalg.norm(side)
    up = np.cross(direction, side)
    visual = etree.SubElement(link, "visual")
    geometry = etree.Element("geometry")
    if bar.width is None:  # along z
        rotation = np.column_stack([side, up, direction])
        size = {"radius": format_numbers([bar.height / 2]), "length": format_numbers([length])}
        etree.SubElement(geometry, "cylinder", size)
    else:
        rotation = np.column_stack([direction, side, up])
        size = {"size": format_numbers([length, bar.width, bar.height])}
        etree.SubElement(geometry, "box", size)
    add_origin(visual, *xyz_rpy_from_se3(pin.SE3(rotation, bar.ends.mean(axis=0) - origin)))
    visual.append(geometry)
    etree.SubElement(visual, "material", name="body")
