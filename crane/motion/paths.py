"""Motions from files: points, or samples of a motion that somebody recorded or computed."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from crane.common.errors import CraneWarning, InputError, LimitError, RecordingError, at, known
from crane.common.samples import Array
from crane.description.spec import ATTITUDES, TIP
from crane.machine import Machine
from crane.motion.attitude import INCLINATION, Turning, via_attitudes
from crane.motion.curves import Trajectory, via_points
from crane.motion.limits import beyond_limits
from crane.motion.splines import noise, quintics, smoothed
from crane.motion.trajectories import tip_trajectory, with_free
from crane.recordings.recording import FORCE, VELOCITY
from crane.recordings.timeseries import TIME, Table, check_unit, read

_DENSE = 50  # samples, from which on they may be noisy
_EXACT = 1e-7  # scatter of a column, as a share of its range, that is no noise
_RECORDED = "tip_"  # of the tip's columns in recordings
_UNITS = {**dict.fromkeys(TIP, "m"), **dict.fromkeys(ATTITUDES[0] + ATTITUDES[1], "rad")}


def read_path(machine: Machine, path: str | Path) -> Trajectory:
    """The motion that a CSV or npz file gives as points in time.

    Its columns are time [s] and all driven joints [m], [rad], as a recording has them; or the
    tip's x, y, z [m], and `inclination` or `roll`, `pitch`, `yaw` [rad] of its frame. Points are
    passed with least jerk (`via_points`), from rest to rest. Columns of many samples that scatter
    are smoothed (`crane.motion.splines`), which a warning tells with how much they scatter and up
    to which frequency they are followed.

    Args:
        machine: The machine.
        path: The file. Time may begin anywhere.

    Returns:
        Trajectory of the active joints.

    Raises:
        RecordingError: The file cannot be read, or a unit is wrong.
        InputError: Columns are missing or unknown, times do not increase, points are too few.
        UnreachableTipError: The tip's path leaves the reach.
        LimitError: It leaves the limits of a driven joint.
    """
    table = read(path)
    try:
        columns = _columns(machine, table)
        time = _times(table)
        names = list(columns)
        units = [_UNITS.get(name) or machine.unit(name) for name in names]
        for name, unit in zip(columns.values(), units, strict=True):
            check_unit(name, table.units[name], [unit])
        points = np.column_stack([_column(table, name) for name in columns.values()])
        curve = _curve(time, points, names, units, path)
        if names[: len(TIP)] != list(TIP):
            found = with_free(machine, curve.of(range(len(names))))
            if text := beyond_limits(machine, found):
                raise LimitError(text)
            return found
        tip = curve.of(range(len(TIP)))
        attitude: Trajectory | Turning | None = None
        if names[len(TIP) :] == [INCLINATION]:
            attitude = curve.of([len(TIP)])
        elif len(names) > len(TIP):
            attitude = via_attitudes(curve.time, curve.parts[0][:, len(TIP) :])
        return tip_trajectory(machine, tip, None, attitude)
    except (InputError, LimitError, RecordingError) as error:
        raise type(error)(at(str(path), error)) from None


class _Knots(NamedTuple):
    """Values, rates and second rates (K, n) at knots (K,)."""

    time: Array
    parts: tuple[Array, Array, Array]

    def of(self, columns: Sequence[int]) -> Trajectory:
        """The trajectory of some columns."""
        chosen = list(columns)
        return Trajectory(quintics(self.time, *(part[:, chosen] for part in self.parts)))


def _columns(machine: Machine, table: Table) -> dict[str, str]:
    """The columns of a path by what they are: driven joints, or the tip and its attitude."""
    joints, given = machine.driven_joints, list(table.units)
    there = [joint for joint in joints if joint in given]
    recording = any(name.endswith((VELOCITY, FORCE)) for name in given)
    tip = {axis: name for axis in TIP for name in (axis, _RECORDED + axis) if name in given}
    if there:
        missing = [joint for joint in joints if joint not in given]
        if missing:
            raise InputError(
                f"column '{missing[0]}' is missing, a path of joints has all that are driven: "
                f"{', '.join(joints)}"
            )
        found = {joint: joint for joint in joints}
    elif tip:
        missing = [axis for axis in TIP if axis not in tip]
        if missing:
            raise InputError(f"column '{missing[0]}' is missing, a path of the tip has x, y, z")
        if machine.tip is None:
            raise InputError(f"'{machine.name}' has no tip, name its frame under 'tip:'")
        groups = [group for group in ATTITUDES if any(name in given for name in group)]
        if len(groups) > 1:
            raise InputError("it has an inclination and roll, pitch, yaw, give one of both")
        for name in groups[0] if groups else ():
            if name not in given:
                raise InputError(f"column '{name}' is missing beside the others of the attitude")
        found = tip | {name: name for group in groups for name in group}
    else:
        raise InputError(
            f"it has no column of a path, give time and {', '.join(joints)}, or time and x, y, z"
        )
    unknown = [name for name in given if name not in (TIME, *found.values())]
    if unknown and not recording:
        every = (*joints, *TIP, *(name for group in ATTITUDES for name in group))
        raise InputError(f"column '{unknown[0]}' is unknown, {known(every, unknown[0])}")
    return found


def _times(table: Table) -> Array:
    time = _column(table, TIME)
    if len(time) < 2:
        raise InputError(f"it has {len(time)} points, give two at least")
    for row, (before, after) in enumerate(zip(time, time[1:], strict=False), start=2):
        if not after > before:
            raise InputError(
                f"time goes from {before:g} to {after:g} s at row {row} of its samples, let it "
                "increase"
            )
    return time - time[0]


def _column(table: Table, name: str) -> Array:
    return np.asarray(table.values[:, list(table.units).index(name)])


def _curve(
    time: Array, points: Array, names: Sequence[str], units: Sequence[str], path: str | Path
) -> _Knots:
    """Through points, or near samples that scatter."""
    told, near = [], {}
    for i, (name, unit, x) in enumerate(zip(names, units, points.T, strict=True)):
        if len(x) < _DENSE or np.isnan(x).any():
            continue
        scatter = noise(time, x)
        if scatter > _EXACT * float(np.ptp(x)):
            knots, found, cut = smoothed(time, x, scatter)
            near[i] = knots, found
            told.append(f"'{name}' scatters by {scatter:.2g} {unit}, followed up to {cut:.2g} Hz")
    if told:
        warnings.warn(f"{path}: {'; '.join(told)}", CraneWarning, stacklevel=4)
    if not near:
        through = via_points(time, points)
        return _Knots(time, through(time))
    knots = next(iter(near.values()))[0]
    parts = np.empty((3, len(knots), len(names)))
    for i in range(len(names)):
        if i in near:
            parts[:, :, i] = near[i][1].T
        else:
            through = via_points(time, points[:, [i]])
            parts[:, :, i] = np.array(through(knots))[:, :, 0]
    return _Knots(knots, (parts[0], parts[1], parts[2]))
