"""Elements of written MJCF: placements, inertias, tendons and coefficients of couplings."""

from collections.abc import Mapping

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import InputError, warn
from crane.description.kinematic_tree import unique_name
from crane.description.specification import Coupling
from crane.formats.xml_file import format_numbers

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
