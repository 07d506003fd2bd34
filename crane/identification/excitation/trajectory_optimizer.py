"""Optimization of excitation trajectories, from random trajectories within the limits."""

from collections.abc import Callable
from typing import Any

import numpy as np

from crane.common.errors import ClosureError, InputError
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.identification.excitation.fisher_information import FisherInformation
from crane.identification.excitation.fourier_trajectory import FourierTrajectory, fourier_basis
from crane.identification.excitation.trajectory_limits import (
    QUANTITIES,
    TrajectoryLimits,
    singularity_proximity,
)
from crane.identification.mechanics.model_term import MotionSamples

DENSE_SAMPLES = 64  # samples per period of the highest harmonic, for checks of limits
COARSE_SAMPLES = 12  # the same for the optimization
# limit at samples, so that shares do not exceed 1 in between
_SAMPLED_LIMIT = float(np.cos(np.pi / DENSE_SAMPLES))
_PEAK_INSTANTS = 33  # instants around the one with the largest share
# random trajectories within the limits, and largest number of trials
_RANDOM_COUNT, _MAX_TRIALS = 20, 200
_MAX_BISECTIONS = 10  # of the interval of the largest amplitude
_NORM_ORDER = 80  # order of the norm in place of the maximum over time, for derivatives
_MAX_ITERATIONS = 150  # of sequential quadratic programming
_COST_TOLERANCE = 1e-3  # change of the cost at convergence
_DIFFERENCE_STEP = 1e-6  # step of differences of scaled coefficients
_INFEASIBLE_COST = 1e3  # cost and constraint violation if loops do not close
_CONSTRAINT_TOLERANCE = 1e-3  # violation that the final scaling removes

Progress = Callable[[float], None]


class TrajectoryOptimizer:
    """Costs and constraints of trajectories with scaled coefficients x.

    The units of x are half a stroke for the middle, and for every harmonic its largest possible
    amplitude alone.

    Args:
        information: Fisher information to be maximized.
        limits: Limits of the trajectories.
        period: [s].
        harmonics: Number of harmonics K.
        sample_count: Number of samples of the recording.
        criterion: See `crane.identification.excitation.fisher_information.CRITERIA`.
    """

    def __init__(
        self,
        information: FisherInformation,
        limits: TrajectoryLimits,
        period: float,
        harmonics: int,
        sample_count: float,
        criterion: Callable[[Array], Array],
    ):
        self._information, self._limits, self._criterion = information, limits, criterion
        self._machine, self._sample_count, self._period = (
            information.model.machine,
            sample_count,
            period,
        )
        self._dynamics = Dynamics(self._machine)
        n = len(limits.half_stroke)
        samples = max(COARSE_SAMPLES * harmonics, -(-2 * information.base.rank // n))
        self._bases = fourier_basis(period * np.arange(samples) / samples, harmonics, period)
        wk = 2 * np.pi / period * np.arange(1, harmonics + 1)[:, None]
        max_amplitudes = np.minimum(
            limits.velocity, np.minimum(wk * limits.half_stroke, limits.acceleration / wk)
        )
        self._units = np.vstack([limits.half_stroke, max_amplitudes, max_amplitudes])
        self._offset = np.zeros_like(self._units)
        self._offset[0] = limits.stroke_middle
        self._dense_times = np.linspace(0, 2 * period, 2 * DENSE_SAMPLES * harmonics + 1)
        all_names = [
            f"the {what} limit of '{joint}'"
            for what in QUANTITIES
            for joint in self._machine.active
        ]
        self._is_limited = np.isfinite(limits.as_array).ravel()
        names = [
            name for name, limited in zip(all_names, self._is_limited, strict=True) if limited
        ]
        self._limit_names = [*names, "the edge of the assembly branch"]

    def coefficients(self, x: Array) -> Array:
        """Coefficients (..., 1 + 2 K, n), see `FourierTrajectory`, of vectors (..., size)."""
        return self._offset + x.reshape(*x.shape[:-1], *self._units.shape) * self._units

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Costs (V,) of vectors (V, size), and constraints (V, c), 1 - used share of a limit >= 0.

        Raises:
            ClosureError: Loops do not close.
        """
        motion_count, n = len(x), self._units.shape[1]
        coefficients = self.coefficients(x)
        q, v, a = ((basis @ coefficients).reshape(-1, n) for basis in self._bases)
        at = self._information.model.samples(
            q, v, a, self._period * motion_count / len(q), range(0, len(q), len(q) // motion_count)
        )
        costs = self._criterion(
            self._information.singular_values(at, self._sample_count, motion_count)
        )
        shares = self._limit_usage_at(at).reshape(motion_count, len(q) // motion_count, -1)
        largest = shares.max(axis=1, keepdims=True) + np.finfo(float).tiny
        norms = largest[:, 0] * np.linalg.norm(shares / largest, _NORM_ORDER, axis=1)
        return costs, 1 - norms

    def random_references(self, rng: np.random.Generator) -> Array:
        """Random vectors (V, size) of trajectories, scaled to the limits.

        Raises:
            InputError: No trajectory is within the limits.
        """
        vectors: list[Array] = []
        for _ in range(_MAX_TRIALS):
            table = rng.normal(size=self._units.shape)
            table[0] = rng.uniform(-0.6, 0.6, table.shape[1])
            x, reason = self.scale_to_limits(table.ravel())
            if not reason:
                vectors.append(x)
                if len(vectors) == _RANDOM_COUNT:
                    break
        if not vectors:
            raise InputError(
                f"'{self._machine.name}' has no reference within its limits in {_MAX_TRIALS} "
                f"random configurations, lastly for {reason}: check it, or lower the margin"
            )
        return np.array(vectors)

    def scale_to_limits(self, x: Array) -> tuple[Array, str]:
        """Scale the amplitudes of a vector to the limits; returns also "" or an exceeded limit.

        Amplitudes are scaled by joint for strokes, velocities and accelerations, then together for
        forces and loops.
        """
        limits, table = self._limits, x.reshape(self._units.shape).copy()
        table[0] = np.clip(table[0], -0.95, 0.95)
        q, v, a = FourierTrajectory(table * self._units, self._period)(self._dense_times)
        swing = q / limits.half_stroke - table[0]
        available = np.where(swing > 0, 1 - table[0], 1 + table[0])
        usage = np.abs([swing / available, v / limits.velocity, a / limits.acceleration]).max(
            axis=(0, 1)
        )
        table[1:] *= _SAMPLED_LIMIT / np.maximum(usage, np.finfo(float).tiny)
        factors = np.ones((len(table), 1))

        def scaled(share: float) -> Array:
            factors[1:] = share
            return (factors * table).ravel()

        if not self._exceeded_limit(scaled(1.0)):
            return scaled(1.0), ""
        if reason := self._exceeded_limit(scaled(0.0)):
            return x, reason
        feasible_share, infeasible_share = 0.0, 1.0
        for _ in range(_MAX_BISECTIONS):
            share = (feasible_share + infeasible_share) / 2
            feasible_share, infeasible_share = (
                (feasible_share, share)
                if self._exceeded_limit(scaled(share))
                else (share, infeasible_share)
            )
        return scaled(feasible_share), ""

    def optimize(self, start: Array, progress: Progress) -> Array:
        """Optimize a vector by sequential quadratic programming, and scale it to the limits.

        Derivatives are difference quotients, computed as one stack of motions.
        """
        from scipy.optimize import Bounds, minimize

        size, n = len(start), self._units.shape[1]
        count = self.evaluate(start[None])[1].shape[1]
        cache: dict[str, tuple[bytes, Array, Array]] = {}
        best, lowest_cost = start, float(self.evaluate(start[None])[0][0])

        def values(x: Array, steps: Array, kind: str) -> tuple[Array, Array]:
            if kind not in cache or cache[kind][0] != x.tobytes():
                try:
                    cache[kind] = (x.tobytes(), *self.evaluate(x + steps))
                except ClosureError:
                    rows = len(steps)
                    cache[kind] = (
                        x.tobytes(),
                        np.full(rows, _INFEASIBLE_COST),
                        np.full((rows, count), -_INFEASIBLE_COST),
                    )
            return cache[kind][1:]

        def cost(x: Array) -> float:
            nonlocal best, lowest_cost
            costs, inside = values(x, np.zeros((1, size)), "value")
            if costs[0] < lowest_cost and inside.min() > -_CONSTRAINT_TOLERANCE:
                best, lowest_cost = x.copy(), float(costs[0])
            return float(costs[0])

        def gradients(x: Array) -> tuple[Array, Array]:
            costs, inside = values(x, _DIFFERENCE_STEP * np.eye(size + 1, size, -1), "slope")
            return (costs[1:] - costs[0]) / _DIFFERENCE_STEP, (
                inside[1:] - inside[0]
            ).T / _DIFFERENCE_STEP

        steps = iter(range(1, _MAX_ITERATIONS + 1))

        def report(_: Any) -> None:
            progress(next(steps) / _MAX_ITERATIONS)

        constraint: Any = {
            "type": "ineq",
            "fun": lambda x: values(x, np.zeros((1, size)), "value")[1][0],
            "jac": lambda x: gradients(x)[1],
        }
        # a harmonic of a function within 1 is at most that of a square wave
        amplitude_bounds = np.vstack(
            [np.ones((1, n)), np.full((len(self._units) - 1, n), 4 / np.pi)]
        ).ravel()
        result = minimize(  # type: ignore[call-overload]
            cost,
            start,
            jac=lambda x: gradients(x)[0],
            bounds=Bounds(-amplitude_bounds, amplitude_bounds),
            constraints=constraint,
            method="SLSQP",
            options={"maxiter": _MAX_ITERATIONS, "ftol": _COST_TOLERANCE},
            callback=report,
        )
        scaled_vectors = [
            x
            for x, reason in (self.scale_to_limits(best), self.scale_to_limits(result.x))
            if not reason
        ]
        return min(
            scaled_vectors, key=lambda x: float(self.evaluate(x[None])[0][0]), default=start
        )

    def limit_usage(self, trajectory: FourierTrajectory) -> Array:
        """Largest used share (5, n) of every limit over a trajectory, by `QUANTITIES`."""

        def shares(times: Array) -> Array:
            q, v, a = trajectory(times)
            tau = self._dynamics.inverse(q, v, a, friction=True)
            return self._limits.usage(q, v, a, tau)

        dense = shares(self._dense_times)
        peaks = shares(self._times_near_peaks(dense.reshape(len(dense), -1)))
        return np.maximum(dense.max(axis=0), peaks.max(axis=0))

    def _times_near_peaks(self, shares: Array) -> Array:
        """Times [s] around the maxima of the shares (N, c) at the dense instants.

        At a reversal friction jumps within milliseconds, and the peak of the force is next to it.
        """
        largest = np.unique(shares.argmax(axis=0))
        before = self._dense_times[np.maximum(largest - 1, 0)]
        after = self._dense_times[np.minimum(largest + 1, len(self._dense_times) - 1)]
        return np.unique(np.linspace(before, after, _PEAK_INSTANTS))

    def _exceeded_limit(self, x: Array) -> str:
        """Name of a limit that a trajectory with its parts from and to rest exceeds, or ""."""
        trajectory = FourierTrajectory(self.coefficients(x), self._period)
        try:
            shares = self._limit_usage_at(
                self._information.model.samples(*trajectory(self._dense_times))
            )
            times = self._times_near_peaks(shares)
            peaks = self._limit_usage_at(self._information.model.samples(*trajectory(times)))
        except ClosureError:
            return "loops that do not close"
        largest = np.maximum(shares.max(axis=0), peaks.max(axis=0))
        return (
            self._limit_names[int(largest.argmax())]
            if largest.max() > _SAMPLED_LIMIT * (1 + 1e-12)
            else ""
        )

    def _limit_usage_at(self, samples: MotionSamples) -> Array:
        """Used shares (N, c) of all finite limits."""
        tau = self._dynamics.inverse(samples.q_a, samples.v_a, samples.a_a, friction=True)
        shares = self._limits.usage(samples.q_a, samples.v_a, samples.a_a, tau).reshape(
            len(tau), -1
        )
        return np.column_stack(
            [shares[:, self._is_limited], singularity_proximity(self._machine, samples)]
        )
