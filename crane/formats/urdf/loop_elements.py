"""Loops and couplings of a URDF, by the elements of URDF+ and by the proposed `<constraint>`.

URDF+ is by Chignoli et al., arXiv 2411.19753. The element `<constraint>` is proposed as
ros/urdfdom#264 and ros/urdfdom_headers#108 ("Add constraints to describe closed loops", open since
8 June 2026):

    <constraint name="Name" type="Type">
    <parent link="Parent_Name"/>
    <parent_origin xyz="Offset_Child" rpy="RPY_Parent"/>
    <parent_axis xyz="Joint_Axis_Parent"/>
    <child link="Child_Name"/>
    <child_origin xyz="Offset_Child" rpy="RPY_Child"/>
    <child_axis xyz="Joint_Axis_Child"/>
    </constraint>

By the parser of the proposal, `urdf_parser/src/constraint.cpp`, types are revolute, prismatic,
universal and spherical, each also with the suffix `_joint`, and link, a link that was cut. Missing
origins are the identity, a missing axis is 1 0 0, and `child_axis` has a meaning for universal
alone. The proposal may still change, so it is read only on request.
"""

import os
from collections.abc import Iterable, Mapping

import numpy as np
from lxml import etree

from crane.common.errors import CraneError, suggest_names
from crane.common.package_search import URDF_CONSTRAINT, own_argument
from crane.description.findings import FollowUpError, error_recovery, report_error
from crane.description.kinematic_tree import MULTI_FREEDOM_TYPES, Joint, joint_freedoms
from crane.description.specification import Coupling, LoopSpec
from crane.formats.xml_file import XmlFile

# Types of URDF+, whose "continuous" is a revolute joint without limits, and cylindrical.
_LOOP_TYPES = (
    "fixed", "revolute", "continuous", "prismatic", "spherical", "planar", "cylindrical",
)  # fmt: skip
_DEFAULT_AXIS = (1.0, 0.0, 0.0)  # of a joint, loop or constraint without an axis


def read_loops(
    xml: XmlFile, elements: Mapping[str, etree._Element], links: Mapping[str, etree._Element]
) -> tuple[tuple[LoopSpec, ...], tuple[Joint, ...]]:
    """Read `<loop>` elements.

    Args:
        xml: The file.
        elements: The `<loop>` elements by name.
        links: The `<link>` elements by name.

    Returns:
        The loops, and the fixed joints of the two frames that each loop adds to links.

    Raises:
        DescriptionError: A loop is malformed or names an unknown link.
    """
    loops, frame_joints = [], []
    for name, element in elements.items():
        with error_recovery():
            loop, end_joints = _read_loop(xml, name, element, links)
            loops.append(loop)
            frame_joints += end_joints
    return tuple(loops), tuple(frame_joints)


def _read_loop(
    xml: XmlFile, name: str, element: etree._Element, links: Mapping[str, etree._Element]
) -> tuple[LoopSpec, list[Joint]]:
    label, source_location = f"loop '{name}'", xml.source_location(element)
    kind = element.get("type", "")
    if kind not in _LOOP_TYPES:
        report_error(_type_error(xml, element, label, kind, _LOOP_TYPES))
    end_joints = []
    for end in ("predecessor", "successor"):
        tag, link = read_end_link(xml, element, end, label, links)
        frame = f"{name}_{end}"
        if frame in links:
            xml.report(
                links[frame], f"link '{frame}' has the name of a frame of {label}, rename one"
            )
        if tag is None:
            continue
        xyz, rpy = xml.placement(tag, f"the {end} of {label}")
        end_joints.append(Joint(f"{frame}_fixed", "fixed", link, frame, source_location, xyz, rpy))
    axis = xml.direction(element, label, _DEFAULT_AXIS)
    known_ends = [end for end in end_joints if end.parent and end.child not in links]
    if kind not in _LOOP_TYPES or len(known_ends) < 2:
        raise FollowUpError(f"{label} is not complete")
    kind = "revolute" if kind == "continuous" else kind
    return LoopSpec(
        name, kind, end_joints[0].child, end_joints[1].child, axis, source_location
    ), end_joints


def _type_error(
    xml: XmlFile, element: etree._Element, label: str, kind: str, known_types: Iterable[str]
) -> CraneError:
    hint = suggest_names(known_types, kind.removesuffix("_joint") or None)
    problem = f"the unknown type '{kind}', {hint}" if kind else f"no type, {hint}"
    return xml.error_at(element, f"{label} has {problem}")


def read_end_link(
    xml: XmlFile,
    element: etree._Element,
    tag: str,
    label: str,
    links: Mapping[str, etree._Element],
    noun: str = "",
) -> tuple[etree._Element | None, str]:
    """Return the child with a tag, and the link that it names, "" after an error.

    Args:
        xml: The file.
        element: The element.
        tag: Tag of the child.
        label: Name of the element in errors.
        links: The `<link>` elements by name.
        noun: Word after the tag in the error about a missing link.

    Raises:
        DescriptionError: No link is named, or an unknown one.
    """
    child = xml.single_child(element, tag, label)
    link = "" if child is None else child.get("link", "").strip()
    if link in links:
        return child, link
    if not link:
        xml.report(element, f'{label} has no {tag}{noun}, add <{tag} link="..."/>')
    elif "link" in xml.unnamed_kinds:
        report_error(FollowUpError(f"link '{link}' may be the one without a name"))
    else:
        xml.report(child, f"{label} has the unknown {tag} '{link}', {suggest_names(links, link)}")
    return child, ""


def independent_joints(
    xml: XmlFile, joints: Mapping[str, etree._Element]
) -> tuple[str, ...] | None:
    """Return the moving joints marked `independent="true"`, None if no joint has the attribute.

    If some joints are marked "false", those without a mark are independent, as in URDF+.

    Raises:
        DescriptionError: The attribute is neither true nor false, or belongs to a fixed joint.
    """
    marks: dict[str, bool] = {}
    for name, joint in joints.items():
        value = joint.get("independent", "").lower()  # files of the authors of URDF+ have "True"
        is_fixed = joint.get("type") == "fixed"
        if "independent" not in joint.attrib:
            continue
        if value not in ("true", "false"):
            xml.report(
                joint, f"independent=\"{value}\" of joint '{name}' is neither true nor false"
            )
        if value == "true" and is_fixed:
            xml.report(joint, f"joint '{name}' is fixed and independent, keep one of the two")
        marks[name] = value != "false" and not is_fixed
    if not marks:
        return None
    if False in marks.values() and (any(marks.values()) or xml.root.find("loop") is None):
        # by URDF+ joints without a mark are independent, too
        marks = {
            name: marks.get(name, joint.find("mimic") is None and joint.get("type") != "fixed")
            for name, joint in joints.items()
        }
    names: list[str] = []
    for name in (name for name, is_independent in marks.items() if is_independent):
        kind = joints[name].get("type")
        if kind in MULTI_FREEDOM_TYPES:
            names += [f"{name}_{x[0]}" for x in joint_freedoms(kind, (0.0, 0.0, 1.0))]
        else:
            names.append(name)
    return tuple(names)


CONSTRAINT_HINT = (
    f"read it by --arg {URDF_CONSTRAINT}:=true, arguments={{'{URDF_CONSTRAINT}': True}} in Python"
)
_CONSTRAINT_TYPES = {
    "revolute": "revolute", "prismatic": "prismatic", "spherical": "spherical", "link": "fixed",
}  # fmt: skip
_END_TAGS = {"parent": "predecessor", "child": "successor"}
_CHILDREN = {
    "constraint": {f"{end}{part}" for end in _END_TAGS for part in ("", "_origin", "_axis")}
}  # fmt: skip
_ATTRIBUTES = {"constraint": {"name", "type"}} | {
    f"{end}{part}": keys
    for end in _END_TAGS
    for part, keys in (("", {"link"}), ("_origin", {"xyz", "rpy"}), ("_axis", {"xyz"}))
}
_PARALLEL_TOLERANCE = 1e-9


def read_constraints(xml: XmlFile) -> None:
    """Replace each `<constraint>` by a `<loop>`, if the load argument requests it.

    Raises:
        DescriptionError: A constraint is malformed, or of a type that no `<loop>` has.
        InputError: The load argument is neither true nor false.
    """
    if not own_argument(URDF_CONSTRAINT):
        return
    for element in xml.root.findall("constraint"):
        with error_recovery():
            _convert_to_loop(xml, element)
            continue
        xml.root.remove(element)  # its error was recorded


def _convert_to_loop(xml: XmlFile, element: etree._Element) -> None:
    if not (name := element.get("name", "").strip()):
        raise xml.error_at(element, 'a constraint has no name, add name="..."')
    label = f"constraint '{name}'"
    xml.check_elements(element, _CHILDREN, _ATTRIBUTES, set(_ATTRIBUTES) - {"constraint"})
    kind = element.get("type", "")
    base_type = kind if kind == "link_joint" else kind.removesuffix("_joint")
    if base_type == "universal":
        raise xml.error_at(
            element,
            f"{label} is universal, which no loop is: hang a link without mass on its parent by "
            "a continuous joint about parent_axis, and close to that, with revolute",
        )
    if base_type not in _CONSTRAINT_TYPES:
        raise _type_error(xml, element, label, kind, _CONSTRAINT_TYPES)
    element.set("type", _CONSTRAINT_TYPES[base_type])
    _check_axes(xml, element, label)
    for end, tag in _END_TAGS.items():
        child = xml.single_child(element, end, label)
        if child is None or not child.get("link", "").strip():
            raise xml.error_at(element, f'{label} has no {end}, add <{end} link="..."/>')
        if (origin := xml.single_child(element, f"{end}_origin", label)) is not None:
            origin.tag = "origin"
            child.append(origin)
        child.tag = tag
    for axis in element.findall("parent_axis"):
        axis.tag = "axis"
    element.tag = "loop"


def _check_axes(xml: XmlFile, element: etree._Element, label: str) -> None:
    """Raise if the axes differ, because a loop has the same axis in both frames."""
    parent, child = (xml.single_child(element, f"{end}_axis", label) for end in _END_TAGS)
    if child is None:
        return
    parent_axis, child_axis = (
        _DEFAULT_AXIS if axis is None else xml.vector(axis, "xyz", f"an axis of {label}", 3)
        for axis in (parent, child)
    )
    product = np.linalg.norm(parent_axis) * np.linalg.norm(child_axis)
    if not np.linalg.norm(np.cross(parent_axis, child_axis)) <= _PARALLEL_TOLERANCE * product:
        raise xml.error_at(
            child,
            f"the child_axis of {label} is another than parent_axis, turn the child's frame by "
            "the rpy of child_origin and leave child_axis out",
        )
    element.remove(child)


_COUPLING_TYPES = ("rolling",)  # belts, chains and gears; also the default


def read_coupling(
    xml: XmlFile,
    name: str,
    element: etree._Element,
    joints: Mapping[str, etree._Element],
    end_links: Mapping[str, tuple[str, str]],
    links: Mapping[str, etree._Element],
) -> Coupling:
    """Read the linear constraint of a `<coupling>`.

    With the moving joints on the paths from the nearest common ancestor of both links to the
    predecessor, P, and to the successor, S,

        ratio sum_P q = sum_S q,

    whatever the directions of the axes.

    Args:
        xml: The file.
        name: Name of the coupling.
        element: The `<coupling>`.
        joints: The `<joint>` elements by name.
        end_links: Parent and child link by joint.
        links: The `<link>` elements by name.

    Raises:
        DescriptionError: It is malformed, or constrains no joint.
    """
    label = f"coupling '{name}'"
    kind = element.get("type", _COUPLING_TYPES[0])
    if kind not in _COUPLING_TYPES:
        raise _type_error(xml, element, label, kind, _COUPLING_TYPES)
    parents = {
        child: (parent, joint) for joint, (parent, child) in end_links.items() if parent and child
    }
    paths = []
    for end in ("predecessor", "successor"):
        _, link = read_end_link(xml, element, end, label, links)
        if not link:
            raise FollowUpError(f"{label} is not complete")
        path = []
        while link in parents:
            link, joint = parents[link]
            path.append(joint)
        paths.append(path[::-1])
    common_count = len(os.path.commonprefix(paths))  # joints to the nearest common ancestor
    predecessor_joints, successor_joints = (
        [joint for joint in path[common_count:] if joints[joint].get("type") != "fixed"]
        for path in paths
    )
    for joint in (*predecessor_joints, *successor_joints):
        if joints[joint].get("type") in MULTI_FREEDOM_TYPES:
            raise xml.error_at(
                element,
                f"{label} counts the joint '{joint}', which has several freedoms: use others",
            )
    tag = xml.single_child(element, "ratio", label)
    ratio = 1.0 if tag is None else xml.number(tag, "value", f"the ratio of {label}")
    factors = dict.fromkeys(reversed(successor_joints), 1.0)
    factors |= dict.fromkeys(predecessor_joints if ratio else (), -ratio)
    if not factors:
        raise xml.error_at(element, f"{label} binds no joint, name two links that move")
    return Coupling(name, factors, 0.0, xml.source_location(element))
