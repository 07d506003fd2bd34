"""Recorded steps of stiff circuits, which choose their own length within."""

import numpy as np

from crane.control import StiffController
from crane.dynamics import Dynamics
from crane.errors import ClosureError, InputError, SimulationError
from crane.integration.rosenbrock import StiffStepper
from crane.integration.stepwise import Progress, PythonStepper
from crane.samples import Array

_CHUNK = 1000  # steps between reports of progress
_AHEAD = 1e-3  # [s] how far a machine is thought on that stops


class StiffSteps:
    """The Rosenbrock method of `StiffStepper`, with a program of the valves where there is one.

    Args:
        dynamics: The machine.
        control: Its controller.

    Attributes:
        slow: Observes.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, dynamics: Dynamics, control: StiffController):
        self._dynamics, self._control = dynamics, control
        self._fast = StiffStepper(dynamics, control)
        self.slow = PythonStepper(dynamics, control, len(control.scales))

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> None:
        """See `Steps.run`.

        Raises:
            InputError: The program's period is no whole number of steps.
            SimulationError: The machine cannot go on.
        """
        control = self._control
        period = round(control.period / step) if control.period else 0
        if control.period and abs(period * step - control.period) > 1e-9 * control.period:
            raise InputError(
                f"the period {control.period:g} s of the valves' program is no whole number of "
                f"steps of {step:g} s, change one"
            )
        at, done = self.slow.layout.view(state), 0
        while done < len(times):
            if period:
                control.update(times[done], at.q, at.v_a, at.own)
            chunk = times[done : done + (period or _CHUNK)]
            count = self._fast.run(chunk, state, step, rows[done:])
            if count < len(chunk):
                raise self._stopped(times[done + count], at.q, at.v_a)
            done += count
            if progress is not None:
                progress(done)

    def _stopped(self, time: float, q: Array, v_a: Array) -> SimulationError:
        """Why the machine cannot go on."""
        closure = self._dynamics.machine.closure
        try:
            closure.solve(q[closure.active] + _AHEAD * v_a, guess=q)
        except ClosureError as error:
            return SimulationError(f"at t = {time:.6g} s: {error}")
        return SimulationError(
            f"at t = {time:.6g} s the motion cannot be followed, the fastest joint moves at "
            f"{np.abs(v_a).max():.3g} m/s or rad/s: give its end stops damping, or smooth the "
            "friction more"
        )
