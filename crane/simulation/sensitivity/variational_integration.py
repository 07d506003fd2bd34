"""Sensitivities along a simulated motion."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from crane.codegen import LayoutView
from crane.common.samples import Array
from crane.simulation.sensitivity.forward_derivatives import ForwardDerivatives
from crane.simulation.sensitivity.rate_formulas import report_long_formulas
from crane.simulation.sensitivity.simulated_motion import (
    MAX_REFINEMENTS,
    MotionNodes,
    ResimulatedSegment,
    SimulatedMotion,
    SimulationProblem,
    TransitionJump,
)
from crane.simulation.sensitivity.simulation_constants import SimulationConstants
from crane.simulation.sensitivity.variational_equations import interpolation_errors, step_pair_maps

STEP_ACCURACY = 1e-8  # error of a step, per size of what it is of
MIN_RELATIVE_CHANGE = 1e-6  # of the states, what matters of what a number as a whole changes


class SensitivitySolution(NamedTuple):
    """A motion and how it changes.

    Attributes:
        time: (N + 1,) [s].
        parts: Of the rows (N + 1, .), see `crane.simulation.simulation_run.integrate`.
        derivatives: (N + 1, k, p) of k outputs in p directions.
        notes: What is to be said of the motion.
    """

    time: Array
    parts: LayoutView
    derivatives: Array
    notes: list[str]


def integrate_sensitivities(
    motion: SimulationProblem,
    outputs: Sequence[str],
    make_constants: Callable[[Array], tuple[SimulationConstants, SimulationConstants]],
    typical_changes: Array,
    accuracy: float = STEP_ACCURACY,
    progress: Callable[[float], None] | None = None,
) -> SensitivitySolution:
    """Simulate a machine, and how its outputs change in some directions.

    Args:
        motion: What is simulated.
        outputs: What is observed, see `Rate`.
        make_constants: Numbers of the simulation, and p directions of them with a leading axis
            each, given the times (2 N + 1,) at which references are asked.
        typical_changes: (p,) how long directions are that change much.
        accuracy: Error of a step, per size of what it is of.
        progress: See `simulate`.

    Raises:
        InputError: A machine that has no formulas, or floats; an output that is not there.
        SimulationError: It comes to a dead centre; else as `simulate`.
    """
    track = SimulatedMotion(motion, progress)
    base, directions = make_constants(track.time)
    with report_long_formulas(track.chart.machine):
        tangent = ForwardDerivatives(
            track.chart,
            track.control,
            track.controller_state_count,
            track.stiff_state_count,
            outputs,
            _variable_constants(directions),
        )
    scale = MIN_RELATIVE_CHANGE * np.outer(track.largest_states, 1.0 / typical_changes)
    slopes = _VariationalIntegrator(track, tangent, base, directions, scale, accuracy).integrate()
    return SensitivitySolution(
        track.time[::2], track.layout.view(track.rows[::2]), slopes, track.notes
    )


def _variable_constants(directions: SimulationConstants) -> SimulationConstants:
    """Which numbers change in some of p directions, 1 or 0."""
    flat = (np.any(part != 0, axis=tuple(range(part.ndim - 1))) for part in directions)
    return SimulationConstants(*(part.astype(np.float64) for part in flat))


class _VariationalIntegrator:
    """The variational equations along a recorded motion, stretch by stretch.

    Pairs of steps over which A or B bend too much for the method are taken in parts, along states
    that are simulated anew: where a valve opens or a compensator closes they jump.

    Args:
        motion: The motion.
        forward_derivatives: Derivatives of the rate.
        nominal_constants: Numbers of the simulation.
        directions: p directions of them.
        scale: (m, p) what is taken for no smaller.
        accuracy: See `integrate_sensitivities`.
    """

    def __init__(
        self,
        motion: SimulatedMotion,
        forward_derivatives: ForwardDerivatives,
        nominal_constants: SimulationConstants,
        directions: SimulationConstants,
        scale: Array,
        accuracy: float,
    ):
        self._motion, self._forward_derivatives = motion, forward_derivatives
        self._nominal_constants, self._directions = nominal_constants, directions
        self._min_scale = np.maximum(np.abs(directions.initial_state.T), scale)
        self._accuracy = accuracy

    def integrate(self) -> Array:
        """Derivatives (N + 1, k, p) of the outputs."""
        track, m, k = (
            self._motion,
            self._forward_derivatives.state_size,
            len(self._forward_derivatives.outputs),
        )
        sensitivity = self._directions.initial_state.T.copy()
        output_derivatives = np.empty((len(track.time) // 2 + 1, k, sensitivity.shape[1]))
        for segment in track.segments():
            track.adopt_mode(segment.mode)
            if isinstance(segment, TransitionJump):
                sensitivity = self._apply_jump(segment, sensitivity)
            elif isinstance(segment, ResimulatedSegment):
                sensitivity = self._integrate_segment(
                    track.resimulated_nodes(*segment[1:]), sensitivity, MAX_REFINEMENTS - 1
                )[0][-1]
            else:
                every, seen = self._integrate_segment(
                    track.recorded_nodes(segment), sensitivity, MAX_REFINEMENTS
                )
                at = seen[::2, :k]
                output_derivatives[segment.first_instant : segment.last_instant + 1] = (
                    at[..., :m] @ every + at[..., m:]
                )
                sensitivity = every[-1]
        return output_derivatives

    def _directional_derivatives(self, nodes: MotionNodes) -> tuple[Array, Array]:
        """A and B, and the derivatives of outputs and transition margin."""
        reference_changes = nodes.interpolate(self._directions.references)
        return self._forward_derivatives.directional_derivatives(
            self._motion.constants_at(self._nominal_constants, nodes),
            nodes.states,
            self._directions._replace(references=reference_changes),
            self._motion.has_joints_at_rest,
        )

    def _integrate_segment(
        self, nodes: MotionNodes, sensitivity: Array, depth: int
    ) -> tuple[Array, Array]:
        """S (n + 1, m, p) at the ends of a stretch's steps, and what is seen at its nodes."""
        m, (state_jacobian, output_jacobian) = (
            self._forward_derivatives.state_size,
            self._directional_derivatives(nodes),
        )
        count, paired = len(nodes.step_sizes), len(nodes.step_sizes) // 2 * 2
        step_maps = step_pair_maps(
            state_jacobian[: 2 * paired + 1],
            nodes.step_sizes[:paired],
            self._motion.largest_states,
        )
        ends = np.empty((paired // 2 + 1, *sensitivity.shape))
        ends[0] = sensitivity
        for i, pair in enumerate(step_maps.both):
            ends[i + 1] = pair[:, :m] @ ends[i] + pair[:, m:]
        self._min_scale = np.maximum(self._min_scale, np.abs(ends).max(axis=0))
        interpolation_error = interpolation_errors(state_jacobian[: 2 * paired + 1])
        error = np.abs(interpolation_error[..., :m] @ ends[:-1] + interpolation_error[..., m:])
        error *= nodes.step_sizes[:paired:2, None, None]
        needs_refinement = np.any(error > self._accuracy * self._min_scale, axis=(1, 2))
        step_sensitivities = [sensitivity]
        for first, pair, finer in zip(
            step_maps.first, step_maps.both, needs_refinement, strict=True
        ):
            if finer and depth:
                self._refine_step(nodes, step_sensitivities, depth)
                self._refine_step(nodes, step_sensitivities, depth)
            else:
                begin = step_sensitivities[-1]
                step_sensitivities += [one[:, :m] @ begin + one[:, m:] for one in (first, pair)]
        if paired < count:
            self._refine_step(nodes, step_sensitivities, depth)
        return np.array(step_sensitivities), output_jacobian

    def _refine_step(
        self, nodes: MotionNodes, step_sensitivities: list[Array], depth: int
    ) -> None:
        """One more step, in parts."""
        finer = self._motion.nodes_within_step(nodes, len(step_sensitivities) - 1)
        step_sensitivities.append(
            self._integrate_segment(finer, step_sensitivities[-1], depth - 1)[0][-1]
        )

    def _apply_jump(self, jump: TransitionJump, sensitivity: Array) -> Array:
        """Sensitivities S after an instant at which joints start or stop."""
        track, m, nodes = (
            self._motion,
            self._forward_derivatives.state_size,
            self._motion.nodes_at_transition(jump.transition),
        )
        by_number = self._directional_derivatives(nodes)[1][1, -1, m:]
        by_state, leap = track.sensitivity_jump(
            self._forward_derivatives, self._nominal_constants, jump
        )
        return sensitivity - np.outer(leap, by_state @ sensitivity + by_number)
