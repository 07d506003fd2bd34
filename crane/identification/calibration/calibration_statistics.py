"""Statistics of a calibration: profile likelihood, correlated directions and score tests.

Profile likelihood: the simulation verifies the confidence intervals of the linearization. With H =
J^T J + P at the minimum z, C = H^-1, and the distance d to the end of an interval, the profile is

    z(d) = z + d C e_i / C_ii,    F(z(d)) - F(z) = d^2 / (2 C_ii)

for a quadratic cost F. At both ends the machine is simulated, the other unknowns are corrected by
a Gauss-Newton step with the same J, and it is simulated again: four simulations per parameter. The
rise of F shows whether the linearization is valid. If F rises less, a point beyond the end is
simulated, too: if F decreases there, the minimum was a local one.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import CraneError
from crane.common.samples import Array
from crane.identification.calibration.levenberg_marquardt import LevenbergMarquardt
from crane.identification.calibration.normal_equations import scaled_inverse
from crane.identification.calibration.unknowns import Unknown

_LOWER_MINIMUM_SHARE = 5e-2  # relative difference of the cost of a lower minimum
_MAX_RESTARTS = 2  # continuations from a lower minimum
# root of the rise of the cost over that of the linearization
_MIN_QUADRATIC_RISE, _WIDE_INTERVAL_RISE = 0.8, 0.6
_STEEP_RISE = 3.0  # likewise, for strong nonlinearity
_EXTRAPOLATION_FACTOR = 3.0  # half widths at which a lower minimum is searched for
_PAIR_CORRELATION = 0.9  # correlation that links two parameters
_MIN_INFLATION = 3.0  # variance inflation that links parameters
_MIN_SHARED_EIGENVALUE = 1.5  # eigenvalue of a direction of several parameters
_MIN_COMPONENT = 0.25  # relative to the largest component of a direction
_MIN_COST_REDUCTION = 0.03  # of the cost, that is reported
_MAX_REPORTED = 5  # results that are reported
_MAX_STEP = 2.0  # standard deviations of a change
_MIN_INDEPENDENT_SHARE = 1e-6  # part of a derivative that is independent of the fitted parameters


class ProfileEnds(NamedTuple):
    """Rise of the cost at the ends of the interval of a parameter.

    Attributes:
        lower_rise: Root of the rise at the lower end over that of the linearization: 1 if it is
            valid, less if the interval is wider; NaN if a bound is nearer.
        upper_rise: The same at the upper end.
    """

    lower_rise: float = np.nan
    upper_rise: float = np.nan

    @property
    def remark(self) -> str:
        """Text about an interval that the linearization does not describe, else ""."""
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
    """Estimate of a calibration with covariance and intervals.

    Attributes:
        z: (p,) scaled unknowns.
        covariance: (p, p) covariance of the unknowns.
        interval_half_widths: (n,) half widths of the 95 % intervals of the parameters, in their
            scales.
        candidate_half_widths: (n,) the same with the candidates that a selection left out free
            within their priors.
        profile_ends: Profile likelihood at the ends of these intervals.
        is_lowest_minimum: Whether no lower minimum was found.
    """

    z: Array
    covariance: Array
    interval_half_widths: Array
    candidate_half_widths: Array
    profile_ends: list[ProfileEnds]
    is_lowest_minimum: bool


def estimate_with_profiles(
    search: LevenbergMarquardt, minimum: Array, left_out: Sequence[Unknown] = ()
) -> CalibrationEstimate:
    """Evaluate the ends of the intervals at a minimum, and continue from lower minima.

    Args:
        search: The minimization.
        minimum: (p,) minimum at which the search is linearized.
        left_out: Candidates that a selection left out.
    """
    z = minimum
    for last in [False] * _MAX_RESTARTS + [True]:
        covariance, half_widths = _covariance_and_half_widths(search, z)
        ends, lower_point = evaluate_profile_ends(search, z, half_widths)
        if lower_point is None or last:
            break
        z = search.nearest_minimum(lower_point)
    wider = half_widths
    if left_out:
        with suppress(CraneError):  # they are not known then
            wider = _covariance_and_half_widths(*extended_search(search, left_out, z))[1]
    return CalibrationEstimate(
        z, covariance, half_widths, wider[: len(half_widths)], ends, lower_point is None
    )


def _covariance_and_half_widths(search: LevenbergMarquardt, z: Array) -> tuple[Array, Array]:
    """Covariance (p, p) of the unknowns, and half widths (n,) of the intervals of parameters."""
    from scipy.stats import t as student

    covariance, blocks = search.covariance(z)
    variances = np.maximum(np.diag(covariance)[: len(search.problem.unknowns)], 0.0)
    return covariance, float(student.ppf(0.975, max(blocks - 1, 1))) * np.sqrt(variances)


def extended_search(
    search: LevenbergMarquardt, others: Sequence[Unknown], z: Array
) -> tuple[LevenbergMarquardt, Array]:
    """Search of further parameters, linearized at their values before, and its unknowns.

    Args:
        search: A search at its minimum.
        others: The parameters.
        z: (p,) the minimum.

    Raises:
        CraneError: The simulation fails.
    """
    unknowns = search.problem.unknowns
    extended = search.restricted_search(search.problem.variant([*unknowns, *others]))
    z = np.insert(z, [len(unknowns)] * len(others), 0.0)
    extended.linearize_for_covariance(z)
    return extended, z


def evaluate_profile_ends(
    search: LevenbergMarquardt, z: Array, half_widths: Array
) -> tuple[list[ProfileEnds], Array | None]:
    """Evaluate the cost at the ends of the intervals.

    Args:
        search: Minimization, linearized at z.
        z: (p,) unknowns at the minimum.
        half_widths: (n,) half widths of the intervals of the first n unknowns, in their scales.

    Returns:
        Profile ends of each parameter, and a point with a lower cost than the minimum, or None.
    """
    H = search.jacobian.T @ search.jacobian + np.diag(search.prior**2)
    C, profile_ends = scaled_inverse(H), list[ProfileEnds]()
    minimum_cost, _ = _cost_and_gradient(search, z)
    lower_point, lowest_cost = None, minimum_cost * (1.0 - _LOWER_MINIMUM_SHARE)
    for i, width in enumerate(half_widths):
        if not np.isfinite(width):
            profile_ends.append(ProfileEnds())
            continue
        free = (z > search.low) & (z < search.high)
        free[i] = True
        inverse = scaled_inverse(H[np.ix_(free, free)])
        k = int(free[:i].sum())
        path = np.zeros(len(z))
        path[free] = inverse[:, k] / inverse[k, k]
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
    search: LevenbergMarquardt, z: Array, H: Array, free: NDArray[np.bool_]
) -> tuple[Array, float]:
    """The better of a point and the point after a Gauss-Newton step, and its cost."""
    z = np.clip(z, search.low, search.high)
    cost, gradient = _cost_and_gradient(search, z)
    inverse = scaled_inverse(H[np.ix_(free, free)])
    refined = z.copy()
    refined[free] -= inverse @ gradient[free]
    refined = np.clip(refined, search.low, search.high)
    refined_cost, _ = _cost_and_gradient(search, refined)
    return (refined, refined_cost) if refined_cost < cost else (z, cost)


def _cost_and_gradient(search: LevenbergMarquardt, z: Array) -> tuple[float, Array]:
    """Half the sum of squares, infinite if the simulation fails, and its gradient by J."""
    try:
        residuals = search.weighted_residuals(z)
    except CraneError:
        return np.inf, np.zeros(len(z))
    prior_gradient = search.prior**2 * z
    return 0.5 * float(
        residuals @ residuals + z @ prior_gradient
    ), search.jacobian.T @ residuals + prior_gradient


def correlated_directions(
    names: Sequence[str], correlation: Array, half_widths: Array
) -> list[dict[str, float]]:
    """Directions of parameters that the recordings do not determine, by name.

    Args:
        names: Names of n parameters.
        correlation: (n, n) correlations; 0 if a variance is zero.
        half_widths: (n,) half widths of their intervals.
    """
    from scipy.sparse.csgraph import connected_components

    if len(correlation) < 2:
        return []
    count, labels = connected_components(np.abs(correlation) > _PAIR_CORRELATION)
    groups = [np.flatnonzero(labels == label).tolist() for label in range(count)]
    inverse = np.linalg.pinv(correlation, rcond=1e-12, hermitian=True)
    inflated = np.sqrt(np.maximum(np.diag(inverse), 0.0)) > _MIN_INFLATION
    singles = [group[0] for group in groups if len(group) == 1 and inflated[group[0]]]
    found = []
    for group in [*(group for group in groups if len(group) > 1), *([singles] if singles else [])]:
        sizes, directions = np.linalg.eigh(correlation[np.ix_(group, group)])
        v = directions[:, -1]
        v = v * np.sign(v[0]) / np.abs(v).max()
        parts = {names[i]: float(x * half_widths[i]) for i, x in zip(group, v, strict=True)
                 if abs(x) > _MIN_COMPONENT}  # fmt: skip
        if sizes[-1] > _MIN_SHARED_EIGENVALUE and len(parts) > 1:
            found.append(parts)
    return found


@dataclass(frozen=True)
class ScoreTestResult:
    """Score test of one parameter that is not fitted.

    Attributes:
        name: Name of the parameter.
        value: Its estimate to first order.
        cost_reduction: Reduction of the weighted sum of squares, relative to it.
    """

    name: str
    value: float
    cost_reduction: float


def score_tests(
    search: LevenbergMarquardt, candidates: Sequence[Unknown], z: Array
) -> list[ScoreTestResult]:
    """Score tests of parameters that are not fitted, in descending order of cost reduction.

    Args:
        search: A search at its minimum.
        candidates: The parameters, with their standard deviations as scales.
        z: (p,) the minimum.
    """
    count, candidate_count = len(search.problem.unknowns), len(candidates)
    try:
        extended, _ = extended_search(search, candidates, z)
    except CraneError:  # the tests are optional
        return []
    jacobian, residual = search.jacobian, search.residual
    candidate_jacobian = extended.jacobian[:, count : count + candidate_count]
    inverse = scaled_inverse(jacobian.T @ jacobian + np.diag(search.prior**2))
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
        # within some standard deviations, and within the bounds
        step = np.clip(np.clip(-gradient / size, -_MAX_STEP, _MAX_STEP),
                       (candidate.low - candidate.start) / candidate.scale,
                       (candidate.high - candidate.start) / candidate.scale)  # fmt: skip
        gain = -(2.0 * step * gradient + step**2 * size) / max(float(residual @ residual), 1e-300)
        found.append(
            ScoreTestResult(
                candidate.name, candidate.start + candidate.scale * float(step), float(gain)
            )
        )
    return [
        one
        for one in sorted(found, key=lambda one: -one.cost_reduction)
        if one.cost_reduction > _MIN_COST_REDUCTION
    ][:_MAX_REPORTED]
