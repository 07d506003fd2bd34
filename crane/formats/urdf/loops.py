"""Loops in a URDF: the elements and attributes of URDF+ (Chignoli et al., arXiv 2411.19753)."""

from collections.abc import Mapping

from lxml import etree

from crane.common.errors import CraneError, known
from crane.description.findings import FollowUpError, flag, recoverable
from crane.description.spec import LoopSpec
from crane.description.tree import Joint
from crane.formats.series import SEVERAL, names_of, parts_of
from crane.formats.xml import XmlFile

# Those of URDF+, whose "continuous" is a revolute joint (a loop has no limits), and cylindrical.
_TYPES = (
    "fixed", "revolute", "continuous", "prismatic", "spherical", "planar", "cylindrical",
)  # fmt: skip
_X = (1.0, 0.0, 0.0)  # axis of a URDF joint that names none


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
    loops, frames = [], []
    for name, element in elements.items():
        with recoverable():
            loop, ends = _loop(xml, name, element, links)
            loops.append(loop)
            frames += ends
    return tuple(loops), tuple(frames)


def _loop(
    xml: XmlFile, name: str, element: etree._Element, links: Mapping[str, etree._Element]
) -> tuple[LoopSpec, list[Joint]]:
    what, where = f"loop '{name}'", xml.where(element)
    kind = element.get("type", "")
    if kind not in _TYPES:
        problem = f"the unknown type '{kind}'" if kind else "no type"
        flag(xml.fail(element, f"{what} has {problem}, {known(_TYPES, kind or None)}"))
    ends = []
    for end in ("predecessor", "successor"):
        tag = xml.only(element, end, what)
        link = "" if tag is None else tag.get("link", "").strip()
        if not link:
            flag(xml.fail(element, f'{what} has no {end}, add <{end} link="..."/>'))
            continue
        if link not in links:
            flag(unknown_link(xml, tag, f"{what} has the unknown {end}", link, links))
        if f"{name}_{end}" in links:
            named = links[f"{name}_{end}"]
            problem = f"link '{name}_{end}' has the name of a frame of {what}, rename one"
            flag(xml.fail(named, problem))
        xyz, rpy = xml.placement(tag, f"the {end} of {what}")
        frame = f"{name}_{end}"
        ends.append(Joint(f"{frame}_fixed", "fixed", link, frame, where, xyz, rpy))
    axis = xml.direction(element, what, _X)
    known_ends = [end for end in ends if end.parent in links and end.child not in links]
    if kind not in _TYPES or len(known_ends) < 2:
        raise FollowUpError(f"{what} is not complete")
    kind = "revolute" if kind == "continuous" else kind
    return LoopSpec(name, kind, ends[0].child, ends[1].child, axis, where), ends


def unknown_link(
    xml: XmlFile,
    tag: etree._Element,
    what: str,
    link: str,
    links: Mapping[str, etree._Element],
) -> CraneError:
    """The error about a link that is not there, unless one has lost its name."""
    if "link" in xml.nameless:
        return FollowUpError(f"link '{link}' may be the one without a name")
    return xml.fail(tag, f"{what} '{link}', {known(links, link)}")


def independent(xml: XmlFile, joints: Mapping[str, etree._Element]) -> tuple[str, ...] | None:
    """Moving joints marked `independent="true"`; None where no joint has the attribute.

    Where some are marked "false", those without a mark are independent, as in URDF+.

    Raises:
        DescriptionError: The attribute is neither true nor false, or stands on a fixed joint.
    """
    marked = {name: joint for name, joint in joints.items() if "independent" in joint.attrib}
    for name, joint in marked.items():
        value = joint.get("independent").lower()  # the authors' own files have "True"
        joint.set("independent", value)
        if value not in ("true", "false"):
            problem = f"independent=\"{value}\" of joint '{name}' is neither true nor false"
            flag(xml.fail(joint, problem))
            value = "true"
            joint.set("independent", value)
        if value == "true" and joint.get("type") == "fixed":
            flag(xml.fail(joint, f"joint '{name}' is fixed and independent, keep one of the two"))
            joint.set("independent", "false")
    if not marked:
        return None
    values = {joint.get("independent") for joint in marked.values()}
    if values == {"true", "false"} or (values == {"false"} and xml.root.find("loop") is None):
        # as URDF+ has it: those without a mark are independent, too
        passive = (
            joint.find("mimic") is not None or joint.get("type") == "fixed"
            for joint in joints.values()
        )
        marked = {
            name: joint
            for (name, joint), follows in zip(joints.items(), passive, strict=True)
            if name in marked or not follows
        }
    out: list[str] = []
    for name, joint in marked.items():
        kind = joint.get("type")
        if joint.get("independent") == "false":
            continue
        out += names_of(name, parts_of(kind, (0.0, 0.0, 1.0))) if kind in SEVERAL else [name]
    return tuple(out)
