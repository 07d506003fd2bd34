"""Elements of SDF and the values in their texts."""

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import DescriptionError
from crane.description.pinocchio_conversion import rotation_from_rpy
from crane.description.specification import unit_vector
from crane.formats.xml_file import XmlFile

_QUATERNION = "quat_xyzw"


@dataclass(frozen=True)
class SdfElement:
    """An element of SDF in its file.

    Attributes:
        xml: The file.
        element: The element.
        label: Name of the element in errors.
        base_frame: The frame that its poses are relative to by default.
    """

    xml: XmlFile
    element: etree._Element
    label: str
    base_frame: str = "__model__"

    @property
    def source_location(self) -> str:
        """File and line."""
        return self.xml.source_location(self.element)

    @property
    def name(self) -> str:
        """Its name, "" without one."""
        return self.attribute("name")

    def attribute(self, key: str) -> str:
        """Return an attribute without surrounding blanks, "" if there is none."""
        return str(self.element.get(key, "")).strip()

    def error(self, problem: str) -> DescriptionError:
        """Return an error with the source location of the element."""
        return self.xml.error_at(self.element, problem)

    def wrap(self, element: etree._Element, label: str) -> "SdfElement":
        """Return another element of the same file with the same base frame."""
        return SdfElement(self.xml, element, label, self.base_frame)

    def single_child(self, tag: str) -> "SdfElement | None":
        """Return the child with a tag, None if there is none.

        Raises:
            DescriptionError: There are several.
        """
        child = self.xml.single_child(self.element, tag, self.label)
        return None if child is None else self.wrap(child, self.label)

    def text(self, tag: str, default: str = "") -> str:
        """Return the text of a child."""
        child = self.single_child(tag)
        return default if child is None else (child.element.text or "").strip() or default

    def is_true(self, tag: str) -> bool:
        """Whether the text of a child is true."""
        return self.text(tag).lower() in ("true", "1")

    def numbers(self, tag: str, count: int, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return the numbers in the text of a child.

        Args:
            tag: Tag of the child.
            count: How many numbers there have to be.
            default: Result without a child or text.

        Raises:
            DescriptionError: The text is something else.
        """
        child = self.single_child(tag)
        if child is None or not (child.element.text or "").strip():
            return default
        return child.parse_numbers(count, f"<{tag}>")

    def number(self, tag: str, default: float) -> float:
        """Return the number in the text of a child, which may be `inf`; see `numbers`."""
        text = self.text(tag).lower()
        if text.lstrip("+-") in ("inf", "infinity"):
            return -math.inf if text.startswith("-") else math.inf
        return self.numbers(tag, 1, (default,))[0]

    def parse_numbers(self, count: int, description: str) -> tuple[float, ...]:
        """Return the numbers in the text of this element."""
        text = self.element.text or ""
        return self.xml.parse_numbers(self.element, text, f"{description} of {self.label}", count)

    def direction(self, tag: str) -> np.ndarray:
        """Return the unit vector (3,) of a child, z without one.

        Raises:
            DescriptionError: It is zero or malformed.
        """
        unit = unit_vector(self.numbers(tag, 3, (0.0, 0.0, 1.0)))
        if unit is None:
            raise self.error(f"the axis of {self.label} is zero, give a direction")
        return np.array(unit)

    def read_pose(self) -> tuple[pin.SE3, str]:
        """Return the pose, and the frame that it is relative to, "" for the default."""
        child = self.single_child("pose")
        if child is None:
            return pin.SE3.Identity(), ""
        attributes = child.element.attrib
        relative_frame = attributes.get("relative_to", attributes.get("frame", "")).strip()
        if not (child.element.text or "").strip():
            return pin.SE3.Identity(), relative_frame
        if attributes.get("rotation_format") == _QUATERNION:
            *xyz, qx, qy, qz, qw = child.parse_numbers(7, "<pose>")
            length = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
            if length == 0:
                raise child.error(f"the pose of {self.label} has no rotation")
            quaternion = pin.Quaternion(qw / length, qx / length, qy / length, qz / length)
            return pin.SE3(quaternion.toRotationMatrix(), np.array(xyz)), relative_frame
        x, y, z, *angles = child.parse_numbers(6, "<pose>")
        if attributes.get("degrees", "").lower() in ("true", "1"):
            angles = [math.radians(angle) for angle in angles]
        roll, pitch, yaw = angles
        return pin.SE3(rotation_from_rpy((roll, pitch, yaw)), np.array([x, y, z])), relative_frame
