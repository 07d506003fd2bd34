"""A URDF with other inertials."""

from collections.abc import Mapping
from pathlib import Path

import pinocchio as pin
from lxml import etree

from crane.common.samples import Array
from crane.formats.visuals.mesh_files import find_mesh_file

_INERTIA_INDICES = {
    "ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2),
}  # fmt: skip


def replace_inertials(
    file: Path, bodies: Mapping[str, Array], fixed_links: set[str], origin_text: str
) -> etree._ElementTree:
    """The tree of a URDF with other inertials, and without loops: their ends become links.

    Args:
        file: The URDF.
        bodies: Ten parameters about the origin of its frame by link that a joint moves.
        fixed_links: Links fixed to one of those, whose inertials are removed.
        origin_text: Where the numbers come from, for a comment.
    """
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    tree = etree.parse(str(file), parser)
    robot = tree.getroot()
    for link in robot.iterfind("link"):
        name = link.get("name").strip()
        inertial = link.find("inertial")
        if name in bodies:
            new_inertial = _inertial_element(bodies[name])
            if inertial is None:
                link.insert(0, new_inertial)
            else:
                new_inertial.tail = inertial.tail
                link.replace(inertial, new_inertial)
        elif name in fixed_links and inertial is not None:
            _remove_element(inertial)
    for mesh in robot.iter("mesh"):
        _resolve_mesh_path(mesh, file.parent)
    for loop in robot.findall("loop"):
        for end in ("predecessor", "successor"):
            _add_loop_frame(robot, loop, end)
        _remove_element(loop)
    comment = etree.Comment(f" Inertials: {origin_text}. ")
    comment.tail = robot.text or "\n"
    robot.text = "\n  "
    robot.insert(0, comment)
    return tree


def _inertial_element(body: Array) -> etree._Element:
    """<inertial> of ten parameters about the origin of the link's frame."""
    inertia = pin.Inertia.FromDynamicParameters(body)
    inertial = etree.Element("inertial")
    xyz = " ".join(map(repr, inertia.lever.tolist()))
    etree.SubElement(inertial, "origin", xyz=xyz, rpy="0 0 0")
    etree.SubElement(inertial, "mass", value=repr(float(inertia.mass)))
    tensor = {key: repr(float(inertia.inertia[at])) for key, at in _INERTIA_INDICES.items()}
    etree.SubElement(inertial, "inertia", tensor)
    inertial.text = inertial[0].tail = inertial[1].tail = "\n      "
    inertial[2].tail = inertial.tail = "\n    "
    return inertial


def _remove_element(element: etree._Element) -> None:
    """Remove an element, not what stands after it."""
    element.tail, tail = None, element.tail
    parent, previous = element.getparent(), element.getprevious()
    parent.remove(element)
    if previous is None:
        parent.text = (parent.text or "") + (tail or "")
    else:
        previous.tail = (previous.tail or "") + (tail or "")


def _resolve_mesh_path(mesh: etree._Element, folder: Path) -> None:
    """Name a mesh by its whole path, where it is there."""
    file = find_mesh_file(mesh.get("filename", ""), folder)
    if file is not None:
        mesh.set("filename", str(file.resolve()))


def _add_loop_frame(robot: etree._Element, loop: etree._Element, end: str) -> None:
    """The frame of a loop's end as a link, as a sub-chain has it."""
    loop_end = loop.find(end)
    name = f"{loop.get('name').strip()}_{end}"
    etree.SubElement(robot, "link", name=name)
    joint = etree.SubElement(robot, "joint", name=f"{name}_fixed", type="fixed")
    if (origin := loop_end.find("origin")) is not None:
        etree.SubElement(joint, "origin", dict(origin.attrib))
    etree.SubElement(joint, "parent", link=loop_end.get("link").strip())
    etree.SubElement(joint, "child", link=name)
