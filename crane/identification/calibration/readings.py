"""What a machine's sensors say while it is simulated."""

import numpy as np
import pinocchio as pin

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
    units = _units(machine)
    found = []
    for name, unit in table.units.items():
        if name == TIME or name.startswith(_INPUTS):
            continue
        if name.startswith(INCLINATION):
            link = name.removeprefix(INCLINATION).removesuffix(VELOCITY)
            links = [f.name for f in machine.model.frames if f.type == pin.FrameType.BODY]
            if link not in links:
                raise RecordingError(f"column '{name}' is of no link, {known(links, link)}")
            check_unit(name, unit, spellings("rad/s" if name.endswith(VELOCITY) else "rad"))
        elif name in units:
            check_unit(name, unit, spellings(units[name]))
        else:
            continue
        found.append(name)
    return found


def _units(machine: Machine) -> dict[str, str]:
    """Of what a simulation on valves records."""
    kinds = {joint: machine.unit(joint) for joint in machine.joints}
    units = dict(kinds)
    units |= {joint + VELOCITY: VELOCITY_UNITS[kinds[joint]] for joint in machine.active}
    units |= {joint + FORCE: FORCE_UNITS[kinds[joint]] for joint in machine.active}
    units |= {f"tip_{axis}": "m" for axis in "xyz" if machine.tip is not None}
    for joint in machine.hydraulics.joints if machine.hydraulics else ():
        units |= {f"pressure_{joint}_{side}": "Pa" for side in "ab"}
        units |= {f"spool_{joint}": ""}
    return units


def read(machine: Machine, recording: Recording, names: list[str]) -> Array:
    """What ideal sensors say (N, k) at the recorded instants, SI units.

    Args:
        machine: The machine that was simulated.
        recording: Its simulation.
        names: See `sensors_of`.
    """
    columns = recording.columns()
    own = [name for name in names if name.startswith(INCLINATION)]
    found = columns | (_inclined(machine, recording, own) if own else {})
    return np.column_stack([found[name] for name in names])


def _inclined(machine: Machine, recording: Recording, names: list[str]) -> dict[str, Array]:
    columns = recording.columns()
    q = np.column_stack([columns[joint] for joint in machine.joints])
    order = [recording.joints.index(joint) for joint in machine.active]
    v = np.einsum("nij,nj->ni", machine.closure.gamma(q), recording.v[:, order])
    return sensed(machine, q, v, names)
