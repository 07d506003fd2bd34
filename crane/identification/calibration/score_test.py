"""What a fitted model lacks: by how much numbers that were not fitted would lower what is left.

With J_f the derivatives by all that was fitted, j by another number, both weighted, and r what is
left, the number taken with the others changes the sum of squares by

    (j^T r)^2 / (j^T j - j^T J_f (J_f^T J_f + P)^-1 J_f^T j),

P being the prior: the score test (Rao 1948), with one linearization for all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array
from crane.identification.calibration.unknowns import Unknown

_MIN_COST_REDUCTION = 0.03  # of what is left, that is worth to be told
_MAX_REPORTED = 5  # that are told
_MAX_STEP = 2.0  # deviations that a number may be off
_MIN_INDEPENDENT_SHARE = 1e-6  # share of a derivative that the fitted numbers do not have


@dataclass(frozen=True)
class ScoreTestResult:
    """A number that would help.

    Attributes:
        name: Of the number.
        value: What it would be, to first order.
        cost_reduction: Of the weighted sum of squares that it would take away.
    """

    name: str
    value: float
    cost_reduction: float


def score_test(
    candidates: Sequence[Unknown],
    jacobian: Array,
    candidate_jacobian: Array,
    residual: Array,
    prior: Array,
) -> list[ScoreTestResult]:
    """Numbers that would help, the one that helps most first.

    Args:
        candidates: The numbers, how far they may be off being their unit.
        jacobian: (M, p) weighted derivatives by what was fitted.
        candidate_jacobian: (M, k) by the others.
        residual: (M,) weighted.
        prior: (p,) one over the standard deviations of what was fitted.
    """
    inverse = np.linalg.pinv(jacobian.T @ jacobian + np.diag(prior**2), hermitian=True)
    independent_columns = candidate_jacobian - jacobian @ (
        inverse @ (jacobian.T @ candidate_jacobian)
    )
    gradients, sizes = independent_columns.T @ residual, np.sum(independent_columns**2, axis=0)
    found = []
    for candidate, gradient, size, squared_norm in zip(
        candidates, gradients, sizes, np.sum(candidate_jacobian**2, axis=0), strict=True
    ):
        if not size > _MIN_INDEPENDENT_SHARE * squared_norm:
            continue
        # no further than the file may be off, and than can be
        step = np.clip(-gradient / size, (candidate.low - candidate.start) / candidate.scale,
                       (candidate.high - candidate.start) / candidate.scale)  # fmt: skip
        step = np.clip(step, -_MAX_STEP, _MAX_STEP)
        gain = -(2.0 * step * gradient + step**2 * size) / max(float(residual @ residual), 1e-300)
        value = candidate.start + candidate.scale * float(step)
        found.append(ScoreTestResult(candidate.name, value, float(gain)))
    ranked = sorted(found, key=lambda one: -one.cost_reduction)
    return [one for one in ranked if one.cost_reduction > _MIN_COST_REDUCTION][:_MAX_REPORTED]
