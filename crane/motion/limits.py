"""Where a reference leaves the limits of joints, told before it is tried."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.curves import Trajectory

_LIMIT_SLACK = 1e-6  # [rad], [machine's size]
_SPEED_SLACK = 1e-6  # of a velocity limit
_CLOSE = 1e-6  # [s]
_LEAST, _PER_SECOND, _MOST = 100, 100, 20000  # samples

Columns = Callable[[Array], Array]


def limit_slack(machine: Machine) -> Array:
    """By how much the coordinates of all joints may pass a limit [m], [rad], which is rounding."""
    return _LIMIT_SLACK * machine.closure.units


def beyond_limits(machine: Machine, reference: Trajectory, until: float = np.inf) -> str:
    """What to say of a reference that leaves the limits of an active joint, else nothing.

    Args:
        machine: The machine.
        reference: Reference of its active joints.
        until: End of what is looked at [s].
    """
    least, most = reference.bounds()
    if least.shape != machine.lower.shape:
        return ""  # of another machine, which is told elsewhere
    slack = limit_slack(machine)[machine.closure.active]
    if (np.maximum(machine.lower - least, most - machine.upper) <= slack).all():
        return ""  # without a look where it turns
    times = np.unique(np.minimum(np.append(reference.turns(), _times(reference, until)), until))
    found = _Beyond.of(times, reference.position, machine.lower, machine.upper, slack)
    if found is None:
        return ""
    joint, more = machine.active[found.joint], _more(found.others)
    return (
        f"the reference of {_told(machine, joint, found)}{more}: keep it within, or widen the "
        "limits"
    )


def carried_beyond(machine: Machine, reference: Trajectory, until: float = np.inf) -> str:
    """What to say of a reference that takes other joints beyond their limits, else nothing.

    Those are the passive ones, closed loop by loop, and the velocities of all.

    Args:
        machine: The machine.
        reference: Reference of its active joints.
        until: End of what is looked at [s].
    """
    closure, times = machine.closure, _times(reference, until)
    if reference.position(times).shape[1] != len(machine.active):
        return ""
    passive = np.delete(np.arange(len(machine.joints)), closure.active)
    lower, upper = machine.coordinates.lower, machine.coordinates.upper

    def carried(times: Array) -> Array:
        return closure.solve(reference.position(times))[:, passive]

    def speeds(times: Array) -> Array:
        gamma = closure.gamma(closure.solve(reference.position(times)))
        return np.asarray(np.einsum("nij,nj->ni", gamma, reference.velocity(times)))

    try:
        found = _Beyond.of(
            times, carried, lower[passive], upper[passive], limit_slack(machine)[passive]
        )
    except ClosureError:
        return ""  # a dead centre, or beyond the reach: the run tells which
    if found is not None:
        joint = machine.joints[passive[found.joint]]
        return (
            f"the reference takes {_told(machine, joint, found, 'to')}{_more(found.others)}: keep "
            "it within, or widen the limits"
        )
    most = np.array(
        [
            machine.tree.joints[joint].limits.velocity if joint in machine.tree.joints else np.inf
            for joint in machine.joints
        ]
    )
    most[most <= 0] = np.inf
    found = _Beyond.of(
        times, speeds, -most, most, _SPEED_SLACK * np.where(np.isfinite(most), most, 0)
    )
    if found is None:
        return ""
    joint = machine.joints[found.joint]
    unit = f"{machine.unit(joint)}/s"
    return (
        f"the reference moves '{joint}' with up to {abs(found.value):.4g} {unit} at t = "
        f"{found.time:.4g} s, its limit is {abs(found.limit):.6g} {unit}{_place(machine, joint)}, "
        f"{found.when}{_more(found.others)}: move slower, or raise the limit"
    )


class _Beyond(NamedTuple):
    """Where a column is farthest beyond its limits."""

    joint: int
    value: float
    limit: float
    time: float
    when: str
    others: int

    @classmethod
    def of(
        cls, times: Array, at: Columns, lower: Array, upper: Array, slack: Array
    ) -> "_Beyond | None":
        """The worst of what has columns (N, n), as a share of what lies between the limits."""
        q = at(times)
        excess = np.maximum(lower - q, q - upper)
        if not q.shape[1] or not (excess > slack).any():
            return None
        span = upper - lower
        scale = np.where(np.isfinite(span) & (span > 0), span, 1.0)
        shares = np.where(excess > slack, excess / scale, -np.inf)
        k, i = (int(x) for x in np.unravel_index(int(shares.argmax()), shares.shape))
        below = bool(q[k, i] < lower[i])
        limit, sign = float(lower[i] if below else upper[i]), -1.0 if below else 1.0
        others = int((excess > slack).any(axis=0).sum()) - 1

        def beyond(time: float) -> float:
            return float(sign * (at(np.array([time]))[0, i] - limit))

        when = _when(times, excess[:, i], k, beyond)
        time, most = _highest(times, excess[:, i], k, beyond)
        return cls(i, limit + sign * most, limit, time, when, others)


def _highest(
    times: Array, excess: Array, k: int, at: Callable[[float], float]
) -> tuple[float, float]:
    """When it is farthest beyond, around sample k, and by how much."""
    from scipy.optimize import minimize_scalar

    ends = times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)]
    found = minimize_scalar(lambda t: -at(t), bounds=ends, method="bounded")
    if -found.fun > excess[k]:
        return float(found.x), float(-found.fun)
    return float(times[k]), float(excess[k])


def _when(times: Array, excess: Array, k: int, at: Callable[[float], float]) -> str:
    """From when to when it is beyond around sample k, with what it is at any time."""
    from scipy.optimize import brentq

    first = last = k
    while first > 0 and excess[first - 1] > 0:
        first -= 1
    while last < len(times) - 1 and excess[last + 1] > 0:
        last += 1
    begins = times[first]
    if first > 0:
        begins = brentq(at, times[first - 1], begins, xtol=_CLOSE)
    if last == len(times) - 1:
        return f"from t = {begins:.4g} s on"
    return (
        f"from t = {begins:.4g} to {brentq(at, times[last], times[last + 1], xtol=_CLOSE):.4g} s"
    )


def _told(machine: Machine, joint: str, found: _Beyond, word: str = "goes to") -> str:
    unit = machine.unit(joint)
    return (
        f"'{joint}' {word} {found.value:.6g} {unit} at t = {found.time:.4g} s, beyond its limit "
        f"{found.limit:.6g} {unit}{_place(machine, joint)} {found.when}"
    )


def _place(machine: Machine, joint: str) -> str:
    place = machine.tree.joints[joint].limits.where if joint in machine.tree.joints else ""
    return f" ({place})" if place else ""


def _more(others: int) -> str:
    return f" ({others} other joint{'s' * (others > 1)} likewise)" if others else ""


def _times(reference: Trajectory, until: float) -> Array:
    end = min(until, reference.duration)
    return np.linspace(0.0, end, min(int(_PER_SECOND * end) + _LEAST, _MOST))
