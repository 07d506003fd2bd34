"""Reference motions: piecewise polynomials in the active coordinates or in the tip's space."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PPoly, make_interp_spline

from crane.common.errors import InputError, LimitError, known
from crane.common.samples import Array, as_number, as_samples
from crane.machine import Machine
from crane.motion.kinematics import Kinematics

_LIMIT_SLACK = 1e-6  # [rad], [machine's size]
_KNOTS_PER_SECOND = 100
_JUMP = 1e-9  # of the largest value, what no jump is


def limit_slack(machine: Machine) -> Array:
    """(nv,) by how much a reference may pass limits between its knots [m], [rad]."""
    return _LIMIT_SLACK * machine.closure.units


class Trajectory:
    """A motion with two derivatives; before its start and after its end it stands still.

    Args:
        curve: Piecewise polynomial of time from 0 [s], values (n,).
        tip: The same motion of the tip, values (3,) [m], where the trajectory was given there.

    Attributes:
        duration: [s].
        tip: See above.
    """

    def __init__(self, curve: PPoly, tip: "Trajectory | None" = None):
        self.duration = float(curve.x[-1])
        self.tip = tip
        self._curves = (curve, curve.derivative(), curve.derivative(2))

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
        rests = [np.ravel(roots) for roots in np.ravel(rate.roots(extrapolate=False))]
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
    return Trajectory(PPoly(table, [0.0, duration]))


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


def tip_trajectory(
    machine: Machine, tip: Trajectory, guess: ArrayLike | None = None
) -> Trajectory:
    """The motion of the active joints that moves the tip along a trajectory.

    Positions at knots every 10 ms come from inverse kinematics, and so do velocities and
    accelerations, v_A = J^-1 x', a_A = J^-1 (x'' - bias); quintics join them. A machine with more
    than three active joints moves them as little as it can from knot to knot, and its velocities
    and accelerations are those of the quintic spline through the knots.

    Args:
        machine: The machine.
        tip: Trajectory of the tip in the world [m].
        guess: (n,) active coordinates near the start.

    Returns:
        Trajectory of q_A, with `tip` set.

    Raises:
        UnreachableTipError: The trajectory leaves the reach.
    """
    kinematics = Kinematics(machine)
    count = max(6, int(np.ceil(tip.duration * _KNOTS_PER_SECOND)) + 1)
    time = np.linspace(0.0, tip.duration, count)
    x, x_rate, x_second = tip(time)
    q_a = kinematics.inverse(x, guess)
    if machine.driven.sum() > x.shape[1]:
        spline = make_interp_spline(time, q_a, k=5)
        return Trajectory(quintics(time, q_a, spline(time, 1), spline(time, 2)), tip)
    jacobian = np.linalg.pinv(kinematics.jacobian(q_a) * machine.driven)
    v_a = np.einsum("ijk,ik->ij", jacobian, x_rate)
    a_a = np.einsum("ijk,ik->ij", jacobian, x_second - kinematics.bias(q_a, v_a))
    return Trajectory(quintics(time, q_a, v_a, a_a), tip)


def quintics(time: Array, x: Array, v: Array, a: Array) -> PPoly:
    """Polynomials of fifth order between knots (N,) with values and derivatives (N, n).

    With u = t - t_i, h = t_i+1 - t_i and what the second order misses at u = h,

        d = x_i+1 - x_i - v_i h - a_i h^2/2,   e = v_i+1 - v_i - a_i h,   f = a_i+1 - a_i,
        x = x_i + v_i u + a_i u^2/2 + (10 d - 4 e h + f h^2/2) (u/h)^3
            + (-15 d + 7 e h - f h^2) (u/h)^4 + (6 d - 3 e h + f h^2/2) (u/h)^5.
    """
    h = np.diff(time)[:, None]
    d = x[1:] - x[:-1] - h * (v[:-1] + h * a[:-1] / 2)
    e = h * (v[1:] - v[:-1] - h * a[:-1])
    f = h * h * (a[1:] - a[:-1])
    rows = [
        (6 * d - 3 * e + f / 2) / h**5,
        (-15 * d + 7 * e - f) / h**4,
        (10 * d - 4 * e + f / 2) / h**3,
        a[:-1] / 2,
        v[:-1],
        x[:-1],
    ]
    return PPoly(np.array(rows), time)


class _WithFree(Trajectory):
    """A reference of the driven joints beside free joints that stay where they start."""

    def __init__(self, reference: Trajectory, driven: NDArray[np.bool_], start: Array):
        self.duration, self.tip = reference.duration, reference.tip
        self._reference, self._driven, self._start = reference, driven, start

    def position(self, time: ArrayLike) -> Array:
        """See `Trajectory`."""
        return self._beside(self._reference.position(time), self._start)

    def _rate(self, order: int, time: ArrayLike) -> Array:
        return self._beside(self._reference._rate(order, time), np.zeros_like(self._start))

    def bounds(self) -> tuple[Array, Array]:
        """See `Trajectory`."""
        least, most = self._reference.bounds()
        return self._beside(least, self._start), self._beside(most, self._start)

    def turns(self) -> Array:
        """See `Trajectory`."""
        return self._reference.turns()

    def breaks(self) -> Array:
        """See `Trajectory`."""
        return self._reference.breaks()

    def _beside(self, x: Array, others: Array) -> Array:
        out = np.tile(others, (*x.shape[:-1], 1) if x.ndim > 1 else 1)
        out[..., self._driven] = x if x.shape[-1] < len(others) else x[..., self._driven]
        return out


def with_free(machine: Machine, reference: Trajectory) -> Trajectory:
    """A reference of the driven joints as one of all active joints (n,).

    Free joints follow none. Their columns only say where they start: at home, or where those of a
    reference of all joints do.

    Raises:
        InputError: It is neither of the driven joints nor of all.
    """
    if not machine.free:
        return reference
    start, names = reference.position(0.0), machine.driven_joints
    if len(start) not in (len(names), len(machine.active)):
        raise InputError(
            f"the reference has {len(start)} coordinates, give the {len(names)} of the driven "
            f"joints ({', '.join(names)}) or those of all {len(machine.active)}"
        )
    if len(start) == len(names):
        start = machine.home[machine.closure.active]
    return _WithFree(reference, machine.driven, start)


def task_trajectory(machine: Machine, task: str) -> Trajectory:
    """Trajectory of the active joints of a named task of the machine.

    Raises:
        InputError: The machine has no such task.
        UnreachableTipError: It leaves the reach.
        LimitError: It leaves the limits of an active joint.
    """
    if task not in machine.tasks:
        raise InputError(
            f"machine '{machine.name}' has no task '{task}', {known(machine.tasks, task)}"
        )
    chosen = machine.tasks[task]
    if chosen.space == "joystick":
        raise InputError(f"task '{task}' moves levers, it has no trajectory")
    if chosen.space == "tip":
        rows = [chosen.coefficients[axis] for axis in ("x", "y", "z")]
        return tip_trajectory(machine, polynomial(rows, chosen.duration))
    rows = [chosen.coefficients[name] for name in machine.active if name not in machine.free]
    found = with_free(machine, polynomial(rows, chosen.duration))
    if text := beyond_limits(machine, found):
        raise LimitError(f"task '{task}': {text}")
    return found


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
    times = np.unique(np.minimum(reference.turns(), until))
    q_a = reference.position(times)
    excess = np.maximum(machine.lower - q_a, q_a - machine.upper)
    if not (excess > slack).any():
        return ""
    span = machine.upper - machine.lower
    shares = excess / np.where(
        np.isfinite(span), span, machine.closure.units[machine.closure.active]
    )
    k, i = np.unravel_index(int(shares.argmax()), shares.shape)
    joint, value = machine.active[i], q_a[k, i]
    limit = machine.lower[i] if value < machine.lower[i] else machine.upper[i]
    unit = machine.unit(joint)
    place = machine.tree.joints[joint].limits.where
    others = int((excess > slack).any(axis=0).sum()) - 1
    more = f" ({others} other joint{'s' * (others > 1)} likewise)" if others else ""
    return (
        f"the reference of '{joint}' goes to {value:.6g} {unit} at t = {times[k]:.4g} s, beyond "
        f"its limit {limit:.6g} {unit}{f' ({place})' if place else ''}{more}: keep it within, or "
        "widen the limits"
    )
