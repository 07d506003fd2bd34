"""Elements of written MJCF: placements, inertias, tendons, couplings, struts without mass."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import InputError, warn
from crane.description.kinematic_tree import unique_name
from crane.description.specification import Coupling, LoopSpec
from crane.formats.xml_file import format_numbers
from crane.machine.machine import Machine

_ROUNDING_TOLERANCE = 1e-9  # relative to the largest moment
_MIN_MOMENT = 1e-14  # [kg m2] smallest moment of inertia that MuJoCo accepts


def solve_polynomial(coupling: Coupling) -> tuple[list[str], list[float]]:
    """Return follower and leader of a coupling with powers, and its five coefficients.

    Raises:
        InputError: It is no polynomial of one joint.
    """
    factors, (leader, *others) = coupling.factors, coupling.powers
    followers = [joint for joint in coupling.joints if joint != leader]
    if others or len(followers) != 1:
        raise InputError(
            f"coupling '{coupling.name}' is no polynomial of one joint, for which alone MJCF has "
            "a constraint, write a machine file"
        )
    terms = [-coupling.offset, factors.get(leader, 0.0), *coupling.powers[leader]]
    return [*followers, leader], [-x / factors[followers[0]] + 0.0 for x in terms]


def add_tendon(tendons: etree._Element, tag: str, name: str) -> etree._Element:
    """Add a tendon under a unique name."""
    used_names = {tendon.get("name") for tendon in tendons}
    return etree.SubElement(tendons, tag, name=unique_name(name, used_names))


def add_fixed_tendon(tendons: etree._Element, name: str, factors: Mapping[str, float]) -> str:
    """Add a fixed tendon, and return its name."""
    tendon = add_tendon(tendons, "fixed", name)
    for joint, factor in factors.items():
        etree.SubElement(tendon, "joint", joint=joint, coef=format_numbers([factor]))
    return str(tendon.get("name"))


def placement_attributes(placement: pin.SE3) -> dict[str, str]:
    """Return the attributes of a placement that differ from the default."""
    found = {}
    if placement.translation.any():
        found["pos"] = format_numbers(placement.translation)
    if not np.array_equal(placement.rotation, np.eye(3)):
        x, y, z, w = pin.Quaternion(placement.rotation).normalize().coeffs()
        found["quat"] = format_numbers([w, x, y, z])
    return found


def add_inertial(body: etree._Element, inertia: pin.Inertia) -> None:
    """Add principal moments and axes; MuJoCo requires positive, physically feasible moments."""
    moments, axes = np.linalg.eigh(inertia.inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    moments = np.maximum(moments, _MIN_MOMENT)
    violation = moments[2] - moments[0] - moments[1]
    if violation > _ROUNDING_TOLERANCE * moments[2]:
        warn(
            f"the inertia of '{body.get('name')}' is of no possible body by {violation:.2g} kg "
            "m2, which MuJoCo refuses: two moments are written larger",
            stacklevel=5,
        )
    if violation > 0:
        moments[:2] += (0.5 + 1e-15) * violation
    values = {"pos": format_numbers(inertia.lever), "mass": format_numbers([inertia.mass])}
    values |= placement_attributes(pin.SE3(axes, np.zeros(3)))
    etree.SubElement(body, "inertial", {**values, "diaginertia": format_numbers(moments)})


_KINDS = {  # kinds of the three joints, from the base on, and whether they are of a slider-crank
    ("revolute", "revolute", "prismatic"): False,
    ("prismatic", "revolute", "revolute"): True,
}


@dataclass(frozen=True)
class MasslessStrut:
    """Three joints in series without mass that a spherical loop closes.

    Attributes:
        joint: Name of its prismatic joint.
        joints: Pinocchio's indices of its joints.
        base: Link that carries it, whose frame is that of its first joint.
        loop: The loop.
        rod_length: Length of the rod of a slider-crank [m]; 0 of a strut of variable length.
    """

    joint: str
    joints: tuple[int, ...]
    base: str
    loop: LoopSpec
    rod_length: float


def find_massless_struts(machine: Machine) -> dict[str, MasslessStrut]:
    """Return the struts and slider-cranks of a machine by their prismatic joints.

    They are as `crane.formats.mjcf.actuator_cylinders` makes them: the axes of their revolute
    joints meet on the line of the prismatic joint, and nothing else hangs on them.
    """
    found = (_strut_of_loop(machine, loop) for loop in machine.closure.equations.loops)
    return {strut.joint: strut for strut in found if strut is not None}


def _strut_of_loop(machine: Machine, loop: LoopSpec) -> MasslessStrut | None:
    model, tree = machine.model, machine.tree
    frame = model.frames[machine.frame(loop.predecessor)]
    joints: list[int] = [int(frame.parentJoint)]
    while joints[0] and len(joints) < 3:
        joints.insert(0, int(model.parents[joints[0]]))
    parts = [tree.joints[model.names[i]] for i in joints if model.names[i] in tree.joints]
    kinds = tuple(part.kind for part in parts)
    if loop.type != "spherical" or kinds not in _KINDS:
        return None
    is_crank = _KINDS[kinds]
    other_children = [i for i in range(1, model.njoints)
                      if model.parents[i] in joints and i not in joints]  # fmt: skip
    has_mass = any(model.inertias[i].mass for i in joints)
    rod = np.array(frame.placement.translation)
    is_apart = any(model.jointPlacements[i].translation.any() for i in joints[1:])
    first = parts[0]
    is_turned = is_crank and (any(first.rpy) or tuple(first.axis) != (0.0, 0.0, 1.0))
    is_other = rod.any() != is_crank
    if other_children or has_mass or is_apart or is_turned or any(first.xyz) or is_other:
        return None
    return MasslessStrut(
        parts[0 if is_crank else 2].name,
        tuple(joints),
        first.parent,
        loop,
        float(np.linalg.norm(rod)),
    )
