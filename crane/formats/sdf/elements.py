"""Elements of URDF made of numbers."""

import math

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.description.rigid import placement
from crane.description.tree import NO_LIMIT
from crane.formats.sdf.joints import Axis


def is_limited(axis: Axis) -> bool:
    """Whether an axis has a limit."""
    return math.isfinite(axis.lower) or math.isfinite(axis.upper)


def add_origin(element: etree._Element, place: pin.SE3) -> None:
    """`<origin>` of a place."""
    xyz, rpy = placement(place)
    etree.SubElement(element, "origin", xyz=_text(xyz), rpy=_text(rpy))


def add_axis(element: etree._Element, direction: np.ndarray) -> None:
    """`<axis>` of a direction (3,)."""
    etree.SubElement(element, "axis", xyz=_text(direction))


def add_limit(joint: etree._Element, axis: Axis) -> None:
    """`<limit>` of a joint, 1e9 where there is none."""
    values = {"effort": axis.effort, "velocity": axis.velocity}
    if joint.get("type") != "continuous":
        values |= {"lower": axis.lower, "upper": axis.upper}
    elif all(map(math.isinf, values.values())):
        return
    ends = {key: repr(min(max(x, -NO_LIMIT), NO_LIMIT)) for key, x in values.items()}
    etree.SubElement(joint, "limit", ends)


def add_dynamics(joint: etree._Element, axis: Axis) -> None:
    """`<dynamics>` of a joint that has friction."""
    if axis.damping or axis.friction:
        values = {"damping": repr(axis.damping), "friction": repr(axis.friction)}
        etree.SubElement(joint, "dynamics", values)


def _text(values: tuple[float, ...] | np.ndarray) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)
