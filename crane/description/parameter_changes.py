"""Descriptions with other parameters, locked joints, or other active joints."""

import dataclasses
import warnings
from collections.abc import Container, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from crane.common.errors import CraneWarning, InputError, suggest_names
from crane.common.plausible_ranges import implausible_value_text
from crane.common.samples import MAX_COORDINATE, as_number
from crane.common.unit_conversions import UnitError, parse_quantity
from crane.description.external_forces import ExternalForce
from crane.description.force_elements import (
    AnyForceElement,
    Friction,
    as_nonnegative_number,
)
from crane.description.kinematic_tree import Joint, Limits, Link, parse_limit
from crane.description.machine_parameters import (
    PAYLOAD_MASS,
    PINS_PREFIX,
    FieldPath,
    parameter_paths,
    parameter_unit,
    parameters,
    unknown_parameter_text,
    value_at,
)
from crane.description.rotation_vectors import convert_locked_rotations
from crane.description.sensors import (
    SENSOR_PREFIX,
    parse_sensor_parameter,
    quantity_unit,
    quantity_units,
    with_sensor_parameters,
)
from crane.description.specification import Coupling, Drive, MachineSpec, Task

_LIMIT_TOLERANCE = 1e-9  # relative to a limit, for rounding

T = TypeVar("T")


def changes_in_si(spec: MachineSpec, changes: Mapping[str, Any] | None) -> dict[str, Any]:
    """Parameter changes with numbers in place of texts with units; unknown names are left.

    Raises:
        InputError: A text is no number in a unit of its parameter.
    """
    changes = changes or {}
    texts = [name for name in changes if isinstance(changes[name], str)]
    known = parameters(spec) if texts else {}
    numbers = {
        name: _in_si(f"parameter '{name}'", changes[name], (parameter_unit(spec.tree, name),))
        for name in texts
        if name in known or name.startswith(SENSOR_PREFIX)
    }
    return {**changes, **numbers}


def locks_in_si(spec: MachineSpec, lock: Mapping[str, Any] | None) -> dict[str, Any]:
    """Coordinates of locked joints with numbers in place of texts with units.

    Raises:
        InputError: A text is no number in a unit of its joint.
    """

    def units_of(name: str) -> tuple[str, ...]:
        return tuple(filter(None, [quantity_unit(spec.tree, name)])) or ("m", "rad")

    return {
        name: _in_si(f"the coordinate to lock '{name}' at", value, units_of(name))
        if isinstance(value, str)
        else value
        for name, value in (lock or {}).items()
    }


def _in_si(what: str, text: str, units: Sequence[str]) -> float:
    try:
        return parse_quantity(text, units).value
    except UnitError as error:
        raise InputError(f"{what} is '{text}', {error}") from None


def apply_parameter_changes(spec: MachineSpec, changes: Mapping[str, float]) -> MachineSpec:
    """Return a machine with other parameters.

    Args:
        spec: The machine as read.
        changes: New values by name, see `parameters`; SI units.

    Raises:
        InputError: A name is unknown, or a value is not allowed.
    """
    paths = parameter_paths(spec)
    values = {name: _check_change(spec, paths, name, changes[name]) for name in changes}
    values = _flows_at_engine_speed(spec, values) | values
    payload_mass = values.pop(PAYLOAD_MASS, 0.0)
    sensor_changes = {x: value for x, value in values.items() if x.startswith(SENSOR_PREFIX)}
    new_values: dict[FieldPath, Any] = {}
    for name in [name for name in values if name not in sensor_changes]:
        value, path = values[name], paths[name]
        if "limits" in path:
            value = parse_limit(value)
            new_values[*path[:-1], "source_location"] = f"changed by {name}"
        new_values[path] = value
    changed_joints = [str(path[1]) for path in new_values if path[0] == "friction"]
    changed: MachineSpec = _replace_values(
        dataclasses.replace(
            spec,
            friction={**spec.friction}
            | {joint: Friction() for joint in changed_joints if joint not in spec.friction},
        ),
        new_values,
    )
    for name, value in values.items():
        if name not in sensor_changes and paths[name][0] == "hydraulics":
            _warn_about_unit(spec, name, value)
    changed = dataclasses.replace(
        changed, sensors=MappingProxyType(with_sensor_parameters(spec.sensors, sensor_changes))
    )
    return _add_payload(changed, payload_mass) if payload_mass else changed


def _flows_at_engine_speed(spec: MachineSpec, values: Mapping[str, float]) -> dict[str, float]:
    """Flows of the pumps of which the file gives the displacement, at another engine speed."""
    if "engine.speed" not in values or spec.hydraulics is None:
        return {}
    numbers, flows = spec.written_numbers, {}
    for prefix, path in (
        ("supply", ("supply",)),
        *((f"supply.{name}", ("supplies", name)) for name in spec.hydraulics.supplies),
    ):
        size = numbers.get(("hydraulics", *path, "displacement"))
        if size is not None and ("hydraulics", *path, "speed") not in numbers:
            flows[f"{prefix}.flow"] = size.value * values["engine.speed"]
    return flows


def _check_change(spec: MachineSpec, paths: Container[str], name: str, new_value: object) -> float:
    if name.startswith(SENSOR_PREFIX):
        quantity, _ = parse_sensor_parameter(name)
        if quantity_unit(spec.tree, quantity) is None and quantity not in spec.sensors:
            hint = suggest_names(quantity_units(spec.tree), quantity)
            raise InputError(f"'{name}' is of no quantity of '{spec.name}', {hint}")
    elif name not in paths and (name != PAYLOAD_MASS or spec.tip is None):
        raise InputError(unknown_parameter_text(spec, parameters(spec), name))
    if name.endswith((".mass", ".rotor_inertia")):
        return as_nonnegative_number(
            new_value, f"parameter '{name}'", "kg" if name.endswith(".mass") else ""
        )
    value = as_number(new_value, f"parameter '{name}'", "")
    if name.startswith(PINS_PREFIX) and value <= 0:
        raise InputError(f"parameter '{name}' is {value:g} N, give a force above 0")
    return value


def _replace_values(owner: Any, new_values: Mapping[FieldPath, Any]) -> Any:
    values_by_key: dict[str | int, dict[FieldPath, Any]] = {}
    for (key, *rest), value in new_values.items():
        values_by_key.setdefault(key, {})[tuple(rest)] = value
    replaced: dict[Any, Any] = {
        key: values[()] if () in values else _replace_values(value_at(owner, (key,)), values)
        for key, values in values_by_key.items()
    }
    if isinstance(owner, tuple):
        return tuple(replaced.get(i, item) for i, item in enumerate(owner))
    if isinstance(owner, dict):
        return owner | replaced
    if isinstance(owner, Mapping):
        return MappingProxyType({**owner, **replaced})
    return dataclasses.replace(owner, **replaced) if replaced else owner


def _warn_about_unit(spec: MachineSpec, name: str, value: float) -> None:
    part, _, key = name.rpartition(".")
    kind, _, joint = part.partition(".")
    is_rotary = joint in spec.tree.joints and spec.tree.joints[joint].kind != "prismatic"
    if text := implausible_value_text(key, value, is_rotary, kind):
        warnings.warn(f"parameter '{name}' {text}", CraneWarning, stacklevel=2)


def _scale_inertial(part: Link | Joint, scale: float) -> Link | Joint:
    if not isinstance(part, Link) or part.inertial is None:
        return part
    tensor = tuple(scale * x for x in part.inertial.tensor)
    scaled = dataclasses.replace(part.inertial, mass=scale * part.inertial.mass, tensor=tensor)
    return dataclasses.replace(part, inertial=scaled)


def _add_payload(spec: MachineSpec, mass: float) -> MachineSpec:
    """Return a machine with its payload fixed to the tip, or else with a point mass there.

    The payload is scaled to the mass as if it had another density: its dimensions stay.
    """
    tree = spec.tree
    if spec.payload is not None:
        scale = mass / spec.payload.tree.total_mass
        parts = [_scale_inertial(part, scale) for part in spec.payload.tree]
        return dataclasses.replace(
            spec, tree=tree.with_parts(*parts), chains=((*spec.chains, spec.payload.chain))
        )
    import pinocchio as pin

    from crane.description.pinocchio_conversion import add_rigid_load

    tip = str(spec.tip)
    tree = tree.with_parts(
        Link("payload", PAYLOAD_MASS),
        Joint("payload_fixed", "fixed", tip, "payload", PAYLOAD_MASS),
    )
    return dataclasses.replace(
        spec, tree=add_rigid_load(tree, tip, pin.Inertia(mass, np.zeros(3), np.zeros((3, 3))))
    )


def lock_joints(spec: MachineSpec, lock: Mapping[str, float]) -> MachineSpec:
    """Return a machine with some joints fixed.

    Parts of the description that refer to a locked joint, such as its friction, are removed. So
    are tasks of active joints of which one is locked, and force elements whose two frames belong
    to one body now.

    Args:
        spec: The machine as read.
        lock: Coordinate [m], [rad] by joint.

    Raises:
        InputError: A joint is unknown, a coordinate is not finite or outside of the limits, or no
            active joint is left.
    """
    joints = {joint.name: joint for joint in spec.tree.moving_joints}
    spec, lock = convert_locked_rotations(spec, lock)
    lock = {
        name: as_number(
            x, f"the coordinate to lock '{name}' at", "m or rad", max_magnitude=MAX_COORDINATE
        )
        for name, x in lock.items()
    }
    for name in lock.keys() & joints.keys():
        _check_lock_coordinate(joints[name], lock[name])
    lock, couplings = _propagate_locks(spec.couplings, lock)
    fixed_joints = []
    for name, value in lock.items():
        if name not in joints:
            raise InputError(f"joint '{name}' to lock is unknown, {suggest_names(joints, name)}")
        fixed_joints.append(_fix_joint(joints[name], value))
    active = spec.active and tuple(name for name in spec.active if name not in lock)
    free = tuple(name for name in spec.free if name not in lock)
    if (spec.active and not active and not free) or not joints.keys() - lock.keys():
        raise InputError(f"with {', '.join(lock)} locked nothing drives the machine, lock less")
    tree = spec.tree.with_parts(*fixed_joints)
    body_of_link = tree.bodies_by_link()
    spools = spec.hydraulics.spools if spec.hydraulics else {}

    def moves(force: ExternalForce) -> bool:
        return body_of_link[force.frame] != body_of_link[tree.root_link]

    def acts(element: AnyForceElement) -> bool:
        if element.between is None:
            return element.joint not in lock
        return len({body_of_link[frame] for frame in element.between}) > 1

    def task_without_locked(task: Task) -> Task:
        return dataclasses.replace(
            task,
            levers={
                name: lever
                for name, lever in _without(task.levers, lock).items()
                if name not in spools or spools[name].joint not in lock
            },
            phases=tuple(x for phase in task.phases if (x := phase.without_joints(lock)).levers),
            start=_without(task.start, lock),
            loads=tuple(filter(moves, task.loads)),
        )

    return dataclasses.replace(
        spec,
        tree=tree,
        chains=tuple(
            dataclasses.replace(chain, joints=tuple(x for x in chain.joints if x not in lock))
            for chain in spec.chains
        ),
        active=active,
        free=free,
        drives=_drives_without(spec.drives, lock),
        home=_without(spec.home, lock),
        friction=_without(spec.friction, lock),
        control=_without(spec.control, lock),
        pin_capacities=_without(spec.pin_capacities, lock),
        forces=tuple(filter(acts, spec.forces)),
        external_forces=tuple(filter(moves, spec.external_forces)),
        hydraulics=spec.hydraulics and spec.hydraulics.select_joints(active or ()),
        gas_springs=tuple(filter(acts, spec.gas_springs)),
        ropes=tuple(filter(acts, spec.ropes)),
        end_stops=tuple(stop for stop in spec.end_stops if stop.joint not in lock),
        tasks={
            name: task_without_locked(task)
            for name, task in spec.tasks.items()
            if not (task.space == "active" and lock.keys() & set(task.coordinates))
        },
        couplings=couplings,
    )


def _without(values: Mapping[str, T], joints: Container[str]) -> dict[str, T]:
    return {name: value for name, value in values.items() if name not in joints}


def _drives_without(drives: Iterable[Drive], joints: Container[str]) -> tuple[Drive, ...]:
    """Return drives without some joints; a drive without any joint left is omitted."""
    return tuple(
        dataclasses.replace(drive, factors=factors)
        for drive in drives
        if (factors := _without(drive.factors, joints))
    )


def set_active_joints(
    spec: MachineSpec, active: Sequence[str] | None, free: Sequence[str] | None
) -> MachineSpec:
    """Return a machine with other active or free joints.

    Circuits, gains and tasks of joints that are no longer driven are removed.

    Args:
        spec: The machine as read.
        active: Driven joints, in the order of q_A; None for those of the file.
        free: Free joints, which no actuator drives; None for those of the file.

    Raises:
        InputError: A joint is unknown, named twice, or both active and free.
    """
    names = [joint.name for joint in spec.tree.moving_joints]
    chosen = {"active": list(active or ()), "free": list(free or ())}
    for what, joint in [(what, joint) for what, given in chosen.items() for joint in given]:
        if joint not in names:
            raise InputError(f"{what} joint '{joint}' is unknown, {suggest_names(names, joint)}")
        if chosen[what].count(joint) > 1:
            raise InputError(f"{what} joint '{joint}' is named twice, once will do")
        if joint in chosen["active"] and joint in chosen["free"]:
            raise InputError(f"joint '{joint}' is active and free, keep one of the two")
    free_names = tuple(spec.free if free is None else free)
    if active is None:
        drives = _drives_without(spec.drives, free_names)
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


def _propagate_locks(
    couplings: tuple[Coupling, ...], lock: Mapping[str, float]
) -> tuple[dict[str, float], tuple[Coupling, ...]]:
    """Return the locks with those that couplings imply, and the remaining couplings."""
    locked, pending, remaining = dict(lock), list(couplings), list(couplings)
    while pending:
        coupling = pending.pop(0)
        rest = coupling.without_joints({x: locked[x] for x in coupling.joints if x in locked})
        free, residual, locked_names = (
            rest.factors,
            rest.offset,
            set(coupling.joints) - set(rest.joints),
        )
        if len(rest.joints) > 1 or not locked_names:
            continue
        if rest.powers:
            raise InputError(
                f"coupling '{coupling.name}' has powers of {rest.joints[0]}, lock that joint, "
                "which determines the others"
            )
        remaining.remove(coupling)
        if not free and abs(residual) > 1e-9:
            raise InputError(
                f"coupling '{coupling.name}' does not allow "
                f"{', '.join(f'{x} = {locked[x]:g}' for x in sorted(locked_names))}, lock one of "
                "them alone"
            )
        locked |= {name: residual / factor for name, factor in free.items()}
        pending = list(remaining)  # further couplings may determine more joints
    return locked, tuple(
        coupling.without_joints({x: locked[x] for x in coupling.joints if x in locked})
        for coupling in remaining
    )


def _check_lock_coordinate(joint: Joint, value: float) -> None:
    lower, upper = joint.limits.lower, joint.limits.upper
    tolerance = _LIMIT_TOLERANCE * max(1.0, abs(value))
    if not lower - tolerance <= value <= upper + tolerance:
        unit = "m" if joint.kind == "prismatic" else "rad"
        raise InputError(
            f"joint '{joint.name}' cannot be locked at {value:g} {unit}, beyond its limits "
            f"{joint.limits}, give a coordinate within them"
        )


def _fix_joint(joint: Joint, value: float) -> Joint:
    from scipy.spatial.transform import Rotation

    fixed_joint = dataclasses.replace(joint, kind="fixed", limits=Limits())
    rotation, axis = Rotation.from_euler("xyz", joint.rpy), np.array(joint.axis)
    if joint.kind == "prismatic":
        x, y, z = (np.array(joint.xyz) + rotation.apply(value * axis)).tolist()
        return dataclasses.replace(fixed_joint, xyz=(x, y, z))
    if not value:
        return fixed_joint
    roll, pitch, yaw = (rotation * Rotation.from_rotvec(value * axis)).as_euler("xyz").tolist()
    return dataclasses.replace(fixed_joint, rpy=(roll, pitch, yaw))
