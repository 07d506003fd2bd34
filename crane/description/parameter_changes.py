"""Machines that differ from their files: other numbers, locked joints."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

import numpy as np

from crane.common.errors import CraneWarning, InputError, suggest_names
from crane.common.plausible_ranges import implausible_value_text
from crane.common.samples import MAX_COORDINATE, as_number
from crane.description.external_forces import ExternalForce
from crane.description.floating_bases import convert_locked_rotations
from crane.description.kinematic_tree import Joint, Limits, Link, Tree, parse_limit
from crane.description.machine_lookup import bundled_machines, command_line_arguments
from crane.description.sensors import (
    SENSOR_PREFIX,
    parse_sensor_parameter,
    quantity_names,
    quantity_unit,
    sensor_parameters,
    with_sensor_parameters,
)
from crane.description.specification import (
    AnyForceElement,
    Chain,
    Coupling,
    Drive,
    EndStop,
    Friction,
    MachineSpec,
)
from crane.hydraulics.circuit_elements import parameter_names
from crane.hydraulics.hydraulic_circuit import Hydraulics

PAYLOAD_MASS = "payload.mass"
PINS_PREFIX = "pins."
_ELEMENT_FIELDS = ("forces", "gas_springs", "ropes", "end_stops")
_ANGLE_NAMES = ("roll", "pitch", "yaw")
_LIMIT_TOLERANCE = 1e-9  # of a limit, for rounding


# Where a number stands: names of fields, and indices in tuples, from a link or a joint on
_FieldPath = tuple[str | int, ...]
_TENSOR_COMPONENTS = ("xx", "xy", "xz", "yy", "yz", "zz")


def tree_parameters(
    tree: Tree, chains: Iterable[Chain]
) -> Iterator[tuple[str, Link | Joint, _FieldPath]]:
    """Names of a tree's numbers, with the link or joint that has them, and where."""
    for link in tree.links.values():
        if link.inertial is None:
            continue
        yield f"{link.name}.mass", link, ("inertial", "mass")
        for i, axis in enumerate("xyz"):
            yield f"{link.name}.com.{axis}", link, ("inertial", "com", i)
        for i, key in enumerate(_TENSOR_COMPONENTS):
            yield f"{link.name}.inertia.{key}", link, ("inertial", "tensor", i)
    attachment_names = {chain.attachment_name for chain in chains if chain.parent is not None}
    for joint in tree.joints.values():
        if joint.name in attachment_names:
            continue  # whose place stands in no file
        for i, (axis, angle) in enumerate(zip("xyz", _ANGLE_NAMES, strict=True)):
            yield f"{joint.child}.{axis}", joint, ("xyz", i)
            yield f"{joint.child}.{angle}", joint, ("rpy", i)
        limit_names = ("lower", "upper") if joint.is_movable else ()
        for key in [key for key in limit_names if math.isfinite(getattr(joint.limits, key))]:
            yield f"{joint.name}.{key}", joint, ("limits", key)
        if joint.is_movable:
            yield f"{joint.name}.rotor_inertia", joint, ("rotor_inertia",)


def parameter_value(part: Any, field_path: _FieldPath) -> float:
    """The number of a link or a joint where `tree_parameters` says that it stands."""
    for key in field_path:
        part = part[key] if isinstance(key, int) else getattr(part, key)
    return float(part)


def _replace_at_path(part: Any, field_path: _FieldPath, value: float) -> Any:
    """A part of the description with another number in it."""
    if not field_path:
        return value
    key, inner_path = field_path[0], field_path[1:]
    if isinstance(key, int):
        return (*part[:key], _replace_at_path(part[key], inner_path, value), *part[key + 1 :])
    return dataclasses.replace(
        part, **{key: _replace_at_path(getattr(part, key), inner_path, value)}
    )


def parameters(spec: MachineSpec) -> dict[str, float]:
    """Numbers of a machine that can be changed, by name.

    `LINK.mass`, `LINK.com.x`, `LINK.inertia.xx` (about the centre of mass), `LINK.x`, `LINK.roll`
    (where its joint places it on its parent; frames such as pins are links, too),
    `JOINT.lower`, `JOINT.rotor_inertia`, `friction.JOINT.coulomb`,
    `control.JOINT.kp`, of a circuit `supply.pressure`, `oil.bulk_modulus`,
    `cylinder.JOINT.area_a`, `valve.JOINT.c1`; of what acts along joints or between
    frames `spring.JOINT.stiffness`, `gas_spring.JOINT.pressure`,
    `rope.LINK-LINK.length`, `end_stop.JOINT.stiffness`; and `payload.mass`, a point mass at
    the tip, or the load that the machine file names, scaled to that mass; of its sensors
    `sensor.QUANTITY.zero`, `.scale`, `.delay`, `.noise`, which may be set of any quantity; of pins
    `pins.JOINT`, the largest force that they bear.
    """
    tree_values = tree_parameters(spec.tree, spec.chains)
    values = {name: parameter_value(part, way) for name, part, way in tree_values}
    for joint in (joint.name for joint in spec.tree.moving_joints):
        friction = spec.friction.get(joint, Friction())
        for field in dataclasses.fields(Friction):
            values[f"friction.{joint}.{field.name}"] = getattr(friction, field.name)
    for joint, gains in spec.control.items():
        for field in dataclasses.fields(gains):
            values[f"control.{joint}.{field.name}"] = getattr(gains, field.name)
    for prefix, (_, _, item) in elements_by_prefix(**_element_lists(spec)).items():
        for field in dataclasses.fields(item):
            if field.name not in ("joint", "between"):
                values[f"{prefix}.{field.name}"] = getattr(item, field.name)
    if spec.hydraulics is not None:
        for prefix, part in components_by_prefix(spec.hydraulics).items():
            names = [
                x for x in parameter_names(type(part)) if (prefix[:7], x) != ("supply.", "tank")
            ]
            values |= {f"{prefix}.{name}": getattr(part, name) for name in names}
    if spec.tip is not None:
        values[PAYLOAD_MASS] = 0.0
    values |= {f"{PINS_PREFIX}{name}": force for name, force in spec.pin_capacities.items()}
    return values | sensor_parameters(spec.sensors)


def elements_by_prefix(
    **elements_by_field: Sequence[AnyForceElement | EndStop],
) -> dict[str, tuple[str, int, AnyForceElement | EndStop]]:
    """Springs, gas springs, ropes and end stops by the names that their numbers begin with.

    With the field of the description and the place in it that they have.

    Args:
        elements_by_field: By those fields: forces, gas_springs, ropes, end_stops.
    """
    found: dict[str, tuple[str, int, AnyForceElement | EndStop]] = {}
    for prefix, field in (
        ("spring", "forces"), ("gas_spring", "gas_springs"), ("rope", "ropes"),
        ("end_stop", "end_stops"),
    ):  # fmt: skip
        for i, item in enumerate(elements_by_field[field]):
            between = getattr(item, "between", None)
            name = f"{prefix}.{'-'.join(between) if between else item.joint}"
            count = sum(other == name or other.startswith(f"{name}#") for other in found)
            found[f"{name}#{count + 1}" if count else name] = field, i, item
    return found


def _element_lists(spec: MachineSpec) -> dict[str, Sequence[Any]]:
    return {field: getattr(spec, field) for field in _ELEMENT_FIELDS}


def apply_parameter_changes(spec: MachineSpec, changes: Mapping[str, float]) -> MachineSpec:
    """A machine with other numbers.

    Args:
        spec: The machine as read.
        changes: New values by name, see `parameters`; SI units.

    Raises:
        InputError: Unknown name, or a value that cannot be.
    """
    names = parameters(spec)
    tree_locations = {
        name: (part, field_path)
        for name, part, field_path in tree_parameters(spec.tree, spec.chains)
    }
    tree, chains = spec.tree, spec.chains
    friction, control, pins = dict(spec.friction), dict(spec.control), dict(spec.pin_capacities)
    circuit = components_by_prefix(spec.hydraulics) if spec.hydraulics else {}
    elements_of_prefix = elements_by_prefix(**_element_lists(spec))
    component_changes: dict[str, dict[str, float]] = {}
    element_changes: dict[str, dict[str, float]] = {}
    sensor_changes: dict[str, float] = {}
    for name in sorted(changes, key=lambda name: name == PAYLOAD_MASS):  # last: it adds to a link
        if name.startswith(SENSOR_PREFIX):
            _check_sensor_quantity(spec, name)
        elif name not in names:
            raise InputError(unknown_parameter_text(spec, names, name))
        value = as_number(changes[name], f"parameter '{name}'", "")
        head, _, rest = name.partition(".")
        if name.endswith(".mass") and value < 0:
            raise InputError(f"parameter '{name}' is {value:g} kg, it must not be negative")
        if name.endswith(".rotor_inertia") and value < 0:
            raise InputError(f"parameter '{name}' is {value:g}, it must not be negative")
        if name.startswith(PINS_PREFIX) and value <= 0:
            raise InputError(f"parameter '{name}' is {value:g} N, give a force above 0")
        if name == PAYLOAD_MASS:
            tree, chains = _add_payload(spec, tree, value)
        elif name.startswith(SENSOR_PREFIX):
            sensor_changes[name] = value
        elif name.startswith(PINS_PREFIX):
            pins[rest] = value
        elif head == "friction":
            _set_joint_parameter(friction, rest, value, Friction)
        elif (part := name.rpartition(".")[0]) in elements_of_prefix:
            element_changes.setdefault(part, {})[name.rpartition(".")[2]] = value
        elif part in circuit:
            component_changes.setdefault(part, {})[name.rpartition(".")[2]] = value
        elif head == "control":
            _set_joint_parameter(control, rest, value, None)
        else:
            owner, way = tree_locations[name]
            current = (tree.links if isinstance(owner, Link) else tree.joints)[owner.name]
            tree = tree.with_parts(_change_part_parameter(current, way, value, name))
    for part, values in component_changes.items():
        circuit[part] = dataclasses.replace(circuit[part], **values)
    lists: dict[str, list[Any]] = {
        field: list(items) for field, items in _element_lists(spec).items()
    }
    for part, values in element_changes.items():
        field, i, _ = elements_of_prefix[part]
        lists[field][i] = dataclasses.replace(lists[field][i], **values)
    hydraulics = _with_components(spec.hydraulics, circuit) if spec.hydraulics else None
    for part, values in component_changes.items():
        _warn_about_units(spec, part, values)
    return dataclasses.replace(
        spec,
        chains=chains,
        tree=tree,
        friction=MappingProxyType(friction),
        control=MappingProxyType(control),
        pin_capacities=MappingProxyType(pins),
        hydraulics=hydraulics,
        forces=tuple(lists["forces"]),
        gas_springs=tuple(lists["gas_springs"]),
        ropes=tuple(lists["ropes"]),
        end_stops=tuple(lists["end_stops"]),
        sensors=MappingProxyType(with_sensor_parameters(spec.sensors, sensor_changes)),
    )


def _check_sensor_quantity(spec: MachineSpec, name: str) -> None:
    """See that a number is of a sensor that a machine may have."""
    quantity, _ = parse_sensor_parameter(name)
    if quantity_unit(spec.tree, quantity) is None and quantity not in spec.sensors:
        hint = suggest_names(quantity_names(spec.tree), quantity)
        raise InputError(f"'{name}' is of no quantity of '{spec.name}', {hint}")


def _change_part_parameter(
    part: Link | Joint, field_path: _FieldPath, value: float, name: str
) -> Link | Joint:
    """A link or joint with another number, called `name`, in it."""
    if field_path[0] != "limits":
        return _replace_at_path(part, field_path, value)
    assert isinstance(part, Joint)
    limit_change = {str(field_path[-1]): parse_limit(value)}
    limits = dataclasses.replace(part.limits, source_location=f"changed by {name}", **limit_change)
    return dataclasses.replace(part, limits=limits)


def unknown_parameter_text(spec: MachineSpec, names: Iterable[str], unknown_name: str) -> str:
    """What is said of a parameter that is none: names like it, and where all are."""
    similar_names = get_close_matches(unknown_name, names, 3, 0.6)
    suggestion = f"did you mean '{similar_names[0]}'? " if similar_names else ""
    if len(similar_names) > 1:
        suggestion += f"like it are {' and '.join(map(repr, similar_names[1:]))}; "
    machine_name = (
        spec.path.stem if bundled_machines().get(spec.path.stem) == spec.path else spec.path
    )
    problem = f"parameter '{unknown_name}' is unknown"
    return (
        f"{problem}, {suggestion}crane info {command_line_arguments(machine_name)} --names "
        f"lists all names"
    )


def _warn_about_units(spec: MachineSpec, part: str, values: Mapping[str, float]) -> None:
    """Warn of numbers of the circuit that can be, and hardly are in their SI unit."""
    joint = part.partition(".")[2]
    is_rotary = joint in spec.tree.joints and spec.tree.joints[joint].kind != "prismatic"
    for name, value in values.items():
        if text := implausible_value_text(name, value, is_rotary, part.partition(".")[0]):
            message = f"parameter '{part}.{name}' {text}"
            warnings.warn(message, CraneWarning, stacklevel=2)


SPOOL_B = "spool_b"  # second spool of a valve, whose numbers are those of a part of their own
CIRCUIT_FIELDS = {
    "cylinder.": "cylinders", "valve.": "valves", "valve_control.": "control",
    "supply.": "supplies", "line.": "lines", "accumulator.": "accumulators",
    "element.": "elements",
}  # fmt: skip


def components_by_prefix(hydraulics: Hydraulics) -> dict[str, Any]:
    """The parts of a circuit by the names that their numbers begin with."""
    return (
        {"supply": hydraulics.supply, "oil": hydraulics.oil}
        | {f"supply.{name}": part for name, part in hydraulics.supplies.items()}
        | ({"engine": hydraulics.engine} if hydraulics.engine is not None else {})
        | {f"line.{name}": part for name, part in hydraulics.lines.items()}
        | {f"accumulator.{name}": part for name, part in hydraulics.accumulators.items()}
        | {f"element.{name}": part for name, part in hydraulics.elements.items()}
        | {f"cylinder.{joint}": part for joint, part in hydraulics.cylinders.items()}
        | {f"valve.{joint}": part for joint, part in hydraulics.valves.items()}
        | {
            f"valve.{x.joint}.{SPOOL_B}": x.spool_b
            for x in hydraulics.valves.values()
            if x.spool_b
        }
        | {f"valve_control.{joint}": part for joint, part in hydraulics.control.items()}
    )


def _with_components(hydraulics: Hydraulics, components: Mapping[str, Any]) -> Hydraulics:
    """A circuit with these parts in place of its own."""
    components = dict(components)
    for joint, valve in hydraulics.valves.items():
        second_spool = components.pop(f"valve.{joint}.{SPOOL_B}", None)
        if valve.spool_b is not None:
            of = components[f"valve.{joint}"]
            components[f"valve.{joint}"] = dataclasses.replace(of, spool_b=second_spool)
    component_groups: dict[str, Any] = {
        field: {
            name.removeprefix(kind): part
            for name, part in components.items()
            if name.startswith(kind)
        }
        for kind, field in CIRCUIT_FIELDS.items()
    }
    single_components: dict[str, Any] = {
        name: components[name] for name in ("supply", "oil", "engine") if name in components
    }
    return dataclasses.replace(hydraulics, **single_components, **component_groups)


def lock_joints(spec: MachineSpec, lock: Mapping[str, float]) -> MachineSpec:
    """A machine with some joints fixed.

    What refers to a locked joint, such as its friction, goes with it, and so do tasks of active
    joints if one of them is locked, and what acts between two frames that make one body now.

    Args:
        spec: The machine as read.
        lock: Coordinate [m], [rad] by joint.

    Raises:
        InputError: No such joint, no finite coordinate, one beyond its limits, or the last active
            joint.
    """
    joints = {joint.name: joint for joint in spec.tree.moving_joints}
    fixed_joints = []
    spec, lock = convert_locked_rotations(spec, lock)
    for name in lock.keys() & joints.keys():
        _check_lock_coordinate(joints[name], lock[name])
    lock, couplings = _propagate_locks(spec.couplings, lock)
    for name, given in lock.items():
        if name not in joints:
            raise InputError(f"joint '{name}' to lock is unknown, {suggest_names(joints, name)}")
        fixed_joints.append(_fix_joint(joints[name], given))
    active = spec.active and tuple(name for name in spec.active if name not in lock)
    has_free_joint = any(name not in lock for name in spec.free)
    if (spec.active and not active and not has_free_joint) or not joints.keys() - lock.keys():
        raise InputError(f"with {', '.join(lock)} locked nothing drives the machine, lock less")
    tree = spec.tree.with_parts(*fixed_joints)
    body_of_link = tree.bodies_by_link()

    spools = spec.hydraulics.spools if spec.hydraulics else {}

    def moves(force: ExternalForce) -> bool:
        return body_of_link[force.frame] != body_of_link[tree.root_link]

    def acts(item: AnyForceElement) -> bool:
        if item.between is None:
            return item.joint not in lock
        return len({body_of_link[frame] for frame in item.between}) > 1

    chains = tuple(
        dataclasses.replace(chain, joints=tuple(j for j in chain.joints if j not in lock))
        for chain in spec.chains
    )
    return dataclasses.replace(
        spec,
        tree=tree,
        chains=chains,
        active=active,
        free=tuple(name for name in spec.free if name not in lock),
        drives=_drives_of_movable_joints(spec.drives, lock),
        home={joint: value for joint, value in spec.home.items() if joint not in lock},
        friction={joint: value for joint, value in spec.friction.items() if joint not in lock},
        control={joint: value for joint, value in spec.control.items() if joint not in lock},
        pin_capacities={
            name: value for name, value in spec.pin_capacities.items() if name not in lock
        },
        forces=tuple(filter(acts, spec.forces)),
        external_forces=tuple(filter(moves, spec.external_forces)),
        hydraulics=spec.hydraulics and spec.hydraulics.select_joints(active or ()),
        gas_springs=tuple(filter(acts, spec.gas_springs)),
        ropes=tuple(filter(acts, spec.ropes)),
        end_stops=tuple(item for item in spec.end_stops if item.joint not in lock),
        tasks={
            name: dataclasses.replace(
                task,
                levers={
                    x: lever
                    for x, lever in task.levers.items()
                    if x not in lock and (x not in spools or spools[x].joint not in lock)
                },
                phases=tuple(
                    x for phase in task.phases if (x := phase.without_joints(lock)).levers
                ),
                start={x: value for x, value in task.start.items() if x not in lock},
                loads=tuple(filter(moves, task.loads)),
            )
            for name, task in spec.tasks.items()
            if not (task.space == "active" and lock.keys() & set(task.coordinates))
        },
        couplings=couplings,
    )


def _drives_of_movable_joints(
    drives: tuple[Drive, ...], lock: Mapping[str, float]
) -> tuple[Drive, ...]:
    """Drives of what still moves."""
    remaining = (
        dataclasses.replace(
            drive, factors={x: f for x, f in drive.factors.items() if x not in lock}
        )
        for drive in drives
    )
    return tuple(drive for drive in remaining if drive.factors)


def set_active_joints(
    spec: MachineSpec, active: Sequence[str] | None, free: Sequence[str] | None
) -> MachineSpec:
    """A machine whose drives, or whose free coordinates, are others than its file says.

    Circuits, gains and tasks of joints that are not driven any more go.

    Args:
        spec: The machine as read.
        active: Driven joints, in the order of q_A; None for those of the file.
        free: Coordinates that nothing drives; None for those of the file.

    Raises:
        InputError: No such joint, or one in both.
    """
    names = [joint.name for joint in spec.tree.moving_joints]
    for what, given in (("active", active), ("free", free)):
        for joint in given or ():
            if joint not in names:
                raise InputError(
                    f"{what} joint '{joint}' is unknown, {suggest_names(names, joint)}"
                )
            if list(given or ()).count(joint) > 1:
                raise InputError(f"{what} joint '{joint}' is named twice, once will do")
            if joint in (active or ()) and joint in (free or ()):
                raise InputError(f"joint '{joint}' is active and free, keep one of the two")
    free_names = tuple(spec.free if free is None else free)
    if active is None:
        drives = _drives_of_movable_joints(spec.drives, dict.fromkeys(free_names, 0.0))
        active_names = spec.active and tuple(
            name for name in spec.active if name not in free_names
        )
    else:
        drives, active_names = (), tuple(active)
    free_names = tuple(name for name in free_names if name not in (active_names or ()))
    remaining_names = names if active_names is None else active_names
    is_unchanged = active_names == spec.active
    return dataclasses.replace(
        spec,
        active=active_names,
        free=free_names,
        drives=drives,
        control={
            x: gains
            for x, gains in spec.control.items()
            if x in remaining_names and x not in free_names
        },
        hydraulics=spec.hydraulics and spec.hydraulics.select_joints(remaining_names),
        tasks={
            name: task
            for name, task in spec.tasks.items()
            if task.space == "tip"
            or is_unchanged
            or not {*task.coordinates, *task.start} - set(remaining_names)
        },
    )


def _lock_coupled_joints(couplings: list[Coupling], locked: dict[str, float]) -> bool:
    """Lock joints that couplings leave no freedom, take out these couplings; whether any was."""
    initial_count = len(locked)
    for coupling in tuple(couplings):
        free = {name: x for name, x in coupling.factors.items() if name not in locked}
        locked_names = coupling.factors.keys() - free.keys()
        if len(free) > 1 or not locked_names:
            continue
        couplings.remove(coupling)
        residual = coupling.offset - sum(
            coupling.factors[name] * locked[name] for name in locked_names
        )
        if not free and abs(residual) > 1e-9:
            raise InputError(
                f"coupling '{coupling.name}' does not allow "
                f"{', '.join(f'{x} = {locked[x]:g}' for x in sorted(locked_names))}, lock one of "
                "them alone"
            )
        locked |= {name: residual / factor for name, factor in free.items()}
    return len(locked) > initial_count


def _propagate_locks(
    couplings: tuple[Coupling, ...], lock: Mapping[str, float]
) -> tuple[dict[str, float], tuple[Coupling, ...]]:
    """Locks with what couplings make of them, and the couplings of what still moves."""
    locked = {
        name: as_number(
            x, f"the coordinate to lock '{name}' at", "m or rad", max_magnitude=MAX_COORDINATE
        )
        for name, x in lock.items()
    }
    remaining = list(couplings)
    while _lock_coupled_joints(remaining, locked):
        pass  # others may follow those
    return locked, tuple(
        dataclasses.replace(
            coupling,
            factors={name: x for name, x in coupling.factors.items() if name not in locked},
            offset=coupling.offset
            - sum(x * locked[name] for name, x in coupling.factors.items() if name in locked),
        )
        for coupling in remaining
    )


def _check_lock_coordinate(joint: Joint, coordinate: object) -> None:
    """Raise where a joint cannot be at a coordinate [m], [rad]."""
    value = as_number(
        coordinate,
        f"the coordinate to lock '{joint.name}' at",
        "m or rad",
        max_magnitude=MAX_COORDINATE,
    )
    lower, upper = joint.limits.lower, joint.limits.upper
    tolerance = _LIMIT_TOLERANCE * max(1.0, abs(value))
    if not lower - tolerance <= value <= upper + tolerance:
        unit = "m" if joint.kind == "prismatic" else "rad"
        raise InputError(
            f"joint '{joint.name}' cannot be locked at {value:g} {unit}, beyond its limits "
            f"{joint.limits}, give a coordinate within them"
        )


def _fix_joint(joint: Joint, value: float) -> Joint:
    """A joint fixed where its coordinate has a value."""
    from scipy.spatial.transform import Rotation

    fixed_joint = dataclasses.replace(joint, kind="fixed", limits=Limits(), rotor_inertia=0.0)
    rotation, axis = Rotation.from_euler("xyz", joint.rpy), np.array(joint.axis)
    if joint.kind == "prismatic":
        x, y, z = (np.array(joint.xyz) + rotation.apply(value * axis)).tolist()
        return dataclasses.replace(fixed_joint, xyz=(x, y, z))
    if not value:
        return fixed_joint
    roll, pitch, yaw = (rotation * Rotation.from_rotvec(value * axis)).as_euler("xyz").tolist()
    return dataclasses.replace(fixed_joint, rpy=(roll, pitch, yaw))


def _set_joint_parameter(
    values_by_joint: dict, name: str, value: float, default: Callable | None
) -> None:
    joint, _, field = name.rpartition(".")
    before = values_by_joint[joint] if default is None else values_by_joint.get(joint, default())
    values_by_joint[joint] = dataclasses.replace(before, **{field: value})


def _add_payload(spec: MachineSpec, tree: Tree, mass: float) -> tuple[Tree, tuple[Chain, ...]]:
    """Fix a payload to the tip: the machine's own, scaled to the mass, or else a point mass.

    Masses and inertias are scaled, places are not: a load of another density.

    Returns:
        The tree with it, and the chains that it is made of now.
    """
    if mass == 0:
        return tree, spec.chains
    if spec.payload is None:
        import pinocchio as pin

        from crane.description.pinocchio_conversion import add_rigid_load

        tip = str(spec.tip)
        frame = (
            Link("payload", PAYLOAD_MASS),
            Joint("payload_fixed", "fixed", tip, "payload", PAYLOAD_MASS),
        )
        point_mass = pin.Inertia(mass, np.zeros(3), np.zeros((3, 3)))
        return add_rigid_load(tree.with_parts(*frame), tip, point_mass), spec.chains
    scale = mass / spec.payload.tree.total_mass
    scaled_parts = [
        _scale_mass(part, scale) if isinstance(part, Link) else part for part in spec.payload.tree
    ]
    return tree.with_parts(*scaled_parts), (*spec.chains, spec.payload.chain)


def _scale_mass(link: Link, scale: float) -> Link:
    """A link of another density."""
    if (inertial := link.inertial) is None:
        return link
    tensor = tuple(scale * x for x in inertial.tensor)
    inertial = dataclasses.replace(inertial, mass=scale * inertial.mass, tensor=tensor)
    return dataclasses.replace(link, inertial=inertial)
