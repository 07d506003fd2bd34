"""Motions from recordings: checks of units, delays, outliers and hum, derivatives, loads."""

import math
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from crane.common.errors import CraneWarning, RecordingError, check_name, suggest_names
from crane.common.progress import Progress, ignore_progress
from crane.common.samples import Array, root_mean_square
from crane.common.scratch_arrays import release_pages, stack_columns
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics.dynamics import Dynamics
from crane.identification.signals.signal_processing import (
    Motion,
    check_gaps,
    differentiate,
    low_pass,
    resample_evenly,
    sampling_step,
)
from crane.identification.signals.signal_quality import (
    outlier_mask,
    reject_delay,
    reject_unless_trusted,
    replace_outliers,
    shifted_correlation,
    signal_delay,
    spectral_edge_frequency,
    strongest_spectral_line,
)
from crane.machine.machine import Machine
from crane.recordings.angle_unwrapping import unwrap_angles
from crane.recordings.measured_recordings import locked_joint_conflicts
from crane.recordings.recording import FORCE_SUFFIX, VELOCITY_SUFFIX, VELOCITY_UNITS, Recording
from crane.recordings.rotation_columns import body_motion, continuous_rotations
from crane.recordings.timeseries import time_derivative

_MOTION_FACTOR = 3.0  # standard deviations of a velocity, above which a joint moves
# times the velocity limit of a joint, above which a recording is rejected
_MAX_SPEED_FACTOR = 30.0
_HUM_FACTOR = 10.0  # times the frequency of the motion, above which a spectral line is hum
_MIN_SAMPLES = 50  # samples
_COMPARISON_CUTOFF = 10.0  # [Hz] of the comparison of velocities and positions
_MAX_COMPARED_SAMPLES = 1 << 20  # above which velocities are compared at fewer instants,
_SAMPLES_PER_PERIOD = 16  # of the cutoff
_MAX_OUTLIER_SHARE = 0.05  # of the samples of a column, above which it is rejected
# units that are confused with SI units
_COMMON_UNITS = {"rad": ("deg", 180 / math.pi), "m": ("mm", 1e3)}
_LOAD_PREFIX, _PART_UNITS = "load_", {"force": "N", "moment": "N m"}


def smoothed_motion(
    machine: Machine,
    recording: Recording,
    derivatives: str = "kalman",
    cutoff: float | None = None,
    trust: bool = False,
    progress: Progress = ignore_progress,
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
    unwrapped = unwrap_angles(machine, recording.time, recording.columns())
    original, recording = recording, _select_active_joints(machine, recording, unwrapped)
    locked_columns = {
        x: column for x, column in original.columns().items() if x in machine.locked_joints
    }
    for text in locked_joint_conflicts(
        machine, locked_columns, original.units | original.channel_units
    ):
        reject_unless_trusted(f"{text}, do not lock it, or lock it where it is", trust)
    time, n = recording.time, len(machine.active)
    names = [x + suffix for suffix in ("", FORCE_SUFFIX) for x in machine.active]
    columns = stack_columns([*recording.q.T, *recording.tau.T], 2 * n)
    rotations = _active_rotations(machine)
    for part in rotations:
        columns[:, part] = continuous_rotations(columns[:, part])
    columns = remove_outliers(time, names, columns, trust)
    recorded = None
    if np.any(recording.v):  # for comparison only, without outliers
        recorded = stack_columns((replace_outliers(x, outlier_mask(x)) for x in recording.v.T), n)
        is_derived = [
            np.array_equal(v, time_derivative(q, time))
            for q, v in zip(recording.q.T, recording.v.T, strict=True)
        ]
        recorded[:, is_derived] = np.nan  # no column of the file
        for part in rotations:  # angular velocities are no derivatives of coordinates
            recorded[:, part] = np.nan
    limits = np.column_stack([machine.lower, machine.upper])
    check_recording(
        time,
        columns[:, :n],
        columns[:, n:],
        machine.active,
        {joint: machine.unit(joint) for joint in machine.active},
        recorded,
        limits if np.isfinite(limits).all() else None,
        free=machine.free,
        trust=trust,
    )
    columns[:, n:] += recorded_load_forces(machine, original, columns[:, :n], trust)
    time, columns = resample_evenly(time, columns)
    step = float(np.median(np.diff(time)))
    lowest = _HUM_FACTOR * spectral_edge_frequency(columns[:, :n], step)
    warn_hum(time, dict(zip(names, columns.T, strict=True)), lowest)
    found = differentiate(time, columns[:, :n], derivatives, cutoff, progress)
    del recorded
    v, a = found.v, found.a
    is_moving = np.ones(n, dtype=bool)  # by more than the uncertainty of the velocity
    if found.std_v is not None:
        deviations = np.array([root_mean_square(x) for x in found.std_v.T])
        is_moving = np.array([x.std() for x in v.T]) > _MOTION_FACTOR * deviations
    is_noisy = ~is_moving & v.any(axis=0)
    v[:, ~is_moving] = a[:, ~is_moving] = 0.0
    for part in rotations:
        v[:, part], a[:, part] = body_motion(found.q[:, part], v[:, part], a[:, part])
    release_pages()
    _check_speeds(machine, v, trust)
    # static friction makes any force
    for i in np.flatnonzero(is_noisy).tolist():
        joint, place = machine.active[i], float(found.q[:, i].mean())
        warnings.warn(
            f"'{joint}' stands still but for noise: its forces are not informative, move it, or "
            f"lock it ({joint}={place:.4g})",
            CraneWarning,
            stacklevel=2,
        )
    passband = math.inf
    if found.passband is not None:
        passband = float(found.passband[is_moving].min(initial=math.inf))
    return Motion(time, found.q, v, a, columns[:, n:], passband)


def _select_active_joints(
    machine: Machine, recording: Recording, unwrapped: Mapping[str, Array]
) -> Recording:
    """Select the active joints of a machine from a recording, in their order.

    Free joints may be among the channels; their forces are zero. Coordinates are taken from
    `unwrapped` where they jump by revolutions, with velocities that are their derivatives there.

    Raises:
        RecordingError: A joint is missing or has another unit, or a free joint has a force.
    """
    recorded_columns, units = recording.columns(), recording.units | recording.channel_units
    for joint in unwrapped.keys() & set(machine.active):
        name, jumps = joint + VELOCITY_SUFFIX, recorded_columns[joint] - unwrapped[joint]
        near = np.convolve(np.abs(np.diff(jumps, prepend=jumps[0])) > 1, np.ones(5), "same") > 0
        derivative = time_derivative(unwrapped[joint], recording.time)
        recorded_columns[name] = np.where(near, derivative, recorded_columns.get(name, derivative))
    recorded_columns |= unwrapped
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
    zeros, count = np.zeros_like(recording.time), len(machine.active)

    def rate(joint: str) -> Array:
        known = recorded_columns.get(joint + VELOCITY_SUFFIX)
        return time_derivative(recorded_columns[joint], recording.time) if known is None else known

    return Recording(
        recording.time,
        machine.active,
        stack_columns((recorded_columns[joint] for joint in machine.active), count),
        stack_columns(map(rate, machine.active), count),
        stack_columns(
            (recorded_columns.get(x + FORCE_SUFFIX, zeros) for x in machine.active), count
        ),
        {joint: machine.unit(joint) for joint in machine.active},
        free=machine.free,
        copy=False,
    )


def _active_rotations(machine: Machine) -> list[slice]:
    """Places of the rotation vectors among the active joints.

    Raises:
        RecordingError: A rotation vector is active in part, whose rates are no derivatives.
    """
    found = []
    for column in machine.coordinates.rotation_columns:
        places = np.flatnonzero(np.isin(machine.closure.active, range(column, column + 3)))
        if len(places) in (1, 2):
            joint = machine.active[int(places[0])]
            raise RecordingError(
                f"'{joint}' is a part of a rotation vector, whose angular velocity recordings do "
                "not determine alone: lock it, or choose active joints without it"
            )
        if len(places):
            found.append(slice(int(places[0]), int(places[0]) + 3))
    return found


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


def remove_outliers(
    time: Array, names: Sequence[str], columns: Array, trust: bool = False
) -> Array:
    """Replace outliers in columns (N, k) by linear interpolation.

    Outliers are removed before filters, which would smear them. Columns of a trusted recording are
    not changed.

    Raises:
        RecordingError: A column has too many outliers.
    """
    messages = []
    for name, column in () if trust else zip(names, columns.T, strict=True):
        bad = outlier_mask(column)
        release_pages()
        if not bad.any():
            continue
        first = f"the first at {time[bad.argmax()]:.6g} s"
        if bad.mean() > _MAX_OUTLIER_SHARE:
            reject_unless_trusted(
                f"'{name}' has {bad.sum()} outliers in {len(bad)} samples, {first}", trust
            )
        messages.append(f"{bad.sum()} in '{name}' ({first})")
        column[:] = replace_outliers(column, bad)
    if messages:
        warnings.warn(
            f"outliers are left out and bridged: {', '.join(messages)} of {len(time)} samples",
            CraneWarning,
            stacklevel=3,
        )
    return columns


def warn_hum(time: Array, columns: Mapping[str, Array], min_frequency: float) -> None:
    """Warn of spectral lines in columns (N,) above a frequency [Hz] without motion."""
    step, messages = float(np.median(np.diff(time))), []
    for name, column in columns.items():
        if (
            np.ptp(column) > 0
            and (found := strongest_spectral_line(column, step, min_frequency)) is not None
        ):
            share = 100 * found[1] / float(np.std(column))
            messages.append(f"'{name}' of {found[0]:.3g} Hz ({found[1]:.3g}, {share:.2g} % of it)")
    if messages:
        warnings.warn(
            f"hum in {', '.join(messages)}: keep the bandwidth well below it",
            CraneWarning,
            stacklevel=3,
        )


def check_recording(
    time: Array,
    q: Array,
    tau: Array,
    joints: Sequence[str],
    units: Mapping[str, str],
    v: Array | None = None,
    limits: Array | None = None,
    longest_delay: float = 0.05,
    free: Sequence[str] = (),
    trust: bool = False,
) -> None:
    """Reject a recording that is not suitable for an identification.

    Args:
        time: Instants (N,) [s].
        q: Coordinates (N, n).
        tau: Generalized forces (N, n).
        joints: Names (n,).
        units: "rad" or "m" of each coordinate.
        v: Recorded velocities (N, n), compared with the derivatives of q; nan for none.
        limits: Lower and upper limits (n, 2).
        longest_delay: Largest delay [s] between recorded velocity and q, for filters of sensors.
        free: Names of free joints.
        trust: Whether to warn only of what is probably wrong.

    Raises:
        RecordingError: There are too few samples, a gap or no motion, units are wrong, or columns
            are inconsistent; the message names the column.
    """
    if len(time) < _MIN_SAMPLES:
        raise RecordingError(f"{len(time)} samples are too few, record at least {_MIN_SAMPLES}")
    check_gaps(time)
    # steps between samples of pure noise have twice its variance
    if all(np.ptp(x) == 0 or np.var(np.diff(x)) >= np.var(x) for x in q.T):
        raise RecordingError("no joint moves, record a motion")
    for i, joint in enumerate(joints):
        if joint not in free and np.ptp(tau[:, i]) == 0 and np.ptp(q[:, i]) > 0:
            reject_unless_trusted(
                f"'{joint}_force' is constant while '{joint}' moves, check it", trust
            )
        if limits is not None:
            _check_range(q[:, i], limits[i], joint, units[joint], trust)
        if v is None or np.isnan(v[:, i]).any():
            continue
        if np.var(np.diff(q[:, i])) < np.var(q[:, i]):
            _check_velocity(time, q[:, i], v[:, i], joint, units[joint], longest_delay, trust)


def _check_range(x: Array, limits: Array, joint: str, unit: str, trust: bool) -> None:
    low, high = limits
    slack = 0.1 * (high - low)

    def inside(values: Array) -> bool:
        return low - slack <= values.min() and values.max() <= high + slack

    if not inside(x):
        other, factor = _COMMON_UNITS[unit]
        is_other_unit = inside(x / factor) and np.ptp(x) > 0.02 * factor * (high - low)
        hint = f"it looks like {other}" if is_other_unit else "check its zero and unit"
        reject_unless_trusted(
            f"'{joint}' goes from {x.min():.4g} to {x.max():.4g} {unit}, its limits are "
            f"{low:.4g} and {high:.4g} {unit}, {hint}",
            trust,
        )


def _check_velocity(
    time: Array, x: Array, v: Array, joint: str, unit: str, longest_delay: float, trust: bool
) -> None:
    """Compare a velocity with the derivative of its coordinate below 10 Hz."""
    time, columns = resample_evenly(time, stack_columns([x, v], 2))
    step = sampling_step(time)
    if 0.4 / step > _COMPARISON_CUTOFF:
        columns = low_pass(time, columns, _COMPARISON_CUTOFF)
        if len(time) > _MAX_COMPARED_SAMPLES:
            stride = max(1, int(1.0 / (_SAMPLES_PER_PERIOD * _COMPARISON_CUTOFF * step)))
            time, columns, step = time[::stride], columns[::stride].copy(), stride * step
    release_pages()
    derivative = np.gradient(columns[:, 0], step, axis=0, edge_order=2)
    v = columns[:, 1]
    # less than a micrometre is noise or rounding, not motion
    if np.std(columns[:, 0]) < 1e-6:
        return
    ratio = math.sqrt(np.mean(v**2) / np.mean(derivative**2))
    other, factor = _COMMON_UNITS[unit]
    for wrong, scale in ((f"{joint}_velocity", factor), (joint, 1 / factor)):
        if 0.8 < ratio / scale < 1.25:
            return reject_unless_trusted(
                f"'{joint}_velocity' is {ratio:.3g} times the derivative of '{joint}', "
                f"'{wrong}' looks like {other}, give {unit}",
                trust,
            )
    delay = signal_delay(time, derivative, v)
    shift = round(delay / step)
    correlation = shifted_correlation(derivative, v, shift) if np.ptp(v) > 0 else 0.0
    if correlation < 0.7 or not 0.5 < ratio < 2:
        return reject_unless_trusted(
            f"'{joint}_velocity' is not the derivative of '{joint}' (correlation "
            f"{correlation:.2f}, ratio {ratio:.3g}), check the columns",
            trust,
        )
    if abs(delay) > longest_delay:
        reject_delay(f"{joint}_velocity", delay, f"'{joint}'", trust)
    return None


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
        (N, n) [N], [N m]; (1, n) zeros without loads.

    Raises:
        RecordingError: A load acts on an unknown link, or a load of the machine is not recorded.
    """
    frames = {force.name: force.frame for force in machine.external_forces}
    wrenches: dict[str, Array] = {}
    for column, values in recording.channels.items():
        pieces = column.removeprefix(_LOAD_PREFIX).rsplit("_", 2)
        part = "_".join(pieces[1:])
        if not column.startswith(_LOAD_PREFIX) or part not in WRENCH_COMPONENTS:
            continue
        name, unit = pieces[0], recording.channel_units[column]
        if unit != _PART_UNITS[part[:-2]]:
            raise RecordingError(
                f"'{column}' is recorded in {unit}, give {_PART_UNITS[part[:-2]]}"
            )
        if name not in frames:
            problem = f"'{column}' acts on no link of '{machine.name}'"
            check_name(name, machine.tree.links, problem, RecordingError)
        rows = wrenches.setdefault(name, np.zeros((len(values), len(WRENCH_COMPONENTS))))
        rows[:, WRENCH_COMPONENTS.index(part)] = values
    for name in frames:
        if name not in wrenches:
            reject_unless_trusted(
                f"'{machine.name}' has the load '{name}', and no column contains it: add "
                f"{_LOAD_PREFIX}{name}_force_x and so on, or take a machine without it",
                trust,
            )
    if not wrenches:
        return np.zeros((1, q_a.shape[1]))
    dynamics, total = Dynamics(machine), np.zeros_like(q_a)
    for name, rows in wrenches.items():
        total += dynamics.project_wrenches(q_a, {frames.get(name, name): rows})
    return total
