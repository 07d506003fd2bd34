"""Strict reading of URDF files: what other readers swallow silently is caught here."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lxml import etree

from crane.common.errors import known
from crane.description.findings import FollowUpError, flag, recoverable, remember_file
from crane.description.spec import Coupling, ForceElement, Friction, LoopSpec
from crane.description.tree import Joint, Link, Tree
from crane.formats.opening import opened
from crane.formats.series import SEVERAL
from crane.formats.urdf.constraints import read_constraints
from crane.formats.urdf.couplings import read_coupling
from crane.formats.urdf.elements import (
    read_friction,
    read_joint,
    read_limits,
    read_link,
    read_several,
)
from crane.formats.urdf.graph import MOVING, read_graph
from crane.formats.urdf.home import read_home, read_tip
from crane.formats.urdf.loops import independent, read_loops
from crane.formats.urdf.strangers import warn_of_strangers
from crane.formats.xml import XmlFile

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
        name: The robot's.
        tree: Its links and joints.
        root: Name of the root link.
        loops: Loops of `<loop>` elements.
        independent: Joints marked `independent="true"`; None where no joint has the attribute.
        friction: Friction of `<dynamics>` elements.
        couplings: Joints that mimic another, and `<coupling>` elements.
        home: Coordinates of the group state "home".
        home_lines: File and line of each.
        tip: Link of the end effector "tip".
        complete: Whether all elements have names of their own, if not only some are here.
        springs: Of a format that has some.
    """

    file: Path
    name: str
    tree: Tree
    root: str
    loops: tuple[LoopSpec, ...]
    independent: tuple[str, ...] | None
    friction: Mapping[str, Friction]
    couplings: tuple[Coupling, ...]
    home: Mapping[str, float] = field(default_factory=dict)
    home_lines: Mapping[str, str] = field(default_factory=dict)
    tip: str | None = None
    complete: bool = True
    springs: tuple[ForceElement, ...] = ()

    @property
    def moving(self) -> tuple[str, ...]:
        """Its moving joints."""
        return tuple(joint.name for joint in self.tree.moving)


def read_urdf(file: Path, edit: Callable[[XmlFile], None] | None = None) -> Urdf:
    """Read and check one URDF, or what stands for one, see `crane.formats.opening`.

    Args:
        file: The file.
        edit: Changes its elements before they are read.

    Raises:
        DescriptionError: With file, line, and what is wrong.
    """
    source = opened(file)
    xml = source.xml
    remember_file(xml)
    if xml.root.tag != "robot":
        raise xml.fail(xml.root, f"a URDF starts with <robot>, this file with <{xml.root.tag}>")
    read_constraints(xml)
    xml.check(xml.root, _CHILDREN, _ATTRIBUTES, _EXACT)
    if edit is not None:
        edit(xml)
    for tag, now in _EARLY.items():
        for element in xml.root.iterfind(tag):
            flag(xml.fail(element, f"<{tag}> is not read, URDF+ has <{now}> for it: write one"))
    links, joints = _named(xml, "link"), _named(xml, "joint")
    warn_of_strangers(xml, _CHILDREN, _ATTRIBUTES, joints)
    if not links:
        raise xml.fail(xml.root, "no <link> in this file, add one")
    ends, root, cut = read_graph(xml, links, joints)
    moved = {ends[name][1] for name, joint in joints.items() if joint.get("type") != "fixed"}
    parts: list[Link | Joint] = []
    for name, link in links.items():
        with recoverable():
            parts.append(read_link(xml, name, link, name in moved))
    friction: dict[str, Friction | None] = {}
    for name, joint in joints.items():
        if joint.get("type") in SEVERAL:
            parts += _series(xml, name, ends[name], links, joints)
            continue
        parts += _single(xml, name, joint, ends[name], name in cut)
        with recoverable(harmless=True):
            friction[name] = read_friction(xml, name, joint)
    driven = independent(xml, joints)
    loops, frames = read_loops(xml, _named(xml, "loop"), links)
    for frame in frames:
        parts.append(Link(frame.child, frame.where))
        if (same := joints.get(frame.name)) is not None:
            flag(xml.fail(same, f"joint '{frame.name}' has the name of a loop's, rename it"))
            continue
        parts.append(frame)
    couplings = _mimics(xml, joints, driven)
    for name, element in _named(xml, "coupling").items():
        with recoverable():
            couplings += (read_coupling(xml, name, element, joints, ends, links),)
    tree = Tree({}, {}).replacing(*parts)
    home, home_lines = read_home(xml, {joint.name for joint in tree.moving})
    return Urdf(
        file,
        xml.root.get("name") or file.stem,
        tree,
        root,
        loops,
        driven,
        {name: found for name, found in friction.items() if found is not None},
        couplings,
        home,
        home_lines,
        read_tip(xml, links),
        complete=not xml.nameless,
        springs=source.springs,
    )


def _single(
    xml: XmlFile, name: str, joint: etree._Element, ends: tuple[str, str], cut: bool
) -> list[Link | Joint]:
    """A joint with one freedom, or none; without limits where they are wrong."""
    found: list[Link | Joint] = []
    with recoverable():
        read = dataclasses.replace(read_joint(xml, name, joint, ends), cut=cut)
        found = [read]
        if read.moves:
            found = [dataclasses.replace(read, limits=read_limits(xml, name, joint))]
    return found


def _series(
    xml: XmlFile,
    name: str,
    ends: tuple[str, str],
    links: Mapping[str, etree._Element],
    joints: Mapping[str, etree._Element],
) -> list[Link | Joint]:
    """What a joint with several freedoms becomes, without parts whose names are taken."""
    made: list[Link | Joint] = []
    with recoverable():
        made = read_several(xml, name, joints[name], ends)
    found = []
    for part in made:
        kind, taken = ("link", links) if isinstance(part, Link) else ("joint", joints)
        if part.name in taken:
            problem = f"its {kind} '{part.name}' is there already, rename one"
            flag(xml.fail(joints[name], problem))
        else:
            found.append(part)
    return found


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
        with recoverable():
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
            flag(xml.fail(element, f'a {kind} has no name, add name="..."'))
        elif name in found:
            xml.nameless.add(kind)
            first = xml.where(found[name]).rpartition(":")[2]
            problem = f"{kind} '{name}' is there twice (first in line {first}), rename one"
            flag(xml.fail(element, problem))
        else:
            found[name] = element
    return found
