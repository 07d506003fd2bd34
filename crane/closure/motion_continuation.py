"""Continuation along recorded motions and over stacks of samples.

A recorded motion may pass dead centres of the recorded coordinates; samples of a stack need not
be a path.
"""

import numpy as np

from crane.closure.active_joint_selection import null_space_basis
from crane.closure.constraint_structure import Indices
from crane.closure.loop_equations import LoopEquations
from crane.common.errors import ClosureError
from crane.common.samples import Array

_SINGULAR_TOLERANCE = 1e-9  # relative singular value that counts as zero
# least singular value of A below which q_A does not determine q
_WEAK_SINGULAR_VALUE = 0.05
# weight w of the extrapolated motion
_EXTRAPOLATION_WEIGHT = 3e-3
_MAX_ITERATIONS, _STEP_TOLERANCE = 40, 1e-13
_CLOSED_TOLERANCE = 1e-9  # residual of closed loops
# scaled distance to the extrapolation that means another branch
_MAX_EXTRAPOLATION_ERROR = 0.5

# samples worth sorting: number, and mean distance of neighbours as a fraction of the range
_MIN_SAMPLES_TO_SORT, _FAR_SAMPLE_DISTANCE = 100, 0.1


def sort_samples(scaled: Array) -> Indices | None:
    """An order of samples (N, n) with close neighbours; None if they need no sorting.

    Samples are sorted into cells of all coordinates but the last, and by the last one within a
    cell.

    Args:
        scaled: (N, n) coordinates as fractions of their ranges.
    """
    if len(scaled) <= _MIN_SAMPLES_TO_SORT or not scaled.size:
        return None
    if np.abs(np.diff(scaled, axis=0)).max(axis=1).mean() < _FAR_SAMPLE_DISTANCE:
        return None
    cells = np.floor(scaled * len(scaled) ** (1 / scaled.shape[1]))
    return np.asarray(np.lexsort((scaled[:, -1], *cells[:, :-1].T)))


def follow_motion(
    equations: LoopEquations,
    active_columns: Indices,
    motion_scales: Array,
    q_a: Array,
    first_configuration: Array,
) -> Array:
    """Configurations of recorded active coordinates, by continuity of the motion.

    Where an active coordinate turns back at a dead centre, two configurations have the same q_A.
    The one nearest to the extrapolated motion is taken: with N the motions that the loops allow, A
    its rows of the active joints, r the remaining step of the recorded coordinates and p that of
    the extrapolated motion,

        min |A y - r|^2 + w^2 |y - p|^2,

    with a small w near a dead centre, and w = 0 where A is regular, so that the recorded
    coordinates are met exactly.

    Args:
        equations: The loop equations.
        active_columns: (n,) columns of the active joints.
        motion_scales: (nq,) comparable displacements of the joints.
        q_a: (N, n), sampled densely enough to extrapolate.
        first_configuration: (nq,) closed configuration of the first sample.

    Raises:
        ClosureError: The motion does not continue to a sample.
    """
    out = np.empty((len(q_a), len(first_configuration)))
    for k, target in enumerate(q_a):
        if not k:
            out[0] = first_configuration
            continue
        extrapolated = out[k - 1] if k < 2 else 2 * out[k - 1] - out[k - 2]
        if k > 2:
            extrapolated = 3 * out[k - 1] - 3 * out[k - 2] + out[k - 3]
        q, is_weak = extrapolated.copy(), True
        for _ in range(_MAX_ITERATIONS):
            residual, jacobian = equations.evaluate(q)
            null_space = null_space_basis(jacobian, motion_scales, _SINGULAR_TOLERANCE)
            normal_step = -np.linalg.lstsq(
                jacobian * motion_scales, residual, rcond=_SINGULAR_TOLERANCE
            )[0]
            corrected = q + motion_scales * normal_step
            active_rows = null_space[active_columns]
            remaining = (target - corrected[active_columns]) / motion_scales[active_columns]
            is_weak = bool(
                np.linalg.svd(active_rows, compute_uv=False).min(initial=1.0)
                < _WEAK_SINGULAR_VALUE
            )
            weight = _EXTRAPOLATION_WEIGHT * is_weak
            system = np.vstack([active_rows, weight * np.eye(active_rows.shape[1])])
            right = np.concatenate(
                [remaining, weight * (null_space.T @ ((extrapolated - corrected) / motion_scales))]
            )
            step = normal_step + null_space @ np.linalg.lstsq(system, right, rcond=None)[0]
            q = q + motion_scales * step
            if np.abs(step).max(initial=0.0) < _STEP_TOLERANCE:
                break
        residual, _ = equations.evaluate(q)
        deviation = float(np.abs((q - extrapolated) / motion_scales).max(initial=0.0))
        if not (
            np.abs(residual).max(initial=0.0) < _CLOSED_TOLERANCE
            and deviation < _MAX_EXTRAPOLATION_ERROR
        ):
            raise ClosureError(
                f"sample {k}: the motion does not go on to it, it is {deviation:.2g} of a way "
                "off: record more samples, or see that zeros and signs are the machine's"
            )
        out[k] = q
    return out
