"""Recorded instants of a method that chooses its steps itself."""

from crane.common.samples import Array
from crane.control import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.explicit import TOLERANCE, ExplicitStepper
from crane.simulation.integration.stepwise import Progress
from crane.simulation.integration.switching import Switching

_CHUNK = 1000  # instants between reports of progress


class ExplicitSteps(Switching):
    """The method of `ExplicitStepper`, whose steps end where they like.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.
        tolerance: Error of a step, per size of the state.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self, chart: Chart, control: TracedController, own: int, tolerance: float = TOLERANCE
    ):
        self._fast = ExplicitStepper(chart, control, own, tolerance)
        super().__init__(chart, control, own, self._fast)
        self._next = 0.0

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> int:
        """See `Steps.run`.

        Raises:
            HaltedError: The machine cannot go on.
        """
        first = times[0] if len(times) else self._next
        self.done = self.reached = 0
        self._begin(first + self.offset, state)
        while self.done < len(times) or self.offset < 0:
            self._next = first + step * self.done
            chunk = rows[self.done : min(self.done + _CHUNK, len(times))]
            count, self.offset = self._fast.run(self._next, state, self.offset, step, chunk)
            self.done = self.reached = self.done + count
            self._next = first + step * self.done
            if self._fast.event:
                if not self.offset:
                    rows[self.done] = self.last(self._next, state)
                    self.done = self.reached = self.done + 1
                    self._next, self.offset = first + step * self.done, -step
                self._completed(self._next, state, step)
            elif count < len(chunk) or self.offset < 0:
                if self.slow.steep(state):
                    break
                raise self.slow.stopped(self._next + self.offset, state)
            if progress is not None:
                progress(self.done)
        return self.done

    def _step(self, time: float, state: Array, length: float) -> tuple[Array, float]:
        """See `Switching._step`."""
        return self._fast.advance(time, state, length)
