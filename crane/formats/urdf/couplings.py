"""Couplings in a URDF: the element <coupling> of URDF+ (Chignoli et al., arXiv 2411.19753)."""

from collections.abc import Mapping

from lxml import etree

from crane.common.errors import known
from crane.description.spec import Coupling
from crane.formats.series import SEVERAL
from crane.formats.xml import XmlFile

_TYPES = ("rolling",)  # belts, chains and gears; without a type it means the same


def read_coupling(
    xml: XmlFile,
    name: str,
    element: etree._Element,
    joints: Mapping[str, etree._Element],
    ends: Mapping[str, tuple[str, str]],
    links: Mapping[str, etree._Element],
) -> Coupling:
    """The linear constraint of a `<coupling>`.

    With the moving joints on the ways from the nearest common ancestor of both links down to the
    predecessor, P, and to the successor, S,

        ratio sum_P q = sum_S q.

    Coordinates count as they are, whichever way their axes point.

    Args:
        xml: The file.
        name: The coupling's name.
        element: The `<coupling>`.
        joints: The `<joint>` elements by name.
        ends: Parent and child link by joint.
        links: The `<link>` elements by name.

    Raises:
        DescriptionError: It is malformed, or binds nothing.
    """
    what = f"coupling '{name}'"
    kind = element.get("type", _TYPES[0])
    if kind not in _TYPES:
        raise xml.fail(element, f"{what} has the unknown type '{kind}', {known(_TYPES, kind)}")
    above = {child: (parent, joint) for joint, (parent, child) in ends.items() if parent and child}
    ways = []
    for end in ("predecessor", "successor"):
        tag = xml.only(element, end, what)
        link = "" if tag is None else tag.get("link", "").strip()
        if not link:
            raise xml.fail(element, f'{what} has no {end}, add <{end} link="..."/>')
        if link not in links:
            raise xml.fail(tag, f"{what} has the unknown {end} '{link}', {known(links, link)}")
        way = []
        while link in above:
            link, joint = above[link]
            way.append(joint)
        ways.append(way[::-1])
    shared = 0  # joints from the root to the nearest common ancestor
    while all(len(way) > shared for way in ways) and ways[0][shared] == ways[1][shared]:
        shared += 1
    before, after = (
        [joint for joint in way[shared:] if joints[joint].get("type") != "fixed"] for way in ways
    )
    for joint in (*before, *after):
        if joints[joint].get("type") in SEVERAL:
            raise xml.fail(
                element,
                f"{what} counts the joint '{joint}', which has several freedoms: use others",
            )
    tag = xml.only(element, "ratio", what)
    ratio = 1.0 if tag is None else xml.number(tag, "value", f"the ratio of {what}")
    factors = dict.fromkeys(reversed(after), 1.0) | dict.fromkeys(before if ratio else (), -ratio)
    if not factors:
        raise xml.fail(element, f"{what} binds no joint, name two links that move")
    return Coupling(name, factors, 0.0, xml.where(element))
