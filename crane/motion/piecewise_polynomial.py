"""Piecewise polynomials."""

from dataclasses import dataclass
from math import perm
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crane.common.samples import Array


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """Polynomials between knots, x(t) = sum_k c_k (t - t_i)^(m - 1 - k) for t_i <= t < t_i+1.

    The first and the last one hold beyond the knots, too. It is what scipy's PPoly is, whose
    import takes several times as long as a motion.

    Attributes:
        c: (m, N - 1, n) coefficients, highest power first.
        x: (N,) knots, increasing.
    """

    c: Array
    x: Array

    def __call__(self, time: ArrayLike, order: int = 0) -> Array:
        """Values (..., n), or derivatives of an order, at times (...)."""
        t = np.asarray(time, dtype=np.float64)
        interval = np.clip(np.searchsorted(self.x, t, "right") - 1, 0, len(self.x) - 2)
        u = (t - self.x[interval])[..., None]
        value, power = np.zeros((*t.shape, self.c.shape[2])), np.ones_like(u)
        for k in range(order, len(self.c)):
            value += self.c[-1 - k, interval] * power * float(perm(k, order))
            power = power * u
        return value

    def derivative(self, order: int = 1) -> "PiecewisePolynomial":
        """Its derivative."""
        if order >= len(self.c):
            return PiecewisePolynomial(np.zeros_like(self.c[:1]), self.x)
        factors = [float(perm(k, order)) for k in range(len(self.c) - 1, order - 1, -1)]
        return PiecewisePolynomial(
            self.c[: len(factors)] * np.array(factors)[:, None, None], self.x
        )

    def roots(self) -> Any:
        """Where it is zero between its knots: (n,) arrays of times, NaN of a part that is."""
        from scipy.interpolate import PPoly  # slow to import

        return PPoly(self.c, self.x).roots(extrapolate=False)
