"""The machine of the benchmark, the mini forwarder in springs and dampers, and its motions."""

import dataclasses
from functools import partial

import numpy as np
import pinocchio as pin

import crane
from crane.codegen import Program
from crane.control import ControlLaw, ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.integrators import ErrorControlledIntegrator, FixedStepIntegrator
from crane.simulation.integration.rosenbrock import RosenbrockStepper

Array = np.ndarray

START = np.array([0.3, 0.020, 0.010]), np.array([2.0, 0.02, 0.02])


def swinging(machine: crane.Machine) -> crane.Machine:
    """The machine in springs and dampers at its actuators, without friction and end stops.

    Under constant forces the crane falls chaotically, and no two engines could be compared. All
    bodies get a little more inertia, because MuJoCo refuses slender ones.
    """
    model = pin.Model(machine.model)
    for body in range(1, model.njoints):
        inertia = model.inertias[body]
        tensor = inertia.inertia + 1e-7 * np.eye(3)
        model.inertias[body] = pin.Inertia(inertia.mass, inertia.lever, tensor)
    machine = dataclasses.replace(machine, model=model)
    middle = np.array([0.0, 0.015, 0.015])
    weight = crane.Dynamics(machine, backend="pinocchio").gravity(middle)
    springs = tuple(
        crane.description.ForceElement(joint, stiffness=k, rest=float(m + w / k), damping=c)
        for joint, k, c, m, w in zip(
            machine.active, (0.3, 3000.0, 5000.0), (0.02, 40.0, 40.0), middle, weight, strict=True
        )
    )
    return machine.replace(friction={}, forces=springs, end_stops=())


def along(count: int) -> tuple[Array, Array]:
    """Coordinates and velocities (N, 3) of a motion through most of the strokes at 1 ms."""
    t = 1e-3 * np.arange(count)[:, None]
    rate, phase = np.array([1.0, 0.7, 0.9]), np.array([0.0, 0.0, 1.5])
    middle, reach = np.array([0.0, 0.015, 0.015]), np.array([1.0, 0.012, 0.012])
    return middle + reach * np.sin(rate * t + phase), reach * rate * np.cos(rate * t + phase)


class Runner:
    """The simulation's loop in steps of a millisecond, circuits in recorded ones, from one start.

    Args:
        machine: The machine.
        control: Its controller.
        q_a: (n,) start.
        v_a: (n,).
    """

    def __init__(self, machine: crane.Machine, control: ControlLaw, q_a: Array, v_a: Array):
        own = control.start(q_a)
        self._start = np.concatenate([machine.closure.solve(q_a), v_a, own, np.zeros(2)])
        chart = Chart.from_dynamics(crane.Dynamics(machine), control, len(own))
        self._way = (
            ErrorControlledIntegrator(chart, RosenbrockStepper)
            if isinstance(control, ValveDrive)
            else FixedStepIntegrator(chart)
        )
        self._columns = chart.row_layout.size

    def run(self, step: float, steps: int) -> Array:
        """The state after so many steps."""
        state, out = self._start.copy(), np.empty((steps, self._columns))
        done = self._way.run(step * np.arange(steps), state, step, out)
        if done < steps:
            raise SystemExit(f"error: the loop stopped at step {done} of {steps}")
        return state


class FormulaLoop:
    """A formula, that of forward dynamics, in a loop of machine code, over closed postures.

    It is called through its address, so that nothing of it can leave the loop.

    Args:
        dynamics: Of the machine.
        q: (N, nq) closed postures.
        v_a: (N, n).
        tau: (N, n) forces.
        quantity: Which.

    Attributes:
        out: (N, n) accelerations, or what else it gives.
    """

    def __init__(
        self,
        dynamics: crane.Dynamics,
        q: Array,
        v_a: Array,
        tau: Array,
        quantity: str = "forward",
    ):
        formula = dynamics._compiled_quantity(quantity)
        self.out = np.empty((len(q), formula.size))
        self._q, self._x = q, np.hstack([v_a, tau])
        program = Program()
        names = ("geometry", "numbers", "q", "x", "out")
        arguments = {"counts": ("count",), "functions": ("formula",), "arrays": names}
        with program.add_routine("loop", **arguments) as r:
            with r.loop(r.count) as i:
                rows = r.q.row_pointer(i, q.shape[1]), r.x.row_pointer(i, self._x.shape[1])
                r.call("formula", r.geometry, r.numbers, *rows, r.out.row_pointer(i, formula.size))
            r.return_value(r.count)
        program.compile()
        constants = formula._constants
        address = formula._program.function_address("formula")
        arrays = *constants, q, self._x, self.out
        self._loop = partial(program.call, "loop", len(q), address, *arrays)
        self._each = [
            formula._program.sample_function(
                "closed_each", 1, *constants, *rows, inputs=np.empty((0, 0)), output=rows[-1]
            )
            for rows in zip(q, self._x, self.out, strict=True)
        ]

    def run(self) -> None:
        """Once over all postures."""
        self._loop()

    def call_each(self) -> None:
        """The same by one call from Python per posture."""
        for call in self._each:
            call()
