"""Machine files and single URDFs, read and checked into a `MachineSpec`."""

from collections.abc import Callable, Container, Sequence
from pathlib import Path
from typing import Any, TypeVar

from crane.common.errors import DescriptionError, suggest_names
from crane.common.package_search import load_options
from crane.description.estimation_settings import EstimationSettings
from crane.description.external_forces import ExternalForce
from crane.description.findings import FollowUpError, UnknownNames, error_recovery, report_error
from crane.description.floating_bases import FLOATING_FREEDOMS, check_freedoms
from crane.description.ground_contact import Contact
from crane.description.kinematic_tree import with_rotor_inertias
from crane.description.machine_lookup import find_machine_file
from crane.description.specification import (
    AXISLESS_TYPES,
    LOOP_TYPES,
    Chain,
    Coupling,
    Drive,
    ForceElement,
    Friction,
    LoopSpec,
    MachineSpec,
    PayloadSpec,
    PIGains,
    Task,
    source_locations,
    unit_vector,
)
from crane.formats.machine_file.circuit_section import (
    check_active_joint,
    circuit_locations,
    read_hydraulics,
)
from crane.formats.machine_file.estimation_section import read_estimation
from crane.formats.machine_file.external_force_sections import read_external_forces
from crane.formats.machine_file.force_sections import (
    read_end_stops,
    read_forces,
    read_friction,
    read_gas_springs,
    read_ropes,
    read_rotor_inertias,
)
from crane.formats.machine_file.home_section import read_home
from crane.formats.machine_file.open_loop_warning import warn_about_open_loops
from crane.formats.machine_file.sensor_section import read_sensors
from crane.formats.machine_file.task_section import read_tasks
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.machine_file.yaml_section import EXTENDS_KEY, YamlSection
from crane.formats.parallel_robots import is_parallel_robot, read_parallel_robot
from crane.formats.robot_files import is_robot_file
from crane.formats.urdf.urdf_reader import UrdfModel, read_urdf

SectionContent = TypeVar("SectionContent")

_KEYS = (
    EXTENDS_KEY,
    "name",
    "source",
    "chains",
    "floating",
    "loops",
    "active",
    "free",
    "drives",
    "home",
    "friction",
    "forces",
    "gas_springs",
    "ropes",
    "loads",
    "ground",
    "contacts",
    "soil",
    "cutters",
    "supports",
    "pins",
    "end_stops",
    "rotor_inertia",
    "couplings",
    "tip",
    "payload",
    "tasks",
    "control",
    "hydraulics",
    "sensors",
    "identification",
)


def read_machine_spec(name: str | Path) -> MachineSpec:
    """Read a machine by bundled name or path, in the format that the file has.

    Raises:
        DescriptionError: With file, line, what is wrong, and the names that exist.
    """
    path = find_machine_file(name)
    spec = _read_by_format(path)
    warn_about_open_loops(spec)
    return spec


def _read_by_format(path: Path) -> MachineSpec:
    if is_robot_file(path):
        return _read_robot(path)
    if path.suffix.lower() in (".xml", ".mjcf"):
        from crane.formats.mjcf.mjcf_reader import read_mjcf  # Pinocchio is in it

        return read_mjcf(path)
    return read_parallel_robot(path) if is_parallel_robot(path) else _read_machine(path)


def _read_robot(path: Path) -> MachineSpec:
    urdf = read_urdf(path)
    chain = Chain(path.stem, path, None, path.name, urdf.moving_joints)
    tree = TreeBuilder()
    tree.add_chain(chain, urdf)
    if not tree.joints and not load_options().floating_root:
        report_error(DescriptionError(f"{path.name}: no joint moves in this file, add one"))
    for loop in urdf.loops:
        with error_recovery():
            tree.check_loop(loop)
    locations = source_locations(urdf.loops, urdf.couplings)
    locations |= {f"home {joint}": place for joint, place in urdf.home_locations.items()}
    active = urdf.independent_joints
    if urdf.loops and not active:
        active, locations["active"] = (), urdf.loops[0].source_location
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
        tip=tree.single_leaf_link() if urdf.tip is None else urdf.tip,
        couplings=urdf.couplings,
        source_locations=locations,
    )


def read_plain_data(path: Path) -> dict[str, Any]:
    """What a machine file says, with what it extends.

    Raises:
        DescriptionError: As `read_machine_spec`.
    """
    return YamlSection.read(path, _KEYS).to_plain_data()


def _read_machine(path: Path) -> MachineSpec:
    top = YamlSection.read(path, _KEYS)
    name, source = top.text("name"), top.text("source", "")
    chains, tree, friction, couplings, springs = _read_chains(top, path)
    loops = _read_loops(top, tree)
    couplings += _read_couplings(top, tree)
    active: tuple[str, ...] = UnknownNames()
    with error_recovery():
        active = top.names("active") if "active" in top else ()
    for joint in active:
        with error_recovery():
            tree.check_joint(joint, top.source_location("active"))
    if not all(joint in tree.joints for joint in active):
        active = UnknownNames()
    free = _read_free_joints(top, tree, active)
    locations = {key: top.source_location(key) for key in top} | source_locations(loops, couplings)
    home, home_lines = read_home(top, tree)
    locations |= {f"home {joint}": place for joint, place in home_lines.items()}
    rotor_inertias = _read_or_default(read_rotor_inertias, {}, top, tree)
    friction |= _read_or_default(read_friction, {}, top, tree)
    forces = springs + _read_or_default(read_forces, (), top, tree)
    gas_springs = _read_or_default(read_gas_springs, (), top, tree)
    end_stops = _read_or_default(read_end_stops, (), top, tree)
    tip = _read_tip(top, tree)
    payload = _read_or_default(_read_payload, None, top, tree, tip)
    # a machine whose active joints are not named is not driven either: `load` proposes some
    hydraulics = None
    tasks: dict[str, Task] = {}
    control: dict[str, PIGains] = {}
    if active:
        valves: tuple[str, ...] = UnknownNames() if "hydraulics" in top else ()
        hydraulics = _read_or_default(read_hydraulics, None, top, tree, active)
        if hydraulics is not None:
            locations |= circuit_locations(top)
        if hydraulics is not None and not isinstance(active, UnknownNames):
            valves = tuple(hydraulics.spools)
        tasks = _read_or_default(read_tasks, tasks, top, tree, active, tip, valves, home)
        control = _read_or_default(_read_control, control, top, active)
    external_forces = _read_or_default(read_external_forces, (), top, tree)
    return MachineSpec(
        name,
        source,
        path,
        chains,
        with_rotor_inertias(tree.tree, rotor_inertias),
        loops,
        active,
        home,
        friction,
        forces,
        gas_springs,
        end_stops,
        tip,
        tasks,
        control,
        hydraulics,
        couplings,
        locations,
        payload,
        free,
        _read_or_default(_read_drives, (), top, tree),
        _read_or_default(read_ropes, (), top, tree),
        _read_or_default(read_sensors, {}, top, tree),
        _read_or_default(read_estimation, EstimationSettings(), top),
        external_forces,
        _read_or_default(_read_supports, (), top, tree, external_forces),
        _read_or_default(_read_pins, {}, top, tree, loops),
    )


def _read_floating(top: YamlSection) -> tuple[str, ...]:
    """Freedoms of the first chain's root."""
    if "floating" not in top:
        return ()
    names = top.names("floating")
    for name in names:
        if name not in FLOATING_FREEDOMS:
            raise top.error_at(
                "floating",
                f"freedom '{name}' of the root is unknown, "
                f"{suggest_names(FLOATING_FREEDOMS, name)}",
            )
    return check_freedoms(names)


def _read_supports(
    top: YamlSection, tree: TreeBuilder, external_forces: Sequence[ExternalForce]
) -> tuple[str, ...]:
    """Links that the machine stands on."""
    names = top.names("supports") if "supports" in top else ()
    contacts = {force.frame for force in external_forces if isinstance(force, Contact)}
    for link in names:
        tree.check_link(link, top.source_location("supports"), "the support")
        if tree.is_movable(link) and link not in contacts:
            problem = f"support '{link}' moves, name links of the base or those of contacts"
            raise tree.unknown_name_error(str(top.error_at("supports", problem)))
    if names and len(names) < 3:
        raise top.error_at("supports", f"{len(names)} supports make no area, name three or more")
    return names


def _read_pins(top: YamlSection, tree: TreeBuilder, loops: Sequence[LoopSpec]) -> dict[str, float]:
    """The largest force that pins bear, by joint or loop [N]."""
    found: dict[str, float] = {}
    section = top.section("pins", "'pins'")
    names = [*tree.joints, *(loop.name for loop in loops)]
    for name in section or ():
        assert section is not None
        with error_recovery(harmless=True):
            if name not in names:
                problem = (
                    f"'{name}' under 'pins' is no joint or loop, {suggest_names(names, name)}"
                )
                raise tree.unknown_name_error(str(section.error_at(name, problem)))
            force = section.number(name)
            if force <= 0:
                raise section.error_at(
                    name, f"the pin '{name}' bears {force:g} N, give a force above 0"
                )
            found[name] = force
    return found


def _read_free_joints(
    top: YamlSection, tree: TreeBuilder, active: Container[str]
) -> tuple[str, ...]:
    """Independent coordinates that nothing drives."""
    free: tuple[str, ...] = ()
    with error_recovery(harmless=True):
        free = top.names("free") if "free" in top else ()
    for joint in free:
        with error_recovery(harmless=True):
            tree.check_joint(joint, top.source_location("free"))
            if joint in active and not isinstance(active, UnknownNames):
                raise top.error_at("free", f"'{joint}' is active and free, keep one of the two")
    return free


def _read_or_default(
    read_section: Callable[..., SectionContent], default: Any, *arguments: object
) -> SectionContent:
    """A part that the machine can be assembled without, `default` where it is refused."""
    with error_recovery(harmless=True):
        return read_section(*arguments)
    return default


def _read_tip(top: YamlSection, tree: TreeBuilder) -> str | None:
    """The name of the tip frame, also where it has been noted as wrong."""
    tip = top.text("tip", None)
    if tip is None:
        return None
    with error_recovery(harmless=True):
        tree.check_link(tip, top.source_location("tip"), "the tip frame")
        if not tree.is_movable(tip):
            problem = f"the tip frame '{tip}' does not move, choose another"
            raise tree.unknown_name_error(str(top.error_at("tip", problem)))
    return tip


def _read_chains(
    top: YamlSection, path: Path
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
        tree.is_complete &= top.is_complete
        was_complete = tree.is_complete
        tree.is_complete = False
        with error_recovery():
            chain, urdf = _read_chain(item, chains, was_complete, path)
            tree.is_complete = was_complete
            tree.add_chain(chain, urdf)
            chains.append(chain)
            friction |= urdf.friction
            couplings += urdf.couplings
            springs += urdf.springs
    tree.is_complete &= top.is_complete
    if not chains and tree.is_complete:
        report_error(top.error_at("chains", "there are no chains, add one under 'chains:'"))
        tree.is_complete = False
    with error_recovery(harmless=True):
        tree.add_floating_base(_read_floating(top))
    if not tree.joints and tree.is_complete:
        report_error(top.error_at("chains", "no joint of these chains moves, add one"))
    return tuple(chains), tree, friction, couplings, springs


def _read_chain(
    item: YamlSection, earlier_chains: list[Chain], are_all_read: bool, path: Path
) -> tuple[Chain, UrdfModel]:
    """A chain and its file.

    Args:
        item: Where it is written.
        earlier_chains: The chains before it.
        are_all_read: Whether these are all that were written before it.
        path: The machine file.
    """
    name, parent = item.text("name"), item.text("parent", None)
    file = item.file("urdf")
    if any(chain.name == name for chain in earlier_chains):
        report_error(item.error_at("name", f"two chains are named '{name}', rename one"))
    elif (earlier_chains or not are_all_read) and parent is None:
        problem = f"chain '{name}' has no 'parent', name the frame it hangs from"
        report_error(item.error_at(None, problem))
    elif not earlier_chains and are_all_read and parent is not None:
        problem = f"chain '{name}' is first and stands on the world, remove its 'parent'"
        report_error(item.error_at("parent", problem))
        parent = None
    urdf = read_urdf(file)
    for loop in urdf.loops[:1]:
        problem = f"a sub-chain has no <loop>, write it under 'loops' of {path.name}"
        report_error(DescriptionError(f"{loop.source_location}: {problem}"))
    return Chain(name, file, parent, item.source_location("parent"), urdf.moving_joints), urdf


def _read_loops(top: YamlSection, tree: TreeBuilder) -> tuple[LoopSpec, ...]:
    loops: dict[str, LoopSpec] = {}
    for item in top.sections("loops", "loop", "name", "type", "predecessor", "successor", "axis"):
        with error_recovery():
            loop = _read_loop(item, tree, loops)
            loops[loop.name] = loop
    return tuple(loops.values())


def _read_loop(section: YamlSection, tree: TreeBuilder, earlier_names: Container[str]) -> LoopSpec:
    name, kind = section.text("name"), section.text("type")
    label = f"loop '{name}'" if name else "a loop"
    if kind and kind not in LOOP_TYPES:
        problem = f"{label} has the unknown type '{kind}', {suggest_names(LOOP_TYPES, kind)}"
        report_error(section.error_at("type", problem))
    frames = []
    for end in ("predecessor", "successor"):
        frame = section.text(end)
        if frame and frame not in tree.links and tree.is_complete:
            problem = (
                f"{label} has the unknown {end} '{frame}', {suggest_names(tree.links, frame)}"
            )
            report_error(section.error_at(end, problem))
        frames.append(frame)
    axis = None
    with error_recovery():
        axis = unit_vector(section.numbers("axis", (0.0, 0.0, 1.0)))
        if axis is None and kind in AXISLESS_TYPES:
            axis = (0.0, 0.0, 1.0)
        if axis is None:
            problem = f"the axis of {label} is no direction"
            raise section.error_at("axis", f"{problem}, give three numbers, not all zero")
    if axis is None or kind not in LOOP_TYPES or not all(end in tree.links for end in frames):
        raise FollowUpError(f"{label} is not complete")
    loop = LoopSpec(name, kind, frames[0], frames[1], axis, section.source_location())
    tree.check_loop(loop)
    if name in earlier_names:
        raise section.error_at("name", f"two loops are named '{name}', rename one")
    return loop


def _read_couplings(top: YamlSection, tree: TreeBuilder) -> tuple[Coupling, ...]:
    found: dict[str, Coupling] = {}
    for item in top.sections("couplings", "coupling", "name", "joints", "offset"):
        with error_recovery():
            coupling = _read_coupling(item, tree, found)
            found[coupling.name] = coupling
    return tuple(found.values())


def _read_coupling(
    item: YamlSection, tree: TreeBuilder, earlier_names: Container[str]
) -> Coupling:
    name, joints = item.text("name"), item.section("joints", "'joints'")
    if name in earlier_names:
        raise item.error_at("name", f"two couplings are named '{name}', rename one")
    if joints is None or len(list(joints)) < 2:
        raise item.error_at("joints", f"coupling '{name}' joins less than two joints, add some")
    factors = {}
    for joint in joints:
        with error_recovery():
            tree.check_joint(joint, joints.source_location(joint))
            factors[joint] = _read_factor(joints, joint)
    return Coupling(name, factors, item.number("offset", 0.0), item.source_location())


def _read_factor(joints: YamlSection, joint: str) -> float:
    factor = joints.number(joint)
    if factor == 0:
        report_error(joints.error_at(joint, f"the factor of '{joint}' is 0, leave it out"))
    return factor


def _read_drives(top: YamlSection, tree: TreeBuilder) -> tuple[Drive, ...]:
    """What motors act along, where that is not the active joints one by one."""
    found = []
    section = top.section("drives", "'drives'")
    for name in section or ():
        assert section is not None
        with error_recovery():
            joints = section.section(name, f"drive '{name}'")
            if joints is None or not list(joints):
                raise section.error_at(name, f"drive '{name}' moves no joint, name some")
            for joint in joints:
                tree.check_joint(joint, joints.source_location(joint))
            found.append(Drive(name, {joint: _read_factor(joints, joint) for joint in joints}))
    return tuple(found)


def _read_payload(top: YamlSection, tree: TreeBuilder, tip: str | None) -> PayloadSpec | None:
    """The load that payload.mass hangs on the tip, a chain without moving joints."""
    section = top.section("payload", "'payload'")
    if section is None:
        return None
    section.check_keys("urdf")
    if tip is None:
        raise section.error_at(None, "a payload hangs on the tip, name its frame under 'tip:'")
    urdf = read_urdf(section.file("urdf"))
    for joint in urdf.tree.moving_joints:
        problem = f"joint '{joint.name}' moves, a payload is rigid: make it fixed"
        report_error(DescriptionError(f"{joint.source_location}: {problem}"))
    for loop in urdf.loops:
        report_error(
            DescriptionError(f"{loop.source_location}: a payload has no <loop>, remove it")
        )
    if not urdf.tree.total_mass:
        raise section.error_at(
            "urdf", f"no link of {urdf.file.name} has a mass, give one an <inertial>"
        )
    chain = Chain("payload", urdf.file, tip, section.source_location("urdf"), ())
    attachment = chain.attachment_joint(urdf.root_link)
    for _ in tree.filter_new_names([attachment, *urdf.tree]):
        pass  # notes names that are taken
    return PayloadSpec(chain, urdf.tree.with_parts(attachment))


def _read_control(top: YamlSection, active: tuple[str, ...]) -> dict[str, PIGains]:
    gains, named_joints = {}, []
    for joint, item in top.mappings("control", "control of", "kp", "ki"):
        named_joints.append(joint)
        with error_recovery():
            check_active_joint(joint, item, active)
        with error_recovery():
            kp, ki = (item.number(key, minimum=0.0) for key in ("kp", "ki"))
            gains[joint] = PIGains(kp, ki)
    missing = [joint for joint in active if named_joints and joint not in named_joints]
    if missing:
        raise top.error_at("control", f"no gains for {', '.join(missing)}, give kp and ki of each")
    return gains
