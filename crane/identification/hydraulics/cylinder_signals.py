"""What a recording tells of one hydraulic cylinder: stroke, opening of its valve, pressures."""

from dataclasses import dataclass, fields

import numpy as np

from crane.common.errors import InputError, RecordingError, suggest_names
from crane.common.samples import Array
from crane.hydraulics.components import Cylinder, Valve
from crane.identification.signals.signal_processing import (
    average_periods,
    differentiate,
    sampling_step,
)
from crane.machine import Machine
from crane.recordings.measured_recordings import locked_joint_conflicts
from crane.recordings.missing_measurements import check_columns_present
from crane.recordings.recording import Recording

_STROKE_TOLERANCE = 1e-3  # of the stroke by which a noisy sensor may leave it
_NOISE_SHARE = 0.03  # of the fastest speed, noise that is worth smoothing


@dataclass(frozen=True, eq=False)
class CylinderSignals:
    """Samples of one cylinder at N equidistant instants, pressures from a vacuum.

    Attributes:
        time: (N,) [s].
        x: Coordinate above the joint's lower limit (N,) [m] or [rad], as in equation (24).
        opening: Of the valve's edges (N,), -1 to 1.
        p_a: Pressure of chamber A (N,) [Pa].
        p_b: Of chamber B (N,).
        p_s: Of the supply (N,).
        p_r: Of the return line (N,).
        stroke: Distance s between the joint's limits [m] or [rad].
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
        """[s]."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))


SIGNAL_NAMES = ("x", "opening", "p_a", "p_b", "p_s", "p_r")


def cylinder_and_valve(machine: Machine, joint: str) -> tuple[Cylinder, Valve]:
    """Cylinder and valve of a joint.

    Raises:
        InputError: The machine has none there.
    """
    circuit = machine.hydraulics
    if circuit is None:
        raise InputError(f"'{machine.name}' has no hydraulics, add the section to its file")
    if joint not in circuit.cylinders:
        raise InputError(f"'{joint}' has no cylinder, {suggest_names(circuit.cylinders, joint)}")
    if circuit.valves[joint].spool_b:
        raise InputError(
            f"the valve of '{joint}' has two spools, which this does not tell apart: fit its "
            "numbers with crane calibrate"
        )
    return circuit.cylinders[joint], circuit.valves[joint]


def required_channels(joint: str) -> list[tuple[str, ...]]:
    """Channels of a cylinder: four pressures, and the signal of its valve or the spool."""
    names = [f"pressure_{joint}_a", f"pressure_{joint}_b", "pressure_supply", "pressure_tank"]
    return [*((name,) for name in names), (f"voltage_{joint}", f"spool_{joint}")]


def joint_index(recording: Recording, joint: str) -> int:
    """Column of a joint in q, v and tau.

    Raises:
        RecordingError: It is not recorded.
    """
    if joint not in recording.joints:
        raise RecordingError(
            f"'{joint}' is not recorded, {suggest_names(recording.joints, joint)}"
        )
    return recording.joints.index(joint)


def joint_velocity(recording: Recording, joint: str) -> Array:
    """A joint's velocity (N,) as recorded, or from a Kalman smoother of its coordinate.

    The latter where the recorded one is noisy, as differences of a measured coordinate are.
    """
    i = joint_index(recording, joint)
    v = recording.v[:, i]
    if noise_std(v) > _NOISE_SHARE * np.abs(v).max():
        return differentiate(recording.time, recording.q[:, [i]]).v[:, 0]
    return v


def channel_values(recording: Recording, name: str, unit: str) -> Array:
    """A further column (N,) in SI units.

    Raises:
        RecordingError: It is missing, or in another unit.
    """
    if name not in recording.channels:
        raise RecordingError(
            f"channel '{name}' [{unit}] is missing, {suggest_names(recording.channels, name)}"
        )
    given = recording.channel_units.get(name, "")
    if given not in ("", unit):
        raise RecordingError(f"channel '{name}' is in {given}, give {unit}")
    return recording.channels[name]


def cylinder_signals(
    machine: Machine, recording: Recording, joint: str, period: float | None = None
) -> CylinderSignals:
    """Signals of one cylinder from the columns of a recording.

    The opening comes from `spool_<joint>` where that is recorded, else from `voltage_<joint>`
    by `valve_opening`. A stroke that leaves its limits by noise is kept.

    Args:
        machine: With hydraulics.
        recording: With the joint, `pressure_<joint>_a`, `pressure_<joint>_b`,
            `pressure_supply` and `pressure_tank`.
        joint: The cylinder's.
        period: Of a periodic motion [s], to be averaged over its whole periods; None for none.

    Raises:
        InputError: The joint has no cylinder.
        RecordingError: A column is missing, in another unit, or out of the stroke; samples are
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
    """Opening y (N,) of spool positions u (N,), see `Valve`."""
    size = np.clip((np.abs(u) - valve.dead_band) / (1 - valve.dead_band), 0.0, 1.0)
    return np.copysign(size, u)


def spool_position(valve: Valve, voltage: Array, step: float) -> Array:
    """Spool position u (N,) that follows a signal (N,) [V].

    u'' + 2 damping w u' + w^2 u = w^2 (U - neutral) / (full - neutral), w the bandwidth, U the
    signal of t - delay, from rest at the first sample, straight between samples, which is exact to
    second order in the step. Without bandwidth the spool follows at once.

    Raises:
        RecordingError: It would move faster than the valve's rate, which this leaves out.
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

    Differences of order d have the variance binomial(2 d, d) sigma^2 of the noise and hardly
    anything of the signal; their median does not see jumps. The least over d from 2 to 8.
    """
    from scipy.special import comb

    found = []
    for order in range(2, 9):
        size = np.median(np.abs(np.diff(x, order)))
        found.append(1.4826 * float(size) / np.sqrt(comb(2 * order, order)))
    return min(found)


def signal_noise(
    signals: CylinderSignals, given: dict[str, float] | None = None
) -> dict[str, float]:
    """Standard deviation of each sensor's noise, estimated where it is not given.

    Raises:
        InputError: A sensor is unknown.
    """
    for name in given or {}:
        if name not in SIGNAL_NAMES:
            raise InputError(f"sensor '{name}' is unknown, {suggest_names(SIGNAL_NAMES, name)}")
    return {name: noise_std(getattr(signals, name)) for name in SIGNAL_NAMES} | (given or {})


def shift_signal(signals: CylinderSignals, name: str, offset: float) -> CylinderSignals:
    """The same signals with one of them moved; an opening of zero stays zero."""
    values = {entry.name: getattr(signals, entry.name) for entry in fields(signals)}
    where = values["opening"] != 0 if name == "opening" else 1.0
    return CylinderSignals(**values | {name: values[name] + offset * where})


def opening_regions(y: Array) -> np.ndarray:
    """Which smooth piece of the opening each sample (N,) is on: closed, open, or fully open."""
    return np.sign(y) * (1.0 + (np.abs(y) >= 1))
