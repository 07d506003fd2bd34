"""Signals of one hydraulic cylinder in a recording: stroke, valve opening, pressures."""

from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError, RecordingError, check_name
from crane.common.samples import Array
from crane.hydraulics.components import Cylinder, Valve
from crane.identification.signals.signal_processing import (
    average_periods,
    differentiate,
    sampling_step,
)
from crane.machine.machine import Machine
from crane.recordings.measured_recordings import locked_joint_conflicts
from crane.recordings.recording import Recording
from crane.recordings.timeseries import check_columns_present

_STROKE_TOLERANCE = 1e-3  # of the stroke, for noise beyond its ends
_NOISE_SHARE = 0.03  # of the fastest speed; noise above it is smoothed


@dataclass(frozen=True, eq=False)
class CylinderSignals:
    """Signals of one cylinder at N equidistant instants, with absolute pressures.

    Attributes:
        time: (N,) [s].
        x: (N,) coordinate above the lower limit of the joint [m] or [rad], as in equation (24).
        opening: (N,) opening of the valve, -1 to 1.
        p_a: (N,) pressure of chamber A [Pa].
        p_b: (N,) pressure of chamber B [Pa].
        p_s: (N,) pressure of the supply [Pa].
        p_r: (N,) pressure of the return line [Pa].
        stroke: Distance between the limits of the joint [m] or [rad].
    """

    time: Array
    x: Array
    opening: Array
    p_a: Array
    p_b: Array
    p_s: Array
    p_r: Array
    stroke: float

    @property
    def step(self) -> float:
        """Sampling step [s]."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))


SIGNAL_NAMES = ("x", "opening", "p_a", "p_b", "p_s", "p_r")


def cylinder_and_valve(machine: Machine, joint: str) -> tuple[Cylinder, Valve]:
    """Cylinder and valve of a joint.

    Raises:
        InputError: The machine has none at this joint, or the valve has two spools.
    """
    circuit = machine.hydraulics
    if circuit is None:
        raise InputError(f"'{machine.name}' has no hydraulics, add the section to its file")
    check_name(joint, circuit.cylinders, f"'{joint}' has no cylinder")
    if circuit.valves[joint].spool_b:
        raise InputError(
            f"the valve of '{joint}' has two spools, which this method does not separate: fit "
            "its parameters with crane calibrate"
        )
    return circuit.cylinders[joint], circuit.valves[joint]


def required_channels(joint: str) -> list[tuple[str, ...]]:
    """Required channels of a cylinder: four pressures, and the valve signal or spool position."""
    names = [f"pressure_{joint}_a", f"pressure_{joint}_b", "pressure_supply", "pressure_tank"]
    return [*((name,) for name in names), (f"voltage_{joint}", f"spool_{joint}")]


def joint_index(recording: Recording, joint: str) -> int:
    """Column of a joint in q, v and tau.

    Raises:
        RecordingError: It is not recorded.
    """
    check_name(joint, recording.joints, f"'{joint}' is not recorded", RecordingError)
    return recording.joints.index(joint)


def joint_velocity(recording: Recording, joint: str) -> Array:
    """Recorded velocity (N,) of a joint, or that of a Kalman smoother of its coordinate.

    The smoother is used if the recorded velocity is noisy.
    """
    i = joint_index(recording, joint)
    v = recording.v[:, i]
    if noise_std(v) > _NOISE_SHARE * np.abs(v).max():
        return differentiate(recording.time, recording.q[:, [i]]).v[:, 0]
    return v


def channel_values(recording: Recording, name: str, unit: str) -> Array:
    """Channel (N,) in SI units.

    Raises:
        RecordingError: The channel is missing, or has another unit.
    """
    check_name(name, recording.channels, f"channel '{name}' [{unit}] is missing", RecordingError)
    given = recording.channel_units.get(name, "")
    if given not in ("", unit):
        raise RecordingError(f"channel '{name}' is in {given}, give {unit}")
    return recording.channels[name]


def cylinder_signals(
    machine: Machine, recording: Recording, joint: str, period: float | None = None
) -> CylinderSignals:
    """Extract the signals of one cylinder from a recording.

    The opening is computed from `spool_<joint>` if it is recorded, else from `voltage_<joint>` by
    `spool_position` and `valve_opening`. Strokes may exceed their limits by noise.

    Args:
        machine: With hydraulics.
        recording: Recording with the joint, `pressure_<joint>_a`, `pressure_<joint>_b`,
            `pressure_supply` and `pressure_tank`.
        joint: Joint of the cylinder.
        period: Period of a periodic motion [s], which is averaged over its periods; None for none.

    Raises:
        InputError: The joint has no cylinder.
        RecordingError: A column is missing, has another unit, or exceeds the stroke; samples are
            not equidistant.
    """
    _, valve = cylinder_and_valve(machine, joint)
    for text in locked_joint_conflicts(
        machine, recording.columns(), recording.units | recording.channel_units
    ):
        raise RecordingError(f"{text}, do not lock it, or lock it where it is")
    q = recording.q[:, joint_index(recording, joint)]
    index = machine.active.index(joint)
    lower, upper = float(machine.lower[index]), float(machine.upper[index])
    slack = _STROKE_TOLERANCE * (upper - lower)
    if q.min() < lower - slack or q.max() > upper + slack:
        raise RecordingError(
            f"'{joint}' goes from {q.min():.4g} to {q.max():.4g} {machine.unit(joint)}, its "
            f"limits are {lower:.4g} and {upper:.4g}, check its zero and unit"
        )
    step = sampling_step(recording.time)
    check_columns_present(required_channels(joint), recording.channels)
    *names, (signal, spool) = required_channels(joint)
    pressures = [channel_values(recording, name, "Pa") for (name,) in names]
    if spool in recording.channels:
        y = valve_opening(valve, recording.channels[spool])
    else:
        voltage = channel_values(recording, signal, "V")
        y = valve_opening(valve, spool_position(valve, voltage, step))
    time, columns = recording.time, np.column_stack([q - lower, y, *pressures])
    if period is not None:
        time, columns, _ = average_periods(time, columns, period)
    x, y, p_a, p_b, p_s, p_r = np.ascontiguousarray(columns.T)
    return CylinderSignals(time, x, y, p_a, p_b, p_s, p_r, upper - lower)


def valve_opening(valve: Valve, u: Array) -> Array:
    """Opening (N,) for spool positions u (N,), see `Valve`."""
    return np.copysign(np.clip((np.abs(u) - valve.dead_band) / (1 - valve.dead_band), 0.0, 1.0), u)


def spool_position(valve: Valve, voltage: Array, step: float) -> Array:
    """Spool position u (N,) for a valve signal (N,) [V].

    It solves u'' + 2 damping w u' + w^2 u = w^2 (U - neutral) / (full - neutral) with the
    bandwidth w and the signal U at t - delay, from rest at the first sample, with linear
    interpolation of the signal. Without bandwidth the spool follows the signal without lag.

    Raises:
        RecordingError: The spool would exceed the rate of the valve, which is not modelled here.
    """
    from scipy.signal import cont2discrete, dlsim

    command = (voltage - valve.neutral) / (valve.full - valve.neutral)
    if valve.delay:
        samples = np.arange(len(command), dtype=np.float64)
        command = np.interp(samples - valve.delay / step, samples, command)
    if not valve.bandwidth:
        return np.asarray(command)
    w = valve.bandwidth
    A = np.array([[0.0, 1.0], [-w * w, -2 * valve.damping * w]])
    system = cont2discrete(
        (A, np.array([[0.0], [w * w]]), np.eye(2), np.zeros((2, 1))), step, "foh"
    )
    start = command[0]
    _, states, _ = dlsim(system, command - start)
    fastest = float(np.abs(states[:, 1]).max())
    if valve.rate and fastest > valve.rate:
        raise RecordingError(
            f"the signal asks the spool of '{valve.joint}' for {fastest:.3g} strokes/s, above its "
            f"rate {valve.rate:g}, record 'spool_{valve.joint}'"
        )
    return np.asarray(states[:, 0] + start)


def noise_std(x: Array) -> float:
    """Standard deviation of white noise on a smooth signal (N,).

    Differences of order d have the variance binomial(2 d, d) sigma^2 of the noise and little of
    the signal; their median is robust against jumps. The minimum over d from 2 to 8 is returned.
    """
    from scipy.special import comb

    found = []
    for order in range(2, 9):
        size = np.median(np.abs(np.diff(x, order)))
        found.append(1.4826 * float(size) / np.sqrt(comb(2 * order, order)))
    return min(found)
