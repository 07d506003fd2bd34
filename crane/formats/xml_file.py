"""Strict reading of XML, and writing of the elements of URDF.

Reading expands no entities, has no network access, and names source locations in all errors.
"""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from lxml import etree

from crane.common.errors import DescriptionError, check_name, suggest_names, warn
from crane.common.number_text import parse_float
from crane.common.package_search import read_plain_file
from crane.description.findings import report_error
from crane.description.kinematic_tree import (
    NO_LIMIT,
    TENSOR_ATTRIBUTES,
    X_AXIS,
    Inertial,
    Joint,
    Limits,
    Link,
    Placement,
    Vector,
)
from crane.description.specification import AXISLESS_TYPES, unit_vector

MAX_FILE_SIZE = 50_000_000  # bytes
_ROOT_ELEMENTS = {  # by suffix, if not a <robot>
    ".sdf": "an <sdf>", ".world": "an <sdf>", ".mjcf": "a <mujoco>",
    ".xml": "a <robot>, an <sdf> or a <mujoco>",
}  # fmt: skip
_MAX_LINE_NUMBER = 1 << 16
_MAX_VALUE_LENGTH = 60  # characters shown
_REPEATABLE_ELEMENTS = {"link", "joint", "loop", "visual", "collision"}


def set_source_location(element: etree._Element, location: str, locations: dict[str, int]) -> None:
    """Set the source location of an element of an `XmlFile` whose parts come from several files.

    Args:
        element: The element.
        location: File and line.
        locations: Index of each location; the first is that of elements without another.
    """
    number = locations.setdefault(location, len(locations))
    element.sourceline = number if number < _MAX_LINE_NUMBER else 0  # 16 bits in libxml2


def _read_root(file: Path) -> etree._Element:
    """Read the root element of a file, without comments.

    <!DOCTYPE> is refused, because its entities can expand without bounds or read other files.
    """
    try:
        data = read_plain_file(file, MAX_FILE_SIZE)
    except OSError as error:
        raise DescriptionError(
            f"{file}: cannot be read ({error.strerror}), check the path"
        ) from None
    if not data.strip():
        element = _ROOT_ELEMENTS.get(file.suffix.lower(), "a <robot>")
        raise DescriptionError(f"{file.name}: the file is empty, write {element} in it")
    if b"encoding" not in data[:200] and not data.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as error:
            line = data.count(b"\n", 0, error.start) + 1
            raise DescriptionError(
                f"{file.name}:{line}: not UTF-8, save it as UTF-8 or declare its encoding"
            ) from None
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, remove_comments=True, remove_pis=True
    )
    line = data.count(b"\n", 0, max(data.find(b"<!DOCTYPE"), 0)) + 1
    document_type_error = DescriptionError(
        f"{file.name}:{line}: <!DOCTYPE> is not supported, remove it"
    )
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        if b"<!DOCTYPE" in data or re.search("amplification|reference loop", error.msg or ""):
            raise document_type_error from None
        text = (error.msg or "broken").splitlines()[0].split(", line")[0].rstrip(" !")
        raise DescriptionError(
            f"{file.name}:{error.lineno or 1}: not XML, {text}, correct it"
        ) from None
    if root.getroottree().docinfo.doctype:
        raise document_type_error
    return root


class XmlFile:
    """An XML file.

    Args:
        file: The file.
        root: Its root element if the file was expanded; else the file is read.
        locations: Source locations if elements come from several files.

    Attributes:
        file: The file.
        root: Its root element, without comments.
        unnamed_kinds: Tags of elements of which one has no unique name.
        locations: As given; `sourceline` of an element is then an index in this list.

    Raises:
        DescriptionError: The file cannot be read, is not XML, or has a document type.
    """

    def __init__(
        self, file: Path, root: etree._Element | None = None, locations: Iterable[str] = ()
    ):
        self.file, self.locations = file, list(locations)
        self.unnamed_kinds: set[str] = set()
        self.root = _read_root(file) if root is None else root

    def source_location(self, element: etree._Element) -> str:
        """Return file and line of an element."""
        if self.locations:
            number = element.sourceline or 0
            return self.locations[number if number < len(self.locations) else 0]
        return f"{self.file.name}:{element.sourceline}"

    def error_at(self, element: etree._Element, problem: str) -> DescriptionError:
        """Return an error with the source location of an element."""
        return DescriptionError(f"{self.source_location(element)}: {problem}")

    def check_name(
        self, element: etree._Element, name: str, names: Collection[str], problem: str
    ) -> None:
        """Raise for a name in an element that is not among some."""
        check_name(name, names, f"{self.source_location(element)}: {problem}", DescriptionError)

    def warn(self, element: etree._Element, problem: str) -> None:
        """Warn with the source location of an element."""
        warn(f"{self.source_location(element)}: {problem}", stacklevel=4)

    def report(self, element: etree._Element, problem: str, harmless: bool = False) -> None:
        """Raise an error with the source location of an element, or record it.

        See `crane.description.findings.report_error`.
        """
        report_error(self.error_at(element, problem), harmless)

    def check_elements(
        self,
        element: etree._Element,
        children: Mapping[str, set[str]],
        attributes: Mapping[str, set[str]],
        closed_elements: set[str],
    ) -> None:
        """Raise for mistyped or misplaced tags and attributes.

        Foreign tags and attributes (sensors, settings of simulators) are common and ignored,
        except attributes of `closed_elements`. While findings are collected, mistyped names are
        corrected, so that the elements are read, too.

        Args:
            element: The element to begin with.
            children: Tags of child elements by tag.
            attributes: Names of attributes by tag.
            closed_elements: Tags of elements without foreign attributes.

        Raises:
            DescriptionError: A name is mistyped or misplaced.
        """
        self._check_attributes(element, attributes.get(element.tag, set()), closed_elements)
        tags = children.get(element.tag, set())
        for child in element:
            if child.tag not in tags:
                self._check_unknown_child(element, child, children)
            if child.tag in tags:  # possibly after a correction
                self.check_elements(child, children, attributes, closed_elements)

    def _check_attributes(
        self, element: etree._Element, known_attributes: set[str], closed_elements: set[str]
    ) -> None:
        for key in element.keys() if known_attributes else ():
            if key in known_attributes:
                continue
            similar = get_close_matches(key.lower(), known_attributes, 1, 0.75)
            is_correctable = bool(similar) and element.get(similar[0]) is None
            if element.tag in closed_elements or is_correctable:
                self.report(
                    element,
                    f'unknown {key}="..." in <{element.tag}>, '
                    f"{suggest_names(known_attributes, key.lower())}",
                    harmless=is_correctable,
                )
            if is_correctable:
                element.set(similar[0], element.attrib.pop(key))

    def _check_unknown_child(
        self, element: etree._Element, child: etree._Element, children: Mapping[str, set[str]]
    ) -> None:
        """Report a child that is mistyped or misplaced; a foreign one is ignored."""
        tags = children.get(element.tag, set())
        similar = get_close_matches(child.tag.lower(), tags, 1, 0.75)
        if similar:
            is_correctable = similar[0] in _REPEATABLE_ELEMENTS or element.find(similar[0]) is None
            self.report(
                child,
                f"unknown <{child.tag}> in <{element.tag}>, "
                f"{suggest_names(tags, child.tag.lower())}",
                harmless=is_correctable,
            )
            if is_correctable:
                child.tag = similar[0]
        elif any(child.tag in x for x in children.values() if tags):
            self.report(child, f"<{child.tag}> has no place in <{element.tag}>, move it")

    def single_child(self, element: etree._Element, tag: str, label: str) -> etree._Element | None:
        """Return the child with a tag, None if there is none.

        Raises:
            DescriptionError: There are several.
        """
        found = element.findall(tag)
        if len(found) > 1:
            self.report(found[1], f"{label} has {len(found)} <{tag}>, keep one")
        return found[0] if found else None

    def number(
        self, element: etree._Element, name: str, label: str, default: float | None = None
    ) -> float:
        """Read a finite number.

        Args:
            element: The element.
            name: Name of the attribute.
            label: Name of the element in errors.
            default: Value of a missing attribute; None if it is required.

        Raises:
            DescriptionError: Missing, not a number or not finite. While findings are collected, it
                is recorded, and the number is NaN.
        """
        return self.vector(element, name, label, 1, None if default is None else (default,))[0]

    def vector(
        self,
        element: etree._Element,
        name: str,
        label: str,
        length: int,
        default: tuple[float, ...] | None = None,
    ) -> tuple[float, ...]:
        """Read finite numbers, see `number`."""
        text = element.get(name)
        if text is None and default is not None:
            return default
        try:
            if text is None:
                raise self.error_at(element, f'{label} has no {name}, add {name}="..."')
            short = text if len(text) < _MAX_VALUE_LENGTH else text[:_MAX_VALUE_LENGTH] + "..."
            return self.parse_numbers(element, text, f'{name}="{short}" of {label}', length)
        except DescriptionError as error:
            report_error(error)
            return (math.nan,) * length

    def parse_numbers(
        self, element: etree._Element, text: str, label: str, length: int
    ) -> tuple[float, ...]:
        """Parse finite numbers in a text.

        Args:
            element: The element that contains it.
            text: The text.
            label: Name of the value in errors.
            length: Required count of numbers.

        Raises:
            DescriptionError: The text is something else.
        """
        try:
            values = tuple(parse_float(word) for word in text.split())
        except ValueError:
            hint = "write digits"
            if "," in text:
                hint = "write a decimal point"
            if "${" in text:
                hint = "expand the file with xacro"
            raise self.error_at(element, f"{label} is not a number, {hint}") from None
        if len(values) != length:
            raise self.error_at(element, f"{label} has {len(values)} numbers, give {length}")
        if not all(math.isfinite(value) for value in values):
            raise self.error_at(element, f"{label} is not finite, give a number")
        return values

    def direction(self, element: etree._Element, label: str, default: tuple[float, ...]) -> Vector:
        """Read the unit vector of the child `<axis xyz="..."/>`; ignored for types without axis.

        Raises:
            DescriptionError: It is zero or malformed.
        """
        if element.get("type") in AXISLESS_TYPES:
            return X_AXIS
        axis = self.single_child(element, "axis", label)
        xyz = default if axis is None else self.vector(axis, "xyz", f"the axis of {label}", 3)
        if (unit := unit_vector(xyz)) is None:
            self.report(axis, f"the axis of {label} is zero, give a direction")
            return X_AXIS
        return unit

    def placement(self, element: etree._Element, label: str) -> Placement:
        """Read xyz [m] and rpy [rad] of the child `<origin/>`, zeros without one.

        Raises:
            DescriptionError: They are malformed.
        """
        origin = self.single_child(element, "origin", label)
        zero = (0.0, 0.0, 0.0)
        if origin is None:
            return zero, zero
        (x, y, z), (roll, pitch, yaw) = (
            self.vector(origin, key, f"the origin of {label}", 3, zero) for key in ("xyz", "rpy")
        )
        return (x, y, z), (roll, pitch, yaw)


def parse_attribute(element: etree._Element, key: str) -> list[float]:
    """Return the numbers of an attribute, none if it is malformed, which others report."""
    try:
        return [parse_float(word) for word in element.get(key, "").split()]
    except ValueError:
        return []


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
    kind = "continuous" if is_continuous else joint.kind
    element = etree.SubElement(robot, "joint", name=joint.name, type=kind)
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
        values = {"damping": format_numbers([viscous]), "friction": format_numbers([coulomb])}
        etree.SubElement(joint, "dynamics", values)
