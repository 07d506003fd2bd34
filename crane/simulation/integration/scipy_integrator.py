"""Integration by the methods of scipy with step-size control."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.integrators import StickSlipIntegrator
from crane.simulation.integration.python_stepper import IntegrationHaltError, StepProgress
from crane.simulation.integration.stick_slip_modes import EVENT_TOLERANCE, locate_event

# limit of passive velocities [coordinate units per characteristic time]: they are infinite at the
# end of a branch
_MAX_PASSIVE_VELOCITY = 300.0
SCIPY_TOLERANCE = 1e-9  # error of a step, relative to the size of the state
# length of a rotation vector [rad] at which it is limited to pi and the method starts anew; their
# rates are infinite at 2 pi
_MAX_ROTATION = 1.25 * np.pi
_ABSOLUTE_TOLERANCE_SHARE = 1e-2  # absolute over relative tolerance, in coordinate or SI units
SCIPY_METHODS = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")


class ScipyIntegrator(StickSlipIntegrator):
    """A method of scipy with dense output; loops are closed at the recorded instants.

    Args:
        chart: The machine in a chart.
        method: One of `SCIPY_METHODS`.
        tolerance: Error of a step, relative to the size of the state.
    """

    def __init__(self, chart: Chart, method: str, tolerance: float = SCIPY_TOLERANCE):
        self._tolerance = tolerance
        super().__init__(chart, None)
        self._chart, self._closure, self._method = chart, chart.machine.closure, method

    _max_transitions = 200  # each restarts the method

    def _advance(
        self,
        first: float,
        times: Array,
        state: Array,
        step: float,
        rows: Array,
        progress: StepProgress,
    ) -> bool:
        """See `StickSlipIntegrator._advance`; integrates to the last instant if there is no event.

        Raises:
            IntegrationHaltError: The method fails, or the loops do not close.
        """
        from scipy import integrate

        closure, end = self._closure, first + step * len(times)
        instants = np.append(times, end)
        start_time = instants[self.next_instant] + self.offset
        units, coordinates, view = (
            closure.units,
            self._chart.machine.coordinates,
            self.python_stepper.state_layout.view,
        )

        def rate(time: float, state: Array) -> Array:
            closed = state.copy()  # gamma is valid at closed configurations alone
            q = view(closed).q
            with suppress(ClosureError):  # of a trial state beyond the branch
                q[:] = coordinates.unwrap_rotations(closure.solve(q[closure.active]), q)
            return self.python_stepper.state_rate(time, closed)[0]

        absolute_tolerances = np.full(len(state), _ABSOLUTE_TOLERANCE_SHARE * self._tolerance)
        view(absolute_tolerances).q[:] *= units
        view(absolute_tolerances).v_a[:] *= units[closure.active] / closure.characteristic_time
        method: Any = getattr(integrate, self._method)
        solver = method(
            rate, start_time, state.copy(), end, rtol=self._tolerance, atol=absolute_tolerances
        )
        rate(start_time, state)  # the last evaluation of the solver may be at another state
        before = self.python_stepper.transition_margin
        while solver.status == "running":
            with np.errstate(all="ignore"):  # the method fails by itself where a trial diverges
                message = solver.step()
            if message is not None:
                raise IntegrationHaltError(
                    float(solver.t),
                    self.python_stepper.user_coordinates(solver.y),
                    f" {self._method} gives up: {message.rstrip('.').lower()}",
                    ", try another method",
                )
            self._check_passive_velocities(solver.t, solver.y)
            dense_output, start = solver.dense_output(), float(solver.t_old)

            def trial(part: float, within: Any = dense_output, start: float = start) -> Any:
                displaced = within(start + part)
                rate(start + part, displaced)
                return displaced, self.python_stepper.transition_margin

            rate(solver.t, solver.y)
            after, until, event_state = (
                self.python_stepper.transition_margin,
                float(solver.t),
                None,
            )
            if after < -EVENT_TOLERANCE and self._stick_slip.columns:
                later, event_state = locate_event(trial, before, until - start, after)
                until = start + later
            self._record(instants, until, dense_output, state, rows)
            progress(self.next_instant)
            if event_state is None and self._has_long_rotation(solver.y):
                event_state = solver.y
            if event_state is not None:
                state[:] = event_state
                self._count_transition(until, state, step)
                self.python_stepper.close_loops(until, state)
                self._find_modes(until, state)
                self.next_instant = self.done
                self.offset = until - instants[self.next_instant]
                return True
            before, q = after, view(solver.y).q
            if self._chart.largest_gamma_entry(q) > self.python_stepper.chart_limits[0]:
                return False
        return True

    def _has_long_rotation(self, state: Array) -> bool:
        """Whether a rotation vector has to be limited to pi."""
        q = self.python_stepper.state_layout.view(state).q
        columns = self._chart.machine.coordinates.rotation_columns
        return any(np.linalg.norm(q[i : i + 3]) > _MAX_ROTATION for i in columns)

    def _check_passive_velocities(self, time: float, state: Array) -> None:
        """Check the velocities of the passive joints.

        Raises:
            IntegrationHaltError: One is too large.
        """
        closure, at = self._closure, self.python_stepper.state_layout.view(state)
        speed = np.inf
        with suppress(ClosureError):
            rates = closure.gamma(at.q)[closure.passive] @ at.v_a / closure.units[closure.passive]
            speed = float(np.abs(rates).max(initial=0.0))
        limit = _MAX_PASSIVE_VELOCITY / closure.characteristic_time
        if not np.any(self._chart.machine.model.gravity.linear):
            limit *= 10.0  # that time is of a fall; a small mechanism may be faster
        if not speed < limit:
            length = closure.characteristic_length
            raise IntegrationHaltError(
                time,
                self.python_stepper.user_coordinates(state),
                f" the motion explodes (a passive joint exceeds {limit:.3g} rad/s or "
                f"{limit * length:.3g} m/s)",
                ": look at its forces and gains",
            )

    def _record(
        self,
        instants: Array,
        end_time: float,
        dense_output: Callable[[float], Array],
        state: Array,
        rows: Array,
    ) -> None:
        """Fill the rows of the instants up to a time [s]; sets the state to that at the last."""
        for k in range(self.done, len(instants)):
            time = instants[k]
            if time > end_time:
                break
            sample = dense_output(time)
            self.python_stepper.close_loops(time, sample)
            state[:] = sample
            self.next_instant, self.offset = k, 0.0
            if k < len(rows):
                rows[k] = [*sample, *self.python_stepper.observe(time, sample)[1]]
                self.done = k + 1
