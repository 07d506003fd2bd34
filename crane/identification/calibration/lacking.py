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

_SHARE = 0.03  # of what is left, that is worth to be told
_MOST = 5  # that are told
_FARTHEST = 2.0  # deviations that a number may be off
_OWN = 1e-6  # share of a derivative that the fitted numbers do not have


@dataclass(frozen=True)
class Lacking:
    """A number that would help.

    Attributes:
        name: Of the number.
        value: What it would be, to first order.
        share: Of the weighted sum of squares that it would take away.
    """

    name: str
    value: float
    share: float


def lacking(
    extras: Sequence[Unknown], jacobian: Array, by_extras: Array, residual: Array, prior: Array
) -> list[Lacking]:
    """Numbers that would help, the one that helps most first.

    Args:
        extras: The numbers, how far they may be off being their unit.
        jacobian: (M, p) weighted derivatives by what was fitted.
        by_extras: (M, k) by the others.
        residual: (M,) weighted.
        prior: (p,) one over the standard deviations of what was fitted.
    """
    inverse = np.linalg.pinv(jacobian.T @ jacobian + np.diag(prior**2), hermitian=True)
    own = by_extras - jacobian @ (inverse @ (jacobian.T @ by_extras))
    slopes, sizes = own.T @ residual, np.sum(own**2, axis=0)
    found = []
    for extra, slope, size, whole in zip(
        extras, slopes, sizes, np.sum(by_extras**2, axis=0), strict=True
    ):
        if not size > _OWN * whole:
            continue
        # no further than the file may be off, and than can be
        step = np.clip(-slope / size, (extra.low - extra.start) / extra.scale,
                       (extra.high - extra.start) / extra.scale)  # fmt: skip
        step = np.clip(step, -_FARTHEST, _FARTHEST)
        gain = -(2.0 * step * slope + step**2 * size) / max(float(residual @ residual), 1e-300)
        value = extra.start + extra.scale * float(step)
        found.append(Lacking(extra.name, value, float(gain)))
    best = sorted(found, key=lambda one: -one.share)
    return [one for one in best if one.share > _SHARE][:_MOST]
