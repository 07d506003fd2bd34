"""Links and joints of a URDF, checked."""

import dataclasses
import math
import warnings

from lxml import etree

from crane.common.errors import CraneWarning
from crane.description.findings import FollowUpError, error_recovery, is_strict, report_error
from crane.description.inertia_feasibility import inertia_problem
from crane.description.kinematic_tree import Inertial, Joint, Limits, Link, parse_limit
from crane.description.specification import Friction
from crane.formats.joint_series import joint_freedoms, joint_series
from crane.formats.xml_file import XmlFile


def read_link(xml: XmlFile, name: str, element: etree._Element, is_moved: bool) -> Link:
    """A checked link.

    Args:
        xml: The file.
        name: Its name.
        element: The `<link>`.
        is_moved: Whether a joint moves it.
    """
    label = f"link '{name}'"
    composite_joint = element.get("between") if element.find("inertial") is None else None
    link = Link(name, xml.source_location(element), composite_joint=composite_joint)
    with error_recovery():
        if any(map(any, xml.placement(element, label))):
            raise xml.error_at(
                element, f"{label} has an <origin>, which is its joint's: move it there"
            )
    with error_recovery(harmless=True):
        inertial = xml.single_child(element, "inertial", label)
        if inertial is None:
            return link
        return dataclasses.replace(link, inertial=_read_inertial(xml, label, inertial, is_moved))
    return dataclasses.replace(link, has_refused_inertial=True)


def _read_inertial(xml: XmlFile, label: str, inertial: etree._Element, is_moved: bool) -> Inertial:
    mass_tag, tensor_tag = (xml.single_child(inertial, tag, label) for tag in ("mass", "inertia"))
    for tag, link_inertial in (("mass", mass_tag), ("inertia", tensor_tag)):
        if link_inertial is None:
            report_error(xml.error_at(inertial, f"the inertial of {label} has no <{tag}>, add it"))
    com, rpy = xml.placement(inertial, label)
    if mass_tag is None or tensor_tag is None:
        raise FollowUpError(f"{label} has no inertia")
    mass = xml.number(mass_tag, "value", f"the mass of {label}")
    tensor = tuple(
        xml.number(tensor_tag, key, f"the inertia of {label}")
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    if mass < 0:
        raise xml.error_at(mass_tag, f"{label} has the mass {mass:g} kg, give a positive one")
    if not all(map(math.isfinite, (mass, *tensor, *com, *rpy))):
        raise FollowUpError(f"{label} has no inertia")
    link_inertial = Inertial(mass, com, rpy, tensor)
    problem = inertia_problem(mass, link_inertial.inertia_matrix)
    if problem is None:
        return link_inertial
    error = xml.error_at(tensor_tag, f"{label} has {problem}")
    if is_moved and not problem.is_formal:
        raise error
    if is_moved and is_strict():
        report_error(error, harmless=True)
    elif is_strict() or not problem.is_formal:
        # rigidly attached, it only adds to another body, whose sum is checked later
        warnings.warn(str(error), CraneWarning, stacklevel=2)
    finding_location = xml.source_location(tensor_tag) if problem.is_formal else ""
    return dataclasses.replace(link_inertial, finding_location=finding_location)


def read_joint(
    xml: XmlFile, name: str, element: etree._Element, end_links: tuple[str, str]
) -> Joint:
    """A joint with one freedom, or none, whose limits are not read yet.

    Args:
        xml: The file.
        name: Its name.
        element: The `<joint>`.
        end_links: Its parent and child link.
    """
    label, kind = f"joint '{name}'", element.get("type")
    xml.single_child(element, "mimic", label)
    xyz, rpy = xml.placement(element, label)
    joint = Joint(name, kind, *end_links, xml.source_location(element), xyz, rpy)
    if kind == "fixed":
        return joint
    return dataclasses.replace(
        joint,
        kind="revolute" if kind == "continuous" else kind,
        axis=xml.direction(element, label, (1.0, 0.0, 0.0)),
        limits=Limits(math.nan, math.nan),
    )


def read_multi_freedom_joint(
    xml: XmlFile, name: str, element: etree._Element, end_links: tuple[str, str]
) -> list[Link | Joint]:
    """A joint with several freedoms as a series of joints, with the links between them."""
    label, kind = f"joint '{name}'", element.get("type")
    for tag in ("dynamics", "mimic"):
        if (found := xml.single_child(element, tag, label)) is not None:
            problem = f"{label} is {kind}, for which <{tag}> has no meaning, remove it"
            report_error(xml.error_at(found, problem))
    axis = xml.direction(element, label, (1.0, 0.0, 0.0))
    placement = xml.placement(element, label)
    return joint_series(
        name, joint_freedoms(kind, axis), placement, end_links, xml.source_location(element)
    )


def _read_maximum(xml: XmlFile, element: etree._Element, key: str, label: str) -> float:
    """The effort or velocity that a `<limit>` allows, infinite where it has none."""
    if element.get(key) is None:
        return math.inf
    value: float = xml.number(element, key, f"the limit of {label}")
    if value < 0:
        raise xml.error_at(element, f"the {key} limit of {label} is negative, make it positive")
    return parse_limit(value) if math.isfinite(value) else math.inf


def read_limits(xml: XmlFile, name: str, joint: etree._Element) -> Limits:
    """Limits of a joint that moves; what the file leaves open is open, and warned of.

    Exporters write `<limit effort velocity/>` without lower and upper, which the specification of
    URDF reads as a range from 0 to 0, or all four as zeros, forms that nobody has filled in.

    Raises:
        DescriptionError: They leave it nothing to move.
    """
    label, kind = f"joint '{name}'", joint.get("type")
    element = xml.single_child(joint, "limit", label)
    if element is None:
        if kind != "continuous":
            _warn_about_missing_limits(xml, joint, f"{label} is {kind} and has no <limit>")
        return Limits(source_location=xml.source_location(joint))
    found: dict[str, float] = {}
    for key in ("effort", "velocity"):
        with error_recovery(harmless=True):
            found[key] = _read_maximum(xml, element, key, label)
    limits = Limits(**found, source_location=xml.source_location(element))
    if kind == "continuous":
        return limits
    if element.get("lower") is None and element.get("upper") is None:
        _warn_about_missing_limits(xml, element, f"the limit of {label} has no lower and no upper")
        return limits
    lower, upper = (
        xml.number(element, key, f"the limit of {label}", 0.0) for key in ("lower", "upper")
    )
    if lower == upper == 0 and not any(found.values()):
        _warn_about_missing_limits(xml, element, f"all limits of {label} are 0")
        return Limits(source_location=limits.source_location)
    problem = ""
    if lower > upper:
        problem = f"the limits of {label} are reversed ({lower:g} > {upper:g}), swap them"
    if lower == upper:
        both = f"lower and upper limit of {label} are both {lower:g}"
        problem = f"{both}, widen them or make it fixed"
    if problem:
        report_error(xml.error_at(element, problem))
    return dataclasses.replace(limits, lower=parse_limit(lower), upper=parse_limit(upper))


def _warn_about_missing_limits(xml: XmlFile, element: etree._Element, problem: str) -> None:
    message = (
        f"{xml.source_location(element)}: {problem}, taken as unlimited: give it lower and upper"
    )
    warnings.warn(message, CraneWarning, stacklevel=4)


def read_friction(xml: XmlFile, name: str, joint: etree._Element) -> Friction | None:
    """Friction of a joint by its `<dynamics>`, None where it has none."""
    label = f"joint '{name}'"
    tag = xml.single_child(joint, "dynamics", label)
    if tag is None or joint.get("type") == "fixed":
        return None
    damping, friction = (
        xml.number(tag, key, f"the dynamics of {label}", 0.0) for key in ("damping", "friction")
    )
    if min(damping, friction) < 0:
        raise xml.error_at(tag, f"damping or friction of {label} is negative, make it positive")
    return Friction(viscous=damping, coulomb=friction) if damping or friction else None
