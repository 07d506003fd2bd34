"""Barrel and rod hung between two eyes of a machine that is being written, closed by a loop."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.samples import Array
from crane.description.rigid import placement, vector
from crane.description.tree import Joint, Limits, Link
from crane.formats.adding.eyes import Eye, apart, path_between
from crane.formats.adding.steel import SteelCylinder
from crane.formats.machine_file.write import Draft
from crane.formats.parts import add_joint, add_link
from crane.machine import Machine

_SAME = 1e-6  # share of a cylinder's length that is none
_PARALLEL = 1e-9  # sine of an angle that is none: what is less exact gets a universal joint
_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def hung(
    draft: Draft,
    machine: Machine,
    name: str,
    eyes: Sequence[Eye],
    steel: SteelCylinder,
    q: Array,
) -> list[str]:
    """Barrel and rod as a chain, the loop that closes it, and the home posture q (nq,)."""
    notes = []
    way = apart(machine, eyes, q)
    normal = _normal(machine, eyes, q, way)
    planar = normal is not None and bool(abs(way @ normal) <= steel.bore)
    if normal is not None and planar:
        offset = float(way @ normal)
        if abs(offset) > _SAME * steel.retracted:
            notes.append(f"the rod's eye moved {1e3 * abs(offset):.4g} mm along its pin, into the "
                         "plane of the barrel's")  # fmt: skip
        way = way - offset * normal
    length = float(np.linalg.norm(way))
    along = way / length
    if normal is None or abs(along @ normal) > 0.9:
        normal = np.eye(3)[np.abs(along).argmin()]
    across = normal - (normal @ along) * along
    across /= np.linalg.norm(across)
    turn = np.column_stack([along, across, np.cross(along, across)])
    barrel, rod = (eye.place(machine, q) for eye in eyes)
    mount = pin.SE3(turn, barrel.translation)
    seat = pin.SE3(turn, barrel.translation + way)
    base = pin.SE3(np.eye(3), np.array(eyes[0].point)) * barrel.actInv(mount)
    eye = pin.SE3(np.eye(3), np.array(eyes[1].point)) * rod.actInv(seat)
    _put_eye(draft.robot_of(eyes[1].link), name, eyes[1].link, eye)
    draft.add_chain(name, _chain(name, steel, base, planar), {"parent": eyes[0].link})
    draft.data["loops"].append(
        {
            "name": name,
            "type": "revolute" if planar else "spherical",
            "predecessor": f"{name}_rod",
            "successor": f"{name}_eye",
            "axis": list(_Y),
        }
    )
    home = dict(zip(machine.joints, q.tolist(), strict=True))
    pins = [f"{name}_pin"] if planar else [f"{name}_pin_y", f"{name}_pin_z"]
    draft.data["home"] = home | dict.fromkeys(pins, 0.0) | {name: length - steel.retracted}
    return notes


def _normal(machine: Machine, eyes: Sequence[Eye], q: Array, way: Array) -> Array | None:
    """(3,) normal of the plane in which two bodies move against each other, None for space."""
    data = machine.model.createData()
    at = machine.coordinates.configuration(q)
    jacobian = pin.computeJointJacobians(machine.model, data, at).reshape(6, -1)
    turning, sliding = [], []
    for joint in path_between(machine, eyes[0].link, eyes[1].link):
        column = jacobian[:, machine.column(joint.name)]
        if joint.kind == "revolute":
            turning.append(column[3:])
        else:
            sliding.append(column[:3])
    if turning:
        normal = turning[0]
    else:
        crosses = [np.cross(way, axis) for axis in sliding]
        normal = max(crosses, key=lambda cross: float(np.linalg.norm(cross)))
        if np.linalg.norm(normal) < _PARALLEL * np.linalg.norm(way):
            normal = np.cross(way, np.eye(3)[np.abs(way).argmin()])
        normal = normal / np.linalg.norm(normal)
    off = [float(np.linalg.norm(np.cross(axis, normal))) for axis in turning]
    off += [abs(float(axis @ normal)) for axis in sliding]
    return None if max(off) > _PARALLEL else np.asarray(normal)


def _put_eye(robot: etree._Element, name: str, link: str, place: pin.SE3) -> None:
    """A frame of a link for the rod's eye."""
    xyz, rpy = placement(place)
    add_link(robot, Link(f"{name}_eye", ""))
    add_joint(robot, Joint(f"{name}_eye", "fixed", link, f"{name}_eye", "", xyz, rpy))


def _chain(name: str, steel: SteelCylinder, base: pin.SE3, planar: bool) -> etree._Element:
    """The URDF of barrel and rod; x points from the barrel's eye to the rod's, y is a pin."""
    robot = etree.Element("robot", name=name)
    barrel, cross, rod = (f"{name}_{part}" for part in ("barrel", "cross", "rod"))
    xyz, rpy = placement(base)
    links = [Link(f"{name}_base", "")]
    if planar:
        pins = [Joint(f"{name}_pin", "revolute", links[0].name, barrel, "", xyz, rpy, _Y)]
    else:
        links.append(Link(cross, "", between=f"{name}_pin"))
        pins = [
            Joint(f"{name}_pin_y", "revolute", links[0].name, cross, "", xyz, rpy, _Y),
            Joint(f"{name}_pin_z", "revolute", cross, barrel, "", axis=_Z),
        ]
    links += [Link(barrel, "", steel.barrel), Link(rod, "", steel.piston_rod)]
    limits = Limits(0.0, steel.stroke, steel.effort)
    at = vector(np.array([steel.retracted, 0, 0]))
    slide = Joint(name, "prismatic", barrel, rod, "", at, axis=_X, limits=limits)
    for link in links:
        add_link(robot, link)
    steel.draw(*(element for element in robot.findall("link")[-2:]))
    for joint in (*pins, slide):
        add_joint(robot, joint)
    return robot
