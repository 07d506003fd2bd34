"""Periodic trajectories as finite Fourier series, from rest to rest."""

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_count, as_number, as_samples
from crane.motion.trajectory import Trajectory

_INSTANTS_PER_PERIOD = 200  # instants in the shortest period


class FourierTrajectory(Trajectory):
    """Finite Fourier series in the active coordinates (Swevers et al., 1997).

        q_i = c_i + sum_k a_ik / (w k) sin(w k s) - b_ik / (w k) cos(w k s),   k = 1 ... K,

    with w = 2 pi / period, so that a_ik and b_ik are velocity amplitudes. In the periodic part s
    is time. In half a period before it the rate of s grows from zero to one as 3 u^2 - 2 u^3 of
    the share u of that time, and decreases likewise after it: the motion starts and ends at rest
    on the periodic curve itself, within its strokes and speeds.

    Args:
        coefficients: (1 + 2 K, n): c [m], [rad], then a and b [m/s], [rad/s].
        period: [s].
        periods: Number of complete periods.

    Attributes:
        coefficients: As given.
        period: Period [s].
        periods: Number of complete periods.
        lead: Duration of the parts before and after the periodic part [s].

    Raises:
        InputError: The shape is wrong, values are not finite, or the period is not positive.

    Source: Swevers, Ganseman, Tukel, De Schutter, Van Brussel 1997, IEEE Trans. Robotics and
    Automation 13(5).
    """

    def __init__(self, coefficients: ArrayLike, period: float, periods: int = 1):
        table = np.asarray(coefficients)
        if table.ndim != 2 or len(table) < 3 or len(table) % 2 == 0:
            raise InputError(
                f"coefficients have the shape {table.shape}, give (1 + 2 harmonics, joints)"
            )
        self.coefficients = as_samples(table, table.shape[1], "coefficients")
        self.period = as_number(period, "the period", "s", greater_than=0)
        self.periods = as_count(periods, "the number of periods")
        self.lead = self.period / 2
        self.duration = self.periods * self.period + 2 * self.lead

    def breaks(self) -> Array:
        """See `Trajectory`."""
        return np.array([0.0, self.lead, self.duration - self.lead, self.duration])

    def extremum_times(self) -> Array:
        """See `Trajectory`: dense instants that resolve a maximum to 1e-4 of its harmonic."""
        shortest = self.period / self.harmonics
        return np.linspace(
            0.0, self.duration, 1 + round(_INSTANTS_PER_PERIOD * self.duration / shortest)
        )

    @property
    def harmonics(self) -> int:
        """Number of harmonics K."""
        return len(self.coefficients) // 2

    def bounds(self) -> tuple[Array, Array]:
        """See `Trajectory`: the sum of the amplitudes of all harmonics."""
        middle, (a, b) = self.coefficients[0], np.split(self.coefficients[1:], 2)
        wk = 2 * np.pi / self.period * np.arange(1, self.harmonics + 1)
        reach = (np.hypot(a, b) / wk[:, None]).sum(axis=0)
        return middle - reach, middle + reach

    def position(self, time: ArrayLike) -> Array:
        """See `Trajectory`."""
        return self(time)[0]

    def velocity(self, time: ArrayLike) -> Array:
        """See `Trajectory`."""
        return self(time)[1]

    def __call__(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """See `Trajectory`: q = f(s), v = f' s', a = f'' s'^2 + f' s''."""
        time = np.asarray(time, dtype=np.float64)
        lead = self.lead
        u = np.clip(np.minimum(time, self.duration - time), 0.0, lead) / lead
        phase_offset = lead * (u**3 - u**4 / 2 - 0.5)  # from -lead / 2 at rest to 0 when steady
        is_second_half = time > self.duration / 2
        steady_time = np.clip(time - lead, 0.0, self.duration - 2 * lead)
        s = steady_time + np.where(is_second_half, -phase_offset, phase_offset)
        rate = (u**2 * (3 - 2 * u))[..., None]
        growth = (np.where(is_second_half, -1.0, 1.0) * 6 * u * (1 - u) / lead)[..., None]
        q, v, a = (
            basis @ self.coefficients for basis in fourier_basis(s, self.harmonics, self.period)
        )
        return q, v * rate, a * rate**2 + v * growth


def fourier_basis(time: Array, harmonics: int, period: float) -> tuple[Array, Array, Array]:
    """Basis functions (..., 1 + 2 K) of the coefficients in q, v and a of a series."""
    wk = 2 * np.pi / period * np.arange(1, harmonics + 1)
    angle = np.asarray(time)[..., None] * wk
    sin, cos = np.sin(angle), np.cos(angle)
    one = np.ones_like(angle[..., :1])
    return (
        np.concatenate([one, sin / wk, -cos / wk], axis=-1),
        np.concatenate([0 * one, cos, sin], axis=-1),
        np.concatenate([0 * one, -wk * sin, wk * cos], axis=-1),
    )
