"""Hydraulic cylinders of steel: masses and shapes from bore, rod and stroke, links and loop."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import CraneWarning, InputError
from crane.common.plausible_ranges import LONGEST, implausible_value_text, suggested_units_text
from crane.common.samples import Array, as_number
from crane.description.kinematic_tree import Inertial, Joint, Limits, Link
from crane.description.pinocchio_conversion import (
    inertial_from_inertia,
    to_vector,
    xyz_rpy_from_se3,
)
from crane.formats.additions.attachment_points import (
    AttachmentPoint,
    joints_between,
    vector_between,
)
from crane.formats.machine_file.machine_writer import MachineDraft
from crane.formats.xml_file import add_joint, add_link, format_numbers
from crane.machine.machine import Machine

STEEL_DENSITY = 7850.0  # [kg/m3]
RELIEF_PRESSURE = 35e6  # [Pa] usual in mobile machines; determines the effort of the joint
_WALL_SHARE = 0.1  # of the bore: at 35 MPa the stress in the tube is 35 / 0.2 MPa


@dataclass(frozen=True)
class SteelCylinder:
    """A tube with a cap at its eye and a gland at the other end, and a rod with a piston.

    Cap, piston, gland and the outer part of the rod have the length `part_length` each: one bore,
    or a fourth of the retracted length without the stroke if that is less. The wall of the tube is
    a tenth of the bore. All parts are steel of 7850 kg/m3; oil is neglected.

    Attributes:
        bore: D, inner diameter of the tube [m].
        rod: d, diameter of the rod [m].
        stroke: S [m].
        retracted_length: L0, pin to pin with the rod retracted [m]; S + 4 D by default.

    Raises:
        InputError: A length is not positive, or the parts do not fit into each other.
    """

    bore: float
    rod: float
    stroke: float
    retracted_length: float

    def __post_init__(self) -> None:
        if self.rod >= self.bore:
            raise InputError(
                f"the rod of {self.rod:g} m does not fit into the bore of {self.bore:g} m, "
                "choose a thinner one"
            )
        if self.retracted_length <= self.stroke:
            raise InputError(
                f"the dead length of {self.retracted_length:g} m is pin to pin with the rod in, "
                f"it has to be more than the stroke of {self.stroke:g} m"
            )

    @classmethod
    def from_dimensions(
        cls, bore: float, rod: float, stroke: float, dead_length: float | None = None
    ) -> "SteelCylinder":
        """Return a cylinder from dimensions of a user, which are checked."""
        dimensions = {"bore": bore, "rod": rod, "stroke": stroke}
        if dead_length is not None:
            dimensions["dead length"] = dead_length
        for label, value in dimensions.items():
            if as_number(value, f"the {label}", "m") <= 0:
                raise InputError(f"the {label} is {value:g} m, it must be positive")
            range_name = "stroke" if label == "dead length" else label
            if value > LONGEST:
                unit_hint = (
                    suggested_units_text(range_name, value)
                    or ", longer than any part of a machine, give metres"
                )
                raise InputError(f"the {label} is {value:g} m{unit_hint}")
            if warning := implausible_value_text(range_name, value):
                warnings.warn(f"the {label} {warning}", CraneWarning, stacklevel=4)
        bore, rod, stroke = float(bore), float(rod), float(stroke)
        return cls(bore, rod, stroke, stroke + 4 * bore if dead_length is None else dead_length)

    @property
    def part_length(self) -> float:
        """Length of cap, piston, gland and the outer part of the rod [m]."""
        return min(self.bore, (self.retracted_length - self.stroke) / 4)

    @property
    def max_force(self) -> float:
        """Force at `RELIEF_PRESSURE` on the piston [N]."""
        return RELIEF_PRESSURE * math.pi / 4 * self.bore**2

    @property
    def barrel_inertial(self) -> Inertial:
        """Inertial of tube, cap and gland; x points from the barrel's eye to the rod's."""
        barrel_end, part = self.retracted_length - self.part_length, self.part_length
        return _total_inertial(
            _tube_inertia(0, barrel_end, self.bore, (1 + 2 * _WALL_SHARE) * self.bore),
            _tube_inertia(0, part, 0, self.bore),
            _tube_inertia(barrel_end - part, barrel_end, self.rod, self.bore),
        )

    @property
    def rod_inertial(self) -> Inertial:
        """Inertial of rod and piston in the rod's eye, with x as for the barrel."""
        back = 2 * self.part_length - self.retracted_length
        return _total_inertial(
            _tube_inertia(back, 0, 0, self.rod),
            _tube_inertia(back - self.part_length, back, 0, self.bore),
        )

    def add_visuals(self, barrel_link: etree._Element, rod_link: etree._Element) -> None:
        """Add cylinders of the true diameters to two `<link>` elements."""
        _add_cylinder_visual(
            barrel_link,
            0,
            self.retracted_length - self.part_length,
            (1 + 2 * _WALL_SHARE) * self.bore,
        )
        _add_cylinder_visual(rod_link, 2 * self.part_length - self.retracted_length, 0, self.rod)


def _tube_inertia(start: float, end: float, inner: float, outer: float) -> pin.Inertia:
    """Return the inertia of a tube along x with two diameters [m]."""
    length, squares = end - start, (inner**2 + outer**2) / 4
    mass = STEEL_DENSITY * math.pi / 4 * (outer**2 - inner**2) * length
    transverse_moment = mass * (3 * squares + length**2) / 12
    tensor = np.diag([mass * squares / 2, transverse_moment, transverse_moment])
    return pin.Inertia(mass, np.array([(start + end) / 2, 0, 0]), tensor)


def _total_inertial(*inertias: pin.Inertia) -> Inertial:
    whole = inertias[0]
    for part in inertias[1:]:
        whole = whole + part
    found = inertial_from_inertia(whole)
    assert found is not None
    return found


def _add_cylinder_visual(link: etree._Element, start: float, end: float, diameter: float) -> None:
    visual = etree.SubElement(link, "visual")
    etree.SubElement(
        visual,
        "origin",
        xyz=format_numbers([(start + end) / 2, 0, 0]),
        rpy=format_numbers([0, math.pi / 2, 0]),
    )
    geometry = etree.SubElement(visual, "geometry")
    etree.SubElement(
        geometry,
        "cylinder",
        radius=format_numbers([diameter / 2]),
        length=format_numbers([end - start]),
    )


_OFFSET_TOLERANCE = 1e-6  # relative to the cylinder's length
_PARALLEL_TOLERANCE = 1e-9  # sine of an angle; a larger deviation gets a universal joint
_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def add_barrel_and_rod(
    draft: MachineDraft,
    machine: Machine,
    name: str,
    points: Sequence[AttachmentPoint],
    cylinder: SteelCylinder,
    q: Array,
) -> list[str]:
    """Add barrel and rod as a chain with its loop and the home configuration q (nq,).

    Returns:
        Notes on changes of the attachment points.
    """
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
    barrel_placement, rod_placement = (point.placement(machine, q) for point in points)
    barrel_frame = pin.SE3(rotation, barrel_placement.translation)
    rod_frame = pin.SE3(rotation, barrel_placement.translation + axis_vector)
    base_in_link = pin.SE3(np.eye(3), np.array(points[0].point)) * barrel_placement.actInv(
        barrel_frame
    )
    eye_in_link = pin.SE3(np.eye(3), np.array(points[1].point)) * rod_placement.actInv(rod_frame)
    rod_robot, eye = draft.urdf_of_link(points[1].link), f"{name}_eye"
    add_link(rod_robot, Link(eye, ""))
    add_joint(
        rod_robot, Joint(eye, "fixed", points[1].link, eye, "", *xyz_rpy_from_se3(eye_in_link))
    )
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
    """Return the normal (3,) of the plane of relative motion of two bodies, None if spatial."""
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


def _cylinder_urdf(
    name: str, cylinder: SteelCylinder, base_placement: pin.SE3, is_planar: bool
) -> etree._Element:
    """Return the URDF of barrel and rod; x points from the barrel's eye to the rod's."""
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
