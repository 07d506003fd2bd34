"""Links and joints of a URDF as a graph: every ring and every second parent is told and cut."""

from collections.abc import Container, Mapping
from difflib import get_close_matches

from lxml import etree

from crane.common.errors import suggest_names
from crane.description.findings import report_error
from crane.formats.joint_series import MULTI_FREEDOM_TYPES
from crane.formats.urdf.loop_elements import unknown_link_error
from crane.formats.xml_file import XmlFile

MOVABLE_TYPES = ("revolute", "continuous", "prismatic")

EndLinks = dict[
    str, tuple[str, str]
]  # parent and child link by joint, "" for one that is not there
_NO_ENDS = ("", "")
_MAX_LISTED = 8  # joints of a ring in an error


def read_graph(
    xml: XmlFile, links: Mapping[str, etree._Element], joints: Mapping[str, etree._Element]
) -> tuple[EndLinks, str, set[str]]:
    """Parent and child link of every joint, the root, and the joints that are cut.

    Whatever the file says, joints with both ends make a forest: whoever follows them comes to an
    end. A joint that joins a link to itself has no ends once that was noted, nor has one that
    gives a link a second parent or closes a ring, which is cut.

    Args:
        xml: The file.
        links: Its `<link>` elements by name.
        joints: Its `<joint>` elements by name.

    Raises:
        DescriptionError: An end is missing or unknown, or the joints do not make one tree.
    """
    end_links = {name: _read_end_links(xml, name, joint, links) for name, joint in joints.items()}
    cut_joints: set[str] = set()
    root = _find_root(xml, links, joints, end_links, cut_joints)
    for name in cut_joints:
        end_links[name] = _NO_ENDS
    return end_links, root, cut_joints


def _read_end_links(
    xml: XmlFile, name: str, joint: etree._Element, links: Mapping[str, etree._Element]
) -> tuple[str, str]:
    """Parent and child link of a joint of a known type; "" for one that was noted as wrong."""
    label, kinds = f"joint '{name}'", (*MOVABLE_TYPES, *MULTI_FREEDOM_TYPES, "fixed")
    kind = joint.get("type")
    if kind not in kinds:
        report_error(
            xml.error_at(
                joint,
                f"{label} has no type, {suggest_names(kinds)}"
                if not kind
                else f"{label} has the type '{kind}', which is not supported, "
                f"{suggest_names(kinds, kind)}",
            )
        )
        similar = get_close_matches(kind or "", kinds, 1, 0.75)
        joint.set("type", similar[0] if similar else "revolute")
        limit = joint.find("limit")
        if limit is None:
            limit = etree.SubElement(joint, "limit")
        if limit.get("lower") is None and limit.get("upper") is None:
            limit.attrib.update({"lower": "-1", "upper": "1"})  # nobody has to miss them
    ends = []
    for end in ("parent", "child"):
        tag = xml.single_child(joint, end, label)
        link = "" if tag is None else tag.get("link", "").strip()
        if not link:
            report_error(
                xml.error_at(joint, f'{label} has no {end} link, add <{end} link="..."/>')
            )
        elif link not in links:
            report_error(
                unknown_link_error(xml, tag, f"{label} has the unknown {end}", link, links)
            )
            link = ""
        ends.append(link)
    if ends[0] and ends[0] == ends[1]:
        report_error(
            xml.error_at(joint, f"{label} joins link '{ends[0]}' to itself, change one end")
        )
        return _NO_ENDS
    return ends[0], ends[1]


def _find_root(
    xml: XmlFile,
    links: Mapping[str, etree._Element],
    joints: Mapping[str, etree._Element],
    end_links: EndLinks,
    cut_joints: set[str],
) -> str:
    """The one link without a parent of joints that form a tree; those to cut are added."""
    parents: dict[str, tuple[str, str]] = {}  # link -> parent, joint
    for name, (parent, child) in end_links.items():
        if child in parents:
            report_error(
                xml.error_at(
                    joints[name],
                    f"link '{child}' has two parents, joints '{parents[child][1]}' and '{name}': "
                    "keep one and close the other as a loop",
                )
            )
            cut_joints.add(name)
        elif child:
            parents[child] = (parent, name)
    roots = [name for name in links if name not in parents]
    joined_count = len(parents)
    visited = {""}  # links whose ancestors have been looked at
    for name in links:
        seen, repeated_link = _ancestors(parents, name, visited)
        visited |= seen
        if repeated_link is None:
            continue
        closing_joint, ring = parents[repeated_link][1], _loop_text(parents, repeated_link)
        report_error(
            xml.error_at(
                joints[closing_joint],
                f"link '{repeated_link}' is its own ancestor: cut the ring of joints {ring} at "
                f"'{closing_joint}' and "
                "close it as a loop",
            )
        )
        cut_joints.add(closing_joint)
        del parents[repeated_link]
    unplaced_count = (
        len(xml.root.findall("joint")) - joined_count
    )  # joints that may have had a root as child
    if len(roots) - unplaced_count > 1:
        listed = ", ".join(roots[:4]) + (", ..." if len(roots) > 4 else "")
        report_error(
            xml.error_at(
                links[roots[1]], f"{len(roots)} links have no parent ({listed}): join all but one"
            )
        )
    return roots[0] if roots else next(iter(links))


def _ancestors(
    parents: Mapping[str, tuple[str, str]], link: str, visited: Container[str]
) -> tuple[set[str], str | None]:
    """A link with its ancestors up to one that has been passed, and who is its own, if any."""
    seen = {link}
    while link in parents and link not in visited:
        link = parents[link][0]
        if link in seen:
            return seen, link
        seen.add(link)
    return seen, None


def _loop_text(parents: Mapping[str, tuple[str, str]], link: str) -> str:
    """The joints of the ring that a link is in, from the link on."""
    found: list[str] = []
    current = link
    while current != link or not found:
        current, joint = parents[current]
        found.append(joint)
    found.reverse()
    return ", ".join(found[:_MAX_LISTED]) + (", ..." if len(found) > _MAX_LISTED else "")
