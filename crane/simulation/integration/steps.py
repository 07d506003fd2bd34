"""Steps of a fixed length by the classical Runge-Kutta method."""

from contextlib import suppress

import numpy as np

from crane.codegen import TooLongError
from crane.common.samples import Array
from crane.control import Controller, TracedController, ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.runge_kutta import CompiledStepper
from crane.simulation.integration.stepwise import Progress, PythonStepper

_CHUNK = 5000  # steps between reports of progress
_BACK, _AHEAD = 40, 20  # steps before and after a halt that are done anew with finer ones
_FINER = (2, 8)  # how much finer


class Steps:
    """Runge-Kutta steps in machine code, with care where that stops.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.

    Attributes:
        slow: Makes a step with care, or says why it cannot.
        done: Number of instants that have their row, after a run or where it halted.
        reached: Index of the instant of the state, which may have no row yet.
    """

    offset = 0.0

    def __init__(self, chart: Chart, control: Controller, own: int):
        self.slow = PythonStepper(chart, control, own)
        self.done = self.reached = 0
        self._fast: CompiledStepper | None = None
        if isinstance(control, ValveDrive) or chart.dynamics.backend != "compiled":
            return
        if isinstance(control, TracedController):
            with suppress(TooLongError):
                self._fast = CompiledStepper(chart, control, own)

    def limit(self, limits: Array) -> None:
        """Look for other coordinates from there on, see `Chart.limits`."""
        self.slow.limits = limits
        if self._fast is not None:
            self._fast.bounds[-2:] = limits

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> int:
        """Integrate from each of the times to the next, while the coordinates are good ones.

        Args:
            times: (N,) instants [s].
            state: At the first; replaced by that where it has got to.
            step: [s].
            rows: (N, .) in any order, filled with state and observations at the instants.
            progress: Called with the number of finished steps.

        Returns:
            How many steps were made.

        Raises:
            HaltedError: A step cannot be taken.
        """
        size, i = len(state), 0
        self.done = self.reached = 0
        while i < len(times):
            beyond = min(i + _CHUNK, len(times))
            if self._fast is not None:
                i += self._fast.run(times[i:beyond], state, step, rows[i:])
                self.done = self.reached = i
            if i < beyond:  # it stopped, or there is none
                if self.slow.steep(state):
                    break
                rows[i, :size] = state
                self.done = i + 1
                rate, rows[i, size:] = self.slow.observe(times[i], state)
                state[:] = self.slow.advance(times[i], state, rate, step)
                i += 1
                self.reached = i
            if progress is not None:
                progress(i)
        return i

    def last(self, time: float, state: Array) -> Array:
        """A row without a step after it.

        Args:
            time: [s].
            state: There.

        Raises:
            HaltedError: It cannot be observed.
        """
        fast = self._fast
        seen = fast.observe(time, state) if fast else self.slow.observe(time, state)[1]
        return np.concatenate([state, seen])

    def finer(self, times: Array, rows: Array, step: float) -> float:
        """A step [s] with which the motion goes on where it halted; 0 if none was found.

        Arguments as those of the run that halted.
        """
        done = self.done
        back, beyond = max(0, done - _BACK), min(done + _AHEAD, len(times))
        for share in _FINER:
            part = step / share
            again = times[back] + part * np.arange(share * (beyond - back))
            state = rows[back, : self.slow.layout.size].copy()
            with suppress(HaltedError):
                made = self.run(again, state, part, np.empty((len(again), rows.shape[1])))
                if made == len(again):
                    self.slow.observe(again[-1] + part, state)
                    self.done = done
                    return part
        self.done = done
        return 0.0
