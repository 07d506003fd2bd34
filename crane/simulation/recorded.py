"""What a simulation leaves: a recording with channels, and what is to be said of its energy."""

import warnings

import numpy as np

from crane.control import Controller, Free, Signals, StiffController, ValveDrive
from crane.errors import CraneWarning
from crane.hydraulics.circuit import BALANCES
from crane.kinematics import Kinematics
from crane.machine import Machine
from crane.recording import Recording
from crane.samples import Array

ENERGIES = 2  # of the state: work, dissipated; of the observations: kinetic, potential
_IMBALANCE = 5e-3  # share of the energy that went through


def recorded(
    machine: Machine,
    control: Controller,
    step: float,
    states: Array,
    seen: Array,
    task: str,
) -> Recording:
    """What the integration left as a recording.

    Args:
        machine: The machine.
        control: What drove it.
        step: [s].
        states: (N, .) see `trajectory`.
        seen: (N, .) observations, see there.
        task: Name to put into it.
    """
    n, path = len(machine.active), control.path
    forces, friction = seen[:, :n], seen[:, n : 2 * n]
    energies, more = seen[:, 2 * n : 2 * n + ENERGIES], seen[:, 2 * n + ENERGIES :]
    time = step * np.arange(len(states), dtype=np.float64)
    nq = machine.model.nq
    postures, v_a = states[:, :nq], states[:, nq : nq + len(machine.active)]
    q_a = postures[:, machine.closure.active]
    _warn_of_limits(machine, time, q_a)
    channels: dict[str, Array] = {}
    units: dict[str, str] = {}

    def add(name: str, values: Array, unit: str) -> None:
        channels[name], units[name] = values, unit

    for column in machine.closure.passive:
        joint = machine.joints[column]
        add(joint, postures[:, column], machine.unit(joint))
    if machine.tip is not None:
        kinematics = Kinematics(machine)
        tip = np.empty((len(postures), 3))  # a list of an hour's would take half a gigabyte
        for i, q in enumerate(postures):
            tip[i] = kinematics.position_at(q)
        for axis, values in zip("xyz", tip.T, strict=True):
            add(f"tip_{axis}", values, "m")
    if path is not None:
        reference, reference_rate, _ = path(time)
        for i, joint in enumerate(machine.active):
            add(f"reference_{joint}", reference[:, i], machine.unit(joint))
            rate_unit = machine.unit(joint) + "/s"
            add(f"reference_velocity_{joint}", reference_rate[:, i], rate_unit)
        if path.tip is not None:
            for axis, values in zip("xyz", path.tip(time)[0].T, strict=True):
                add(f"reference_tip_{axis}", values, "m")
    for i, joint in enumerate(machine.active):
        add(f"friction_{joint}", friction[:, i], "N" if machine.unit(joint) == "m" else "N m")
    add("kinetic", energies[:, 0], "J")
    add("potential", energies[:, 1], "J")
    add("work", states[:, -2], "J")
    add("dissipated", states[:, -1], "J")
    if isinstance(control, StiffController):
        for (name, unit), values in zip(control.channels, more.T, strict=True):
            add(name, values, unit)
        integrals = states[:, -ENERGIES - len(BALANCES) : -ENERGIES]
        for (name, unit), values in zip(BALANCES.items(), integrals.T, strict=True):
            add(name, values, unit)
    return Recording(
        time=time,
        joints=machine.active,
        q=q_a,
        v=v_a,
        tau=forces,
        units={joint: machine.unit(joint) for joint in machine.active},
        channels=channels,
        channel_units=units,
        machine=machine.call,
        task=task,
        controller=_name_of(control),
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


def imbalance(work: Array, energies: Array, dissipated: Array, step: float) -> str:
    """What to say if a simulation does not keep its energy, else nothing.

    Args:
        work: (N,) of the active forces [J].
        energies: (N, 2) kinetic, potential [J].
        dissipated: (N,) [J].
        step: [s].
    """
    change = (energies - energies[0]).sum(axis=1)
    gap = float(np.abs(work - change - dissipated).max())
    throughput = float(max(np.ptp(part) for part in (work, dissipated, *energies.T)))
    rounding = 1e-12 * float(np.abs(energies).max())
    if gap <= _IMBALANCE * throughput + rounding:
        return ""
    return (
        f"work, energy and dissipation differ by {gap:.2g} J of {throughput:.2g} J, so the "
        f"step of {step:g} s is too long: shorten it, or smooth the friction more"
    )
