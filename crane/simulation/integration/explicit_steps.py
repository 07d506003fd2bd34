"""Recorded instants of a method that chooses its steps itself."""

import numpy as np

from crane.common.samples import Array
from crane.control import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.explicit import TOLERANCE, ExplicitStepper
from crane.simulation.integration.stepwise import Progress, PythonStepper

_CHUNK = 1000  # instants between reports of progress


class ExplicitSteps:
    """The method of `ExplicitStepper`, whose steps end where they like.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.
        tolerance: Error of a step, per size of the state.

    Attributes:
        slow: Observes.
        done: Number of instants that have their row, after a run or where it halted.
        offset: When the state is, after the next instant without a row [s].

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self, chart: Chart, control: TracedController, own: int, tolerance: float = TOLERANCE
    ):
        self._fast = ExplicitStepper(chart, control, own, tolerance)
        self.slow = PythonStepper(chart, control, own)
        self.done, self.offset, self._next = 0, 0.0, 0.0

    @property
    def reached(self) -> int:
        """The first instant that is not before the state."""
        return self.done

    def limit(self, limits: Array) -> None:
        """See `Steps.limit`."""
        self.slow.limits = self._fast.bounds[-2:] = limits

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> int:
        """See `Steps.run`; the state is at `offset` behind the first of the times.

        Raises:
            HaltedError: The machine cannot go on.
        """
        first = times[0] if len(times) else self._next
        self.done = 0
        while self.done < len(times) or self.offset < 0:
            self._next = first + step * self.done
            chunk = rows[self.done : min(self.done + _CHUNK, len(times))]
            count, self.offset = self._fast.run(self._next, state, self.offset, step, chunk)
            self.done += count
            self._next = first + step * self.done
            if count < len(chunk) or self.offset < 0:
                if self.slow.steep(state):
                    break
                raise self.slow.stopped(self._next + self.offset, state)
            if progress is not None:
                progress(self.done)
        return self.done

    def last(self, time: float, state: Array) -> Array:
        """See `Steps.last`."""
        return np.concatenate([state, self._fast.observe(time, state)])

    def finer(self, times: Array, rows: Array, step: float) -> float:
        """No step: the method has found the finest itself."""
        return 0.0
