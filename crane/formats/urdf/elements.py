"""Links and joints of a URDF, checked."""

import dataclasses
import math
import warnings

from lxml import etree

from crane.common.errors import CraneWarning
from crane.description.findings import FollowUpError, flag, is_strict, recoverable
from crane.description.inertia import inertia_problem
from crane.description.spec import Friction
from crane.description.tree import Inertial, Joint, Limits, Link, limit
from crane.formats.series import parts_of, series
from crane.formats.xml import XmlFile


def read_link(xml: XmlFile, name: str, element: etree._Element, moved: bool) -> Link:
    """A checked link.

    Args:
        xml: The file.
        name: Its name.
        element: The `<link>`.
        moved: Whether a joint moves it.
    """
    what = f"link '{name}'"
    between = element.get("between") if element.find("inertial") is None else None
    link = Link(name, xml.where(element), between=between)
    with recoverable():
        if any(map(any, xml.placement(element, what))):
            raise xml.fail(element, f"{what} has an <origin>, which is its joint's: move it there")
    with recoverable(harmless=True):
        inertial = xml.only(element, "inertial", what)
        if inertial is None:
            return link
        return dataclasses.replace(link, inertial=_read_inertial(xml, what, inertial, moved))
    return dataclasses.replace(link, refused=True)


def _read_inertial(xml: XmlFile, what: str, inertial: etree._Element, moved: bool) -> Inertial:
    mass_tag, tensor_tag = (xml.only(inertial, tag, what) for tag in ("mass", "inertia"))
    for tag, found in (("mass", mass_tag), ("inertia", tensor_tag)):
        if found is None:
            flag(xml.fail(inertial, f"the inertial of {what} has no <{tag}>, add it"))
    com, rpy = xml.placement(inertial, what)
    if mass_tag is None or tensor_tag is None:
        raise FollowUpError(f"{what} has no inertia")
    mass = xml.number(mass_tag, "value", f"the mass of {what}")
    tensor = tuple(
        xml.number(tensor_tag, key, f"the inertia of {what}")
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    if mass < 0:
        raise xml.fail(mass_tag, f"{what} has the mass {mass:g} kg, give a positive one")
    if not all(map(math.isfinite, (mass, *tensor, *com, *rpy))):
        raise FollowUpError(f"{what} has no inertia")
    found = Inertial(mass, com, rpy, tensor)
    problem = inertia_problem(mass, found.matrix)
    if problem is None:
        return found
    error = xml.fail(tensor_tag, f"{what} has {problem}")
    if moved and not problem.formal:
        raise error
    if moved and is_strict():
        flag(error, harmless=True)
    elif is_strict() or not problem.formal:
        # rigidly attached, it only adds to another body, whose sum is checked later
        warnings.warn(str(error), CraneWarning, stacklevel=2)
    doubt = xml.where(tensor_tag) if problem.formal else ""
    return dataclasses.replace(found, doubt=doubt)


def read_joint(xml: XmlFile, name: str, element: etree._Element, ends: tuple[str, str]) -> Joint:
    """A joint with one freedom, or none, whose limits are not read yet.

    Args:
        xml: The file.
        name: Its name.
        element: The `<joint>`.
        ends: Its parent and child link.
    """
    what, kind = f"joint '{name}'", element.get("type")
    xml.only(element, "mimic", what)
    xyz, rpy = xml.placement(element, what)
    joint = Joint(name, kind, *ends, xml.where(element), xyz, rpy)
    if kind == "fixed":
        return joint
    return dataclasses.replace(
        joint,
        kind="revolute" if kind == "continuous" else kind,
        axis=xml.direction(element, what, (1.0, 0.0, 0.0)),
        limits=Limits(math.nan, math.nan),
    )


def read_several(
    xml: XmlFile, name: str, element: etree._Element, ends: tuple[str, str]
) -> list[Link | Joint]:
    """A joint with several freedoms as a series of joints, with the links between them."""
    what, kind = f"joint '{name}'", element.get("type")
    for tag in ("dynamics", "mimic"):
        if (found := xml.only(element, tag, what)) is not None:
            problem = f"{what} is {kind}, for which <{tag}> has no meaning, remove it"
            flag(xml.fail(found, problem))
    axis = xml.direction(element, what, (1.0, 0.0, 0.0))
    place = xml.placement(element, what)
    return series(name, parts_of(kind, axis), place, ends, xml.where(element))


def _most(xml: XmlFile, element: etree._Element, key: str, what: str) -> float:
    """The effort or velocity that a `<limit>` allows, infinite where it has none."""
    if element.get(key) is None:
        return math.inf
    value: float = xml.number(element, key, f"the limit of {what}")
    if value < 0:
        raise xml.fail(element, f"the {key} limit of {what} is negative, make it positive")
    return limit(value) if math.isfinite(value) else math.inf


def read_limits(xml: XmlFile, name: str, joint: etree._Element) -> Limits:
    """Limits of a joint that moves; what the file leaves open is open, and warned of.

    Exporters write `<limit effort velocity/>` without lower and upper, which the specification of
    URDF reads as a range from 0 to 0, or all four as zeros, forms that nobody has filled in.

    Raises:
        DescriptionError: They leave it nothing to move.
    """
    what, kind = f"joint '{name}'", joint.get("type")
    element = xml.only(joint, "limit", what)
    if element is None:
        if kind != "continuous":
            _warn_of_no_limits(xml, joint, f"{what} is {kind} and has no <limit>")
        return Limits(where=xml.where(joint))
    found: dict[str, float] = {}
    for key in ("effort", "velocity"):
        with recoverable(harmless=True):
            found[key] = _most(xml, element, key, what)
    limits = Limits(**found, where=xml.where(element))
    if kind == "continuous":
        return limits
    if element.get("lower") is None and element.get("upper") is None:
        _warn_of_no_limits(xml, element, f"the limit of {what} has no lower and no upper")
        return limits
    lower, upper = (
        xml.number(element, key, f"the limit of {what}", 0.0) for key in ("lower", "upper")
    )
    if lower == upper == 0 and not any(found.values()):
        _warn_of_no_limits(xml, element, f"all limits of {what} are 0")
        return Limits(where=limits.where)
    problem = ""
    if lower > upper:
        problem = f"the limits of {what} are reversed ({lower:g} > {upper:g}), swap them"
    if lower == upper:
        both = f"lower and upper limit of {what} are both {lower:g}"
        problem = f"{both}, widen them or make it fixed"
    if problem:
        flag(xml.fail(element, problem))
    return dataclasses.replace(limits, lower=limit(lower), upper=limit(upper))


def _warn_of_no_limits(xml: XmlFile, element: etree._Element, what: str) -> None:
    text = f"{xml.where(element)}: {what}, taken as unlimited: give it lower and upper"
    warnings.warn(text, CraneWarning, stacklevel=4)


def read_friction(xml: XmlFile, name: str, joint: etree._Element) -> Friction | None:
    """Friction of a joint by its `<dynamics>`, None where it has none."""
    what = f"joint '{name}'"
    tag = xml.only(joint, "dynamics", what)
    if tag is None or joint.get("type") == "fixed":
        return None
    damping, friction = (
        xml.number(tag, key, f"the dynamics of {what}", 0.0) for key in ("damping", "friction")
    )
    if min(damping, friction) < 0:
        raise xml.fail(tag, f"damping or friction of {what} is negative, make it positive")
    return Friction(viscous=damping, coulomb=friction) if damping or friction else None
