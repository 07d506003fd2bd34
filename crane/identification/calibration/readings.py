"""What a machine's sensors say while it is simulated."""

import numpy as np
import pinocchio as pin

from crane.common.errors import RecordingError, known
from crane.common.samples import Array
from crane.machine import Machine
from crane.recordings.recording import FORCE, FORCE_UNITS, VELOCITY, VELOCITY_UNITS, Recording
from crane.recordings.timeseries import TIME, Table, check_unit, spellings

INCLINATION = "inclination_"
_INPUTS = ("voltage_", "pressure_supply", "pressure_tank")


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
    """Readings (N, k) at the recorded instants, SI units.

    The inclination of a link is that of its x axis above the horizon,
    asin(x_z); its velocity (w x x)_z / sqrt(1 - x_z^2).

    Args:
        machine: The machine that was simulated.
        recording: Its simulation.
        names: See `sensors_of`.
    """
    columns = recording.columns()
    links = [
        name.removeprefix(INCLINATION).removesuffix(VELOCITY)
        for name in names
        if name.startswith(INCLINATION)
    ]
    inclined = _inclinations(machine, recording, sorted(set(links))) if links else {}
    out: Array = np.column_stack(
        [inclined[name] if name in inclined else columns[name] for name in names]
    )
    return out


def _inclinations(machine: Machine, recording: Recording, links: list[str]) -> dict[str, Array]:
    """Of links, and their rates, by the name of their column."""
    closure, model, data = machine.closure, machine.model, machine.model.createData()
    columns = recording.columns()
    q = np.column_stack([columns[joint] for joint in machine.joints])
    order = [recording.joints.index(joint) for joint in machine.active]
    v = np.einsum("nij,nj->ni", closure.gamma(q), recording.v[:, order])
    frames = [machine.frame(link) for link in links]
    out = np.empty((2 * len(links), len(q)))
    axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for i, (place, rate) in enumerate(zip(q, v, strict=True)):
        pin.forwardKinematics(model, data, machine.coordinates.configuration(place), rate)
        for k, frame in enumerate(frames):
            x = pin.updateFramePlacement(model, data, frame).rotation[:, 0]
            w = pin.getFrameVelocity(model, data, frame, axes).angular
            flat = max(float(np.hypot(x[0], x[1])), 1e-12)
            out[2 * k, i] = np.arctan2(x[2], flat)
            out[2 * k + 1, i] = (w[0] * x[1] - w[1] * x[0]) / flat
    names = [INCLINATION + link + end for link in links for end in ("", VELOCITY)]
    return dict(zip(names, out, strict=True))
