"""Recorded steps of stiff circuits, which choose their own length within."""

import numpy as np

from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.control import ValveDrive
from crane.dynamics import Dynamics
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.rosenbrock import StiffStepper
from crane.simulation.integration.stepwise import Progress, PythonStepper

_CHUNK = 1000  # steps between reports of progress
_AHEAD = 1e-3  # [s] how far a machine is thought on that stops


class StiffSteps:
    """The Rosenbrock method of `StiffStepper`, with a program of the valves where there is one.

    Args:
        dynamics: The machine.
        control: Its controller.

    Attributes:
        slow: Observes.
        done: Number of instants that have their row, after a run or where it halted.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, dynamics: Dynamics, control: ValveDrive):
        self._dynamics, self._control = dynamics, control
        self._fast = StiffStepper(dynamics, control)
        self.slow = PythonStepper(dynamics, control, len(control.scales))
        self.done = 0

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> None:
        """See `Steps.run`.

        Raises:
            InputError: The program's period is no whole number of steps.
            HaltedError: The machine cannot go on.
        """
        control = self._control
        period = round(control.period / step) if control.period else 0
        if control.period and abs(period * step - control.period) > 1e-9 * control.period:
            raise InputError(
                f"the period {control.period:g} s of the valves' program is no whole number of "
                f"steps of {step:g} s, change one"
            )
        at, self.done = self.slow.layout.view(state), 0
        while self.done < len(times):
            if period:
                self._update(times[self.done], at.q, at.v_a, at.own)
            chunk = times[self.done : self.done + (period or _CHUNK)]
            count = self._fast.run(chunk, state, step, rows[self.done :])
            self.done += count
            if count < len(chunk):
                raise self._stopped(times[self.done], at.q, at.v_a)
            if progress is not None:
                progress(self.done)

    def last(self, time: float, state: Array) -> Array:
        """See `Steps.last`."""
        return np.concatenate([state, self._fast.observe(time, state)])

    def finer(self, times: Array, rows: Array, step: float) -> float:
        """No step: within recorded ones the method has found the finest itself."""
        return 0.0

    def _update(self, time: float, q: Array, v_a: Array, own: Array) -> None:
        """Let a program look at the machine, which may ask where no posture is."""
        try:
            self._control.update(time, q, v_a, own)
        except ClosureError as error:
            here = q[self._dynamics.machine.closure.active]
            raise HaltedError(time, here, f": {error}") from None

    def _stopped(self, time: float, q: Array, v_a: Array) -> HaltedError:
        """Why the machine cannot go on, whatever the step."""
        closure = self._dynamics.machine.closure
        here = q[closure.active]
        try:
            closure.solve(here + _AHEAD * v_a, guess=q)
        except ClosureError as error:
            return HaltedError(time, here, f": {error}")
        speed = np.abs(v_a).max()
        return HaltedError(
            time,
            here,
            f" the motion cannot be followed, the fastest joint moves at {speed:.3g} m/s or rad/s",
            ": give its end stops damping, or smooth the friction more",
        )
