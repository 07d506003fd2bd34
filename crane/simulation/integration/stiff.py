"""Steps of the Rosenbrock method, and programs that command valves."""

import numpy as np

from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.control import ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.rosenbrock import StiffStepper
from crane.simulation.integration.stepwise import Progress
from crane.simulation.integration.sticking import NEAR
from crane.simulation.integration.switching import Switching

_CHUNK = 1000  # steps between reports of progress


class StiffSteps(Switching):
    """The Rosenbrock method of `StiffStepper`, with a program of the valves where there is one.

    Args:
        chart: The machine.
        control: Its controller.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, chart: Chart, control: ValveDrive):
        self._fast = StiffStepper(chart, control)
        super().__init__(chart, control, len(control.scales), self._fast)
        self._chart, self._control, self._next = chart, control, 0.0

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> int:
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
        first = times[0] if len(times) else self._next
        self.done = self.reached = 0
        self._begin(first + self.offset, state)
        while self.done < len(times) or self.offset < 0:
            if self.offset < 0:
                self._completed(first + step * self.done, state, step)
                continue
            length = _CHUNK
            if period:
                since = round(times[self.done] / step) % period
                length = period - since
                if not since:
                    self._update(times[self.done], state)
            chunk = times[self.done : self.done + length]
            count = self._fast.run(chunk, state, step, rows[self.done :])
            self.done = self.reached = self.done + count
            event = self._fast.event
            if not event and count == len(chunk) and self._sticking.columns:
                event = step * (self._look(chunk[-1] + step, state)[1] < -NEAR)
            if event and count:
                begun = times[self.done - 1]
                state[:] = rows[self.done - 1, : len(state)]
                later = self._switched(begun, state, event, step)
                self.offset = self._left(later - step, step)
            elif event:
                self._settle(chunk[0], state)
            elif count < len(chunk):
                if self.slow.steep(state):
                    break
                raise self.slow.stopped(times[self.done], state)
            if progress is not None:
                progress(self.done)
        self._next = first + step * self.done
        return self.done

    def _step(self, time: float, state: Array, length: float) -> tuple[Array, float]:
        """See `Switching._step`."""
        after, row = state.copy(), np.empty((1, self._fast.width))
        if not self._fast.run(np.array([time]), after, length, row):
            raise self.slow.stopped(time, state)
        if self._fast.event:  # before its end
            return after, -np.inf
        return after, self._look(time + length, after)[1]

    def _update(self, time: float, state: Array) -> None:
        """Let a program look at the machine, which may ask where no posture is."""
        at = self.slow.layout.view(state)
        try:
            v_a = self._chart.velocities(at.q, at.v_a)
            self._control.update(time, at.q, v_a, at.own)
        except ClosureError as error:
            raise HaltedError(time, self.slow.here(state), f": {error}") from None
