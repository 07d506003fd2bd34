"""Steps of a fixed length by the classical Runge-Kutta method."""

from contextlib import suppress

import numpy as np

from crane.codegen import FormulaTooLongError
from crane.common.samples import Array
from crane.control import Controller, TracedController, ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.integration_halt import IntegrationHaltError
from crane.simulation.integration.python_stepper import StepProgress
from crane.simulation.integration.runge_kutta import RungeKuttaStepper
from crane.simulation.integration.stick_slip_integrator import StickSlipIntegrator
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE

_STEPS_PER_REPORT = 5000  # steps between reports of progress
_STEPS_BEFORE_HALT, _STEPS_AFTER_HALT = (
    40,
    20,
)  # steps before and after a halt that are done anew with finer ones
_REFINEMENT_FACTORS = (2, 8)  # how much finer
_MAX_TRANSITIONS_IN_FINER_STEP = (
    100  # starts and stops within a finer step: one that needs more is no remedy
)


class FixedStepIntegrator(StickSlipIntegrator):
    """Runge-Kutta steps in machine code, with care where that stops.

    Args:
        chart: The machine.
        control: Its controller.
        controller_state_count: Number of the controller's states.
    """

    def __init__(self, chart: Chart, control: Controller, controller_state_count: int):
        self._compiled_stepper: RungeKuttaStepper | None = None
        compiled = not isinstance(control, ValveDrive) and chart.dynamics.backend == "compiled"
        if (
            compiled
            and chart.machine.has_traceable_forces
            and isinstance(control, TracedController)
        ):
            with suppress(FormulaTooLongError):
                self._compiled_stepper = RungeKuttaStepper(chart, control, controller_state_count)
        super().__init__(chart, control, controller_state_count, self._compiled_stepper)
        self._next_time = 0.0

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: StepProgress = None
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
        first = times[0] if len(times) else self._next_time
        self.done = self.next_instant = 0
        self._prepare_modes(first + self.offset, state)
        while self.done < len(times) or self.offset < 0:
            now = first + step * self.next_instant
            if self.offset < 0:
                self._advance_to_instant(now, state, step)
                continue
            if not self._make_steps(times, state, step, rows):
                break
            if progress is not None:
                progress(self.done)
        self._next_time = first + step * self.next_instant
        return self.next_instant

    def _make_steps(self, times: Array, state: Array, step: float, rows: Array) -> bool:
        """Make some steps, or go on to where a joint starts or stops.

        Returns:
            False where other coordinates are better.
        """
        size, i = len(state), self.done
        chunk_end, event = min(i + _STEPS_PER_REPORT, len(times)), 0.0
        if self._compiled_stepper is not None:
            i += self._compiled_stepper.run(times[i:chunk_end], state, step, rows[i:])
            self.done = self.next_instant = i
            event = self._compiled_stepper.event
        if i < chunk_end and not event:  # it stopped, or there is none
            if self.python_stepper.exceeds_chart_limits(state):
                return False
            rate, seen = self.python_stepper.observe(times[i], state)
            if self.python_stepper.transition_margin < -EVENT_TOLERANCE:
                event = step
            else:
                rows[i, :size], rows[i, size:] = state, seen
                self.done = i + 1
                state[:] = self.python_stepper.advance(times[i], state, rate, step)
                i = self.next_instant = i + 1
        if not event and i == len(times) and self._stick_slip.columns:  # nobody looks behind it
            event = step * (
                self._outputs_and_margin(times[-1] + step, state)[1] < -EVENT_TOLERANCE
            )
        if event and i:
            state[:] = rows[i - 1, :size]
            event_time_offset = self._advance_to_transition(times[i - 1], state, event, step)
            self.offset = self._rounded_offset(event_time_offset - step, step)
        elif event:
            self._find_modes(times[0], state)
        return True

    def _make_step(self, time: float, state: Array, length: float) -> tuple[Array, float]:
        """See `StickSlipIntegrator._make_step`."""
        if self._compiled_stepper is not None:
            after, row = state.copy(), np.empty((1, self._compiled_stepper.row_size))
            if self._compiled_stepper.run(np.array([time]), after, length, row):
                return after, self._compiled_stepper.observe(time + length, after)[1]
        rate, _ = self.python_stepper.observe(time, state)
        after = self.python_stepper.advance(time, state, rate, length)
        self.python_stepper.observe(time + length, after)
        return after, self.python_stepper.transition_margin

    def find_finer_step(self, times: Array, rows: Array, step: float) -> float:
        """See `StickSlipIntegrator.find_finer_step`."""
        done_before = self.done
        first_repeated, last_repeated = (
            max(0, done_before - _STEPS_BEFORE_HALT),
            min(done_before + _STEPS_AFTER_HALT, len(times)),
        )
        self._max_transitions = _MAX_TRANSITIONS_IN_FINER_STEP
        for share in _REFINEMENT_FACTORS:
            finer_step = step / share
            repeated_times = times[first_repeated] + finer_step * np.arange(
                share * (last_repeated - first_repeated)
            )
            state = rows[first_repeated, : self.python_stepper.state_layout.size].copy()
            self.offset, self._stick_slip.has_modes = 0.0, False
            with suppress(IntegrationHaltError):
                steps_made = self.run(
                    repeated_times,
                    state,
                    finer_step,
                    np.empty((len(repeated_times), rows.shape[1])),
                )
                if steps_made == len(repeated_times):
                    self.python_stepper.observe(repeated_times[-1] + finer_step, state)
                    self.done = done_before
                    return finer_step
        self.done = done_before
        return 0.0
