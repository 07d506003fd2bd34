"""Curves in time: piecewise polynomials, by coefficients or through points."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr, format_count
from crane.common.samples import Array, as_number, as_samples
from crane.motion.piecewise_polynomial import PiecewisePolynomial
from crane.motion.quintic_splines import least_jerk, quintic_polynomials

if TYPE_CHECKING:
    from crane.motion.attitude import AttitudeTrajectory

_JUMP_TOLERANCE = 1e-9  # of the largest value, what no jump is


class Trajectory(OneLineRepr):
    """A motion with two derivatives; before its start and after its end it stands still.

    Args:
        curve: Piecewise polynomial of time from 0 [s], values (n,).
        tip: The same motion of the tip, values (3,) [m], where the trajectory was given there.
        attitude: That of the tip's frame, where that was given: its inclination, values (1,)
            [rad], or its rotation.

    Attributes:
        duration: [s].
        tip: See above.
        attitude: See above.
    """

    duration: float
    tip: "Trajectory | None" = None
    attitude: "Trajectory | AttitudeTrajectory | None" = None

    def __init__(
        self,
        curve: PiecewisePolynomial,
        tip: "Trajectory | None" = None,
        attitude: "Trajectory | AttitudeTrajectory | None" = None,
    ):
        self.duration = float(curve.x[-1])
        self.tip, self.attitude = tip, attitude
        self._polynomials = (curve, curve.derivative(), curve.derivative(2))

    def _one_line(self) -> str:
        """How long, and of how many coordinates."""
        count = np.size(self.position(0.0))
        summary = f"{self.duration:.6g} s of {format_count(count, 'coordinate')}"
        return f"{type(self).__name__}({summary}{', by its tip' * (self.tip is not None)})"

    def position(self, time: ArrayLike) -> Array:
        """Coordinates alone, (n,) or (N, n) at times () or (N,) [s]."""
        return np.asarray(self._polynomials[0](np.clip(time, 0.0, self.duration)))

    def velocity(self, time: ArrayLike) -> Array:
        """Velocities alone, likewise."""
        return self._derivative(1, time)

    def _derivative(self, order: int, time: ArrayLike) -> Array:
        """A derivative; zero before and after it, where it stands still."""
        clipped_time = np.clip(time, 0.0, self.duration)
        derivative: Array = np.asarray(self._polynomials[order](clipped_time))
        derivative[clipped_time != time] = 0.0
        return derivative

    def bounds(self) -> tuple[Array, Array]:
        """Two vectors (n,) between which the coordinates stay, which may be farther apart.

        A polynomial sum a_i u^i is no farther than sum |a_i| h^i, i > 0, from a_0 in 0 <= u <= h.
        """
        curve = self._polynomials[0]
        powers = np.vander(np.diff(curve.x), len(curve.c))[:, :-1]
        max_deviation = np.einsum("imj,mi->mj", np.abs(curve.c[:-1]), powers)
        return (curve.c[-1] - max_deviation).min(axis=0), (curve.c[-1] + max_deviation).max(axis=0)

    def extremum_times(self) -> Array:
        """Times (k,) [s] at which a coordinate may be largest or least: knots, and rests."""
        curve, rate = self._polynomials[:2]
        rest_times = [np.ravel(roots) for roots in np.ravel(rate.roots())]
        times = np.concatenate([curve.x, *rest_times])
        return np.unique(times[np.isfinite(times)])

    def breaks(self) -> Array:
        """Times (k,) [s] at which coordinates, velocities or accelerations jump, and the ends."""
        x = self._polynomials[0].x
        is_break = np.zeros(len(x), dtype=bool)
        is_break[[0, -1]] = True
        for curve in self._polynomials:
            powers = np.diff(x)[:, None] ** np.arange(len(curve.c))[::-1]
            end_values = np.einsum("imj,mi->mj", curve.c, powers)[:-1]
            magnitude = np.abs(curve.c[-1]).max(axis=0) + np.finfo(float).tiny
            is_break[1:-1] |= (
                np.abs(end_values - curve.c[-1, 1:]) > _JUMP_TOLERANCE * magnitude
            ).any(axis=1)
        return np.asarray(x[is_break])

    def __call__(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """Coordinates, velocities and accelerations.

        Args:
            time: () or (N,) [s].

        Returns:
            Three arrays (n,) or (N, n).
        """
        return self.position(time), self._derivative(1, time), self._derivative(2, time)


def polynomial(coefficients: Sequence[Sequence[float]], duration: float) -> Trajectory:
    """Polynomials in time.

    Args:
        coefficients: Per coordinate, lowest power first.
        duration: [s].

    Raises:
        InputError: No coordinates, not finite, or no duration.
    """
    as_number(duration, "the trajectory's duration", "s", greater_than=0)
    try:
        coefficient_rows = [np.asarray(row, dtype=np.float64) for row in coefficients]
    except (TypeError, ValueError):
        coefficient_rows = []
    size = max((row.size for row in coefficient_rows if row.ndim == 1), default=0)
    if not size or not all(row.ndim == 1 and np.isfinite(row).all() for row in coefficient_rows):
        raise InputError(
            "the trajectory's coefficients are not finite numbers, give a list per coordinate"
        )
    table = np.zeros((size, 1, len(coefficient_rows)))
    for column, row in enumerate(coefficient_rows):
        table[size - len(row) :, 0, column] = row[::-1]
    return Trajectory(PiecewisePolynomial(table, np.array([0.0, duration])))


def point_to_point(start: ArrayLike, end: ArrayLike, duration: float) -> Trajectory:
    """Straight line from rest to rest with least jerk: s = 10 u^3 - 15 u^4 + 6 u^5, u = t/T.

    Args:
        start: (n,) active coordinates or (3,) tip position.
        end: The same shape.
        duration: T [s].

    Raises:
        InputError: Different sizes, not finite, or no duration.
    """
    as_number(duration, "the trajectory's duration", "s", greater_than=0)
    start_values = as_samples(np.ravel(start), np.size(start), "start")
    end_values = as_samples(np.ravel(end), len(start_values), "end")
    unit_coefficients = np.array([0, 0, 0, 10.0, -15.0, 6.0]) / duration ** np.arange(6)
    return polynomial(
        [
            [a, *((b - a) * unit_coefficients[1:])]
            for a, b in zip(start_values, end_values, strict=True)
        ],
        duration,
    )


def via_points(time: ArrayLike, points: ArrayLike, rates: ArrayLike | None = None) -> Trajectory:
    """Through given points with least jerk, from rest to rest if nothing else is said.

    Each coordinate follows its own spline through its own points, `crane.motion.quintic_splines`:
    of all curves through these it has the least int (x''')^2 dt. It is C4; C3 where a rate is
    given. Second rates are zero at both ends.

    Args:
        time: (N,) [s], increasing from 0.
        points: (N, n) coordinates [m], [rad]; NaN where one is left open, at neither end.
        rates: (N, n) their rates [m/s], [rad/s]; NaN where they follow, which at the ends is zero.

    Raises:
        InputError: Fewer than two points, times that do not increase from 0, wrong shapes, an end
            that is left open, or a rate where no point is.
    """
    times = np.asarray(time, dtype=np.float64)
    point_table = np.asarray(points, dtype=np.float64)
    if (
        times.ndim != 1
        or len(times) < 2
        or point_table.ndim != 2
        or len(point_table) != len(times)
    ):
        raise InputError(
            f"via points have the shape {point_table.shape} at times {times.shape}, give (N, n) "
            f"at "
            "(N,), two at least"
        )
    given_rates = (
        np.full_like(point_table, np.nan) if rates is None else np.array(rates, dtype=np.float64)
    )
    if given_rates.shape != point_table.shape:
        raise InputError(
            f"rates have the shape {given_rates.shape}, give {point_table.shape} as the points"
        )
    if times[0] != 0 or not (np.diff(times) > 0).all() or not np.isfinite(times).all():
        raise InputError("times of via points do not increase from 0, give such")
    if np.isinf(point_table).any() or np.isinf(given_rates).any():
        raise InputError("via points are infinite, give finite numbers, or NaN where one is open")
    if np.isnan(point_table[[0, -1]]).any():
        raise InputError("the first and the last via point have to be complete, fill them in")
    if (np.isnan(point_table) & ~np.isnan(given_rates)).any():
        raise InputError("a rate is given where no point is, give the point, too")
    given_rates[[0, -1]] = np.nan_to_num(given_rates[[0, -1]])
    derivatives = np.empty((3, *point_table.shape))
    for i, (x, v) in enumerate(zip(point_table.T, given_rates.T, strict=True)):
        given_indices = np.flatnonzero(~np.isnan(x))
        knot_values = least_jerk(times[given_indices], x[given_indices], v[given_indices])
        curve = quintic_polynomials(
            times[given_indices], knot_values[:, :1], knot_values[:, 1:2], knot_values[:, 2:]
        )
        for order in range(3):
            derivatives[order, :, i] = curve(times, order)[:, 0]
        derivatives[0, given_indices, i] = x[given_indices]
    return Trajectory(quintic_polynomials(times, *derivatives))
