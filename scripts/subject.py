"""What the benchmark simulates: the mini forwarder in springs and dampers, and its own motions."""

import dataclasses
from ctypes import c_int64, c_void_p

import numpy as np
import pinocchio as pin

import crane
from crane.control import TracedController
from crane.integration import CompiledStepper
from crane.straight import Program

Array = np.ndarray

START = np.array([0.3, 0.020, 0.010]), np.array([2.0, 0.02, 0.02])

_LOOP = """
define void @loop(i64 %count, ptr %formula, ptr %geometry, ptr %numbers, ptr %q, ptr %x,
                  ptr %out) {{
entry:
  br label %sample
sample:
  %i = phi i64 [0, %entry], [%i1, %evaluate]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %evaluate, label %done
evaluate:
  %q0 = mul i64 %i, {nq}
  %qi = getelementptr double, ptr %q, i64 %q0
  %x0 = mul i64 %i, {inputs}
  %xi = getelementptr double, ptr %x, i64 %x0
  %o0 = mul i64 %i, {outputs}
  %oi = getelementptr double, ptr %out, i64 %o0
  call void %formula(ptr %geometry, ptr %numbers, ptr %qi, ptr %xi, ptr %oi)
  %i1 = add i64 %i, 1
  br label %sample
done:
  ret void
}}
"""


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
    weight = crane.Dynamics(machine, path="pinocchio").gravity(middle)
    springs = tuple(
        crane.ForceElement(joint, stiffness=k, rest=float(m + w / k), damping=c)
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
    """The simulation's loop in machine code, from one start.

    Args:
        machine: The machine.
        control: Its controller.
        q_a: (n,) start.
        v_a: (n,).
    """

    def __init__(self, machine: crane.Machine, control: TracedController, q_a: Array, v_a: Array):
        own = control.start(q_a)
        self._start = np.concatenate([machine.closure.solve(q_a), v_a, own, np.zeros(2)])
        self._stepper = CompiledStepper(crane.Dynamics(machine), control, len(own))
        self._columns = len(self._start) + 2 * len(v_a) + 2

    def run(self, step: float, steps: int) -> Array:
        """The state after so many steps."""
        state, out = self._start.copy(), np.empty((steps, self._columns))
        done = self._stepper.run(step * np.arange(steps), state, step, out)
        if done < steps:
            raise SystemExit(f"error: the loop stopped at step {done} of {steps}")
        return state


class FormulaLoop:
    """The formula of forward dynamics in a loop of machine code, over closed postures.

    It is called through its address, so that nothing of it can leave the loop.

    Args:
        dynamics: Of the machine.
        q: (N, nq) closed postures.
        v_a: (N, n).
        tau: (N, n) forces.

    Attributes:
        out: (N, n) accelerations.
    """

    def __init__(self, dynamics: crane.Dynamics, q: Array, v_a: Array, tau: Array):
        self._formula = formula = dynamics._formula("forward")
        self.out = np.empty((len(q), formula.size))
        self._q, self._x = q, np.hstack([v_a, tau])
        program = self._program = Program()
        program.add_text(
            _LOOP.format(nq=q.shape[1], inputs=self._x.shape[1], outputs=formula.size)
        )
        program.compile()
        self._loop = program.function("loop", c_int64, *[c_void_p] * 6)
        constants = [a.ctypes.data for a in (formula._fast.geometry.numbers, formula._numbers)]
        self._arguments = (
            len(q), formula._program.address("formula"), *constants,
            q.ctypes.data, self._x.ctypes.data, self.out.ctypes.data,
        )  # fmt: skip
        self._each = [
            (*constants, *(row.ctypes.data for row in rows))
            for rows in zip(q, self._x, self.out, strict=True)
        ]

    def run(self) -> None:
        """Once over all postures."""
        self._loop(*self._arguments)

    def call_each(self) -> None:
        """The same by one call of ctypes per posture."""
        for addresses in self._each:
            self._formula._formula(*addresses)
