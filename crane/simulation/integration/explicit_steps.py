"""Recorded instants of a method that chooses its steps itself."""

from crane.common.samples import Array
from crane.control import TracedController
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.chosen import ChosenSteps
from crane.simulation.integration.explicit import TOLERANCE, ExplicitStepper
from crane.simulation.integration.stepwise import Progress

_CHUNK = 1000  # instants between reports of progress


class ExplicitSteps(ChosenSteps[ExplicitStepper]):
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
        super().__init__(chart, control, own, ExplicitStepper(chart, control, own, tolerance))
        self._next = 0.0

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
