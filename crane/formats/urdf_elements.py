"""Elements of URDF, written from links and joints."""

import math
from collections.abc import Sequence

import numpy as np
from lxml import etree

from crane.description.kinematic_tree import NO_LIMIT, Inertial, Joint, Limits, Link, Vector
from crane.description.specification import AXISLESS_TYPES

TENSOR_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def format_numbers(values: Sequence[float] | np.ndarray) -> str:
    """Return numbers in full precision, separated by blanks."""
    return " ".join(repr(float(value) + 0.0) for value in np.ravel(values))


def finite_limits(limits: Limits) -> tuple[float, float] | None:
    """Return lower and upper limit as written in files, None for a joint without limits."""
    if math.isinf(limits.lower) and math.isinf(limits.upper):
        return None
    return max(limits.lower, -NO_LIMIT), min(limits.upper, NO_LIMIT)


def add_origin(element: etree._Element, xyz: Vector, rpy: Vector) -> None:
    """Add an `<origin>`."""
    etree.SubElement(element, "origin", xyz=format_numbers(xyz), rpy=format_numbers(rpy))


def add_inertial(link: etree._Element, inertial: Inertial) -> None:
    """Add an `<inertial>`."""
    element = etree.SubElement(link, "inertial")
    add_origin(element, inertial.com, inertial.rpy)
    etree.SubElement(element, "mass", value=format_numbers([inertial.mass]))
    tensor = zip(TENSOR_ATTRIBUTES, inertial.tensor, strict=True)
    etree.SubElement(element, "inertia", {key: format_numbers([value]) for key, value in tensor})


def add_link(robot: etree._Element, link: Link) -> etree._Element:
    """Add a `<link>` with its inertial."""
    element = etree.SubElement(robot, "link", name=link.name)
    if link.composite_joint is not None:
        element.set("between", link.composite_joint)
    if link.inertial is not None:
        add_inertial(element, link.inertial)
    return element


def add_joint(robot: etree._Element, joint: Joint) -> etree._Element:
    """Add a `<joint>` with its limits.

    A revolute joint without limits is continuous. URDF requires both limits of a prismatic joint
    and of a joint that is limited on one side; 1e9 stands for no limit and is read as such.
    """
    limits = joint.limits
    limit_values = finite_limits(limits)
    is_continuous = limit_values is None and joint.kind == "revolute"
    element = etree.SubElement(
        robot, "joint", name=joint.name, type=("continuous" if is_continuous else joint.kind)
    )
    add_origin(element, joint.xyz, joint.rpy)
    etree.SubElement(element, "parent", link=joint.parent)
    etree.SubElement(element, "child", link=joint.child)
    if joint.kind in AXISLESS_TYPES:
        return element
    etree.SubElement(element, "axis", xyz=format_numbers(joint.axis))
    values = {key: min(getattr(limits, key), NO_LIMIT) for key in ("effort", "velocity")}
    if not is_continuous:
        lower, upper = limit_values or (-NO_LIMIT, NO_LIMIT)
        values = {"lower": lower, "upper": upper} | values
    elif math.isinf(limits.effort) and math.isinf(limits.velocity):
        return element
    etree.SubElement(
        element, "limit", {key: format_numbers([value]) for key, value in values.items()}
    )
    return element


def add_friction(joint: etree._Element, viscous: float, coulomb: float) -> None:
    """Add the `<dynamics>` of a joint that has Coulomb or viscous friction."""
    if viscous or coulomb:
        etree.SubElement(
            joint,
            "dynamics",
            {"damping": format_numbers([viscous]), "friction": format_numbers([coulomb])},
        )
