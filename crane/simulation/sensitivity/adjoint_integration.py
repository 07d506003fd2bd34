"""Gradients of functionals of a simulated motion, by backward integration of adjoint equations.

With J = sum over instants i and outputs of w_i . y(s_i, c), all numbers c and S = ds/dc,

    dJ/dc = sum_i w_i^T (C_i S_i + D_i),    S_(i+1) = Phi_i S_i + Psi_i,

is computed by the adjoints lambda of the state, backwards from the last instant,

    lambda_i = Phi_i^T lambda_(i+1) + C_i^T w_i,
    dJ/dc = lambda_0^T S_0 + sum_i (Psi_i^T lambda_(i+1) + D_i^T w_i),

the exact transpose of `variational_integration` on the same steps (Bryson and Ho, Applied Optimal
Control, 1975, chapter 2; Sandu, On the Properties of Runge-Kutta Discrete Adjoints, 2006). The
cost does not depend on the number of parameters: B^T mu and D^T w are computed for all constants
by one reverse pass over the formulas. The recorded states are the checkpoints, from which the
derivatives are computed segment by segment.
"""

from collections.abc import Sequence

import numpy as np

from crane.closure.coordinates import Indices
from crane.common.samples import Array
from crane.simulation.sensitivity.rate_derivatives import ForwardDerivatives, ReverseDerivatives
from crane.simulation.sensitivity.simulated_motion import (
    MAX_REFINEMENTS,
    MotionNodes,
    ResimulatedSegment,
    SimulatedMotion,
    TransitionJump,
)
from crane.simulation.sensitivity.simulation_constants import SimulationConstants
from crane.simulation.sensitivity.variational_integration import (
    FOURTH_DIFFERENCE_WEIGHTS,
    MIN_RELATIVE_CHANGE,
    STEP_ACCURACY,
    TransposedMap,
    interpolation_errors,
    transposed_pair_maps,
)


class AdjointIntegrator:
    """Backward integrator of the adjoint equations along a motion, segment by segment.

    Pairs of steps over which A^T lambda or B^T lambda are not smooth are divided, by the rule of
    `variational_integration` for S.

    Args:
        motion: The motion.
        outputs: Names (k,) of the outputs, see `sensitivities`.
        nominal_constants: Constants of the simulation.
        changes: Sizes of changes of the constants; 0 for those that do not change, and references.
        accuracy: Relative error of a step.

    Raises:
        InputError: An output is unknown, or the formulas are too long.
    """

    def __init__(
        self,
        motion: SimulatedMotion,
        outputs: Sequence[str],
        nominal_constants: SimulationConstants,
        changes: SimulationConstants,
        accuracy: float = STEP_ACCURACY,
    ):
        self._motion, self._nominal_constants, self._accuracy = motion, nominal_constants, accuracy
        of = motion.chart, motion.stiff_state_count, outputs
        no_changes = SimulationConstants(*(np.zeros(part.shape[-1]) for part in nominal_constants))
        self._forward_derivatives = ForwardDerivatives(*of, no_changes)
        self._reverse_derivatives = ReverseDerivatives(*of, changes)
        self._variable_indices = [np.flatnonzero(part) for part in changes[:4]]
        self._change_sizes = np.concatenate([np.abs(part[part != 0]) for part in changes[:4]])
        self._zero_directions = SimulationConstants(
            *(np.zeros((0, part.shape[-1])) for part in nominal_constants)
        )

    def integrate_backward(self, weights: Array) -> SimulationConstants:
        """Gradients of K functionals of the motion.

        Args:
            weights: (K, N + 1, k) weights of the outputs.

        Returns:
            Derivatives by all constants except for references, each part with a leading axis K; 0
            for constants that do not change.
        """
        track, sum_count, moving = self._motion, len(weights), len(self._change_sizes)
        self._gradient = np.zeros((sum_count, moving))
        adjoint = np.zeros((sum_count, self._forward_derivatives.state_size))
        self._largest_values = adjoint.copy(), self._gradient.copy()
        for segment in reversed(track.segments()):
            track.adopt_mode(segment.mode)
            if isinstance(segment, TransitionJump):
                adjoint = self._apply_jump(segment, adjoint)
                continue
            if isinstance(segment, ResimulatedSegment):
                nodes = track.resimulated_nodes(*segment[1:])
                adjoint = self._integrate_segment(nodes, adjoint, None, MAX_REFINEMENTS - 1)
                continue
            nodes = track.recorded_nodes(segment)
            output_weights = np.swapaxes(
                weights[:, segment.first_instant : segment.last_instant + 1], 0, 1
            ).copy()
            if len(output_weights) > 1:
                output_weights[-1] = 0.0  # it belongs to the next segment
            adjoint = self._integrate_segment(nodes, adjoint, output_weights, MAX_REFINEMENTS)
        out = SimulationConstants(
            *(np.zeros((sum_count, part.shape[-1])) for part in self._nominal_constants)
        )
        ends = np.cumsum([len(which) for which in self._variable_indices])[:-1]
        every = np.split(self._gradient, ends, axis=1)
        for part, which, found in zip(out[:4], self._variable_indices, every, strict=True):
            part[:, which] = found
        return out._replace(initial_state=adjoint)

    def _integrate_segment(
        self, nodes: MotionNodes, adjoint: Array, output_weights: Array | None, depth: int
    ) -> Array:
        """Lambda (K, m) at the start of a segment, from that at its end.

        Args:
            nodes: Nodes of n steps.
            adjoint: lambda at the end.
            output_weights: Weights (n + 1, K, k) of outputs; None for parts of a step.
            depth: How often steps may be divided.
        """
        lengths, k = nodes.step_sizes, len(self._forward_derivatives.outputs)
        if output_weights is None:
            output_weights = np.zeros((len(lengths) + 1, len(adjoint), k))
        still = self._zero_directions.references.shape
        by_state, output_jacobian = self._forward_derivatives.directional_derivatives(
            self._motion.constants_at(self._nominal_constants, nodes), nodes.states,
            self._zero_directions._replace(references=np.zeros((0, len(nodes.times), still[1]))),
            self._motion.has_joints_at_rest,
        )  # fmt: skip
        count, paired = len(lengths), len(lengths) // 2 * 2
        transposed_maps = transposed_pair_maps(
            by_state[: 2 * paired + 1], lengths[:paired], self._motion.largest_states
        )  # fmt: skip
        output_contributions = output_weights @ output_jacobian[::2, :k]
        step_adjoints = np.empty((count + 1, *adjoint.shape))
        step_adjoints[-1] = adjoint + output_contributions[-1]
        if paired < count:
            self._refine_step(nodes, step_adjoints, output_contributions, count - 1, depth)
        is_smooth = np.ones(len(transposed_maps[0].transposed_propagation), dtype=bool)
        segment = (
            nodes, transposed_maps, step_adjoints, output_contributions, output_weights,
        )  # fmt: skip
        contributions = self._propagate_backward(*segment, is_smooth, depth)
        self._update_scales(step_adjoints[::2], contributions)
        if depth:
            error_maps = interpolation_errors(by_state[: 2 * paired + 1])
            is_smooth = np.logical_not(
                self._needs_refinement(nodes, error_maps, step_adjoints[2 : paired + 1 : 2])
            )
        if not is_smooth.all():
            contributions = self._propagate_backward(*segment, is_smooth, depth)
        self._gradient += contributions.sum(axis=0)
        return step_adjoints[0]

    def _propagate_backward(
        self,
        nodes: MotionNodes,
        transposed_maps: tuple[TransposedMap, TransposedMap],
        step_adjoints: Array,
        output_contributions: Array,
        output_weights: Array,
        is_smooth: Array,
        depth: int,
    ) -> Array:
        """Lambda (n + 1, K, m) backwards over pairs of steps, divided where not smooth.

        Returns:
            Contributions (., K, l) of smooth pairs and of outputs to the gradient, at the nodes.
        """
        first, both = transposed_maps
        for i in range(len(is_smooth))[::-1]:
            begin, middle, end = 2 * i, 2 * i + 1, 2 * i + 2
            if is_smooth[i]:
                step_adjoints[begin] = (
                    step_adjoints[end] @ both.transposed_propagation[i].T
                    + output_contributions[middle] @ first.transposed_propagation[i].T
                    + output_contributions[begin]
                )
            else:
                self._refine_step(nodes, step_adjoints, output_contributions, middle, depth)
                self._refine_step(nodes, step_adjoints, output_contributions, begin, depth)
        weights = np.zeros((len(nodes.times), output_weights.shape[1], self._weighted_count))
        m, pairs = self._forward_derivatives.state_size, 2 * np.arange(len(is_smooth))[is_smooth]
        for of, behind in (
            (both, step_adjoints[pairs + 2]),
            (first, output_contributions[pairs + 1]),
        ):
            mu = np.einsum("njab,nkb->njka", of.stage_weights[is_smooth], behind)
            for j in range(mu.shape[1]):
                weights[2 * pairs + j, :, :m] += mu[:, j]
        weights[::2, :, m:-1] = output_weights
        contributions = np.zeros((*weights.shape[:2], len(self._change_sizes)))
        some = np.flatnonzero(weights.any(axis=(1, 2)))
        if len(some):
            contributions[some] = self._gradients_at_nodes(nodes, some, weights[some])
        return contributions

    def _refine_step(
        self,
        nodes: MotionNodes,
        step_adjoints: Array,
        output_contributions: Array,
        step: int,
        depth: int,
    ) -> None:
        """Lambda at the start of a step, which is divided."""
        finer = self._motion.nodes_within_step(nodes, step)
        step_adjoints[step] = (
            self._integrate_segment(finer, step_adjoints[step + 1], None, depth - 1)
            + output_contributions[step]
        )

    @property
    def _weighted_count(self) -> int:
        return self._forward_derivatives.state_size + len(self._forward_derivatives.outputs) + 1

    def _gradients_at_nodes(
        self, nodes: MotionNodes, node_indices: Indices, weights: Array
    ) -> Array:
        """See `ReverseDerivatives.gradients`, at some of the nodes."""
        numbers = self._motion.constants_at(self._nominal_constants, nodes)
        numbers = numbers._replace(references=numbers.references[node_indices])
        return self._reverse_derivatives.gradients(
            numbers, nodes.states[node_indices], weights, self._motion.has_joints_at_rest
        )

    def _update_scales(self, step_adjoints: Array, contributions: Array) -> None:
        """Update the largest values of lambda and the gradient; see `_needs_refinement`."""
        of_lambda, of_total = self._largest_values
        largest = self._motion.largest_states
        np.maximum(of_lambda, np.abs(step_adjoints).max(axis=0), out=of_lambda)
        least = MIN_RELATIVE_CHANGE * (of_lambda * largest).max(axis=1, keepdims=True)
        np.maximum(of_lambda, least / largest, out=of_lambda)
        np.maximum(
            of_total,
            np.abs(self._gradient + np.cumsum(contributions[::-1], axis=0)).max(axis=0),
            out=of_total,
        )
        np.maximum(of_total, least / self._change_sizes, out=of_total)

    def _needs_refinement(
        self, nodes: MotionNodes, interpolation_errors: Array, adjoints: Array
    ) -> Array:
        """Whether A^T lambda or B^T lambda are not smooth over pairs of steps.

        Args:
            nodes: Nodes of the segment.
            interpolation_errors: Interpolation errors of A (n, m, m).
            adjoints: lambda (n, K, m) after each pair.
        """
        count, several, m = adjoints.shape
        weights = np.zeros((count, several, self._weighted_count))
        weights[..., :m] = adjoints
        by_number = np.zeros((count, several, len(self._change_sizes)))
        if count:
            for j, share in enumerate(FOURTH_DIFFERENCE_WEIGHTS):
                by_number += share * self._gradients_at_nodes(
                    nodes, 4 * np.arange(count) + j, weights
                )
        rough = np.zeros(count, dtype=bool)
        for curve, scale in zip(
            (adjoints @ interpolation_errors, by_number), self._largest_values, strict=True
        ):
            rough |= (
                (np.abs(curve) * nodes.step_sizes[: 2 * count : 2, None, None])
                > self._accuracy * scale
            ).any(axis=(1, 2))
        return rough

    def _apply_jump(self, jump: TransitionJump, adjoint: Array) -> Array:
        """Lambda before joints start or stop, from that behind; see `sensitivity_jump`."""
        track, nodes = self._motion, self._motion.nodes_at_transition(jump.transition)
        by_state, leap = track.sensitivity_jump(
            self._forward_derivatives, self._nominal_constants, jump
        )
        track.adopt_mode(jump.mode)
        weights = np.zeros((1, len(adjoint), self._weighted_count))
        weights[0, :, -1] = -(adjoint @ leap)
        self._gradient += self._gradients_at_nodes(nodes, np.array([1]), weights)[0]
        return adjoint + np.outer(weights[0, :, -1], by_state)
