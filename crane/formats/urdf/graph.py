"""Links and joints of a URDF as a graph: every ring and every second parent is told and cut."""

from collections.abc import Container, Mapping
from difflib import get_close_matches

from lxml import etree

from crane.common.errors import known
from crane.description.findings import flag
from crane.formats.series import SEVERAL
from crane.formats.urdf.loops import unknown_link
from crane.formats.xml import XmlFile

MOVING = ("revolute", "continuous", "prismatic")

Ends = dict[str, tuple[str, str]]  # parent and child link by joint, "" for one that is not there
_CUT = ("", "")
_LISTED = 8  # joints of a ring in an error


def read_graph(
    xml: XmlFile, links: Mapping[str, etree._Element], joints: Mapping[str, etree._Element]
) -> tuple[Ends, str, set[str]]:
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
    ends = {name: _ends(xml, name, joint, links) for name, joint in joints.items()}
    cut: set[str] = set()
    root = _root(xml, links, joints, ends, cut)
    for name in cut:
        ends[name] = _CUT
    return ends, root, cut


def _ends(
    xml: XmlFile, name: str, joint: etree._Element, links: Mapping[str, etree._Element]
) -> tuple[str, str]:
    """Parent and child link of a joint of a known type; "" for one that was noted as wrong."""
    what, kinds = f"joint '{name}'", (*MOVING, *SEVERAL, "fixed")
    kind = joint.get("type")
    if kind not in kinds:
        flag(
            xml.fail(
                joint,
                f"{what} has no type, {known(kinds)}"
                if not kind
                else f"{what} has the type '{kind}', which is not supported, {known(kinds, kind)}",
            )
        )
        near = get_close_matches(kind or "", kinds, 1, 0.75)
        joint.set("type", near[0] if near else "revolute")
        limit = joint.find("limit")
        if limit is None:
            limit = etree.SubElement(joint, "limit")
        if limit.get("lower") is None and limit.get("upper") is None:
            limit.attrib.update({"lower": "-1", "upper": "1"})  # nobody has to miss them
    ends = []
    for end in ("parent", "child"):
        tag = xml.only(joint, end, what)
        link = "" if tag is None else tag.get("link", "").strip()
        if not link:
            flag(xml.fail(joint, f'{what} has no {end} link, add <{end} link="..."/>'))
        elif link not in links:
            flag(unknown_link(xml, tag, f"{what} has the unknown {end}", link, links))
            link = ""
        ends.append(link)
    if ends[0] and ends[0] == ends[1]:
        flag(xml.fail(joint, f"{what} joins link '{ends[0]}' to itself, change one end"))
        return _CUT
    return ends[0], ends[1]


def _root(
    xml: XmlFile,
    links: Mapping[str, etree._Element],
    joints: Mapping[str, etree._Element],
    ends: Ends,
    cut: set[str],
) -> str:
    """The one link without a parent of joints that form a tree; those to cut are added."""
    above: dict[str, tuple[str, str]] = {}  # link -> parent, joint
    for name, (parent, child) in ends.items():
        if child in above:
            flag(
                xml.fail(
                    joints[name],
                    f"link '{child}' has two parents, joints '{above[child][1]}' and '{name}': "
                    "keep one and close the other as a loop",
                )
            )
            cut.add(name)
        elif child:
            above[child] = (parent, name)
    roots = [name for name in links if name not in above]
    joined = len(above)
    passed = {""}  # links whose ancestors have been looked at
    for name in links:
        seen, at = _ancestors(above, name, passed)
        passed |= seen
        if at is None:
            continue
        last, ring = above[at][1], _ring(above, at)
        flag(
            xml.fail(
                joints[last],
                f"link '{at}' is its own ancestor: cut the ring of joints {ring} at '{last}' and "
                "close it as a loop",
            )
        )
        cut.add(last)
        del above[at]
    lost = len(xml.root.findall("joint")) - joined  # joints that may have had a root as child
    if len(roots) - lost > 1:
        listed = ", ".join(roots[:4]) + (", ..." if len(roots) > 4 else "")
        flag(
            xml.fail(
                links[roots[1]], f"{len(roots)} links have no parent ({listed}): join all but one"
            )
        )
    return roots[0] if roots else next(iter(links))


def _ancestors(
    above: Mapping[str, tuple[str, str]], link: str, passed: Container[str]
) -> tuple[set[str], str | None]:
    """A link with its ancestors up to one that has been passed, and who is its own, if any."""
    seen = {link}
    while link in above and link not in passed:
        link = above[link][0]
        if link in seen:
            return seen, link
        seen.add(link)
    return seen, None


def _ring(above: Mapping[str, tuple[str, str]], link: str) -> str:
    """The joints of the ring that a link is in, from the link on."""
    found: list[str] = []
    at = link
    while at != link or not found:
        at, joint = above[at]
        found.append(joint)
    found.reverse()
    return ", ".join(found[:_LISTED]) + (", ..." if len(found) > _LISTED else "")
