"""Couplings in a URDF: the element <coupling> of URDF+ (Chignoli et al., arXiv 2411.19753)."""

from collections.abc import Mapping

from lxml import etree

from crane.common.errors import suggest_names
from crane.description.specification import Coupling
from crane.formats.joint_series import MULTI_FREEDOM_TYPES
from crane.formats.xml_file import XmlFile

_COUPLING_TYPES = ("rolling",)  # belts, chains and gears; without a type it means the same


def read_coupling(
    xml: XmlFile,
    name: str,
    element: etree._Element,
    joints: Mapping[str, etree._Element],
    end_links: Mapping[str, tuple[str, str]],
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
        end_links: Parent and child link by joint.
        links: The `<link>` elements by name.

    Raises:
        DescriptionError: It is malformed, or binds nothing.
    """
    label = f"coupling '{name}'"
    kind = element.get("type", _COUPLING_TYPES[0])
    if kind not in _COUPLING_TYPES:
        raise xml.error_at(
            element,
            f"{label} has the unknown type '{kind}', {suggest_names(_COUPLING_TYPES, kind)}",
        )
    parents = {
        child: (parent, joint) for joint, (parent, child) in end_links.items() if parent and child
    }
    paths = []
    for end in ("predecessor", "successor"):
        tag = xml.single_child(element, end, label)
        link = "" if tag is None else tag.get("link", "").strip()
        if not link:
            raise xml.error_at(element, f'{label} has no {end}, add <{end} link="..."/>')
        if link not in links:
            raise xml.error_at(
                tag, f"{label} has the unknown {end} '{link}', {suggest_names(links, link)}"
            )
        path = []
        while link in parents:
            link, joint = parents[link]
            path.append(joint)
        paths.append(path[::-1])
    common_count = 0  # joints from the root to the nearest common ancestor
    while (
        all(len(way) > common_count for way in paths)
        and paths[0][common_count] == paths[1][common_count]
    ):
        common_count += 1
    predecessor_joints, successor_joints = (
        [joint for joint in way[common_count:] if joints[joint].get("type") != "fixed"]
        for way in paths
    )
    for joint in (*predecessor_joints, *successor_joints):
        if joints[joint].get("type") in MULTI_FREEDOM_TYPES:
            raise xml.error_at(
                element,
                f"{label} counts the joint '{joint}', which has several freedoms: use others",
            )
    tag = xml.single_child(element, "ratio", label)
    ratio = 1.0 if tag is None else xml.number(tag, "value", f"the ratio of {label}")
    factors = dict.fromkeys(reversed(successor_joints), 1.0) | dict.fromkeys(
        predecessor_joints if ratio else (), -ratio
    )
    if not factors:
        raise xml.error_at(element, f"{label} binds no joint, name two links that move")
    return Coupling(name, factors, 0.0, xml.source_location(element))
