"""Estimators of theta in y = W theta + noise: least squares, Huber, instrumental variables.

Rows belong to joints (`groups`) at instants (`samples`); rows may be missing. The noise of a joint
may be correlated in time, and with that of other joints at the same instant. The regressor is read
in blocks of rows, see `regressor.Regressor`, and may exceed the memory.
"""

import numpy as np

from crane.common.samples import Array
from crane.identification.estimation.regression_problem import Estimate, Prior, RegressionProblem
from crane.identification.estimation.regressor import (
    Regressor,
)


def least_squares(
    W: Array | Regressor,
    y: Array,
    groups: np.ndarray | None = None,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Ordinary least squares: min |y - W theta|^2 (/ noise^2 + |(theta - mean) / std|^2).

    The noise that a prior is weighted against is common to all rows and estimated from the
    residuals.

    Args:
        W: Regressor (m, p), as an array or in blocks.
        y: Forces (m,).
        groups: Joint of each row (m,), 0, 1, ..., with its own noise.
        samples: Number of the instant of each row (m,), increasing within a group.
        prior: See `Prior`.

    Raises:
        InputError: Shapes differ, there are too few rows, or columns are linearly dependent.
    """
    return RegressionProblem(W, None, y, groups, samples, prior).estimate(per_group=False)


def weighted_least_squares(
    W: Array | Regressor,
    y: Array,
    groups: np.ndarray,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Weighted least squares with the rows of each joint divided by its estimated noise.

    Arguments and errors as for `least_squares`.
    """
    return RegressionProblem(W, None, y, groups, samples, prior).estimate()


def huber(
    W: Array | Regressor,
    y: Array,
    groups: np.ndarray | None = None,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Huber's M-estimate by iteratively reweighted least squares.

    Rows are weighted by min(1, k sigma / |e|) / sigma^2 with k = 1.345 and the robust standard
    deviation sigma of each joint, 1.4826 median |e|. The covariance is that of sum_i w_i psi(e_i),
    with psi clipping at k sigma, over the information sum_i w_i psi'(e_i) w_i^T of the unclipped
    rows, whose share may depend on the motion.

    Arguments and errors as for `least_squares`.
    """
    return RegressionProblem(W, None, y, groups, samples, prior).huber_estimate()


def instrumental_variables(
    W: Array,
    y: Array,
    Z: Array,
    groups: np.ndarray | None = None,
    samples: np.ndarray | None = None,
    prior: Prior | None = None,
) -> Estimate:
    """Instrumental variables: theta from Z^T D (y - W theta) = 0, D = 1 / noise^2 of each joint.

    Noise of the measured motion in W biases least squares. It does not bias this estimate if the
    instruments Z (m, p) are independent of it, such as the regressor of a simulated or commanded
    motion. Rows of a prior belong to both. Other arguments and errors are those of
    `least_squares`.

    Source: Janot, Vandanjon, Gautier 2014, IEEE Trans. Control Systems Technology 22(1).
    """
    return RegressionProblem(W, Z, y, groups, samples, prior).estimate()


def essential_parameters(estimate: Estimate, level: float = 0.05) -> np.ndarray:
    """Essential parameters, without which the model would be significantly worse.

    The parameter with the largest relative standard deviation is set to zero and the others are
    updated by their covariances, repeatedly, until an F-test of all zero parameters against the
    full estimate rejects at `level`:

        F = theta_d^T C_dd^-1 theta_d / d.

    For least squares with independent noise this is (RSS_reduced - RSS) / (d sigma^2), and the
    updates equal new estimates; it remains valid for correlated noise.

    Returns:
        Indices of the kept parameters, increasing.

    Source: Pham, Gautier 1991, essential parameters of robots, IEEE CDC.
    """
    from scipy.stats import f

    kept, dropped = list(range(len(estimate.values))), list[int]()
    values, covariance = estimate.values, estimate.covariance
    while len(kept) > 1:
        std = np.sqrt(np.diag(covariance))
        worst = int(np.argmax(std / np.maximum(np.abs(values), np.finfo(float).tiny)))
        trial = [*dropped, kept[worst]]
        theta = estimate.values[trial]
        F = theta @ np.linalg.solve(estimate.covariance[np.ix_(trial, trial)], theta) / len(trial)
        if f.sf(F, len(trial), estimate.degrees_of_freedom) < level:
            break
        gain = covariance[:, worst] / covariance[worst, worst]
        rest = np.arange(len(kept)) != worst
        values = (values - gain * values[worst])[rest]
        covariance = (covariance - np.outer(gain, covariance[worst]))[np.ix_(rest, rest)]
        dropped.append(kept.pop(worst))
    return np.array(kept)
