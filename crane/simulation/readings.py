"""What ideal sensors say of a simulation, beside what was measured."""

from collections.abc import Mapping

import numpy as np

from crane.common.errors import RecordingError, known
from crane.common.samples import Array
from crane.description.sensors import (
    FORCE,
    FORCE_UNITS,
    INCLINATION,
    SIGNAL,
    SUPPLY,
    TANK,
    VELOCITY,
    VELOCITY_UNITS,
    unit_of,
)
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.sensed import sensed
from crane.recordings.timeseries import TIME, Table, check_unit, spellings

_INPUTS = (SIGNAL, SUPPLY, TANK)


def sensors_of(machine: Machine, table: Table) -> list[str]:
    """Columns of a measured table that a simulation of its inputs says something of.

    Joints, their velocities and forces, pressures, channels of the circuit, the tip, and
    inclinations of links, `inclination_LINK` and `inclination_LINK_velocity`.

    Raises:
        RecordingError: A column is in a unit of something else, or of no link.
    """
    return _checked(machine, table, units_of(machine))


def recorded_of(machine: Machine, table: Table, recording: Recording) -> list[str]:
    """Columns of a measured table that a recording of a simulation says something of.

    Raises:
        RecordingError: As for `sensors_of`.
    """
    units = recording.units | recording.channel_units
    units |= {x + VELOCITY: VELOCITY_UNITS[unit] for x, unit in recording.units.items()}
    driven = (x for x in recording.joints if x not in recording.free)
    units |= {x + FORCE: FORCE_UNITS[recording.units[x]] for x in driven}
    return _checked(machine, table, units)


def _checked(machine: Machine, table: Table, units: Mapping[str, str]) -> list[str]:
    """Columns, but for the inputs, that have one of these units by name, or are inclinations."""
    found = []
    for name, unit in table.units.items():
        if name == TIME:
            continue
        wanted = units.get(name)
        if name.startswith(INCLINATION):
            wanted = unit_of(machine.tree, name)
            if wanted is None:
                link = name.removeprefix(INCLINATION).removesuffix(VELOCITY)
                links = machine.tree.links
                raise RecordingError(f"column '{name}' is of no link, {known(links, link)}")
        if wanted is not None:
            check_unit(name, unit, spellings(wanted))
            if not name.startswith(_INPUTS):
                found.append(name)
    return found


def units_of(machine: Machine) -> dict[str, str]:
    """By column, of what a simulation on valves records."""
    kinds = {joint: machine.unit(joint) for joint in machine.joints}
    units = dict(kinds)
    units |= {joint + VELOCITY: VELOCITY_UNITS[kinds[joint]] for joint in machine.active}
    units |= {joint + FORCE: FORCE_UNITS[kinds[joint]] for joint in machine.driven_joints}
    units |= {f"tip_{axis}": "m" for axis in "xyz" if machine.tip is not None}
    for joint in machine.hydraulics.joints if machine.hydraulics else ():
        units |= {f"pressure_{joint}_{side}": "Pa" for side in "ab"}
        units |= {f"spool_{joint}": ""}
    return units


def read_off(machine: Machine, recording: Recording, names: list[str]) -> Array:
    """What ideal sensors say (N, k) at the recorded instants, SI units.

    Args:
        machine: The machine that was simulated.
        recording: Its simulation.
        names: See `sensors_of`.
    """
    columns = recording.columns()
    own = [name for name in names if name.startswith(INCLINATION)]
    found = columns | (_inclined(machine, recording, own) if own else {})
    values = [found[name] for name in names]
    return np.column_stack(values) if values else np.empty((len(recording.time), 0))


def _inclined(machine: Machine, recording: Recording, names: list[str]) -> dict[str, Array]:
    columns = recording.columns()
    q = np.column_stack([columns[joint] for joint in machine.joints])
    order = [recording.joints.index(joint) for joint in machine.active]
    v = np.einsum("nij,nj->ni", machine.closure.gamma(q), recording.v[:, order])
    return sensed(machine, q, v, names)
