"""Warnings about elements of a URDF that are not read and belong to no known program."""

import warnings
from collections.abc import Mapping, Set
from difflib import get_close_matches

from lxml import etree

from crane.common.errors import CraneWarning, suggest_names
from crane.formats.urdf.loop_elements import CONSTRAINT_HINT
from crane.formats.xml_file import XmlFile

# Elements of simulators, controllers and planners (ROS, SRDF, Gazebo, Drake, PyBullet, MuJoCo,
# PR2). Elements with a namespace belong to other programs, too.
_FOREIGN_ELEMENTS = {
    "robot": {
        "sensor", "ros2_control", "mujoco", "group", "chain", "virtual_joint", "passive_joint",
        "disable_collisions", "disable_default_collisions", "enable_collisions", "frame",
        "self_collision_checking", "link_sphere_approximation", "collision_filter_group",
        "actuator", "plugin", "version", "author", "license",
    },
    "link": {
        "sensor", "contact", "contact_coefficients", "audio_source", "gravity", "kinematic",
        "surface", "self_filter", "self_collision_checking", "collision_checking", "gazebo", "map",
    },
    "joint": {
        "joint_properties", "map", "gazebo", "sensor", "hardwareInterface", "transmission",
        "actuator", "mechanicalReduction", "rotor",
    },
    "collision": {"verbose", "contact_coefficients", "surface", "contact", "map"},
    "visual": {"map"},
}  # fmt: skip
_MAX_WARNINGS = 3  # for one file
_MIN_SIMILARITY = 0.6  # of a suggested name


def warn_about_unknown_elements(
    xml: XmlFile,
    children: Mapping[str, Set[str]],
    attributes: Mapping[str, Set[str]],
    joints: Mapping[str, etree._Element],
) -> None:
    """Warn of unknown elements, which are left out, and of incomplete limits.

    Equal elements have one warning, at the first of them, with their number.

    Args:
        xml: The file.
        children: Tags that each element may contain.
        attributes: Attributes that each element may have.
        joints: The `<joint>` elements by name.
    """
    found: dict[tuple[str, str], list[etree._Element]] = {}
    known_tags = set().union(*children.values())  # a misplaced known element is an error
    children_of_read_elements = [
        (parent, child)
        for parent in children
        for element in ([xml.root] if parent == xml.root.tag else xml.root.iter(parent))
        if _is_inside_read_elements(element, children)
        for child in element
    ]
    for parent, child in children_of_read_elements:
        tag = child.tag
        if isinstance(tag, str) and not (
            tag in known_tags or tag in _FOREIGN_ELEMENTS.get(parent, ()) or tag.startswith("{")
        ):
            found.setdefault((parent, tag), []).append(child)
    groups = [
        (elements, parent, _suggest_element(tag, children[parent], attributes))
        for (parent, tag), elements in found.items()
    ]
    groups.sort(key=lambda item: item[2].startswith("known"))  # likely mistakes first
    for elements, parent, hint in groups[:_MAX_WARNINGS]:
        problem = f"unknown <{elements[0].tag}> in <{parent}>"
        _warn_about_elements(xml, elements, problem, f", it is left out, {hint}")
    if remaining := [elements[0] for elements, _, _ in groups[_MAX_WARNINGS:]]:
        listed = ", ".join(f"<{element.tag}>" for element in remaining[:_MAX_WARNINGS])
        dots = ", ..." if len(remaining) > _MAX_WARNINGS else ""
        problem = f"{len(remaining)} more unknown elements ({listed}{dots}) are left out"
        _warn_about_elements(xml, remaining[:1], problem, "")
    incomplete = []
    for name, joint in joints.items():
        limit = joint.find("limit")
        if limit is None or joint.get("type") == "fixed":
            continue
        missing = [key for key in ("effort", "velocity") if limit.get(key) is None]
        if missing:
            problem = f"the limit of joint '{name}' has no {' and no '.join(missing)}"
            incomplete.append((limit, problem))
    if incomplete:
        hint = ", nothing is limited then: add it, 1e9 for no limit"
        _warn_about_elements(xml, [limit for limit, _ in incomplete], incomplete[0][1], hint)


def _is_inside_read_elements(element: etree._Element, children: Mapping[str, Set[str]]) -> bool:
    """Whether all ancestors of an element are read."""
    while (parent := element.getparent()) is not None:
        if element.tag not in children.get(parent.tag, ()):
            return False
        element = parent
    return True


def _suggest_element(tag: str, tags: Set[str], attributes: Mapping[str, Set[str]]) -> str:
    """Suggest a known element or attribute in place of an unknown element."""
    if tag == "constraint":
        return CONSTRAINT_HINT
    element_of_attribute = {
        name: other for other in sorted(tags) for name in sorted(attributes.get(other, ()))
    }
    similar = get_close_matches(
        tag.lower(), [*sorted(tags), *element_of_attribute], 1, _MIN_SIMILARITY
    )
    if not similar:
        return suggest_names(tags)
    if similar[0] in tags:
        return f"did you mean <{similar[0]}>?"
    return f'did you mean {similar[0]}="..." of <{element_of_attribute[similar[0]]}>?'


def _warn_about_elements(
    xml: XmlFile, elements: list[etree._Element], problem: str, hint: str
) -> None:
    count = f" ({len(elements)} such in this file)" if len(elements) > 1 else ""
    warnings.warn(
        f"{xml.source_location(elements[0])}: {problem}{count}{hint}", CraneWarning, stacklevel=4
    )
