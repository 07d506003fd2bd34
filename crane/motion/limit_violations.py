"""Violations of joint limits by a trajectory, found before a simulation runs."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.description.kinematic_tree import Limits
from crane.machine.machine import Machine
from crane.motion.trajectory import Trajectory

_LIMIT_TOLERANCE = 1e-6  # [rad], of the characteristic length
_VELOCITY_LIMIT_TOLERANCE = 1e-6  # relative to a velocity limit
_TIME_TOLERANCE = 1e-6  # [s]
_MIN_SAMPLES, _SAMPLES_PER_SECOND, _MAX_SAMPLES = 100, 100, 20000  # samples

ColumnFunction = Callable[[Array], Array]


def limit_tolerances(machine: Machine) -> Array:
    """Tolerances [m], [rad] by which the coordinates of all joints may exceed a limit."""
    return _LIMIT_TOLERANCE * machine.closure.units


def limit_violation_message(
    machine: Machine, reference: Trajectory, end_time: float = np.inf
) -> str:
    """Message about a reference that leaves the limits of an active joint, or "".

    Args:
        machine: The machine.
        reference: Reference of its active joints.
        end_time: End of the interval that is checked [s].
    """
    lower_bounds, upper_bounds = reference.bounds()
    if lower_bounds.shape != machine.lower.shape:
        return ""  # of another machine; the caller reports that
    tolerances = limit_tolerances(machine)[machine.closure.active]
    if (
        np.maximum(machine.lower - lower_bounds, upper_bounds - machine.upper) <= tolerances
    ).all():
        return ""  # within the limits by its bounds alone
    times = np.unique(
        np.minimum(
            np.append(reference.extremum_times(), _sample_times(reference, end_time)), end_time
        )
    )
    violation = _LimitViolation.find(
        times, reference.position, machine.lower, machine.upper, tolerances
    )
    if violation is None:
        return ""
    joint = machine.active[violation.joint_index]
    return (
        f"the reference of '{joint}' goes to {_violation_text(machine, joint, violation)}: keep "
        "it within, or widen the limits"
    )


def passive_limit_violation_message(
    machine: Machine, reference: Trajectory, end_time: float = np.inf
) -> str:
    """Message about a reference that violates other limits, or "".

    Those are the limits of passive joints, and the velocity limits of all joints.

    Args:
        machine: The machine.
        reference: Reference of its active joints.
        end_time: End of the interval that is checked [s].
    """
    closure, times = machine.closure, _sample_times(reference, end_time)
    if reference.position(times).shape[1] != len(machine.active):
        return ""
    passive = np.delete(np.arange(len(machine.joints)), closure.active)
    lower, upper = machine.coordinates.lower, machine.coordinates.upper

    def joint_velocities(times: Array) -> Array:
        gamma = closure.gamma(closure.solve(reference.position(times)))
        return np.asarray(np.einsum("nij,nj->ni", gamma, reference.velocity(times)))

    try:
        violation = _LimitViolation.find(
            times,
            lambda times: closure.solve(reference.position(times))[:, passive],
            lower[passive],
            upper[passive],
            limit_tolerances(machine)[passive],
        )
    except ClosureError:
        return ""  # a dead centre or an unreachable position: the simulation reports it
    if violation is not None:
        joint = machine.joints[passive[violation.joint_index]]
        return (
            f"the reference takes '{joint}' to {_violation_text(machine, joint, violation)}: keep "
            "it within, or widen the limits"
        )
    limits = [_joint_limits(machine, joint).velocity for joint in machine.joints]
    maximum = np.array([x if x > 0 else np.inf for x in limits])
    tolerances = _VELOCITY_LIMIT_TOLERANCE * np.where(np.isfinite(maximum), maximum, 0)
    violation = _LimitViolation.find(times, joint_velocities, -maximum, maximum, tolerances)
    if violation is None:
        return ""
    joint = machine.joints[violation.joint_index]
    unit = f"{machine.unit(joint)}/s"
    return (
        f"the reference moves '{joint}' with up to {abs(violation.value):.4g} {unit} at t = "
        f"{violation.time:.4g} s, its limit is {abs(violation.limit):.6g} "
        f"{unit}{_limit_location(machine, joint)}, {violation.extent_text}: move slower, or raise "
        f"the limit"
    )


class _LimitViolation(NamedTuple):
    """Largest violation of the limits of a quantity."""

    joint_index: int
    value: float
    limit: float
    time: float
    extent_text: str

    @classmethod
    def find(
        cls, times: Array, evaluate: ColumnFunction, lower: Array, upper: Array, tolerances: Array
    ) -> "_LimitViolation | None":
        """Largest violation of columns (N, n), relative to the range between their limits."""
        q = evaluate(times)
        excess = np.maximum(lower - q, q - upper)
        if not q.shape[1] or not (excess > tolerances).any():
            return None
        from scipy.optimize import brentq, minimize_scalar  # slow to import

        span = upper - lower
        scale = np.where(np.isfinite(span) & (span > 0), span, 1.0)
        relative_excess = np.where(excess > tolerances, excess / scale, -np.inf)
        k, i = (
            int(x) for x in np.unravel_index(int(relative_excess.argmax()), relative_excess.shape)
        )
        is_below = bool(q[k, i] < lower[i])
        limit, sign = float(lower[i] if is_below else upper[i]), -1.0 if is_below else 1.0

        def excess_at(time: float) -> float:
            return float(sign * (evaluate(np.array([time]))[0, i] - limit))

        within_indices = np.flatnonzero(~(excess[:, i] > 0))
        before, after = within_indices[within_indices < k], within_indices[within_indices > k]
        start_time, end_text = times[0], " s on"
        if len(before):
            start, end = times[before[-1]], times[before[-1] + 1]
            start_time = brentq(excess_at, start, end, xtol=_TIME_TOLERANCE)
        if len(after):
            start, end = times[after[0] - 1], times[after[0]]
            end_text = f" to {brentq(excess_at, start, end, xtol=_TIME_TOLERANCE):.4g} s"
        extent_text = f"from t = {start_time:.4g}{end_text}"
        if others := int((excess > tolerances).any(axis=0).sum()) - 1:
            extent_text += f" ({others} other joint{'s' * (others > 1)} likewise)"
        bounds = times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)]
        optimum = minimize_scalar(lambda t: -excess_at(t), bounds=bounds, method="bounded")
        time, largest = float(times[k]), float(excess[k, i])
        if -optimum.fun > largest:
            time, largest = float(optimum.x), float(-optimum.fun)
        return cls(i, limit + sign * largest, limit, time, extent_text)


def _violation_text(machine: Machine, joint: str, violation: _LimitViolation) -> str:
    unit = machine.unit(joint)
    return (
        f"{violation.value:.6g} {unit} at t = {violation.time:.4g} s, beyond "
        f"its limit {violation.limit:.6g} {unit}{_limit_location(machine, joint)} "
        f"{violation.extent_text}"
    )


def _joint_limits(machine: Machine, joint: str) -> Limits:
    """Limits of a joint of the tree, none for a coordinate of a floating base."""
    return machine.tree.joints[joint].limits if joint in machine.tree.joints else Limits()


def _limit_location(machine: Machine, joint: str) -> str:
    location = _joint_limits(machine, joint).source_location
    return f" ({location})" if location else ""


def _sample_times(reference: Trajectory, end_time: float) -> Array:
    end = min(end_time, reference.duration)
    return np.linspace(0.0, end, min(int(_SAMPLES_PER_SECOND * end) + _MIN_SAMPLES, _MAX_SAMPLES))
