"""What a URDF says and nobody reads: warned of, unless other programs are known to write it."""

import warnings
from collections.abc import Mapping, Set
from difflib import get_close_matches

from lxml import etree

from crane.common.errors import CraneWarning, known
from crane.formats.urdf.constraints import HINT
from crane.formats.xml import XmlFile

# Of simulators, controllers and planners (ROS, SRDF, Gazebo, Drake, PyBullet, MuJoCo, PR2);
# whatever has a namespace is another program's, too.
_FOREIGN = {
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
_MOST = 3  # lines on elements of one file
_NEAR = 0.6  # likeness from which another name may have been meant


def warn_of_strangers(
    xml: XmlFile,
    children: Mapping[str, Set[str]],
    attributes: Mapping[str, Set[str]],
    joints: Mapping[str, etree._Element],
) -> None:
    """Warn of elements that are left out, and of limits that say less than they must.

    Equal ones are counted, and told at the first.

    Args:
        xml: The file.
        children: Tags that each element may contain.
        attributes: Attributes that each element may have.
        joints: The `<joint>` elements by name.
    """
    found: dict[tuple[str, str], list[etree._Element]] = {}
    elsewhere = set().union(*children.values())  # what has a place is an error in another
    inside = [
        (parent, child)
        for parent in children
        for element in ([xml.root] if parent == xml.root.tag else xml.root.iter(parent))
        if _is_read(element, children)
        for child in element
    ]
    for parent, child in inside:
        tag = child.tag
        if not isinstance(tag, str) or tag in elsewhere or tag in _FOREIGN.get(parent, ()):
            continue
        if not tag.startswith("{"):
            found.setdefault((parent, tag), []).append(child)
    told = [
        (elements, f"unknown <{tag}> in <{parent}>", _meant(tag, children[parent], attributes))
        for (parent, tag), elements in found.items()
    ]
    told.sort(key=lambda item: item[2].startswith("known"))  # slips first
    for elements, what, hint in told[:_MOST]:
        _warn(xml, elements, what, f"it is left out, {hint}")
    if rest := told[_MOST:]:
        listed = ", ".join(f"<{elements[0].tag}>" for elements, _, _ in rest[:_MOST])
        more = ", ..." if len(rest) > _MOST else ""
        problem = f"{len(rest)} more unknown elements ({listed}{more}) are left out"
        warnings.warn(f"{xml.where(rest[0][0][0])}: {problem}", CraneWarning, stacklevel=3)
    _warn_of_limits(xml, joints)


def _is_read(element: etree._Element, children: Mapping[str, Set[str]]) -> bool:
    """Whether all that an element stands in is read, too."""
    while (parent := element.getparent()) is not None:
        if element.tag not in children.get(parent.tag, ()):
            return False
        element = parent
    return True


def _meant(tag: str, tags: Set[str], attributes: Mapping[str, Set[str]]) -> str:
    """The element, or attribute of one, that may have been meant by an unknown element."""
    if tag == "constraint":
        return HINT
    within = {name: other for other in sorted(tags) for name in sorted(attributes.get(other, ()))}
    near = get_close_matches(tag.lower(), [*sorted(tags), *within], 1, _NEAR)
    if not near:
        return known(tags)
    if near[0] in tags:
        return f"did you mean <{near[0]}>?"
    return f'did you mean {near[0]}="..." of <{within[near[0]]}>?'


def _warn_of_limits(xml: XmlFile, joints: Mapping[str, etree._Element]) -> None:
    lacking = []
    for name, joint in joints.items():
        limit = joint.find("limit")
        if limit is None or joint.get("type") == "fixed":
            continue
        missing = [key for key in ("effort", "velocity") if limit.get(key) is None]
        if missing:
            what = f"the limit of joint '{name}' has no {' and no '.join(missing)}"
            lacking.append((limit, what))
    if lacking:
        elements = [limit for limit, _ in lacking]
        _warn(xml, elements, lacking[0][1], "nothing is limited then: add it, 1e9 for no limit")


def _warn(xml: XmlFile, elements: list[etree._Element], what: str, hint: str) -> None:
    count = f" ({len(elements)} such in this file)" if len(elements) > 1 else ""
    warnings.warn(f"{xml.where(elements[0])}: {what}{count}, {hint}", CraneWarning, stacklevel=4)
