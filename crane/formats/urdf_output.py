"""Parts that the writers of several formats share: shapes, couplings, drives, the document."""

import copy
import dataclasses
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from lxml import etree

from crane.common.errors import format_one_line
from crane.description.kinematic_tree import Tree
from crane.description.specification import Coupling
from crane.formats.robot_files import open_robots
from crane.formats.visuals.mesh_files import find_mesh_file
from crane.machine.machine import Machine


def with_floating_joints(machine: Machine) -> Tree:
    """Return the tree with a floating joint in place of the six joints of each floating base."""
    links, joints = dict(machine.tree.links), dict(machine.tree.joints)
    for column in machine.coordinates.floating_base_columns:
        series = [joints.pop(name) for name in machine.joints[column : column + 6]]
        for joint in series[:-1]:
            del links[joint.child]
        name = series[0].floating_joint
        joints[name] = dataclasses.replace(
            series[0], name=name, kind="floating", child=series[-1].child
        )
    return Tree(links, joints)


def copy_shapes(
    robot: etree._Element,
    machine: Machine,
    chains: Iterable[str] | None = None,
    uris: bool = False,
) -> None:
    """Copy visuals, collisions and materials of a machine's URDFs to the links of the same names.

    Args:
        robot: The `<robot>` that receives them.
        machine: The machine.
        chains: Names of the chains to copy from, all if not given.
        uris: Whether to name meshes by URIs, as ROS requires, instead of paths.
    """
    targets = {link.get("name"): link for link in robot.iterfind("link")}
    materials: dict[str, etree._Element] = {}
    with open_robots(machine, chains) as sources:
        shapes = [
            (xml.file.parent, link.get("name", "").strip(), shape)
            for xml in sources
            for link in xml.root.iterfind("link")
            for shape in (*link.iterfind("visual"), *link.iterfind("collision"))
        ]
        for material in (x for xml in sources for x in xml.root.iterfind("material")):
            materials.setdefault(material.get("name", ""), copy.deepcopy(material))
        for folder, name, shape in shapes:
            if name in targets:
                targets[name].append(_with_mesh_paths(shape, folder, uris))
    for material in reversed(materials.values()):
        robot.insert(0, material)


def _with_mesh_paths(shape: etree._Element, folder: Path, uris: bool) -> etree._Element:
    """Return a copy of a shape that names its mesh by an absolute path or URI if the file exists.

    As a URI, a mesh of a package keeps its `package://` name, which other computers can resolve.
    """
    shape = copy.deepcopy(shape)
    for mesh in shape.iter("mesh"):
        name = mesh.get("filename", "")
        if uris and name.startswith("package://"):
            continue
        if (file := find_mesh_file(name, folder)) is not None:
            mesh_path = file.resolve()
            mesh.set("filename", mesh_path.as_uri() if uris else str(mesh_path))
    return shape


def solve_coupling(coupling: Coupling) -> tuple[list[str], list[float], float]:
    """Solve a coupling for its first joint: q_0 = sum slope_i q_i + offset.

    Returns:
        Names of all joints, slopes of the joints after the first, offset.
    """
    joints, factors = list(coupling.factors), list(coupling.factors.values())
    slopes = [-factor / factors[0] + 0.0 for factor in factors[1:]]
    return joints, slopes, coupling.offset / factors[0] + 0.0


def format_document(
    robot: etree._Element, comment: str, element_notes: Sequence[tuple[etree._Element, str]] = ()
) -> bytes:
    """Return an indented XML document with a comment in its first line and beside elements."""
    etree.indent(robot)
    for element, note in element_notes:
        comment_element = etree.Comment(f" {_comment_text(note)} ")
        parent = element.getparent()
        parent.insert(parent.index(element) + 1, comment_element)
        comment_element.tail, element.tail = element.tail, "  "
    header = f'<?xml version="1.0"?>\n<!-- {_comment_text(comment)} -->\n'
    return header.encode() + etree.tostring(robot, encoding="utf-8") + b"\n"


def _comment_text(comment: str) -> str:
    """Return a text that is allowed in an XML comment."""
    return re.sub("-(?=-)", "- ", " ".join(format_one_line(comment).split())).strip(" -")


def origin_text(machine: Machine) -> str:
    """Return the comment that names the source of a written machine."""
    return f"{machine.name}, written by crane; source: {machine.source or machine.path.name}"


def compound_drive_factors(machine: Machine) -> dict[str, dict[str, float]]:
    """Return the factors of all drives if one of them acts along several joints, else nothing."""
    drives = {drive.name: dict(drive.factors) for drive in machine.drives}
    is_plain = all(factors == {name: 1.0} for name, factors in drives.items())
    return {} if is_plain else drives


def rotor_inertias(machine: Machine) -> dict[str, float]:
    """Return the rotor inertias that are not zero, by joint."""
    joints = machine.tree.joints
    return {x: joints[x].rotor_inertia for x in machine.joints if joints[x].rotor_inertia}
