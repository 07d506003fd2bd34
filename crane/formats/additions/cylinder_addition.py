"""Hydraulic cylinders added to a machine between attachment points: links and loop."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import InputError, check_name
from crane.common.samples import Array
from crane.common.unit_conversions import UnitError, parse_number
from crane.description.kinematic_tree import (
    X_AXIS,
    Y_AXIS,
    Z_AXIS,
    Joint,
    Limits,
    Link,
    Vector,
    path_to_root,
    to_vector,
)
from crane.description.pinocchio_conversion import inertial_from_inertia, xyz_rpy_from_se3
from crane.description.specification import LoopSpec
from crane.formats.machine_file.machine_writer import MachineDraft, loop_data
from crane.formats.steel_cylinder import SteelCylinder, add_cylinder_visuals
from crane.formats.xml_file import add_joint, add_link
from crane.machine.machine import Machine

_DIFFERENCE_STEP = 1e-5  # of the fastest coordinate, for central differences


@dataclass(frozen=True)
class AttachmentPoint:
    """A point of a body.

    Attributes:
        link: A link of the body.
        point: (3,) in the link's frame [m].
    """

    link: str
    point: Vector

    def __str__(self) -> str:
        """Return it in the notation that `parse_attachment_point` reads."""
        point = ",".join(f"{value:.6g}" for value in self.point)
        return f"{self.link}:{point}" if any(self.point) else self.link

    @property
    def placement(self) -> pin.SE3:
        """Its pose in the link's frame."""
        return pin.SE3(np.eye(3), np.array(self.point))


def parse_attachment_point(machine: Machine, text: str) -> AttachmentPoint:
    """Parse LINK or LINK:x,y,z, metres in the link's frame.

    Raises:
        InputError: The link is unknown, or the text is malformed.
    """
    text = str(text)
    link, colon, coordinates = text.rpartition(":")
    if text in machine.tree.links or not colon:
        link, coordinates = text, "0,0,0"
    try:
        point = np.array([parse_number(word, ("m",)) for word in coordinates.split(",")])
    except (UnitError, ValueError):
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(
            f"'{text}' is no point, write LINK or LINK:x,y,z with metres in the link's frame"
        )
    check_name(link, machine.tree.links, f"'{link}' is no link of '{machine.name}'")
    return AttachmentPoint(link, to_vector(point))


def joints_between(
    parent_joints: dict[str, Joint], first_link: str, second_link: str
) -> list[Joint]:
    """Return the movable joints of a tree between two links, see `Tree.parent_joints`."""
    first, second = (path_to_root(parent_joints, link) for link in (first_link, second_link))
    shared = {joint.name for joint in first} & {joint.name for joint in second}
    return [x for x in (*first, *second) if x.is_movable and x.name not in shared]


@dataclass(frozen=True)
class AttachmentPair:
    """Two attachment points of a machine.

    Attributes:
        machine: The machine.
        points: The points.
    """

    machine: Machine
    points: tuple[AttachmentPoint, AttachmentPoint]

    @property
    def joints(self) -> list[Joint]:
        """The movable joints of the tree between the two bodies."""
        return joints_between(self.machine.tree.parent_joints, *(x.link for x in self.points))

    def placements(self, q: Array) -> list[pin.SE3]:
        """Return the poses of the links' frames, moved to the points, in the world."""
        model, data = self.machine.model, self.machine.model.createData()
        pin.forwardKinematics(model, data, self.machine.coordinates.configuration(q))
        return [
            pin.updateFramePlacement(model, data, self.machine.frame(x.link)) * x.placement
            for x in self.points
        ]

    def vector(self, q: Array) -> Array:
        """Return the vector (3,) from the first point to the second in the world [m]."""
        first, second = (placement.translation for placement in self.placements(q))
        return np.asarray(second - first)

    def lever_arm(self, q: Array, joint: str) -> float:
        """Return the derivative of the distance by an active joint: the lever arm [m].

        For a prismatic joint it is a ratio. It is computed along gamma at a closed configuration
        (nq,), by central differences.

        Raises:
            ClosureError: The configuration is singular.
        """
        gamma_column = self.machine.closure.gamma(q)[:, self.machine.active.index(joint)]
        step = _DIFFERENCE_STEP / float(np.abs(gamma_column).max())
        ahead, back = (np.linalg.norm(self.vector(q + x * gamma_column)) for x in (step, -step))
        return float(ahead - back) / (2 * step)


_OFFSET_TOLERANCE = 1e-6  # relative to the cylinder's length
_PARALLEL_TOLERANCE = 1e-9  # sine of an angle; a larger deviation gets a universal joint


def add_barrel_and_rod(
    draft: MachineDraft, name: str, pair: AttachmentPair, cylinder: SteelCylinder, q: Array
) -> list[str]:
    """Add barrel and rod as a chain with its loop and the home configuration q (nq,).

    Returns:
        Notes on changes of the attachment points.
    """
    notes, points = [], pair.points
    axis_vector = pair.vector(q)
    normal = _plane_normal(pair, q, axis_vector)
    is_planar = normal is not None and bool(abs(axis_vector @ normal) <= cylinder.bore)
    if normal is not None and is_planar:
        offset = float(axis_vector @ normal)
        if abs(offset) > _OFFSET_TOLERANCE * cylinder.retracted_length:
            notes.append(f"the rod's eye moved {1e3 * abs(offset):.4g} mm along its pin, into the "
                         "plane of the barrel's")  # fmt: skip
        axis_vector = axis_vector - offset * normal
    length = float(np.linalg.norm(axis_vector))
    axis_direction = axis_vector / length
    if normal is None or abs(axis_direction @ normal) > 0.9:
        normal = np.eye(3)[np.abs(axis_direction).argmin()]
    pin_direction = normal - (normal @ axis_direction) * axis_direction
    pin_direction /= np.linalg.norm(pin_direction)
    rotation = np.column_stack(
        [axis_direction, pin_direction, np.cross(axis_direction, pin_direction)]
    )
    barrel_placement, rod_placement = pair.placements(q)
    barrel_frame = pin.SE3(rotation, barrel_placement.translation)
    rod_frame = pin.SE3(rotation, barrel_placement.translation + axis_vector)
    base_in_link = points[0].placement * barrel_placement.actInv(barrel_frame)
    eye_in_link = points[1].placement * rod_placement.actInv(rod_frame)
    rod_robot, eye = draft.urdf_of_link(points[1].link), f"{name}_eye"
    add_link(rod_robot, Link(eye, ""))
    add_joint(
        rod_robot, Joint(eye, "fixed", points[1].link, eye, "", *xyz_rpy_from_se3(eye_in_link))
    )
    draft.add_chain(
        name, _cylinder_urdf(name, cylinder, base_in_link, is_planar), {"parent": points[0].link}
    )
    draft.data["loops"].append(
        loop_data(
            LoopSpec(
                name, "revolute" if is_planar else "spherical", f"{name}_rod", eye, Y_AXIS, ""
            )
        )
    )
    home = dict(zip(pair.machine.joints, q.tolist(), strict=True))
    draft.data["home"] = (
        home
        | dict.fromkeys([f"{name}_pin"] if is_planar else [f"{name}_pin_y", f"{name}_pin_z"], 0.0)
        | {name: length - cylinder.retracted_length}
    )
    return notes


def _plane_normal(pair: AttachmentPair, q: Array, axis_vector: Array) -> Array | None:
    """Return the normal (3,) of the plane of relative motion of two bodies, None if spatial."""
    machine = pair.machine
    jacobian = pin.computeJointJacobians(
        machine.model, machine.model.createData(), machine.coordinates.configuration(q)
    ).reshape(6, -1)
    columns = [(joint.kind, jacobian[:, machine.column(joint.name)]) for joint in pair.joints]
    revolute_axes = [column[3:] for kind, column in columns if kind == "revolute"]
    prismatic_axes = [column[:3] for kind, column in columns if kind == "prismatic"]
    if revolute_axes:
        normal = revolute_axes[0]
    else:
        cross_products = [np.cross(axis_vector, axis) for axis in prismatic_axes]
        normal = max(cross_products, key=lambda cross: float(np.linalg.norm(cross)))
        if np.linalg.norm(normal) < _PARALLEL_TOLERANCE * np.linalg.norm(axis_vector):
            normal = np.cross(axis_vector, np.eye(3)[np.abs(axis_vector).argmin()])
        normal = normal / np.linalg.norm(normal)
    deviations = [float(np.linalg.norm(np.cross(axis, normal))) for axis in revolute_axes]
    deviations += [abs(float(axis @ normal)) for axis in prismatic_axes]
    return None if max(deviations) > _PARALLEL_TOLERANCE else np.asarray(normal)


def _cylinder_urdf(
    name: str, cylinder: SteelCylinder, base_placement: pin.SE3, is_planar: bool
) -> etree._Element:
    """Return the URDF of barrel and rod; x points from the barrel's eye to the rod's."""
    robot = etree.Element("robot", name=name)
    barrel, cross, rod = (f"{name}_{part}" for part in ("barrel", "cross", "rod"))
    xyz, rpy = xyz_rpy_from_se3(base_placement)
    links = [Link(f"{name}_base", "")]
    if is_planar:
        pins = [Joint(f"{name}_pin", "revolute", links[0].name, barrel, "", xyz, rpy, Y_AXIS)]
    else:
        links.append(Link(cross, "", composite_joint=f"{name}_pin"))
        pins = [
            Joint(f"{name}_pin_y", "revolute", links[0].name, cross, "", xyz, rpy, Y_AXIS),
            Joint(f"{name}_pin_z", "revolute", cross, barrel, "", axis=Z_AXIS),
        ]
    links += [
        Link(barrel, "", inertial_from_inertia(cylinder.barrel_inertia)),
        Link(rod, "", inertial_from_inertia(cylinder.rod_inertia)),
    ]
    slide = Joint(
        name,
        "prismatic",
        barrel,
        rod,
        "",
        to_vector(np.array([cylinder.retracted_length, 0, 0])),
        axis=X_AXIS,
        limits=Limits(0.0, cylinder.stroke, cylinder.max_force),
    )
    for link in links:
        add_link(robot, link)
    barrel_element, rod_element = robot.findall("link")[-2:]
    add_cylinder_visuals(barrel_element, rod_element, cylinder)
    for joint in (*pins, slide):
        add_joint(robot, joint)
    return robot
