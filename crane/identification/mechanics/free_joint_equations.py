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
from crane.identification.mechanics.model_term import MotionSamples

_MAX_ITERATIONS = 30
_CONVERGENCE_TOLERANCE = 1e-2  # of a standard deviation
_ROUNDING_TOLERANCE = 1e-9  # of the largest value

RegressorFunction = Callable[[MotionSamples], tuple[Array, Array]]
"""Samples -> W (N, n, r) and known forces (N, n)."""


def free_joint_rows(
    regressor_function: RegressorFunction,
    samples: MotionSamples,
    free_joints: np.ndarray,
    values: Array,
) -> tuple[Array, Array]:
    """W (N, n, r) and what stands for known forces (N, n), of free joints' rows as above.

    Args:
        regressor_function: Of the model.
        samples: Where.
        free_joints: (f,) which joints.
        values: b (r,).
    """
    term_states = dict(samples.term_states)  # of forces that remember the past
    W, known = regressor_function(samples)
    residual = (W @ values + known)[:, free_joints]

    def free_rows_at(a_a: Array) -> tuple[Array, Array]:
        W, known = regressor_function(
            dataclasses.replace(samples, a_a=a_a, term_states=dict(term_states))
        )
        return W[:, free_joints], (W @ values + known)[:, free_joints]

    columns = [
        free_rows_at(samples.a_a + np.eye(samples.a_a.shape[1])[i])[1] - residual
        for i in free_joints.tolist()
    ]
    a_a = samples.a_a.copy()
    a_a[:, free_joints] -= np.linalg.solve(np.stack(columns, axis=2), residual[:, :, None])[
        :, :, 0
    ]
    W[:, free_joints], _ = free_rows_at(a_a)
    known[:, free_joints] = residual - W[:, free_joints] @ values
    return W, known


def iterate_estimate(
    estimate: Callable[[Array], tuple[Estimate, Array]], start: Array
) -> Estimate:
    """The estimate at whose own values the rows of free joints are taken.

    Args:
        estimate: Values (r,) to take rows at -> what they tell, and its values (r,).
        start: (r,) values to begin with.
    """
    result, values = estimate(start)
    for _ in range(_MAX_ITERATIONS):
        before, (result, values) = result.values, estimate(values)
        step = np.abs(result.values - before)
        if (
            step
            <= _CONVERGENCE_TOLERANCE * result.std + _ROUNDING_TOLERANCE * np.abs(before).max()
        ).all():
            break
    return result
