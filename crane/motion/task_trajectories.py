"""Trajectories of the active joints from trajectories of the tip and from tasks."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crane.codegen import cached_result
from crane.common.errors import InputError, LimitError, suggest_names
from crane.common.samples import Array
from crane.description.specification import TIP_COORDINATES, Task, ViaPoint
from crane.machine.machine import Machine
from crane.motion.attitude import INCLINATION, via_attitudes
from crane.motion.kinematics import Kinematics
from crane.motion.limit_violations import limit_violation_message
from crane.motion.quintic_splines import PiecewisePolynomial, quintic_polynomials
from crane.motion.trajectory import AttitudeTrajectory, Trajectory, polynomial, via_points

_KNOTS_PER_SECOND = 100


def tip_trajectory(
    machine: Machine,
    tip: Trajectory,
    initial_guess: ArrayLike | None = None,
    attitude: Trajectory | AttitudeTrajectory | None = None,
) -> Trajectory:
    """Trajectory of the active joints that moves the tip along a trajectory.

    Positions at knots every 10 ms, and the velocities v_A = J^-1 x' and accelerations a_A = J^-1
    (x'' - bias) there, come from inverse kinematics; quintics connect them. For a redundant
    machine the motion from knot to knot is minimal, and velocities and accelerations are those of
    the quintic spline through the knots.

    Args:
        machine: The machine.
        tip: Trajectory of the tip in the world [m].
        initial_guess: (n,) active coordinates near the start.
        attitude: Attitude of the tip's frame over the same time: inclination (1,) [rad], or
            rotation, see `via_attitudes`; default free.

    Returns:
        Trajectory of q_A, with `tip` and `attitude` set.

    Raises:
        InputError: The attitude has another duration, or the drives cannot set it.
        UnreachableTipError: The trajectory is not reachable.
    """
    kinematics = Kinematics(machine)
    count = max(6, int(np.ceil(tip.duration * _KNOTS_PER_SECOND)) + 1)
    time = np.linspace(0.0, tip.duration, count)
    x, x_rate, x_acceleration = tip(time)
    name, attitude_targets = None, None
    if attitude is not None:
        if attitude.duration != tip.duration:
            raise InputError(
                f"the tip takes {tip.duration:g} s and its attitude {attitude.duration:g} s, give "
                "them the same time"
            )
        name = "rotation" if isinstance(attitude, AttitudeTrajectory) else INCLINATION
        attitude_targets, rate, acceleration = attitude(time)
        attitude_targets = (
            attitude_targets
            if isinstance(attitude, AttitudeTrajectory)
            else attitude_targets[:, 0]
        )
        x_rate, x_acceleration = (
            np.hstack([x_rate, rate]),
            np.hstack([x_acceleration, acceleration]),
        )
    q_a = kinematics.inverse_along_path(x, initial_guess, attitude_targets, time)
    if machine.is_driven.sum() > x_rate.shape[1]:
        from scipy.interpolate import make_interp_spline  # slow to import

        spline = make_interp_spline(time, q_a, k=5)
        v_a, a_a = spline(time, 1), spline(time, 2)
    else:
        jacobian = np.linalg.pinv(kinematics.jacobian(q_a, name) * machine.is_driven)
        v_a = np.einsum("ijk,ik->ij", jacobian, x_rate)
        a_a = np.einsum("ijk,ik->ij", jacobian, x_acceleration - kinematics.bias(q_a, v_a, name))
    return Trajectory(quintic_polynomials(time, q_a, v_a, a_a), tip, attitude)


class _FreeJointTrajectory(Trajectory):
    """Trajectory of all active joints with the free joints at constant coordinates."""

    def __init__(self, reference: Trajectory, driven: NDArray[np.bool_], start: Array):
        self.duration = reference.duration
        self.tip, self.attitude = reference.tip, reference.attitude
        self._reference, self._driven, self._start = reference, driven, start

    def position(self, time: ArrayLike) -> Array:
        """See `Trajectory`."""
        return self._insert_driven(self._reference.position(time), self._start)

    def _derivative(self, order: int, time: ArrayLike) -> Array:
        return self._insert_driven(
            self._reference._derivative(order, time), np.zeros_like(self._start)
        )

    def bounds(self) -> tuple[Array, Array]:
        """See `Trajectory`."""
        lower, upper = self._reference.bounds()
        return self._insert_driven(lower, self._start), self._insert_driven(upper, self._start)

    def extremum_times(self) -> Array:
        """See `Trajectory`."""
        return self._reference.extremum_times()

    def breaks(self) -> Array:
        """See `Trajectory`."""
        return self._reference.breaks()

    def _insert_driven(self, x: Array, all_values: Array) -> Array:
        out = np.tile(all_values, (*x.shape[:-1], 1) if x.ndim > 1 else 1)
        out[..., self._driven] = x if x.shape[-1] < len(all_values) else x[..., self._driven]
        return out


def add_free_joints(machine: Machine, reference: Trajectory) -> Trajectory:
    """Extend a trajectory of the driven joints to all active joints (n,).

    Free joints follow no reference. Their columns only give the initial coordinates: those of
    home, or those of a trajectory of all joints.

    Raises:
        InputError: The trajectory has another number of coordinates.
    """
    if not machine.free:
        return reference
    start, driven_names = reference.position(0.0), machine.driven_joints
    if len(start) not in (len(driven_names), len(machine.active)):
        raise InputError(
            f"the reference has {len(start)} coordinates, give the {len(driven_names)} of the "
            f"driven joints ({', '.join(driven_names)}) or those of all {len(machine.active)}"
        )
    if len(start) == len(driven_names):
        start = machine.home[machine.closure.active]
    return _FreeJointTrajectory(reference, machine.is_driven, start)


def task_trajectory(machine: Machine, task: str) -> Trajectory:
    """Trajectory of the active joints for a task of the machine.

    Raises:
        InputError: The machine has no such task.
        UnreachableTipError: The path of the tip is not reachable.
        LimitError: The trajectory leaves the limits of an active joint.
    """
    if task not in machine.tasks:
        raise InputError(
            f"machine '{machine.name}' has no task '{task}', {suggest_names(machine.tasks, task)}"
        )
    task_spec = machine.tasks[task]
    if task_spec.space == "joystick":
        raise InputError(f"task '{task}' moves levers, it has no trajectory")
    closure = machine.closure
    dependencies = (
        closure.equations.cache_key, closure.structure, machine.home, machine.lower, machine.upper,
        machine.active, machine.is_driven, machine.tip, task_spec.space, task_spec.duration,
        tuple((name, tuple(row)) for name, row in task_spec.coefficients.items()),
        tuple((x.time, tuple(x.point.items()), tuple(x.rates.items())) for x in task_spec.via),
    )  # fmt: skip
    classes = Trajectory, _FreeJointTrajectory, AttitudeTrajectory, PiecewisePolynomial
    return cached_result(
        ("task", dependencies),
        lambda: _build_task_trajectory(machine, task_spec),
        "scipy.interpolate",
        classes,
    )


def _build_task_trajectory(machine: Machine, task: Task) -> Trajectory:
    if task.space == "tip":
        tip = _coordinate_trajectory(task, TIP_COORDINATES)
        attitude: Trajectory | AttitudeTrajectory | None = None
        names = [name for name in task.coordinates if name not in TIP_COORDINATES]
        if names == [INCLINATION]:
            attitude = _coordinate_trajectory(task, names)
        elif names:
            attitude = via_attitudes(*_via_point_table(task.via, names))
        return tip_trajectory(machine, tip, None, attitude)
    trajectory = add_free_joints(machine, _coordinate_trajectory(task, machine.driven_joints))
    if text := limit_violation_message(machine, trajectory):
        raise LimitError(f"task '{task.name}': {text}")
    return trajectory


def _coordinate_trajectory(task: Task, names: Sequence[str]) -> Trajectory:
    """Trajectory of some of the coordinates of a task."""
    if task.via:
        return via_points(*_via_point_table(task.via, names))
    return polynomial([task.coefficients[name] for name in names], task.duration)


def _via_point_table(via: Sequence[ViaPoint], names: Sequence[str]) -> tuple[Array, Array, Array]:
    """Times (N,), coordinates and rates (N, n) of via points, NaN where none is given."""
    time = np.array([via_point.time for via_point in via])
    points, rates = (
        np.array(
            [[coordinates.get(name, np.nan) for name in names] for coordinates in point_values]
        )
        for point_values in ([one.point for one in via], [one.rates for one in via])
    )
    return time, points, rates
