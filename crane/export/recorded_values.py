"""Values of the library that tests of exported programs compare with."""

import warnings
from typing import NamedTuple

import numpy as np

from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.control.valve_commands import ValveSignals
from crane.control.valve_drive import ValveDrive
from crane.dynamics.dynamics import Dynamics
from crane.export.instance_program import DYNAMICS_ROUTINES, InstanceProgram
from crane.simulation.simulation_run import simulate

_TEST_STATES, _TEST_STEPS, _TEST_STEP = 20, 50, 0.01


class RecordedMotion(NamedTuple):
    """A motion from home.

    Attributes:
        step: [s].
        inputs: (k, inputs) at the end of each step.
        q: (k, nq) coordinates there.
    """

    step: float
    inputs: Array
    q: Array


def recorded_motion(program: InstanceProgram) -> RecordedMotion:
    """A motion by `simulate`: valves open slowly, or the machine moves without forces."""
    machine, control = program.machine, program.control
    times = _TEST_STEP * np.arange(_TEST_STEPS + 1)
    start = program.layout.view(program.defaults).inputs
    inputs, controller = np.tile(start, (len(times), 1)), None
    if isinstance(control, ValveDrive):
        spools = control.circuit.hydraulics.spools
        for i, spool in enumerate(spools.values()):
            inputs[:, i] += 0.6 * (spool.full - spool.neutral) * times / times[-1] * (-1) ** i
        signals = {name: inputs[:, i] for i, name in enumerate(spools)}
        controller = ValveSignals(machine, times, signals)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        recording = simulate(machine, controller, duration=times[-1], step=_TEST_STEP)
    columns = [
        recording.q[:, machine.active.index(joint)]
        if joint in machine.active
        else recording.channels[joint]
        for joint in machine.joints
    ]
    return RecordedMotion(_TEST_STEP, inputs[1:], np.column_stack(columns)[1:])


def random_vectors(program: InstanceProgram) -> dict[str, list[Array]]:
    """Random closed states about home, and the quantities of the library at them."""
    machine, random = program.machine, np.random.default_rng(0)
    dynamics, n = Dynamics(machine), len(machine.active)
    found: dict[str, list[Array]] = {"configurations": [], "velocities": [], "second": []}
    units = machine.closure.units[machine.closure.active]
    home = machine.home[machine.closure.active]
    for _ in range(_TEST_STATES):
        q = machine.closure.solve(home + 0.01 * units * random.uniform(-1, 1, n))
        v, x = random.normal(size=(2, n))
        found["configurations"].append(q)
        found["velocities"].append(v)
        found["second"].append(x)
        for name, quantity in DYNAMICS_ROUTINES.items():
            if name in program.entries:
                value = dynamics.evaluate_closed(quantity, q, v, x)
                found.setdefault(name, []).append(value)
    return found
