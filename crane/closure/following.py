"""Postures along a recorded motion, through dead centres of the coordinates that were recorded."""

import numpy as np

from crane.closure.choice import motions
from crane.closure.equations import LoopEquations
from crane.closure.structure import Indices
from crane.common.errors import ClosureError
from crane.common.samples import Array

_SINGULAR = 1e-9  # singular values that are zero
_WEAK = 0.05  # least singular value of what moves q_A, below which it does not tell the posture
_PULL = 3e-3  # weight of the continued motion there, per weight of what was recorded
_TRIES, _SMALL = 40, 1e-13
_OPEN = 1e-9  # of loops, in the equations' units
_FAR = 0.5  # from the continued motion [rad, ways of the joints]: another branch


def followed(
    equations: LoopEquations, active: Indices, scale: Array, q_a: Array, first: Array
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
        active: (n,) columns of the active joints.
        scale: (nq,) ways of the joints that compare.
        q_a: (N, n) from sample to sample as dense as the motion is smooth.
        first: (nq,) the closed posture of the first.

    Raises:
        ClosureError: The motion does not go on.
    """
    out = np.empty((len(q_a), len(first)))
    for k, wanted in enumerate(q_a):
        if not k:
            out[0] = first
            continue
        ahead = out[k - 1] if k < 2 else 2 * out[k - 1] - out[k - 2]
        if k > 2:
            ahead = 3 * out[k - 1] - 3 * out[k - 2] + out[k - 3]
        q, weak = ahead.copy(), True
        for _ in range(_TRIES):
            gap, jacobian = equations.evaluate(q)
            ways = motions(jacobian, scale, _SINGULAR)
            across = -np.linalg.lstsq(jacobian * scale, gap, rcond=_SINGULAR)[0]
            there = q + scale * across
            along = ways[active]
            left = (wanted - there[active]) / scale[active]
            weak = bool(np.linalg.svd(along, compute_uv=False).min(initial=1.0) < _WEAK)
            pull = _PULL * weak
            system = np.vstack([along, pull * np.eye(along.shape[1])])
            right = np.concatenate([left, pull * (ways.T @ ((ahead - there) / scale))])
            step = across + ways @ np.linalg.lstsq(system, right, rcond=None)[0]
            q = q + scale * step
            if np.abs(step).max(initial=0.0) < _SMALL:
                break
        gap, _ = equations.evaluate(q)
        off = float(np.abs((q - ahead) / scale).max(initial=0.0))
        if not (np.abs(gap).max(initial=0.0) < _OPEN and off < _FAR):
            raise ClosureError(
                f"sample {k}: the motion does not go on to it, it is {off:.2g} of a way off: "
                "record more samples, or see that zeros and signs are the machine's"
            )
        out[k] = q
    return out
