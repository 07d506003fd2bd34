"""What ideal sensors say of a simulation, beside what was measured."""

from collections.abc import Mapping

import numpy as np

from crane.common.errors import RecordingError, suggest_names
from crane.common.samples import Array
from crane.description.sensors import (
    FORCE_SUFFIX,
    FORCE_UNITS,
    INCLINATION_PREFIX,
    SUPPLY_PRESSURE,
    TANK_PRESSURE,
    VALVE_SIGNAL_PREFIX,
    VELOCITY_SUFFIX,
    VELOCITY_UNITS,
    quantity_unit,
)
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.sensor_kinematics import ideal_readings
from crane.recordings.timeseries import TIME, Table, accepted_units, check_unit

_INPUT_PREFIXES = (VALVE_SIGNAL_PREFIX, SUPPLY_PRESSURE, TANK_PRESSURE)


def simulated_columns(machine: Machine, table: Table) -> list[str]:
    """Columns of a measured table that a simulation of its inputs says something of.

    Joints, their velocities and forces, pressures, channels of the circuit, the tip, and
    inclinations of links, `inclination_LINK` and `inclination_LINK_velocity`.

    Raises:
        RecordingError: A column is in a unit of something else, or of no link.
    """
    return _select_columns(machine, table, simulated_units(machine))


def recorded_columns(machine: Machine, table: Table, recording: Recording) -> list[str]:
    """Columns of a measured table that a recording of a simulation says something of.

    Raises:
        RecordingError: As for `simulated_columns`.
    """
    units = recording.units | recording.channel_units
    units |= {x + VELOCITY_SUFFIX: VELOCITY_UNITS[unit] for x, unit in recording.units.items()}
    driven = (x for x in recording.joints if x not in recording.free)
    units |= {x + FORCE_SUFFIX: FORCE_UNITS[recording.units[x]] for x in driven}
    return _select_columns(machine, table, units)


def _select_columns(machine: Machine, table: Table, units: Mapping[str, str]) -> list[str]:
    """Columns, but for the inputs, that have one of these units by name, or are inclinations."""
    columns = []
    for name, unit in table.units.items():
        if name == TIME:
            continue
        wanted = units.get(name)
        if name.startswith(INCLINATION_PREFIX):
            wanted = quantity_unit(machine.tree, name)
            if wanted is None:
                link = name.removeprefix(INCLINATION_PREFIX).removesuffix(VELOCITY_SUFFIX)
                links = machine.tree.links
                raise RecordingError(
                    f"column '{name}' is of no link, {suggest_names(links, link)}"
                )
        if wanted is not None:
            check_unit(name, unit, accepted_units(wanted))
            if not name.startswith(_INPUT_PREFIXES):
                columns.append(name)
    return columns


def simulated_units(machine: Machine) -> dict[str, str]:
    """By column, of what a simulation on valves records."""
    joint_units = {joint: machine.unit(joint) for joint in machine.joints}
    units = dict(joint_units)
    units |= {
        joint + VELOCITY_SUFFIX: VELOCITY_UNITS[joint_units[joint]] for joint in machine.active
    }
    units |= {
        joint + FORCE_SUFFIX: FORCE_UNITS[joint_units[joint]] for joint in machine.driven_joints
    }
    units |= {f"tip_{axis}": "m" for axis in "xyz" if machine.tip is not None}
    for joint in machine.hydraulics.joints if machine.hydraulics else ():
        units |= {f"pressure_{joint}_{side}": "Pa" for side in "ab"}
        units |= {f"spool_{joint}": ""}
    return units


def read_simulation(machine: Machine, recording: Recording, names: list[str]) -> Array:
    """What ideal sensors say (N, k) at the recorded instants, SI units.

    Args:
        machine: The machine that was simulated.
        recording: Its simulation.
        names: See `simulated_columns`.
    """
    columns = recording.columns()
    inclination_names = [name for name in names if name.startswith(INCLINATION_PREFIX)]
    readings = columns | (
        _inclination_readings(machine, recording, inclination_names) if inclination_names else {}
    )
    values = [readings[name] for name in names]
    return np.column_stack(values) if values else np.empty((len(recording.time), 0))


def _inclination_readings(
    machine: Machine, recording: Recording, names: list[str]
) -> dict[str, Array]:
    columns = recording.columns()
    q = np.column_stack([columns[joint] for joint in machine.joints])
    order = [recording.joints.index(joint) for joint in machine.active]
    v = np.einsum("nij,nj->ni", machine.closure.gamma(q), recording.v[:, order])
    return ideal_readings(machine, q, v, names)
