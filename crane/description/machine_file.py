"""Machine files and single URDFs, read and checked into a `MachineSpec`."""

import copy
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from lxml import etree

from crane.description.section import Section
from crane.description.sources import find
from crane.description.spec import (
    LOOP_TYPES,
    Chain,
    EndStop,
    ForceElement,
    Friction,
    LoopSpec,
    MachineSpec,
    PIGains,
    Task,
)
from crane.description.urdf import MOVING, Urdf, read_urdf
from crane.errors import CraneWarning, DescriptionError, known


def read(name: str | Path) -> MachineSpec:
    """Read a machine by bundled name, path of a machine file, or path of a URDF.

    Raises:
        DescriptionError: With file, line, what is wrong, and the names that exist.
    """
    path = find(name)
    return _read_single(path) if path.suffix.lower() == ".urdf" else _read_machine(path)


def _read_single(path: Path) -> MachineSpec:
    urdf = read_urdf(path)
    chain = Chain(path.stem, path, None, f"{path.name}:1")
    tree = _Tree()
    tree.add(chain, urdf)
    if not tree.joints:
        raise DescriptionError(f"{path.name}: no joint moves in this file, add one")
    return MachineSpec(
        name=urdf.robot.get("name"),
        source=path.name,
        path=path,
        chains=(chain,),
        tree=tree.robot,
        loops=urdf.loops,
        active=urdf.independent,
        friction=urdf.friction,
        tip=tree.only_leaf(),
        where=tree.where,
    )


def _read_machine(path: Path) -> MachineSpec:
    top = Section.read(path)
    name, source = top.text("name"), top.text("source", "")
    chains, tree, friction = _chains(top, path)
    loops = tuple(_loop(item, tree) for item in top.sections("loops", "loop"))
    twice = {loop.name for loop in loops if [other.name for other in loops].count(loop.name) > 1}
    if twice:
        raise top.fail("loops", f"two loops are named '{min(twice)}', rename one")
    active = top.names("active")
    for joint in active:
        tree.check_joint(joint, top.where("active"))
    if not active:
        raise top.fail("active", "'active' is empty, name the driven joints")
    home = {}
    if (section := top.section("home")) is not None:
        for joint in section.keys():
            tree.check_joint(joint, section.where(joint))
            home[joint] = section.number(joint)
    friction |= _friction(top, tree)
    forces = tuple(_force(item, tree) for item in top.sections("forces", "force element"))
    end_stops = _end_stops(top, tree)
    tip = top.text("tip", None)
    if tip is not None and tip not in tree.links:
        raise top.fail("tip", f"the tip frame '{tip}' is unknown, {known(tree.links, tip)}")
    tasks = _tasks(top, active, tip)
    control = _control(top, active)
    top.done()
    where = {key: top.where(key) for key in top.keys()} | tree.where
    return MachineSpec(
        name, source, path, chains, tree.robot, loops, active, home, friction, forces,
        end_stops, tip, tasks, control, where,
    )  # fmt: skip


class _Tree:
    """The chains merged into one robot, so that Pinocchio builds it depth-first."""

    def __init__(self) -> None:
        self.robot = etree.Element("robot", name="machine")
        self.links: dict[str, str] = {}  # name -> where
        self.joints: dict[str, str] = {}  # moving joints, name -> where
        self.bodies: dict[str, str] = {}  # link -> the link it is rigidly attached to
        self.where: dict[str, str] = {}

    def add(self, chain: Chain, urdf: Urdf) -> None:
        """Hang a chain from its parent frame."""
        if chain.parent is not None:
            if chain.parent not in self.links:
                raise DescriptionError(
                    f"{chain.where}: chain '{chain.name}' hangs from the unknown frame "
                    f"'{chain.parent}', {known(self.links, chain.parent)}"
                )
            joint = etree.SubElement(
                self.robot, "joint", name=f"{chain.name}_attachment", type="fixed"
            )
            etree.SubElement(joint, "parent", link=chain.parent)
            etree.SubElement(joint, "child", link=urdf.root)
            self.bodies[urdf.root] = self.bodies[chain.parent]
        else:
            self.bodies[urdf.root] = urdf.root
        for element in urdf.robot:
            name, where = element.get("name"), urdf.where(element.tag, element.get("name"))
            names = self.links if element.tag == "link" else self.joints
            if name in names:
                raise DescriptionError(
                    f"{where}: {element.tag} '{name}' is also in {names[name]}, rename one"
                )
            if element.tag == "link" or element.get("type") in MOVING:
                names[name] = where
                self.where[f"{element.tag} {name}"] = where
            self.robot.append(copy.deepcopy(element))
        joints = {joint.find("child").get("link"): joint for joint in urdf.robot.iter("joint")}

        def body(link: str) -> str:
            if link not in self.bodies:
                joint = joints[link]
                fixed = joint.get("type") == "fixed"
                self.bodies[link] = body(joint.find("parent").get("link")) if fixed else link
            return self.bodies[link]

        for link in urdf.robot.iter("link"):
            body(link.get("name"))

    def only_leaf(self) -> str | None:
        """The last link of an unbranched chain."""
        parents = {tag.get("link") for tag in self.robot.iter("parent")}
        leaves = [name for name in self.links if name not in parents]
        return leaves[0] if len(leaves) == 1 else None

    def check_joint(self, joint: str, where: str) -> None:
        """Raise for a joint that does not exist."""
        if joint not in self.joints:
            raise DescriptionError(
                f"{where}: joint '{joint}' is unknown, {known(self.joints, joint)}"
            )

    def joint(self, section: Section) -> str:
        """The joint that a section names."""
        joint = section.text("joint")
        self.check_joint(joint, section.where("joint"))
        return joint

    def has_limits(self, joint: str) -> bool:
        """Whether a joint has a finite range."""
        (found,) = (e for e in self.robot.iter("joint") if e.get("name") == joint)
        return found.get("type") != "continuous"


def _chains(
    top: Section, path: Path
) -> tuple[tuple[Chain, ...], _Tree, dict[str, Friction]]:
    chains: list[Chain] = []
    tree = _Tree()
    friction: dict[str, Friction] = {}
    for item in top.sections("chains", "chain"):
        name, file = item.text("name"), item.text("urdf")
        if any(chain.name == name for chain in chains):
            raise item.fail("name", f"two chains are named '{name}', rename one")
        if not (path.parent / file).is_file():
            raise item.fail("urdf", f"chain '{name}': no file '{file}' beside the machine file")
        parent = item.text("parent", None)
        if chains and parent is None:
            raise item.fail(None, f"chain '{name}' has no 'parent', name a frame of {chains[0].name}")
        if not chains and parent is not None:
            raise item.fail("parent", f"chain '{name}' is first and stands on the world: no parent")
        item.done()
        chain = Chain(name, (path.parent / file).resolve(), parent, item.where())
        urdf = read_urdf(chain.urdf)
        if urdf.loops:
            raise DescriptionError(
                f"{urdf.loops[0].where}: <loop> in a sub-chain, write it under 'loops' of {path.name}"
            )
        tree.add(chain, urdf)
        chains.append(chain)
        friction |= urdf.friction
    if not chains:
        raise top.fail("chains", "there are no chains, add one under 'chains:'")
    if not tree.joints:
        raise top.fail("chains", "no joint of these chains moves, add one")
    return tuple(chains), tree, friction


def _loop(section: Section, tree: _Tree) -> LoopSpec:
    name, kind = section.text("name"), section.text("type")
    if kind not in LOOP_TYPES:
        raise section.fail("type", f"loop '{name}' has the type '{kind}', {known(LOOP_TYPES, kind)}")
    ends = []
    for end in ("predecessor", "successor"):
        frame = section.text(end)
        if frame not in tree.links:
            raise section.fail(
                end, f"loop '{name}': unknown {end} frame '{frame}', {known(tree.links, frame)}"
            )
        ends.append(frame)
    if tree.bodies[ends[0]] == tree.bodies[ends[1]]:
        raise section.fail(
            None,
            f"loop '{name}' joins '{ends[0]}' and '{ends[1]}' of one body "
            f"('{tree.bodies[ends[0]]}'), choose frames of two bodies",
        )
    axis = section.numbers("axis", (0.0, 0.0, 1.0))
    length = float(np.linalg.norm(axis))
    if len(axis) != 3 or not length > 0:
        raise section.fail("axis", f"the axis of loop '{name}' needs three numbers, not all zero")
    section.done()
    x, y, z = (value / length for value in axis)
    return LoopSpec(name, kind, ends[0], ends[1], (x, y, z), section.where())


def _friction(top: Section, tree: _Tree) -> dict[str, Friction]:
    found: dict[str, Friction] = {}
    section = top.section("friction")
    for joint in section.keys() if section else []:
        tree.check_joint(joint, section.where(joint))
        item = section.section(joint, f"friction of '{joint}'")
        if item is None:
            raise section.fail(joint, f"friction of '{joint}' is empty, give coulomb or viscous")
        friction = Friction(
            coulomb=item.number("coulomb", 0.0, minimum=0.0),
            coulomb_offset=item.number("coulomb_offset", 0.0),
            viscous=item.number("viscous", 0.0, minimum=0.0),
            viscous_offset=item.number("viscous_offset", 0.0),
            smoothing=item.number("smoothing", Friction.smoothing, minimum=0.0),
        )
        item.done()
        for kind in ("coulomb", "viscous"):
            mean, offset = getattr(friction, kind), getattr(friction, f"{kind}_offset")
            if abs(offset) > mean:
                warnings.warn(
                    f"{section.where(joint)}: friction of '{joint}' drives the joint in one "
                    f"direction (|{kind}_offset| {abs(offset):g} > {kind} {mean:g}), "
                    "a constant force may hide in it",
                    CraneWarning,
                    stacklevel=2,
                )
        found[joint] = friction
    return found


def _force(section: Section, tree: _Tree) -> ForceElement:
    element = ForceElement(
        tree.joint(section),
        stiffness=section.number("stiffness", 0.0, minimum=0.0),
        rest=section.number("rest", 0.0),
        damping=section.number("damping", 0.0, minimum=0.0),
        force=section.number("force", 0.0),
    )
    section.done()
    if element == ForceElement(element.joint, rest=element.rest):
        raise section.fail(None, f"no force on '{element.joint}', give stiffness, damping or force")
    return element


def _end_stops(top: Section, tree: _Tree) -> tuple[EndStop, ...]:
    section = top.section("end_stops")
    stops = []
    for joint in section.keys() if section else []:
        tree.check_joint(joint, section.where(joint))
        if not tree.has_limits(joint):
            raise section.fail(joint, f"joint '{joint}' has no limits to stop at, use a revolute")
        item = section.section(joint, f"end stop of '{joint}'")
        if item is None:
            raise section.fail(joint, f"end stop of '{joint}' is empty, give its stiffness")
        stiffness = item.number("stiffness", minimum=0.0)
        if stiffness == 0:
            raise item.fail("stiffness", f"the end stop of '{joint}' has no stiffness, give one")
        stops.append(EndStop(joint, stiffness, item.number("damping", 0.0, minimum=0.0)))
        item.done()
    return tuple(stops)


def _tasks(top: Section, active: tuple[str, ...], tip: str | None) -> dict[str, Task]:
    section = top.section("tasks")
    tasks = {}
    for name in section.keys() if section else []:
        item = section.section(name, f"task '{name}'")
        if item is None:
            raise section.fail(name, f"task '{name}' is empty, give duration and tip or active")
        description = item.text("description", "")
        duration = item.number("duration", minimum=0.0)
        if duration == 0:
            raise item.fail("duration", f"task '{name}' takes no time, give a duration")
        spaces: Mapping[str, tuple[str, ...]] = {"tip": ("x", "y", "z"), "active": active}
        found = {space: item.section(space, f"'{space}' of task '{name}'") for space in spaces}
        given = [space for space in spaces if found[space] is not None]
        if len(given) != 1:
            raise item.fail(None, f"task '{name}' needs either 'tip' or 'active'")
        space = given[0]
        if space == "tip" and tip is None:
            raise item.fail("tip", f"task '{name}' moves the tip, name its frame under 'tip:'")
        polynomials = found[space]
        assert polynomials is not None
        tasks[name] = Task(
            name, description, duration, space,
            {key: polynomials.numbers(key) for key in spaces[space]},
        )  # fmt: skip
        polynomials.done()
        item.done()
    return tasks


def _control(top: Section, active: tuple[str, ...]) -> dict[str, PIGains]:
    section = top.section("control")
    gains = {}
    for joint in section.keys() if section else []:
        if joint not in active:
            raise section.fail(joint, f"'{joint}' is not an active joint, {known(active, joint)}")
        item = section.section(joint, f"control of '{joint}'")
        if item is None:
            raise section.fail(joint, f"control of '{joint}' is empty, give kp and ki")
        gains[joint] = PIGains(item.number("kp", minimum=0.0), item.number("ki", minimum=0.0))
        item.done()
    missing = [joint for joint in active if section and joint not in gains]
    if missing:
        raise top.fail("control", f"no gains for {', '.join(missing)}, give kp and ki of each")
    return gains
