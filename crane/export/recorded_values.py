"""Values of the library that tests of exported programs compare with."""

import warnings
from typing import NamedTuple

import numpy as np

from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.control.control_law import ControlLaw
from crane.control.reference_samples import interpolate_references
from crane.control.valve_commands import ValveCommand, ValveSignals, require_circuit
from crane.control.valve_drive import ValveDrive
from crane.dynamics.dynamics import Dynamics
from crane.export.instance_program import DYNAMICS_ROUTINES, InstanceProgram
from crane.simulation.simulation_run import simulate

_TEST_STATES, _TEST_STEPS, _TEST_STEP = 20, 50, 0.01
_FOLLOWED = 0.01  # displacement of references [m], [rad]


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
    """A motion by `simulate`: valves open slowly, or the machine follows or moves freely."""
    machine, control = program.machine, program.control
    times = np.linspace(0.0, _TEST_STEP * _TEST_STEPS, _TEST_STEPS + 1)
    start = program.layout.view(program.defaults).inputs
    inputs, shares = np.tile(start, (len(times), 1)), times / times[-1]
    controller: ControlLaw | ValveCommand = control
    if isinstance(control, ValveDrive):
        controller = control.command
    if isinstance(controller, ValveSignals):
        spools = require_circuit(machine).spools
        for i, spool in enumerate(spools.values()):
            inputs[:, i] += 0.6 * (spool.full - spool.neutral) * shares * (-1) ** i
        signals = {name: inputs[:, i] for i, name in enumerate(spools)}
        controller = ValveSignals(machine, times, signals)
    else:
        for i, unit in enumerate(control.reference_units.values()):
            inputs[:, i] += _FOLLOWED * shares * (unit in ("m", "rad"))
        rows = inputs[:, : control.references(times).shape[1]]
        controller = interpolate_references(controller, times, rows)
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


def random_vectors(program: InstanceProgram) -> tuple[dict[str, list[Array]], dict[str, float]]:
    """Random closed states about home, the quantities of the library at them, and their sizes.

    The size is the largest value, or more where rounding of the configuration changes the
    quantity by more than 1e-14 of it, as beside change points.
    """
    machine, random = program.machine, np.random.default_rng(0)
    dynamics, n = Dynamics(machine), len(machine.active)
    found: dict[str, list[Array]] = {"configurations": [], "velocities": [], "second": []}
    sizes: dict[str, float] = {}
    units = machine.closure.units[machine.closure.active]
    home = machine.home[machine.closure.active]
    quantities = {x: DYNAMICS_ROUTINES[x] for x in program.entries if x in DYNAMICS_ROUTINES}
    for _ in range(_TEST_STATES):
        q = machine.closure.solve(home + 0.01 * units * random.uniform(-1, 1, n))
        v, x = random.normal(size=(2, n))
        rounded = q * (1.0 + 4e-16 * random.uniform(-1, 1, len(q)))
        for key, row in (("configurations", q), ("velocities", v), ("second", x)):
            found[key].append(row)
        for name, quantity in quantities.items():
            value = dynamics.evaluate_closed(quantity, q, v, x)
            change = np.abs(dynamics.evaluate_closed(quantity, rounded, v, x) - value).max()
            found.setdefault(name, []).append(value)
            size = max(float(np.abs(value).max()), 1e14 * float(change))
            sizes[name] = max(sizes.get(name, 0.0), size)
    return found, sizes
