"""Recorded steps of stiff circuits, which choose their own length within."""

from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.control import ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.chosen import ChosenSteps
from crane.simulation.integration.halt import HaltedError
from crane.simulation.integration.rosenbrock import StiffStepper
from crane.simulation.integration.stepwise import Progress

_CHUNK = 1000  # steps between reports of progress


class StiffSteps(ChosenSteps[StiffStepper]):
    """The Rosenbrock method of `StiffStepper`, with a program of the valves where there is one.

    Args:
        chart: The machine.
        control: Its controller.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, chart: Chart, control: ValveDrive):
        super().__init__(chart, control, len(control.scales), StiffStepper(chart, control))
        self._chart, self._control = chart, control

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
        self.done = 0
        while self.done < len(times):
            length = _CHUNK
            if period:
                since = round(times[self.done] / step) % period
                length = period - since
                if not since:
                    self._update(times[self.done], state)
            chunk = times[self.done : self.done + length]
            count = self._fast.run(chunk, state, step, rows[self.done :])
            self.done += count
            if count < len(chunk):
                if self.slow.steep(state):
                    break
                raise self.slow.stopped(times[self.done], state)
            if progress is not None:
                progress(self.done)
        return self.done

    def _update(self, time: float, state: Array) -> None:
        """Let a program look at the machine, which may ask where no posture is."""
        at = self.slow.layout.view(state)
        try:
            v_a = self._chart.velocities(at.q, at.v_a)
            self._control.update(time, at.q, v_a, at.own)
        except ClosureError as error:
            raise HaltedError(time, self.slow.here(state), f": {error}") from None
