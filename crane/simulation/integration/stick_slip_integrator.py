"""Steps that end where a joint starts to slip or comes to rest, in any method."""

from typing import Protocol

import numpy as np

from crane.common.samples import Array
from crane.control import Controller
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.integration_halt import IntegrationHaltError
from crane.simulation.integration.python_stepper import PythonStepper
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE, locate_event

_TIME_TOLERANCE = 1e-9  # of a recorded step, between instants that are one
_MAX_TRANSITIONS = 2000  # starts and stops within a recorded step


class CompiledMethod(Protocol):
    """A method in machine code."""

    bounds: Array

    @property
    def event(self) -> float:
        """Not 0 where a joint has started or stopped."""

    def adopt_modes(self) -> None:
        """See `Stepper.adopt_modes`."""

    def observe(self, time: float, state: Array) -> tuple[Array, float]:
        """See `Stepper.observe`."""


class StickSlipIntegrator:
    """What all methods have in common.

    A method that makes steps of a given length writes `_make_step`.

    Args:
        chart: The machine.
        control: Its controller.
        controller_state_count: Number of the controller's states.
        compiled_method: The method in machine code, if it is.

    Attributes:
        python_stepper: Observes, and makes a step with care, or says why it cannot.
        done: Number of instants that have their row, after a run or where it halted.
        next_instant: The first instant that is not before the state.
        offset: When the state is, after the next instant without a row [s].
    """

    _max_transitions = _MAX_TRANSITIONS

    def __init__(
        self,
        chart: Chart,
        control: Controller,
        controller_state_count: int,
        compiled_method: CompiledMethod | None,
    ):
        self.python_stepper = PythonStepper(chart, control, controller_state_count)
        self.done = self.next_instant = 0
        self.offset = 0.0
        self._stick_slip, self._compiled_method = chart.stick_slip, compiled_method
        self._dynamics, self._transition_count, self._count_start_time = chart.dynamics, 0, -np.inf

    def set_chart_limits(self, limits: Array) -> None:
        """Look for other coordinates from there on, see `Chart.chart_limits`."""
        self.python_stepper.chart_limits = limits
        if self._compiled_method is not None:
            self._compiled_method.bounds[3:5] = limits

    def final_row(self, time: float, state: Array) -> Array:
        """A row without a step after it.

        Args:
            time: [s].
            state: There.

        Raises:
            HaltedError: It cannot be observed.
        """
        return np.concatenate([state, self._outputs_and_margin(time, state)[0]])

    def find_finer_step(self, times: Array, rows: Array, step: float) -> float:
        """A step [s] with which the motion goes on where it halted; 0 if none was found.

        Arguments as those of the run that halted. A method that chooses its steps has found none.
        """
        return 0.0

    def _make_step(self, time: float, state: Array, length: float) -> tuple[Array, float]:
        """The state after one step of some length, and the margin there.

        Not needed of methods that find events within their steps.
        """
        raise NotImplementedError

    def _outputs_and_margin(self, time: float, state: Array) -> tuple[Array, float]:
        """What is seen at a state, and its margin."""
        if self._compiled_method is not None:
            return self._compiled_method.observe(time, state)
        return self.python_stepper.observe(time, state)[1], self.python_stepper.transition_margin

    def _prepare_modes(self, time: float, state: Array) -> None:
        """Know what sticks before the first step, and in a chart that was left meanwhile."""
        if not self._stick_slip.columns:
            return
        if not self._stick_slip.has_modes:
            self._find_modes(time, state)
            return
        self._stick_slip.apply_to(self._dynamics)
        if self._compiled_method is not None:
            self._compiled_method.adopt_modes()

    def _find_modes(self, time: float, state: Array) -> None:
        """Find anew what sticks at a state."""
        if self._compiled_method is None:
            self.python_stepper.find_modes(time, state)
        else:
            self._compiled_method.adopt_modes()
            self.python_stepper.find_modes(
                time, state, self._compiled_method.observe(time, state)[0]
            )
            self._compiled_method.adopt_modes()
        self._stick_slip.record_transition(time, state)

    def _advance_to_transition(
        self, time: float, state: Array, length: float, step: float
    ) -> float:
        """Go on to where a joint starts or stops within a step.

        Args:
            time: [s].
            state: Then; replaced by that at the event, with the joints' new modes.
            length: Of the step [s].
            step: Between instants [s].

        Returns:
            How much later that is [s].

        Raises:
            HaltedError: Joints start and stop without end.
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

    def _count_transition(self, time: float, state: Array, step: float) -> None:
        """Count a joint that starts or stops.

        Raises:
            HaltedError: Joints start and stop without end.
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

    def _rounded_offset(self, offset: float, step: float) -> float:
        """An offset, zero if it is next to nothing."""
        return offset if offset < -_TIME_TOLERANCE * step else 0.0

    def _advance_to_instant(self, now: float, state: Array, step: float) -> None:
        """Go on to the next instant, or to where a joint starts or stops before it.

        Args:
            now: The next instant [s].
            state: At `offset`.
            step: Between instants [s].
        """
        after, margin = self._make_step(now + self.offset, state, -self.offset)
        if margin >= -EVENT_TOLERANCE:
            state[:], self.offset = after, 0.0
            return
        time_offset = self._advance_to_transition(now + self.offset, state, -self.offset, step)
        self.offset = self._rounded_offset(self.offset + time_offset, step)
