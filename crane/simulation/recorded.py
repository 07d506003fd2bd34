"""What a simulation leaves: a recording with channels, and what is to be said of its energy."""

import warnings
from collections.abc import Iterator

import numpy as np

from crane.codegen import Parts
from crane.common.errors import CraneWarning
from crane.common.samples import FARTHEST, Array
from crane.control import Controller, Free, Signals, ValveDrive, reference_of
from crane.hydraulics.circuit import BALANCES
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.trajectories import Trajectory, limit_slack
from crane.recordings.recording import Recording

Column = tuple[str, Array, str]  # name, values, unit

_SHOWN = 3  # joints beyond their limits that are named
_IMBALANCE = 5e-3  # share of the energy that went through


def recorded(
    machine: Machine, control: Controller, time: Array, rows: Parts, task: str
) -> Recording:
    """What the integration left as a recording.

    Args:
        machine: The machine.
        control: What drove it.
        time: (N,) [s].
        rows: See `integrate`.
        task: Name to put into it.
    """
    q_a = rows.q[:, machine.closure.active]
    if text := limits_passed(machine, time, rows.q):
        warnings.warn(text, CraneWarning, stacklevel=3)
    channels: dict[str, Array] = {}
    units: dict[str, str] = {}
    for name, values, unit in _channels(machine, control, time, rows):
        channels[name], units[name] = values, unit
    return Recording(
        time=time,
        joints=machine.active,
        q=q_a,
        v=rows.v_a,
        tau=rows.tau,
        units={joint: machine.unit(joint) for joint in machine.active},
        channels=channels,
        channel_units=units,
        machine=machine.call,
        task=task,
        controller=_name_of(control),
        copy=False,
    )


def _channels(machine: Machine, control: Controller, time: Array, rows: Parts) -> Iterator[Column]:
    """What is recorded beside the active joints."""
    for column in machine.closure.passive:
        joint = machine.joints[column]
        yield joint, rows.q[:, column], machine.unit(joint)
    if machine.tip is not None:
        yield from _point("tip", Kinematics(machine).positions(rows.q))
    reference = reference_of(control)
    if reference is not None:
        yield from _references(machine, reference, time)
    for i, joint in enumerate(machine.active):
        yield (
            f"friction_{joint}",
            rows.friction[:, i],
            "N" if machine.unit(joint) == "m" else "N m",
        )
    names = {"kinetic": "kinetic", "potential": "potential", "work": "work", "dissipated": "lost"}
    for name, part in names.items():
        yield name, getattr(rows, part)[:, 0], "J"
    if isinstance(control, ValveDrive):
        integrals = rows.own[:, -len(BALANCES) :]
        units = [*control.channels, *BALANCES.items()]
        for (name, unit), values in zip(units, [*rows.channels.T, *integrals.T], strict=True):
            yield name, values, unit


def _references(machine: Machine, reference: Trajectory, time: Array) -> Iterator[Column]:
    """What a reference asks of the joints, and of the tip where it was given there."""
    q, v = reference.position(time), reference.velocity(time)
    for i in np.flatnonzero(machine.driven):
        joint = machine.active[i]
        unit = machine.unit(joint)
        yield f"reference_{joint}", q[:, i], unit
        yield f"reference_velocity_{joint}", v[:, i], unit + "/s"
    if reference.tip is not None:
        yield from _point("reference_tip", reference.tip.position(time))


def _point(name: str, positions: Array) -> Iterator[Column]:
    """Positions (N, 3) [m] by axis."""
    for axis, values in zip("xyz", positions.T, strict=True):
        yield f"{name}_{axis}", values, "m"


def _name_of(control: Controller) -> str:
    """What drives the machine: what its command calls itself, or the name of its class."""
    if isinstance(control, ValveDrive):
        command = control.command
        return command.title if isinstance(command, Signals) else type(command).__name__
    return "" if isinstance(control, Free) else type(control).__name__


def limits_passed(machine: Machine, time: Array, q: Array) -> str:
    """What to say of joints that went beyond limits where nothing stops them, else nothing.

    Args:
        machine: The machine.
        time: (N,) [s].
        q: (N, nv) the motion.
    """
    lower, upper = machine.coordinates.lower, machine.coordinates.upper
    beyond = np.maximum(lower - q, q - upper)
    farthest = beyond.max(axis=0)
    stopped = {stop.joint for stop in machine.end_stops}
    slack = limit_slack(machine)
    passed = [i for i in np.flatnonzero(farthest > slack) if machine.joints[i] not in stopped]
    if not passed:
        return ""
    units = machine.closure.units
    passed.sort(key=lambda i: -farthest[i] / min(upper[i] - lower[i], FARTHEST * units[i]))
    words = []
    for i in passed[:_SHOWN]:
        joint, first = machine.joints[i], int(np.argmax(beyond[:, i] > slack[i]))
        limit = lower[i] if q[first, i] < lower[i] else upper[i]
        unit = machine.unit(joint)
        words.append(
            f"'{joint}' passes its limit {limit:.4g} {unit} at t = {time[first]:.4g} s, by up to "
            f"{farthest[i]:.3g} {unit}"
        )
    more = f" and {len(passed) - _SHOWN} more joints" if len(passed) > _SHOWN else ""
    one = len(passed) == 1
    return (
        f"{', '.join(words)}{more}: nothing stops {'it' if one else 'them'} there, give "
        f"{'it an end stop' if one else 'them end stops'}"
    )


def imbalance(rows: Parts, step: float) -> str:
    """What to say if a simulation does not keep its energy, else nothing.

    Args:
        rows: See `integrate`; work, lost, kinetic, potential [J] of it.
        step: [s].
    """
    change = rows.kinetic + rows.potential - rows.kinetic[0] - rows.potential[0]
    gap = float(np.abs(rows.work - change - rows.lost).max())
    parts = rows.work, rows.lost, rows.kinetic, rows.potential
    throughput = float(max(np.ptp(part) for part in parts))
    rounding = 1e-12 * float(max(np.abs(rows.kinetic).max(), np.abs(rows.potential).max()))
    if gap <= _IMBALANCE * throughput + rounding:
        return ""
    return (
        f"work, energy and dissipation differ by {gap:.2g} J of {throughput:.2g} J, so the "
        f"step of {step:g} s is too long: shorten it, or smooth the friction more"
    )
