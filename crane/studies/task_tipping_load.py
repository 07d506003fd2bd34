"""The load under which a machine tips while it does a task."""

import warnings
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from crane.common.errors import CraneWarning, InputError, suggest_names
from crane.control import ComputedTorque, joystick
from crane.dynamics.tipping_stability import TippingStability
from crane.formats.machine_loading import MachineVariants
from crane.machine import Machine
from crane.motion.task_trajectories import task_trajectory
from crane.recordings.recording import Recording
from crane.simulation import simulate

PAYLOAD_MASS = "payload.mass"
_STEP = 5e-3  # [s] between the instants at which it may tip
_RELATIVE_TOLERANCE = 1e-4  # of the load
_MAX_DOUBLINGS = 20


class TippingLoad(NamedTuple):
    """What tips a machine that moves.

    Attributes:
        mass: Of the payload [kg], infinite where none does.
        time: When it is on a tipping line [s].
        static_mass: The payload under which it would tip standing still at the worst posture [kg].
    """

    mass: float
    time: float
    static_mass: float


def tipping_load(machine: Machine, task: str) -> TippingLoad:
    """The payload with which a task brings a machine just onto a tipping line, by bisection.

    A trajectory is followed exactly (computed torque), so what tips are inertial forces of the
    task itself, not of a controller that swings. A task of levers is what these do to the machine
    with that payload. Loads of the task act besides.

    Args:
        machine: Fixed to the world, with `supports` and a payload.
        task: One of its tasks.

    Raises:
        InputError: It has no such task, no payload, or no supports; or it tips without a load.
    """
    if task not in machine.tasks:
        raise InputError(
            f"machine '{machine.name}' has no task '{task}', {suggest_names(machine.tasks, task)}"
        )
    TippingStability(machine)  # that it has supports
    variants = MachineVariants(machine)
    if PAYLOAD_MASS not in variants.values:
        raise InputError(f"'{machine.name}' has no payload, describe one in its machine file")
    recordings: dict[float, Recording] = {}

    def smallest_margin(mass: float, channel: str = "stability") -> float:
        if mass not in recordings:
            with warnings.catch_warnings():  # that it tips is what is asked for
                warnings.simplefilter("ignore", CraneWarning)
                recordings[mass] = _simulate_task(variants.machine({PAYLOAD_MASS: mass}), task)
        return float(recordings[mass].channels[channel].min())

    masses: list[float] = []
    for channel in ("static_stability", "stability"):
        if smallest_margin(0.0, channel) <= 0:
            raise InputError(f"'{machine.name}' tips in '{task}' without any payload")
        upper_mass = 0.05 * TippingStability(machine).mass
        for _ in range(_MAX_DOUBLINGS):
            if smallest_margin(upper_mass, channel) < 0:
                break
            upper_mass *= 2.0
        else:
            return TippingLoad(np.inf, np.nan, masses[0] if masses else np.inf)
        masses.append(
            float(brentq(smallest_margin, 0.0, upper_mass, (channel,), rtol=_RELATIVE_TOLERANCE))
        )
    static, mass = masses
    smallest_margin(mass)
    run = recordings[mass]
    return TippingLoad(mass, float(run.time[run.channels["stability"].argmin()]), static)


def _simulate_task(machine: Machine, task: str) -> Recording:
    task_spec = machine.tasks[task]
    loaded_machine = machine.with_external_forces(*task_spec.loads)
    if task_spec.space == "joystick":
        return simulate(loaded_machine, joystick(machine, task), step=_STEP)
    return simulate(
        loaded_machine, ComputedTorque(machine, task_trajectory(machine, task)), step=_STEP
    )
