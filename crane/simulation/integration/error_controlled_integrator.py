"""Recorded instants of methods in machine code that choose their steps."""

from collections.abc import Callable

from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.control import TracedController, ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import (
    MAX_REFERENCE_SPACING,
    ErrorControlledStepper,
)
from crane.simulation.integration.integration_halt import IntegrationHaltError
from crane.simulation.integration.python_stepper import StepProgress
from crane.simulation.integration.stick_slip_integrator import StickSlipIntegrator

_INSTANTS_PER_REPORT = 1000  # instants between reports of progress
_TIME_TOLERANCE = 1e-9  # of a step, between times that are one


class ErrorControlledIntegrator(StickSlipIntegrator):
    """A `ErrorControlledStepper`, with a program of the valves where there is one.

    Args:
        chart: The machine.
        control: Its controller.
        controller_state_count: Number of the controller's states.
        stepper_factory: The method.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        chart: Chart,
        control: TracedController,
        controller_state_count: int,
        stepper_factory: Callable[..., ErrorControlledStepper],
    ):
        self._stepper = stepper_factory(chart, control, controller_state_count)
        super().__init__(chart, control, controller_state_count, self._stepper)
        self._chart, self._control, self._next_time = chart, control, 0.0
        self._sampled_drive = (
            control if isinstance(control, ValveDrive) and control.period else None
        )

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: StepProgress = None
    ) -> int:
        """See `FixedStepIntegrator.run`.

        Raises:
            InputError: The valves' program has a period that is no whole number of steps.
            HaltedError: The machine cannot go on.
        """
        period = self._period_in_steps(step)
        first = times[0] if len(times) else self._next_time
        self.done = self.next_instant = 0
        self._stepper.reset_step_size()
        self._prepare_modes(first + self.offset, state)
        while self.done < len(times) or self.offset < 0:
            self._next_time = now = first + step * self.done
            chunk = rows[self.done : min(self.done + _INSTANTS_PER_REPORT, len(times))]
            if period and self.offset < 0:
                chunk = chunk[:0]
            elif period:
                since = round(now / step) % period
                chunk = chunk[: period - since]
                if not since:
                    self._update_command(now, state)
            count, self.offset = self._stepper.run(now, state, self.offset, step, chunk)
            self.done = self.next_instant = self.done + count
            self._next_time = first + step * self.done
            if self._stepper.event:
                self._count_transition(self._next_time + self.offset, state, step)
                # what refers to time is asked behind a jump, as steps that begin there do
                self._find_modes(
                    self._next_time
                    + self.offset
                    + _TIME_TOLERANCE * min(step, MAX_REFERENCE_SPACING),
                    state,
                )
                self.offset = self._rounded_offset(self.offset, step)
            elif count < len(chunk) or self.offset < 0:
                if self.python_stepper.exceeds_chart_limits(state):
                    break
                raise self.python_stepper.halt_error(self._next_time + self.offset, state)
            if progress is not None:
                progress(self.done)
        return self.done

    def _period_in_steps(self, step: float) -> int:
        """Steps in a period of the valves' program, 0 without one."""
        if self._sampled_drive is None:
            return 0
        period_time = self._sampled_drive.period
        period = round(period_time / step)
        if abs(period * step - period_time) > _TIME_TOLERANCE * period_time:
            raise InputError(
                f"the period {period_time:g} s of the valves' program is no whole number of "
                f"steps of "
                f"{step:g} s, change one"
            )
        return period

    def _update_command(self, time: float, state: Array) -> None:
        """Let a program look at the machine, which may ask where no posture is."""
        at = self.python_stepper.state_layout.view(state)
        assert self._sampled_drive is not None
        try:
            v_a = self._chart.user_velocities(at.q, at.v_a)
            self._sampled_drive.update(time, at.q, v_a, at.own)
        except ClosureError as error:
            raise IntegrationHaltError(
                time, self.python_stepper.user_coordinates(state), f": {error}"
            ) from None
