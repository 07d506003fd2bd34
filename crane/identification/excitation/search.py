"""The search for a reference: random ones within the limits, and the way down from them."""

from collections.abc import Callable
from typing import Any

import numpy as np

from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.dynamics import Dynamics
from crane.identification.excitation.fourier import Fourier, bases
from crane.identification.excitation.information import Information
from crane.identification.excitation.limits import QUANTITIES, Limits, gear
from crane.identification.mechanics.term import Samples

DENSE = 64  # samples per period of the highest harmonic, to see that limits hold
COARSE = 12  # the same to optimise with
_WITHIN = float(np.cos(np.pi / DENSE))  # at samples, so that nothing exceeds 1 in between
_CLOSE = 33  # instants between the neighbours of the one with the largest share
_DRAWS, _TRIALS = 20, 200  # random references: how many within the limits, of how many at most
_HALVINGS = 10  # of the interval in which the largest amplitude lies
_NORM = 80  # takes the place of the maximum over time, which has no derivative
_STEPS = 150  # of sequential quadratic programming
_SETTLED = 1e-3  # change of the cost that ends it
_SMALL = 1e-6  # step of differences, of coefficients of order one
_OUTSIDE = 1e3  # cost and excess where loops do not close
_SLACK = 1e-3  # excess that a last scaling takes away

Progress = Callable[[float], None]


class Search:
    """References of a machine as vectors x of order one, their costs and constraints.

    The units of x are half a stroke for the middle, and for every harmonic the largest amplitude
    that it could have alone.

    Args:
        information: To be gained.
        bounds: Not to be left.
        period: [s].
        harmonics: K.
        count: Number of samples of the recording.
        criterion: See `crane.identification.excitation.information.CRITERIA`.
    """

    def __init__(
        self,
        information: Information,
        bounds: Limits,
        period: float,
        harmonics: int,
        count: float,
        criterion: Callable[[Array], Array],
    ):
        self._information, self._bounds, self._criterion = information, bounds, criterion
        self._machine, self._count, self._period = information.model.machine, count, period
        self._dynamics = Dynamics(self._machine)
        n = len(bounds.half)
        samples = max(COARSE * harmonics, -(-2 * information.base.rank // n))
        self._bases = bases(period * np.arange(samples) / samples, harmonics, period)
        wk = 2 * np.pi / period * np.arange(1, harmonics + 1)[:, None]
        alone = np.minimum(bounds.velocity, np.minimum(wk * bounds.half, bounds.acceleration / wk))
        self._unit = np.vstack([bounds.half, alone, alone])
        self._middle = np.zeros_like(self._unit)
        self._middle[0] = bounds.middle
        self._dense = np.linspace(0, 2 * period, 2 * DENSE * harmonics + 1)
        every = [
            f"the {what} limit of '{joint}'"
            for what in QUANTITIES
            for joint in self._machine.active
        ]
        self._limited = np.isfinite(bounds.all).ravel()
        names = [name for name, limited in zip(every, self._limited, strict=True) if limited]
        self._names = [*names, "the edge of the assembly branch"]

    def coefficients(self, x: Array) -> Array:
        """Coefficients (..., 1 + 2 K, n), see `Fourier`, of vectors (..., size)."""
        return self._middle + x.reshape(*x.shape[:-1], *self._unit.shape) * self._unit

    def rate(self, x: Array) -> tuple[Array, Array]:
        """Costs (V,) of vectors (V, size), and 1 - share of each limit (V, c), >= 0 inside.

        Raises:
            ClosureError: Loops do not close.
        """
        sets, n = len(x), self._unit.shape[1]
        coefficients = self.coefficients(x)
        q, v, a = ((basis @ coefficients).reshape(-1, n) for basis in self._bases)
        at = self._information.model.samples(
            q, v, a, self._period * sets / len(q), range(0, len(q), len(q) // sets)
        )
        costs = self._criterion(self._information.sizes(at, self._count, sets))
        shares = self._shares(at).reshape(sets, len(q) // sets, -1)
        most = shares.max(axis=1, keepdims=True) + np.finfo(float).tiny
        norms = most[:, 0] * np.linalg.norm(shares / most, _NORM, axis=1)
        return costs, 1 - norms

    def draws(self, rng: np.random.Generator) -> Array:
        """Random vectors (V, size) of references as large as the limits allow.

        Raises:
            InputError: There are none.
        """
        found: list[Array] = []
        for _ in range(_TRIALS):
            table = rng.normal(size=self._unit.shape)
            table[0] = rng.uniform(-0.6, 0.6, table.shape[1])
            x, reason = self.fitted(table.ravel())
            if not reason:
                found.append(x)
                if len(found) == _DRAWS:
                    break
        if not found:
            raise InputError(
                f"'{self._machine.name}' cannot even stand still within its limits in "
                f"{_TRIALS} random postures, lastly for {reason}: check it, or lower the margin"
            )
        return np.array(found)

    def fitted(self, x: Array) -> tuple[Array, str]:
        """A vector's amplitudes scaled to what the limits allow, and why it cannot be.

        Joint by joint for strokes, velocities and accelerations, then together for forces and
        loops.
        """
        b, table = self._bounds, x.reshape(self._unit.shape).copy()
        table[0] = np.clip(table[0], -0.95, 0.95)
        q, v, a = Fourier(table * self._unit, self._period)(self._dense)
        swing = q / b.half - table[0]
        room = np.where(swing > 0, 1 - table[0], 1 + table[0])
        used = np.abs([swing / room, v / b.velocity, a / b.acceleration]).max(axis=(0, 1))
        table[1:] *= _WITHIN / np.maximum(used, np.finfo(float).tiny)
        whole = np.ones((len(table), 1))

        def scaled(share: float) -> Array:
            whole[1:] = share
            return (whole * table).ravel()

        if not self._excess(scaled(1.0)):
            return scaled(1.0), ""
        if reason := self._excess(scaled(0.0)):
            return x, reason
        least, most = 0.0, 1.0
        for _ in range(_HALVINGS):
            share = (least + most) / 2
            least, most = (least, share) if self._excess(scaled(share)) else (share, most)
        return scaled(least), ""

    def descend(self, start: Array, progress: Progress) -> Array:
        """The best vector on the way of sequential quadratic programming, fitted.

        Derivatives are differences, all of them computed as one stack of motions.
        """
        from scipy.optimize import Bounds, minimize

        size, n = len(start), self._unit.shape[1]
        count = self.rate(start[None])[1].shape[1]
        kept: dict[str, tuple[bytes, Array, Array]] = {}
        best, least = start, float(self.rate(start[None])[0][0])

        def values(x: Array, steps: Array, kind: str) -> tuple[Array, Array]:
            if kind not in kept or kept[kind][0] != x.tobytes():
                try:
                    kept[kind] = (x.tobytes(), *self.rate(x + steps))
                except ClosureError:
                    rows = len(steps)
                    kept[kind] = (
                        x.tobytes(), np.full(rows, _OUTSIDE), np.full((rows, count), -_OUTSIDE)
                    )  # fmt: skip
            return kept[kind][1:]

        def cost(x: Array) -> float:
            nonlocal best, least
            costs, inside = values(x, np.zeros((1, size)), "value")
            if costs[0] < least and inside.min() > -_SLACK:
                best, least = x.copy(), float(costs[0])
            return float(costs[0])

        def slopes(x: Array) -> tuple[Array, Array]:
            costs, inside = values(x, _SMALL * np.eye(size + 1, size, -1), "slope")
            return (costs[1:] - costs[0]) / _SMALL, (inside[1:] - inside[0]).T / _SMALL

        steps = iter(range(1, _STEPS + 1))

        def report(_: Any) -> None:
            progress(next(steps) / _STEPS)

        within: Any = {
            "type": "ineq",
            "fun": lambda x: values(x, np.zeros((1, size)), "value")[1][0],
            "jac": lambda x: slopes(x)[1],
        }
        # no harmonic of what keeps within 1 is larger than that of a square wave
        most = np.vstack([np.ones((1, n)), np.full((len(self._unit) - 1, n), 4 / np.pi)]).ravel()
        end = minimize(  # type: ignore[call-overload]
            cost,
            start,
            jac=lambda x: slopes(x)[0],
            bounds=Bounds(-most, most),
            constraints=within,
            method="SLSQP",
            options={"maxiter": _STEPS, "ftol": _SETTLED},
            callback=report,
        )
        fitted = [x for x, reason in (self.fitted(best), self.fitted(end.x)) if not reason]
        return min(fitted, key=lambda x: float(self.rate(x[None])[0][0]), default=start)

    def used(self, trajectory: Fourier) -> Array:
        """Largest share of every limit over a whole trajectory, (5, n) as in `QUANTITIES`."""

        def shares(times: Array) -> Array:
            q, v, a = trajectory(times)
            tau = self._dynamics.inverse(q, v, a, friction=True)
            return self._bounds.shares(q, v, a, tau)

        dense = shares(self._dense)
        peaks = shares(self._around(dense.reshape(len(dense), -1)))
        return np.maximum(dense.max(axis=0), peaks.max(axis=0))

    def _around(self, shares: Array) -> Array:
        """Times [s] close around where each of (N, c) shares is largest at the dense instants.

        Where a joint turns, friction steps within milliseconds, and a force's peak is beside it.
        """
        largest = np.unique(shares.argmax(axis=0))
        before = self._dense[np.maximum(largest - 1, 0)]
        after = self._dense[np.minimum(largest + 1, len(self._dense) - 1)]
        return np.unique(np.linspace(before, after, _CLOSE))

    def _excess(self, x: Array) -> str:
        """Which limit a vector's reference exceeds, ways from and to rest included."""
        trajectory = Fourier(self.coefficients(x), self._period)
        try:
            shares = self._shares(self._information.model.samples(*trajectory(self._dense)))
            times = self._around(shares)
            peaks = self._shares(self._information.model.samples(*trajectory(times)))
        except ClosureError:
            return "loops that do not close"
        most = np.maximum(shares.max(axis=0), peaks.max(axis=0))
        return self._names[int(most.argmax())] if most.max() > _WITHIN * (1 + 1e-12) else ""

    def _shares(self, at: Samples) -> Array:
        """Of all limits that there are, (N, c)."""
        tau = self._dynamics.inverse(at.q_a, at.v_a, at.a_a, friction=True)
        shares = self._bounds.shares(at.q_a, at.v_a, at.a_a, tau).reshape(len(tau), -1)
        return np.column_stack([shares[:, self._limited], gear(self._machine, at)])
