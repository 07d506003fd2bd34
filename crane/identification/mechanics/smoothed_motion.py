"""Motions from recordings: checked samples, derivatives, and recorded loads."""

import math
import warnings

import numpy as np

from crane.common.errors import CraneWarning, RecordingError, suggest_names
from crane.common.samples import Array
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics.dynamics import Dynamics
from crane.identification.mechanics.force_delays import motion_frequency
from crane.identification.mechanics.recording_checks import (
    check_recording,
    check_samples,
    reject_unless_trusted,
    remove_outliers,
    warn_hum,
)
from crane.identification.mechanics.regression_equations import Progress
from crane.identification.signals.signal_processing import (
    Derivatives,
    Motion,
    differentiate,
    resample_evenly,
)
from crane.identification.signals.signal_quality import outlier_mask, replace_outliers
from crane.machine.machine import Machine
from crane.recordings.measured_recordings import locked_joint_conflicts
from crane.recordings.recording import FORCE_SUFFIX, VELOCITY_SUFFIX, VELOCITY_UNITS, Recording
from crane.recordings.timeseries import time_derivative

_MOTION_FACTOR = 3.0  # standard deviations of a velocity, above which a joint moves
# times the velocity limit of a joint, above which a recording is rejected
_MAX_SPEED_FACTOR = 30.0
_HUM_FACTOR = 10.0  # times the frequency of the motion, above which a spectral line is hum
_LOAD_PREFIX, _PART_UNITS = "load_", {"force": "N", "moment": "N m"}


def smoothed_motion(
    machine: Machine,
    recording: Recording,
    derivatives: str = "kalman",
    cutoff: float | None = None,
    trust: bool = False,
    progress: Progress | None = None,
) -> Motion:
    """Motion of a recording, with checks, velocities and accelerations.

    Outliers are replaced by linear interpolation before filtering. Forces are the sum of joint
    forces and recorded loads.

    Args:
        machine: The recorded machine.
        recording: Recording with all active joints of the machine.
        derivatives: Method "kalman" or "lowpass", see `differentiate`.
        cutoff: Cutoff of "lowpass" [Hz].
        trust: Whether to warn only of what is probably wrong, and keep outliers.
        progress: Called with the finished share, 0 to 1.

    Raises:
        RecordingError: The recording is not suitable; the message names column and time.
    """
    original, recording = recording, _select_active_joints(machine, recording)
    locked_columns = {
        x: column for x, column in original.columns().items() if x in machine.locked_joints
    }
    for text in locked_joint_conflicts(
        machine, locked_columns, original.units | original.channel_units
    ):
        reject_unless_trusted(f"{text}, do not lock it, or lock it where it is", trust)
    time, n = recording.time, len(machine.active)
    check_samples(time)
    names = [x + suffix for suffix in ("", FORCE_SUFFIX) for x in machine.active]
    columns = remove_outliers(time, names, np.hstack([recording.q, recording.tau]), trust)
    _check_columns(machine, time, columns, recording.v, trust)
    columns[:, n:] += recorded_load_forces(machine, original, columns[:, :n], trust)
    time, columns = resample_evenly(time, columns)
    step = float(np.median(np.diff(time)))
    lowest = _HUM_FACTOR * motion_frequency(columns[:, :n], step)
    warn_hum(time, dict(zip(names, columns.T, strict=True)), lowest)
    found = differentiate(time, columns[:, :n], derivatives, cutoff, progress)
    v, a = np.where(_is_moving(found), (found.v, found.a), 0.0)
    _check_speeds(machine, v, trust)
    _warn_standstill(machine, found, v)
    return Motion(time, found.q, v, a, columns[:, n:], _lowest_passband(found))


def _select_active_joints(machine: Machine, recording: Recording) -> Recording:
    """Select the active joints of a machine from a recording, in their order.

    Free joints may be among the channels; their forces are zero.

    Raises:
        RecordingError: A joint is missing or has another unit, or a free joint has a force.
    """
    recorded_columns, units = recording.columns(), recording.units | recording.channel_units
    available = {*recording.joints, *(x for x in machine.free if x in recorded_columns)}
    missing = [joint for joint in machine.active if joint not in available]
    if missing:
        listed = ", ".join(f"'{joint}'" for joint in missing)
        held = " ".join(f"--lock {joint}=VALUE" for joint in missing)
        raise RecordingError(
            f"{listed} of '{machine.name}' not recorded, {suggest_names(recording.joints)}; lock "
            f"what was held ({held})"
        )
    for joint in machine.active:
        if units[joint] != machine.unit(joint):
            raise RecordingError(
                f"'{joint}' is recorded in {units[joint]}, give {machine.unit(joint)}"
            )
    zeros = np.zeros_like(recording.time)
    q = np.column_stack([recorded_columns[joint] for joint in machine.active])
    tau = np.column_stack(
        [recorded_columns.get(joint + FORCE_SUFFIX, zeros) for joint in machine.active]
    )
    rates = [
        recorded_columns.get(
            x + VELOCITY_SUFFIX, time_derivative(recorded_columns[x], recording.time)
        )
        for x in machine.active
    ]
    v = np.column_stack(rates)
    joint_units = {joint: machine.unit(joint) for joint in machine.active}
    return Recording(recording.time, machine.active, q, v, tau, joint_units, free=machine.free)


def _check_columns(machine: Machine, time: Array, columns: Array, v: Array, trust: bool) -> None:
    """Check coordinates and forces (N, 2 n) and recorded velocities (N, n)."""
    q, tau = np.split(columns, 2, axis=1)
    recorded = None
    if np.any(v):  # for comparison only, without outliers
        recorded = np.column_stack([replace_outliers(x, outlier_mask(x)) for x in v.T])
    limits = np.column_stack([machine.lower, machine.upper])
    bounded = limits if np.isfinite(limits).all() else None
    units = {joint: machine.unit(joint) for joint in machine.active}
    free = machine.free
    check_recording(time, q, tau, machine.active, units, recorded, bounded, free=free, trust=trust)


def _check_speeds(machine: Machine, v: Array, trust: bool) -> None:
    """Reject velocities (N, n) far above the velocity limits."""
    limits = machine.model.velocityLimit[machine.closure.active]
    for joint, speed, limit in zip(
        machine.active, np.sqrt(np.mean(v**2, axis=0)), limits, strict=True
    ):
        if 0 < limit < speed / _MAX_SPEED_FACTOR:
            unit = VELOCITY_UNITS[machine.unit(joint)]
            reject_unless_trusted(
                f"'{joint}' moves at {speed:.3g} {unit} on the whole, its limit is {limit:.3g} "
                f"{unit}: look at the unit of the time",
                trust,
            )


def _lowest_passband(found: Derivatives) -> float:
    """Lowest passband [Hz] of the moving joints."""
    if found.passband is None:
        return math.inf
    return float(found.passband[_is_moving(found)].min(initial=math.inf))


def _is_moving(found: Derivatives) -> np.ndarray:
    """Mask (n,) of joints that move by more than the uncertainty of their velocities."""
    if found.std_v is None:
        return np.ones(found.v.shape[1], dtype=bool)
    uncertain = np.sqrt(np.mean(found.std_v**2, axis=0))
    return np.asarray(found.v.std(axis=0) > _MOTION_FACTOR * uncertain)


def _warn_standstill(machine: Machine, found: Derivatives, v: Array) -> None:
    """Warn of joints that have noise, but no motion: static friction makes any force."""
    for i in np.flatnonzero(~v.any(axis=0) & found.v.any(axis=0)).tolist():
        joint, place = machine.active[i], float(found.q[:, i].mean())
        text = (
            f"'{joint}' stands still but for noise: its forces are not informative, move it, or "
            f"lock it ({joint}={place:.4g})"
        )
        warnings.warn(text, CraneWarning, stacklevel=3)


def recorded_load_forces(machine: Machine, recording: Recording, q_a: Array, trust: bool) -> Array:
    """Forces of recorded loads at the active joints, so that W beta = tau + forces.

    Columns `load_NAME_force_x` to `load_NAME_moment_z` are a wrench in the world frame at the
    frame of the machine's load NAME, or at the link NAME; missing components are zero.

    Args:
        machine: The recorded machine.
        recording: Recording of N samples.
        q_a: (N, n) [m], [rad].
        trust: See `smoothed_motion`.

    Returns:
        (N, n) [N], [N m].

    Raises:
        RecordingError: A load acts on an unknown link, or a load of the machine is not recorded.
    """
    frames = {force.name: force.frame for force in machine.external_forces}
    wrenches: dict[str, Array] = {}
    for column, values in recording.channels.items():
        part = next(
            (x for x in WRENCH_COMPONENTS if column == f"{_LOAD_PREFIX}{_load_name(column)}_{x}"),
            None,
        )
        if part is None:
            continue
        name, unit = _load_name(column), recording.channel_units[column]
        if unit != _PART_UNITS[part[:-2]]:
            raise RecordingError(
                f"'{column}' is recorded in {unit}, give {_PART_UNITS[part[:-2]]}"
            )
        if name not in frames and name not in machine.tree.links:
            links = suggest_names(machine.tree.links, name)
            raise RecordingError(f"'{column}' acts on no link of '{machine.name}', {links}")
        rows = wrenches.setdefault(name, np.zeros((len(values), len(WRENCH_COMPONENTS))))
        rows[:, WRENCH_COMPONENTS.index(part)] = values
    for name in frames:
        if name not in wrenches:
            reject_unless_trusted(
                f"'{machine.name}' has the load '{name}', and no column contains it: add "
                f"{_LOAD_PREFIX}{name}_force_x and so on, or take a machine without it",
                trust,
            )
    dynamics, total = Dynamics(machine), np.zeros_like(q_a)
    for name, rows in wrenches.items():
        total += dynamics.project_wrenches(q_a, {frames.get(name, name): rows})
    return total


def _load_name(column: str) -> str:
    """Name of the load of a column."""
    return column.removeprefix(_LOAD_PREFIX).rsplit("_", 2)[0]
