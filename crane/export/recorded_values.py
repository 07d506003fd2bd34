"""Values of the library that tests of exported programs compare with."""

import warnings
from typing import NamedTuple

import numpy as np

from crane.common.errors import ClosureError, CraneWarning
from crane.common.samples import Array
from crane.control.control_law import ControlLaw
from crane.control.reference_samples import interpolate_references
from crane.control.valve_commands import ValveCommand, ValveSignals, require_circuit
from crane.control.valve_drive import ValveDrive
from crane.dynamics.dynamics import Dynamics
from crane.export.instance_program import DYNAMICS_ROUTINES, InstanceProgram
from crane.simulation.simulation_run import simulate

TEST_STEP = 0.01  # [s]
_TEST_STATES, _TEST_STEPS = 20, 50
_FOLLOWED = 0.01  # displacement of references [m], [rad]
_ROUNDED_STATES = 8
_SHARES = 1.0, 0.1, 0.01  # of the random offsets from home
_ROUNDING = float(np.finfo(float).eps)


def recorded_motion(program: InstanceProgram) -> tuple[Array, Array]:
    """A motion by `simulate`: valves open slowly, or the machine follows or moves freely.

    It ends before a dead centre, which exported programs do not pass.

    Returns:
        Inputs (k, inputs) at the ends of steps of `TEST_STEP`, and coordinates (k, nq) there.
    """
    machine, control = program.machine, program.control
    times = np.linspace(0.0, TEST_STEP * _TEST_STEPS, _TEST_STEPS + 1)
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
        recording = simulate(machine, controller, duration=times[-1], step=TEST_STEP)
    columns = {**recording.channels, **dict(zip(machine.active, recording.q.T, strict=True))}
    q, chart = np.column_stack([columns[x] for x in machine.joints]), program.chart
    determinant = machine.closure.compiled_closure.least_determinant
    beyond = [
        chart.largest_gamma_entry(x) > chart.chart_limits[0]
        or determinant(x) < chart.chart_limits[1]
        for x in q
    ]
    end = beyond.index(True) - 1 if any(beyond) else len(q)
    return inputs[1:end], q[1:end]


class RandomVectors(NamedTuple):
    """Quantities of the library at random closed states about home.

    Attributes:
        states: Rows (states, .) of configurations, velocities, and second arguments.
        values: Rows of each quantity by its routine.
        changes: (states,) of each quantity: its largest change by one rounding of the state and
            of the dynamic parameters, at least the rounding of its largest value.
    """

    states: dict[str, Array]
    values: dict[str, Array]
    changes: dict[str, Array]


def random_vectors(program: InstanceProgram) -> RandomVectors:
    """Quantities at random states, and what rounding changes of them."""
    machine, random = program.machine, np.random.default_rng(0)
    dynamics, n = Dynamics(machine), len(machine.active)
    units = machine.closure.units[machine.closure.active]
    offsets = 0.01 * units * random.uniform(-1, 1, (_TEST_STATES, n))
    q = machine.home[None]
    for share in _SHARES:
        try:
            q = machine.closure.solve(machine.home[machine.closure.active] + share * offsets)
            break
        except ClosureError:  # home is near the end of a branch
            continue
    q = np.broadcast_to(q, (_TEST_STATES, machine.model.nv))
    states = (q, *random.normal(size=(2, _TEST_STATES, n)))
    names = [name for name in program.entries if name in DYNAMICS_ROUTINES]

    def evaluate(*arrays: Array) -> dict[str, Array]:
        return {x: dynamics.evaluate_closed(DYNAMICS_ROUTINES[x], *arrays) for x in names}

    def round_off(x: Array) -> Array:
        return x * (1.0 + random.choice([-1, 1], x.shape) * _ROUNDING)

    values = evaluate(*states)
    changes = {x: _ROUNDING * np.abs(row).max(axis=1) for x, row in values.items()}
    constants = dynamics.formula_constants.copy()
    for _ in range(_ROUNDED_STATES):
        dynamics.formula_constants[:] = round_off(constants)
        rounded = evaluate(*map(round_off, states))
        for name, row in values.items():
            change = np.abs(rounded[name] - row).max(axis=1)
            changes[name] = np.maximum(changes[name], change)
    keys = "configurations", "velocities", "second"
    return RandomVectors(dict(zip(keys, states, strict=True)), values, changes)
