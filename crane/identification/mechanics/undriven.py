"""Rows of joints that nothing drives: their force is known to be zero, noise is in their motion.

0 = W beta + known tells ratios: with nothing known it holds for c beta as well. The measured
accelerations in W have noise, so least squares would take the smallest c, and be sure of it. What
is wrong there is the acceleration, not the force: with a_f(b) that of the free joints f by the
model with values b (hybrid dynamics, see `Dynamics.hybrid`),

    e = -(W(a) b + known(a))_f = M_ff(b) (a_f(b) - a_f),

of which Gauss and Newton make, with weights M_ff of the values before, rows at the model's own
accelerations, that have none of the noise of the measured ones:

    W_f(a(b)) beta = e + W_f(a(b)) b.

Along b itself they say nothing: how large masses are is left to the driven joints, known forces,
or what is known before.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from crane.common.samples import Array
from crane.identification.estimation.estimators import Estimate
from crane.identification.mechanics.term import Samples

_ROUNDS = 30
_SETTLED = 1e-2  # of a standard deviation
_ROUNDING = 1e-9  # of the largest value

Sides = Callable[[Samples], tuple[Array, Array]]
"""Samples -> W (N, n, r) and known forces (N, n)."""


def related(sides: Sides, at: Samples, free: np.ndarray, values: Array) -> tuple[Array, Array]:
    """W (N, n, r) and what stands for known forces (N, n), of free joints' rows as above.

    Args:
        sides: Of the model.
        at: Where.
        free: (f,) which joints.
        values: b (r,).
    """
    before = dict(at.memory)  # of forces that remember the past
    W, known = sides(at)
    left = (W @ values + known)[:, free]

    def moved(a_a: Array) -> tuple[Array, Array]:
        W, known = sides(dataclasses.replace(at, a_a=a_a, memory=dict(before)))
        return W[:, free], (W @ values + known)[:, free]

    columns = [moved(at.a_a + np.eye(at.a_a.shape[1])[i])[1] - left for i in free.tolist()]
    a_a = at.a_a.copy()
    a_a[:, free] -= np.linalg.solve(np.stack(columns, axis=2), left[:, :, None])[:, :, 0]
    W[:, free], _ = moved(a_a)
    known[:, free] = left - W[:, free] @ values
    return W, known


def settled(estimate: Callable[[Array], tuple[Estimate, Array]], start: Array) -> Estimate:
    """The estimate at whose own values the rows of free joints are taken.

    Args:
        estimate: Values (r,) to take rows at -> what they tell, and its values (r,).
        start: (r,) values to begin with.
    """
    found, values = estimate(start)
    for _ in range(_ROUNDS):
        before, (found, values) = found.values, estimate(values)
        step = np.abs(found.values - before)
        if (step <= _SETTLED * found.std + _ROUNDING * np.abs(before).max()).all():
            break
    return found
