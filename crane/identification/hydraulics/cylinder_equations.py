"""Signals of a hydraulic cylinder, and its equations of bulk modulus and orifices in weak form.

The pressure rates of the chambers, equation (23) with the flows (21), (22), over V and beta:

    A:  p_A' / beta - (c1 y+ r1 + c3 y- r3) / V_A = -(ln V_A)'
    B:  p_B' / beta + (c2 y+ r2 + c4 y- r4) / V_B = -(ln V_B)'

    r1 = root(p_S - p_A), r2 = root(p_B - p_R), r3 = root(p_A - p_R), r4 = root(p_S - p_B),

with y+ = max(y, 0), y- = min(y, 0) of the opening and root(d) = sign(d) sqrt(|d|) for flow in both
directions. A valve with a margin limits r1 and r4 to the root of the margin and has no return
flow. Area A times the first equation minus area B times the second is equation (29), A X = Y, X =
[1/beta, c1, c2, c3, c4].

Equations are those of the electro-hydraulic forwarder paper (IROS 2012).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

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
_EXPONENT = 6
_MIN_HALF_WIDTH = 32  # least number of steps to either side of a centre
_WINDOWS_PER_LENGTH = 8  # windows per window length


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
    """Opening (N,) for spool positions u (N,), see `Valve`.

    Raises:
        InputError: The spool has an underlap, so that several edges are open at once.
    """
    if valve.dead_band < 0:
        raise InputError(
            f"the valve of '{valve.joint}' has an underlap, whose edges this method does not "
            "separate: fit its parameters with crane calibrate"
        )
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
        return command
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
    return states[:, 0] + start


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


@dataclass(frozen=True, eq=False)
class EquationSides:
    """Both sides of equation (29) [m2/s], or [m3/(rad s)].

    Attributes:
        time: (K,) [s].
        predicted: (K,) A X for the estimated parameters.
        measured: (K,) measured Y.
    """

    time: Array
    predicted: Array
    measured: Array

    @property
    def relative_error(self) -> float:
        """Norm of the difference over the norm of the measured side."""
        return float(
            np.linalg.norm(self.measured - self.predicted) / np.linalg.norm(self.measured)
        )


class OrificeEquations:
    """Equations of one recording: E equations on two halves of the samples of K windows.

    Args:
        machine: With hydraulics.
        joint: The cylinder's.
        signals: Signals of the recording.
        window_length: Length of the windows [s].
        per_chamber: Whether to use both equations (23), or their difference (29).

    Attributes:
        combination: (E, 2) weights of the equations of chambers A and B.
        windows: Test functions.
        is_smooth: (K,) mask of windows without kinks of the opening.
        W: (E, 2, K, 5) columns of X.
        y: (E, 2, K) right-hand sides.
    """

    def __init__(
        self,
        machine: Machine,
        joint: str,
        signals: CylinderSignals,
        window_length: float,
        per_chamber: bool,
    ):
        cylinder, _ = cylinder_and_valve(machine, joint)
        areas = np.array([cylinder.area_a, -cylinder.area_b])
        self.machine, self.joint, self.signals = machine, joint, signals
        self.combination = np.eye(2) if per_chamber else areas[None]
        # weights of the equations in (29)
        self._difference_weights = areas if per_chamber else np.ones(1)
        self.windows = w = WeakFormWindows.create(len(signals.time), signals.step, window_length)
        # closed, open, or fully open, with sign
        regions = np.sign(signals.opening) * (1.0 + (np.abs(signals.opening) >= 1))
        self.is_smooth = w.are_uniform(regions)
        states, columns = self._combined_terms(signals)
        self.W = np.empty((len(self.combination), 2, len(w.centres), 5))
        self.y = np.empty(self.W.shape[:3])
        for e in range(len(self.combination)):
            self.W[e, :, :, 0] = w.integrate(w.phi_derivative, states[e, 0])
            for j in range(4):
                self.W[e, :, :, 1 + j] = w.integrate(w.phi, columns[e, j])
            self.y[e] = -w.integrate(w.phi_derivative, states[e, 1])

    def _combined_terms(self, signals: CylinderSignals) -> tuple[Array, Array]:
        states, columns = chamber_terms(self.machine, self.joint, signals)
        combination = self.combination
        return np.tensordot(combination, states, 1), np.tensordot(combination, columns, 1)

    def sides(self, X: Array) -> EquationSides:
        """Both sides of (29) for X (5,) in all windows."""
        W, y = (np.tensordot(self._difference_weights, x, 1) for x in (self.W, self.y))
        time = self.signals.time[self.windows.centres]
        return EquationSides(time, (W @ X).mean(axis=0), y.mean(axis=0))

    def noise_sensitivity(self, X: Array, sensor: str, offset: float) -> tuple[Array, Array]:
        """Changes (E, N) of the differentiated part and of the other part by noise of a sensor."""
        ends, values = [], getattr(self.signals, sensor)
        where = values != 0 if sensor == "opening" else 1.0  # an opening of zero stays zero
        for sign in (1, -1):
            shifted = replace(self.signals, **{sensor: values + sign * offset * where})
            states, columns = self._combined_terms(shifted)
            ends.append((states[:, 0] * X[0] + states[:, 1], np.tensordot(columns, X[1:], (1, 0))))
        return 0.5 * (ends[0][0] - ends[1][0]), 0.5 * (ends[0][1] - ends[1][1])


def chamber_terms(machine: Machine, joint: str, signals: CylinderSignals) -> tuple[Array, Array]:
    """Terms of both chambers that are differentiated, and the others.

    Returns:
        (p_A, ln V_A), (p_B, ln V_B) as (2, 2, N), and the columns of c1 to c4 (2, 4, N), so that
        p' / beta + columns c = -(ln V)'.
    """
    cylinder, valve = cylinder_and_valve(machine, joint)
    volume_a = cylinder.hose_a + cylinder.area_a * signals.x
    volume_b = cylinder.hose_b + cylinder.area_b * (signals.stroke - signals.x)
    up, down = np.maximum(signals.opening, 0), np.minimum(signals.opening, 0)

    def inlet(drop: Array) -> Array:
        return _signed_sqrt(np.clip(drop, 0, valve.margin) if valve.margin else drop)

    none = np.zeros_like(up)
    columns = np.array(
        [
            [
                -up * inlet(signals.p_s - signals.p_a) / volume_a,
                none,
                -down * _signed_sqrt(signals.p_a - signals.p_r) / volume_a,
                none,
            ],
            [
                none,
                up * _signed_sqrt(signals.p_b - signals.p_r) / volume_b,
                none,
                down * inlet(signals.p_s - signals.p_b) / volume_b,
            ],
        ]
    )
    return np.array([[signals.p_a, np.log(volume_a)], [signals.p_b, np.log(volume_b)]]), columns


def _signed_sqrt(drop: Array) -> Array:
    """Signed square root sign(d) sqrt(|d|)."""
    return np.copysign(np.sqrt(np.abs(drop)), drop)


@dataclass(frozen=True, eq=False)
class WeakFormWindows:
    """Windows of test functions (1 - s^2)^6, each on even and on odd sample offsets.

    For phi that vanishes at both ends of its window, int phi f' dt = -int phi' f dt: no measured
    signal is differentiated. With s from -1 to 1 the first five derivatives of phi vanish at the
    ends, so that sums over equidistant samples approximate the integrals to the order of (pi
    samples)^-7 for a smooth integrand. White noise of one half is independent of that of the other
    half, so each half is an instrument for the other.

    Attributes:
        centres: (K,) samples of the centres.
        phi: (2, 2 n + 1) weights of the mean over a window by either half; their sum is 1.
        phi_derivative: (2, 2 n + 1) weights of the mean derivative by either half [1/s].
    """

    centres: np.ndarray
    phi: Array
    phi_derivative: Array

    @classmethod
    def create(cls, count: int, step: float, length: float) -> "WeakFormWindows":
        """Create windows of `length` [s], at least 64 steps, over `count` samples.

        Raises:
            RecordingError: There are fewer samples than in one window.
        """
        half_width = 4 * max(round(length / step / 8), _MIN_HALF_WIDTH // 4)
        spacing = 2 * max(2 * half_width // _WINDOWS_PER_LENGTH // 2, 1)
        if count < 2 * half_width + 1:
            raise RecordingError(
                f"{count} samples are fewer than the {2 * half_width + 1} of one window, record "
                f"longer"
            )
        offsets = np.arange(-half_width, half_width + 1.0)
        s = offsets / half_width
        half = np.stack([offsets % 2 == 0, offsets % 2 == 1])
        phi = (1 - s**2) ** _EXPONENT * half
        phi_derivative = s * (1 - s**2) ** (_EXPONENT - 1) * half
        return cls(
            np.arange(half_width, count - half_width, spacing),
            phi / phi.sum(axis=1, keepdims=True),
            phi_derivative / (phi_derivative @ offsets * step)[:, None],
        )

    @property
    def half_width(self) -> int:
        """Steps from a centre to either end of its window."""
        return self.phi.shape[1] // 2

    def integrate(self, weights: Array, f: Array) -> Array:
        """Weighted sums (2, K) of a signal (N,) over all windows."""
        view = sliding_window_view(f, weights.shape[1])[self.centres - self.half_width]
        return weights @ view.T

    def apply_transpose(self, weights: Array, rows: Array, count: int) -> Array:
        """Transpose of `integrate` (N, p), applied to rows (2, K, p)."""
        out = np.zeros((count, rows.shape[2]))
        for half in range(2):
            for offset in np.flatnonzero(weights[half]):
                out[self.centres - self.half_width + offset] += weights[half, offset] * rows[half]
        return out

    def are_uniform(self, labels: np.ndarray) -> np.ndarray:
        """Mask (K,) of windows in which the labels (N,) are constant."""
        changes = np.append(0, np.cumsum(np.diff(labels) != 0))
        return changes[self.centres + self.half_width] == changes[self.centres - self.half_width]
