"""A simulated motion, and the nodes of its variational equations."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from crane.closure.coordinates import Indices
from crane.common.errors import InputError, SimulationError
from crane.common.progress import ignore_progress
from crane.common.samples import Array
from crane.control.control_law import ControlLaw
from crane.control.valve_drive import ValveDrive
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.external_forces import state_count
from crane.simulation.integration.stick_slip_modes import StickSlipTransition
from crane.simulation.sensitivity.rate_derivatives import ForwardDerivatives
from crane.simulation.sensitivity.simulation_constants import SimulationConstants
from crane.simulation.simulation_run import integrate, integrator_factory

_STEPS_PER_SEGMENT = 400  # steps that are processed together
REFINEMENT_FACTOR, MAX_REFINEMENTS = 16, 3  # parts of a divided step, depth of divisions
_TIME_TOLERANCE = 1e-9  # share of a step: difference of equal times
_MAX_CHECKED_SAMPLES = 500  # configurations that are checked for dead centres
_EVENT_DIFFERENCE_STEP = 1e-6  # share of a step: interval of the rate of references at an event


class MotionNodes(NamedTuple):
    """Nodes of a segment of n steps: their ends and their middles.

    Attributes:
        times: (2 n + 1,) times [s].
        states: (2 n + 1, .) states.
        previous_indices: (2 n + 1,) index of the last recorded instant or middle before.
        interpolation_shares: (2 n + 1,) share of the interval to the next one.
    """

    times: Array
    states: Array
    previous_indices: Indices
    interpolation_shares: Array

    @property
    def step_sizes(self) -> Array:
        """(n,) step sizes [s]."""
        return self.times[2::2] - self.times[:-2:2]

    def interpolate(self, values: Array) -> Array:
        """Values (..., 2 n + 1, c) at the nodes, from recorded values (..., 2 N + 1, c)."""
        behind = np.minimum(self.previous_indices + 1, values.shape[-2] - 1)
        share, one = self.interpolation_shares[:, None], values[..., self.previous_indices, :]
        return np.ascontiguousarray((1.0 - share) * one + share * values[..., behind, :])


class RecordedSegment(NamedTuple):
    """Recorded steps between two instants; without steps before a transition.

    The outputs at an instant are those of the last segment that has it.

    Attributes:
        mode: Index of the last transition before.
        first_instant: Index of the first instant.
        last_instant: Index of the last instant.
    """

    mode: int
    first_instant: int
    last_instant: int


class ResimulatedSegment(NamedTuple):
    """A part of a step, which is simulated again.

    Attributes:
        mode: Index of the last transition before.
        state: State at the start.
        start_time: [s].
        end_time: [s].
        end_state: State at the end.
    """

    mode: int
    state: Array
    start_time: float
    end_time: float
    end_state: Array


class TransitionJump(NamedTuple):
    """The jump of the sensitivities at a stick-slip transition.

    Attributes:
        mode: Index of the transition before.
        transition: The transition.
    """

    mode: int
    transition: StickSlipTransition


class SimulatedMotion:
    """A simulated motion with states at the ends and middles of its steps.

    Args:
        dynamics: Dynamics of the machine.
        control: Its controller.
        initial: Initial q_A and v_A.
        step_count: Number of output intervals.
        step: Output interval [s].
        method: See `simulate`.
        tolerance: See `simulate`.
        progress: See `simulate`.

    Attributes:
        chart: The machine in a chart.
        stiff_state_count: Number of the first ones, on which the rates depend.
        time: (2 N + 1,) instants and the middles between them [s].
        rows: (2 N + 1, .) rows at these times, see `integrate`.
        parts: Parts of the rows at the instants.
        notes: Notes for the user about the motion.
        largest_states: (m,) largest values of the minimal state, at least in coordinate units; 1
            for states that are always 0.
        transitions: Stick-slip transitions, with the start as the first.
        has_joints_at_rest: Whether a joint is at rest.

    Raises:
        InputError: The machine has no formulas.
        SimulationError: The motion reaches a dead centre; else as `simulate`.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        control: ControlLaw,
        initial: tuple[Array, Array],
        step_count: int,
        step: float,
        method: str | None = None,
        tolerance: float | None = None,
        progress: Callable[[float], None] = ignore_progress,
    ):
        machine = dynamics.machine
        self._step, self.has_joints_at_rest = step, False
        if dynamics.backend != "compiled" or not machine.has_traceable_forces:
            raise InputError(
                f"'{machine.name}' with its controller has no formulas to differentiate: lock "
                "joints, or write the controller as a Law, and loads as ExternalForce"
            )
        if state_count(machine.external_forces):
            raise InputError(
                f"'{machine.name}' has contacts that give way along the ground, sensitivities "
                "are of those without lateral stiffness"
            )
        made = (dynamics, control, initial, 2 * step_count, 0.5 * step, method)
        run = integrate(*made, progress, tolerance, records_transitions=True)
        if run.stop is not None:
            raise run.stop
        time, parts, self.notes = run.time, run.rows, run.notes
        self.time, self.chart = time, run.chart
        stride = max(1, len(time) // _MAX_CHECKED_SAMPLES)
        # another chart would be sought earlier, but only a dead centre prevents derivatives
        limits = np.array([5.0, 0.1]) * self.chart.chart_limits
        for at, configuration in zip(time[::stride], parts.q[::stride], strict=True):
            if self.chart.largest_gamma_entry(configuration) > limits[0]:
                raise SimulationError(
                    f"at t = {at:.4g} s the active coordinates come near a dead centre, where "
                    "nothing depends on them smoothly: drive other joints, or end before"
                )
        self.stiff_state_count = (
            control.circuit.stiff_state_count
            if isinstance(control, ValveDrive)
            else self.chart.controller_state_count
        )
        layout = self.chart.row_layout
        self.rows = np.hstack([getattr(parts, name) for name in layout.parts])
        self.parts = layout.view(self.rows[::2])
        self._states = self.rows[:, : layout.start_index("tau")]
        self._integrator = integrator_factory(self.chart, method, tolerance)(self.chart)
        self._integrator.set_chart_limits(limits)
        self.transitions = self.chart.stick_slip.transitions or []
        self.chart.stick_slip.transitions = None  # repeated parts are not recorded
        columns, closure = self.chart.user_columns, machine.closure
        minimal = np.hstack(
            [parts.q[:, columns], parts.v_a, parts.controller[:, : self.stiff_state_count]]
        )
        units = np.concatenate(
            [closure.units[columns], closure.units[columns] / closure.characteristic_time]
        )
        self.largest_states: Array = np.abs(minimal).max(axis=0)
        self.largest_states[self.largest_states == 0.0] = 1.0
        self.largest_states[: len(units)] = np.maximum(self.largest_states[: len(units)], units)

    def segments(self) -> list[RecordedSegment | ResimulatedSegment | TransitionJump]:
        """Segments of the motion in their order."""
        segments_found: list[RecordedSegment | ResimulatedSegment | TransitionJump] = []
        count, transition_index, first = len(self.time) // 2, 0, 0
        transitions = self.transitions[1:]
        while first < count:
            last = min(first + _STEPS_PER_SEGMENT, count)
            if transition_index < len(transitions):
                last = min(
                    last,
                    int(
                        (transitions[transition_index].time - self.time[0]) / self._step
                        + _TIME_TOLERANCE
                    ),
                )
            if last > first:
                segments_found.append(RecordedSegment(transition_index, first, last))
                first = last
                continue
            segments_found.append(RecordedSegment(transition_index, first, first))
            begins, ends = self.time[2 * first], self.time[2 * first + 2]
            state = self._states[2 * first]
            while (
                transition_index < len(transitions)
                and transitions[transition_index].time < ends - _TIME_TOLERANCE * self._step
            ):
                switch = transitions[transition_index]
                if switch.time - begins > _TIME_TOLERANCE * self._step:
                    segments_found.append(
                        ResimulatedSegment(
                            transition_index, state, begins, switch.time, switch.state
                        )
                    )
                    begins = switch.time
                segments_found.append(TransitionJump(transition_index, switch))
                transition_index, state = transition_index + 1, switch.state
            segments_found.append(
                ResimulatedSegment(
                    transition_index, state, begins, ends, self._states[2 * first + 2]
                )
            )
            first += 1
        return [*segments_found, RecordedSegment(transition_index, count, count)]

    def adopt_mode(self, mode: int) -> None:
        """Set the stick-slip modes after a transition; the start is the first one."""
        sticking = self.chart.stick_slip
        if self.transitions:
            switch = self.transitions[mode]
            sticking.slip_signs[:], sticking.is_held[:] = switch.slip_signs, switch.is_held
            sticking.is_moving = switch.is_moving
            sticking.apply_to(self.chart.dynamics)
            self.has_joints_at_rest = bool(switch.is_held.any())

    def recorded_nodes(self, segment: RecordedSegment) -> MotionNodes:
        """The nodes of recorded steps."""
        which = np.arange(2 * segment.first_instant, 2 * segment.last_instant + 1)
        return MotionNodes(self.time[which], self._states[which], which, np.zeros(len(which)))

    def resimulated_nodes(
        self, state: Array, start_time: float, end_time: float, end_state: Array
    ) -> MotionNodes:
        """Nodes of `REFINEMENT_FACTOR` steps between two times [s], from one state to another."""
        times = np.linspace(start_time, end_time, 2 * REFINEMENT_FACTOR + 1)
        state, sticking = state.copy(), self.chart.stick_slip
        saved_modes = sticking.slip_signs.copy(), sticking.is_held.copy(), sticking.is_moving
        rows = np.empty(
            (2 * REFINEMENT_FACTOR, len(self._integrator.final_row(start_time, state)))
        )
        self._integrator.offset = 0.0
        if self._integrator.run(times[:-1], state, times[1] - times[0], rows) < len(rows):
            raise SimulationError(
                f"at t = {start_time:.4g} s the motion jumps and cannot be followed, shorten "
                f"the step"
            )
        sticking.slip_signs[:], sticking.is_held[:], sticking.is_moving = saved_modes
        sticking.apply_to(self.chart.dynamics)
        return MotionNodes(
            times,
            np.vstack([rows[:, : len(state)], end_state]),
            *self._interpolation_positions(times),
        )

    def nodes_within_step(self, nodes: MotionNodes, step: int) -> MotionNodes:
        """Nodes within one step of others."""
        begin, end = 2 * step, 2 * step + 2
        times, states = nodes.times, nodes.states
        return self.resimulated_nodes(states[begin], times[begin], times[end], states[end])

    def nodes_at_transition(self, transition: StickSlipTransition) -> MotionNodes:
        """Three nodes around a transition, with its state."""
        times = transition.time + _EVENT_DIFFERENCE_STEP * self._step * np.array([-1.0, 0.0, 1.0])
        return MotionNodes(
            times, np.tile(transition.state, (3, 1)), *self._interpolation_positions(times)
        )

    def _interpolation_positions(self, times: Array) -> tuple[Indices, Array]:
        before = np.clip(np.searchsorted(self.time, times) - 1, 0, len(self.time) - 2)
        return before, (times - self.time[before]) / (self.time[before + 1] - self.time[before])

    def constants_at(
        self, constants: SimulationConstants, nodes: MotionNodes
    ) -> SimulationConstants:
        """Constants of the simulation at some nodes, with the stick-slip modes."""
        references = nodes.interpolate(constants.references)
        return constants._replace(
            dynamics_constants=self.chart.dynamics.formula_constants, references=references
        )

    def sensitivity_jump(
        self, tangent: ForwardDerivatives, constants: SimulationConstants, jump: TransitionJump
    ) -> tuple[Array, Array]:
        """Jump of S at a stick-slip transition; sets the modes after it.

        With g = 0 the condition of the transition, r the rate before and r_+ the rate after it,

            S_+ = S + (r - r_+) dt/dp,    (g_s r + g_t) dt/dp = -(g_s S + g_p).

        Returns:
            g_s (m,), and (r - r_+) / (g_s r + g_t) (m,); 0 where g does not change.
        """
        nodes, m = self.nodes_at_transition(jump.transition), tangent.state_size
        event_constants = self.constants_at(constants, nodes)
        rows = event_constants.references
        reference_rate = (rows[2] - rows[0]) / (nodes.times[2] - nodes.times[0])
        zero_directions = SimulationConstants(
            *(np.zeros((1, part.shape[-1])) for part in constants)
        )
        time_direction = zero_directions._replace(references=np.tile(reference_rate, (1, 3, 1)))
        margin_derivatives = tangent.directional_derivatives(
            event_constants, nodes.states, time_direction, self.has_joints_at_rest
        )[1][1, -1]
        rate_before = self._rate_at_node(tangent, constants, nodes)
        margin_rate = float(margin_derivatives[:m] @ rate_before + margin_derivatives[m])
        self.adopt_mode(jump.mode + 1)
        if not margin_rate:
            return margin_derivatives[:m], np.zeros(m)
        return margin_derivatives[:m], (
            rate_before - self._rate_at_node(tangent, constants, nodes)
        ) / margin_rate

    def _rate_at_node(
        self, derivatives: ForwardDerivatives, constants: SimulationConstants, nodes: MotionNodes
    ) -> Array:
        """Rate (m,) at the second of three nodes."""
        node_constants = self.constants_at(constants, nodes)
        row = np.ascontiguousarray(node_constants.references[1])
        return derivatives.evaluate_rate(
            node_constants._replace(references=row),
            nodes.states[1].copy(),
            self.has_joints_at_rest,
        )
