"""Elements of URDF made of numbers."""

import math

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.description.kinematic_tree import NO_LIMIT
from crane.description.pinocchio_conversion import xyz_rpy_from_se3
from crane.formats.sdf.sdf_joints import SdfAxis


def is_limited(axis: SdfAxis) -> bool:
    """Whether an axis has a limit."""
    return math.isfinite(axis.lower) or math.isfinite(axis.upper)


def add_origin(element: etree._Element, placement: pin.SE3) -> None:
    """`<origin>` of a place."""
    xyz, rpy = xyz_rpy_from_se3(placement)
    etree.SubElement(element, "origin", xyz=_format_numbers(xyz), rpy=_format_numbers(rpy))


def add_axis(element: etree._Element, direction: np.ndarray) -> None:
    """`<axis>` of a direction (3,)."""
    etree.SubElement(element, "axis", xyz=_format_numbers(direction))


def add_limit(joint: etree._Element, axis: SdfAxis) -> None:
    """`<limit>` of a joint, 1e9 where there is none."""
    values = {"effort": axis.effort, "velocity": axis.velocity}
    if joint.get("type") != "continuous":
        values |= {"lower": axis.lower, "upper": axis.upper}
    elif all(map(math.isinf, values.values())):
        return
    ends = {key: repr(min(max(x, -NO_LIMIT), NO_LIMIT)) for key, x in values.items()}
    etree.SubElement(joint, "limit", ends)


def add_dynamics(joint: etree._Element, axis: SdfAxis) -> None:
    """`<dynamics>` of a joint that has friction."""
    if axis.damping or axis.friction:
        values = {"damping": repr(axis.damping), "friction": repr(axis.friction)}
        etree.SubElement(joint, "dynamics", values)


def _format_numbers(values: tuple[float, ...] | np.ndarray) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)
