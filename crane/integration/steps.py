"""Steps of a fixed length by the classical Runge-Kutta method."""

from contextlib import suppress

from crane.codegen import TooLongError, carefully
from crane.control import Controller, StiffController, TracedController
from crane.dynamics import Dynamics
from crane.integration.runge_kutta import CompiledStepper
from crane.integration.stepwise import Progress, PythonStepper
from crane.samples import Array

_CHUNK = 1000  # steps between reports of progress


class Steps:
    """Runge-Kutta steps in machine code, with care where that stops.

    Args:
        dynamics: The machine.
        control: Its controller.
        own: Number of the controller's states.

    Attributes:
        slow: Makes a step with care, or says why it cannot.
    """

    def __init__(self, dynamics: Dynamics, control: Controller, own: int):
        self.slow = PythonStepper(dynamics, control, own)
        self._fast: CompiledStepper | None = None
        if isinstance(control, StiffController) or dynamics.path != "compiled":
            return
        if isinstance(control, TracedController):
            with suppress(TooLongError):
                self._fast = CompiledStepper(dynamics, control, own)

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> None:
        """Integrate from each of the times to the next.

        Args:
            times: (N,) instants [s].
            state: At the first; replaced by that a step after the last.
            step: [s].
            rows: (N, .), filled with state and observations at the instants.
            progress: Called with the number of finished steps.
        """
        fast = self._fast

        def quick(first: int, beyond: int) -> int:
            assert fast is not None
            return fast.run(times[first:beyond], state, step, rows[first:])

        def careful(i: int) -> None:
            rate, seen = self.slow.observe(times[i], state)
            rows[i] = [*state, *seen]
            state[:] = self.slow.advance(times[i], state, rate, step)

        carefully(len(times), quick if fast else None, careful, _CHUNK, progress)
