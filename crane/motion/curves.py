"""Curves in time: piecewise polynomials, by coefficients or through points."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_number, as_samples
from crane.common.shown import Brief, counted
from crane.motion.piecewise import Piecewise
from crane.motion.splines import least_jerk, quintics

if TYPE_CHECKING:
    from crane.motion.attitude import Turning

_JUMP = 1e-9  # of the largest value, what no jump is


class Trajectory(Brief):
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
    attitude: "Trajectory | Turning | None" = None

    def __init__(
        self,
        curve: Piecewise,
        tip: "Trajectory | None" = None,
        attitude: "Trajectory | Turning | None" = None,
    ):
        self.duration = float(curve.x[-1])
        self.tip, self.attitude = tip, attitude
        self._curves = (curve, curve.derivative(), curve.derivative(2))

    def _line(self) -> str:
        """How long, and of how many coordinates."""
        count = np.size(self.position(0.0))
        words = f"{self.duration:.6g} s of {counted(count, 'coordinate')}"
        return f"{type(self).__name__}({words}{', by its tip' * (self.tip is not None)})"

    def position(self, time: ArrayLike) -> Array:
        """Coordinates alone, (n,) or (N, n) at times () or (N,) [s]."""
        return np.asarray(self._curves[0](np.clip(time, 0.0, self.duration)))

    def velocity(self, time: ArrayLike) -> Array:
        """Velocities alone, likewise."""
        return self._rate(1, time)

    def _rate(self, order: int, time: ArrayLike) -> Array:
        """A derivative; zero before and after it, where it stands still."""
        inside = np.clip(time, 0.0, self.duration)
        rate: Array = np.asarray(self._curves[order](inside))
        rate[inside != time] = 0.0
        return rate

    def bounds(self) -> tuple[Array, Array]:
        """Two vectors (n,) between which the coordinates stay, which may be farther apart.

        A polynomial sum a_i u^i is no farther than sum |a_i| h^i, i > 0, from a_0 in 0 <= u <= h.
        """
        curve = self._curves[0]
        powers = np.vander(np.diff(curve.x), len(curve.c))[:, :-1]
        reach = np.einsum("imj,mi->mj", np.abs(curve.c[:-1]), powers)
        return (curve.c[-1] - reach).min(axis=0), (curve.c[-1] + reach).max(axis=0)

    def turns(self) -> Array:
        """Times (k,) [s] at which a coordinate may be largest or least: knots, and rests."""
        curve, rate = self._curves[:2]
        rests = [np.ravel(roots) for roots in np.ravel(rate.roots())]
        times = np.concatenate([curve.x, *rests])
        return np.unique(times[np.isfinite(times)])

    def breaks(self) -> Array:
        """Times (k,) [s] at which coordinates, velocities or accelerations jump, and the ends."""
        x = self._curves[0].x
        jumps = np.zeros(len(x), dtype=bool)
        jumps[[0, -1]] = True
        for curve in self._curves:
            powers = np.diff(x)[:, None] ** np.arange(len(curve.c))[::-1]
            ends = np.einsum("imj,mi->mj", curve.c, powers)[:-1]
            size = np.abs(curve.c[-1]).max(axis=0) + np.finfo(float).tiny
            jumps[1:-1] |= (np.abs(ends - curve.c[-1, 1:]) > _JUMP * size).any(axis=1)
        return np.asarray(x[jumps])

    def __call__(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """Coordinates, velocities and accelerations.

        Args:
            time: () or (N,) [s].

        Returns:
            Three arrays (n,) or (N, n).
        """
        return self.position(time), self._rate(1, time), self._rate(2, time)


def polynomial(coefficients: Sequence[Sequence[float]], duration: float) -> Trajectory:
    """Polynomials in time.

    Args:
        coefficients: Per coordinate, lowest power first.
        duration: [s].

    Raises:
        InputError: No coordinates, not finite, or no duration.
    """
    as_number(duration, "the trajectory's duration", "s", above=0)
    try:
        rows = [np.asarray(row, dtype=np.float64) for row in coefficients]
    except (TypeError, ValueError):
        rows = []
    size = max((row.size for row in rows if row.ndim == 1), default=0)
    if not size or not all(row.ndim == 1 and np.isfinite(row).all() for row in rows):
        raise InputError(
            "the trajectory's coefficients are not finite numbers, give a list per coordinate"
        )
    table = np.zeros((size, 1, len(rows)))
    for column, row in enumerate(rows):
        table[size - len(row) :, 0, column] = row[::-1]
    return Trajectory(Piecewise(table, np.array([0.0, duration])))


def point_to_point(start: ArrayLike, end: ArrayLike, duration: float) -> Trajectory:
    """Straight line from rest to rest with least jerk: s = 10 u^3 - 15 u^4 + 6 u^5, u = t/T.

    Args:
        start: (n,) active coordinates or (3,) tip position.
        end: The same shape.
        duration: T [s].

    Raises:
        InputError: Different sizes, not finite, or no duration.
    """
    as_number(duration, "the trajectory's duration", "s", above=0)
    first = as_samples(np.ravel(start), np.size(start), "start")
    last = as_samples(np.ravel(end), len(first), "end")
    shape = np.array([0, 0, 0, 10.0, -15.0, 6.0]) / duration ** np.arange(6)
    return polynomial(
        [[a, *((b - a) * shape[1:])] for a, b in zip(first, last, strict=True)], duration
    )


def via_points(time: ArrayLike, points: ArrayLike, rates: ArrayLike | None = None) -> Trajectory:
    """Through given points with least jerk, from rest to rest if nothing else is said.

    Each coordinate follows its own spline through its own points, `crane.motion.splines`: of all
    curves through these it has the least int (x''')^2 dt. It is C4; C3 where a rate is given.
    Second rates are zero at both ends.

    Args:
        time: (N,) [s], increasing from 0.
        points: (N, n) coordinates [m], [rad]; NaN where one is left open, at neither end.
        rates: (N, n) their rates [m/s], [rad/s]; NaN where they follow, which at the ends is zero.

    Raises:
        InputError: Fewer than two points, times that do not increase from 0, wrong shapes, an end
            that is left open, or a rate where no point is.
    """
    times = np.asarray(time, dtype=np.float64)
    table = np.asarray(points, dtype=np.float64)
    if times.ndim != 1 or len(times) < 2 or table.ndim != 2 or len(table) != len(times):
        raise InputError(
            f"via points have the shape {table.shape} at times {times.shape}, give (N, n) at "
            "(N,), two at least"
        )
    moves = np.full_like(table, np.nan) if rates is None else np.array(rates, dtype=np.float64)
    if moves.shape != table.shape:
        raise InputError(f"rates have the shape {moves.shape}, give {table.shape} as the points")
    if times[0] != 0 or not (np.diff(times) > 0).all() or not np.isfinite(times).all():
        raise InputError("times of via points do not increase from 0, give such")
    if np.isinf(table).any() or np.isinf(moves).any():
        raise InputError("via points are infinite, give finite numbers, or NaN where one is open")
    if np.isnan(table[[0, -1]]).any():
        raise InputError("the first and the last via point have to be complete, fill them in")
    if (np.isnan(table) & ~np.isnan(moves)).any():
        raise InputError("a rate is given where no point is, give the point, too")
    moves[[0, -1]] = np.nan_to_num(moves[[0, -1]])
    parts = np.empty((3, *table.shape))
    for i, (x, v) in enumerate(zip(table.T, moves.T, strict=True)):
        own = np.flatnonzero(~np.isnan(x))
        found = least_jerk(times[own], x[own], v[own])
        curve = quintics(times[own], found[:, :1], found[:, 1:2], found[:, 2:])
        for order in range(3):
            parts[order, :, i] = curve(times, order)[:, 0]
        parts[0, own, i] = x[own]
    return Trajectory(quintics(times, *parts))
