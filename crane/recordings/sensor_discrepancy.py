"""Discrepancies of redundant sensors, compared through the loops of the machine.

The determining sensors give the expected reading of every redundant sensor. A discrepancy is
explained, by least squares over the recording, by the simplest cause that leaves no more than
noise: a zero of the sensor or of a determining one, then a delay, a scale, or another position of
a pin. Rates are compared by their integrals, so that noise does not hide their zero.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from crane.common.errors import ClosureError, CraneWarning, MechanismError, RecordingError
from crane.common.samples import Array, root_mean_square
from crane.common.scratch_arrays import release_pages
from crane.description.sensors import (
    INCLINATION_PREFIX,
    SENSOR_PREFIX,
    VELOCITY_SUFFIX,
    Sensor,
    quantity_unit,
)
from crane.machine.machine import Machine
from crane.recordings.measured_configurations import (
    AGREEMENT_TOLERANCE,
    MeasuredConfigurations,
    add_inclination_angles,
    tolerance,
)
from crane.recordings.recording_reader import known_sensors
from crane.recordings.timeseries import TIME, Table, table_column

# standard deviations of a significant discrepancy, and of an accepted residual
_NOISE_FACTORS = (
    3.3,
    2.0,
)
_RANDOM_WALK_FACTOR = 1.5  # of the random walk of integrated white noise
_EQUIVALENT_FACTOR = 2.0  # times the residual of the best cause
_IMPROVEMENT_SHARE = 0.8  # of the residual of a zero, below which other causes are reported
# times the residual of the best of those, and how many are listed
_NEAR_BEST_FACTOR, _MAX_LISTED = 1.3, 2
_STANDSTILL_SHARE = 0.05  # of the expected motion
_MIN_MOTION_FACTOR = 4.0  # times the tolerance; less motion does not determine scale and delay
_ZERO_DERIVATIVE = 1e-6  # derivative that counts as zero
_MAX_ITERATIONS = 4  # Gauss-Newton iterations
_DISPLAY_UNITS = {"rad": ("deg", 180 / np.pi), "m": ("mm", 1e3)}


def warn_discrepancies(machine: Machine, table: Table) -> None:
    """Warn of redundant sensors that disagree with the determining ones, a line each.

    Redundant joints, inclinations and rates are compared with the values that the determining
    joints give.
    """
    known = known_sensors(table, machine)
    try:
        configurations = MeasuredConfigurations(machine, add_inclination_angles(machine, table))
        messages = [
            _RedundantSensor(configurations, name).discrepancy_message(known, list(table.units))
            for name in _redundant_columns(machine, table, configurations.drives)
        ]
    except (ClosureError, MechanismError):  # the caller reports that loops do not close
        return
    for text in filter(None, messages):
        warnings.warn(text, CraneWarning, stacklevel=3)


def displaced_pins(machine: Machine, table: Table) -> dict[str, float]:
    """Coordinates [m] of pins whose error explains a discrepancy better than a zero does.

    Args:
        machine: The machine.
        table: Measured quantities.
    """
    try:
        configurations = MeasuredConfigurations(machine, add_inclination_angles(machine, table))
        sensors = [
            _RedundantSensor(configurations, name)
            for name in _redundant_columns(machine, table, configurations.drives)
        ]
    except (ClosureError, MechanismError, RecordingError):
        return {}
    return {name: value for x in sensors for name, value in x.displaced_pins().items()}


def _redundant_columns(machine: Machine, table: Table, drives: tuple[str, ...]) -> list[str]:
    names = [x for x, unit in table.units.items() if unit == quantity_unit(machine.tree, x)]
    determined = {*machine.joints, *(x + VELOCITY_SUFFIX for x in machine.joints)}
    return [
        x
        for x in names
        if x not in drives and (x in determined or x.startswith(INCLINATION_PREFIX))
    ]


@dataclass(frozen=True)
class _DiscrepancyCause:
    """Possible cause of a discrepancy.

    Attributes:
        sensor_parameters: By sensor, zero, scale and delay relative to the known ones.
        residual_rms: Root mean square of the remaining discrepancy.
        description: Text of the cause.
        pin_positions: Positions of pins by name [m].
    """

    sensor_parameters: dict[str, dict[str, float]]
    residual_rms: float
    description: str
    pin_positions: dict[str, float] = field(default_factory=dict)

    def format_parameters(self, known: Mapping[str, Sensor]) -> str:
        """Text of the parameters as in machine files, notes and options."""
        found = []
        for name, now in self.sensor_parameters.items():
            was = known.get(name, Sensor())
            values = {
                "zero": was.zero + was.scale * now.get("zero", 0.0),
                "scale": was.scale * now.get("scale", 1.0),
                "delay": was.delay + now.get("delay", 0.0),
            }
            found += [f"{SENSOR_PREFIX}{name}.{what} = {values[what]:.4g}" for what in now]
        return ", ".join(
            found + [f"{name} = {value:.4g}" for name, value in self.pin_positions.items()]
        )


class _RedundantSensor:
    """Redundant sensor, compared with the determining ones.

    Args:
        configurations: Configurations by the determining joints.
        name: Column of the sensor.
    """

    def __init__(self, configurations: MeasuredConfigurations, name: str):
        self._configurations, self.name = configurations, name
        self.time = configurations.time
        self.quantity = name.removesuffix(VELOCITY_SUFFIX)
        self.is_rate = self.quantity != name
        self.unit = str(quantity_unit(configurations.machine.tree, self.quantity))
        from scipy.integrate import cumulative_trapezoid

        release_pages()
        reading, random_walk = table_column(configurations.table, name), 0.0
        if self.is_rate:
            time = table_column(configurations.table, TIME)
            random_walk = (
                noise_std(reading) * float(time[-1] - time[0]) / float(np.sqrt(len(time)))
            )
            reading = cumulative_trapezoid(reading, time, initial=0)
        self.measured = reading[configurations.sample_slice]
        self.expected = configurations.expected_reading(self.quantity)
        self.off = self.measured - self.expected
        if self.is_rate:
            self.off = self.off - self.off.mean()
        elif self.unit == "rad":
            self.off = self.off - 2 * np.pi * np.round(np.median(self.off) / (2 * np.pi))
        noise = noise_std(self.off)
        self.tolerance = tolerance(AGREEMENT_TOLERANCE, configurations.machine, self.unit)
        # limits of a discrepancy and of a residual; integrated noise is a random walk
        self.most = max(
            self.tolerance, _NOISE_FACTORS[0] * noise, _RANDOM_WALK_FACTOR * random_walk
        )
        self.limit = max(self.tolerance, _NOISE_FACTORS[1] * noise, random_walk)

    def discrepancy_message(
        self, known: Mapping[str, Sensor], measured_columns: Sequence[str]
    ) -> str:
        """Message about the discrepancy and its cause; "" if there is none.

        Args:
            known: Known sensors.
            measured_columns: Measured columns, whose zeros may be the cause.
        """
        mean, spread = float(self.off.mean()), float(self.off.std())
        if abs(mean) <= self.tolerance and spread <= self.most:
            return ""
        cause = self._explanation(known, measured_columns)
        if self.is_rate and not cause:
            return ""  # integrals of rates drift for many reasons
        unit, factor = _DISPLAY_UNITS[self.unit]
        used = ", ".join(self._determining_joints())
        if self.is_rate:
            drift_rate = factor * float(self._fit_discrepancy([self.time])[0][0])
            return (
                f"sensors disagree: '{self.name}' deviates from the rate computed from {used} by "
                f"{drift_rate:+.3g} {unit}/s on average; {cause}"
            )
        low, high = factor * self.off.min(), factor * self.off.max()
        return (
            f"sensors disagree: '{self.name}' deviates from the value computed from {used} by "
            f"{factor * mean:+.3g} {unit} on average ({low:+.3g} to {high:+.3g}); {cause}"
        )

    def displaced_pins(self) -> dict[str, float]:
        """Coordinates [m] of the pin that explains the discrepancy best, if no zero does."""
        zero_residual = self._fit_discrepancy([self._zero_column])[1]
        causes = [] if self.is_rate or zero_residual <= self.limit else self._pin_causes()
        best = min(causes, key=lambda x: x.residual_rms, default=None)
        if best is None or best.residual_rms > _IMPROVEMENT_SHARE * zero_residual:
            return {}
        return best.pin_positions

    def _determining_joints(self) -> list[str]:
        configurations = self._configurations
        q = configurations.q[configurations.derivative_slice]
        slopes = [
            configurations.directional_derivative(self.quantity, q, g)
            for g in np.moveaxis(configurations.machine.closure.gamma(q), 2, 0)
        ]
        pairs = zip(configurations.machine.active, slopes, strict=True)
        return [joint for joint, slope in pairs if np.abs(slope).max() > _ZERO_DERIVATIVE]

    def _explanation(self, known: Mapping[str, Sensor], measured_columns: Sequence[str]) -> str:
        """Text of the cause; "" for a rate without a cause."""
        values, residual_rms = self._fit_discrepancy([self._zero_column])
        own_zero = _DiscrepancyCause(
            {self.name: {"zero": float(values[0])}}, residual_rms, "a constant offset"
        )
        zeros = sorted(
            [own_zero, *self._drive_zero_causes(measured_columns)], key=lambda x: x.residual_rms
        )
        zero = (
            zeros[0]
            if zeros[0].residual_rms < _IMPROVEMENT_SHARE * own_zero.residual_rms
            else own_zero
        )
        if zeros[0].residual_rms <= self.limit:
            detection_limit = max(_EQUIVALENT_FACTOR * zeros[0].residual_rms, 0.2 * self.tolerance)
            named = " or ".join(
                x.format_parameters(known) for x in zeros if x.residual_rms <= detection_limit
            )
            residual = self._format_residual(zeros[0].residual_rms)
            return f"residual {residual} with a constant offset ({named})"
        if np.ptp(self.measured) < _STANDSTILL_SHARE * np.ptp(self.expected):
            return "" if self.is_rate else "its reading does not change"
        other_causes = sorted(
            [*self._scale_and_delay_causes(), *self._pin_causes()], key=lambda x: x.residual_rms
        )
        if self.is_rate:
            other_causes = [x for x in other_causes if x.residual_rms <= self.limit]
            return self._format_causes([zero, other_causes[0]], known) if other_causes else ""
        if absolute_angle := self._absolute_angle_hint(zero):
            return absolute_angle
        detection_limit = (
            min(
                _IMPROVEMENT_SHARE * zero.residual_rms,
                max(self.limit, _NEAR_BEST_FACTOR * other_causes[0].residual_rms),
            )
            if other_causes
            else 0.0
        )
        best = sorted(
            (x for x in other_causes if x.residual_rms <= detection_limit),
            key=lambda x: len(x.sensor_parameters),
        )
        rest = "" if best else "; no delay, scale or pin position explains the rest"
        return self._format_causes([zero, *best[:_MAX_LISTED]], known) + rest

    def _format_causes(self, causes: list[_DiscrepancyCause], known: Mapping[str, Sensor]) -> str:
        texts = (
            f"{self._format_residual(x.residual_rms)} with {x.description} "
            f"({x.format_parameters(known)})"
            for x in causes
        )
        return "residual " + ", ".join(texts)

    def _format_residual(self, residual_rms: float) -> str:
        unit, factor = _DISPLAY_UNITS[self.unit]
        return f"{factor * residual_rms:.2g} {unit}"

    def _fit_discrepancy(
        self, columns: list[Array], discrepancy: Array | None = None
    ) -> tuple[Array, float]:
        """Least-squares coefficients of columns (N,) for the discrepancy, and the residual RMS."""
        discrepancy = self.off if discrepancy is None else discrepancy
        rate_columns = [np.ones_like(self.time)] if self.is_rate else []
        A = np.column_stack([*columns, *rate_columns])
        values: Array = np.asarray(np.linalg.lstsq(A, discrepancy, rcond=None)[0])
        return values, root_mean_square(discrepancy - A @ values)

    @property
    def _zero_column(self) -> Array:
        """Change (N,) of the reading per zero."""
        return self.time - self.time[0] if self.is_rate else np.ones_like(self.time)

    def _scale_and_delay_causes(self) -> list[_DiscrepancyCause]:
        """Causes: a zero with a scale, and a zero with a delay."""
        if np.ptp(self.expected) < _MIN_MOTION_FACTOR * self.tolerance:
            return []
        (zero, change, *_), residual_rms = self._fit_discrepancy(
            [self._zero_column, self.expected]
        )
        numbers = {"zero": float(zero), "scale": 1.0 + float(change)}
        found = [_DiscrepancyCause({self.name: numbers}, residual_rms, "an offset and a scale")]
        delay = 0.0
        for _ in range(_MAX_ITERATIONS):
            delayed = np.interp(self.time - delay, self.time, self.expected)
            discrepancy = self.off + self.expected - delayed
            (zero, change, *_), residual_rms = self._fit_discrepancy(
                [self._zero_column, -np.gradient(delayed, self.time)], discrepancy
            )
            delay += float(change)
        if delay > 0:  # a delay is causal
            numbers = {"zero": float(zero), "delay": delay}
            found.append(
                _DiscrepancyCause({self.name: numbers}, residual_rms, "an offset and a delay")
            )
        return found

    def _drive_zero_causes(self, measured_columns: Sequence[str]) -> list[_DiscrepancyCause]:
        """Causes: zeros of the determining joints, one at a time, by the Gauss-Newton method."""
        found = []
        for i, joint in enumerate(self._configurations.machine.active if not self.is_rate else ()):
            if joint not in measured_columns:
                continue
            zero, residual_rms = 0.0, np.inf
            try:
                for _ in range(_MAX_ITERATIONS):
                    shifted = self._configurations.q_b.copy()
                    shifted[:, i] -= zero
                    q = self._configurations.machine.closure.solve(shifted)
                    discrepancy = (
                        self.off
                        + self.expected
                        - self._configurations.expected_reading(self.name, q)
                    )
                    residual_rms = root_mean_square(discrepancy)
                    derivative = -self._configurations.directional_derivative(
                        self.name, q, self._configurations.machine.closure.gamma(q)[:, :, i]
                    )
                    if np.abs(derivative).max() < _ZERO_DERIVATIVE:
                        break
                    zero += float(derivative @ discrepancy / (derivative @ derivative))
            except ClosureError:
                continue
            found.append(
                _DiscrepancyCause({joint: {"zero": zero}}, residual_rms, "a constant offset")
            )
        return found

    def _pin_causes(self) -> list[_DiscrepancyCause]:
        """Causes: the position of a pin, alone or with a zero, to first order."""
        configurations = self._configurations
        q, time = (
            configurations.q[configurations.derivative_slice],
            self.time[configurations.derivative_slice],
        )
        positions = {x.child: x.xyz for x in configurations.machine.tree.joints.values()}
        found: dict[str, list[tuple[float, _DiscrepancyCause]]] = {}
        for name, dq in configurations.pin_derivatives.items() if not self.is_rate else ():
            sampled_derivative = configurations.directional_derivative(self.name, q, dq)
            if np.abs(sampled_derivative).max() < _ZERO_DERIVATIVE:
                continue
            link, _, axis = name.rpartition(".")
            derivative = np.interp(self.time, time, sampled_derivative)
            (move, zero), residual_rms = self._fit_discrepancy([derivative, self._zero_column])
            (move_alone,), residual_without_zero = self._fit_discrepancy([derivative])
            zero_parameters = {self.name: {"zero": float(zero)}}
            description = "an offset and another pin position"
            if residual_without_zero <= max(_NEAR_BEST_FACTOR * residual_rms, self.limit):
                move, residual_rms = move_alone, residual_without_zero
                zero_parameters, description = {}, "another pin position"
            position = float(positions[link]["xyz".index(axis)] + move)
            cause = _DiscrepancyCause(zero_parameters, residual_rms, description, {name: position})
            found.setdefault(link, []).append((abs(float(move)), cause))
        return [_smallest_pin_move(causes, self.limit) for causes in found.values()]

    def _absolute_angle_hint(self, best: _DiscrepancyCause) -> str:
        """Text about an absolute angle that is recorded as a joint angle, "" if it is none."""
        configurations, joints = self._configurations, self._configurations.machine.tree.joints
        if self.unit != "rad":
            return ""
        if self.quantity.startswith(INCLINATION_PREFIX):
            link = self.quantity.removeprefix(INCLINATION_PREFIX)
            pairs = [
                (
                    joint,
                    table_column(configurations.table, joint)[configurations.sample_slice],
                    self.measured,
                )
                for joint in configurations.drives
                if joints[joint].child == link and joints[joint].kind == "revolute"
            ]
        else:
            link = joints[self.quantity].child
            pairs = [
                (
                    self.quantity,
                    self.measured,
                    configurations.expected_reading(INCLINATION_PREFIX + link),
                )
            ]
        for joint, angle, inclination in pairs:
            for sign_text, sign in (("", 1.0), (" and reverse its sign", -1.0)):
                residual_std = float(np.std(angle - sign * inclination))
                if residual_std <= self.limit < best.residual_rms:
                    what = f"'{joint}' follows the inclination of '{link}' against the horizon"
                    return (
                        f"{what} within {self._format_residual(residual_std)}: if the sensor "
                        "measures an absolute angle, name the column "
                        f"'{INCLINATION_PREFIX}{link}'{sign_text}"
                    )
        return ""


def _smallest_pin_move(
    causes: list[tuple[float, _DiscrepancyCause]], limit: float
) -> _DiscrepancyCause:
    """The smallest of the displacements of one pin with about the same residual."""
    max_residual = max(limit, _NEAR_BEST_FACTOR * min(cause.residual_rms for _, cause in causes))
    similar = [(move, cause) for move, cause in causes if cause.residual_rms <= max_residual]
    return min(similar, key=lambda pair: (len(pair[1].sensor_parameters), pair[0]))[1]


def noise_std(x: Array) -> float:
    """Standard deviation of white noise on a smooth signal (N,), by its second differences."""
    return float(np.median(np.abs(np.diff(x, 2)))) / 1.65 if len(x) > 2 else 0.0
