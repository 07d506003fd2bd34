"""Limits of excitation trajectories, and their optimization from random ones within them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from crane.common.errors import ClosureError, InputError, check_name
from crane.common.progress import Progress
from crane.common.samples import Array, as_number
from crane.dynamics.dynamics import Dynamics
from crane.identification.excitation.fisher_information import FisherInformation
from crane.identification.excitation.fourier_trajectory import FourierTrajectory, fourier_basis
from crane.identification.mechanics.base_parameters import HALF_TURN
from crane.identification.mechanics.model_terms import MotionSamples
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_mapping import stroke_limits

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

QUANTITIES = ("stroke", "velocity", "acceleration", "force", "flow")
_SINGULARITY_GAIN = 5.0  # ratio of gamma to that at home, near the end of the branch


@dataclass(frozen=True, eq=False)
class TrajectoryLimits:
    """Limits of a trajectory, infinite if there is no limit.

    Attributes:
        stroke_middle: (n,) middle of the strokes [m], [rad].
        half_stroke: (n,) half lengths of the strokes.
        velocity: (n,) velocity limits.
        acceleration: (n,) acceleration limits.
        force: (n,) force limits [N], [N m].
        flow: (n,) flow of the pump that feeds a joint [m3/s].
        areas: (2, n, n) areas A and B of joint j if one pump feeds i and j, else 0 [m2], [m3/rad]:
            the flow of the pump of i is the sum over j of max(A_ij v_j, -B_ij v_j).
    """

    stroke_middle: Array
    half_stroke: Array
    velocity: Array
    acceleration: Array
    force: Array
    flow: Array
    areas: Array

    @property
    def as_array(self) -> Array:
        """Limits (5, n) by `QUANTITIES`, with half lengths of strokes."""
        return np.stack(
            [self.half_stroke, self.velocity, self.acceleration, self.force, self.flow]
        )

    def usage(self, q_a: Array, v_a: Array, a_a: Array, tau: Array) -> Array:
        """Used share (..., 5, n) of the limits by a motion, 1 at a limit, by `QUANTITIES`."""
        out, back = self.areas
        drawn = np.maximum(v_a, 0.0) @ out.T + np.maximum(-v_a, 0.0) @ back.T
        return (
            np.abs(np.stack([q_a - self.stroke_middle, v_a, a_a, tau, drawn], axis=-2))
            / self.as_array
        )


def trajectory_limits(
    machine: Machine, acceleration: Mapping[str, float] | None = None, margin: float = 0.05
) -> TrajectoryLimits:
    """Limits of the active joints: strokes, velocities, forces, and flows of pumps.

    An unlimited joint stays within 1 rad, or the characteristic length, of home. Accelerations
    need no separate limit: for a velocity below V with harmonics up to K w they are below K w V
    (Bernstein).

    Args:
        machine: The machine.
        acceleration: Acceleration limits by active joint [m/s2], [rad/s2].
        margin: Unused share of every limit, at both ends of a stroke.

    Raises:
        InputError: Joints are unknown, or limits are zero.
    """
    if not 0 <= as_number(margin, "the margin", "") < 1:
        raise InputError(f"the margin is {margin:g}, give a share from 0 to below 1")
    columns = machine.closure.active
    lower, upper = stroke_limits(machine, HALF_TURN)
    velocity, flow, areas = _fed(machine)
    found = TrajectoryLimits(
        (lower + upper) / 2,
        (upper - lower) / 2 * (1 - margin),
        np.minimum(machine.model.velocityLimit[columns], velocity) * (1 - margin),
        joint_values(machine, acceleration, "acceleration", np.full(len(columns), np.inf))
        * (1 - margin),
        machine.model.effortLimit[columns] * (1 - margin),
        flow * (1 - margin),
        areas,
    )
    for what, values in zip(QUANTITIES, found.as_array, strict=True):
        immovable = [x for x, value in zip(machine.active, values, strict=True) if not value > 0]
        if immovable:
            raise InputError(f"the {what} limit of '{immovable[0]}' is 0, give one above")
    return found


def _fed(machine: Machine) -> tuple[Array, Array, Array]:
    """Velocity limits of each joint alone by valve and pump, flows, and areas.

    A compensated valve has the largest flow c sqrt(margin), any valve that of its pump.
    """
    n = len(machine.active)
    velocity, flow, areas = np.full(n, np.inf), np.full(n, np.inf), np.zeros((2, n, n))
    hydraulics = machine.hydraulics
    if hydraulics is None:
        return velocity, flow, areas
    column = {joint: machine.active.index(joint) for joint in hydraulics.joints}
    for joint, i in column.items():
        valve, cylinder = hydraulics.valves[joint], hydraulics.cylinders[joint]
        pump = hydraulics.pumps[valve.supply]
        flow[i] = pump.flow or np.inf
        for edge, area in ((valve.c1, cylinder.area_a), (valve.c4, cylinder.area_b)):
            most = edge * np.sqrt(valve.margin) if valve.margin else np.inf
            velocity[i] = min(velocity[i], most / area, flow[i] / area)
        sharing = [x for x in column if pump.flow and hydraulics.valves[x].supply == valve.supply]
        for other in sharing:
            beside = hydraulics.cylinders[other]
            areas[:, i, column[other]] = beside.area_a, beside.area_b
    return velocity, flow, areas


def joint_values(
    machine: Machine, given: Mapping[str, float] | None, what: str, default: Array
) -> Array:
    """Positive values (n,) by active joint, with defaults.

    Raises:
        InputError: A joint is unknown, or a value is not positive.
    """
    out = default.copy()
    for joint, value in (given or {}).items():
        check_name(joint, machine.active, f"{what} of '{joint}', which is not active")
        out[machine.active.index(joint)] = as_number(
            value, f"{what} of '{joint}'", "", greater_than=0
        )
    return out


def singularity_proximity(machine: Machine, samples: MotionSamples) -> Array:
    """Proximity (N,) of configurations to the end of the branch, 1 at the limit.

    It is |gamma_P diag(span)| / (5 |...| at home). Near the end of the branch small active motions
    cause large passive ones, which drives cannot follow.
    """
    lower, upper = stroke_limits(machine, HALF_TURN)
    rows, span = machine.closure.passive, upper - lower

    def size(gamma: Array) -> Array:
        return np.linalg.norm(gamma[..., rows, :] * span, axis=(-2, -1))

    home = float(size(machine.closure.gamma(machine.home)))
    return size(samples.gamma) / (_SINGULARITY_GAIN * home) if home else np.zeros(len(samples.q))


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
        return costs, 1 - largest[:, 0] * np.linalg.norm(shares / largest, _NORM_ORDER, axis=1)

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
            return self._limits.usage(q, v, a, self._dynamics.inverse(q, v, a, friction=True))

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
