"""The variational equations of a motion, S' = A(t) S + B(t), along its recorded states.

One step of Lobatto's method IIIC of order 4, which is L-stable and has its stages where a step
begins, in its middle and where it ends,

    S_i = S + h sum_j a_ij (A_j S_j + B_j),    S(t + h) = S_3,

so that what oil and stops stiffen needs no shorter steps (Hairer and Wanner, Solving Ordinary
Differential Equations II, IV.5). A step maps S linearly, S(t + h) = Phi S(t) + Psi.

Two steps and one over both of them differ by 15 times the error of the two, without which they
are of order 5 (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, II.4).

Its transpose takes weights lambda of S(t + h) to those of S(t) and of the B_j,

    nu = (1 - h a (x) A)^-T (0, 0, lambda),    Phi^T lambda = sum_i nu_i,
    Psi^T lambda = sum_j B_j^T mu_j,    mu_j = h sum_i a_ij nu_i.
"""

from typing import NamedTuple

import numpy as np

from crane.common.samples import Array

STAGE_WEIGHTS = np.array([[1.0, -2.0, 1.0], [1.0, 2.5, -0.5], [1.0, 4.0, 1.0]]) / 6.0


class StepPairMaps(NamedTuple):
    """What n pairs of steps do to S: Phi and Psi (n, m, m + p).

    Attributes:
        first: Of the first step.
        both: Of both, without their error.
    """

    first: Array
    both: Array


FOURTH_DIFFERENCE_WEIGHTS = (
    np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 15.0
)  # see `interpolation_errors`


def interpolation_errors(values: Array) -> Array:
    """By pair of steps, what parabolas through their nodes leave out of their mean, and more.

    Fourth differences over 15, of values (4 n + 1, .) at the nodes.
    """
    count = len(values) - 4
    out: Array = sum(
        (share * values[i : count + i : 4] for i, share in enumerate(FOURTH_DIFFERENCE_WEIGHTS)),
        np.zeros(()),
    )
    return out


class TransposedMap(NamedTuple):
    """The way back: Phi^T (n, m, m), and what gives mu (n, nodes, m, m)."""

    transposed_propagation: Array
    stage_weights: Array


class TransposedPairMaps(NamedTuple):
    """The transpose of `StepPairMaps`, at three nodes of the first step and at five of both."""

    first: TransposedMap
    both: TransposedMap


def step_pair_maps(values: Array, lengths: Array, sizes: Array) -> StepPairMaps:
    """What pairs of steps do.

    Args:
        values: A and B (4 n + 1, m, m + p) at the nodes.
        lengths: (2 n,) of the steps, those of a pair equal [s].
        sizes: See `step_maps`.
    """
    m, count = values.shape[1], len(lengths)
    all_step_maps = np.concatenate(step_maps(*_stage_values(values, lengths), sizes), axis=2)
    first, second, coarse = (
        all_step_maps[:count:2],
        all_step_maps[1:count:2],
        all_step_maps[count:],
    )
    refined = second[..., :m] @ first
    refined[..., m:] += second[..., m:]
    return StepPairMaps(first, refined + (refined - coarse) / 15.0)


def transposed_pair_maps(by_state: Array, lengths: Array, sizes: Array) -> TransposedPairMaps:
    """Transposed maps of pairs of steps; see `step_pair_maps`, with A (4 n + 1, m, m)."""
    count = len(lengths)
    back, stages = transposed_step_maps(*_stage_values(by_state, lengths), sizes)
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
    return TransposedPairMaps(first, TransposedMap(refined_propagation, refined_stages))


def _stage_values(values: Array, lengths: Array) -> tuple[Array, Array]:
    """Values at the stages of 2 n steps and of n over two of them each, and how long these are."""
    stages = np.concatenate([_values_by_step(values), _values_by_step(values[::2])])
    return stages, np.concatenate([lengths, lengths[::2] + lengths[1::2]])


def _values_by_step(values: Array) -> Array:
    """Values (N, 3, .) at the stages of N steps, of those (2 N + 1, .) at their nodes."""
    return np.stack([values[i : len(values) - 2 + i : 2] for i in range(3)], axis=1)


def step_maps(values: Array, lengths: Array, sizes: Array) -> tuple[Array, Array]:
    """Phi (N, m, m) and Psi (N, m, p) of steps.

    Args:
        values: A and B (N, 3, m, m + p) at their stages.
        lengths: (N,) [s].
        sizes: (m,) of states, in shares of which the equations are solved: a rounded pressure
            [Pa] is no length [m].
    """
    count, stages, m, width = values.shape
    by_state, by_number, p = values[..., :m], values[..., m:], width - m
    right = np.empty((count, stages, m, m + p))
    right[..., :m] = np.eye(m)
    right[..., m:] = (
        np.einsum("ij,n,njmp->nimp", STAGE_WEIGHTS, lengths, by_number) / sizes[:, None]
    )
    right = right.reshape(count, stages * m, m + p)
    solution = (
        np.linalg.solve(_stage_matrix(by_state, lengths, sizes), right)[:, -m:] * sizes[:, None]
    )
    solution[..., :m] /= sizes
    return solution[..., :m].astype(np.float64), solution[..., m:].astype(np.float64)


def transposed_step_maps(by_state: Array, lengths: Array, sizes: Array) -> tuple[Array, Array]:
    """Phi^T (N, m, m) of steps, and what gives the mu_j of their stages (N, 3, m, m)."""
    count, stages, m, _ = by_state.shape
    right = np.broadcast_to(np.eye(stages * m)[:, -m:], (count, stages * m, m))
    solution = np.linalg.solve(np.swapaxes(_stage_matrix(by_state, lengths, sizes), 1, 2), right)
    nu = solution.astype(np.float64).reshape(count, stages, m, m) / sizes[:, None] * sizes
    return nu.sum(axis=1), np.einsum("ij,n,nimp->njmp", STAGE_WEIGHTS, lengths, nu)


def _stage_matrix(by_state: Array, lengths: Array, sizes: Array) -> Array:
    """1 - h a (x) A (N, 3 m, 3 m), in shares of sizes of the states."""
    by_state = by_state / sizes[:, None] * sizes
    count, stages, m, _ = by_state.shape
    whole = np.zeros((count, stages, m, stages, m))
    for i in range(stages):
        for j in range(stages):
            whole[:, i, :, j] = -STAGE_WEIGHTS[i, j] * lengths[:, None, None] * by_state[:, j]
    out: Array = whole.reshape(count, stages * m, stages * m) + np.eye(stages * m)
    return out
