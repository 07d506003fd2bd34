"""Reference motions: piecewise polynomials in the active coordinates or in the tip's space."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crane.codegen import kept_result
from crane.common.errors import InputError, LimitError, known
from crane.common.samples import Array
from crane.description.spec import TIP, Task, Via
from crane.machine import Machine
from crane.motion.attitude import INCLINATION, Turning, via_attitudes
from crane.motion.curves import Trajectory, polynomial, via_points
from crane.motion.kinematics import Kinematics
from crane.motion.limits import beyond_limits
from crane.motion.piecewise import Piecewise
from crane.motion.splines import quintics

_KNOTS_PER_SECOND = 100


def tip_trajectory(
    machine: Machine,
    tip: Trajectory,
    guess: ArrayLike | None = None,
    attitude: Trajectory | Turning | None = None,
) -> Trajectory:
    """The motion of the active joints that moves the tip along a trajectory.

    Positions at knots every 10 ms come from inverse kinematics, and so do velocities and
    accelerations, v_A = J^-1 x', a_A = J^-1 (x'' - bias); quintics join them. A machine with more
    active joints than there are coordinates moves them as little as it can from knot to knot, and
    its velocities and accelerations are those of the quintic spline through the knots.

    Args:
        machine: The machine.
        tip: Trajectory of the tip in the world [m].
        guess: (n,) active coordinates near the start.
        attitude: Of the tip's frame meanwhile: its inclination (1,) [rad], or its rotation, see
            `via_attitudes`. Left open if not given.

    Returns:
        Trajectory of q_A, with `tip` and `attitude` set.

    Raises:
        InputError: The attitude takes another time, or the machine has no drives for it.
        UnreachableTipError: The trajectory leaves the reach.
    """
    kinematics = Kinematics(machine)
    count = max(6, int(np.ceil(tip.duration * _KNOTS_PER_SECOND)) + 1)
    time = np.linspace(0.0, tip.duration, count)
    x, x_rate, x_second = tip(time)
    name, goal = None, None
    if attitude is not None:
        if attitude.duration != tip.duration:
            raise InputError(
                f"the tip takes {tip.duration:g} s and its attitude {attitude.duration:g} s, give "
                "them the same time"
            )
        name = "rotation" if isinstance(attitude, Turning) else INCLINATION
        goal, rate, second = attitude(time)
        goal = goal if isinstance(attitude, Turning) else goal[:, 0]
        x_rate, x_second = np.hstack([x_rate, rate]), np.hstack([x_second, second])
    q_a = kinematics.tracked(x, guess, goal, time)
    if machine.driven.sum() > x_rate.shape[1]:
        from scipy.interpolate import make_interp_spline  # slow to import

        spline = make_interp_spline(time, q_a, k=5)
        v_a, a_a = spline(time, 1), spline(time, 2)
    else:
        jacobian = np.linalg.pinv(kinematics.jacobian(q_a, name) * machine.driven)
        v_a = np.einsum("ijk,ik->ij", jacobian, x_rate)
        a_a = np.einsum("ijk,ik->ij", jacobian, x_second - kinematics.bias(q_a, v_a, name))
    return Trajectory(quintics(time, q_a, v_a, a_a), tip, attitude)


class _WithFree(Trajectory):
    """A reference of the driven joints beside free joints that stay where they start."""

    def __init__(self, reference: Trajectory, driven: NDArray[np.bool_], start: Array):
        self.duration = reference.duration
        self.tip, self.attitude = reference.tip, reference.attitude
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
    closure = machine.closure
    depends = (
        closure.parts, closure.structure, machine.home, machine.lower, machine.upper,
        machine.active, machine.driven, machine.tip, chosen.space, chosen.duration,
        tuple((name, tuple(row)) for name, row in chosen.coefficients.items()),
        tuple((x.time, tuple(x.point.items()), tuple(x.rates.items())) for x in chosen.via),
    )  # fmt: skip
    classes = Trajectory, _WithFree, Turning, Piecewise
    return kept_result(
        ("task", depends), lambda: _followed(machine, chosen), "scipy.interpolate", classes
    )


def _followed(machine: Machine, chosen: Task) -> Trajectory:
    if chosen.space == "tip":
        tip = _curve(chosen, TIP)
        attitude: Trajectory | Turning | None = None
        names = [name for name in chosen.coordinates if name not in TIP]
        if names == [INCLINATION]:
            attitude = _curve(chosen, names)
        elif names:
            attitude = via_attitudes(*_table(chosen.via, names))
        return tip_trajectory(machine, tip, None, attitude)
    found = with_free(machine, _curve(chosen, machine.driven_joints))
    if text := beyond_limits(machine, found):
        raise LimitError(f"task '{chosen.name}': {text}")
    return found


def _curve(task: Task, names: Sequence[str]) -> Trajectory:
    """What a task says of some coordinates."""
    if task.via:
        return via_points(*_table(task.via, names))
    return polynomial([task.coefficients[name] for name in names], task.duration)


def _table(via: Sequence[Via], names: Sequence[str]) -> tuple[Array, Array, Array]:
    """Times (N,), coordinates and rates (N, n) of points, NaN where nothing is given."""
    time = np.array([one.time for one in via])
    points, rates = (
        np.array([[given.get(name, np.nan) for name in names] for given in every])
        for every in ([one.point for one in via], [one.rates for one in via])
    )
    return time, points, rates
