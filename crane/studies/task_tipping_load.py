"""The payload at which a machine tips during a task."""

import warnings
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from crane.common.errors import CraneWarning, InputError, check_name
from crane.control.control_law import ComputedTorque
from crane.control.levers import joystick
from crane.dynamics.tipping_stability import TippingStability
from crane.formats.machine_loading import MachineVariants
from crane.machine.machine import Machine
from crane.motion.task_trajectories import task_trajectory
from crane.recordings.recording import Recording
from crane.simulation.simulation_run import simulate

PAYLOAD_MASS = "payload.mass"
_STEP = 5e-3  # between instants at which tipping is checked [s]
_RELATIVE_TOLERANCE = 1e-4  # of the payload
_MAX_DOUBLINGS = 20


class TippingLoad(NamedTuple):
    """Payload at which a moving machine tips.

    Attributes:
        mass: Mass of the payload [kg]; infinite if the machine does not tip.
        time: Instant at which the machine is on a tipping line [s].
        static_mass: Mass at which the machine would tip at rest in the worst configuration [kg].
    """

    mass: float
    time: float
    static_mass: float


def tipping_load(machine: Machine, task: str) -> TippingLoad:
    """Find the payload with which a task brings a machine just onto a tipping line.

    Trajectories are followed exactly by computed torque, so that only the inertial forces of the
    task count, not those of a controller that oscillates. Tasks of levers are simulated with the
    payload. Loads of the task act in addition.

    Args:
        machine: A machine that is fixed to the world, with `supports` and a payload.
        task: Name of one of its tasks.

    Raises:
        InputError: The machine has no such task, no payload or no supports, or it tips without
            payload.
    """
    check_name(task, machine.tasks, f"machine '{machine.name}' has no task '{task}'")
    TippingStability(machine)  # raises without supports
    variants = MachineVariants(machine)
    if PAYLOAD_MASS not in variants.values:
        raise InputError(f"'{machine.name}' has no payload, describe one in its machine file")

    @cache
    def simulate_with(mass: float) -> Recording:
        # tipping is expected
        with warnings.catch_warnings(action="ignore", category=CraneWarning):
            return _simulate_task(variants.machine({PAYLOAD_MASS: mass}), task)

    def smallest_margin(mass: float, channel: str) -> float:
        return float(simulate_with(mass).channels[channel].min())

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
    run = simulate_with(mass)
    return TippingLoad(mass, float(run.time[run.channels["stability"].argmin()]), static)


def _simulate_task(machine: Machine, task: str) -> Recording:
    task_spec = machine.tasks[task]
    loaded_machine = machine.with_external_forces(*task_spec.loads)
    if task_spec.space == "joystick":
        return simulate(loaded_machine, joystick(machine, task), step=_STEP)
    return simulate(
        loaded_machine, ComputedTorque(machine, task_trajectory(machine, task)), step=_STEP
    )
