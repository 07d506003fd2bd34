"""Loops in a URDF: the elements and attributes of URDF+ (Chignoli et al., arXiv 2411.19753)."""

from collections.abc import Mapping

from lxml import etree

from crane.common.errors import CraneError, suggest_names
from crane.description.findings import FollowUpError, error_recovery, report_error
from crane.description.kinematic_tree import Joint
from crane.description.specification import LoopSpec
from crane.formats.joint_series import MULTI_FREEDOM_TYPES, joint_freedoms, series_joint_names
from crane.formats.xml_file import XmlFile

# Those of URDF+, whose "continuous" is a revolute joint (a loop has no limits), and cylindrical.
_LOOP_TYPES = (
    "fixed", "revolute", "continuous", "prismatic", "spherical", "planar", "cylindrical",
)  # fmt: skip
_DEFAULT_AXIS = (1.0, 0.0, 0.0)  # axis of a URDF joint that names none


def read_loops(
    xml: XmlFile, elements: Mapping[str, etree._Element], links: Mapping[str, etree._Element]
) -> tuple[tuple[LoopSpec, ...], tuple[Joint, ...]]:
    """Loops of `<loop>` elements, and the fixed joints of the two frames that each puts on links.

    Args:
        xml: The file.
        elements: The `<loop>` elements by name.
        links: The `<link>` elements by name.

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
        problem = f"the unknown type '{kind}'" if kind else "no type"
        report_error(
            xml.error_at(
                element, f"{label} has {problem}, {suggest_names(_LOOP_TYPES, kind or None)}"
            )
        )
    end_joints = []
    for end in ("predecessor", "successor"):
        tag = xml.single_child(element, end, label)
        link = "" if tag is None else tag.get("link", "").strip()
        if not link:
            report_error(xml.error_at(element, f'{label} has no {end}, add <{end} link="..."/>'))
            continue
        if link not in links:
            report_error(
                unknown_link_error(xml, tag, f"{label} has the unknown {end}", link, links)
            )
        if f"{name}_{end}" in links:
            same_named = links[f"{name}_{end}"]
            problem = f"link '{name}_{end}' has the name of a frame of {label}, rename one"
            report_error(xml.error_at(same_named, problem))
        xyz, rpy = xml.placement(tag, f"the {end} of {label}")
        frame = f"{name}_{end}"
        end_joints.append(Joint(f"{frame}_fixed", "fixed", link, frame, source_location, xyz, rpy))
    axis = xml.direction(element, label, _DEFAULT_AXIS)
    known_ends = [end for end in end_joints if end.parent in links and end.child not in links]
    if kind not in _LOOP_TYPES or len(known_ends) < 2:
        raise FollowUpError(f"{label} is not complete")
    kind = "revolute" if kind == "continuous" else kind
    return LoopSpec(
        name, kind, end_joints[0].child, end_joints[1].child, axis, source_location
    ), end_joints


def unknown_link_error(
    xml: XmlFile,
    tag: etree._Element,
    problem: str,
    link: str,
    links: Mapping[str, etree._Element],
) -> CraneError:
    """The error about a link that is not there, unless one has lost its name."""
    if "link" in xml.unnamed_kinds:
        return FollowUpError(f"link '{link}' may be the one without a name")
    return xml.error_at(tag, f"{problem} '{link}', {suggest_names(links, link)}")


def independent_joints(
    xml: XmlFile, joints: Mapping[str, etree._Element]
) -> tuple[str, ...] | None:
    """Moving joints marked `independent="true"`; None where no joint has the attribute.

    Where some are marked "false", those without a mark are independent, as in URDF+.

    Raises:
        DescriptionError: The attribute is neither true nor false, or stands on a fixed joint.
    """
    marked_joints = {
        name: joint for name, joint in joints.items() if "independent" in joint.attrib
    }
    for name, joint in marked_joints.items():
        value = joint.get("independent").lower()  # the authors' own files have "True"
        joint.set("independent", value)
        if value not in ("true", "false"):
            problem = f"independent=\"{value}\" of joint '{name}' is neither true nor false"
            report_error(xml.error_at(joint, problem))
            value = "true"
            joint.set("independent", value)
        if value == "true" and joint.get("type") == "fixed":
            report_error(
                xml.error_at(
                    joint, f"joint '{name}' is fixed and independent, keep one of the two"
                )
            )
            joint.set("independent", "false")
    if not marked_joints:
        return None
    values = {joint.get("independent") for joint in marked_joints.values()}
    if values == {"true", "false"} or (values == {"false"} and xml.root.find("loop") is None):
        # as URDF+ has it: those without a mark are independent, too
        passive = (
            joint.find("mimic") is not None or joint.get("type") == "fixed"
            for joint in joints.values()
        )
        marked_joints = {
            name: joint
            for (name, joint), follows in zip(joints.items(), passive, strict=True)
            if name in marked_joints or not follows
        }
    names: list[str] = []
    for name, joint in marked_joints.items():
        kind = joint.get("type")
        if joint.get("independent") == "false":
            continue
        names += (
            series_joint_names(name, joint_freedoms(kind, (0.0, 0.0, 1.0)))
            if kind in MULTI_FREEDOM_TYPES
            else [name]
        )
    return tuple(names)
