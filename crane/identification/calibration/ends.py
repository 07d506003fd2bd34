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

_LOWER = 5e-2  # share of the cost, by which another minimum is lower
_AGAIN = 2  # times that the search goes on from there
_BENT, _FARTHER = 0.8, 0.6  # of what the cost should have risen by, as a root
_STEEP = 3.0  # likewise, of numbers that bend with others
_ONWARD = 3.0  # widths, where another minimum is looked for beyond an end


class Minimum(Protocol):
    """Where a search has ended, see `Search`."""

    low: Array
    high: Array
    prior: Array
    jacobian: Array
    residual: Array

    def run(self) -> Array:
        """The unknowns."""

    def onward(self, z: Array) -> Array:
        """The unknowns of the nearest minimum."""

    def left(self, z: Array) -> Array:
        """(M,) weighted residuals."""

    def covariance(self, z: Array) -> tuple[Array, int]:
        """(p, p) of the unknowns in their scales, and the number of blocks."""


class Ends(NamedTuple):
    """What was found at the ends of a number's interval.

    Attributes:
        low: Root of the cost's rise at the lower end, over that which derivatives say: 1 where
            they hold, less where the interval reaches farther; NaN where a bound is nearer.
        high: At the upper end.
    """

    low: float = np.nan
    high: float = np.nan

    @property
    def remark(self) -> str:
        """In words, where derivatives do not say how far the interval reaches."""
        sides = [side for side, rise in (("down", self.low), ("up", self.high)) if rise < _FARTHER]
        if sides:
            return f"reaches farther {' and '.join(sides)}"
        bent = self.low > _STEEP or self.high > _STEEP
        return "derivatives do not hold over its interval" if bent else ""


@dataclass(frozen=True, eq=False)
class Found:
    """What a search has found.

    Attributes:
        z: (p,) the unknowns.
        covariance: (p, p) of them.
        widths: (n,) half of the intervals of 95 % of the numbers, in their scales.
        ends: Of those intervals.
        lowest: Whether no lower minimum was seen.
    """

    z: Array
    covariance: Array
    widths: Array
    ends: list[Ends]
    lowest: bool


def found_by(search: Minimum, count: int) -> Found:
    """Search, try the ends of the intervals, and go on from where the cost is lower there.

    Args:
        search: The search.
        count: Of the numbers, which are the first unknowns.
    """
    from scipy.stats import t as student

    z = search.run()
    for last in [False] * _AGAIN + [True]:
        covariance, blocks = search.covariance(z)
        factor = float(student.ppf(0.975, max(blocks - 1, 1)))
        widths = factor * np.sqrt(np.maximum(np.diag(covariance)[:count], 0.0))
        ends, lower = try_ends(search, z, widths)
        if lower is None or last:
            break
        z = search.onward(lower)
    return Found(z, covariance, widths, ends, lower is None)


def try_ends(search: Minimum, z: Array, widths: Array) -> tuple[list[Ends], Array | None]:
    """Simulate the ends of intervals.

    Args:
        search: Linearized at z.
        z: (p,) the minimum.
        widths: (n,) half of the intervals of the first n unknowns, in their scales.

    Returns:
        What was found of each, and where the cost is lower than at the minimum, if it is.
    """
    J = search.jacobian
    H = J.T @ J + np.diag(search.prior**2)
    C = np.linalg.pinv(H, rcond=1e-13, hermitian=True)
    least, _ = _cost(search, z)
    best, lowest = None, least * (1.0 - _LOWER)
    found = []
    for i, width in enumerate(widths):
        free = (z > search.low) & (z < search.high)
        free[i] = True
        path = _path(H, free, i)
        free[i] = False
        rises = [np.nan, np.nan]
        for k, side in enumerate((-1.0, 1.0)):
            for times in (1.0, _ONWARD):
                there = z + side * times * width * path
                if not width > 0 or not search.low[i] <= there[i] <= search.high[i]:
                    break
                there, cost = _refitted(search, there, H, free)
                if cost < lowest:
                    best, lowest = there, cost
                if times == 1.0:
                    expected = 0.5 * width**2 / C[i, i]
                    rises[k] = float(np.sqrt(max(cost - least, 0.0) / expected))
                if not rises[k] < _BENT:
                    break
        found.append(Ends(*rises))
    return found, best


def _refitted(
    search: Minimum, z: Array, H: Array, others: NDArray[np.bool_]
) -> tuple[Array, float]:
    """The better one of two points, the others a step on in the second, and its cost."""
    z = np.clip(z, search.low, search.high)
    cost, gradient = _cost(search, z)
    onward = np.linalg.pinv(H[np.ix_(others, others)], rcond=1e-13, hermitian=True)
    there = z.copy()
    there[others] -= onward @ gradient[others]
    there = np.clip(there, search.low, search.high)
    beyond, _ = _cost(search, there)
    return (there, beyond) if beyond < cost else (z, cost)


def _cost(search: Minimum, z: Array) -> tuple[float, Array]:
    """Half the sum of squares, infinite where the machine cannot be, and about its gradient."""
    try:
        left = search.left(z)
    except CraneError:
        return np.inf, np.zeros(len(z))
    own = search.prior**2 * z
    return 0.5 * float(left @ left + z @ own), search.jacobian.T @ left + own


def _path(H: Array, free: NDArray[np.bool_], i: int) -> Array:
    """(p,) how all unknowns go along with one, those that are not free staying."""
    some = np.flatnonzero(free)
    inverse = np.linalg.pinv(H[np.ix_(some, some)], rcond=1e-13, hermitian=True)
    k = int(np.flatnonzero(some == i)[0])
    path = np.zeros(len(free))
    path[some] = inverse[:, k] / inverse[k, k]
    return path
