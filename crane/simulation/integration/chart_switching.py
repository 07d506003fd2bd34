"""Integration through dead centres and branch crossings by a change of the chart."""

from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np

from crane.closure.coordinates import Indices
from crane.codegen import Tape
from crane.common.errors import InputError
from crane.common.progress import ignore_progress
from crane.common.samples import Array
from crane.control.control_law import ControlLaw
from crane.control.valve_drive import ValveDrive
from crane.simulation.integration.charts import (
    MAX_MOTION_PER_STEP,
    MAX_RELATIVE_RANK,
    MIN_IMPROVEMENT,
    NODES_BEFORE,
    STEPS_BEFORE,
    STEPS_BEHIND,
    Chart,
    CrossingPolynomial,
    correct_polynomial,
    extrapolate_states,
    relative_rank,
)
from crane.simulation.integration.integrators import StickSlipIntegrator
from crane.simulation.integration.machine_formulas import raise_undetermined, trace_law
from crane.simulation.integration.python_stepper import IntegrationHaltError, StepProgress

_NEARLY_SINGULAR_MARGIN = 1e5  # on the inertia that counts as none, of what explains a halt
_LIMIT_RELAXATION = np.array([2.0, 0.1])  # factors of the limits where no chart is better
_MAX_RECENT_STATES = 500
_MAX_LISTED = 4  # times in a note
_MOTION_BACK = 1e-3  # of the fastest joint, coordinate units: difference of determinants
_REPEATED_STEPS = 4 * (NODES_BEFORE + STEPS_BEFORE)  # at least, before a crossing
_MAX_SHARE = 2  # of steps that locate a crossing in an interval of outputs
_CONFIGURATION_TOLERANCE = 1e-6  # between predicted and closed configuration, coordinate units
# least ratios of condition numbers: at a dead centre, and of a chart that is tried after a halt
_DEAD_CENTRE_IMPROVEMENT, _HALT_IMPROVEMENT = 10.0, 1.5


class RunNotes:
    """Notes about a run; those of equal words are one, with their times and their number."""

    def __init__(self) -> None:
        self._times: dict[tuple[str, str], list[float]] = {}

    def add(self, time: float, before: str, after: str) -> None:
        """Note what happens at a time [s], which stands between two parts of the text."""
        self._times.setdefault((before, after), []).append(time)

    def __iter__(self) -> Iterator[str]:
        """The texts, in the order in which they were first noted."""
        for (before, after), times in self._times.items():
            yield f"{before}{_format_times(times)}{after}"


def _format_times(times: list[float]) -> str:
    """Text such as "at t = 1.2 s", or "at t = 1.2, 2.4, ..., 9.6 s (8 times)"."""
    listed = [f"{time:.4g}" for time in times]
    if len(listed) > _MAX_LISTED:
        listed = [*listed[: _MAX_LISTED - 1], "...", listed[-1]]
    count = f" ({len(times)} times)" if len(times) > 1 else ""
    return f"at t = {', '.join(listed)} s{count}"


class ChartSwitchingIntegrator:
    """Integrator in the coordinates of the user, and in other charts near their dead centres.

    Rows are in the coordinates of the user: velocities are C v_B, and friction is C^-T times that
    of the chart, see `crane.simulation.integration.charts`.

    Args:
        chart: The machine in the coordinates of the user.
        make_integrator: Creates the integrator of a chart.

    Attributes:
        done: Number of instants with a row, after a run or a halt.
        notes: Notes for the user about the motion.
    """

    def __init__(self, chart: Chart, make_integrator: Callable[[Chart], StickSlipIntegrator]):
        self._make_integrator = make_integrator
        self._chart, self._integrator = chart, make_integrator(chart)
        self._chart_limits = chart.chart_limits
        self._known_integrators = [(chart, self._integrator)]
        self._row_layout = chart.row_layout
        self._segment_start = self.done = 0
        self._recent_states = np.zeros((0, chart.state_layout.size))
        self.notes = RunNotes()
        self._orientation, self._has_passed_dead_centre = 1.0, False

    def run(
        self, times: Array, state: Array, step: float, rows: Array, progress: StepProgress
    ) -> None:
        """Integrate from each time to the next; see `StickSlipIntegrator.run` for arguments.

        Raises:
            IntegrationHaltError: The integration halts in all charts.
        """
        i = self.done = 0
        while i < len(times) or self._integrator.offset < 0:
            self._segment_start, halt = i, None
            steps_made = self._integrator.done = 0
            try:
                steps_made = self._integrator.run(
                    times[i:], state, step, rows[i:], self._progress_from(i, progress)
                )
            except IntegrationHaltError as error:
                steps_made, halt = self._integrator.next_instant, error
            finally:  # also after an interrupt
                self.done = i + self._integrator.done
                first_recent = i + max(steps_made - _MAX_RECENT_STATES, 0)
                recent_states = np.vstack(
                    [self._recent_states, rows[first_recent : i + steps_made, : len(state)]]
                )
                self._recent_states = recent_states[-_MAX_RECENT_STATES:]
                self._to_user_coordinates(times[i : self.done], rows[i : self.done])
            i += steps_made
            if i == len(times) and not self._integrator.offset < 0:
                continue
            if self._switch_chart(times[0] + i * step, state, halt):
                continue
            next_index = self._repeat_intervals(times, i, state, step, rows)
            if next_index is None:
                next_index = self._pass_branch_crossing(times, i, state, step, rows)
            if next_index is None and halt is not None:
                raise self._explain_by_mass_matrix(times[0] + i * step, state) or halt.explained()
            if next_index is not None:
                i = next_index
            else:
                self._chart_limits = self._chart_limits * _LIMIT_RELAXATION
                self._integrator.set_chart_limits(self._chart_limits)

    def final_row(self, time: float, state: Array) -> Array:
        """See `StickSlipIntegrator.final_row`."""
        row = self._integrator.final_row(time, state)
        self._to_user_coordinates(np.array([time]), row[None])
        return row

    def find_finer_step(self, times: Array, rows: Array, step: float) -> float:
        """See `StickSlipIntegrator.find_finer_step`."""
        if not self._chart.has_user_coordinates:
            return 0.0
        return self._integrator.find_finer_step(
            times[self._segment_start :], rows[self._segment_start :], step
        )

    def _progress_from(self, first: int, progress: StepProgress) -> StepProgress:
        return lambda done: progress(first + done)

    def _switch_chart(self, time: float, state: Array, halt: IntegrationHaltError | None) -> bool:
        """Change to a better chart and transform the state; returns whether there is one."""
        at = self._chart.state_layout.view(state.copy())  # a chart keeps its configuration
        chart, nq = self._chart, self._chart.machine.model.nv
        better_chart = chart.find_better_chart(
            at.q, MIN_IMPROVEMENT if halt is None else _HALT_IMPROVEMENT
        )
        if better_chart is None:
            return False
        if self._uses_inverse_dynamics:
            if (
                halt is not None
                and chart.find_better_chart(at.q, _DEAD_CENTRE_IMPROVEMENT) is not None
            ):
                names = _joints_left(chart, better_chart)
                raise IntegrationHaltError(
                    time,
                    at.q[chart.user_columns],
                    f": {'joints' if len(names) > 1 else 'joint'} {' and '.join(names)} at a dead "
                    "centre, where inverse dynamics is undefined",
                    ": keep the reference away from there, or drive other joints",
                )
            return False
        orientation = self._orientation * self._orientation_at(at.q)
        self._enter_chart(self._find_integrator(better_chart, at.q), self._integrator.offset)
        self._orientation = orientation * self._orientation_at(at.q)
        states = np.vstack([self._recent_states, state])
        rows = chart.machine.closure.gamma(states[:, :nq])[:, self._chart.machine.closure.active]
        velocities = slice(nq, nq + len(chart.user_columns))
        states[:, velocities] = np.einsum("nij,nj->ni", rows, states[:, velocities])
        state[:], self._recent_states = states[-1], states[:-1]
        return True

    def _explain_by_mass_matrix(self, time: float, state: Array) -> IntegrationHaltError | None:
        """The halt where the mass matrix of the user is (nearly) singular, else None."""
        q = self._chart.state_layout.view(state).q
        chart = self._known_integrators[0][0]
        error = chart.dynamics.singular_mass_error(q, margin=_NEARLY_SINGULAR_MARGIN)
        if error is None:
            return None
        return IntegrationHaltError(time, q[chart.user_columns], f": {error}", "")

    def _pass_branch_crossing(
        self, times: Array, i: int, state: Array, step: float, rows: Array
    ) -> int | None:
        """Pass a branch crossing, if there is one ahead.

        Args:
            times: See `run`.
            i: Index of the first instant not before the state.
            state: Replaced by the state at the returned instant.
            step: [s].
            rows: See `run`.

        Returns:
            Index of the first instant behind the crossing; None without a crossing.
        """
        integrator, recent = self._integrator, self._recent_states
        now = times[0] + i * step + integrator.offset
        prediction = self._predict_crossing(state)
        if prediction is None or np.prod(prediction) >= 3.0 * MAX_MOTION_PER_STEP:
            return None
        crossing, speed = now + prediction[0], prediction[1]
        share = int(np.ceil(step * speed / MAX_MOTION_PER_STEP))
        stride = int(np.ceil(MAX_MOTION_PER_STEP / (step * speed)))
        stride = max(1, min(stride, len(recent) // (NODES_BEFORE + STEPS_BEFORE)))
        fine_step = step / share
        last_node_time = crossing - STEPS_BEFORE * stride * fine_step
        first = int((last_node_time - NODES_BEFORE * stride * fine_step - times[0]) // step)
        if not i - len(recent) <= first < i:
            return None
        # repeat the motion up to nodes at a sufficient distance from the crossing
        saved_state, offset = state.copy(), integrator.offset
        state[:], integrator.offset = recent[first - i], 0.0
        integrator.set_chart_limits(np.array([np.inf, -np.inf]))
        instants = np.arange(times[first], last_node_time, fine_step)
        fine_rows = np.empty((len(instants), rows.shape[1]))
        steps_made = 0
        with suppress(IntegrationHaltError):
            steps_made = integrator.run(instants, state, fine_step, fine_rows)
        integrator.set_chart_limits(self._chart_limits)
        behind_time = float(crossing + STEPS_BEHIND * stride * fine_step)
        if steps_made == len(instants):
            nodes = slice(len(instants) - 1 - (NODES_BEFORE - 1) * stride, None, stride)
            path = extrapolate_states(
                instants[nodes], fine_rows[nodes, : len(state)], integrator.rate_and_outputs
            )
            q = self._chart.state_layout.view(path.states(np.array([behind_time]))[0]).q
            behind = self._chart_behind_crossing(q)
            if behind is not None:
                self._enter_chart(behind, 0.0)
                path = correct_polynomial(path, behind_time, self._integrator.rate_and_outputs)
                return self._record_crossing(
                    path, behind_time, fine_step, times, state, step, rows
                )
        state[:], integrator.offset = saved_state, offset
        return None

    def _repeat_intervals(
        self, times: Array, i: int, state: Array, step: float, rows: Array
    ) -> int | None:
        """Repeat the last intervals with instants close enough to locate a branch crossing.

        They go on for an interval, so that none ends within a crossing.

        Args:
            times: See `run`.
            i: Index of the first instant not before the state.
            state: Replaced by the state at the returned instant.
            step: [s].
            rows: See `run`.

        Returns:
            Index of the next instant; None where there is no crossing ahead, instants are close
            already, or those before are unknown.
        """
        prediction = self._predict_crossing(state)
        if prediction is None or prediction[0] > 2.0 * step or not len(self._recent_states):
            return None
        share = int(np.ceil(step * prediction[1] / MAX_MOTION_PER_STEP))
        if share <= _MAX_SHARE:
            return None
        needed = int(np.ceil(_REPEATED_STEPS / share))
        before = min(max(needed, 2), len(self._recent_states))
        state[:], self._integrator.offset = self._recent_states[-before], 0.0
        end = min(i + 1, len(times))
        fine_step, count = step / share, (end - i + before) * share
        instants = times[0] + (i - before) * step + fine_step * np.arange(count)
        fine_rows = np.empty((count, rows.shape[1]))
        self._recent_states = self._recent_states[:0]
        try:
            self.run(instants, state, fine_step, fine_rows, ignore_progress)
        finally:
            self.done = self._segment_start = i
        rows[i:end] = fine_rows[before * share :: share]
        self.done = end
        # of the close instants only the last that is an output
        known = len(self._recent_states) // share
        self._recent_states = self._recent_states[-share:][: min(known, 1)]
        return end

    def _predict_crossing(self, state: Array) -> tuple[float, float] | None:
        """Time from a state to a branch crossing ahead, and speed of the fastest joint; else None.

        By the least determinant of the loops at the state and a little before.
        """
        chart, closure = self._chart, self._chart.machine.closure
        if not (closure.is_compiled and np.isfinite(state).all()):
            return None
        at = chart.state_layout.view(state)
        v = closure.gamma(at.q) @ at.v_a
        speed = float(np.abs(v / closure.units).max())
        if not speed:
            return None
        time_back = _MOTION_BACK / speed
        determinant, determinant_before = (
            closure.compiled_closure.least_determinant(q) for q in (at.q, at.q - time_back * v)
        )
        if not 0.0 < determinant < determinant_before:
            return None
        time = determinant / (determinant_before - determinant) * time_back
        home = self._known_integrators[0][0].machine
        least_rank = MAX_RELATIVE_RANK * relative_rank(home, home.home)
        is_singular = relative_rank(chart.machine, at.q + time * v) < least_rank
        return (time, speed) if is_singular else None

    def _record_crossing(
        self,
        path: CrossingPolynomial,
        behind_time: float,
        fine_step: float,
        times: Array,
        state: Array,
        step: float,
        rows: Array,
    ) -> int:
        """Record a path across a crossing, and integrate to the first instant behind it.

        Raises:
            IntegrationHaltError: The integration halts behind the crossing.
        """
        first = int(np.searchsorted(times, path.times[path.nodes_before - 1], side="right"))
        i = int(np.searchsorted(times, behind_time))
        rows[first:i] = path.rows(times[first:i])
        self.done = i
        self._to_user_coordinates(times[first:i], rows[first:i])
        self._recent_states = self._recent_states[:0]
        next_time = times[0] + i * step
        state[:] = path.states(np.array([min(behind_time, next_time)]))[0]
        if next_time - behind_time > 1e-6 * fine_step:
            part = (next_time - behind_time) / np.ceil((next_time - behind_time) / fine_step)
            instants = np.arange(behind_time, next_time - 0.5 * part, part)
            self._integrator.run(instants, state, part, np.empty((len(instants), rows.shape[1])))
            if self._integrator.offset < 0:
                raise self._integrator.python_stepper.halt_error(behind_time, state)
        self.notes.add(
            behind_time,
            "",
            " the linkage passes a configuration from which it could go on in several ways: it "
            "goes on as it moves",
        )
        return i

    def _enter_chart(self, known: tuple[Chart, StickSlipIntegrator], offset: float) -> None:
        """Continue in a chart, at an offset after the next instant [s]."""
        self._chart, self._integrator = known
        self._chart_limits, self._integrator.offset = self._chart.chart_limits, offset
        self._integrator.set_chart_limits(self._chart_limits)

    def _chart_behind_crossing(self, q: Array) -> tuple[Chart, StickSlipIntegrator] | None:
        """A chart of the same coordinates at a predicted configuration (nq,), and its integrator.

        None if it is singular there, or if the prediction is not closed.
        """
        closure = self._chart.machine.closure
        known = self._known_integrator(closure.active, q)
        chart = known[0] if known else self._chart.chart_with_columns(q, closure.active)
        if chart is None:
            return None
        closed = chart.machine.home
        if known is not None:
            closed = chart.machine.closure.solve(q[closure.active], initial_guess=q)
        if np.abs((closed - q) / closure.units).max() >= _CONFIGURATION_TOLERANCE:
            return None
        return known or self._find_integrator(chart, q)

    def _find_integrator(self, chart: Chart, q: Array) -> tuple[Chart, StickSlipIntegrator]:
        """A known chart of the same coordinates and branch with its integrator, or this one."""
        known = self._known_integrator(chart.machine.closure.active, q)
        if known is None:
            known = chart, self._make_integrator(chart)
            self._known_integrators.append(known)
        return known

    def _known_integrator(
        self, active: Indices, q: Array
    ) -> tuple[Chart, StickSlipIntegrator] | None:
        """A known chart of some coordinates, on whose branch a configuration (nq,) lies."""
        for known in self._known_integrators:
            closure = known[0].machine.closure
            if np.array_equal(closure.active, active) and closure.is_on_branch(q):
                return known
        return None

    def _orientation_at(self, q: Array) -> float:
        """Sign of det C at a closed configuration (nq,); it changes at dead centres."""
        return (
            1.0
            if self._chart.has_user_coordinates
            else float(np.linalg.slogdet(self._chart.velocity_map(q))[0])
        )

    def _to_user_coordinates(self, times: Array, rows: Array) -> None:
        """Transform rows (N, .) at times (N,) [s] into the coordinates of the user."""
        chart = self._chart
        if chart.has_user_coordinates or not len(rows):
            return
        at = self._row_layout.view(rows)
        velocity_maps = chart.velocity_map(at.q)
        behind_indices = np.flatnonzero(
            self._orientation * np.linalg.slogdet(velocity_maps)[0] < 0
        )
        if len(behind_indices) and not self._has_passed_dead_centre:
            self._has_passed_dead_centre = True
            names = _joints_left(self._known_integrators[0][0], chart)
            self.notes.add(
                float(times[behind_indices[0]]),
                f"{' and '.join(names)} {'pass' if len(names) > 1 else 'passes'} a dead centre ",
                ": from there on active coordinates alone do not determine the configuration, "
                "take passive joints with them",
            )
        at.v_a[:] = np.einsum("nij,nj->ni", velocity_maps, at.v_a)
        if at.friction.any():
            inverses = np.linalg.pinv(np.swapaxes(velocity_maps, 1, 2))
            at.friction[:] = np.einsum("nij,nj->ni", inverses, at.friction)

    @property
    def _uses_inverse_dynamics(self) -> bool:
        """Whether the controller uses inverse dynamics or gravity in coordinates of the user."""
        control = self._chart.control
        if isinstance(control, ValveDrive) or not isinstance(control, ControlLaw):
            return False
        try:
            trace_law(self._chart, Tape(), (raise_undetermined, raise_undetermined))
        except InputError:
            return True
        return False


def _joints_left(chart: Chart, better_chart: Chart) -> list[str]:
    """Names in quotes of the independent coordinates of a chart that are not those of another."""
    left = np.setdiff1d(chart.machine.closure.active, better_chart.machine.closure.active)
    return [f"'{chart.machine.joints[i]}'" for i in left]
