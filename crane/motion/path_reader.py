"""Trajectories from CSV and npz files of points or of recorded samples."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from crane.common.errors import (
    CraneWarning,
    InputError,
    LimitError,
    RecordingError,
    prefix_location,
    suggest_names,
)
from crane.common.samples import Array
from crane.description.specification import ATTITUDE_COORDINATES, TIP_COORDINATES
from crane.machine.machine import Machine
from crane.motion.attitude import INCLINATION, via_attitudes
from crane.motion.limit_violations import limit_violation_message
from crane.motion.quintic_splines import estimate_noise, quintic_polynomials, smooth_samples
from crane.motion.task_trajectories import add_free_joints, tip_trajectory
from crane.motion.trajectory import AttitudeTrajectory, Trajectory, via_points
from crane.recordings.recording import FORCE_SUFFIX, VELOCITY_SUFFIX
from crane.recordings.table_reader import read_table
from crane.recordings.timeseries import TIME, Table, check_unit

_MIN_NOISY_SAMPLES = 50  # samples; fewer are taken as exact points
_NOISE_THRESHOLD = 1e-7  # noise relative to the range of a column; less is rounding
_TIP_PREFIX = "tip_"  # of columns of the tip in recordings
_UNITS = {
    **dict.fromkeys(TIP_COORDINATES, "m"),
    **dict.fromkeys(ATTITUDE_COORDINATES[0] + ATTITUDE_COORDINATES[1], "rad"),
}


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
        time = _path_times(table)
        names = list(columns)
        units = [_UNITS.get(name) or machine.unit(name) for name in names]
        for name, unit in zip(columns.values(), units, strict=True):
            check_unit(name, table.units[name], [unit])
        points = np.column_stack([_table_column(table, name) for name in columns.values()])
        knots = _fit_curve(time, points, names, units, path)
        if names[: len(TIP_COORDINATES)] != list(TIP_COORDINATES):
            trajectory = add_free_joints(machine, knots.trajectory(range(len(names))))
            if text := limit_violation_message(machine, trajectory):
                raise LimitError(text)
            return trajectory
        tip = knots.trajectory(range(len(TIP_COORDINATES)))
        attitude: Trajectory | AttitudeTrajectory | None = None
        if names[len(TIP_COORDINATES) :] == [INCLINATION]:
            attitude = knots.trajectory([len(TIP_COORDINATES)])
        elif len(names) > len(TIP_COORDINATES):
            attitude = via_attitudes(knots.time, knots.derivatives[0][:, len(TIP_COORDINATES) :])
        return tip_trajectory(machine, tip, None, attitude)
    except (InputError, LimitError, RecordingError) as error:
        raise type(error)(prefix_location(str(path), error)) from None


class _KnotDerivatives(NamedTuple):
    """Values, velocities and accelerations (K, n) at knots (K,)."""

    time: Array
    derivatives: tuple[Array, Array, Array]

    def trajectory(self, columns: Sequence[int]) -> Trajectory:
        """Trajectory of some of the columns."""
        indices = list(columns)
        return Trajectory(
            quintic_polynomials(self.time, *(part[:, indices] for part in self.derivatives))
        )


def _path_columns(machine: Machine, table: Table) -> dict[str, str]:
    """Columns of a path by coordinate: driven joints, or the tip and its attitude."""
    joints, headings = machine.driven_joints, list(table.units)
    present_joints = [joint for joint in joints if joint in headings]
    is_recording = any(name.endswith((VELOCITY_SUFFIX, FORCE_SUFFIX)) for name in headings)
    tip = {
        axis: name
        for axis in TIP_COORDINATES
        for name in (axis, _TIP_PREFIX + axis)
        if name in headings
    }
    if present_joints:
        missing = [joint for joint in joints if joint not in headings]
        if missing:
            raise InputError(
                f"column '{missing[0]}' is missing, a path of joints has all that are driven: "
                f"{', '.join(joints)}"
            )
        columns = {joint: joint for joint in joints}
    elif tip:
        missing = [axis for axis in TIP_COORDINATES if axis not in tip]
        if missing:
            raise InputError(f"column '{missing[0]}' is missing, a path of the tip has x, y, z")
        if machine.tip is None:
            raise InputError(f"'{machine.name}' has no tip, name its frame under 'tip:'")
        groups = [
            group for group in ATTITUDE_COORDINATES if any(name in headings for name in group)
        ]
        if len(groups) > 1:
            raise InputError("it has an inclination and roll, pitch, yaw, give one of both")
        for name in groups[0] if groups else ():
            if name not in headings:
                raise InputError(f"column '{name}' is missing beside the others of the attitude")
        columns = tip | {name: name for group in groups for name in group}
    else:
        raise InputError(
            f"it has no column of a path, give time and {', '.join(joints)}, or time and x, y, z"
        )
    unknown = [name for name in headings if name not in (TIME, *columns.values())]
    if unknown and not is_recording:
        known_names = (
            *joints,
            *TIP_COORDINATES,
            *(name for group in ATTITUDE_COORDINATES for name in group),
        )
        raise InputError(
            f"column '{unknown[0]}' is unknown, {suggest_names(known_names, unknown[0])}"
        )
    return columns


def _path_times(table: Table) -> Array:
    time = _table_column(table, TIME)
    if len(time) < 2:
        raise InputError(f"it has {len(time)} points, give two at least")
    for row, (previous, following) in enumerate(zip(time, time[1:], strict=False), start=2):
        if not following > previous:
            raise InputError(
                f"time goes from {previous:g} to {following:g} s at row {row} of its samples, "
                "let it increase"
            )
    return time - time[0]


def _table_column(table: Table, name: str) -> Array:
    return np.asarray(table.values[:, list(table.units).index(name)])


def _fit_curve(
    time: Array, points: Array, names: Sequence[str], units: Sequence[str], path: str | Path
) -> _KnotDerivatives:
    """Interpolate points, or smooth noisy samples."""
    messages, smoothed_columns = [], {}
    for i, (name, unit, x) in enumerate(zip(names, units, points.T, strict=True)):
        if len(x) < _MIN_NOISY_SAMPLES or np.isnan(x).any():
            continue
        scatter = estimate_noise(time, x)
        if scatter > _NOISE_THRESHOLD * float(np.ptp(x)):
            knots, knot_derivatives, cutoff_frequency = smooth_samples(time, x, scatter)
            smoothed_columns[i] = knots, knot_derivatives
            messages.append(
                f"'{name}' scatters by {scatter:.2g} {unit}, followed up to "
                f"{cutoff_frequency:.2g} Hz"
            )
    if messages:
        warnings.warn(f"{path}: {'; '.join(messages)}", CraneWarning, stacklevel=4)
    if not smoothed_columns:
        trajectory = via_points(time, points)
        return _KnotDerivatives(time, trajectory(time))
    knots = next(iter(smoothed_columns.values()))[0]
    derivatives = np.empty((3, len(knots), len(names)))
    for i in range(len(names)):
        if i in smoothed_columns:
            derivatives[:, :, i] = smoothed_columns[i][1].T
        else:
            trajectory = via_points(time, points[:, [i]])
            derivatives[:, :, i] = np.array(trajectory(knots))[:, :, 0]
    return _KnotDerivatives(knots, (derivatives[0], derivatives[1], derivatives[2]))
