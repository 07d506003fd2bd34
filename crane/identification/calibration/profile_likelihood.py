"""A search, and the ends of the intervals that it finds, tried by simulation.

An interval by derivatives says how the cost rises towards its ends, where the other numbers go
along. With H = J^T J + P at the minimum z, C = H^-1, and d the distance to an end, the path is

    z(d) = z + d C e_i / C_ii,    F(z(d)) - F(z) = d^2 / (2 C_ii)

for a quadratic cost F. At either end the machine is simulated, the others are corrected by a step
of Gauss and Newton with the same J, and it is simulated again: four simulations per number. What F
rises by there, less or more, says how far derivatives hold. Where it rises by less, a point beyond
is tried as well: if it falls, the search has ended in another minimum than the lowest.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import CraneError
from crane.common.samples import Array

_LOWER_MINIMUM_SHARE = 5e-2  # share of the cost, by which another minimum is lower
_MAX_RESTARTS = 2  # times that the search goes on from there
_MIN_QUADRATIC_RISE, _WIDE_INTERVAL_RISE = (
    0.8,
    0.6,
)  # of what the cost should have risen by, as a root
_STEEP_RISE = 3.0  # likewise, of numbers that bend with others
_EXTRAPOLATION_FACTOR = 3.0  # widths, where another minimum is looked for beyond an end


class MinimumSearch(Protocol):
    """Where a search has ended, see `Search`."""

    low: Array
    high: Array
    prior: Array
    jacobian: Array
    residual: Array

    def run(self) -> Array:
        """The unknowns."""

    def nearest_minimum(self, z: Array) -> Array:
        """The unknowns of the nearest minimum."""

    def weighted_residuals(self, z: Array) -> Array:
        """(M,) weighted residuals."""

    def covariance(self, z: Array) -> tuple[Array, int]:
        """(p, p) of the unknowns in their scales, and the number of blocks."""


class ProfileEnds(NamedTuple):
    """What was found at the ends of a number's interval.

    Attributes:
        lower_rise: Root of the cost's rise at the lower end, over that which derivatives say: 1
            where they hold, less where the interval reaches farther; NaN where a bound is nearer.
        upper_rise: At the upper end.
    """

    lower_rise: float = np.nan
    upper_rise: float = np.nan

    @property
    def remark(self) -> str:
        """In words, where derivatives do not say how far the interval reaches."""
        sides = [
            side
            for side, rise in (("down", self.lower_rise), ("up", self.upper_rise))
            if rise < _WIDE_INTERVAL_RISE
        ]
        if sides:
            return f"reaches farther {' and '.join(sides)}"
        is_steep = self.lower_rise > _STEEP_RISE or self.upper_rise > _STEEP_RISE
        return "derivatives do not hold over its interval" if is_steep else ""


@dataclass(frozen=True, eq=False)
class CalibrationEstimate:
    """What a search has found.

    Attributes:
        z: (p,) the unknowns.
        covariance: (p, p) of them.
        interval_half_widths: (n,) half of the intervals of 95 % of the numbers, in their scales.
        profile_ends: Of those intervals.
        is_lowest_minimum: Whether no lower minimum was seen.
    """

    z: Array
    covariance: Array
    interval_half_widths: Array
    profile_ends: list[ProfileEnds]
    is_lowest_minimum: bool


def estimate_with_profiles(search: MinimumSearch, parameter_count: int) -> CalibrationEstimate:
    """Search, try the ends of the intervals, and go on from where the cost is lower there.

    Args:
        search: The search.
        parameter_count: Of the numbers, which are the first unknowns.
    """
    from scipy.stats import t as student

    z = search.run()
    for last in [False] * _MAX_RESTARTS + [True]:
        covariance, blocks = search.covariance(z)
        factor = float(student.ppf(0.975, max(blocks - 1, 1)))
        half_widths = factor * np.sqrt(np.maximum(np.diag(covariance)[:parameter_count], 0.0))
        ends, lower_point = evaluate_profile_ends(search, z, half_widths)
        if lower_point is None or last:
            break
        z = search.nearest_minimum(lower_point)
    return CalibrationEstimate(z, covariance, half_widths, ends, lower_point is None)


def evaluate_profile_ends(
    search: MinimumSearch, z: Array, half_widths: Array
) -> tuple[list[ProfileEnds], Array | None]:
    """Simulate the ends of intervals.

    Args:
        search: Linearized at z.
        z: (p,) the minimum.
        half_widths: (n,) half of the intervals of the first n unknowns, in their scales.

    Returns:
        What was found of each, and where the cost is lower than at the minimum, if it is.
    """
    J = search.jacobian
    H = J.T @ J + np.diag(search.prior**2)
    C = np.linalg.pinv(H, rcond=1e-13, hermitian=True)
    minimum_cost, _ = _cost_and_gradient(search, z)
    lower_point, lowest_cost = None, minimum_cost * (1.0 - _LOWER_MINIMUM_SHARE)
    profile_ends = []
    for i, width in enumerate(half_widths):
        free = (z > search.low) & (z < search.high)
        free[i] = True
        path = _profile_direction(H, free, i)
        free[i] = False
        rises = [np.nan, np.nan]
        for k, side in enumerate((-1.0, 1.0)):
            for times in (1.0, _EXTRAPOLATION_FACTOR):
                point = z + side * times * width * path
                if not width > 0 or not search.low[i] <= point[i] <= search.high[i]:
                    break
                point, cost = _refine_point(search, point, H, free)
                if cost < lowest_cost:
                    lower_point, lowest_cost = point, cost
                if times == 1.0:
                    expected = 0.5 * width**2 / C[i, i]
                    rises[k] = float(np.sqrt(max(cost - minimum_cost, 0.0) / expected))
                if not rises[k] < _MIN_QUADRATIC_RISE:
                    break
        profile_ends.append(ProfileEnds(*rises))
    return profile_ends, lower_point


def _refine_point(
    search: MinimumSearch, z: Array, H: Array, free: NDArray[np.bool_]
) -> tuple[Array, float]:
    """The better one of two points, the others a step on in the second, and its cost."""
    z = np.clip(z, search.low, search.high)
    cost, gradient = _cost_and_gradient(search, z)
    inverse = np.linalg.pinv(H[np.ix_(free, free)], rcond=1e-13, hermitian=True)
    refined = z.copy()
    refined[free] -= inverse @ gradient[free]
    refined = np.clip(refined, search.low, search.high)
    refined_cost, _ = _cost_and_gradient(search, refined)
    return (refined, refined_cost) if refined_cost < cost else (z, cost)


def _cost_and_gradient(search: MinimumSearch, z: Array) -> tuple[float, Array]:
    """Half the sum of squares, infinite where the machine cannot be, and about its gradient."""
    try:
        residuals = search.weighted_residuals(z)
    except CraneError:
        return np.inf, np.zeros(len(z))
    prior_gradient = search.prior**2 * z
    return 0.5 * float(
        residuals @ residuals + z @ prior_gradient
    ), search.jacobian.T @ residuals + prior_gradient


def _profile_direction(H: Array, free: NDArray[np.bool_], i: int) -> Array:
    """(p,) how all unknowns go along with one, those that are not free staying."""
    indices = np.flatnonzero(free)
    inverse = np.linalg.pinv(H[np.ix_(indices, indices)], rcond=1e-13, hermitian=True)
    k = int(np.flatnonzero(indices == i)[0])
    direction = np.zeros(len(free))
    direction[indices] = inverse[:, k] / inverse[k, k]
    return direction
