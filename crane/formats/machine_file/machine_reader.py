"""Machine files and single URDFs, read and checked into a `MachineSpec`."""

import dataclasses
import math
from collections.abc import Callable, Container, Sequence
from pathlib import Path
from typing import Any, TypeVar

from crane.common.errors import DescriptionError, InputError, suggest_names
from crane.common.package_search import load_options
from crane.common.unit_conversions import accepted_units, is_quantity, unit_size
from crane.description.circuit_schema import CYLINDER_SIZE_KEYS
from crane.description.estimation_settings import (
    EstimationSettings,
    ParameterPrior,
    TermValues,
    estimation_units,
)
from crane.description.external_forces import ExternalForce
from crane.description.findings import UnknownNames, error_recovery, report_error
from crane.description.ground_contact import Contact
from crane.description.key_types import NumberKey, NumberListKey
from crane.description.kinematic_tree import with_rotor_inertias
from crane.description.machine_lookup import find_machine_file
from crane.description.machine_schema import MACHINE, SENSOR
from crane.description.sensors import (
    SENSOR_PARAMETERS,
    TIME,
    VALVE_SIGNAL_PREFIX,
    Sensor,
    quantity_unit,
    quantity_units,
    signal_delay_error,
)
from crane.description.specification import (
    ATTITUDE_COORDINATES,
    TIP_COORDINATES,
    Chain,
    LoopSpec,
    MachineSpec,
    PayloadSpec,
    PIGains,
    Task,
    source_locations,
)
from crane.formats.machine_file.circuit_section import (
    check_active_joint,
    circuit_locations,
    read_hydraulics,
)
from crane.formats.machine_file.force_sections import (
    read_end_stops,
    read_external_forces,
    read_forces,
    read_friction,
    read_gas_springs,
    read_ropes,
)
from crane.formats.machine_file.structure_sections import (
    TreeBuilder,
    read_chains,
    read_couplings,
    read_drawn_chain,
    read_drives,
    read_home,
    read_loops,
    warn_about_open_loops,
)
from crane.formats.machine_file.task_section import read_tasks
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.machine_file.yaml_values import as_boolean, as_float
from crane.formats.parallel_robots import is_parallel_robot, read_parallel_robot
from crane.formats.robot_files import is_robot_file
from crane.formats.urdf.urdf_reader import read_urdf

SectionContent = TypeVar("SectionContent")


def read_machine_spec(name: str | Path) -> MachineSpec:
    """Read a machine by bundled name or path, in the format that the file has.

    Raises:
        DescriptionError: With file, line, what is wrong, and the names that exist.
    """
    spec = _read_by_format(find_machine_file(name))
    warn_about_open_loops(spec)
    return spec


def _read_by_format(path: Path) -> MachineSpec:
    if is_robot_file(path):
        return _read_robot(path)
    if path.suffix.lower() in (".xml", ".mjcf"):
        from crane.formats.mjcf.mjcf_reader import read_mjcf  # few files are MJCF

        return read_mjcf(path)
    return read_parallel_robot(path) if is_parallel_robot(path) else _read_machine(path)


def _read_robot(path: Path) -> MachineSpec:
    spec = read_urdf(path)
    tree = TreeBuilder(spec.tree, spec.is_complete)
    if not tree.joints and not load_options().floating_root:
        report_error(DescriptionError(f"{path.name}: no joint moves in this file, add one"))
    for loop in spec.loops:
        with error_recovery():
            tree.check_loop(loop)
    if spec.loops and not spec.active:
        locations = {**spec.source_locations, "active": spec.loops[0].source_location}
        spec = dataclasses.replace(spec, active=(), source_locations=locations)
    return dataclasses.replace(spec, tip=tree.single_leaf_link()) if spec.tip is None else spec


def _read_machine(path: Path) -> MachineSpec:
    top = YamlSection.read(path, MACHINE)
    name, source = top.text("name"), top.text("source")
    drawn = read_drawn_chain(top, path)
    chains, tree, friction, couplings, springs, gravity = read_chains(top, path, drawn)
    top.turns |= dict.fromkeys(TIP_COORDINATES, False)
    top.turns |= {x: True for group in ATTITUDE_COORDINATES for x in group}
    top.turns |= {name: joint.kind != "prismatic" for name, joint in tree.joints.items()}
    loops = drawn.loops + read_loops(top, tree)
    _fill_circuit(top)
    couplings += read_couplings(top, tree)
    active = _read_active_joints(top, tree, drawn)
    free = _read_free_joints(top, tree, active)
    locations = {key: top.source_location(key) for key in top} | source_locations(loops, couplings)
    home, home_locations = read_home(top, tree)
    home = dict(drawn.home) | home
    locations |= {f"home {joint}": drawn.source_locations[f"home {joint}"] for joint in drawn.home}
    locations |= home_locations
    rotor_inertias = _read_or_default(
        top.value_map, {}, "rotor_inertia", YamlSection.number, tree.check_joint
    )
    friction |= _read_or_default(read_friction, {}, top, tree)
    forces = springs + _read_or_default(read_forces, (), top, tree)
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
        name=name,
        source=source,
        path=path,
        chains=chains,
        tree=with_rotor_inertias(tree.tree, rotor_inertias),
        loops=loops,
        active=active,
        home=home,
        friction=friction,
        forces=forces,
        gas_springs=_read_or_default(read_gas_springs, (), top, tree),
        end_stops=_read_or_default(read_end_stops, (), top, tree),
        tip=tip,
        tasks=tasks,
        control=control,
        hydraulics=hydraulics,
        couplings=couplings,
        source_locations=locations,
        payload=payload,
        free=free,
        drives=_read_or_default(read_drives, (), top, tree),
        ropes=_read_or_default(read_ropes, (), top, tree),
        sensors=_read_or_default(read_sensors, {}, top, tree),
        estimation=_read_or_default(read_estimation, EstimationSettings(), top),
        external_forces=external_forces,
        supports=_read_or_default(_read_supports, (), top, tree, external_forces),
        pin_capacities=_read_or_default(_read_pins, {}, top, tree, loops),
        gravity=gravity,
        start=_read_or_default(YamlSection.text, "", top, "start"),
        written_numbers=top.written_numbers(),
    )


def _read_active_joints(
    top: YamlSection, tree: TreeBuilder, drawn: MachineSpec
) -> tuple[str, ...]:
    active: tuple[str, ...] = UnknownNames()
    with error_recovery():
        active = top.names("active") if "active" in top else drawn.active or ()
    for joint in active:
        with error_recovery():
            tree.check_joint(joint, top.source_location("active"))
    return active if all(joint in tree.joints for joint in active) else UnknownNames()


def _fill_circuit(top: YamlSection) -> None:
    """Let the cylinders of the circuit have the dimensions that the drawing has."""
    drawing, circuit = top.section("drawing"), top.section("hydraulics")
    if drawing is not None and circuit is not None:
        circuit.fill_items("cylinders", drawing, CYLINDER_SIZE_KEYS)


def _read_supports(
    top: YamlSection, tree: TreeBuilder, external_forces: Sequence[ExternalForce]
) -> tuple[str, ...]:
    names = top.names("supports")
    contacts = {force.frame for force in external_forces if isinstance(force, Contact)}
    for link in names:
        tree.check_link(link, top.source_location("supports"), "the support")
        lifting_joint = "" if link in contacts else tree.lifting_joint(link)
        if lifting_joint:
            text = (
                f"support '{link}' is lifted by '{lifting_joint}', name links of the base, of "
                "contacts, or that turn about z as the front of an articulated frame"
            )
            raise tree.unknown_name_error(str(top.error_at("supports", text)))
    if names and len(names) < 3:
        raise top.error_at("supports", f"{len(names)} supports make no area, name three or more")
    return names


def _read_pins(top: YamlSection, tree: TreeBuilder, loops: Sequence[LoopSpec]) -> dict[str, float]:
    """The largest force that pins bear, by joint or loop [N]."""
    names = [*tree.joints, *(loop.name for loop in loops)]
    return top.value_map(
        "pins",
        YamlSection.number,
        lambda name, location: tree.check_name(
            name, names, f"{location}: '{name}' under 'pins' is no joint or loop"
        ),
    )


def _read_free_joints(
    top: YamlSection, tree: TreeBuilder, active: Container[str]
) -> tuple[str, ...]:
    free: tuple[str, ...] = ()
    with error_recovery(harmless=True):
        free = top.names("free")
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
    tip = top.text("tip")
    if tip is None:
        return None
    with error_recovery(harmless=True):
        tree.check_link(tip, top.source_location("tip"), "the tip frame")
        if not tree.is_movable(tip):
            raise tree.unknown_name_error(
                str(top.error_at("tip", f"the tip frame '{tip}' does not move, choose another"))
            )
    return tip


def _read_payload(top: YamlSection, tree: TreeBuilder, tip: str | None) -> PayloadSpec | None:
    """The load that payload.mass hangs on the tip, a chain without moving joints."""
    section = top.section("payload")
    if section is None:
        return None
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
            "urdf", f"no link of {urdf.path.name} has a mass, give one an <inertial>"
        )
    chain = Chain("payload", urdf.path, tip, section.source_location("urdf"), ())
    attachment = chain.attachment_joint(urdf.tree.root_link)
    for _ in tree.filter_new_names([attachment, *urdf.tree]):
        pass  # notes names that are taken
    return PayloadSpec(chain, urdf.tree.with_parts(attachment))


def _read_control(top: YamlSection, active: tuple[str, ...]) -> dict[str, PIGains]:
    gains = top.read_map(
        "control",
        lambda _, item: PIGains(**item.values()),
        lambda joint, location: check_active_joint(active, joint, location),
    )
    named_joints = top.item_names("control")
    missing = [joint for joint in active if named_joints and joint not in named_joints]
    if missing:
        raise top.error_at("control", f"no gains for {', '.join(missing)}, give kp and ki of each")
    return gains


def read_estimation(top: YamlSection) -> EstimationSettings:
    """Terms, prior knowledge and settings; an identification checks that the names exist."""
    section = top.section("identification")
    if section is None:
        return EstimationSettings()
    return EstimationSettings(
        section.value_map("terms", _read_term),
        section.value_map("prior", _read_prior),
        section.number("bandwidth") if "bandwidth" in section else None,
        section.value_map("min_speed", YamlSection.number),
    )


def estimation_data(settings: EstimationSettings) -> dict[str, Any]:
    """The section as it is written."""
    data = {
        "terms": {name: _term_data(numbers) for name, numbers in settings.terms.items()},
        "prior": {name: str(known) for name, known in settings.prior.items()},
        "bandwidth": settings.bandwidth,
        "min_speed": dict(settings.min_speed),
    }
    return {key: value for key, value in data.items() if value}


def _read_term(section: YamlSection, name: str) -> TermValues | None:
    """() of `on`, None of `off`."""
    value = section.raw_value(name)
    if (is_wanted := as_boolean(value)) is not None:
        return () if is_wanted else None
    if isinstance(value, str) and not (is_quantity(value) or math.isfinite(as_float(value))):
        label = f"'{name}' of {section.title} is '{value}'"
        raise section.error_at(name, f"{label}, give on, off, a number or a list of numbers")
    count = len(value) if isinstance(value, list) else 1
    units = (", ".join(estimation_units(name, section.turns, i)) for i in range(count))
    section.schema = dataclasses.replace(
        section.schema, others=NumberListKey(column_units=tuple(units))
    )
    return section.numbers(name) if isinstance(value, list) else (section.number(name),)


def _read_prior(section: YamlSection, name: str) -> ParameterPrior:
    try:
        return ParameterPrior.parse(section.raw_value(name), estimation_units(name, section.turns))
    except InputError as error:
        raise section.error_at(name, f"'{name}' of 'prior': {error}") from None


def _term_data(values: TermValues | None) -> bool | float | list[float]:
    if not values:
        return values is not None
    return values[0] if len(values) == 1 else list(values)


def read_sensors(top: YamlSection, tree: TreeBuilder) -> dict[str, Sensor]:
    """Sensors by the quantity that they measure."""

    def read_sensor(name: str, item: YamlSection) -> Sensor:
        unit = quantity_unit(tree.tree, name)
        if unit is None:
            known = suggest_names(quantity_units(tree.tree), name)
            raise tree.unknown_name_error(
                str(item.error_at(None, f"'{name}' is no quantity of this machine, {known}"))
            )
        given = item.text("unit") or unit
        if unit_size(given, unit) is None:
            raise item.error_at(
                "unit",
                f"'{name}' is in [{given}], give {' or '.join(accepted_units(unit)) or 'no unit'}",
            )
        item.schema = dataclasses.replace(
            SENSOR,
            keys={
                **SENSOR.keys,
                **{key: NumberKey(unit=unit) for key in ("zero", "noise")},
            },
        )
        if name == TIME and any(key in item for key in SENSOR_PARAMETERS):
            raise item.error_at(None, "time has a column and a unit, and no numbers of a sensor")
        if name.startswith(VALVE_SIGNAL_PREFIX) and "delay" in item:
            raise item.error_at("delay", str(signal_delay_error(name, name)))
        try:
            return Sensor(**item.values())
        except InputError as error:
            raise item.error_at(None, f"'{name}': {error}") from None

    return top.read_map("sensors", read_sensor)
