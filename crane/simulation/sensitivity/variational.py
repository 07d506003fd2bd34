"""The variational equations of a motion, S' = A(t) S + B(t), along its recorded states.

One step of Lobatto's method IIIC of order 4, which is L-stable and has its stages where a step
begins, in its middle and where it ends,

    S_i = S + h sum_j a_ij (A_j S_j + B_j),    S(t + h) = S_3,

so that what oil and stops stiffen needs no shorter steps (Hairer and Wanner, Solving Ordinary
Differential Equations II, IV.5). A step maps S linearly, S(t + h) = Phi S(t) + Psi.

Its transpose takes weights lambda of S(t + h) to those of S(t) and of the B_j,

    nu = (1 - h a (x) A)^-T (0, 0, lambda),    Phi^T lambda = sum_i nu_i,
    Psi^T lambda = sum_j B_j^T mu_j,    mu_j = h sum_i a_ij nu_i.
"""

import numpy as np

from crane.closure.structure import Indices
from crane.common.samples import Array

STAGES = np.array([[1.0, -2.0, 1.0], [1.0, 2.5, -0.5], [1.0, 4.0, 1.0]]) / 6.0


def staged(values: Array) -> Array:
    """Values (N, 3, .) at the stages of N steps, of those (2 N + 1, .) at their nodes."""
    return np.stack([values[i : len(values) - 2 + i : 2] for i in range(3)], axis=1)


def steps(by_state: Array, by_number: Array, lengths: Array, sizes: Array) -> tuple[Array, Array]:
    """Phi (N, m, m) and Psi (N, m, p) of steps.

    Args:
        by_state: A (N, 3, m, m) at their stages.
        by_number: B (N, 3, m, p).
        lengths: (N,) [s].
        sizes: (m,) of states, in shares of which the equations are solved: a rounded pressure
            [Pa] is no length [m].
    """
    count, stages, m, p = by_number.shape
    right = np.empty((count, stages, m, m + p))
    right[..., :m] = np.eye(m)
    right[..., m:] = np.einsum("ij,n,njmp->nimp", STAGES, lengths, by_number) / sizes[:, None]
    right = right.reshape(count, stages * m, m + p)
    found = np.linalg.solve(_system(by_state, lengths, sizes), right)[:, -m:] * sizes[:, None]
    found[..., :m] /= sizes
    return found[..., :m].astype(np.float64), found[..., m:].astype(np.float64)


def returns(by_state: Array, lengths: Array, sizes: Array) -> tuple[Array, Array]:
    """Phi^T (N, m, m) of steps, and what gives the mu_j of their stages (N, 3, m, m)."""
    count, stages, m, _ = by_state.shape
    right = np.broadcast_to(np.eye(stages * m)[:, -m:], (count, stages * m, m))
    found = np.linalg.solve(np.swapaxes(_system(by_state, lengths, sizes), 1, 2), right)
    nu = found.astype(np.float64).reshape(count, stages, m, m) / sizes[:, None] * sizes
    return nu.sum(axis=1), np.einsum("ij,n,nimp->njmp", STAGES, lengths, nu)


def _system(by_state: Array, lengths: Array, sizes: Array) -> Array:
    """1 - h a (x) A (N, 3 m, 3 m), in shares of sizes of the states."""
    by_state = by_state / sizes[:, None] * sizes
    count, stages, m, _ = by_state.shape
    whole = np.zeros((count, stages, m, stages, m))
    for i in range(stages):
        for j in range(stages):
            whole[:, i, :, j] = -STAGES[i, j] * lengths[:, None, None] * by_state[:, j]
    out: Array = whole.reshape(count, stages * m, stages * m) + np.eye(stages * m)
    return out


def bent(values: Array) -> Array:
    """By step, what a parabola through its three nodes leaves out of its mean, and more.

    Fourth differences over 15, of values (2 n + 1, .) at the nodes of at least two steps.
    """
    shares = bending(len(values) // 2)
    out: Array = sum((share * values[at] for at, share in shares), np.zeros(()))
    return out


def bending(count: int) -> list[tuple[Indices, float]]:
    """What `bent` adds up: a node for each of some steps, and a share, in turn."""
    at = np.clip(2 * np.arange(count) + 1, 2, 2 * count - 2)
    weights = ((-2, 1.0), (-1, -4.0), (0, 6.0), (1, -4.0), (2, 1.0))
    return [(at + i, weight / 15.0) for i, weight in weights]
