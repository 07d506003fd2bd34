"""Normal equations of a least-squares problem: steps between bounds, inverse."""

import numpy as np

from crane.common.samples import Array


def bounded_step(
    hessian: Array, gradient: Array, low: Array, high: Array, damping: float = 0.0
) -> Array:
    """Damped Gauss-Newton step (p,) between bounds, by an active set, 0 of what has no effect.

    Args:
        hessian: (p, p), of unknowns of any units.
        gradient: (p,).
        low: (p,) least step.
        high: (p,) largest step.
        damping: Marquardt's, relative to the diagonal.
    """
    scaled, size = _unit_diagonal(hessian)
    scaled += damping * np.diag(np.diag(scaled))
    gradient, lowest, highest = gradient / size, low * size, high * size
    free = np.diag(hessian) > 0.0  # what has no effect does not move
    step = np.zeros(len(gradient))
    for _ in range(len(gradient)):
        i = np.flatnonzero(free)
        right_side = -gradient[i] - scaled[np.ix_(i, ~free)] @ step[~free]
        step[i] = np.linalg.lstsq(scaled[np.ix_(i, i)], right_side, rcond=1e-12)[0]
        outside = free & ((step < lowest) | (step > highest))
        if not outside.any():
            break
        step[outside] = np.clip(step, lowest, highest)[outside]
        free &= ~outside
    return np.clip(step / size, low, high)


def scaled_inverse(hessian: Array) -> Array:
    """Pseudo-inverse (p, p) of a Hessian whose unknowns may have any units.

    Directions are cut off where the diagonal is scaled to 1: a steep unknown does not hide that a
    flat one is determined.

    Args:
        hessian: (p, p), symmetric and positive semidefinite.
    """
    scaled, size = _unit_diagonal(hessian)
    return np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) / np.outer(size, size)


def _unit_diagonal(hessian: Array) -> tuple[Array, Array]:
    """Hessian (p, p) of unknowns times their sizes, whose diagonal is 1 or 0, and these (p,)."""
    size = np.sqrt(np.diag(hessian))
    size[size == 0.0] = 1.0
    return hessian / np.outer(size, size), size
