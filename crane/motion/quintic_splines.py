"""Piecewise polynomials and quintic splines: through derivatives, of least jerk, or smoothing."""

from dataclasses import dataclass
from math import perm
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crane.common.samples import Array

_VALUES_PER_KNOT = 3  # value, rate and second rate at a knot
_DIVIDED_DIFFERENCE_POINTS = 7  # of a divided difference that contains noise alone
_MIN_KNOT_SPACING = 0.01  # [s] between knots near samples
_MIN_CUTOFF_PER_KNOT = 2.5e-3  # cut-off per knot; below it rounding errors dominate
_RELATIVE_TOLERANCE = 1e-3  # of the noise and of the cut-off frequency


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """Polynomials between knots, x(t) = sum_k c_k (t - t_i)^(m - 1 - k) for t_i <= t < t_i+1.

    The first and the last one extend beyond the knots. It replaces scipy's PPoly, whose import
    takes several times as long as the evaluation of a motion.

    Attributes:
        c: (m, N - 1, n) coefficients, highest power first.
        x: (N,) knots, increasing.
    """

    c: Array
    x: Array

    def __call__(self, time: ArrayLike, order: int = 0) -> Array:
        """Values, or derivatives of an order, (..., n) at times (...)."""
        t = np.asarray(time, dtype=np.float64)
        interval = np.clip(np.searchsorted(self.x, t, "right") - 1, 0, len(self.x) - 2)
        u = (t - self.x[interval])[..., None]
        value, power = np.zeros((*t.shape, self.c.shape[2])), np.ones_like(u)
        for k in range(order, len(self.c)):
            value += self.c[-1 - k, interval] * power * float(perm(k, order))
            power = power * u
        return value

    def derivative(self, order: int = 1) -> "PiecewisePolynomial":
        """Derivative of an order."""
        if order >= len(self.c):
            return PiecewisePolynomial(np.zeros_like(self.c[:1]), self.x)
        factors = [float(perm(k, order)) for k in range(len(self.c) - 1, order - 1, -1)]
        return PiecewisePolynomial(
            self.c[: len(factors)] * np.array(factors)[:, None, None], self.x
        )

    def roots(self) -> Any:
        """Zeros between the knots: (n,) arrays of times, NaN for an interval that is zero."""
        from scipy.interpolate import PPoly  # slow to import

        return PPoly(self.c, self.x).roots(extrapolate=False)


def quintic_polynomials(time: Array, x: Array, v: Array, a: Array) -> PiecewisePolynomial:
    """Quintic polynomials between knots (N,) with given values and derivatives (N, n).

    With u = t - t_i, h = t_i+1 - t_i and the remainders of second order at u = h,

        d = x_i+1 - x_i - v_i h - a_i h^2/2,   e = v_i+1 - v_i - a_i h,   f = a_i+1 - a_i,
        x = x_i + v_i u + a_i u^2/2 + (10 d - 4 e h + f h^2/2) (u/h)^3
            + (-15 d + 7 e h - f h^2) (u/h)^4 + (6 d - 3 e h + f h^2/2) (u/h)^5.
    """
    h = np.diff(time)[:, None]
    d = x[1:] - x[:-1] - h * (v[:-1] + h * a[:-1] / 2)
    e = h * (v[1:] - v[:-1] - h * a[:-1])
    f = h * h * (a[1:] - a[:-1])
    coefficients = [
        (6 * d - 3 * e + f / 2) / h**5,
        (-15 * d + 7 * e - f) / h**4,
        (10 * d - 4 * e + f / 2) / h**3,
        a[:-1] / 2,
        v[:-1],
        x[:-1],
    ]
    return PiecewisePolynomial(np.array(coefficients), np.asarray(time, dtype=np.float64))


# rows of (d, e, f) of `quintic_polynomials` in (x, x', x'') at u = 0 and u = 1, for h = 1
_REMAINDERS = np.array(
    [[-1.0, -1.0, -0.5, 1.0, 0.0, 0.0], [0, -1, -1, 0, 1, 0], [0, 0, -1, 0, 0, 1]]
)
# matrix (6, 6) from (x, x', x'') at u = 0 and u = 1 to the coefficients of a quintic in u
_QUINTIC_BASIS = np.vstack(
    [
        np.eye(6)[:3] * np.array([1.0, 1.0, 0.5])[:, None],
        np.array([[10.0, -4.0, 0.5], [-15.0, 7.0, -1.0], [6.0, -3.0, 0.5]]) @ _REMAINDERS,
    ]
)
_JERK_SCALES = np.array([6.0, 24.0, 60.0])  # of u^3, u^4, u^5, differentiated three times
# quadratic form (6, 6) of int (x''')^2 du over 0 <= u <= 1 in (x, x', x'') at both ends
_JERK_FORM = (
    _QUINTIC_BASIS[3:].T
    @ (np.outer(_JERK_SCALES, _JERK_SCALES) / np.add.outer(np.arange(3.0), np.arange(1.0, 4.0)))
    @ _QUINTIC_BASIS[3:]
)


class _JerkQuadraticForm:
    """Integrated squared jerk of a quintic spline as a quadratic form in its values at knots.

    J(y) = sum_i h_i^-5 y_i^T K y_i = y^T H y, with y_i = (x, h x', h^2 x'') at both ends of an
    interval. Rates at each knot are scaled by the adjacent intervals, so that H is well
    conditioned.

    Args:
        time: (N,) [s].

    Attributes:
        time: As given.
        time_unit: Geometric mean of the intervals [s].
        knot_scales: (N, 3) factors from values and rates to those of H.
        interval_scales: (N - 1, 6) factors from values of H to those of an interval.
        jerk: Lower diagonals (6, 3 N) of H.
    """

    def __init__(self, time: Array):
        self.time = time
        h = np.diff(time)
        self.time_unit = float(np.exp(np.mean(np.log(h))))
        h = h / self.time_unit
        adjacent_lengths = np.concatenate([h[:1], np.sqrt(h[1:] * h[:-1]), h[-1:]])
        knot_scales = adjacent_lengths[:, None] ** np.arange(_VALUES_PER_KNOT)
        self.interval_scales = (
            h[:, None, None] ** np.arange(_VALUES_PER_KNOT)
            / np.stack([knot_scales[:-1], knot_scales[1:]], axis=1)
        ).reshape(-1, 2 * _VALUES_PER_KNOT)
        self.knot_scales = knot_scales * self.time_unit ** np.arange(_VALUES_PER_KNOT)
        self.jerk = self.assemble_banded(np.arange(len(h)), h[:, None, None] ** -5 * _JERK_FORM)

    def assemble_banded(self, intervals: NDArray[np.intp], forms: Array) -> Array:
        """Lower diagonals (6, 3 N) of the sum of forms (k, 6, 6) on intervals (k,)."""
        size = 2 * _VALUES_PER_KNOT
        band = np.zeros((size, _VALUES_PER_KNOT * len(self.time)))
        interval_scales = self.interval_scales[intervals]
        for k in range(size):
            for a in range(size - k):
                values = forms[:, a + k, a] * interval_scales[:, a + k] * interval_scales[:, a]
                np.add.at(band[k], _VALUES_PER_KNOT * intervals + a, values)
        return band

    def unscale_values(self, y: Array) -> Array:
        """Values and rates (N, 3) of scaled knot values (3 N,)."""
        return np.asarray(y.reshape(-1, _VALUES_PER_KNOT) / self.knot_scales)


def least_jerk(time: Array, x: Array, v: Array) -> Array:
    """Values and rates at knots of the curve of least integrated squared jerk.

    It is of fifth order between the knots and C4 at each of them, C3 where a rate is given. With
    the given rates and zero second rates at the ends, it is the unique minimum of

        J = int (x''')^2 dt

    among all curves with these values: x^(6) = 0 between the knots (Flash and Hogan, J. Neurosci.
    5 (1985) 1688-1703, for one knot between the ends).

    Args:
        time: (N,) [s].
        x: (N,) values.
        v: (N,) rates, NaN where they are free; given at both ends.

    Returns:
        (N, 3) values, rates and second rates.
    """
    from scipy.linalg import solveh_banded  # slow to import

    knots = _JerkQuadraticForm(time)
    # an offset keeps the digits of values far from zero
    given_values = np.column_stack([x - x[0], v, np.full(len(time), np.nan)])
    given_values[[0, -1], 2] = 0.0
    y = (given_values * knots.knot_scales).ravel()
    is_unknown = np.isnan(y)
    y[is_unknown] = 0.0
    band = knots.jerk
    product = band[0] * y  # of the symmetric matrix and the given values
    for k in range(1, len(band)):
        product[k:] += band[k, :-k] * y[:-k]
        product[:-k] += band[k, :-k] * y[k:]
    for k in range(1, len(band)):  # rows and columns of given values
        band[k, :-k] *= is_unknown[k:] & is_unknown[:-k]
    band[0] = np.where(is_unknown, band[0], 1.0)
    y += solveh_banded(band, np.where(is_unknown, -product, 0.0), lower=True)
    knot_values = knots.unscale_values(y)
    knot_values[:, 0] = x
    return knot_values


def estimate_noise(time: Array, x: Array) -> float:
    """Standard deviation of the noise of samples (N,) of a smooth curve, by divided differences.

    Sixth divided differences of seven samples each, with weights whose squares add up to one, have
    the variance of the noise of one sample.
    """
    i = (
        np.arange(_DIVIDED_DIFFERENCE_POINTS)
        + np.arange(len(x) - _DIVIDED_DIFFERENCE_POINTS + 1)[:, None]
    )
    differences = time[i][:, :, None] - time[i][:, None, :]
    differences /= np.ptp(time[i], axis=1)[:, None, None]
    np.einsum("ijj->ij", differences)[:] = 1.0
    weights = 1.0 / differences.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1)[:, None]
    return float(np.sqrt(np.mean(np.einsum("ij,ij->i", weights, x[i] - x[i[:, :1]]) ** 2)))


def smooth_samples(time: Array, x: Array, noise_rms: float) -> tuple[Array, Array, float]:
    """Smoothing spline of least jerk whose residuals have the size of the noise.

    It minimizes J + w sum (x - x_i)^2, with w such that the root mean square of x - x_i is that of
    the noise (Reinsch, Numer. Math. 10 (1967) 177-183, for cubic splines). For samples of spacing
    h it is, far from the ends, the filter 1 / (1 + (f/f_c)^6) without delay, that of a Butterworth
    filter of third order applied forwards and backwards, with (2 pi f_c)^6 = w / h. Samples closer
    than 10 ms share knots.

    Args:
        time: (N,) [s].
        x: (N,) samples.
        noise_rms: Standard deviation of the noise, see `estimate_noise`.

    Returns:
        Times (K,) of the knots [s], values, rates and second rates there (K, 3), and f_c [Hz].
    """
    from scipy.linalg import solveh_banded  # slow to import

    first = np.searchsorted(time, np.arange(time[0], time[-1], _MIN_KNOT_SPACING))
    knots = _JerkQuadraticForm(time[np.unique(np.r_[first, len(time) - 1])])
    interval = np.clip(np.searchsorted(knots.time, time, "right") - 1, 0, len(knots.time) - 2)
    u = (time - knots.time[interval]) / np.diff(knots.time)[interval]
    rows = u[:, None] ** np.arange(2 * _VALUES_PER_KNOT) @ _QUINTIC_BASIS
    gram = knots.assemble_banded(interval, rows[:, :, None] * rows[:, None, :])
    columns = _VALUES_PER_KNOT * interval[:, None] + np.arange(2 * _VALUES_PER_KNOT)
    scaled_rows = rows * knots.interval_scales[interval]
    mean = float(x.mean())
    centred, right_side = x - mean, np.zeros(_VALUES_PER_KNOT * len(knots.time))
    np.add.at(right_side, columns, scaled_rows * centred[:, None])
    step = float(np.ptp(time)) / (len(time) - 1) / knots.time_unit
    lower_cutoff = max(1.0 / float(np.ptp(time)), _MIN_CUTOFF_PER_KNOT / knots.time_unit)
    upper_cutoff = 0.5 / knots.time_unit
    while True:
        cutoff_frequency = float(np.sqrt(lower_cutoff * upper_cutoff))
        weight = step * (2 * np.pi * cutoff_frequency * knots.time_unit) ** 6
        y = solveh_banded(knots.jerk + weight * gram, weight * right_side, lower=True)
        residuals = np.einsum("ij,ij->i", scaled_rows, y[columns]) - centred
        residual_rms = float(np.sqrt(np.mean(residuals**2)))
        if (
            abs(residual_rms - noise_rms) < _RELATIVE_TOLERANCE * noise_rms
            or upper_cutoff < (1.0 + _RELATIVE_TOLERANCE) * lower_cutoff
        ):
            break
        if residual_rms > noise_rms:
            lower_cutoff = cutoff_frequency
        else:
            upper_cutoff = cutoff_frequency
    knot_values = knots.unscale_values(y)
    knot_values[:, 0] += mean
    return knots.time, knot_values, cutoff_frequency
