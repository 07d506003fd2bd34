"""Recorded instants of methods in machine code that choose their steps."""

from collections.abc import Callable

from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.controlled import SPACING, ControlledStepper
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.stepwise import Progress
from crane.simulation.integration.switching import Switching

_CHUNK = 1000  # instants between reports of progress
_SAME = 1e-9  # of a step, between times that are one


class ControlledSteps(Switching):
    """A `ControlledStepper`, with a program of the valves where there is one.

    Args:
        chart: The machine.
        control: Its controller.
        own: Number of the controller's states.
        stepper: The method.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        chart: Chart,
        control: TracedController,
        own: int,
        stepper: Callable[..., ControlledStepper],
    ):
        self._fast = stepper(chart, control, own)
        super().__init__(chart, control, own, self._fast)
        self._chart, self._control, self._next = chart, control, 0.0
        self._program = control if isinstance(control, ValveDrive) and control.period else None

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: Progress = None
    ) -> int:
        """See `Steps.run`.

        Raises:
            InputError: The valves' program has a period that is no whole number of steps.
            HaltedError: The machine cannot go on.
        """
        period = self._period(step)
        first = times[0] if len(times) else self._next
        self.done = self.reached = 0
        self._fast.forget()
        self._begin(first + self.offset, state)
        while self.done < len(times) or self.offset < 0:
            self._next = now = first + step * self.done
            chunk = rows[self.done : min(self.done + _CHUNK, len(times))]
            if period and self.offset < 0:
                chunk = chunk[:0]
            elif period:
                since = round(now / step) % period
                chunk = chunk[: period - since]
                if not since:
                    self._update(now, state)
            count, self.offset = self._fast.run(now, state, self.offset, step, chunk)
            self.done = self.reached = self.done + count
            self._next = first + step * self.done
            if self._fast.event:
                self._count(self._next + self.offset, state, step)
                # what refers to time is asked behind a jump, as steps that begin there do
                self._settle(self._next + self.offset + _SAME * min(step, SPACING), state)
                self.offset = self._left(self.offset, step)
            elif count < len(chunk) or self.offset < 0:
                if self.slow.steep(state):
                    break
                raise self.slow.stopped(self._next + self.offset, state)
            if progress is not None:
                progress(self.done)
        return self.done

    def _period(self, step: float) -> int:
        """Steps in a period of the valves' program, 0 without one."""
        if self._program is None:
            return 0
        asked = self._program.period
        period = round(asked / step)
        if abs(period * step - asked) > _SAME * asked:
            raise InputError(
                f"the period {asked:g} s of the valves' program is no whole number of steps of "
                f"{step:g} s, change one"
            )
        return period

    def _update(self, time: float, state: Array) -> None:
        """Let a program look at the machine, which may ask where no posture is."""
        at = self.slow.layout.view(state)
        assert self._program is not None
        try:
            v_a = self._chart.velocities(at.q, at.v_a)
            self._program.update(time, at.q, v_a, at.own)
        except ClosureError as error:
            raise HaltedError(time, self.slow.here(state), f": {error}") from None
