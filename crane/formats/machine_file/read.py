"""Machine files and single URDFs, read and checked into a `MachineSpec`."""

from collections.abc import Callable, Container, Sequence
from pathlib import Path
from typing import Any, TypeVar

from crane.common.errors import DescriptionError, known
from crane.common.packages import given
from crane.description.estimation import Estimation
from crane.description.external import ExternalForce
from crane.description.findings import Anything, FollowUpError, flag, recoverable
from crane.description.floating import PARTS, freedoms_of
from crane.description.ground import Contact
from crane.description.sources import find
from crane.description.spec import (
    LOOP_TYPES,
    WITHOUT_AXIS,
    Chain,
    Coupling,
    Drive,
    ForceElement,
    Friction,
    Load,
    LoopSpec,
    MachineSpec,
    PIGains,
    Task,
    places,
    unit_vector,
)
from crane.description.tree import with_rotors
from crane.formats.machine_file.circuit import check_active, circuit_places, read_hydraulics
from crane.formats.machine_file.estimation import read_estimation
from crane.formats.machine_file.forces import (
    read_end_stops,
    read_forces,
    read_friction,
    read_gas_springs,
    read_ropes,
    read_rotors,
)
from crane.formats.machine_file.open_loops import warn_of_open_loops
from crane.formats.machine_file.outside import read_outside
from crane.formats.machine_file.posture import read_home
from crane.formats.machine_file.section import EXTENDS, Section
from crane.formats.machine_file.sensors import read_sensors
from crane.formats.machine_file.tasks import read_tasks
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.opening import is_robot
from crane.formats.parallel_robots import is_parallel_robot, read_parallel_robot
from crane.formats.urdf.read import Urdf, read_urdf

Part = TypeVar("Part")

_KEYS = (
    EXTENDS, "name", "source", "chains", "floating", "loops", "active", "free", "drives", "home",
    "friction", "forces", "gas_springs", "ropes", "loads", "ground", "contacts", "soil",
    "cutters", "supports", "pins", "end_stops", "rotor_inertia", "couplings", "tip", "payload",
    "tasks", "control", "hydraulics", "sensors", "identification",
)  # fmt: skip


def read(name: str | Path) -> MachineSpec:
    """Read a machine by bundled name or path, in the format that the file has.

    Raises:
        DescriptionError: With file, line, what is wrong, and the names that exist.
    """
    path = find(name)
    spec = _read(path)
    warn_of_open_loops(spec)
    return spec


def _read(path: Path) -> MachineSpec:
    if is_robot(path):
        return _read_single(path)
    if path.suffix.lower() in (".xml", ".mjcf"):
        from crane.formats.mjcf.read import read_mjcf  # Pinocchio is in it

        return read_mjcf(path)
    return read_parallel_robot(path) if is_parallel_robot(path) else _read_machine(path)


def _read_single(path: Path) -> MachineSpec:
    urdf = read_urdf(path)
    chain = Chain(path.stem, path, None, path.name, urdf.moving)
    tree = TreeBuilder()
    tree.add(chain, urdf)
    if not tree.joints and not given().floating:
        flag(DescriptionError(f"{path.name}: no joint moves in this file, add one"))
    for loop in urdf.loops:
        with recoverable():
            tree.check_loop(loop)
    where = places(urdf.loops, urdf.couplings)
    where |= {f"home {joint}": place for joint, place in urdf.home_lines.items()}
    active = urdf.independent
    if urdf.loops and not active:
        active, where["active"] = (), urdf.loops[0].where
    return MachineSpec(
        name=urdf.name,
        source=path.name,
        path=path,
        chains=(chain,),
        tree=tree.tree,
        loops=urdf.loops,
        active=active,
        home=urdf.home,
        friction=urdf.friction,
        forces=urdf.springs,
        tip=tree.only_leaf() if urdf.tip is None else urdf.tip,
        couplings=urdf.couplings,
        where=where,
    )


def plain_data(path: Path) -> dict[str, Any]:
    """What a machine file says, with what it extends.

    Raises:
        DescriptionError: As `read`.
    """
    return Section.read(path, _KEYS).plain()


def _read_machine(path: Path) -> MachineSpec:
    top = Section.read(path, _KEYS)
    name, source = top.text("name"), top.text("source", "")
    chains, tree, friction, couplings, springs = _chains(top, path)
    loops = _loops(top, tree)
    couplings += _couplings(top, tree)
    active: tuple[str, ...] = Anything()
    with recoverable():
        active = top.names("active") if "active" in top else ()
    for joint in active:
        with recoverable():
            tree.check_joint(joint, top.where("active"))
    if not all(joint in tree.joints for joint in active):
        active = Anything()
    free = _free(top, tree, active)
    where = {key: top.where(key) for key in top} | places(loops, couplings)
    home, home_lines = read_home(top, tree)
    where |= {f"home {joint}": place for joint, place in home_lines.items()}
    rotors = _part(read_rotors, {}, top, tree)
    friction |= _part(read_friction, {}, top, tree)
    forces = springs + _part(read_forces, (), top, tree)
    gas_springs = _part(read_gas_springs, (), top, tree)
    end_stops = _part(read_end_stops, (), top, tree)
    tip = _tip(top, tree)
    payload = _part(_payload, None, top, tree, tip)
    # a machine whose active joints are not named is not driven either: `load` proposes some
    hydraulics = None
    tasks: dict[str, Task] = {}
    control: dict[str, PIGains] = {}
    if active:
        valves: tuple[str, ...] = Anything() if "hydraulics" in top else ()
        hydraulics = _part(read_hydraulics, None, top, tree, active)
        if hydraulics is not None:
            where |= circuit_places(top)
        if hydraulics is not None and not isinstance(active, Anything):
            valves = tuple(hydraulics.spools)
        tasks = _part(read_tasks, tasks, top, tree, active, tip, valves, home)
        control = _part(_control, control, top, active)
    outside = _part(read_outside, (), top, tree)
    return MachineSpec(
        name, source, path, chains, with_rotors(tree.tree, rotors), loops, active, home, friction,
        forces, gas_springs, end_stops, tip, tasks, control, hydraulics, couplings, where, payload,
        free, _part(_drives, (), top, tree), _part(read_ropes, (), top, tree),
        _part(read_sensors, {}, top, tree),
        _part(read_estimation, Estimation(), top),
        outside,
        _part(_supports, (), top, tree, outside),
        _part(_pins, {}, top, tree, loops),
    )  # fmt: skip


def _floating(top: Section) -> tuple[str, ...]:
    """Freedoms of the first chain's root."""
    if "floating" not in top:
        return ()
    names = top.names("floating")
    for name in names:
        if name not in PARTS:
            raise top.fail(
                "floating", f"freedom '{name}' of the root is unknown, {known(PARTS, name)}"
            )
    return freedoms_of(names)


def _supports(
    top: Section, tree: TreeBuilder, outside: Sequence[ExternalForce]
) -> tuple[str, ...]:
    """Links that the machine stands on."""
    names = top.names("supports") if "supports" in top else ()
    contacts = {force.frame for force in outside if isinstance(force, Contact)}
    for link in names:
        tree.check_link(link, top.where("supports"), "the support")
        if tree.moves(link) and link not in contacts:
            problem = f"support '{link}' moves, name links of the base or those of contacts"
            raise tree.unknown(str(top.fail("supports", problem)))
    if names and len(names) < 3:
        raise top.fail("supports", f"{len(names)} supports make no area, name three or more")
    return names


def _pins(top: Section, tree: TreeBuilder, loops: Sequence[LoopSpec]) -> dict[str, float]:
    """The largest force that pins bear, by joint or loop [N]."""
    found: dict[str, float] = {}
    section = top.section("pins", "'pins'")
    names = [*tree.joints, *(loop.name for loop in loops)]
    for name in section or ():
        assert section is not None
        with recoverable(harmless=True):
            if name not in names:
                problem = f"'{name}' under 'pins' is no joint or loop, {known(names, name)}"
                raise tree.unknown(str(section.fail(name, problem)))
            force = section.number(name)
            if force <= 0:
                raise section.fail(
                    name, f"the pin '{name}' bears {force:g} N, give a force above 0"
                )
            found[name] = force
    return found


def _free(top: Section, tree: TreeBuilder, active: Container[str]) -> tuple[str, ...]:
    """Independent coordinates that nothing drives."""
    free: tuple[str, ...] = ()
    with recoverable(harmless=True):
        free = top.names("free") if "free" in top else ()
    for joint in free:
        with recoverable(harmless=True):
            tree.check_joint(joint, top.where("free"))
            if joint in active and not isinstance(active, Anything):
                raise top.fail("free", f"'{joint}' is active and free, keep one of the two")
    return free


def _part(read: Callable[..., Part], nothing: Any, *arguments: object) -> Part:
    """A part that the machine can be assembled without, `nothing` where it is refused."""
    with recoverable(harmless=True):
        return read(*arguments)
    return nothing


def _tip(top: Section, tree: TreeBuilder) -> str | None:
    """The name of the tip frame, also where it has been noted as wrong."""
    tip = top.text("tip", None)
    if tip is None:
        return None
    with recoverable(harmless=True):
        tree.check_link(tip, top.where("tip"), "the tip frame")
        if not tree.moves(tip):
            problem = f"the tip frame '{tip}' does not move, choose another"
            raise tree.unknown(str(top.fail("tip", problem)))
    return tip


def _chains(
    top: Section, path: Path
) -> tuple[
    tuple[Chain, ...], TreeBuilder, dict[str, Friction], tuple[Coupling, ...],
    tuple[ForceElement, ...],
]:  # fmt: skip
    chains: list[Chain] = []
    tree = TreeBuilder()
    friction: dict[str, Friction] = {}
    couplings: tuple[Coupling, ...] = ()
    springs: tuple[ForceElement, ...] = ()
    for item in top.sections("chains", "chain", "name", "urdf", "parent"):
        tree.complete &= top.complete
        so_far = tree.complete
        tree.complete = False
        with recoverable():
            chain, urdf = _chain(item, chains, so_far, path)
            tree.complete = so_far
            tree.add(chain, urdf)
            chains.append(chain)
            friction |= urdf.friction
            couplings += urdf.couplings
            springs += urdf.springs
    tree.complete &= top.complete
    if not chains and tree.complete:
        flag(top.fail("chains", "there are no chains, add one under 'chains:'"))
        tree.complete = False
    with recoverable(harmless=True):
        tree.let_float(_floating(top))
    if not tree.joints and tree.complete:
        flag(top.fail("chains", "no joint of these chains moves, add one"))
    return tuple(chains), tree, friction, couplings, springs


def _chain(item: Section, before: list[Chain], all_read: bool, path: Path) -> tuple[Chain, Urdf]:
    """A chain and its file.

    Args:
        item: Where it is written.
        before: The chains before it.
        all_read: Whether these are all that were written before it.
        path: The machine file.
    """
    name, parent = item.text("name"), item.text("parent", None)
    file = item.file("urdf")
    if any(chain.name == name for chain in before):
        flag(item.fail("name", f"two chains are named '{name}', rename one"))
    elif (before or not all_read) and parent is None:
        problem = f"chain '{name}' has no 'parent', name the frame it hangs from"
        flag(item.fail(None, problem))
    elif not before and all_read and parent is not None:
        problem = f"chain '{name}' is first and stands on the world, remove its 'parent'"
        flag(item.fail("parent", problem))
        parent = None
    urdf = read_urdf(file)
    for loop in urdf.loops[:1]:
        problem = f"a sub-chain has no <loop>, write it under 'loops' of {path.name}"
        flag(DescriptionError(f"{loop.where}: {problem}"))
    return Chain(name, file, parent, item.where("parent"), urdf.moving), urdf


def _loops(top: Section, tree: TreeBuilder) -> tuple[LoopSpec, ...]:
    loops: dict[str, LoopSpec] = {}
    for item in top.sections("loops", "loop", "name", "type", "predecessor", "successor", "axis"):
        with recoverable():
            loop = _loop(item, tree, loops)
            loops[loop.name] = loop
    return tuple(loops.values())


def _loop(section: Section, tree: TreeBuilder, before: Container[str]) -> LoopSpec:
    name, kind = section.text("name"), section.text("type")
    what = f"loop '{name}'" if name else "a loop"
    if kind and kind not in LOOP_TYPES:
        problem = f"{what} has the unknown type '{kind}', {known(LOOP_TYPES, kind)}"
        flag(section.fail("type", problem))
    ends = []
    for end in ("predecessor", "successor"):
        frame = section.text(end)
        if frame and frame not in tree.links and tree.complete:
            problem = f"{what} has the unknown {end} '{frame}', {known(tree.links, frame)}"
            flag(section.fail(end, problem))
        ends.append(frame)
    axis = None
    with recoverable():
        axis = unit_vector(section.numbers("axis", (0.0, 0.0, 1.0)))
        if axis is None and kind in WITHOUT_AXIS:
            axis = (0.0, 0.0, 1.0)
        if axis is None:
            problem = f"the axis of {what} is no direction"
            raise section.fail("axis", f"{problem}, give three numbers, not all zero")
    if axis is None or kind not in LOOP_TYPES or not all(end in tree.links for end in ends):
        raise FollowUpError(f"{what} is not complete")
    loop = LoopSpec(name, kind, ends[0], ends[1], axis, section.where())
    tree.check_loop(loop)
    if name in before:
        raise section.fail("name", f"two loops are named '{name}', rename one")
    return loop


def _couplings(top: Section, tree: TreeBuilder) -> tuple[Coupling, ...]:
    found: dict[str, Coupling] = {}
    for item in top.sections("couplings", "coupling", "name", "joints", "offset"):
        with recoverable():
            coupling = _coupling(item, tree, found)
            found[coupling.name] = coupling
    return tuple(found.values())


def _coupling(item: Section, tree: TreeBuilder, before: Container[str]) -> Coupling:
    name, joints = item.text("name"), item.section("joints", "'joints'")
    if name in before:
        raise item.fail("name", f"two couplings are named '{name}', rename one")
    if joints is None or len(list(joints)) < 2:
        raise item.fail("joints", f"coupling '{name}' joins less than two joints, add some")
    factors = {}
    for joint in joints:
        with recoverable():
            tree.check_joint(joint, joints.where(joint))
            factors[joint] = _factor(joints, joint)
    return Coupling(name, factors, item.number("offset", 0.0), item.where())


def _factor(joints: Section, joint: str) -> float:
    factor = joints.number(joint)
    if factor == 0:
        flag(joints.fail(joint, f"the factor of '{joint}' is 0, leave it out"))
    return factor


def _drives(top: Section, tree: TreeBuilder) -> tuple[Drive, ...]:
    """What motors act along, where that is not the active joints one by one."""
    found = []
    section = top.section("drives", "'drives'")
    for name in section or ():
        assert section is not None
        with recoverable():
            joints = section.section(name, f"drive '{name}'")
            if joints is None or not list(joints):
                raise section.fail(name, f"drive '{name}' moves no joint, name some")
            for joint in joints:
                tree.check_joint(joint, joints.where(joint))
            found.append(Drive(name, {joint: _factor(joints, joint) for joint in joints}))
    return tuple(found)


def _payload(top: Section, tree: TreeBuilder, tip: str | None) -> Load | None:
    """The load that payload.mass hangs on the tip, a chain without moving joints."""
    section = top.section("payload", "'payload'")
    if section is None:
        return None
    section.only("urdf")
    if tip is None:
        raise section.fail(None, "a payload hangs on the tip, name its frame under 'tip:'")
    urdf = read_urdf(section.file("urdf"))
    for joint in urdf.tree.moving:
        problem = f"joint '{joint.name}' moves, a payload is rigid: make it fixed"
        flag(DescriptionError(f"{joint.where}: {problem}"))
    for loop in urdf.loops:
        flag(DescriptionError(f"{loop.where}: a payload has no <loop>, remove it"))
    if not urdf.tree.mass:
        raise section.fail(
            "urdf", f"no link of {urdf.file.name} has a mass, give one an <inertial>"
        )
    chain = Chain("payload", urdf.file, tip, section.where("urdf"), ())
    mount = chain.attached(urdf.root)
    for _ in tree.free([mount, *urdf.tree]):
        pass  # notes names that are taken
    return Load(chain, urdf.tree.replacing(mount))


def _control(top: Section, active: tuple[str, ...]) -> dict[str, PIGains]:
    gains, named = {}, []
    for joint, item in top.mappings("control", "control of", "kp", "ki"):
        named.append(joint)
        with recoverable():
            check_active(joint, item, active)
        with recoverable():
            kp, ki = (item.number(key, minimum=0.0) for key in ("kp", "ki"))
            gains[joint] = PIGains(kp, ki)
    missing = [joint for joint in active if named and joint not in named]
    if missing:
        raise top.fail("control", f"no gains for {', '.join(missing)}, give kp and ki of each")
    return gains
