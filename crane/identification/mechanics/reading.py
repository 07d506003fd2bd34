"""From a recording to a motion: what is wrong with it is told, derivatives are found."""

import math
import warnings

import numpy as np

from crane.common.errors import CraneWarning, RecordingError, known
from crane.common.samples import Array
from crane.identification.mechanics.checks import (
    check,
    check_samples,
    doubt,
    tell_hum,
    without_outliers,
)
from crane.identification.mechanics.delays import motion_frequency
from crane.identification.mechanics.equations import Progress
from crane.identification.mechanics.outside import from_outside
from crane.identification.signals.motion import Derivatives, Motion, differentiate, evenly
from crane.identification.signals.outliers import outliers, repaired
from crane.machine import Machine
from crane.recordings.measured import moved_locks
from crane.recordings.recording import FORCE, VELOCITY, VELOCITY_UNITS, Recording, derivative

_MOVES = 3.0  # standard deviations of a joint's velocity, above which it moves
_TOO_FAST = 30.0  # times its limit, at which no joint moves
_HUM = 10.0  # times the frequency of the motion, above which a line in a spectrum is hum


def smoothed_motion(
    machine: Machine,
    recording: Recording,
    derivatives: str = "kalman",
    cutoff: float | None = None,
    trust: bool = False,
    progress: Progress | None = None,
) -> Motion:
    """Velocities and accelerations of a recording, which is checked first.

    Outliers are bridged by lines between their neighbours, before anything is filtered. Forces
    are those of the joints and of recorded loads together.

    Args:
        machine: What was recorded.
        recording: With all active joints of the machine.
        derivatives: "kalman" or "lowpass", see `signals.differentiate`.
        cutoff: [Hz] of "lowpass".
        trust: Whether what is most likely wrong with the recording is only told, and outliers
            are left in.
        progress: Takes the finished share.

    Raises:
        RecordingError: What is recorded cannot serve; the message names column and time.
    """
    given, recording = recording, _of_machine(machine, recording)
    every = {x: column for x, column in given.columns().items() if x in machine.locks}
    for text in moved_locks(machine, every, given.units | given.channel_units):
        doubt(f"{text}, do not lock it, or lock it where it is", trust)
    time, n = recording.time, len(machine.active)
    check_samples(time)
    names = [x + suffix for suffix in ("", FORCE) for x in machine.active]
    columns = without_outliers(time, names, np.hstack([recording.q, recording.tau]), trust)
    _check(machine, time, columns, recording.v, trust)
    columns[:, n:] += from_outside(machine, given, columns[:, :n], trust)
    time, columns = evenly(time, columns)
    step = float(np.median(np.diff(time)))
    lowest = _HUM * motion_frequency(columns[:, :n], step)
    tell_hum(time, dict(zip(names, columns.T, strict=True)), lowest)
    found = differentiate(time, columns[:, :n], derivatives, cutoff, progress)
    v, a = np.where(_moves(found), (found.v, found.a), 0.0)
    _check_speeds(machine, v, trust)
    _tell_still(machine, found, v)
    return Motion(time, found.q, v, a, columns[:, n:], _passed(found))


def _of_machine(machine: Machine, recording: Recording) -> Recording:
    """Of a recording what belongs to the machine's active joints, in their order.

    Free joints may be among the channels: their force is known to be zero.

    Raises:
        RecordingError: One is missing, or in another unit, or a free one has a force.
    """
    every, units = recording.columns(), recording.units | recording.channel_units
    there = {*recording.joints, *(x for x in machine.free if x in every)}
    missing = [joint for joint in machine.active if joint not in there]
    if missing:
        listed = ", ".join(f"'{joint}'" for joint in missing)
        held = " ".join(f"--lock {joint}=VALUE" for joint in missing)
        raise RecordingError(
            f"{listed} of '{machine.name}' not recorded, {known(recording.joints)}; lock what was "
            f"held ({held})"
        )
    for joint in machine.active:
        if units[joint] != machine.unit(joint):
            raise RecordingError(
                f"'{joint}' is recorded in {units[joint]}, give {machine.unit(joint)}"
            )
    none = np.zeros_like(recording.time)
    q = np.column_stack([every[joint] for joint in machine.active])
    tau = np.column_stack([every.get(joint + FORCE, none) for joint in machine.active])
    rates = [every.get(x + VELOCITY, derivative(every[x], recording.time)) for x in machine.active]
    v = np.column_stack(rates)
    known_as = {joint: machine.unit(joint) for joint in machine.active}
    return Recording(recording.time, machine.active, q, v, tau, known_as, free=machine.free)


def _check(machine: Machine, time: Array, columns: Array, v: Array, trust: bool) -> None:
    """Refuse coordinates and forces (N, 2 n), and velocities (N, n) as recorded, by `check`."""
    q, tau = np.split(columns, 2, axis=1)
    recorded = None
    if np.any(v):  # only compared; where none were recorded, derivatives of outliers
        recorded = np.column_stack([repaired(x, outliers(x)) for x in v.T])
    limits = np.column_stack([machine.lower, machine.upper])
    bounded = limits if np.isfinite(limits).all() else None
    units = {joint: machine.unit(joint) for joint in machine.active}
    free = machine.free
    check(time, q, tau, machine.active, units, recorded, bounded, free=free, trust=trust)


def _check_speeds(machine: Machine, v: Array, trust: bool) -> None:
    """Doubt velocities (N, n) that the machine's joints are far from having."""
    limits = machine.model.velocityLimit[machine.closure.active]
    for joint, speed, limit in zip(
        machine.active, np.sqrt(np.mean(v**2, axis=0)), limits, strict=True
    ):
        if 0 < limit < speed / _TOO_FAST:
            unit = VELOCITY_UNITS[machine.unit(joint)]
            doubt(
                f"'{joint}' moves at {speed:.3g} {unit} on the whole, its limit is {limit:.3g} "
                f"{unit}: look at the unit of the time",
                trust,
            )


def _passed(found: Derivatives) -> float:
    """Least of the frequencies [Hz] of which half is left, of the joints that move."""
    if found.passed is None:
        return math.inf
    return float(found.passed[_moves(found)].min(initial=math.inf))


def _moves(found: Derivatives) -> np.ndarray:
    """Which joints (n,) move by more than what is uncertain of their velocities."""
    if found.std_v is None:
        return np.ones(found.v.shape[1], dtype=bool)
    uncertain = np.sqrt(np.mean(found.std_v**2, axis=0))
    return np.asarray(found.v.std(axis=0) > _MOVES * uncertain)


def _tell_still(machine: Machine, found: Derivatives, v: Array) -> None:
    """Warn of joints that tremble, but do not move: friction at rest makes any force."""
    for i in np.flatnonzero(~v.any(axis=0) & found.v.any(axis=0)).tolist():
        joint, place = machine.active[i], float(found.q[:, i].mean())
        text = (
            f"'{joint}' stands still but for noise: its forces tell nothing, move it, or lock it "
            f"({joint}={place:.4g})"
        )
        warnings.warn(text, CraneWarning, stacklevel=3)
