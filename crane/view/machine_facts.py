"""Facts about a machine with tables, for the terminal and for notebooks."""

from collections.abc import Iterator, Mapping
from math import inf, isfinite, isinf
from typing import NamedTuple

from crane.common.units import format_quantity
from crane.description.sensors import Sensor
from crane.description.specification import STANDARD_GRAVITY
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.frame_jacobians import FrameDistances
from crane.machine.machine import Machine
from crane.recordings.recording import FORCE_UNITS


class MachineFact(NamedTuple):
    """One fact with an optional table.

    Attributes:
        name: Subject of the fact.
        text: RoutineStatement.
        heading: Headings of the columns; "" for columns that need none.
        rows: Cells of the table.
    """

    name: str
    text: str
    heading: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()


def machine_facts(machine: Machine) -> Iterator[MachineFact]:
    """Yield facts about files, joints, loops, drives, circuit, sensors and tasks of a machine."""
    if machine.source:
        yield MachineFact("source", machine.source)
    yield MachineFact("file", str(machine.path))
    if machine.gravity != STANDARD_GRAVITY:
        yield MachineFact("gravity", f"{' '.join(f'{x:g}' for x in machine.gravity)} m/s2")
    yield _chain_fact(machine)
    yield _joint_fact(machine)
    yield from _loop_facts(machine)
    yield from _drive_facts(machine)
    yield MachineFact("tip", machine.tip or "none")
    yield from _circuit_fact(machine)
    yield from _sensor_facts(machine)
    for task in machine.tasks.values():
        prefix = "at most " * bool(task.phases)
        yield MachineFact("task", f"{task.name}, {prefix}{task.duration:g} s: {task.description}")


def _chain_fact(machine: Machine) -> MachineFact:
    folder, chains = machine.path.parent, machine.chains
    return MachineFact(
        "chains",
        ", ".join(x.name for x in chains),
        ("", "", "on"),
        tuple(
            (
                x.name,
                str(x.urdf.relative_to(folder) if x.urdf.is_relative_to(folder) else x.urdf),
                x.parent or "",
            )
            for x in chains
        ),
    )


def _joint_fact(machine: Machine) -> MachineFact:
    """Return all joints, active ones first."""
    free_text = f" and {len(machine.free)} free" if machine.free else ""
    mass = sum(inertia.mass for inertia in list(machine.model.inertias)[1:])
    return MachineFact(
        "joints",
        f"{len(machine.joints)}, of which {len(machine.driven_joints)} active{free_text}; "
        f"moving mass {format_quantity(mass, 'kg', 4)}",
        ("", "", "home", "effort", ""),
        tuple(
            _joint_row(machine, int(i))
            for i in [*machine.closure.active, *machine.closure.passive]
        ),
    )


def _joint_row(machine: Machine, joint_index: int) -> tuple[str, ...]:
    """Return limits, home coordinate, largest effort and role of a joint."""
    joint = machine.joints[joint_index]
    unit, effort = machine.unit(joint), machine.model.effortLimit[joint_index]
    driven = joint in machine.active
    max_effort = (
        format_quantity(effort, FORCE_UNITS[unit], 4)
        if driven and isfinite(effort) and effort
        else ""
    )
    lower, upper = machine.coordinates.lower[joint_index], machine.coordinates.upper[joint_index]
    return (
        joint,
        _format_limits(lower, upper, unit),
        f"{machine.home[joint_index]:.5g} {unit}",
        max_effort,
        ("passive" if not driven else "free" if joint in machine.free else "driven"),
    )


def _loop_facts(machine: Machine) -> Iterator[MachineFact]:
    closure = machine.closure
    loops, structure = closure.equations.loops, closure.structure
    yield MachineFact(
        "loops",
        f"{len(loops)}: {len(structure.independent_rows)} independent equations, "
        f"{len(structure.redundant_rows)} redundant",
        ("", "", ""),
        tuple((x.name, x.type, f"{x.predecessor} to {x.successor}") for x in loops),
    )
    for coupling in closure.equations.couplings:
        powers = {
            f"{joint}^{power}": x
            for joint, numbers in coupling.powers.items()
            for power, x in enumerate(numbers, start=2)
            if x
        }
        terms = _format_sum({**coupling.factors, **powers})
        yield MachineFact("coupling", f"{coupling.name}, {terms} = {coupling.offset:g}")
    if structure.blocks:
        order = [
            "+".join(machine.joints[closure.passive[i]] for i in columns)
            for _, columns in structure.blocks
        ]
        yield MachineFact("loop order", f"solved for {', then '.join(order)}")


def _drive_facts(machine: Machine) -> Iterator[MachineFact]:
    closure = machine.closure
    elements = [item for item in machine.force_elements if item.between is not None]
    lengths, _ = FrameDistances(
        machine, [item.between for item in elements if item.between]
    ).evaluate(machine.home)
    for element, length in zip(elements, lengths, strict=True):
        first_frame, second_frame = element.between or ("", "")
        yield MachineFact(
            "between",
            f"{first_frame} and {second_frame}: {element.kind}, ends {length:.5g} m apart at home",
        )
    for motor in machine.explicit_drives:
        yield MachineFact("drive", f"{motor.name}, along {_format_sum(motor.factors)}")
    if closure.equations.loops:
        condition_number = float(closure.condition_number(machine.home))
        better_selections = [
            c
            for c in closure.proposed_active_joints
            if condition_number > 10 and c.condition_number < condition_number / 2
        ]
        hint = f"; better with {better_selections[0]}" if better_selections else ""
        yield MachineFact(
            "coordinates",
            f"condition number of the active ones {condition_number:.3g} at home{hint}",
        )
    if any(inertia.mass for inertia in list(machine.model.inertias)[1:]):
        backend = Dynamics(machine).backend_of("forward")
        is_compiled = backend == "compiled"
        yield MachineFact(
            "dynamics",
            "compiled to machine code" if is_compiled else f"{backend}, too large to compile",
        )


def _circuit_fact(machine: Machine) -> Iterator[MachineFact]:
    if machine.hydraulics is None:
        return
    supply, rows = machine.hydraulics.supply, []
    flow = f", at most {6e4 * supply.flow:.4g} l/min" if supply.flow else ""
    for joint, cylinder in machine.hydraulics.cylinders.items():
        valve = machine.hydraulics.valves[joint]
        kind = "sharing" if valve.sharing else "compensated" if valve.margin else "orifice"
        spool_text = " of two spools" if valve.spool_b else ""
        is_cylinder = machine.unit(joint) == "m"
        unit, size = ("cm2", 1e4) if is_cylinder else ("cm3/rad", 1e6)
        areas = f"A {size * cylinder.area_a:.4g}, B {size * cylinder.area_b:.4g} {unit}"
        owner = "cylinder areas" if is_cylinder else "displacements"
        rows.append((joint, f"{kind} valve{spool_text}", f"{owner} {areas}"))
    yield MachineFact(
        "hydraulics", f"pump {1e-5 * supply.pressure:.4g} bar{flow}", ("", "", ""), tuple(rows)
    )


def _sensor_facts(machine: Machine) -> Iterator[MachineFact]:
    ideal_values = Sensor().parameters()
    for name, sensor in machine.sensors.items():
        differing_values = [
            f"{quantity_name} {x:g}"
            for quantity_name, x in sensor.parameters().items()
            if x != ideal_values[quantity_name]
        ]
        column_text = [f"{sensor.column} [{sensor.unit}]" if sensor.unit else sensor.column]
        text = ", ".join([x for x in column_text if x] + differing_values) or "ideal"
        yield MachineFact("sensor", f"{name}: {text}")


def _format_sum(factors: Mapping[str, float]) -> str:
    return " + ".join(f"{factor:g} {joint}" for joint, factor in factors.items())


def _format_limits(lower: float, upper: float, unit: str) -> str:
    if (lower, upper) == (-inf, inf):
        return "unlimited"
    if isinf(lower):
        return f"at most {upper:.5g} {unit}"
    return f"at least {lower:.5g} {unit}" if isinf(upper) else f"{lower:.5g} to {upper:.5g} {unit}"
