"""The load under which a machine tips while it does a task."""

import warnings
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from crane.common.errors import CraneWarning, InputError, known
from crane.control import ComputedTorque, joystick
from crane.dynamics.stability import Stability
from crane.formats.loading import Variants
from crane.machine import Machine
from crane.motion.trajectories import task_trajectory
from crane.recordings.recording import Recording
from crane.simulation import simulate

MASS = "payload.mass"
_STEP = 5e-3  # [s] between the instants at which it may tip
_WITHIN = 1e-4  # of the load
_DOUBLINGS = 20


class TippingLoad(NamedTuple):
    """What tips a machine that moves.

    Attributes:
        mass: Of the payload [kg], infinite where none does.
        time: When it is on a tipping line [s].
        static: The payload under which it would tip standing still at the worst posture [kg].
    """

    mass: float
    time: float
    static: float


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
            f"machine '{machine.name}' has no task '{task}', {known(machine.tasks, task)}"
        )
    Stability(machine)  # that it has supports
    variants = Variants(machine)
    if MASS not in variants.values:
        raise InputError(f"'{machine.name}' has no payload, describe one in its machine file")
    done: dict[float, Recording] = {}

    def least(mass: float, channel: str = "stability") -> float:
        if mass not in done:
            with warnings.catch_warnings():  # that it tips is what is asked for
                warnings.simplefilter("ignore", CraneWarning)
                done[mass] = _run(variants.machine({MASS: mass}), task)
        return float(done[mass].channels[channel].min())

    found: list[float] = []
    for channel in ("static_stability", "stability"):
        if least(0.0, channel) <= 0:
            raise InputError(f"'{machine.name}' tips in '{task}' without any payload")
        high = 0.05 * Stability(machine).mass
        for _ in range(_DOUBLINGS):
            if least(high, channel) < 0:
                break
            high *= 2.0
        else:
            return TippingLoad(np.inf, np.nan, found[0] if found else np.inf)
        found.append(float(brentq(least, 0.0, high, (channel,), rtol=_WITHIN)))
    static, mass = found
    least(mass)
    run = done[mass]
    return TippingLoad(mass, float(run.time[run.channels["stability"].argmin()]), static)


def _run(machine: Machine, task: str) -> Recording:
    chosen = machine.tasks[task]
    under = machine.under(*chosen.loads)
    if chosen.space == "joystick":
        return simulate(under, joystick(machine, task), step=_STEP)
    return simulate(under, ComputedTorque(machine, task_trajectory(machine, task)), step=_STEP)
