"""Loops in a URDF: the elements and attributes of URDF+ (Chignoli et al., arXiv 2411.19753)."""

from collections.abc import Mapping
from dataclasses import dataclass

from lxml import etree

from crane.description.series import SEVERAL, names_of, parts_of
from crane.description.spec import LoopSpec
from crane.description.xml import XmlFile
from crane.errors import known

# Those of URDF+, whose "continuous" is a revolute joint: a loop has no limits.
_TYPES = ("fixed", "revolute", "continuous", "prismatic", "spherical", "planar")
_X = (1.0, 0.0, 0.0)  # axis of a URDF joint that names none

Placement = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class LoopFrame:
    """A frame that a loop puts on a link.

    Attributes:
        name: The frame's name.
        link: The link.
        placement: xyz [m] and rpy [rad] in the link's frame.
        where: Where it was written, for errors.
    """

    name: str
    link: str
    placement: Placement
    where: str


def read_loops(
    xml: XmlFile, elements: Mapping[str, etree._Element], links: Mapping[str, etree._Element]
) -> tuple[tuple[LoopSpec, ...], tuple[LoopFrame, ...]]:
    """Loops of `<loop>` elements, and the two frames that each puts on links.

    Args:
        xml: The file.
        elements: The `<loop>` elements by name.
        links: The `<link>` elements by name.

    Raises:
        DescriptionError: A loop is malformed or names an unknown link.
    """
    loops, frames = [], []
    for name, element in elements.items():
        what, where = f"loop '{name}'", xml.where(element)
        kind = element.get("type", "")
        if kind not in _TYPES:
            problem = f"the unknown type '{kind}'" if kind else "no type"
            raise xml.fail(element, f"{what} has {problem}, {known(_TYPES, kind or None)}")
        ends = []
        for end in ("predecessor", "successor"):
            tag = xml.only(element, end, what)
            link = "" if tag is None else tag.get("link", "").strip()
            if not link:
                raise xml.fail(element, f'{what} has no {end}, add <{end} link="..."/>')
            if link not in links:
                raise xml.fail(tag, f"{what} has the unknown {end} '{link}', {known(links, link)}")
            if f"{name}_{end}" in links:
                raise xml.fail(
                    links[f"{name}_{end}"],
                    f"link '{name}_{end}' has the name of a frame of {what}, rename one",
                )
            placement = xml.placement(tag, f"the {end} of {what}")
            ends.append(LoopFrame(f"{name}_{end}", link, placement, where))
        axis = xml.direction(element, what, _X)
        kind = "revolute" if kind == "continuous" else kind
        loops.append(LoopSpec(name, kind, ends[0].name, ends[1].name, axis, where))
        frames += ends
    return tuple(loops), tuple(frames)


def independent(xml: XmlFile, joints: Mapping[str, etree._Element]) -> tuple[str, ...] | None:
    """Moving joints marked `independent="true"`; None where no joint has the attribute.

    Raises:
        DescriptionError: The attribute is neither true nor false, or stands on a fixed joint.
    """
    marked = {name: joint for name, joint in joints.items() if "independent" in joint.attrib}
    for name, joint in marked.items():
        value = joint.get("independent")
        if value not in ("true", "false"):
            raise xml.fail(
                joint, f"independent=\"{value}\" of joint '{name}' is neither true nor false"
            )
        if value == "true" and joint.get("type") == "fixed":
            raise xml.fail(joint, f"joint '{name}' is fixed and independent, keep one of the two")
    if not marked:
        return None
    out: list[str] = []
    for name, joint in marked.items():
        kind = joint.get("type")
        if joint.get("independent") == "false":
            continue
        out += names_of(name, parts_of(kind, (0.0, 0.0, 1.0))) if kind in SEVERAL else [name]
    return tuple(out)
