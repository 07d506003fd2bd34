"""Change points: configurations where several branches of the loops meet.

Where links come in line (a folded parallelogram or kite, a slider crank of equal lengths) J_P is
singular and several motions are possible. Along each of them q is a smooth function of q_A, so
that a polynomial through closed configurations on both sides closes the loops in between. Branches
that come close without meeting leave it open, and so does a dead centre, where q_A turns back.
"""

from collections.abc import Callable

import numpy as np

from crane.common.samples import Array

_MEETING_TOLERANCE = 1e-11  # scaled residual between the sides that counts as rounding
_SHARES = (0.25, 0.5, 0.75)  # places between two sides where the loops must close


NEIGHBOUR_PLACES = np.array([-4.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0])
# of the polynomial of degree 7 through values at these places, at 0
NEIGHBOUR_WEIGHTS = np.linalg.solve(np.vander(NEIGHBOUR_PLACES, increasing=True).T, np.eye(8)[0])
_EXTRAPOLATION = np.array([-1.0, 4.0, -6.0, 4.0])  # of degree 3 from one side, to 0
_MAX_DISAGREEMENT = 1e-5  # of these, as a share of the values, of a function with a limit


def interpolate_limit(values: Array) -> Array | None:
    """Limit of a function (m,) in a change point, None if it has none.

    Args:
        values: (8, m) values at equidistant neighbours, at `NEIGHBOUR_PLACES`.
    """
    limit = NEIGHBOUR_WEIGHTS @ values
    sides = np.array([_EXTRAPOLATION @ values[:4], _EXTRAPOLATION @ values[:3:-1]])
    error = np.abs(sides - limit).max(initial=0.0)
    has_limit = error <= _MAX_DISAGREEMENT * np.abs(values).max(initial=0.0)  # False for NaN
    return limit if has_limit else None


def is_smooth_passage(
    one: tuple[Array, Array], other: tuple[Array, Array], residual: Callable[[Array], Array]
) -> bool:
    """Whether two closed configurations are on one smooth motion between them.

    Args:
        one: Configuration (nq,), and its derivative along the motion from 0 to 1.
        other: The same of the other one.
        residual: Scaled residual of the loop equations at a configuration.
    """
    (q, slope), (q_other, slope_other) = one, other
    for t in _SHARES:  # Hermite's cubic polynomial
        between = (1 - t) ** 2 * ((1 + 2 * t) * q + t * slope)
        between += t**2 * ((3 - 2 * t) * q_other - (1 - t) * slope_other)
        if not np.abs(residual(between)).max(initial=0.0) < _MEETING_TOLERANCE:
            return False
    return True
