"""Trajectories of the active joints: from the tip, from tasks, from files of points or samples."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import cached_result
from crane.common.errors import (
    CraneWarning,
    InputError,
    LimitError,
    RecordingError,
    check_name,
    prefix_location,
    suggest_names,
)
from crane.common.samples import Array
from crane.description.specification import ATTITUDE_COORDINATES, TIP_COORDINATES
from crane.machine.machine import Machine
from crane.motion.attitude import INCLINATION, via_attitudes
from crane.motion.kinematics import Kinematics
from crane.motion.limit_violations import limit_violation_message
from crane.motion.quintic_splines import (
    PiecewisePolynomial,
    estimate_noise,
    quintic_polynomials,
    smooth_samples,
)
from crane.motion.trajectory import (
    AdaptedTrajectory,
    AttitudeTrajectory,
    Trajectory,
    polynomial,
    via_points,
)
from crane.recordings.recording import FORCE_SUFFIX, VELOCITY_SUFFIX
from crane.recordings.table_reader import read_table
from crane.recordings.timeseries import TIME, Table, check_unit, table_column

_KNOTS_PER_SECOND = 100
_MIN_NOISY_SAMPLES = 50  # samples; fewer are taken as exact points
_NOISE_THRESHOLD = 1e-7  # noise relative to the range of a column; less is rounding
_TIP_PREFIX = "tip_"  # of columns of the tip in recordings
_UNITS = {
    **dict.fromkeys(TIP_COORDINATES, "m"),
    **dict.fromkeys(ATTITUDE_COORDINATES[0] + ATTITUDE_COORDINATES[1], "rad"),
}


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
        attitude_targets, rate, acceleration = attitude(time)
        name = "rotation"
        if not isinstance(attitude, AttitudeTrajectory):
            name, attitude_targets = INCLINATION, attitude_targets[:, 0]
        x_rate = np.hstack([x_rate, rate])
        x_acceleration = np.hstack([x_acceleration, acceleration])
    q_a = kinematics.inverse(x, initial_guess, attitude_targets, time)
    if machine.is_driven.sum() > x_rate.shape[1]:
        from scipy.interpolate import make_interp_spline  # slow to import

        spline = make_interp_spline(time, q_a, k=5)
        v_a, a_a = spline(time, 1), spline(time, 2)
    else:
        jacobian = np.linalg.pinv(kinematics.jacobian(q_a, name) * machine.is_driven)
        v_a = np.einsum("ijk,ik->ij", jacobian, x_rate)
        a_a = np.einsum("ijk,ik->ij", jacobian, x_acceleration - kinematics.bias(q_a, v_a, name))
    return Trajectory(quintic_polynomials(time, q_a, v_a, a_a), tip, attitude)


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
    return AdaptedTrajectory(reference, reference.duration, machine.is_driven, start)


def task_trajectory(machine: Machine, task: str) -> Trajectory:
    """Trajectory of the active joints for a task of the machine.

    Raises:
        InputError: The machine has no such task.
        UnreachableTipError: The path of the tip is not reachable.
        LimitError: The trajectory leaves the limits of an active joint.
    """
    check_name(task, machine.tasks, f"machine '{machine.name}' has no task '{task}'")
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

    def curve(names: Sequence[str]) -> Trajectory:
        if task_spec.via:
            return via_points(*via_point_table(names))
        return polynomial([task_spec.coefficients[name] for name in names], task_spec.duration)

    def via_point_table(names: Sequence[str]) -> tuple[Array, Array, Array]:
        """Times (N,), coordinates and rates (N, n) of via points, NaN where none is given."""
        points, rates = (
            np.array([[values.get(name, np.nan) for name in names] for values in rows])
            for rows in ([x.point for x in task_spec.via], [x.rates for x in task_spec.via])
        )
        return np.array([x.time for x in task_spec.via]), points, rates

    def compute() -> Trajectory:
        if task_spec.space != "tip":
            return _joint_trajectory(machine, curve(machine.driven_joints), f"task '{task}': ")
        names = [name for name in task_spec.coordinates if name not in TIP_COORDINATES]
        return _pose_trajectory(machine, names, curve, lambda: via_point_table(names))

    classes = Trajectory, AdaptedTrajectory, AttitudeTrajectory, PiecewisePolynomial
    return cached_result(("task", dependencies), compute, "scipy.interpolate", classes)


def _joint_trajectory(machine: Machine, reference: Trajectory, label: str) -> Trajectory:
    """Trajectory of the active joints from one of the driven joints, within their limits."""
    trajectory = add_free_joints(machine, reference)
    if text := limit_violation_message(machine, trajectory):
        raise LimitError(f"{label}{text}")
    return trajectory


def _pose_trajectory(
    machine: Machine,
    attitude_names: Sequence[str],
    curve: Callable[[Sequence[str]], Trajectory],
    attitudes: Callable[[], tuple[Array, ...]],
) -> Trajectory:
    """Trajectory of the active joints from the curves of the tip's position and attitude.

    Args:
        machine: The machine.
        attitude_names: Coordinates of the attitude, none if it is free.
        curve: Function that returns the trajectory of coordinates.
        attitudes: Function that returns the arguments of `via_attitudes`.
    """
    attitude: Trajectory | AttitudeTrajectory | None = None
    if list(attitude_names) == [INCLINATION]:
        attitude = curve(attitude_names)
    elif attitude_names:
        attitude = via_attitudes(*attitudes())
    return tip_trajectory(machine, curve(TIP_COORDINATES), None, attitude)


def read_path(machine: Machine, path: str | Path) -> Trajectory:
    """Read a trajectory from the points in a CSV or npz file.

    Its columns are time [s] and all driven joints [m], [rad], as in a recording; or x, y, z [m] of
    the tip, and optionally `inclination` or `roll`, `pitch`, `yaw` [rad] of its frame. The
    trajectory passes the points with least jerk (`via_points`), from rest to rest. Columns of many
    noisy samples are smoothed (`crane.motion.quintic_splines`); a warning gives their noise and
    the cut-off frequency.

    Args:
        machine: The machine.
        path: The file. Its time may start at any value.

    Returns:
        Trajectory of the active joints.

    Raises:
        RecordingError: The file cannot be read, or a unit is wrong.
        InputError: Columns are missing or unknown, times do not increase, or there are too few
            points.
        UnreachableTipError: The path of the tip is not reachable.
        LimitError: The trajectory leaves the limits of a driven joint.
    """
    table = read_table(path)
    try:
        columns = _path_columns(machine, table)
        time, names = _path_times(table), list(columns)
        units = [_UNITS.get(name) or machine.unit(name) for name in names]
        for name, unit in zip(columns.values(), units, strict=True):
            check_unit(name, table.units[name], [unit])
        points = np.column_stack([table_column(table, name) for name in columns.values()])
        knots, derivatives = _fit_curve(time, points, names, units, path)

        def curve(coordinates: Sequence[str]) -> Trajectory:
            some = derivatives[:, :, [names.index(name) for name in coordinates]]
            return Trajectory(quintic_polynomials(knots, some[0], some[1], some[2]))

        if names[: len(TIP_COORDINATES)] != list(TIP_COORDINATES):
            return _joint_trajectory(machine, curve(names), "")
        others = names[len(TIP_COORDINATES) :]
        return _pose_trajectory(
            machine, others, curve, lambda: (knots, derivatives[0][:, len(TIP_COORDINATES) :])
        )
    except (InputError, LimitError, RecordingError) as error:
        raise type(error)(prefix_location(str(path), error)) from None


def _path_columns(machine: Machine, table: Table) -> dict[str, str]:
    """Columns of a path by coordinate: driven joints, or the tip and its attitude."""
    joints, headings = machine.driven_joints, list(table.units)
    groups = [group for group in ATTITUDE_COORDINATES if any(name in headings for name in group)]
    tip = {
        axis: name
        for axis in TIP_COORDINATES
        for name in (axis, _TIP_PREFIX + axis)
        if name in headings
    }
    is_joint_path = any(joint in headings for joint in joints)
    if not tip and not is_joint_path:
        raise InputError(
            f"it has no column of a path, give time and {', '.join(joints)}, or time and x, y, z"
        )
    if is_joint_path:
        columns = {joint: joint for joint in joints}
        hint = f"a path of joints has all that are driven: {', '.join(joints)}"
    else:
        if machine.tip is None:
            raise InputError(f"'{machine.name}' has no tip, name its frame under 'tip:'")
        if len(groups) > 1:
            raise InputError("it has an inclination and roll, pitch, yaw, give one of both")
        columns = {axis: tip.get(axis, axis) for axis in TIP_COORDINATES}
        columns |= {name: name for group in groups for name in group}
        hint = "a path of the tip has x, y, z, and all or no columns of an attitude"
    if missing := [name for name in columns.values() if name not in headings]:
        raise InputError(f"column '{missing[0]}' is missing, {hint}")
    unknown = [name for name in headings if name not in (TIME, *columns.values())]
    if unknown and not any(name.endswith((VELOCITY_SUFFIX, FORCE_SUFFIX)) for name in headings):
        raise InputError(
            f"column '{unknown[0]}' is unknown, {suggest_names([*joints, *_UNITS], unknown[0])}"
        )
    return columns


def _path_times(table: Table) -> Array:
    time = table_column(table, TIME)
    if len(time) < 2:
        raise InputError(f"it has {len(time)} points, give two at least")
    for row, (previous, following) in enumerate(zip(time, time[1:], strict=False), start=2):
        if not following > previous:
            raise InputError(
                f"time goes from {previous:g} to {following:g} s at row {row} of its samples, "
                "let it increase"
            )
    return time - time[0]


def _fit_curve(
    time: Array, points: Array, names: Sequence[str], units: Sequence[str], path: str | Path
) -> tuple[Array, Array]:
    """Interpolate points, or smooth noisy samples.

    Returns:
        Times (K,) of the knots, and values, velocities and accelerations (3, K, n) there.
    """
    messages, smoothed_columns = [], {}
    knots = time
    for i, (name, unit, x) in enumerate(zip(names, units, points.T, strict=True)):
        if len(x) < _MIN_NOISY_SAMPLES or np.isnan(x).any():
            continue
        scatter = estimate_noise(time, x)
        if scatter > _NOISE_THRESHOLD * float(np.ptp(x)):
            knots, smoothed_columns[i], cutoff_frequency = smooth_samples(time, x, scatter)
            messages.append(
                f"'{name}' scatters by {scatter:.2g} {unit}, followed up to "
                f"{cutoff_frequency:.2g} Hz"
            )
    if messages:
        warnings.warn(f"{path}: {'; '.join(messages)}", CraneWarning, stacklevel=4)
    derivatives = np.empty((3, len(knots), len(names)))
    for i in range(len(names)):
        if i in smoothed_columns:
            derivatives[:, :, i] = smoothed_columns[i].T
        else:
            derivatives[:, :, i] = np.array(via_points(time, points[:, [i]])(knots))[:, :, 0]
    return knots, derivatives
