"""What is written alike in several formats: links and joints of URDF, words on what is lost."""

import copy
import dataclasses
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from lxml import etree

from crane.common.errors import CraneWarning, format_one_line
from crane.description import Coupling
from crane.description.kinematic_tree import NO_LIMIT, Joint, Limits, Link, Tree
from crane.formats.robot_files import open_robots
from crane.formats.visuals.mesh_files import find_mesh_file
from crane.machine import Machine


def format_numbers(values: Sequence[float] | np.ndarray) -> str:
    """Numbers with blanks between, exactly as they are."""
    return " ".join(repr(float(value) + 0.0) for value in np.ravel(values))


def finite_limits(limits: Limits) -> tuple[float, float] | None:
    """Lower and upper limit as files have them, None for a joint without limits."""
    if math.isinf(limits.lower) and math.isinf(limits.upper):
        return None
    return max(limits.lower, -NO_LIMIT), min(limits.upper, NO_LIMIT)


def add_origin(element: etree._Element, joint: Joint) -> None:
    """`<origin>` of a joint."""
    etree.SubElement(
        element, "origin", xyz=format_numbers(joint.xyz), rpy=format_numbers(joint.rpy)
    )


def add_link(robot: etree._Element, link: Link) -> None:
    """A `<link>` of URDF."""
    element = etree.SubElement(robot, "link", name=link.name)
    if link.composite_joint is not None:
        element.set("between", link.composite_joint)
    if (link_inertial := link.inertial) is None:
        return
    inertial = etree.SubElement(element, "inertial")
    etree.SubElement(
        inertial,
        "origin",
        xyz=format_numbers(link_inertial.com),
        rpy=format_numbers(link_inertial.rpy),
    )
    etree.SubElement(inertial, "mass", value=format_numbers([link_inertial.mass]))
    tensor = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), link_inertial.tensor, strict=True)
    etree.SubElement(inertial, "inertia", {key: format_numbers([value]) for key, value in tensor})


def with_floating_joints(machine: Machine) -> Tree:
    """The tree with a joint "floating" in place of the six of each body that floats."""
    tree = machine.tree
    links, joints = dict(tree.links), dict(tree.joints)
    for column in machine.coordinates.floating_base_columns:
        series = [joints[name] for name in machine.joints[column : column + 6]]
        for joint in series[:-1]:
            del links[joint.child]
        for joint in series:
            del joints[joint.name]
        first, last = series[0], series[-1]
        floating_joint = dataclasses.replace(
            first, name=first.floating_joint, kind="floating", child=last.child
        )
        joints[floating_joint.name] = floating_joint
    return Tree(links, joints)


def add_joint(robot: etree._Element, joint: Joint) -> etree._Element:
    """A `<joint>` of URDF with its limits.

    A joint that turns without limits is continuous. A slide, and a joint that is limited to one
    side, has to have both: 1e9 stands for none, and is read so.
    """
    limits = joint.limits
    limit_values = finite_limits(limits)
    is_unlimited = limit_values is None and joint.kind == "revolute"
    kind = "continuous" if is_unlimited else joint.kind
    element = etree.SubElement(robot, "joint", name=joint.name, type=kind)
    add_origin(element, joint)
    etree.SubElement(element, "parent", link=joint.parent)
    etree.SubElement(element, "child", link=joint.child)
    if joint.kind in ("fixed", "floating"):
        return element
    etree.SubElement(element, "axis", xyz=format_numbers(joint.axis))
    values = {key: min(getattr(limits, key), NO_LIMIT) for key in ("effort", "velocity")}
    if not is_unlimited:
        lower, upper = limit_values or (-NO_LIMIT, NO_LIMIT)
        values = {"lower": lower, "upper": upper} | values
    elif math.isinf(limits.effort) and math.isinf(limits.velocity):
        return element
    etree.SubElement(
        element, "limit", {key: format_numbers([value]) for key, value in values.items()}
    )
    return element


def copy_shapes(
    robot: etree._Element,
    machine: Machine,
    chains: Iterable[str] | None = None,
    uris: bool = False,
) -> None:
    """Copy what a machine's URDFs draw to the links of the same names.

    Args:
        robot: Where to.
        machine: The machine.
        chains: Names of those of its chains that are drawn, all if not given.
        uris: Whether meshes are named by URIs, as ROS needs them, and not by paths.
    """
    links = {link.get("name"): link for link in robot.iterfind("link")}
    materials: dict[str, etree._Element] = {}
    with open_robots(machine, chains) as sources:
        for xml in sources:
            for material in xml.root.iterfind("material"):
                materials.setdefault(material.get("name", ""), copy.deepcopy(material))
            _copy_link_shapes(xml.root, links, xml.file.parent, uris)
    for material in reversed(materials.values()):
        robot.insert(0, material)


def _copy_link_shapes(
    source: etree._Element, links: Mapping[str, etree._Element], folder: Path, uris: bool
) -> None:
    for link in source.iterfind("link"):
        target = links.get(link.get("name", "").strip())
        if target is None:
            continue
        for shape in (*link.iterfind("visual"), *link.iterfind("collision")):
            target.append(_with_mesh_paths(shape, folder, uris))


def _with_mesh_paths(shape: etree._Element, folder: Path, uris: bool) -> etree._Element:
    """A copy of what is drawn, its mesh named by its whole path where it is there.

    As URI, a mesh of a package keeps its name, which other computers understand, too.
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
    """A coupling solved for its first joint: q_0 = sum slope_i q_i + offset.

    Returns:
        All joints, slopes of those after the first, offset.
    """
    joints, factors = list(coupling.factors), list(coupling.factors.values())
    derivatives = [-factor / factors[0] + 0.0 for factor in factors[1:]]
    return joints, derivatives, coupling.offset / factors[0] + 0.0


def format_document(
    robot: etree._Element, comment: str, element_notes: Sequence[tuple[etree._Element, str]] = ()
) -> bytes:
    """A file of an element, indented, with a comment in the first line, and beside elements."""
    etree.indent(robot)
    for element, note in element_notes:
        comment_element = etree.Comment(f" {_comment_text(note)} ")
        parent = element.getparent()
        parent.insert(parent.index(element) + 1, comment_element)
        comment_element.tail, element.tail = element.tail, "  "
    header = f'<?xml version="1.0"?>\n<!-- {_comment_text(comment)} -->\n'
    return header.encode() + etree.tostring(robot, encoding="utf-8") + b"\n"


def _comment_text(comment: str) -> str:
    """Words that may stand in a comment."""
    return re.sub("-(?=-)", "- ", " ".join(format_one_line(comment).split())).strip(" -")


def origin_text(machine: Machine) -> str:
    """Words on where a written machine comes from."""
    return f"{machine.name}, written by crane; source: {machine.source or machine.path.name}"


def warn_about_unsupported(
    machine: Machine, format_name: str, names: Sequence[str] | Iterator[str]
) -> None:
    """Warn of what a format has no place for."""
    if names := list(names):
        warnings.warn(
            f"{machine.name}: {format_name} has no place for {', '.join(names)}, left out (a "
            f"machine "
            "file has)",
            CraneWarning,
            stacklevel=3,
        )


def add_friction(element: etree._Element, machine: Machine, joint: str) -> None:
    """`<dynamics>` of a joint that has Coulomb or viscous friction."""
    friction = machine.friction.get(joint)
    if friction is not None and (friction.viscous or friction.coulomb):
        values = {
            "damping": format_numbers([friction.viscous]),
            "friction": format_numbers([friction.coulomb]),
        }
        etree.SubElement(element, "dynamics", values)


def compound_drive_factors(machine: Machine) -> dict[str, dict[str, float]]:
    """Factors of all drives, where one acts along more than a joint."""
    drives = {drive.name: dict(drive.factors) for drive in machine.drives}
    is_plain = all(factors == {name: 1.0} for name, factors in drives.items())
    return {} if is_plain else drives


def rotor_inertias(machine: Machine) -> dict[str, float]:
    """Rotor inertias that are not zero, by joint."""
    joints = machine.tree.joints
    return {x: joints[x].rotor_inertia for x in machine.joints if joints[x].rotor_inertia}


def unsupported_friction(machine: Machine) -> list[str]:
    """Joints with a friction law of more than Coulomb and viscous friction."""
    return [
        f"the friction law of {joint}"
        for joint, law in machine.friction.items()
        if law.coulomb_offset or law.viscous_offset or law.stiction or (
            law.coulomb and law.smoothing
        )
    ]  # fmt: skip


def unsupported_sections(machine: Machine) -> list[str]:
    """Sections of a machine that no other format has."""
    sections = {
        "gas springs": machine.gas_springs,
        "end stops": machine.end_stops,
        "tasks": machine.tasks,
        "gains": machine.control,
        "hydraulics": machine.hydraulics,
    }
    return [name for name, section in sections.items() if section]
