"""What a machine consists of, as facts and tables: for the terminal and for notebooks alike."""

from collections.abc import Iterator, Mapping
from math import inf, isfinite, isinf
from pathlib import Path
from typing import NamedTuple

from crane.common.units import quantity
from crane.description.sensors import Sensor
from crane.dynamics import Dynamics
from crane.dynamics.lengths import Lengths
from crane.machine import Machine
from crane.recordings.recording import FORCE_UNITS


class Fact(NamedTuple):
    """One fact, and the rows of its table where it has one.

    Attributes:
        name: What it is about.
        text: What is to be said.
        head: Of the columns, "" where a cell says by itself what it is.
        rows: Cells, as many as there are columns; empty ones say nothing.
    """

    name: str
    text: str
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()


def facts_of(machine: Machine) -> Iterator[Fact]:
    """Files, joints, loops, drives, circuit, sensors and tasks of a machine."""
    if machine.source:
        yield Fact("source", machine.source)
    yield Fact("file", str(machine.path))
    yield _chains(machine)
    yield _joints(machine)
    yield from _loops(machine)
    yield from _drives(machine)
    yield Fact("tip", machine.tip or "none")
    yield from _circuit(machine)
    yield from _sensors(machine)
    for task in machine.tasks.values():
        most = "at most " * bool(task.phases)
        yield Fact("task", f"{task.name}, {most}{task.duration:g} s: {task.description}")


def _chains(machine: Machine) -> Fact:
    """The sub-chains, by their files where they have some of their own."""
    folder, chains = machine.path.parent, machine.chains
    rows = tuple((x.name, _beside(x.urdf, folder), x.parent or "") for x in chains)
    return Fact("chains", ", ".join(x.name for x in chains), ("", "", "on"), rows)


def _beside(file: Path, folder: Path) -> str:
    return str(file.relative_to(folder) if file.is_relative_to(folder) else file)


def _joints(machine: Machine) -> Fact:
    """All joints: those that are driven first."""
    free = f" and {len(machine.free)} free" if machine.free else ""
    mass = sum(inertia.mass for inertia in list(machine.model.inertias)[1:])
    columns = [*machine.closure.active, *machine.closure.passive]
    return Fact(
        "joints",
        f"{len(machine.joints)}, of which {len(machine.driven_joints)} active{free}; "
        f"moving mass {quantity(mass, 'kg', 4)}",
        ("", "", "home", "effort", ""),
        tuple(_joint(machine, int(i)) for i in columns),
    )


def _joint(machine: Machine, i: int) -> tuple[str, ...]:
    """A joint: its limits, its home, the most that drives it, and whether something does."""
    joint = machine.joints[i]
    unit, effort = machine.unit(joint), machine.model.effortLimit[i]
    driven = joint in machine.active
    most = quantity(effort, FORCE_UNITS[unit], 4) if driven and isfinite(effort) and effort else ""
    role = "passive" if not driven else "free" if joint in machine.free else "driven"
    lower, upper = machine.coordinates.lower[i], machine.coordinates.upper[i]
    return joint, _limits(lower, upper, unit), f"{machine.home[i]:.5g} {unit}", most, role


def _loops(machine: Machine) -> Iterator[Fact]:
    closure = machine.closure
    loops, structure = closure.equations.loops, closure.structure
    yield Fact(
        "loops",
        f"{len(loops)}: {len(structure.rows)} independent equations, "
        f"{len(structure.redundant)} redundant",
        ("", "", ""),
        tuple((x.name, x.type, f"{x.predecessor} to {x.successor}") for x in loops),
    )
    for coupling in closure.equations.couplings:
        terms = _sum(coupling.factors)
        yield Fact("coupling", f"{coupling.name}, {terms} = {coupling.offset:g}")
    if structure.blocks:
        order = [
            "+".join(machine.joints[closure.passive[i]] for i in columns)
            for _, columns in structure.blocks
        ]
        yield Fact("solved as", ", then ".join(order))


def _drives(machine: Machine) -> Iterator[Fact]:
    closure = machine.closure
    elements = [item for item in machine.elements if item.between is not None]
    lengths, _ = Lengths(machine, [item.between for item in elements if item.between]).at(
        machine.home
    )
    for item, length in zip(elements, lengths, strict=True):
        one, two = item.between or ("", "")
        yield Fact("between", f"{one} and {two}: {item.kind}, ends {length:.5g} m apart at home")
    for motor in machine.motors:
        yield Fact("drive", f"{motor.name}, along {_sum(motor.factors)}")
    if closure.equations.loops:
        drive = float(closure.condition(machine.home))
        better = [c for c in closure.proposals if drive > 10 and c.condition < drive / 2]
        others = f"; better with {better[0]}" if better else ""
        # of free ones too, which nothing drives
        yield Fact("independent", f"coordinates: condition {drive:.3g} at home{others}")
    if any(inertia.mass for inertia in list(machine.model.inertias)[1:]):
        backend = Dynamics(machine).backend_of("forward")
        reason = "" if backend == "compiled" else ", too large for machine code"
        yield Fact("computed", f"{backend}{reason}")


def _circuit(machine: Machine) -> Iterator[Fact]:
    if machine.hydraulics is None:
        return
    supply, rows = machine.hydraulics.supply, []
    flow = f", {6e4 * supply.flow:.4g} l/min at most" if supply.flow else ""
    for joint, cylinder in machine.hydraulics.cylinders.items():
        valve = machine.hydraulics.valves[joint]
        kind = "sharing" if valve.sharing else "compensated" if valve.margin else "orifice"
        spools = " of two spools" if valve.spool_b else ""
        unit, size = ("cm2", 1e4) if machine.unit(joint) == "m" else ("cm3/rad", 1e6)
        areas = f"{size * cylinder.area_a:.4g} and {size * cylinder.area_b:.4g} {unit}"
        rows.append((joint, f"{kind} valve{spools}", areas))
    text = f"{1e-5 * supply.pressure:.4g} bar{flow}"
    yield Fact("hydraulics", text, ("", "", ""), tuple(rows))


def _sensors(machine: Machine) -> Iterator[Fact]:
    ideal = Sensor().numbers()
    for name, sensor in machine.sensors.items():
        known = [f"{what} {x:g}" for what, x in sensor.numbers().items() if x != ideal[what]]
        where = [f"{sensor.column} [{sensor.unit}]" if sensor.unit else sensor.column]
        words = ", ".join([x for x in where if x] + known) or "ideal"
        yield Fact("sensor", f"{name}: {words}")


def _sum(factors: Mapping[str, float]) -> str:
    return " + ".join(f"{factor:g} {joint}" for joint, factor in factors.items())


def _limits(lower: float, upper: float, unit: str) -> str:
    """A range in words, which may have no end."""
    if (lower, upper) == (-inf, inf):
        return "unlimited"
    if isinf(lower):
        return f"at most {upper:.5g} {unit}"
    return f"at least {lower:.5g} {unit}" if isinf(upper) else f"{lower:.5g} to {upper:.5g} {unit}"
