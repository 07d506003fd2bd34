"""Strict reading of URDF files, with errors where other readers ignore mistakes."""

import dataclasses
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path

from lxml import etree

from crane.common.errors import suggest_names
from crane.description.findings import (
    FollowUpError,
    error_recovery,
    record_parsed_file,
)
from crane.description.force_elements import Friction
from crane.description.kinematic_tree import (
    MULTI_FREEDOM_TYPES,
    TENSOR_ATTRIBUTES,
    Joint,
    Link,
    Tree,
)
from crane.description.specification import (
    STANDARD_GRAVITY,
    Chain,
    Coupling,
    MachineSpec,
    source_locations,
)
from crane.formats.robot_files import open_robot
from crane.formats.urdf.link_joint_elements import (
    MOVABLE_TYPES,
    read_friction,
    read_graph,
    read_joint,
    read_limits,
    read_link,
    read_multi_freedom_joint,
)
from crane.formats.urdf.loop_elements import (
    CONSTRAINT_HINT,
    independent_joints,
    read_constraints,
    read_coupling,
    read_loops,
)
from crane.formats.xml_file import XmlFile

_CHILDREN = {
    "robot": {
        "link", "joint", "loop", "coupling", "material", "transmission", "gazebo", "group_state",
        "end_effector",
    },
    "link": {"origin", "inertial", "visual", "collision"},
    "joint": {
        "origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "calibration",
        "safety_controller",
    },
    "loop": {"predecessor", "successor", "axis", "limit", "dynamics"},
    "coupling": {"predecessor", "successor", "ratio"},
    "group_state": {"joint"},
    "predecessor": {"origin"},
    "successor": {"origin"},
    "inertial": {"origin", "mass", "inertia"},
    "visual": {"origin", "geometry", "material"},
    "collision": {"origin", "geometry", "material"},
}  # fmt: skip
_ATTRIBUTES = {
    "link": {"name", "between"},
    "joint": {"name", "type", "independent"},
    "loop": {"name", "type"},
    "coupling": {"name", "type"},
    "ratio": {"value"},
    "parent": {"link"},
    "child": {"link"},
    "predecessor": {"link"},
    "successor": {"link"},
    "origin": {"xyz", "rpy"},
    "axis": {"xyz"},
    "mass": {"value"},
    "inertia": {*TENSOR_ATTRIBUTES},
    "limit": {"lower", "upper", "effort", "velocity"},
    "dynamics": {"damping", "friction"},
}
_CLOSED_ELEMENTS = {"origin", "axis", "mass", "inertia"}
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
_MIN_SIMILARITY = 0.6  # of a suggested name
# elements of drafts of URDF+
_OBSOLETE_ELEMENTS = {"loop_constraint": "loop", "joint_constraint": "coupling"}


def read_urdf(file: Path, edit: Callable[[XmlFile], None] | None = None) -> MachineSpec:
    """Read and check a URDF, or a file that is converted to one by `crane.formats.robot_files`.

    Args:
        file: The file.
        edit: Function that changes the elements before they are read.

    Returns:
        The machine of one chain; `source_locations` has "gravity" if the file states it.

    Raises:
        DescriptionError: The file is wrong; the message has file and line.
    """
    xml, springs = open_robot(file)
    record_parsed_file(xml)
    _check_elements(xml, edit)
    links, joints = _elements_by_name(xml, "link"), _elements_by_name(xml, "joint")
    _warn_about_unknown_elements(xml, joints)
    if not links:
        raise xml.error_at(xml.root, "no <link> in this file, add one")
    end_links, cut = read_graph(xml, links, joints)
    moved_links = {
        end_links[name][1] for name, joint in joints.items() if joint.get("type") != "fixed"
    }
    parts: list[Link | Joint] = []
    for name, link in links.items():
        with error_recovery():
            parts.append(read_link(xml, name, link, name in moved_links))
    friction: dict[str, Friction | None] = {}
    for name, joint in joints.items():
        if joint.get("type") in MULTI_FREEDOM_TYPES:
            parts += _read_joint_series(xml, name, end_links[name], links, joints)
            continue
        with error_recovery():
            single = read_joint(xml, name, joint, end_links[name], name in cut)
            parts.append(single)  # without limits if they are wrong
            limits = read_limits(xml, name, joint) if single.is_movable else single.limits
            parts[-1] = dataclasses.replace(single, limits=limits)
        with error_recovery(harmless=True):
            friction[name] = read_friction(xml, name, joint)
    independent_names = independent_joints(xml, joints)
    loops, frames = read_loops(xml, _elements_by_name(xml, "loop"), links)
    for frame in frames:
        parts.append(Link(frame.child, frame.source_location))
        if (same_named := joints.get(frame.name)) is None:
            parts.append(frame)
        else:
            xml.report(same_named, f"joint '{frame.name}' has the name of a loop's, rename it")
    couplings = _read_mimics(xml, joints, independent_names)
    for name, element in _elements_by_name(xml, "coupling").items():
        with error_recovery():
            couplings += (read_coupling(xml, name, element, joints, end_links, links),)
    tree = Tree({}, {}).with_parts(*parts)
    moving_joints = tuple(joint.name for joint in tree.moving_joints)
    home, locations = _read_home(xml, moving_joints)
    if "gravity" in xml.root.attrib:
        locations["gravity"] = xml.source_location(xml.root)
    return MachineSpec(
        name=xml.root.get("name") or file.stem,
        source=file.name,
        path=file,
        chains=(Chain(file.stem, file, None, file.name, moving_joints),),
        tree=tree,
        loops=loops,
        active=independent_names,
        home=home,
        friction={name: found for name, found in friction.items() if found is not None},
        forces=springs,
        tip=_read_tip(xml, links),
        couplings=couplings,
        source_locations=source_locations(loops, couplings) | locations,
        gravity=xml.vector(xml.root, "gravity", "the robot", 3, STANDARD_GRAVITY),
        is_complete=not xml.unnamed_kinds,
    )


def _check_elements(xml: XmlFile, edit: Callable[[XmlFile], None] | None) -> None:
    if xml.root.tag != "robot":
        raise xml.error_at(
            xml.root, f"a URDF starts with <robot>, this file with <{xml.root.tag}>"
        )
    read_constraints(xml)
    xml.check_elements(xml.root, _CHILDREN, _ATTRIBUTES, _CLOSED_ELEMENTS)
    if edit is not None:
        edit(xml)
    for tag, replacement_tag in _OBSOLETE_ELEMENTS.items():
        for element in xml.root.iterfind(tag):
            xml.report(
                element, f"<{tag}> is not read, URDF+ has <{replacement_tag}> for it: write one"
            )


def _read_joint_series(
    xml: XmlFile,
    name: str,
    end_links: tuple[str, str],
    links: Mapping[str, etree._Element],
    joints: Mapping[str, etree._Element],
) -> list[Link | Joint]:
    """Read a composite joint as a series of joints, without parts whose names exist already."""
    series_parts: list[Link | Joint] = []
    with error_recovery():
        series_parts = read_multi_freedom_joint(xml, name, joints[name], end_links)
    found = []
    for part in series_parts:
        kind, used_names = ("link", links) if isinstance(part, Link) else ("joint", joints)
        if part.name in used_names:
            xml.report(joints[name], f"its {kind} '{part.name}' is there already, rename one")
        else:
            found.append(part)
    return found


def _read_mimics(
    xml: XmlFile, joints: Mapping[str, etree._Element], independent_names: tuple[str, ...] | None
) -> tuple[Coupling, ...]:
    """Read the couplings q = multiplier q_other + offset of joints that mimic another."""
    moving = [name for name, joint in joints.items() if joint.get("type") in MOVABLE_TYPES]
    found = []
    for name, joint in joints.items():
        mimic = xml.single_child(joint, "mimic", f"joint '{name}'")
        if mimic is None or name not in moving:
            continue
        with error_recovery():
            found.append(_read_mimic(xml, name, mimic, joints, moving, independent_names or ()))
    return tuple(found)


def _read_mimic(
    xml: XmlFile,
    name: str,
    mimic: etree._Element,
    joints: Mapping[str, etree._Element],
    movable_joints: Sequence[str],
    independent_names: Sequence[str],
) -> Coupling:
    other = mimic.get("joint", "")
    if other not in joints and "joint" in xml.unnamed_kinds:
        raise FollowUpError(f"joint '{other}' may be one without a name")
    known = f"'{other}', which does not move"
    mimicked = known if other in joints else f"the unknown joint '{other}'"
    xml.check_name(mimic, other, movable_joints, f"joint '{name}' mimics {mimicked}")
    if other == name:
        raise xml.error_at(mimic, f"joint '{name}' mimics itself, name another")
    if name in independent_names:
        raise xml.error_at(
            mimic, f"joint '{name}' mimics '{other}' and is independent, keep one of the two"
        )
    multiplier = xml.number(mimic, "multiplier", f"the mimic of '{name}'", 1.0)
    offset = xml.number(mimic, "offset", f"the mimic of '{name}'", 0.0)
    factors = {name: 1.0, other: -multiplier} if multiplier else {name: 1.0}
    return Coupling(f"{name}_mimic", factors, offset, xml.source_location(mimic))


def _elements_by_name(xml: XmlFile, kind: str) -> dict[str, etree._Element]:
    """Return the elements with a tag by name; missing and repeated names are errors."""
    found: dict[str, etree._Element] = {}
    for element in xml.root.iterfind(kind):
        name = element.get("name", "").strip()
        if name and name not in found:
            found[name] = element
            continue
        xml.unnamed_kinds.add(kind)
        if not name:
            xml.report(element, f'a {kind} has no name, add name="..."')
        else:
            first = xml.source_location(found[name]).rpartition(":")[2]
            xml.report(
                element, f"{kind} '{name}' is there twice (first in line {first}), rename one"
            )
    return found


def _read_home(xml: XmlFile, joints: Collection[str]) -> tuple[dict[str, float], dict[str, str]]:
    """Read `<group_state name="home">`, an element of SRDF.

    Returns:
        Coordinates by joint, and the file and line of each as "home JOINT".
    """
    home: dict[str, float] = {}
    locations: dict[str, str] = {}
    joint_elements = [
        joint
        for state in xml.root.iterfind("group_state")
        if state.get("name", "").strip() == "home"
        for joint in state.iterfind("joint")
    ]
    for joint in joint_elements:
        with error_recovery():
            name, value = _read_coordinate(xml, joint, joints, home)
            home[name], locations[f"home {name}"] = value, xml.source_location(joint)
    return home, locations


def _read_tip(xml: XmlFile, links: Mapping[str, etree._Element]) -> str | None:
    """Read the link of `<end_effector name="tip" parent_link="LINK"/>`, an element of SRDF."""
    tips = [x for x in xml.root.iterfind("end_effector") if x.get("name", "").strip() == "tip"]
    if not tips:
        return None
    link = str(tips[0].get("parent_link", "")).strip()
    problem = f"is the unknown link '{link}'" if link else 'has no link, write parent_link="LINK"'
    xml.check_name(tips[0], link, links, f"the tip {problem}")
    return link


def _read_coordinate(
    xml: XmlFile, joint: etree._Element, joints: Collection[str], earlier_names: Container[str]
) -> tuple[str, float]:
    name = joint.get("name", "").strip()
    problem = f"home names the joint '{name}', which is unknown or does not move"
    xml.check_name(joint, name, joints, problem)
    value = xml.number(joint, "value", f"home of '{name}'")
    if name in earlier_names:
        raise xml.error_at(joint, f"home of '{name}' is there twice, keep one")
    return name, value


def _warn_about_unknown_elements(xml: XmlFile, joints: Mapping[str, etree._Element]) -> None:
    """Warn of unknown elements, which are left out, and of incomplete limits."""
    known_tags = set().union(*_CHILDREN.values())  # a misplaced known element is an error
    read_elements = [xml.root]
    for element in read_elements:
        read_elements += [
            x for x in element if x.tag in _CHILDREN[element.tag] and x.tag in _CHILDREN
        ]
        known = known_tags | _FOREIGN_ELEMENTS.get(element.tag, set())
        for child in [x for x in element if x.tag not in known and not x.tag.startswith("{")]:
            hint = _suggest_element(child.tag, element.tag)
            xml.warn(child, f"unknown <{child.tag}> in <{element.tag}>, it is left out, {hint}")
    for name, joint in joints.items():
        limit = joint.find("limit")
        if limit is None or joint.get("type") == "fixed":
            continue
        if missing := [key for key in ("effort", "velocity") if limit.get(key) is None]:
            problem = f"the limit of joint '{name}' has no {' and no '.join(missing)}"
            xml.warn(limit, f"{problem}, nothing is limited then: add it, 1e9 for no limit")


@cache
def _suggest_element(tag: str, parent: str) -> str:
    if tag == "constraint":
        return CONSTRAINT_HINT
    tags = sorted(_CHILDREN[parent])
    element_of_attribute = {
        name: other for other in tags for name in sorted(_ATTRIBUTES.get(other, ()))
    }
    similar = get_close_matches(tag.lower(), [*tags, *element_of_attribute], 1, _MIN_SIMILARITY)
    if not similar:
        return suggest_names(tags)
    if similar[0] in tags:
        return f"did you mean <{similar[0]}>?"
    return f'did you mean {similar[0]}="..." of <{element_of_attribute[similar[0]]}>?'
