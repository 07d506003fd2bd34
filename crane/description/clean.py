"""Writing the clean `<robot>` that a machine is assembled from, as reading a URDF does."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from lxml import etree

_TENSOR = {
    "ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2),
}  # fmt: skip


def text(values: Sequence[float] | np.ndarray) -> str:
    """Numbers with blanks between, exactly as they are."""
    return " ".join(repr(float(value) + 0.0) for value in np.ravel(values))


def add_origin(element: etree._Element, place: pin.SE3) -> None:
    """`<origin>` of a placement."""
    rpy = pin.rpy.matrixToRpy(place.rotation)
    etree.SubElement(element, "origin", xyz=text(place.translation), rpy=text(rpy))


def add_link(robot: etree._Element, name: str, inertia: pin.Inertia | None = None) -> None:
    """A link, with an inertial along the axes of its frame."""
    link = etree.SubElement(robot, "link", name=name)
    if inertia is None or not inertia.mass:
        return
    inertial = etree.SubElement(link, "inertial")
    etree.SubElement(inertial, "origin", xyz=text(inertia.lever), rpy="0.0 0.0 0.0")
    etree.SubElement(inertial, "mass", value=text([inertia.mass]))
    tensor = {key: text([inertia.inertia[at]]) for key, at in _TENSOR.items()}
    etree.SubElement(inertial, "inertia", tensor)


def add_joint(
    robot: etree._Element,
    name: str,
    kind: str,
    place: pin.SE3,
    ends: tuple[str, str],
    axis: Sequence[float] | np.ndarray | None = None,
) -> etree._Element:
    """A joint of a type of URDF between parent and child link."""
    joint = etree.SubElement(robot, "joint", name=name, type=kind)
    add_origin(joint, place)
    etree.SubElement(joint, "parent", link=ends[0])
    etree.SubElement(joint, "child", link=ends[1])
    if axis is not None:
        etree.SubElement(joint, "axis", xyz=text(axis))
    return joint
