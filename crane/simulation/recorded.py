"""What a simulation leaves: a recording with channels, and what is to be said of its energy."""

import warnings

import numpy as np

from crane.codegen import Parts
from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.control import Controller, Free, Signals, ValveDrive, path_of
from crane.hydraulics.circuit import BALANCES
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.recordings.recording import Recording

_IMBALANCE = 5e-3  # share of the energy that went through


def recorded(
    machine: Machine, control: Controller, time: Array, rows: Parts, task: str
) -> Recording:
    """What the integration left as a recording.

    Args:
        machine: The machine.
        control: What drove it.
        time: (N,) [s].
        rows: See `trajectory`.
        task: Name to put into it.
    """
    path = path_of(control)
    q_a = rows.q[:, machine.closure.active]
    _warn_of_limits(machine, time, q_a)
    channels: dict[str, Array] = {}
    units: dict[str, str] = {}

    def add(name: str, values: Array, unit: str) -> None:
        channels[name], units[name] = values, unit

    for column in machine.closure.passive:
        joint = machine.joints[column]
        add(joint, rows.q[:, column], machine.unit(joint))
    if machine.tip is not None:
        for axis, values in zip("xyz", Kinematics(machine).positions(rows.q).T, strict=True):
            add(f"tip_{axis}", values, "m")
    if path is not None:
        reference, reference_rate = path.position(time), path.velocity(time)
        for i, joint in enumerate(machine.active):
            add(f"reference_{joint}", reference[:, i], machine.unit(joint))
            rate_unit = machine.unit(joint) + "/s"
            add(f"reference_velocity_{joint}", reference_rate[:, i], rate_unit)
        if path.tip is not None:
            for axis, values in zip("xyz", path.tip.position(time).T, strict=True):
                add(f"reference_tip_{axis}", values, "m")
    for i, joint in enumerate(machine.active):
        add(f"friction_{joint}", rows.friction[:, i], "N" if machine.unit(joint) == "m" else "N m")
    names = {"kinetic": "kinetic", "potential": "potential", "work": "work", "dissipated": "lost"}
    for name, part in names.items():
        add(name, getattr(rows, part)[:, 0], "J")
    if isinstance(control, ValveDrive):
        for (name, unit), values in zip(control.channels, rows.channels.T, strict=True):
            add(name, values, unit)
        integrals = rows.own[:, -len(BALANCES) :]
        for (name, unit), values in zip(BALANCES.items(), integrals.T, strict=True):
            add(name, values, unit)
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


def _name_of(control: Controller) -> str:
    """What drives the machine: what its command calls itself, or the name of its class."""
    if isinstance(control, ValveDrive):
        command = control.command
        return command.title if isinstance(command, Signals) else type(command).__name__
    return "" if isinstance(control, Free) else type(control).__name__


def _warn_of_limits(machine: Machine, time: Array, q_a: Array) -> None:
    stopped = {stop.joint for stop in machine.end_stops}
    for i, joint in enumerate(machine.active):
        outside = (q_a[:, i] < machine.lower[i]) | (q_a[:, i] > machine.upper[i])
        if outside.any() and joint not in stopped:
            warnings.warn(
                f"'{joint}' leaves its limits {machine.lower[i]:g} to {machine.upper[i]:g} at "
                f"t = {time[outside.argmax()]:.4g} s, it has no end stop",
                CraneWarning,
                stacklevel=4,
            )


def imbalance(rows: Parts, step: float) -> str:
    """What to say if a simulation does not keep its energy, else nothing.

    Args:
        rows: See `trajectory`; work, lost, kinetic, potential [J] of it.
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
