"""Strict reading of URDF files: what Pinocchio would swallow silently is caught here."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from lxml import etree

from crane.description.findings import FollowUpError, kept, note, noted
from crane.description.inertia import inertia_problem
from crane.description.series import SEVERAL, parts_of, write_series
from crane.description.spec import Coupling, Friction, LoopSpec
from crane.description.urdf_couplings import read_coupling
from crane.description.urdf_home import read_home, read_tip
from crane.description.urdf_loops import Placement, independent, read_loops, unknown_link
from crane.description.xml import XmlFile
from crane.errors import CraneWarning, DescriptionError, known

MOVING = ("revolute", "continuous", "prismatic")

_CHILDREN = {
    "robot": {
        "link", "joint", "loop", "coupling", "material", "transmission", "gazebo", "group_state",
        "end_effector",
    },
    "link": {"origin", "inertial", "visual", "collision"},
    "joint": {
        "origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "calibration",
        "safety_controller",
    },
    "loop": {"predecessor", "successor", "axis", "limit", "dynamics"},
    "coupling": {"predecessor", "successor", "ratio"},
    "group_state": {"joint"},
    "predecessor": {"origin"},
    "successor": {"origin"},
    "inertial": {"origin", "mass", "inertia"},
    "visual": {"origin", "geometry", "material"},
    "collision": {"origin", "geometry", "material"},
}  # fmt: skip
_ATTRIBUTES = {
    "link": {"name", "between"},
    "joint": {"name", "type", "independent"},
    "loop": {"name", "type"},
    "coupling": {"name", "type"},
    "ratio": {"value"},
    "parent": {"link"},
    "child": {"link"},
    "predecessor": {"link"},
    "successor": {"link"},
    "origin": {"xyz", "rpy"},
    "axis": {"xyz"},
    "mass": {"value"},
    "inertia": {"ixx", "ixy", "ixz", "iyy", "iyz", "izz"},
    "limit": {"lower", "upper", "effort", "velocity"},
    "dynamics": {"damping", "friction"},
}
_EXACT = {"origin", "axis", "mass", "inertia"}
_EARLY = {"loop_constraint": "loop", "joint_constraint": "coupling"}  # before URDF+ was published


@dataclass(frozen=True)
class Urdf:
    """A checked URDF.

    Attributes:
        file: The file.
        robot: Its links and joints for the dynamics, written anew in plain numbers.
        root: Name of the root link.
        lines: File and line of each link and joint, as ("link", name) or ("joint", name).
        loops: Loops of `<loop>` elements.
        independent: Joints marked `independent="true"`; None where no joint has the attribute.
        friction: Friction of `<dynamics>` elements.
        couplings: Joints that mimic another, and `<coupling>` elements.
        home: Coordinates of the group state "home".
        home_lines: File and line of each.
        tip: Link of the end effector "tip".
        complete: Whether all elements have names of their own, if not only some are here.
    """

    file: Path
    robot: etree._Element
    root: str
    lines: Mapping[tuple[str, str], str]
    loops: tuple[LoopSpec, ...]
    independent: tuple[str, ...] | None
    friction: Mapping[str, Friction]
    couplings: tuple[Coupling, ...]
    home: Mapping[str, float] = field(default_factory=dict)
    home_lines: Mapping[str, str] = field(default_factory=dict)
    tip: str | None = None
    complete: bool = True

    @property
    def moving(self) -> tuple[str, ...]:
        """Its moving joints."""
        joints = self.robot.iter("joint")
        return tuple(joint.get("name") for joint in joints if joint.get("type") in MOVING)


def is_urdf(file: Path) -> bool:
    """Whether an XML file holds a robot and no MuJoCo model."""
    return bool(XmlFile(file).root.tag == "robot")


def read_urdf(file: Path, edit: Callable[[XmlFile], None] | None = None) -> Urdf:
    """Read and check one URDF.

    Args:
        file: The file.
        edit: Changes its elements before they are read.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    xml = XmlFile(file)
    noted(xml)
    if xml.root.tag != "robot":
        raise xml.fail(xml.root, f"a URDF starts with <robot>, this file with <{xml.root.tag}>")
    xml.check(xml.root, _CHILDREN, _ATTRIBUTES, _EXACT)
    if edit is not None:
        edit(xml)
    for tag, now in _EARLY.items():
        for element in xml.root.iterfind(tag):
            note(xml.fail(element, f"<{tag}> is not read, URDF+ has <{now}> for it: write one"))
    links, joints = _named(xml, "link"), _named(xml, "joint")
    if not links:
        raise xml.fail(xml.root, "no <link> in this file, add one")
    robot = etree.Element("robot", name=xml.root.get("name") or file.stem)
    ends = {name: _ends(xml, name, joint, links) for name, joint in joints.items()}
    root = _root(xml, links, joints, ends)
    moved = {ends[name][1] for name, joint in joints.items() if joint.get("type") != "fixed"}
    for name, link in links.items():
        with kept():
            _write_link(xml, name, link, name in moved, robot)
    friction = {}
    made: dict[tuple[str, str], str] = {}
    for name, joint in joints.items():
        if joint.get("type") in SEVERAL:
            with kept():
                made |= _write_several(xml, name, joint, ends[name], robot)
            continue
        with kept():
            _write_joint(xml, name, joint, ends[name], robot)
        with kept(harmless=True):
            if (found := _friction(xml, name, joint)) is not None:
                friction[name] = found
    lines = {
        (kind, name): xml.where(element)
        for kind, elements in (("link", links), ("joint", joints))
        for name, element in elements.items()
    }
    for (kind, name), where in made.items():
        if (kind, name) in lines:
            note(DescriptionError(f"{where}: its {kind} '{name}' is there already, rename one"))
    lines |= made
    driven = independent(xml, joints)
    loops, frames = read_loops(xml, _named(xml, "loop"), links)
    for frame in frames:
        etree.SubElement(robot, "link", name=frame.name)
        joint = f"{frame.name}_fixed"
        lines["link", frame.name] = frame.where
        if joint in joints:
            note(xml.fail(joints[joint], f"joint '{joint}' has the name of a loop's, rename it"))
            continue
        _add_joint(robot, joint, "fixed", frame.placement, (frame.link, frame.name))
        lines["joint", joint] = frame.where
    couplings = _mimics(xml, joints, driven)
    for name, element in _named(xml, "coupling").items():
        with kept():
            couplings += (read_coupling(xml, name, element, joints, ends, links),)
    moving = {joint.get("name") for joint in robot.iter("joint") if joint.get("type") in MOVING}
    home, home_lines = read_home(xml, moving)
    return Urdf(
        file,
        robot,
        root,
        lines,
        loops,
        driven,
        friction,
        couplings,
        home,
        home_lines,
        read_tip(xml, links),
        complete=not xml.nameless,
    )


def _mimics(
    xml: XmlFile, joints: Mapping[str, etree._Element], driven: tuple[str, ...] | None
) -> tuple[Coupling, ...]:
    """Couplings q = multiplier q_other + offset of joints that mimic another."""
    moving = [name for name, joint in joints.items() if joint.get("type") in MOVING]
    found = []
    for name, joint in joints.items():
        mimic = xml.only(joint, "mimic", f"joint '{name}'")
        if mimic is None or name not in moving:
            continue
        with kept():
            found.append(_mimic(xml, name, mimic, joints, moving, driven or ()))
    return tuple(found)


def _mimic(
    xml: XmlFile,
    name: str,
    mimic: etree._Element,
    joints: Mapping[str, etree._Element],
    moving: Sequence[str],
    driven: Sequence[str],
) -> Coupling:
    other = mimic.get("joint", "")
    if other not in joints and "joint" in xml.nameless:
        raise FollowUpError(f"joint '{other}' may be one without a name")
    if other not in moving:
        what = (
            f"mimics '{other}', which does not move"
            if other in joints
            else (f"mimics the unknown joint '{other}'")
        )
        raise xml.fail(mimic, f"joint '{name}' {what}, {known(moving, other)}")
    if other == name:
        raise xml.fail(mimic, f"joint '{name}' mimics itself, name another")
    if name in driven:
        raise xml.fail(
            mimic, f"joint '{name}' mimics '{other}' and is independent, keep one of the two"
        )
    multiplier = xml.number(mimic, "multiplier", f"the mimic of '{name}'", 1.0)
    offset = xml.number(mimic, "offset", f"the mimic of '{name}'", 0.0)
    factors = {name: 1.0, other: -multiplier} if multiplier else {name: 1.0}
    return Coupling(f"{name}_mimic", factors, offset, xml.where(mimic))


def _named(xml: XmlFile, kind: str) -> dict[str, etree._Element]:
    """Elements of one kind by their names."""
    found: dict[str, etree._Element] = {}
    for element in xml.root.iterfind(kind):
        name = element.get("name", "").strip()
        if not name:
            xml.nameless.add(kind)
            note(xml.fail(element, f'a {kind} has no name, add name="..."'))
        elif name in found:
            xml.nameless.add(kind)
            first = found[name].sourceline
            problem = f"{kind} '{name}' is there twice (first in line {first}), rename one"
            note(xml.fail(element, problem))
        else:
            found[name] = element
    return found


def _ends(
    xml: XmlFile, name: str, joint: etree._Element, links: Mapping[str, etree._Element]
) -> tuple[str, str]:
    """Parent and child link of a joint of a known type; "" for one that was noted as wrong."""
    what, kinds = f"joint '{name}'", (*MOVING, *SEVERAL, "fixed")
    kind = joint.get("type")
    if kind not in kinds:
        note(
            xml.fail(
                joint,
                f"{what} has no type, {known(kinds)}"
                if not kind
                else f"{what} has the type '{kind}', which is not supported, {known(kinds, kind)}",
            )
        )
        near = get_close_matches(kind or "", kinds, 1, 0.75)
        joint.set("type", near[0] if near else "continuous")
        if joint.find("limit") is None:  # whatever it is, nobody has to miss limits
            etree.SubElement(joint, "limit", lower="-1", upper="1")
    ends = []
    for end in ("parent", "child"):
        tag = xml.only(joint, end, what)
        link = "" if tag is None else tag.get("link", "").strip()
        if not link:
            note(xml.fail(joint, f'{what} has no {end} link, add <{end} link="..."/>'))
        elif link not in links:
            with kept():
                raise unknown_link(xml, tag, f"{what} has the unknown {end}", link, links)
            link = ""
        ends.append(link)
    if ends[0] and ends[0] == ends[1]:
        note(xml.fail(joint, f"{what} joins link '{ends[0]}' to itself, change one end"))
        return "", ""
    return ends[0], ends[1]


def _root(
    xml: XmlFile,
    links: Mapping[str, etree._Element],
    joints: Mapping[str, etree._Element],
    ends: Mapping[str, tuple[str, str]],
) -> str:
    """The one link without a parent of joints that form a tree."""
    above: dict[str, tuple[str, str]] = {}  # link -> parent, joint
    for name, (parent, child) in ends.items():
        if child in above:
            note(
                xml.fail(
                    joints[name],
                    f"link '{child}' has two parents, joints '{above[child][1]}' and '{name}': "
                    "keep one and close the other as a loop",
                )
            )
        elif child:
            above[child] = (parent, name)
    roots = [name for name in links if name not in above]
    passed = {""}  # links whose ancestors have been looked at
    for name in links:
        seen, at = {name}, name
        while at in above and at not in passed:
            at = above[at][0]
            if at in seen:
                note(
                    xml.fail(
                        joints[above[at][1]],
                        f"link '{at}' is its own ancestor: cut the ring of joints at "
                        f"'{above[at][1]}' and close it as a loop",
                    )
                )
                break
            seen.add(at)
        passed |= seen
    lost = len(xml.root.findall("joint")) - len(above)  # joints that may have had a root as child
    if len(roots) - lost > 1:
        listed = ", ".join(roots[:4]) + (", ..." if len(roots) > 4 else "")
        note(
            xml.fail(
                links[roots[1]], f"{len(roots)} links have no parent ({listed}): join all but one"
            )
        )
    return roots[0] if roots else next(iter(links))


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


def _add_origin(clean: etree._Element, placement: Placement) -> None:
    xyz, rpy = placement
    etree.SubElement(clean, "origin", xyz=_text(*xyz), rpy=_text(*rpy))


def _add_joint(
    robot: etree._Element, name: str, kind: str, placement: Placement, ends: tuple[str, str]
) -> etree._Element:
    joint = etree.SubElement(robot, "joint", name=name, type=kind)
    _add_origin(joint, placement)
    etree.SubElement(joint, "parent", link=ends[0])
    etree.SubElement(joint, "child", link=ends[1])
    return joint


def _write_link(
    xml: XmlFile, name: str, link: etree._Element, moved: bool, robot: etree._Element
) -> None:
    what = f"link '{name}'"
    clean = etree.SubElement(robot, "link", name=name)
    if (series := link.get("between")) is not None and link.find("inertial") is None:
        clean.set("between", series)
    with kept():
        if any(map(any, xml.placement(link, what))):
            raise xml.fail(link, f"{what} has an <origin>, which is its joint's: move it there")
    with kept(harmless=True):
        for drawn in (*link.iterfind("visual"), *link.iterfind("collision")):
            xml.placement(drawn, f"a {drawn.tag} of {what}")
    with kept(harmless=True):
        inertial = xml.only(link, "inertial", what)
        if inertial is not None:
            clean.set("refused", "inertial")
            _write_inertial(xml, what, inertial, moved, clean)
            del clean.attrib["refused"]


def _write_inertial(
    xml: XmlFile, what: str, inertial: etree._Element, moved: bool, clean: etree._Element
) -> None:
    mass_tag, tensor_tag = (xml.only(inertial, tag, what) for tag in ("mass", "inertia"))
    for tag, found in (("mass", mass_tag), ("inertia", tensor_tag)):
        if found is None:
            note(xml.fail(inertial, f"the inertial of {what} has no <{tag}>, add it"))
    placement = xml.placement(inertial, what)
    if mass_tag is None or tensor_tag is None:
        raise FollowUpError(f"{what} has no inertia")
    mass = xml.number(mass_tag, "value", f"the mass of {what}")
    tensor = {
        key: xml.number(tensor_tag, key, f"the inertia of {what}")
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    }
    if mass < 0:
        raise xml.fail(mass_tag, f"{what} has the mass {mass:g} kg, give a positive one")
    if not all(map(math.isfinite, (mass, *tensor.values(), *placement[0], *placement[1]))):
        raise FollowUpError(f"{what} has no inertia")
    xx, xy, xz, yy, yz, zz = tensor.values()
    if problem := inertia_problem(mass, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])):
        error = xml.fail(tensor_tag, f"{what} has {problem}")
        if moved:
            raise error
        # rigidly attached, it only adds to another body, whose sum is checked later
        warnings.warn(str(error), CraneWarning, stacklevel=2)
    written = etree.SubElement(clean, "inertial")
    _add_origin(written, placement)
    etree.SubElement(written, "mass", value=_text(mass))
    etree.SubElement(written, "inertia", {key: _text(value) for key, value in tensor.items()})


def _write_joint(
    xml: XmlFile,
    name: str,
    joint: etree._Element,
    ends: tuple[str, str],
    robot: etree._Element,
) -> None:
    what, kind = f"joint '{name}'", joint.get("type")
    xml.only(joint, "mimic", what)
    clean = _add_joint(robot, name, kind, xml.placement(joint, what), ends)
    if kind != "fixed":
        axis = xml.direction(joint, what, (1.0, 0.0, 0.0))
        etree.SubElement(clean, "axis", xyz=_text(*axis))
        _write_limit(xml, what, joint, clean)


def _write_several(
    xml: XmlFile,
    name: str,
    joint: etree._Element,
    ends: tuple[str, str],
    robot: etree._Element,
) -> dict[tuple[str, str], str]:
    """A joint with several freedoms as a series; what was added, and where it was written."""
    what, kind = f"joint '{name}'", joint.get("type")
    for tag in ("dynamics", "mimic"):
        if (found := xml.only(joint, tag, what)) is not None:
            problem = f"{what} is {kind}, for which <{tag}> has no meaning, remove it"
            note(xml.fail(found, problem))
    axis = xml.direction(joint, what, (1.0, 0.0, 0.0))
    xyz, rpy = xml.placement(joint, what)
    origin = {"xyz": _text(*xyz), "rpy": _text(*rpy)}
    added = write_series(robot, name, parts_of(kind, axis), origin, ends)
    return dict.fromkeys(added, xml.where(joint))


def _write_limit(xml: XmlFile, what: str, joint: etree._Element, clean: etree._Element) -> None:
    kind, limit = joint.get("type"), xml.only(joint, "limit", what)
    if limit is None:
        if kind != "continuous":
            etree.SubElement(clean, "limit")
            raise xml.fail(joint, f"{what} is {kind} and has no <limit>, add one")
        return
    values = {}
    for key in ("effort", "velocity"):
        with kept(harmless=True):
            if limit.get(key) is not None:
                value = xml.number(limit, key, f"the limit of {what}")
                if value < 0:
                    problem = f"the {key} limit of {what} is negative, make it positive"
                    raise xml.fail(limit, problem)
                if math.isfinite(value):
                    values[key] = value
    if kind != "continuous":
        lower, upper = (
            xml.number(limit, key, f"the limit of {what}", 0.0) for key in ("lower", "upper")
        )
        problem = ""
        if lower > upper:
            problem = f"the limits of {what} are reversed ({lower:g} > {upper:g}), swap them"
        if lower == upper:
            both = f"lower and upper limit of {what} are both {lower:g}"
            problem = f"{both}, widen them or make it fixed"
        if problem:
            note(xml.fail(limit, problem))
        values |= {"lower": lower, "upper": upper}
    etree.SubElement(clean, "limit", {key: _text(value) for key, value in values.items()})


def _friction(xml: XmlFile, name: str, joint: etree._Element) -> Friction | None:
    what = f"joint '{name}'"
    tag = xml.only(joint, "dynamics", what)
    if tag is None or joint.get("type") == "fixed":
        return None
    damping, friction = (
        xml.number(tag, key, f"the dynamics of {what}", 0.0) for key in ("damping", "friction")
    )
    if min(damping, friction) < 0:
        raise xml.fail(tag, f"damping or friction of {what} is negative, make it positive")
    return Friction(viscous=damping, coulomb=friction) if damping or friction else None
