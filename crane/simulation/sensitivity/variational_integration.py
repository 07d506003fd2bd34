"""Integration of the variational equations S' = A(t) S + B(t) along a recorded motion.

A step of the method of Lobatto IIIC of order 4, which is L-stable, has its stages at the begin,
the middle and the end of the step,

    S_i = S + h sum_j a_ij (A_j S_j + B_j),    S(t + h) = S_3,

so that stiff circuits and end stops need no shorter steps (Hairer and Wanner, Solving Ordinary
Differential Equations II, IV.5). A step is a linear map, S(t + h) = Phi S(t) + Psi.

Two steps and one step over both of them differ by 15 times the error of the two steps. Without
this error they are of order 5 (Hairer, Norsett and Wanner, Solving Ordinary Differential
Equations I, II.4).

The transposed map takes weights lambda of S(t + h) to those of S(t) and of the B_j,

    nu = (1 - h a (x) A)^-T (0, 0, lambda),    Phi^T lambda = sum_i nu_i,
    Psi^T lambda = sum_j B_j^T mu_j,    mu_j = h sum_i a_ij nu_i.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from crane.common.samples import Array
from crane.simulation.sensitivity.rate_derivatives import ForwardDerivatives
from crane.simulation.sensitivity.simulated_motion import (
    MAX_REFINEMENTS,
    MotionNodes,
    ResimulatedSegment,
    SimulatedMotion,
    TransitionJump,
)
from crane.simulation.sensitivity.simulation_constants import SimulationConstants

STAGE_WEIGHTS = np.array([[1.0, -2.0, 1.0], [1.0, 2.5, -0.5], [1.0, 4.0, 1.0]]) / 6.0


FOURTH_DIFFERENCE_WEIGHTS = (
    np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 15.0
)  # see `interpolation_errors`


def interpolation_errors(values: Array) -> Array:
    """Error bounds of parabolic interpolation by pair of steps.

    Fourth differences over 15 of values (4 n + 1, .) at the nodes.
    """
    return sum(
        (
            share * values[i : (len(values) - 4) + i : 4]
            for i, share in enumerate(FOURTH_DIFFERENCE_WEIGHTS)
        ),
        np.zeros(()),
    )


class TransposedMap(NamedTuple):
    """Transposed map: Phi^T (n, m, m), and matrices that give mu (n, nodes, m, m)."""

    transposed_propagation: Array
    stage_weights: Array


def step_pair_maps(values: Array, lengths: Array, sizes: Array) -> list[Array]:
    """Maps Phi and Psi (n, m, m + p) of S by n pairs of steps.

    Psi = sum_j mu_j^T B_j follows from the transposed maps, by equations with m right sides.

    Args:
        values: A and B (4 n + 1, m, m + p) at the nodes.
        lengths: (2 n,) of the steps, those of a pair equal [s].
        sizes: (m,) scales of the states for the solution of the equations.

    Returns:
        Maps of the first step, and of both steps, extrapolated.
    """
    m, maps = values.shape[1], []
    nodes = np.stack([values[i : len(values) - 4 + i : 4, :, m:] for i in range(5)], axis=1)
    for propagation, stage_weights in transposed_pair_maps(values[..., :m], lengths, sizes):
        count, node_count = stage_weights.shape[:2]
        weights = stage_weights.reshape(count, node_count * m, m)
        by_number = nodes[:, :node_count].reshape(count, node_count * m, nodes.shape[-1])
        maps.append(
            np.concatenate(
                [np.swapaxes(propagation, 1, 2), np.swapaxes(weights, 1, 2) @ by_number], axis=2
            )
        )
    return maps


def apply_maps(maps: Array, sensitivities: Array) -> Array:
    """Phi S + Psi by maps (., m, m + p) of S (., m, P); further columns of Psi are 0."""
    m = sensitivities.shape[-2]
    found: Array = maps[..., :m] @ sensitivities
    found[..., : maps.shape[-1] - m] += maps[..., m:]
    return found


def transposed_pair_maps(
    by_state: Array, lengths: Array, sizes: Array
) -> tuple[TransposedMap, TransposedMap]:
    """Transposed maps of pairs of steps, at three nodes of the first and at five of both.

    See `step_pair_maps`, with A (4 n + 1, m, m).
    """
    count, (stage_values, all_lengths) = len(lengths), _stage_values(by_state, lengths)
    step_count, stage_count, m, _ = stage_values.shape
    right = np.broadcast_to(np.eye(stage_count * m)[:, -m:], (step_count, stage_count * m, m))
    matrix = _stage_matrix(stage_values, all_lengths, sizes)
    solution = np.linalg.solve(np.swapaxes(matrix, 1, 2), right)
    nu = solution.reshape(step_count, stage_count, m, m) / sizes[:, None] * sizes
    back, stages = nu.sum(axis=1), np.einsum("ij,n,nimp->njmp", STAGE_WEIGHTS, all_lengths, nu)
    first, second = (TransposedMap(back[i:count:2], stages[i:count:2]) for i in range(2))
    refined_stages = np.concatenate(
        [
            first.stage_weights @ second.transposed_propagation[:, None],
            0.0 * second.stage_weights[:, 1:],
        ],
        axis=1,
    )
    refined_stages[:, 2:] += second.stage_weights
    refined_stages *= 16.0 / 15.0
    refined_stages[:, ::2] -= stages[count:] / 15.0
    refined_propagation = (
        16.0 * first.transposed_propagation @ second.transposed_propagation - back[count:]
    ) / 15.0
    return first, TransposedMap(refined_propagation, refined_stages)


def _stage_values(values: Array, lengths: Array) -> tuple[Array, Array]:
    """Values at the stages of 2 n steps and of n over two of them each, and how long these are."""
    stages = np.concatenate([_values_by_step(values), _values_by_step(values[::2])])
    return stages, np.concatenate([lengths, lengths[::2] + lengths[1::2]])


def _values_by_step(values: Array) -> Array:
    """Values (N, 3, .) at the stages of N steps, of those (2 N + 1, .) at their nodes."""
    return np.stack([values[i : len(values) - 2 + i : 2] for i in range(3)], axis=1)


def _stage_matrix(by_state: Array, lengths: Array, sizes: Array) -> Array:
    """1 - h a (x) A (N, 3 m, 3 m), scaled by the sizes of the states."""
    count, stages, m, _ = by_state.shape
    scaled = by_state * (-lengths[:, None, None, None] * (sizes / sizes[:, None]))
    rows = np.swapaxes(scaled, 1, 2).reshape(count, 1, m, stages * m)
    matrix = np.repeat(STAGE_WEIGHTS, m, axis=1)[:, None] * rows
    matrix.reshape(count, (stages * m) ** 2)[:, :: stages * m + 1] += 1.0
    return matrix.reshape(count, stages * m, stages * m)


STEP_ACCURACY = 1e-8  # relative error of a step
MIN_RELATIVE_CHANGE = 1e-6  # least relative change of states by a whole parameter that counts


class VariationalIntegrator:
    """Integrator of the variational equations along a simulated motion, segment by segment.

    Pairs of steps over which A or B are not smooth, as where a valve opens or a compensator
    closes, are divided and simulated again.

    Args:
        motion: The motion.
        outputs: Names (k,) of the outputs, see `sensitivities`.
        nominal_constants: Constants of the simulation, for the times of the motion.
        directions: p directions of them, each part with a leading axis.
        typical_changes: (p,) sizes of large changes along the directions.
        accuracy: Relative error of a step.

    Raises:
        InputError: An output is unknown, or the formulas are too long.
    """

    def __init__(
        self,
        motion: SimulatedMotion,
        outputs: Sequence[str],
        nominal_constants: SimulationConstants,
        directions: SimulationConstants,
        typical_changes: Array,
        accuracy: float = STEP_ACCURACY,
    ):
        self._motion, self._accuracy = motion, accuracy
        self._nominal_constants = nominal_constants
        is_variable = (np.any(part != 0, axis=tuple(range(part.ndim - 1))) for part in directions)
        self._forward_derivatives = ForwardDerivatives(
            motion.chart,
            motion.stiff_state_count,
            outputs,
            SimulationConstants(*(part.astype(np.float64) for part in is_variable)),
        )
        # those that change the initial state alone come last: their B is 0
        has_no_input = [
            not any(np.any(part[i]) for part in directions[:5])
            for i in range(len(typical_changes))
        ]
        self._order = np.argsort(has_no_input, kind="stable")
        inputs = self._order[: has_no_input.count(False)]
        self._directions = SimulationConstants(*(part[inputs] for part in directions))
        self._initial_sensitivity = directions.initial_state.T[:, self._order]
        scale = MIN_RELATIVE_CHANGE * np.outer(
            motion.largest_states, 1.0 / typical_changes[self._order]
        )
        self._min_scale = np.maximum(np.abs(self._initial_sensitivity), scale)

    def integrate(self) -> Array:
        """Derivatives (N + 1, k, p) of the outputs."""
        track, k = self._motion, len(self._forward_derivatives.outputs)
        sensitivity = self._initial_sensitivity
        output_derivatives = np.empty((len(track.time) // 2 + 1, k, sensitivity.shape[1]))
        for segment in track.segments():
            track.adopt_mode(segment.mode)
            if isinstance(segment, TransitionJump):
                sensitivity = self._apply_jump(segment, sensitivity)
                continue
            if isinstance(segment, ResimulatedSegment):
                sensitivity = self._integrate_segment(
                    track.resimulated_nodes(*segment[1:]), sensitivity, MAX_REFINEMENTS - 1
                )[0][-1]
            else:
                every, node_outputs = self._integrate_segment(
                    track.recorded_nodes(segment), sensitivity, MAX_REFINEMENTS
                )
                output_derivatives[segment.first_instant : segment.last_instant + 1] = apply_maps(
                    node_outputs[::2, :k], every
                )
                sensitivity = every[-1]
        return output_derivatives[..., np.argsort(self._order)]

    def _directional_derivatives(self, nodes: MotionNodes) -> tuple[Array, Array]:
        """A and B, derivatives of outputs and margin; see `ForwardDerivatives`."""
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
        """S (n + 1, m, p) at the ends of the steps, and derivatives of outputs at the nodes."""
        state_jacobian, output_jacobian = self._directional_derivatives(nodes)
        count, paired = len(nodes.step_sizes), len(nodes.step_sizes) // 2 * 2
        first_maps, pair_maps = step_pair_maps(
            state_jacobian[: 2 * paired + 1],
            nodes.step_sizes[:paired],
            self._motion.largest_states,
        )
        ends = np.empty((paired // 2 + 1, *sensitivity.shape))
        ends[0] = sensitivity
        for i, pair in enumerate(pair_maps):
            ends[i + 1] = apply_maps(pair, ends[i])
        self._min_scale = np.maximum(self._min_scale, np.abs(ends).max(axis=0))
        error = apply_maps(interpolation_errors(state_jacobian[: 2 * paired + 1]), ends[:-1])
        error = np.abs(error) * nodes.step_sizes[:paired:2, None, None]
        needs_refinement = np.any(error > self._accuracy * self._min_scale, axis=(1, 2))
        step_sensitivities = [sensitivity]
        for first, pair, finer in zip(first_maps, pair_maps, needs_refinement, strict=True):
            if finer and depth:
                self._refine_step(nodes, step_sensitivities, depth)
                self._refine_step(nodes, step_sensitivities, depth)
            else:
                step_sensitivities += [
                    apply_maps(one, step_sensitivities[-1]) for one in (first, pair)
                ]
        if paired < count:
            self._refine_step(nodes, step_sensitivities, depth)
        return np.array(step_sensitivities), output_jacobian

    def _refine_step(
        self, nodes: MotionNodes, step_sensitivities: list[Array], depth: int
    ) -> None:
        """Append S after one more step, which is divided."""
        finer = self._motion.nodes_within_step(nodes, len(step_sensitivities) - 1)
        step_sensitivities.append(
            self._integrate_segment(finer, step_sensitivities[-1], depth - 1)[0][-1]
        )

    def _apply_jump(self, jump: TransitionJump, sensitivity: Array) -> Array:
        """S behind an instant at which joints start or stop; see `sensitivity_jump`."""
        nodes = self._motion.nodes_at_transition(jump.transition)
        margin = self._directional_derivatives(nodes)[1][1, -1:]
        _, leap = self._motion.sensitivity_jump(
            self._forward_derivatives, self._nominal_constants, jump
        )
        return sensitivity - np.outer(leap, apply_maps(margin, sensitivity))
