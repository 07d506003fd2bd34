"""Postures along a recorded motion, through dead centres of the coordinates that were recorded."""

import numpy as np

from crane.closure.active_joint_selection import null_space_basis
from crane.closure.constraint_structure import Indices
from crane.closure.loop_equations import LoopEquations
from crane.common.errors import ClosureError
from crane.common.samples import Array

_SINGULAR_TOLERANCE = 1e-9  # singular values that are zero
_WEAK_SINGULAR_VALUE = (
    0.05  # least singular value of what moves q_A, below which it does not tell the posture
)
_EXTRAPOLATION_WEIGHT = (
    3e-3  # weight of the continued motion there, per weight of what was recorded
)
_MAX_ITERATIONS, _STEP_TOLERANCE = 40, 1e-13
_CLOSED_TOLERANCE = 1e-9  # of loops, in the equations' units
_MAX_EXTRAPOLATION_ERROR = (
    0.5  # from the continued motion [rad, ways of the joints]: another branch
)


def follow_motion(
    equations: LoopEquations,
    active_columns: Indices,
    motion_scales: Array,
    q_a: Array,
    first_configuration: Array,
) -> Array:
    """Postures whose active coordinates were recorded, by the continuity of the motion.

    Where active coordinates turn because they come to a dead centre, two postures have them. The
    one nearest to the motion continued is taken: with N the motions that the loops allow, A its
    rows of the active joints, and y what is left to the recorded coordinates r and to the
    continued motion p,

        min |A y - r|^2 + w^2 |y - p|^2,

    w small, and zero where A is regular. There the recorded coordinates are met exactly; at a dead
    centre they say nothing of the posture to first order.

    Args:
        equations: Of the loops.
        active_columns: (n,) columns of the active joints.
        motion_scales: (nq,) ways of the joints that compare.
        q_a: (N, n) from sample to sample as dense as the motion is smooth.
        first_configuration: (nq,) the closed posture of the first.

    Raises:
        ClosureError: The motion does not go on.
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
                f"off: "
                "record more samples, or see that zeros and signs are the machine's"
            )
        out[k] = q
    return out
