"""Machine files and single URDFs, read and checked into a `MachineSpec`."""

import copy
import warnings
from pathlib import Path

from crane.description.circuit_section import read_hydraulics
from crane.description.section import Section
from crane.description.sources import find
from crane.description.spec import (
    LOOP_TYPES,
    Chain,
    Coupling,
    EndStop,
    ForceElement,
    Friction,
    GasSpring,
    LoopSpec,
    MachineSpec,
    PIGains,
    unit_vector,
)
from crane.description.tasks import read_tasks
from crane.description.tree import Tree
from crane.description.urdf import read_urdf
from crane.errors import CraneWarning, DescriptionError, known

_KEYS = (
    "name", "source", "chains", "loops", "active", "home", "friction", "forces",
    "gas_springs", "end_stops", "couplings",
    "tip", "payload", "tasks", "control", "hydraulics",
)  # fmt: skip


def read(name: str | Path) -> MachineSpec:
    """Read a machine by bundled name, path of a machine file, or path of a URDF.

    Raises:
        DescriptionError: With file, line, what is wrong, and the names that exist.
    """
    path = find(name)
    return _read_single(path) if path.suffix.lower() == ".urdf" else _read_machine(path)


def _read_single(path: Path) -> MachineSpec:
    urdf = read_urdf(path)
    chain = Chain(path.stem, path, None, path.name, urdf.moving)
    tree = Tree()
    tree.add(chain, urdf)
    if not tree.joints:
        raise DescriptionError(f"{path.name}: no joint moves in this file, add one")
    for loop in urdf.loops:
        tree.check_loop(loop)
    if urdf.loops and not urdf.independent:
        raise DescriptionError(
            f"{urdf.loops[0].where}: a loop, but no joint is driven, mark those that are "
            'with independent="true"'
        )
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
        couplings=urdf.couplings,
        where=tree.where | _places(urdf.loops, urdf.couplings),
    )


def _read_machine(path: Path) -> MachineSpec:
    top = Section.read(path, _KEYS)
    name, source = top.text("name"), top.text("source", "")
    chains, tree, friction, couplings = _chains(top, path)
    loops = _loops(top, tree)
    couplings += _couplings(top, tree)
    active = top.names("active")
    for joint in active:
        tree.check_joint(joint, top.where("active"))
    if not active:
        raise top.fail("active", "'active' is empty, name the driven joints")
    where = {key: top.where(key) for key in top} | tree.where
    where |= _places(loops, couplings)
    home = {}
    if (section := top.section("home", "'home'")) is not None:
        for joint in section:
            tree.check_joint(joint, section.where(joint))
            home[joint] = section.number(joint)
            where[f"home {joint}"] = section.where(joint)
    friction |= _friction(top, tree)
    forces = _forces(top, tree)
    gas_springs = _gas_springs(top, tree)
    end_stops = _end_stops(top, tree)
    tip = top.text("tip", None)
    if tip is not None and tip not in tree.links:
        raise top.fail("tip", f"the tip frame '{tip}' is unknown, {known(tree.links, tip)}")
    if tip is not None and not tree.moves(tip):
        raise top.fail("tip", f"the tip frame '{tip}' does not move, choose another")
    payload = _payload(top, tree, tip)
    hydraulics = read_hydraulics(top, tree, active)
    tasks = read_tasks(top, active, tip, hydraulics.joints if hydraulics else ())
    control = _control(top, active)
    return MachineSpec(
        name, source, path, chains, tree.robot, loops, active, home, friction, forces,
        gas_springs, end_stops, tip, tasks, control, hydraulics, couplings, where, payload,
    )  # fmt: skip


def _chains(
    top: Section, path: Path
) -> tuple[tuple[Chain, ...], Tree, dict[str, Friction], tuple[Coupling, ...]]:
    chains: list[Chain] = []
    tree = Tree()
    friction: dict[str, Friction] = {}
    couplings: tuple[Coupling, ...] = ()
    for item in top.sections("chains", "chain", "name", "urdf", "parent"):
        name, parent, file = item.text("name"), item.text("parent", None), item.file("urdf")
        if any(chain.name == name for chain in chains):
            raise item.fail("name", f"two chains are named '{name}', rename one")
        if chains and parent is None:
            raise item.fail(None, f"chain '{name}' has no 'parent', name the frame it hangs from")
        if not chains and parent is not None:
            raise item.fail(
                "parent", f"chain '{name}' is first and stands on the world, remove its 'parent'"
            )
        urdf = read_urdf(file)
        chain = Chain(name, file, parent, item.where("parent"), urdf.moving)
        if urdf.loops:
            raise DescriptionError(
                f"{urdf.loops[0].where}: a sub-chain has no <loop>, write it under 'loops' of "
                f"{path.name}"
            )
        tree.add(chain, urdf)
        chains.append(chain)
        friction |= urdf.friction
        couplings += urdf.couplings
    if not chains:
        raise top.fail("chains", "there are no chains, add one under 'chains:'")
    if not tree.joints:
        raise top.fail("chains", "no joint of these chains moves, add one")
    return tuple(chains), tree, friction, couplings


def _loops(top: Section, tree: Tree) -> tuple[LoopSpec, ...]:
    loops: dict[str, LoopSpec] = {}
    for item in top.sections("loops", "loop", "name", "type", "predecessor", "successor", "axis"):
        loop = _loop(item, tree)
        if loop.name in loops:
            raise item.fail("name", f"two loops are named '{loop.name}', rename one")
        loops[loop.name] = loop
    return tuple(loops.values())


def _loop(section: Section, tree: Tree) -> LoopSpec:
    name, kind = section.text("name"), section.text("type")
    if kind not in LOOP_TYPES:
        raise section.fail(
            "type", f"loop '{name}' has the unknown type '{kind}', {known(LOOP_TYPES, kind)}"
        )
    ends = []
    for end in ("predecessor", "successor"):
        frame = section.text(end)
        if frame not in tree.links:
            raise section.fail(
                end, f"loop '{name}' has the unknown {end} '{frame}', {known(tree.links, frame)}"
            )
        ends.append(frame)
    axis = unit_vector(section.numbers("axis", (0.0, 0.0, 1.0)))
    if axis is None:
        raise section.fail(
            "axis", f"the axis of loop '{name}' is no direction, give three numbers, not all zero"
        )
    loop = LoopSpec(name, kind, ends[0], ends[1], axis, section.where())
    tree.check_loop(loop)
    return loop


def _places(loops: tuple[LoopSpec, ...], couplings: tuple[Coupling, ...]) -> dict[str, str]:
    """Where loops and couplings were written, as errors about them look it up."""
    places = {f"loop {loop.name}": loop.where for loop in loops}
    return places | {f"loop {coupling.name}": coupling.where for coupling in couplings}


def _couplings(top: Section, tree: Tree) -> tuple[Coupling, ...]:
    found: dict[str, Coupling] = {}
    for item in top.sections("couplings", "coupling", "name", "joints", "offset"):
        name, joints = item.text("name"), item.section("joints", "'joints'")
        if name in found:
            raise item.fail("name", f"two couplings are named '{name}', rename one")
        if joints is None or len(list(joints)) < 2:
            raise item.fail("joints", f"coupling '{name}' joins less than two joints, add some")
        factors = {}
        for joint in joints:
            tree.check_joint(joint, joints.where(joint))
            factors[joint] = joints.number(joint)
            if factors[joint] == 0:
                raise joints.fail(joint, f"the factor of '{joint}' is 0, leave it out")
        found[name] = Coupling(name, factors, item.number("offset", 0.0), item.where())
    return tuple(found.values())


def _friction(top: Section, tree: Tree) -> dict[str, Friction]:
    found: dict[str, Friction] = {}
    keys = (
        "coulomb", "coulomb_offset", "viscous", "viscous_offset", "smoothing", "stiction",
        "stribeck",
    )  # fmt: skip
    for joint, item in top.mappings("friction", "friction of", *keys):
        tree.check_joint(joint, item.where())
        stribeck = item.number("stribeck", Friction.stribeck, minimum=0.0)
        if stribeck == 0:
            raise item.fail(
                "stribeck", f"'stribeck' of friction of '{joint}' is 0, give a velocity"
            )
        friction = Friction(
            coulomb=item.number("coulomb", 0.0, minimum=0.0),
            coulomb_offset=item.number("coulomb_offset", 0.0),
            viscous=item.number("viscous", 0.0, minimum=0.0),
            viscous_offset=item.number("viscous_offset", 0.0),
            smoothing=item.number("smoothing", Friction.smoothing, minimum=0.0),
            stiction=item.number("stiction", 0.0, minimum=0.0),
            stribeck=stribeck,
        )
        for kind in ("coulomb", "viscous"):
            mean, offset = getattr(friction, kind), getattr(friction, f"{kind}_offset")
            if abs(offset) > mean:
                warnings.warn(
                    f"{item.where()}: friction of '{joint}' drives the joint in one "
                    f"direction (|{kind}_offset| {abs(offset):g} > {kind} {mean:g}), "
                    "a constant force may hide in it",
                    CraneWarning,
                    stacklevel=2,
                )
        found[joint] = friction
    return found


def _forces(top: Section, tree: Tree) -> tuple[ForceElement, ...]:
    forces = []
    keys = ("joint", "stiffness", "rest", "damping", "force")
    for item in top.sections("forces", "force element of", *keys):
        element = ForceElement(
            tree.joint(item),
            stiffness=item.number("stiffness", 0.0, minimum=0.0),
            rest=item.number("rest", 0.0),
            damping=item.number("damping", 0.0, minimum=0.0),
            force=item.number("force", 0.0),
        )
        if not (element.stiffness or element.damping or element.force):
            raise item.fail(
                None,
                f"the element on '{element.joint}' does nothing, give it stiffness, damping "
                "or force",
            )
        forces.append(element)
    return tuple(forces)


def _gas_springs(top: Section, tree: Tree) -> tuple[GasSpring, ...]:
    springs = []
    keys = ("area", "pressure", "volume", "rest", "exponent")
    for joint, item in top.mappings("gas_springs", "gas spring of", *keys):
        tree.check_joint(joint, item.where())
        area = item.number("area")
        volume = item.number("volume", minimum=0.0)
        exponent = item.number("exponent", GasSpring.exponent, minimum=0.0)
        for key, value in (("area", area), ("volume", volume), ("exponent", exponent)):
            if value == 0:
                raise item.fail(key, f"'{key}' of gas spring of '{joint}' is 0, give one")
        pressure, rest = item.number("pressure", minimum=0.0), item.number("rest", 0.0)
        springs.append(GasSpring(joint, area, pressure, volume, rest, exponent))
    return tuple(springs)


def _end_stops(top: Section, tree: Tree) -> tuple[EndStop, ...]:
    stops = []
    for joint, item in top.mappings("end_stops", "end stop of", "stiffness", "damping"):
        tree.check_joint(joint, item.where())
        if not tree.has_limits(joint):
            raise item.fail(
                None, f"joint '{joint}' is continuous, a stop needs limits: make it revolute"
            )
        stiffness = item.number("stiffness", minimum=0.0)
        if stiffness == 0:
            raise item.fail("stiffness", f"the end stop of '{joint}' has no stiffness, give one")
        stops.append(EndStop(joint, stiffness, item.number("damping", 0.0, minimum=0.0)))
    return tuple(stops)


def _payload(top: Section, tree: Tree, tip: str | None) -> Chain | None:
    """The load that payload.mass hangs on the tip, as a chain without moving joints."""
    section = top.section("payload", "'payload'")
    if section is None:
        return None
    section.only("urdf")
    if tip is None:
        raise section.fail(None, "a payload hangs on the tip, name its frame under 'tip:'")
    urdf = read_urdf(section.file("urdf"))
    for joint in urdf.moving:
        raise DescriptionError(
            f"{urdf.lines['joint', joint]}: joint '{joint}' moves, a payload is rigid: "
            "make it fixed"
        )
    for loop in urdf.loops:
        raise DescriptionError(f"{loop.where}: a payload has no <loop>, remove it")
    if not sum(float(mass.get("value")) for mass in urdf.robot.iter("mass")):
        raise section.fail(
            "urdf", f"no link of {urdf.file.name} has a mass, give one an <inertial>"
        )
    chain = Chain("payload", urdf.file, tip, section.where("urdf"), ())
    copy.deepcopy(tree).add(chain, urdf)  # checks that its names are not taken
    return chain


def _control(top: Section, active: tuple[str, ...]) -> dict[str, PIGains]:
    gains = {}
    for joint, item in top.mappings("control", "control of", "kp", "ki"):
        if joint not in active:
            raise item.fail(None, f"'{joint}' is not an active joint, {known(active, joint)}")
        gains[joint] = PIGains(item.number("kp", minimum=0.0), item.number("ki", minimum=0.0))
    missing = [joint for joint in active if gains and joint not in gains]
    if missing:
        raise top.fail("control", f"no gains for {', '.join(missing)}, give kp and ki of each")
    return gains
