"""Values of SDF, which stand as text in elements."""

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from lxml import etree

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
        label: What it is, for errors.
        base_frame: The frame that its poses are relative to if they say nothing.
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
        """Its name, empty without one."""
        return str(self.element.get("name", "")).strip()

    def single_child(self, tag: str) -> "SdfElement | None":
        """The child with a tag, if there is one.

        Raises:
            DescriptionError: There are several.
        """
        child = self.xml.single_child(self.element, tag, self.label)
        return None if child is None else SdfElement(self.xml, child, self.label, self.base_frame)

    def text(self, tag: str, default: str = "") -> str:
        """Text of a child."""
        child = self.single_child(tag)
        return default if child is None else (child.element.text or "").strip() or default

    def is_true(self, tag: str) -> bool:
        """Whether a child says so."""
        return self.text(tag).lower() in ("true", "1")

    def numbers(self, tag: str, count: int, default: tuple[float, ...]) -> tuple[float, ...]:
        """Finite numbers of a child.

        Raises:
            DescriptionError: There are others.
        """
        child = self.single_child(tag)
        if child is None or not (child.element.text or "").strip():
            return default
        return child.parse_numbers(count, f"<{tag}>")

    def number(self, tag: str, default: float) -> float:
        """A number of a child, infinite for what SDF calls so, as `numbers`."""
        text = self.text(tag).lower()
        if text.lstrip("+-") in ("inf", "infinity"):
            return -math.inf if text.startswith("-") else math.inf
        return self.numbers(tag, 1, (default,))[0]

    def parse_numbers(self, count: int, description: str) -> tuple[float, ...]:
        """The numbers in its own text."""
        text = self.element.text or ""
        return self.xml.parse_numbers(self.element, text, f"{description} of {self.label}", count)

    def direction(self, tag: str) -> np.ndarray:
        """Unit vector (3,) of a child, z without one.

        Raises:
            DescriptionError: It is zero or malformed.
        """
        unit = unit_vector(self.numbers(tag, 3, (0.0, 0.0, 1.0)))
        if unit is None:
            raise self.xml.error_at(
                self.element, f"the axis of {self.label} is zero, give a direction"
            )
        return np.array(unit)

    def read_pose(self) -> tuple[pin.SE3, str]:
        """Its `<pose>` and the frame that this is relative to, empty where it does not say."""
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
                raise self.xml.error_at(child.element, f"the pose of {self.label} has no rotation")
            quaternion = pin.Quaternion(qw / length, qx / length, qy / length, qz / length)
            return pin.SE3(quaternion.toRotationMatrix(), np.array(xyz)), relative_frame
        x, y, z, *angles = child.parse_numbers(6, "<pose>")
        if attributes.get("degrees", "").lower() in ("true", "1"):
            angles = [math.radians(angle) for angle in angles]
        roll, pitch, yaw = angles
        return pin.SE3(rotation_from_rpy((roll, pitch, yaw)), np.array([x, y, z])), relative_frame
