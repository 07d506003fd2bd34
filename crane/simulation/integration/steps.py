"""Steps of a fixed length by the classical Runge-Kutta method."""

from contextlib import suppress

import numpy as np

from crane.codegen import TooLongError
from crane.common.samples import Array
from crane.control import Controller, TracedController, ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.runge_kutta import CompiledStepper
from crane.simulation.integration.stepwise import Progress
from crane.simulation.integration.sticking import NEAR
from crane.simulation.integration.switching import Switching

_CHUNK = 5000  # steps between reports of progress
_BACK, _AHEAD = 40, 20  # steps before and after a halt that are done anew with finer ones
_FINER = (2, 8)  # how much finer
_FEW = 100  # starts and stops within a finer step: one that needs more is no remedy


class Steps(Switching):
    """Runge-Kutta steps in machine code, with care where that stops.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.
    """

    def __init__(self, chart: Chart, control: Controller, own: int):
        self._fast: CompiledStepper | None = None
        compiled = not isinstance(control, ValveDrive) and chart.dynamics.backend == "compiled"
        if compiled and chart.machine.traced and isinstance(control, TracedController):
            with suppress(TooLongError):
                self._fast = CompiledStepper(chart, control, own)
        super().__init__(chart, control, own, self._fast)
        self._next = 0.0

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> int:
        """Integrate from each of the times to the next, while the coordinates are good ones.

        Args:
            times: (N,) instants [s].
            state: At the first, or `offset` after it; replaced by that where it has got to.
            step: [s].
            rows: (N, .) in any order, filled with state and observations at the instants.
            progress: Called with the number of finished steps.

        Returns:
            How many steps were made.

        Raises:
            HaltedError: A step cannot be taken.
        """
        first = times[0] if len(times) else self._next
        self.done = self.reached = 0
        self._begin(first + self.offset, state)
        while self.done < len(times) or self.offset < 0:
            now = first + step * self.reached
            if self.offset < 0:
                self._completed(now, state, step)
                continue
            if not self._some(times, state, step, rows):
                break
            if progress is not None:
                progress(self.done)
        self._next = first + step * self.reached
        return self.reached

    def _some(self, times: Array, state: Array, step: float, rows: Array) -> bool:
        """Make some steps, or go on to where a joint starts or stops.

        Returns:
            False where other coordinates are better.
        """
        size, i = len(state), self.done
        beyond, event = min(i + _CHUNK, len(times)), 0.0
        if self._fast is not None:
            i += self._fast.run(times[i:beyond], state, step, rows[i:])
            self.done = self.reached = i
            event = self._fast.event
        if i < beyond and not event:  # it stopped, or there is none
            if self.slow.steep(state):
                return False
            rate, seen = self.slow.observe(times[i], state)
            if self.slow.margin < -NEAR:
                event = step
            else:
                rows[i, :size], rows[i, size:] = state, seen
                self.done = i + 1
                state[:] = self.slow.advance(times[i], state, rate, step)
                i = self.reached = i + 1
        if not event and i == len(times) and self._sticking.columns:  # nobody looks behind it
            event = step * (self._look(times[-1] + step, state)[1] < -NEAR)
        if event and i:
            state[:] = rows[i - 1, :size]
            later = self._switched(times[i - 1], state, event, step)
            self.offset = self._left(later - step, step)
        elif event:
            self._settle(times[0], state)
        return True

    def _step(self, time: float, state: Array, length: float) -> tuple[Array, float]:
        """See `Switching._step`."""
        if self._fast is not None:
            after, row = state.copy(), np.empty((1, self._fast.width))
            if self._fast.run(np.array([time]), after, length, row):
                return after, self._fast.observe(time + length, after)[1]
        rate, _ = self.slow.observe(time, state)
        after = self.slow.advance(time, state, rate, length)
        self.slow.observe(time + length, after)
        return after, self.slow.margin

    def finer(self, times: Array, rows: Array, step: float) -> float:
        """See `Switching.finer`."""
        done = self.done
        back, beyond = max(0, done - _BACK), min(done + _AHEAD, len(times))
        self._most = _FEW
        for share in _FINER:
            part = step / share
            again = times[back] + part * np.arange(share * (beyond - back))
            state = rows[back, : self.slow.layout.size].copy()
            self.offset, self._sticking.settled = 0.0, False
            with suppress(HaltedError):
                made = self.run(again, state, part, np.empty((len(again), rows.shape[1])))
                if made == len(again):
                    self.slow.observe(again[-1] + part, state)
                    self.done = done
                    return part
        self.done = done
        return 0.0
