"""Trajectories: piecewise polynomials in time, and attitudes in time."""

from collections.abc import Sequence
from math import factorial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr, format_count
from crane.common.samples import Array, as_number, as_samples
from crane.motion.quintic_splines import PiecewisePolynomial, least_jerk, quintic_polynomials

_JUMP_TOLERANCE = 1e-9  # of the largest value; smaller differences are rounding
_SERIES_TERMS = 40  # of the series below, sufficient for rotations up to 6 rad
# series of sin(w)/w, (1 - cos w)/w^2, (w - sin w)/w^3 in w^2, highest power first
_SERIES = [
    np.array([(-1.0) ** k / factorial(2 * k + i) for k in reversed(range(_SERIES_TERMS))])
    for i in (1, 2, 3)
]
_SERIES_DERIVATIVES = [np.polyder(series) for series in _SERIES]


class Trajectory(OneLineRepr):
    """Motion with two derivatives; it is at rest before its start and after its end.

    Args:
        curve: Piecewise polynomial of time from 0 [s], values (n,).
        tip: The same motion as a trajectory of the tip (3,) [m], if it was defined by the tip.
        attitude: Attitude of the tip's frame, if it was defined: inclination (1,) [rad] or
            rotation.

    Attributes:
        duration: [s].
        tip: Trajectory of the tip, None if the motion was not defined by the tip.
        attitude: Attitude of the tip's frame, None if it was not defined.
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
        return (
            f"{type(self).__name__}({self.duration:.6g} s of "
            f"{format_count(np.size(self.position(0.0)), 'coordinate')}"
            f"{', by its tip' * (self.tip is not None)})"
        )

    def position(self, time: ArrayLike) -> Array:
        """Coordinates (n,) or (N, n) at times () or (N,) [s]."""
        return np.asarray(self._polynomials[0](np.clip(time, 0.0, self.duration)))

    def velocity(self, time: ArrayLike) -> Array:
        """Velocities (n,) or (N, n) at times () or (N,) [s]."""
        return self._derivative(1, time)

    def _derivative(self, order: int, time: ArrayLike) -> Array:
        """Derivative of an order; zero before the start and after the end."""
        clipped_time = np.clip(time, 0.0, self.duration)
        derivative: Array = np.asarray(self._polynomials[order](clipped_time))
        derivative[clipped_time != time] = 0.0
        return derivative

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (n,) of the coordinates, not necessarily tight.

        In 0 <= u <= h a polynomial sum a_i u^i differs from a_0 by at most sum |a_i| h^i, i > 0.
        """
        curve = self._polynomials[0]
        powers = np.vander(np.diff(curve.x), len(curve.c))[:, :-1]
        max_deviation = np.einsum("imj,mi->mj", np.abs(curve.c[:-1]), powers)
        return (curve.c[-1] - max_deviation).min(axis=0), (curve.c[-1] + max_deviation).max(axis=0)

    def extremum_times(self) -> Array:
        """Times (k,) [s] at which a coordinate may be extremal: knots, and zeros of velocities."""
        curve, rate = self._polynomials[:2]
        times = np.concatenate([curve.x, *map(np.ravel, np.ravel(rate.roots()))])
        return np.unique(times[np.isfinite(times)])

    def breaks(self) -> Array:
        """Times (k,) [s] of jumps in coordinates, velocities or accelerations, and both ends."""
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


class AdaptedTrajectory(Trajectory):
    """Trajectory with another duration, or with free joints at constant coordinates.

    Args:
        reference: The trajectory.
        duration: [s].
        driven: (n,) whether a joint is driven; None if the reference has all coordinates.
        start: (n,) coordinates of the free joints.
    """

    def __init__(
        self,
        reference: Trajectory,
        duration: float,
        driven: NDArray[np.bool_] | None = None,
        start: Array | float = 0.0,
    ):
        self.duration = duration
        self._reference, self._driven, self._start = reference, driven, start
        self._time_scale = reference.duration / duration
        if driven is not None:
            self.tip, self.attitude = reference.tip, reference.attitude

    def position(self, time: ArrayLike) -> Array:
        """See `Trajectory`."""
        return self._insert_driven(
            self._reference.position(np.asarray(time) * self._time_scale), self._start
        )

    def _derivative(self, order: int, time: ArrayLike) -> Array:
        x = self._reference._derivative(order, np.asarray(time) * self._time_scale)
        return self._insert_driven(self._time_scale**order * x, np.zeros_like(self._start))

    def bounds(self) -> tuple[Array, Array]:
        """See `Trajectory`."""
        lower, upper = self._reference.bounds()
        return self._insert_driven(lower, self._start), self._insert_driven(upper, self._start)

    def extremum_times(self) -> Array:
        """See `Trajectory`."""
        return self._reference.extremum_times() / self._time_scale

    def breaks(self) -> Array:
        """See `Trajectory`."""
        return self._reference.breaks() / self._time_scale

    def _insert_driven(self, x: Array, all_values: Array | float) -> Array:
        if self._driven is None:
            return x
        out = np.tile(all_values, (*x.shape[:-1], 1) if x.ndim > 1 else 1)
        out[..., self._driven] = x if x.shape[-1] < out.shape[-1] else x[..., self._driven]
        return out


def retime(reference: Trajectory, duration: float) -> Trajectory:
    """Trajectory with the same path and another duration: q(t T / duration).

    Args:
        reference: Trajectory of duration T [s].
        duration: [s].

    Raises:
        InputError: The duration is not positive.
    """
    return AdaptedTrajectory(reference, as_number(duration, "the duration", "s", greater_than=0))


def polynomial(coefficients: Sequence[Sequence[float]], duration: float) -> Trajectory:
    """Trajectory of one polynomial per coordinate.

    Args:
        coefficients: A list per coordinate, lowest power first.
        duration: [s].

    Raises:
        InputError: There are no coordinates, values are not finite, or the duration is not
            positive.
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
    """Straight line from rest to rest of least jerk, s = 10 u^3 - 15 u^4 + 6 u^5, u = t/T.

    Args:
        start: (n,) active coordinates or (3,) tip position.
        end: The same shape.
        duration: T [s].

    Raises:
        InputError: Sizes differ, values are not finite, or the duration is not positive.
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
    """Trajectory of least jerk through given points, by default from rest to rest.

    Each coordinate is a quintic spline through its own points (`crane.motion.quintic_splines`):
    among all curves through them it has the least int (x''')^2 dt. It is C4, and C3 where a rate
    is given. Accelerations are zero at both ends.

    Args:
        time: (N,) [s], increasing from 0.
        points: (N, n) coordinates [m], [rad]; NaN where a coordinate is free, except at the ends.
        rates: (N, n) their rates [m/s], [rad/s]; NaN where a rate is free, at the ends for zero.

    Raises:
        InputError: There are fewer than two points, times do not increase from 0, shapes differ,
            an end is incomplete, or a rate has no point.
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
            "at (N,), two at least"
        )
    given_rates = (
        np.full_like(point_table, np.nan) if rates is None else np.array(rates, dtype=np.float64)
    )
    if given_rates.shape != point_table.shape:
        raise InputError(
            f"rates have the shape {given_rates.shape}, give {point_table.shape} as the points"
        )
    if times[0] != 0 or not (np.diff(times) > 0).all() or not np.isfinite(times).all():
        raise InputError("times of via points do not increase from 0, give increasing times")
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


def _cross_product_matrices(v: Array) -> Array:
    """Matrices [v] (N, 3, 3) of vectors v (N, 3): [v] w = v x w."""
    out = np.zeros((len(v), 3, 3))
    out[:, [2, 0, 1], [1, 2, 0]] = v
    out[:, [1, 2, 0], [2, 0, 1]] = -v
    return out


class AttitudeTrajectory(OneLineRepr):
    """Attitude as a function of time, R = R_0 exp([r]) with the rotation vector r(t).

    With w^2 = r^T r and the series S_1 = sin(w)/w, S_2 = (1 - cos w)/w^2, S_3 = (w - sin w)/w^3,

        exp([r]) = 1 + S_1 [r] + S_2 [r]^2,    R^T w_world = J r',   J = 1 - S_2 [r] + S_3 [r]^2.

    Args:
        initial_rotation: R_0 (3, 3).
        rotation_vector: r (3,) [rad].

    Attributes:
        duration: [s].
    """

    def __init__(self, initial_rotation: Array, rotation_vector: Trajectory):
        self.duration = rotation_vector.duration
        self._initial_rotation, self._rotation_vector = initial_rotation, rotation_vector

    def __call__(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """Rotations R (N, 3, 3), angular velocities and accelerations (N, 3) in the world frame.

        Args:
            time: () or (N,) [s]; results have no axis N for a scalar.
        """
        r, rate, second = self._rotation_vector(np.atleast_1d(time))
        square, square_rate = np.einsum("ij,ij->i", r, r), 2.0 * np.einsum("ij,ij->i", r, rate)
        sine_series, cosine_series, cubic_series = (
            np.polyval(series, square)[:, None, None] for series in _SERIES
        )
        series_rate_two, series_rate_three = (
            (np.polyval(slope, square) * square_rate)[:, None, None]
            for slope in _SERIES_DERIVATIVES[1:]
        )
        vector_cross, rate_cross = _cross_product_matrices(r), _cross_product_matrices(rate)
        jacobian = (
            np.eye(3) - cosine_series * vector_cross + cubic_series * vector_cross @ vector_cross
        )
        jacobian_rate = (
            -series_rate_two * vector_cross
            - cosine_series * rate_cross
            + series_rate_three * vector_cross @ vector_cross
            + cubic_series * (vector_cross @ rate_cross + rate_cross @ vector_cross)
        )
        rotation = self._initial_rotation @ (
            np.eye(3) + sine_series * vector_cross + cosine_series * vector_cross @ vector_cross
        )
        velocity = rotation @ jacobian @ rate[..., None]
        acceleration = rotation @ (jacobian @ second[..., None] + jacobian_rate @ rate[..., None])
        result = rotation, velocity[..., 0], acceleration[..., 0]
        return result if np.ndim(time) else (result[0][0], result[1][0], result[2][0])
