"""The variational equations of a motion, S' = A(t) S + B(t), along its recorded states.

One step of Lobatto's method IIIC of order 4, which is L-stable and has its stages where a step
begins, in its middle and where it ends,

    S_i = S + h sum_j a_ij (A_j S_j + B_j),    S(t + h) = S_3,

so that what oil and stops stiffen needs no shorter steps (Hairer and Wanner, Solving Ordinary
Differential Equations II, IV.5). A step maps S linearly, S(t + h) = Phi S(t) + Psi.
"""

import numpy as np

from crane.common.samples import Array

STAGES = np.array([[1.0, -2.0, 1.0], [1.0, 2.5, -0.5], [1.0, 4.0, 1.0]]) / 6.0


def steps(by_state: Array, by_number: Array, lengths: Array) -> tuple[Array, Array]:
    """Phi (N, m, m) and Psi (N, m, p) of steps.

    Args:
        by_state: A (N, 3, m, m) at their stages.
        by_number: B (N, 3, m, p).
        lengths: (N,) [s].
    """
    count, stages, m, p = by_number.shape
    whole = np.zeros((count, stages, m, stages, m))
    for i in range(stages):
        for j in range(stages):
            whole[:, i, :, j] = -STAGES[i, j] * lengths[:, None, None] * by_state[:, j]
    whole = whole.reshape(count, stages * m, stages * m) + np.eye(stages * m)
    right = np.empty((count, stages, m, m + p))
    right[..., :m] = np.eye(m)
    right[..., m:] = np.einsum("ij,n,njmp->nimp", STAGES, lengths, by_number)
    found = np.asarray(np.linalg.solve(whole, right.reshape(count, stages * m, m + p)))[:, -m:]
    return found[..., :m].astype(np.float64), found[..., m:].astype(np.float64)


def bent(values: Array) -> Array:
    """By step, what a parabola through its three nodes leaves out of its mean, and more.

    Fourth differences over 15, of values (2 n + 1, .) at the nodes of at least two steps.
    """
    count = len(values) // 2
    at = np.clip(2 * np.arange(count) + 1, 2, len(values) - 3)
    weights = ((-2, 1.0), (-1, -4.0), (0, 6.0), (1, -4.0), (2, 1.0))
    out: Array = sum((weight * values[at + i] for i, weight in weights), np.zeros(())) / 15.0
    return out
