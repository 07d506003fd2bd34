"""Integrators in one chart that locate stick-slip transitions, with fixed or controlled steps."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import numpy as np

from crane.codegen import FormulaTooLongError
from crane.common.errors import ClosureError, InputError
from crane.common.progress import ignore_progress
from crane.common.samples import Array
from crane.control.control_law import ControlLaw
from crane.control.valve_drive import ValveDrive
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import (
    MAX_REFERENCE_SPACING,
    ErrorControlledStepper,
)
from crane.simulation.integration.machine_code_stepper import (
    MachineCodeStepper,
    RungeKuttaStepper,
)
from crane.simulation.integration.python_stepper import (
    IntegrationHaltError,
    PythonStepper,
    StepProgress,
)
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE, locate_event

_TIME_TOLERANCE = 1e-9  # share of the output interval: difference of equal instants
_MAX_TRANSITIONS = 2000  # stick-slip transitions within an output interval


class StickSlipIntegrator(ABC):
    """Base class of integrators in one chart.

    A method implements `_advance`.

    Args:
        chart: The machine in a chart.
        compiled_method: The compiled method, or None.

    Attributes:
        python_stepper: Observes states, makes single steps, and explains halts.
        done: Number of instants with a row, after a run or a halt.
        next_instant: Index of the first instant that is not before the state.
        offset: Time of the state after the next instant without a row [s].
    """

    _max_transitions = _MAX_TRANSITIONS

    def __init__(self, chart: Chart, compiled_method: MachineCodeStepper | None):
        self.python_stepper = PythonStepper(chart)
        self.done = self.next_instant = 0
        self.offset = self._first = self._step = 0.0
        self._stick_slip, self._compiled_method = chart.stick_slip, compiled_method
        self._dynamics, self._transition_count, self._count_start_time = chart.dynamics, 0, -np.inf

    def set_chart_limits(self, limits: Array) -> None:
        """Set the limits of the chart, see `Chart.chart_limits`."""
        self.python_stepper.chart_limits = limits
        if self._compiled_method is not None:
            self._compiled_method.bounds[3:5] = limits

    def run(
        self,
        times: Array,
        state: Array,
        step: float,
        rows: Array,
        progress: StepProgress = ignore_progress,
    ) -> int:
        """Integrate from each of the times to the next, while the chart is regular.

        Args:
            times: (N,) instants [s].
            state: State at the first instant or `offset` after it, replaced by the final one.
            step: Interval of the instants [s].
            rows: (N, row size) in any memory order, filled with state and outputs.
            progress: Called with the number of finished steps.

        Returns:
            Number of steps.

        Raises:
            IntegrationHaltError: A step fails, or the loops do not close.
        """
        first = times[0] if len(times) else self._first + self._step * self.next_instant
        self._first, self._step = first, step
        self.done = self.next_instant = 0
        self._prepare_modes(first + self.offset, state)
        while self.done < len(times) or self.offset < 0:
            if not self._advance(first, times, state, step, rows, progress):
                break
            if not self.offset < -_TIME_TOLERANCE * step:  # within rounding errors
                self.offset = 0.0
            progress(self.done)
        return self.next_instant

    @abstractmethod
    def _advance(
        self,
        first: float,
        times: Array,
        state: Array,
        step: float,
        rows: Array,
        progress: StepProgress,
    ) -> bool:
        """Make some steps of a run, or integrate to a stick-slip transition.

        Args:
            first: The first instant [s].
            times: See `run`, as the others.
            state: State at `offset` after the instant `next_instant`.
            step: [s].
            rows: Rows of all instants.
            progress: Called within long calls.

        Returns:
            False where another chart is needed.
        """

    def final_row(self, time: float, state: Array) -> Array:
        """The row of a state.

        Args:
            time: [s].
            state: State at this time.

        Raises:
            IntegrationHaltError: The outputs cannot be computed.
        """
        return np.concatenate([state, self._outputs_and_margin(time, state)[0]])

    def find_finer_step(self, times: Array, rows: Array, step: float) -> float:
        """A step size [s] with which the motion continues after a halt; 0 if none is found.

        The arguments are those of the run. Methods with step-size control return 0.
        """
        return 0.0

    def _outputs_and_margin(self, time: float, state: Array) -> tuple[Array, float]:
        if self._compiled_method is not None:
            return self._compiled_method.observe(time, state)
        return self.python_stepper.observe(time, state)[1], self.python_stepper.transition_margin

    def rate_and_outputs(self, time: float, state: Array) -> tuple[Array, Array]:
        """Rate of a state at a time [s], and outputs.

        Raises:
            IntegrationHaltError: The loops do not close, or the configuration is singular.
        """
        if self._compiled_method is not None:
            rate, outputs = self._compiled_method.rate_and_outputs(time, state)
            if np.isfinite(rate).all():
                return rate, outputs
        return self.python_stepper.observe(time, state)

    def _prepare_modes(self, time: float, state: Array) -> None:
        """Set the stick-slip modes before the first step, and after a change of the chart."""
        if not self._stick_slip.columns:
            return
        if not self._stick_slip.has_modes:
            self._find_modes(time, state)
        elif self._compiled_method is None:
            self._stick_slip.apply_to(self._dynamics)
        else:
            self._compiled_method.adopt_modes()

    def _find_modes(self, time: float, state: Array) -> None:
        """Determine the stick-slip modes at a state."""
        if self._compiled_method is None:
            self.python_stepper.find_modes(time, state)
        else:
            self.python_stepper.find_modes(
                time, state, self._compiled_method.observe(time, state)[0]
            )
            self._compiled_method.note_joints_at_rest()
        self._stick_slip.record_transition(time, state)

    def _count_transition(self, time: float, state: Array, step: float) -> None:
        """Count a stick-slip transition.

        Raises:
            IntegrationHaltError: There are too many within an output interval.
        """
        if time > self._count_start_time + step:
            self._count_start_time, self._transition_count = time, 0
        self._transition_count += 1
        if self._transition_count > self._max_transitions:
            raise IntegrationHaltError(
                time,
                self.python_stepper.user_coordinates(state),
                f" joints stick and slip more than {self._max_transitions} times within "
                f"{step:g} s",
                ": forces that jump with the sign of a velocity fight their friction, smooth them",
            )


_STEPS_PER_REPORT = 1000  # between reports of progress; their rows stay in the cache
# steps before and after a halt that are repeated with finer steps
_STEPS_BEFORE_HALT, _STEPS_AFTER_HALT = 40, 20
_REFINEMENT_FACTORS = (2, 8)  # of finer steps
_MAX_TRANSITIONS_IN_FINER_STEP = 100  # a step size with more transitions is no remedy


class FixedStepIntegrator(StickSlipIntegrator):
    """Fixed steps of the classical Runge-Kutta method, compiled where possible.

    Args:
        chart: The machine in a chart.
    """

    def __init__(self, chart: Chart):
        control = chart.control
        self._compiled_stepper: RungeKuttaStepper | None = None
        compiled = not isinstance(control, ValveDrive) and chart.dynamics.backend == "compiled"
        if compiled and chart.machine.has_traceable_forces and isinstance(control, ControlLaw):
            with suppress(FormulaTooLongError):
                self._compiled_stepper = RungeKuttaStepper(chart)
        self._row_size = chart.row_layout.size
        super().__init__(chart, self._compiled_stepper)

    def _advance(
        self,
        first: float,
        times: Array,
        state: Array,
        step: float,
        rows: Array,
        progress: StepProgress,
    ) -> bool:
        if self.offset < 0:
            time = first + step * self.next_instant + self.offset
            after, margin = self._make_step(time, state, -self.offset)
            if margin >= -EVENT_TOLERANCE:
                state[:], self.offset = after, 0.0
            else:
                self.offset += self._advance_to_transition(time, state, -self.offset, step)
            return True
        size, i = len(state), self.done
        chunk_end, event = min(i + _STEPS_PER_REPORT, len(times)), 0.0
        if self._compiled_stepper is not None:
            i += self._compiled_stepper.run(times[i:chunk_end], state, step, rows[i:])
            self.done = self.next_instant = i
            event = self._compiled_stepper.event
        if i < chunk_end and not event:  # the compiled stepper stopped, or there is none
            if self.python_stepper.exceeds_chart_limits(state):
                return False
            rate, outputs = self.python_stepper.observe(times[i], state)
            if self.python_stepper.transition_margin < -EVENT_TOLERANCE:
                event = step
            else:
                rows[i, :size], rows[i, size:] = state, outputs
                self.done = i + 1
                state[:] = self.python_stepper.advance(times[i], state, rate, step)
                i = self.next_instant = i + 1
        if not event and i == len(times) and self._stick_slip.columns:  # no step follows
            event = step * (
                self._outputs_and_margin(times[-1] + step, state)[1] < -EVENT_TOLERANCE
            )
        if event and i:
            state[:] = rows[i - 1, :size]
            self.offset = self._advance_to_transition(times[i - 1], state, event, step) - step
        elif event:
            self._find_modes(times[0], state)
        return True

    def _advance_to_transition(
        self, time: float, state: Array, length: float, step: float
    ) -> float:
        """Integrate to a stick-slip transition within a step.

        Args:
            time: [s].
            state: State at this time, replaced by that at the transition with the new modes.
            length: Step size [s].
            step: Output interval [s].

        Returns:
            Time from the start of the step to the transition [s].

        Raises:
            IntegrationHaltError: There are too many transitions.
        """
        self._count_transition(time, state, step)
        margin_before, (_, margin_behind) = (
            self._outputs_and_margin(time, state)[1],
            self._make_step(time, state, length),
        )
        if margin_before < -EVENT_TOLERANCE:
            time_offset = 0.0
        else:
            time_offset, state[:] = locate_event(
                lambda part: self._make_step(time, state, part),
                margin_before,
                length,
                margin_behind,
            )
        self._find_modes(time + time_offset, state)
        return time_offset

    def _make_step(self, time: float, state: Array, length: float) -> tuple[Array, float]:
        """State and margin after one step of a given size."""
        if self._compiled_stepper is not None:
            after, row = state.copy(), np.empty((1, self._row_size))
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


_INSTANTS_PER_REPORT = 1000  # between reports of progress


class ErrorControlledIntegrator(StickSlipIntegrator):
    """Compiled method with step-size control, with a sampled control law where there is one.

    Args:
        chart: The machine in a chart.
        stepper_factory: Creates the compiled method.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """

    def __init__(self, chart: Chart, stepper_factory: Callable[[Chart], ErrorControlledStepper]):
        self._stepper = stepper_factory(chart)
        super().__init__(chart, self._stepper)
        self._chart, self._period_in_steps, self._last_sample = chart, 0, -np.inf
        self._sampled_law = chart.control if chart.control.period else None

    def run(
        self,
        times: Array,
        state: Array,
        step: float,
        rows: Array,
        progress: StepProgress = ignore_progress,
    ) -> int:
        """See `StickSlipIntegrator.run`.

        Raises:
            InputError: The period of the control law is no whole number of steps.
            IntegrationHaltError: A step fails.
        """
        if self._sampled_law is not None:
            period_time = self._sampled_law.period
            self._period_in_steps = round(period_time / step)
            if abs(self._period_in_steps * step - period_time) > _TIME_TOLERANCE * period_time:
                raise InputError(
                    f"the period {period_time:g} s of the sampled program is no whole number of "
                    f"steps of {step:g} s, change one"
                )
        self._last_sample = -np.inf
        self._stepper.restart()
        return super().run(times, state, step, rows, progress)

    def _advance(
        self,
        first: float,
        times: Array,
        state: Array,
        step: float,
        rows: Array,
        progress: StepProgress,
    ) -> bool:
        now = first + step * self.done
        chunk = rows[self.done : min(self.done + _INSTANTS_PER_REPORT, len(times))]
        if self._sampled_law is not None:
            since = round(now / step) % self._period_in_steps
            chunk = chunk[: 0 if self.offset < 0 else self._period_in_steps - since]
            at = self.python_stepper.state_layout.view(state)
            try:
                if not since and not self.offset < 0 and now > self._last_sample:
                    self._last_sample = now
                    v_a = self._chart.user_velocities(at.q, at.v_a)
                    self._sampled_law.update(now, at.q, v_a, at.controller)
            except ClosureError as error:
                raise IntegrationHaltError(
                    now, self.python_stepper.user_coordinates(state), f": {error}"
                ) from None
        count, self.offset = self._stepper.run(now, state, self.offset, step, chunk)
        self.done = self.next_instant = self.done + count
        time = first + step * self.done + self.offset
        if self._stepper.event:
            self._count_transition(time, state, step)
            # references are those after a jump, as for steps that start there
            self._find_modes(time + (_TIME_TOLERANCE * min(step, MAX_REFERENCE_SPACING)), state)
        elif count < len(chunk) or self.offset < 0:
            if not self.python_stepper.exceeds_chart_limits(state):
                raise IntegrationHaltError(
                    time,
                    self.python_stepper.user_coordinates(state),
                    "",
                    explain=partial(self.python_stepper.halt_error, time, state.copy()),
                )
            return False
        return True
