"""Identification of neutral signal, dead band and flow gains of a compensated valve.

With pressure compensation the flow is a function of the signal U [V] alone. With e = U - neutral,
positive for extending (the sign changes if `full` is below `neutral`), the steady speed v and the
half dead band w,

    v = s_up max(e - w, 0) - s_down max(-e - w, 0),

With the nominal signal range S = |full - neutral| this is v A = gain (|u| - u0) / (1 - u0), u = e
/ S, u0 = w / S, gain = s A (S - w), with the area A of the inlet: of chamber A for extending, of B
for retracting.
"""

from dataclasses import dataclass

import numpy as np

from crane.common.errors import RecordingError
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.threads import with_single_threaded_blas
from crane.identification.estimation.estimators import EstimatedValues, least_squares
from crane.identification.hydraulics.cylinder_equations import (
    channel_values,
    cylinder_and_valve,
    joint_velocity,
)
from crane.identification.signals.signal_quality import steady_means
from crane.machine.machine import Machine
from crane.recordings.recording import Recording

PARAMETER_NAMES = (
    "edge up", "edge down", "slope up", "slope down",
    "neutral", "dead_band", "half width", "flow up", "flow down",
)  # fmt: skip
_PARAMETER_UNITS = ("V", "V", "{0}/s/V", "{0}/s/V", "V", "", "V", "m3/s", "m3/s")
_STANDSTILL_SHARE = 0.01  # of the fastest speed, below which the joint stands still
_MIN_SIGNAL_SPREAD = 0.05  # of the signal's range: least spread of levels in one direction


@dataclass(frozen=True, eq=False, repr=False)
class ValveCurve(EstimatedValues, Result):
    """Identified curve of the steady speed over the valve signal.

    Attributes:
        joint: The cylinder's.
        values: (9,) signals at the start of extending and retracting [V], and slopes of the speed
            in these directions [m/s/V] or [rad/s/V], both positive; of these follow the neutral
            signal [V], the dead band as the share u0 of the nominal stroke, its half width [V],
            and the flows at u = 1 for extending and retracting [m3/s].
        covariance: (9, 9) covariance of the values.
        degrees_of_freedom: Degrees of freedom of the covariance.
        signal_range: full - neutral [V]; negative if a lower signal extends.
        signal: (M,) signals of the steady samples [V].
        speed: (M,) speeds of the steady samples.
        noise: Standard deviation of the speeds about the curve.
        ringing: Lowest and highest frequency [Hz] and largest amplitude of speeds that ring at a
            constant signal and are averaged over periods; None if there are none.
    """

    joint: str
    values: Array
    covariance: Array
    degrees_of_freedom: float
    signal_range: float
    signal: Array
    speed: Array
    noise: float
    ringing: tuple[float, float, float] | None = None

    @property
    def neutral(self) -> float:
        """Signal in the middle of the dead band [V]."""
        return float(self.values[4])

    @property
    def dead_band(self) -> float:
        """Dead band as the share u0 of the nominal stroke."""
        return float(self.values[5])

    @property
    def full_flows(self) -> tuple[float, float]:
        """Flows at u = 1 for extending and retracting [m3/s]."""
        return float(self.values[7]), float(self.values[8])

    def parameter_intervals(self, level: float = 0.95) -> dict[str, tuple[float, float, float]]:
        """Value and confidence interval of each parameter by name."""
        table = np.column_stack([self.values, self.confidence_interval(level)])
        return {
            name: (v, low, high)
            for name, (v, low, high) in zip(PARAMETER_NAMES, table.tolist(), strict=True)
        }

    def predict(self, signal: Array) -> Array:
        """Steady speeds of signals (N,) [V]."""
        return _steady_speed(self.values[:4], signal, np.sign(self.signal_range))[0]

    def to_text(self, unit: str = "m") -> str:
        """Table of all parameters."""
        units = [text.format(unit) for text in _PARAMETER_UNITS]
        lines = [
            f"valve of {self.joint}: {len(self.signal)} steady samples",
            f"{'':<12}{'value':>12}   95 % interval",
        ]
        for (name, (value, low, high)), text in zip(
            self.parameter_intervals().items(), units, strict=True
        ):
            lines.append(f"{name:<12}{value:>12.5g}   {low:.5g} to {high:.5g} {text}".rstrip())
        if self.ringing is not None:
            low, high, size = self.ringing
            at = f"{low:.3g}" if high < 1.02 * low else f"{low:.3g} to {high:.3g}"
            lines.append(
                f"the speed rings at {at} Hz by up to {size:.3g} {unit}/s while the signal is "
                "held: means over its periods are taken"
            )
        return "\n".join(lines) + "\n"


@with_single_threaded_blas
def identify_valve(
    machine: Machine, recording: Recording, joint: str, settle: float = 0.5
) -> ValveCurve:
    """Identify dead band and gains of one valve from slow ramps or steps of its signal.

    Samples are used if signal and speed were steady over the last `settle` seconds, or, if the
    speed rings at a constant signal, if their means over its period were. If pressures are
    recorded, moving samples are omitted where the compensator has no margin (supply minus inlet
    below the margin of the valve), or where the inlet cavitates (below half of the tank pressure)
    under a pulling load. The lag of the spool shifts the edges by lag times rate of a ramp; ramps
    in both directions cancel this.

    Args:
        machine: Machine with hydraulics; of its valve `margin` is used, and `neutral` and `full`
            for direction and range.
        recording: Recording with the joint and `voltage_<joint>`; pressures as in
            `cylinder_signals`. A noisy velocity is replaced by that of a smoother of the
            coordinate.
        joint: The cylinder's.
        settle: Duration [s] of several response times of spool and load.

    Raises:
        InputError: The joint has no cylinder.
        RecordingError: A column is missing, no sample is steady, or a direction is not recorded at
            two signals.
    """
    cylinder, valve = cylinder_and_valve(machine, joint)
    signal = channel_values(recording, f"voltage_{joint}", "V")
    v = joint_velocity(recording, joint)
    means = steady_means(recording.time, settle, signal, v)
    is_steady, signal, v = means.kept.copy(), means.signal, means.answer
    fastest = float(np.abs(v).max())
    names = (f"pressure_{joint}_a", f"pressure_{joint}_b", "pressure_supply")
    if valve.margin and all(name in recording.channels for name in names):
        p_a, p_b, supply = (channel_values(recording, name, "Pa") for name in names)
        inlet = np.where(v > 0, p_a, p_b)
        tank = machine.hydraulics.supply.tank if machine.hydraulics else 0.0
        has_margin = (supply - inlet >= valve.margin) & (inlet > 0.5 * tank)
        is_steady &= has_margin | (np.abs(v) < _STANDSTILL_SHARE * fastest)
    span = valve.full - valve.neutral
    sign = float(np.sign(span))
    for sense, word in ((1, "extending"), (-1, "retracting")):
        moving = is_steady & (sense * v > _STANDSTILL_SHARE * fastest)
        if np.count_nonzero(moving) < 2 or np.ptp(signal[moving]) < _MIN_SIGNAL_SPREAD * np.ptp(
            signal
        ):
            raise RecordingError(
                f"'{joint}' has no steady {word} at two signals with margin at its valve, record "
                f"a slow ramp or steps of more than {settle:g} s of 'voltage_{joint}' that way"
            )
    at = np.flatnonzero(is_steady)
    # more samples add no information
    at = at[:: max(1, len(at) // 4000)]
    U, speeds = signal[at], v[at]
    values = _fit_curve(U, speeds, sign, fastest)
    fitted, J = _steady_speed(values, U, sign)
    estimate = least_squares(J, speeds - fitted + J @ values, samples=at)
    others, slopes = _valve_parameters(values, span, (cylinder.area_a, cylinder.area_b))
    J = np.vstack([np.eye(4), slopes])
    return ValveCurve(
        joint=joint,
        values=np.append(values, others),
        covariance=J @ estimate.covariance @ J.T,
        degrees_of_freedom=estimate.degrees_of_freedom,
        signal_range=span,
        signal=U,
        speed=speeds,
        noise=float(estimate.noise[0]),
        ringing=None if means.frequency is None else (*means.frequency, means.amplitude),
    )


def _valve_parameters(
    values: Array, signal_range: float, inlet_areas: tuple[float, float]
) -> tuple[Array, Array]:
    """Parameters (5,) of a machine file, see `ValveCurve`, and their Jacobian (5, 4)."""
    up, down, *slopes = values
    turn, size = np.sign(signal_range), abs(signal_range)
    half, d_half = 0.5 * turn * (up - down), 0.5 * turn * np.array([1.0, -1, 0, 0])
    found = [0.5 * (up + down), half / size, half]
    rows = [np.array([0.5, 0.5, 0, 0]), d_half / size, d_half]
    for i, (area, slope) in enumerate(zip(inlet_areas, slopes, strict=True)):
        found.append(area * slope * (size - half))
        rows.append(-area * slope * d_half)
        rows[-1][2 + i] += area * (size - half)
    return np.array(found), np.array(rows)


def _steady_speed(values: Array, U: Array, sign: float) -> tuple[Array, Array]:
    """Steady speeds (M,) of signals (M,), and their Jacobian (M, 4)."""
    up, down, s_up, s_down = values
    rising, falling = np.maximum(sign * (U - up), 0), np.maximum(sign * (down - U), 0)
    columns = [-sign * s_up * (rising > 0), -sign * s_down * (falling > 0), rising, -falling]
    return s_up * rising - s_down * falling, np.column_stack(columns)


def _fit_curve(U: Array, v: Array, sign: float, fastest: float) -> Array:
    """Fit edges and slopes by least squares, starting from straight lines in each direction."""
    from scipy import optimize

    start = np.empty(4)
    for i, sense in enumerate((1, -1)):
        moving = sense * v > 0.1 * fastest
        if np.ptp(U[moving]) == 0:
            moving = sense * v > _STANDSTILL_SHARE * fastest
        slope, offset = np.polyfit(U[moving], v[moving], 1)
        start[i], start[2 + i] = -offset / slope, abs(slope)
    volts, rate = float(np.ptp(U)), float(np.abs(start[2:]).max())

    def residuals(x: Array) -> Array:
        return _steady_speed(x, U, sign)[0] - v

    def jacobian(x: Array) -> Array:
        return _steady_speed(x, U, sign)[1]

    scale = [volts, volts, rate, rate]
    fine = 1e-14
    found = optimize.least_squares(
        residuals, start, jac=jacobian, x_scale=scale, xtol=fine, ftol=fine, gtol=fine
    )
    return found.x
