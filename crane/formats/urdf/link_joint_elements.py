"""Strict reading of links and joints of a URDF, and of the tree that they form."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from difflib import get_close_matches

from lxml import etree

from crane.common.errors import suggest_names, warn
from crane.description.findings import FollowUpError, error_recovery, is_strict, report_error
from crane.description.force_elements import Friction
from crane.description.kinematic_tree import (
    MULTI_FREEDOM_TYPES,
    TENSOR_ATTRIBUTES,
    Inertial,
    Joint,
    Limits,
    Link,
    inertia_problem,
    joint_freedoms,
    joint_series,
    parse_limit,
)
from crane.formats.urdf.loop_elements import read_end_link
from crane.formats.xml_file import XmlFile

_UNLIMITED_HINT = "taken as unlimited: give it lower and upper"


def read_link(xml: XmlFile, name: str, element: etree._Element, is_moved: bool) -> Link:
    """Read a link.

    Args:
        xml: The file.
        name: Name of the link.
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
    for tag in ("mass", "inertia"):
        if inertial.find(tag) is None:
            xml.report(inertial, f"the inertial of {label} has no <{tag}>, add it")
    com, rpy = xml.placement(inertial, label)
    if mass_tag is None or tensor_tag is None:
        raise FollowUpError(f"{label} has no inertia")
    mass = xml.number(mass_tag, "value", f"the mass of {label}")
    tensor = tuple(
        xml.number(tensor_tag, key, f"the inertia of {label}") for key in TENSOR_ATTRIBUTES
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
        # a fixed link only adds to another body, whose total inertia is checked later
        warn(str(error))
    finding_location = xml.source_location(tensor_tag) if problem.is_formal else ""
    return dataclasses.replace(link_inertial, finding_location=finding_location)


def read_joint(
    xml: XmlFile, name: str, element: etree._Element, end_links: tuple[str, str], is_cut: bool
) -> Joint:
    """Read a joint with one or no degree of freedom, except its limits.

    Args:
        xml: The file.
        name: Name of the joint.
        element: The `<joint>`.
        end_links: Parent and child link.
        is_cut: Whether it closes a cycle.
    """
    label, kind = f"joint '{name}'", element.get("type")
    xyz, rpy = xml.placement(element, label)
    joint = Joint(name, kind, *end_links, xml.source_location(element), xyz, rpy, is_cut=is_cut)
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
    """Read a joint with several freedoms as a series of joints and the links between them."""
    label, kind = f"joint '{name}'", element.get("type")
    for tag in ("dynamics", "mimic"):
        if (found := xml.single_child(element, tag, label)) is not None:
            xml.report(found, f"{label} is {kind}, for which <{tag}> has no meaning, remove it")
    axis = xml.direction(element, label, (1.0, 0.0, 0.0))
    return joint_series(
        name,
        joint_freedoms(kind, axis),
        xml.placement(element, label),
        end_links,
        xml.source_location(element),
    )


def _read_maximum(xml: XmlFile, element: etree._Element, key: str, label: str) -> float:
    """Read effort or velocity of a `<limit>`, infinite if it has none."""
    if element.get(key) is None:
        return math.inf
    value = xml.number(element, key, f"the limit of {label}")
    if value < 0:
        raise xml.error_at(element, f"the {key} limit of {label} is negative, make it positive")
    return parse_limit(value) if math.isfinite(value) else math.inf


def read_limits(xml: XmlFile, name: str, joint: etree._Element) -> Limits:
    """Read the limits of a movable joint, infinite with a warning if the file has none.

    Some exporters write `<limit effort velocity/>` without lower and upper, which the
    specification of URDF interprets as a range from 0 to 0, or all four values as zeros.

    Raises:
        DescriptionError: The limits leave no range of motion.
    """
    label, kind = f"joint '{name}'", joint.get("type")
    element = xml.single_child(joint, "limit", label)
    if element is None:
        if kind != "continuous":
            xml.warn(joint, f"{label} is {kind} and has no <limit>, {_UNLIMITED_HINT}")
        return Limits(source_location=xml.source_location(joint))
    found: dict[str, float] = {}
    for key in ("effort", "velocity"):
        with error_recovery(harmless=True):
            found[key] = _read_maximum(xml, element, key, label)
    limits = Limits(**found, source_location=xml.source_location(element))
    if kind == "continuous":
        return limits
    if element.get("lower") is None and element.get("upper") is None:
        xml.warn(element, f"the limit of {label} has no lower and no upper, {_UNLIMITED_HINT}")
        return limits
    lower, upper = (
        xml.number(element, key, f"the limit of {label}", 0.0) for key in ("lower", "upper")
    )
    if lower == upper == 0 and not any(found.values()):
        xml.warn(element, f"all limits of {label} are 0, {_UNLIMITED_HINT}")
        return Limits(source_location=limits.source_location)
    if lower > upper:
        xml.report(
            element, f"the limits of {label} are reversed ({lower:g} > {upper:g}), swap them"
        )
    if lower == upper:
        xml.report(
            element,
            f"lower and upper limit of {label} are both {lower:g}, widen them or make it fixed",
        )
    return dataclasses.replace(limits, lower=parse_limit(lower), upper=parse_limit(upper))


def read_friction(xml: XmlFile, name: str, joint: etree._Element) -> Friction | None:
    """Read the friction of a joint from its `<dynamics>`, None if it has none."""
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


MOVABLE_TYPES = ("revolute", "continuous", "prismatic")

EndLinks = dict[str, tuple[str, str]]  # parent and child link by joint, "" for a missing one
_NO_ENDS = ("", "")
_MAX_LISTED = 8  # joints of a cycle in an error


def read_graph(
    xml: XmlFile, links: Mapping[str, etree._Element], joints: Mapping[str, etree._Element]
) -> tuple[EndLinks, set[str]]:
    """Read the graph of links and joints.

    Joints with both ends form a forest, whatever the file contains. A joint that joins a link to
    itself has no ends once the error was recorded. Neither has a joint that is cut because it
    gives a link a second parent or closes a cycle.

    Args:
        xml: The file.
        links: The `<link>` elements by name.
        joints: The `<joint>` elements by name.

    Returns:
        Parent and child link by joint, and the joints that are cut.

    Raises:
        DescriptionError: An end is missing or unknown, or the joints do not form one tree.
    """
    end_links = {name: _read_end_links(xml, name, joint, links) for name, joint in joints.items()}
    cut_joints: set[str] = set()
    parents: dict[str, tuple[str, str]] = {}  # link -> parent, joint
    for name, (parent, child) in end_links.items():
        if child and parents.setdefault(child, (parent, name)) != (parent, name):
            xml.report(
                joints[name],
                f"link '{child}' has two parents, joints '{parents[child][1]}' and '{name}': "
                "keep one and close the other as a loop",
            )
            cut_joints.add(name)
    roots = [name for name in links if name not in parents]
    joined_count = len(parents)
    while ring := _find_ring(parents, links):
        closing_joint = ring[-1]
        repeated_link = end_links[closing_joint][1]
        listed = ", ".join(ring[:_MAX_LISTED]) + (", ..." if len(ring) > _MAX_LISTED else "")
        xml.report(
            joints[closing_joint],
            f"link '{repeated_link}' is its own ancestor: cut the ring of joints {listed} at "
            f"'{closing_joint}' and close it as a loop",
        )
        cut_joints.add(closing_joint)
        del parents[repeated_link]
    # joints with errors, each of which may have had one of the roots as its child
    unplaced_count = len(xml.root.findall("joint")) - joined_count
    if len(roots) - unplaced_count > 1:
        listed = ", ".join(roots[:4]) + (", ..." if len(roots) > 4 else "")
        xml.report(
            links[roots[1]], f"{len(roots)} links have no parent ({listed}): join all but one"
        )
    for name in cut_joints:
        end_links[name] = _NO_ENDS
    return end_links, cut_joints


def _read_end_links(
    xml: XmlFile, name: str, joint: etree._Element, links: Mapping[str, etree._Element]
) -> tuple[str, str]:
    """Read parent and child link of a joint, "" after an error, and correct an unknown type."""
    label, kinds = f"joint '{name}'", (*MOVABLE_TYPES, *MULTI_FREEDOM_TYPES, "fixed")
    kind = joint.get("type")
    if kind not in kinds:
        problem = f"the type '{kind}', which is not supported" if kind else "no type"
        xml.report(joint, f"{label} has {problem}, {suggest_names(kinds, kind or None)}")
        similar = get_close_matches(kind or "", kinds, 1, 0.75)
        joint.set("type", similar[0] if similar else "revolute")
        limit = joint.find("limit")
        if limit is None:
            limit = etree.SubElement(joint, "limit")
        if limit.get("lower") is None and limit.get("upper") is None:
            limit.attrib.update({"lower": "-1", "upper": "1"})  # avoids a follow-up error
    _, parent = read_end_link(xml, joint, "parent", label, links, " link")
    _, child = read_end_link(xml, joint, "child", label, links, " link")
    if parent and parent == child:
        xml.report(joint, f"{label} joins link '{parent}' to itself, change one end")
        return _NO_ENDS
    return parent, child


def _find_ring(parents: Mapping[str, tuple[str, str]], links: Iterable[str]) -> list[str]:
    """Return the joints of the first cycle of links, from parents to children; [] without one."""
    visited = {""}  # links whose ancestors have been followed
    for link in links:
        joints: dict[str, str] = {}  # by link the joint above it, upwards
        while link in parents and link not in visited and link not in joints:
            joints[link] = parents[link][1]
            link = parents[link][0]
        if link in joints:
            ring = [*joints.values()][[*joints].index(link) :]
            return ring[::-1]
        visited |= joints.keys()
    return []
