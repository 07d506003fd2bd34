"""Barrel and rod hung between two eyes of a machine that is being written, closed by a loop."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.samples import Array
from crane.description.kinematic_tree import Joint, Limits, Link
from crane.description.pinocchio_conversion import to_vector, xyz_rpy_from_se3
from crane.formats.additions.attachment_points import (
    AttachmentPoint,
    joints_between,
    vector_between,
)
from crane.formats.additions.steel_cylinder import SteelCylinder
from crane.formats.machine_file.machine_writer import MachineDraft
from crane.formats.urdf_output import add_joint, add_link
from crane.machine import Machine

_OFFSET_TOLERANCE = 1e-6  # share of a cylinder's length that is none
_PARALLEL_TOLERANCE = (
    1e-9  # sine of an angle that is none: what is less exact gets a universal joint
)
_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def add_barrel_and_rod(
    draft: MachineDraft,
    machine: Machine,
    name: str,
    points: Sequence[AttachmentPoint],
    cylinder: SteelCylinder,
    q: Array,
) -> list[str]:
    """Barrel and rod as a chain, the loop that closes it, and the home posture q (nq,)."""
    notes = []
    axis_vector = vector_between(machine, points, q)
    normal = _plane_normal(machine, points, q, axis_vector)
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
    barrel_placement, rod_placement = (eye.placement(machine, q) for eye in points)
    barrel_frame = pin.SE3(rotation, barrel_placement.translation)
    rod_frame = pin.SE3(rotation, barrel_placement.translation + axis_vector)
    base_in_link = pin.SE3(np.eye(3), np.array(points[0].point)) * barrel_placement.actInv(
        barrel_frame
    )
    eye_in_link = pin.SE3(np.eye(3), np.array(points[1].point)) * rod_placement.actInv(rod_frame)
    _add_rod_eye_frame(draft.urdf_of_link(points[1].link), name, points[1].link, eye_in_link)
    draft.add_chain(
        name, _cylinder_urdf(name, cylinder, base_in_link, is_planar), {"parent": points[0].link}
    )
    draft.data["loops"].append(
        {
            "name": name,
            "type": "revolute" if is_planar else "spherical",
            "predecessor": f"{name}_rod",
            "successor": f"{name}_eye",
            "axis": list(_Y),
        }
    )
    home = dict(zip(machine.joints, q.tolist(), strict=True))
    pins = [f"{name}_pin"] if is_planar else [f"{name}_pin_y", f"{name}_pin_z"]
    draft.data["home"] = (
        home | dict.fromkeys(pins, 0.0) | {name: length - cylinder.retracted_length}
    )
    return notes


def _plane_normal(
    machine: Machine, points: Sequence[AttachmentPoint], q: Array, axis_vector: Array
) -> Array | None:
    """(3,) normal of the plane in which two bodies move against each other, None for space."""
    data = machine.model.createData()
    configuration = machine.coordinates.configuration(q)
    jacobian = pin.computeJointJacobians(machine.model, data, configuration).reshape(6, -1)
    revolute_axes, prismatic_axes = [], []
    for joint in joints_between(machine, points[0].link, points[1].link):
        column = jacobian[:, machine.column(joint.name)]
        if joint.kind == "revolute":
            revolute_axes.append(column[3:])
        else:
            prismatic_axes.append(column[:3])
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


def _add_rod_eye_frame(
    robot: etree._Element, name: str, link: str, eye_placement: pin.SE3
) -> None:
    """A frame of a link for the rod's eye."""
    xyz, rpy = xyz_rpy_from_se3(eye_placement)
    add_link(robot, Link(f"{name}_eye", ""))
    add_joint(robot, Joint(f"{name}_eye", "fixed", link, f"{name}_eye", "", xyz, rpy))


def _cylinder_urdf(
    name: str, cylinder: SteelCylinder, base_placement: pin.SE3, is_planar: bool
) -> etree._Element:
    """The URDF of barrel and rod; x points from the barrel's eye to the rod's, y is a pin."""
    robot = etree.Element("robot", name=name)
    barrel, cross, rod = (f"{name}_{part}" for part in ("barrel", "cross", "rod"))
    xyz, rpy = xyz_rpy_from_se3(base_placement)
    links = [Link(f"{name}_base", "")]
    if is_planar:
        pins = [Joint(f"{name}_pin", "revolute", links[0].name, barrel, "", xyz, rpy, _Y)]
    else:
        links.append(Link(cross, "", composite_joint=f"{name}_pin"))
        pins = [
            Joint(f"{name}_pin_y", "revolute", links[0].name, cross, "", xyz, rpy, _Y),
            Joint(f"{name}_pin_z", "revolute", cross, barrel, "", axis=_Z),
        ]
    links += [Link(barrel, "", cylinder.barrel_inertial), Link(rod, "", cylinder.rod_inertial)]
    limits = Limits(0.0, cylinder.stroke, cylinder.max_force)
    rod_origin = to_vector(np.array([cylinder.retracted_length, 0, 0]))
    slide = Joint(name, "prismatic", barrel, rod, "", rod_origin, axis=_X, limits=limits)
    for link in links:
        add_link(robot, link)
    cylinder.add_visuals(*(element for element in robot.findall("link")[-2:]))
    for joint in (*pins, slide):
        add_joint(robot, joint)
    return robot
