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

from crane.common.errors import CraneWarning, one_line
from crane.description import Coupling
from crane.description.tree import NO_LIMIT, Joint, Limits, Link, Tree
from crane.formats.opening import robots
from crane.formats.visuals.meshes import mesh_file
from crane.machine import Machine


def text(values: Sequence[float] | np.ndarray) -> str:
    """Numbers with blanks between, exactly as they are."""
    return " ".join(repr(float(value) + 0.0) for value in np.ravel(values))


def ends(limits: Limits) -> tuple[float, float] | None:
    """Lower and upper limit as files have them, None for a joint without limits."""
    if math.isinf(limits.lower) and math.isinf(limits.upper):
        return None
    return max(limits.lower, -NO_LIMIT), min(limits.upper, NO_LIMIT)


def add_origin(element: etree._Element, joint: Joint) -> None:
    """`<origin>` of a joint."""
    etree.SubElement(element, "origin", xyz=text(joint.xyz), rpy=text(joint.rpy))


def add_link(robot: etree._Element, link: Link) -> None:
    """A `<link>` of URDF."""
    element = etree.SubElement(robot, "link", name=link.name)
    if link.between is not None:
        element.set("between", link.between)
    if (mass := link.inertial) is None:
        return
    inertial = etree.SubElement(element, "inertial")
    etree.SubElement(inertial, "origin", xyz=text(mass.com), rpy=text(mass.rpy))
    etree.SubElement(inertial, "mass", value=text([mass.mass]))
    tensor = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), mass.tensor, strict=True)
    etree.SubElement(inertial, "inertia", {key: text([value]) for key, value in tensor})


def with_whole_flyers(machine: Machine) -> Tree:
    """The tree with a joint "floating" in place of the six of each body that floats."""
    tree = machine.tree
    links, joints = dict(tree.links), dict(tree.joints)
    for column in machine.coordinates.floating:
        series = [joints[name] for name in machine.joints[column : column + 6]]
        for joint in series[:-1]:
            del links[joint.child]
        for joint in series:
            del joints[joint.name]
        first, last = series[0], series[-1]
        whole = dataclasses.replace(first, name=first.floats, kind="floating", child=last.child)
        joints[whole.name] = whole
    return Tree(links, joints)


def add_joint(robot: etree._Element, joint: Joint) -> etree._Element:
    """A `<joint>` of URDF with its limits.

    A joint that turns without limits is continuous. A slide, and a joint that is limited to one
    side, has to have both: 1e9 stands for none, and is read so.
    """
    limits = joint.limits
    given = ends(limits)
    endless = given is None and joint.kind == "revolute"
    kind = "continuous" if endless else joint.kind
    element = etree.SubElement(robot, "joint", name=joint.name, type=kind)
    add_origin(element, joint)
    etree.SubElement(element, "parent", link=joint.parent)
    etree.SubElement(element, "child", link=joint.child)
    if joint.kind in ("fixed", "floating"):
        return element
    etree.SubElement(element, "axis", xyz=text(joint.axis))
    values = {key: min(getattr(limits, key), NO_LIMIT) for key in ("effort", "velocity")}
    if not endless:
        lower, upper = given or (-NO_LIMIT, NO_LIMIT)
        values = {"lower": lower, "upper": upper} | values
    elif math.isinf(limits.effort) and math.isinf(limits.velocity):
        return element
    etree.SubElement(element, "limit", {key: text([value]) for key, value in values.items()})
    return element


def draw(
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
    with robots(machine, chains) as sources:
        for xml in sources:
            for material in xml.root.iterfind("material"):
                materials.setdefault(material.get("name", ""), copy.deepcopy(material))
            _copy_shapes(xml.root, links, xml.file.parent, uris)
    for material in reversed(materials.values()):
        robot.insert(0, material)


def _copy_shapes(
    source: etree._Element, links: Mapping[str, etree._Element], folder: Path, uris: bool
) -> None:
    for link in source.iterfind("link"):
        target = links.get(link.get("name", "").strip())
        if target is None:
            continue
        for drawn in (*link.iterfind("visual"), *link.iterfind("collision")):
            target.append(_located(drawn, folder, uris))


def _located(drawn: etree._Element, folder: Path, uris: bool) -> etree._Element:
    """A copy of what is drawn, its mesh named by its whole path where it is there.

    As URI, a mesh of a package keeps its name, which other computers understand, too.
    """
    drawn = copy.deepcopy(drawn)
    for mesh in drawn.iter("mesh"):
        name = mesh.get("filename", "")
        if uris and name.startswith("package://"):
            continue
        if (file := mesh_file(name, folder)) is not None:
            place = file.resolve()
            mesh.set("filename", place.as_uri() if uris else str(place))
    return drawn


def linear(coupling: Coupling) -> tuple[list[str], list[float], float]:
    """A coupling solved for its first joint: q_0 = sum slope_i q_i + offset.

    Returns:
        All joints, slopes of those after the first, offset.
    """
    joints, factors = list(coupling.factors), list(coupling.factors.values())
    slopes = [-factor / factors[0] + 0.0 for factor in factors[1:]]
    return joints, slopes, coupling.offset / factors[0] + 0.0


def finished(
    robot: etree._Element, comment: str, notes: Sequence[tuple[etree._Element, str]] = ()
) -> bytes:
    """A file of an element, indented, with a comment in the first line, and beside elements."""
    etree.indent(robot)
    for element, note in notes:
        beside = etree.Comment(f" {_within(note)} ")
        parent = element.getparent()
        parent.insert(parent.index(element) + 1, beside)
        beside.tail, element.tail = element.tail, "  "
    head = f'<?xml version="1.0"?>\n<!-- {_within(comment)} -->\n'
    return head.encode() + etree.tostring(robot, encoding="utf-8") + b"\n"


def _within(comment: str) -> str:
    """Words that may stand in a comment."""
    return re.sub("-(?=-)", "- ", " ".join(one_line(comment).split())).strip(" -")


def origin_of(machine: Machine) -> str:
    """Words on where a written machine comes from."""
    return f"{machine.name}, written by crane; source: {machine.source or machine.path.name}"


def left_out(machine: Machine, what: str, names: Sequence[str] | Iterator[str]) -> None:
    """Warn of what a format has no place for."""
    if names := list(names):
        warnings.warn(
            f"{machine.name}: {what} has no place for {', '.join(names)}, left out (a machine "
            "file has)",
            CraneWarning,
            stacklevel=3,
        )


def add_friction(element: etree._Element, machine: Machine, joint: str) -> None:
    """`<dynamics>` of a joint that has Coulomb or viscous friction."""
    law = machine.friction.get(joint)
    if law is not None and (law.viscous or law.coulomb):
        values = {"damping": text([law.viscous]), "friction": text([law.coulomb])}
        etree.SubElement(element, "dynamics", values)


def drives_of(machine: Machine) -> dict[str, dict[str, float]]:
    """Factors of all drives, where one acts along more than a joint."""
    drives = {drive.name: dict(drive.factors) for drive in machine.drives}
    plain = all(factors == {name: 1.0} for name, factors in drives.items())
    return {} if plain else drives


def rotors_of(machine: Machine) -> dict[str, float]:
    """Rotor inertias that are not zero, by joint."""
    joints = machine.tree.joints
    return {x: joints[x].rotor_inertia for x in machine.joints if joints[x].rotor_inertia}


def plain_friction(machine: Machine) -> list[str]:
    """Joints with a friction law of more than Coulomb and viscous friction."""
    return [
        f"the friction law of {joint}"
        for joint, law in machine.friction.items()
        if law.coulomb_offset or law.viscous_offset or law.stiction or (
            law.coulomb and law.smoothing
        )
    ]  # fmt: skip


def only_in_machine_files(machine: Machine) -> list[str]:
    """Sections of a machine that no other format has."""
    sections = {
        "gas springs": machine.gas_springs,
        "end stops": machine.end_stops,
        "tasks": machine.tasks,
        "gains": machine.control,
        "hydraulics": machine.hydraulics,
    }
    return [name for name, section in sections.items() if section]
