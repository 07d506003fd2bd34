"""Unknowns of a calibration: machine parameters, common factors, sensor parameters."""

import fnmatch
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError, check_name
from crane.description.machine_parameters import unknown_parameter_text
from crane.description.sensors import INCLINATION_PREFIX, PRESSURE_PREFIX, SENSOR_PREFIX
from crane.description.specification import MachineSpec
from crane.hydraulics.components import Spool, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.identification.calibration.recording_case import RecordingCase
from crane.machine.machine import Machine
from crane.recordings.sensor_kinematics import cylinder_pins
from crane.recordings.timeseries import table_column

SENSOR_PARAMETER_DEFAULTS = {"zero": 0.0, "scale": 1.0, "delay": 0.0}
# scales of sensor zeros
_ZERO_SCALES = {"rad": 0.02, "m": 5e-3, "rad/s": 0.02, "m/s": 0.01, "Pa": 1e5, "V": 0.05}
_DELAY_SCALE = 0.02  # [s]
_MIN_SHARE = 1e-3  # lower bound of a positive parameter, per start
# last words of parameter names with either sign
_SIGNED_PARAMETERS = (
    "x", "y", "z", "roll", "pitch", "yaw", "xx", "xy", "xz", "yy", "yz", "zz", "neutral", "full",
    "lower", "upper", "coulomb_offset", "viscous_offset",
)  # fmt: skip
_MIN_SPOOL_STROKE = 0.05  # of the stroke of a spool, from which a valve counts as open
_MIN_BANDWIDTH, _MAX_BANDWIDTH = 2.0, 200.0  # bandwidths of spools [1/s]
# damping of spools, relative to that of the file: deviation and largest factor
_SPOOL_DAMPING_STD, _MAX_SPOOL_DAMPING_FACTOR = 0.5, 4.0
_DELAY_STD, _MAX_DELAY = 0.1, 0.6  # standard deviation and largest value of delays [s]
_STROKE_DELAY_STD = 0.02  # standard deviation of delays of length sensors [s]
_ANGLE_ZERO_STD = 0.05  # standard deviation of zeros of angle sensors [rad]
_MAX_ZERO_DEVIATIONS = 3.0  # standard deviations up to which a zero is believed
_PIN_STD, _MAX_PIN_ERROR = 0.01, 0.05  # standard deviation and largest error of a pin [m]
_PRESSURE_ZERO_STD = 2e5  # standard deviation of pressure sensor zeros [Pa]
# pressure [Pa] whose share of the mean pressure is the share of gas in the volume of a chamber:
# air dissolves under pressure
_GAS_PRESSURE = 3e4
_LEAKAGE_FLOW_SHARE = 5e-4  # of the full flow of a valve at supply pressure
_ORIFICE_STD, _MAX_ORIFICE_FACTOR = 0.3, 2.5  # relative deviation and largest factor of an orifice
# orifices of the spools of A and B, by direction
_ORIFICES_BY_DIRECTION = {1: ("c1", "c2"), -1: ("c3", "c4")}
# bounds of a stiffness, relative to that of the oil or the known one
_MAX_STIFFNESS_REDUCTION, _MAX_STIFFNESS_INCREASE = 20.0, 4.0
_FRICTION_FORCE_SHARE = 4e-2  # of the force of a cylinder at supply pressure


@dataclass(frozen=True)
class Unknown:
    """Unknown of a calibration, value = start + scale z.

    Attributes:
        name: Name of a machine parameter; with `*` a common factor of all that match;
            `sensor.COLUMN.zero`, `.scale` or `.delay`.
        start: Initial guess.
        low: Lower bound.
        high: Upper bound.
        scale: Change for z = 1.
        members: Parameters that it changes, with their initial values.
        sensor: Column of the sensor, "" for a machine parameter.
        prior: One over the standard deviation of the prior, in its scale; 0 without a prior.
    """

    name: str
    start: float
    low: float
    high: float
    scale: float
    members: tuple[tuple[str, float], ...] = ()
    sensor: str = ""
    prior: float = 0.0

    def changes(self, value: float) -> dict[str, float]:
        """Changed parameters by name for a value of the unknown."""
        if "*" in self.name:
            return {name: value * start for name, start in self.members}
        return {name: value for name, _ in self.members}

    @property
    def machine_value(self) -> float:
        """Its value in the machine before the calibration."""
        return 1.0 if "*" in self.name else self.members[0][1]

    @property
    def sensor_parameter(self) -> str:
        """The sensor parameter zero, scale or delay, "" for a machine parameter."""
        return self.name.rpartition(".")[2] if self.sensor else ""


def build_unknowns(
    fit: Mapping[str, object] | Sequence[str],
    spec: MachineSpec,
    parameters: Mapping[str, float],
    sensor_units: Mapping[str, str],
) -> list[Unknown]:
    """Build the unknowns of a calibration.

    Args:
        fit: Parameters by name: None, a start, or (start, low, high), each of which may be None;
            or names only.
        spec: Specification of the machine.
        parameters: Parameters of the machine and its sensors by name.
        sensor_units: Units of the sensors by column.

    Raises:
        InputError: A name is unknown, bounds are empty, or the scale of a parameter is unknown.
    """
    requested = dict(fit) if isinstance(fit, Mapping) else dict.fromkeys(fit)
    if not requested:
        raise InputError("nothing is to be fitted, name parameters such as 'payload.mass'")
    return [
        _build_unknown(name, value, spec, parameters, sensor_units)
        for name, value in requested.items()
    ]


def _build_unknown(
    name: str,
    given: object,
    spec: MachineSpec,
    parameters: Mapping[str, float],
    sensor_units: Mapping[str, str],
) -> Unknown:
    start, low, high = _read_bounds(name, given)
    is_of_sensor = name.startswith(SENSOR_PREFIX)
    pattern = name if "*" in name and not is_of_sensor else ""
    members = tuple(
        (x, parameters[x]) for x in fnmatch.filter(parameters, pattern) if parameters[x]
    )
    if pattern and not members:
        raise InputError(f"'{name}' matches no nonzero parameter of the machine")
    if not is_of_sensor and not pattern and name not in parameters:
        raise InputError(unknown_parameter_text(spec, parameters, name))
    sensor = ""
    if is_of_sensor:
        sensor, _, what = name.removeprefix(SENSOR_PREFIX).rpartition(".")
        check_name(sensor, sensor_units, f"'{name}' is of no sensor")
        check_name(what, SENSOR_PARAMETER_DEFAULTS, f"'{name}': a sensor has no '{what}'")
        described = parameters.get(name, SENSOR_PARAMETER_DEFAULTS[what])
        zero_scale = _ZERO_SCALES.get(sensor_units[sensor], 1.0)
        scale = {"delay": _DELAY_SCALE, "scale": 0.05, "zero": zero_scale}[what]
        if what == "delay" and low is None:
            low = 0.0
    elif pattern:
        described, scale, low = 1.0, 1.0, _MIN_SHARE if low is None else low
    else:
        described = parameters[name]
        initial = described if start is None else start
        scale, low, high = _scale_and_bounds(name, initial, low, high)
    start = float(described if start is None else start)
    lower, upper = -math.inf if low is None else low, math.inf if high is None else high
    if not lower < upper or not lower <= start <= upper:
        raise InputError(f"'{name}': {start:g} does not lie within {lower:g} to {upper:g}")
    return Unknown(name, start, lower, upper, scale, members or ((name, described),), sensor)


def _scale_and_bounds(
    name: str, initial: float, low: float | None, high: float | None
) -> tuple[float, float | None, float | None]:
    """Scale of a machine parameter and its bounds, by default those of its sign."""
    scale = abs(initial)
    if name.endswith(".delay"):
        scale, low = _DELAY_SCALE, 0.0 if low is None else low
    if not name.endswith((".delay", *("." + word for word in _SIGNED_PARAMETERS))):
        if initial >= 0:
            low = _MIN_SHARE * initial if low is None else low
        else:
            high = _MIN_SHARE * initial if high is None else high
    if name.endswith(".bandwidth") and high is None:
        high = max(initial, _MAX_BANDWIDTH)
    if not scale:
        if low is None or high is None:
            raise InputError(f"'{name}' is 0 initially, give its range: '{name}=0,LOW~HIGH'")
        scale = high - low
    if name.endswith((".x", ".y", ".z")):
        scale = min(scale, 0.1)
    return scale, low, high


def _read_bounds(name: str, given: object) -> tuple[float | None, float | None, float | None]:
    if given is None or isinstance(given, int | float):
        given = given, None, None
    if not isinstance(given, Sequence) or len(given) != 3:
        raise InputError(f"'{name}': give a start, or (start, low, high)")
    start, low, high = (None if x is None else float(x) for x in given)
    return start, low, high


def candidate_parameters(
    machine: Machine,
    cases: Sequence[RecordingCase],
    parameters: Mapping[str, float],
    pins: Iterable[str] = (),
) -> list[Unknown]:
    """Candidates that recordings of a machine may determine.

    Args:
        machine: The machine.
        cases: The recordings.
        parameters: Parameters of the machine and its sensors by name.
        pins: Coordinates of pins that are displaced by the sensors; without any, those on which
            the cylinders of moved valves act are candidates.
    """
    found: list[Unknown] = []
    for sensor in dict.fromkeys(name for case in cases for name in case.sensors):
        found += _sensor_candidates(sensor, machine, parameters)
    hydraulics = machine.hydraulics
    if hydraulics is None:
        return found + _pin_candidates(pins, parameters)
    moved_pins: list[str] = []
    for joint, valve in hydraulics.valves.items():
        directions = {name: _opening_directions(name, hydraulics, cases) for name in valve.spools}
        for name, spool in valve.spools.items():
            if directions[name]:
                found += _spool_candidates(spool, parameters, directions[name])
                found += _orifice_candidates(spool, valve, parameters, directions[name])
        is_moved = any(directions.values())
        found += _friction_candidates(joint, hydraulics, parameters, is_moved)
        if is_moved:
            found += _cylinder_candidates(joint, machine, hydraulics, parameters, cases)
            moved_pins += cylinder_pins(machine, joint)
    found += _pin_candidates(list(pins) or moved_pins, parameters)
    if parameters.get("payload.mass", 0.0):
        found.append(_positive_candidate("payload.mass", parameters["payload.mass"], 0.5, 3.0))
    found.append(_positive_candidate("oil.bulk_modulus", hydraulics.oil.bulk_modulus, 0.5, 5.0))
    return found


def _pin_candidates(names: Iterable[str], parameters: Mapping[str, float]) -> list[Unknown]:
    """Candidates of coordinates of pins, which may be elsewhere than in the drawing."""
    positions = {name: parameters[name] for name in names}
    return [
        _candidate(name, x, _PIN_STD, x - _MAX_PIN_ERROR, x + _MAX_PIN_ERROR)
        for name, x in positions.items()
    ]


def _candidate(
    name: str, start: float, std: float, low: float = -np.inf, high: float = np.inf
) -> Unknown:
    """Candidate with the standard deviation of its value in a file as prior."""
    return Unknown(name, start, low, high, std, prior=1.0)


def _positive_candidate(name: str, start: float, relative_std: float, factor: float) -> Unknown:
    """Positive candidate with a relative standard deviation, bounded by a factor."""
    return _candidate(name, start, relative_std * start, start / factor, start * factor)


def _opening_directions(
    name: str, hydraulics: Hydraulics, cases: Sequence[RecordingCase]
) -> set[int]:
    """Directions in which a spool opens, 1 and -1."""
    spool = hydraulics.spools[name]
    signals = [
        case.inputs.signals[by]
        for case in cases
        for by in [name if name in case.inputs.signals else spool.joint]
        if by in case.inputs.signals
    ]
    if not signals:
        return set()
    u = (np.concatenate(signals) - spool.neutral) / (spool.full - spool.neutral)
    return {way for way, most in ((1, u.max()), (-1, -u.min())) if most > _MIN_SPOOL_STROKE}


def _sensor_candidates(
    name: str, machine: Machine, parameters: Mapping[str, float]
) -> Iterator[Unknown]:
    zero, delay = (f"{SENSOR_PREFIX}{name}.{what}" for what in ("zero", "delay"))
    is_passive = name in machine.joints and name not in machine.active
    is_angle = is_passive and machine.unit(name) == "rad"
    is_pressure = name.startswith(PRESSURE_PREFIX)
    if is_pressure or is_angle or name.startswith(INCLINATION_PREFIX):
        std, start = (
            _PRESSURE_ZERO_STD if is_pressure else _ANGLE_ZERO_STD,
            parameters.get(zero, 0.0),
        )
        most = _MAX_ZERO_DEVIATIONS * std
        yield _candidate(zero, start, std, start - most, start + most)
    if not is_pressure:  # pressure sensors have little delay
        std = _STROKE_DELAY_STD if name in machine.joints and not is_angle else _DELAY_STD
        yield _candidate(delay, parameters.get(delay, 0.0), std, 0.0, _MAX_DELAY)


def _spool_candidates(
    spool: Spool, parameters: Mapping[str, float], directions: set[int]
) -> Iterator[Unknown]:
    """Candidates of a spool, by the directions in which it opened."""
    name = f"valve.{spool.joint}" + ("" if isinstance(spool, Valve) else ".spool_b")
    drift, dead = 0.02 * abs(spool.full - spool.neutral), spool.dead_band
    lowest = max(dead - 0.15, 0.0 if dead >= 0 else -0.5)  # an overlap stays one
    if len(directions) == 2:  # in one direction neutral and dead band are not separable
        least, most = spool.neutral - 3.0 * drift, spool.neutral + 3.0 * drift
        yield _candidate(f"{name}.neutral", spool.neutral, drift, least, most)
    yield _candidate(f"{name}.dead_band", dead, 0.05, lowest, dead + 0.15)
    if spool.bandwidth:
        low, high = min(spool.bandwidth, _MIN_BANDWIDTH), max(spool.bandwidth, _MAX_BANDWIDTH)
        yield _candidate(f"{name}.bandwidth", spool.bandwidth, 0.5 * spool.bandwidth, low, high)
        yield _positive_candidate(
            f"{name}.damping", spool.damping, _SPOOL_DAMPING_STD, _MAX_SPOOL_DAMPING_FACTOR
        )
    yield _candidate(f"{name}.delay", spool.delay, _DELAY_STD, 0.0, max(spool.delay, _MAX_DELAY))


def _orifice_candidates(
    spool: Spool, valve: Valve, parameters: Mapping[str, float], directions: set[int]
) -> Iterator[Unknown]:
    """Candidates of orifices: a common factor where a single spool opened in one direction.

    What holds for the edges that were opened then holds for the others, too.
    """
    if len(valve.spools) == 1 and len(directions) == 1:
        low, high = 1.0 / _MAX_ORIFICE_FACTOR, _MAX_ORIFICE_FACTOR
        yield _candidate(f"valve.{spool.joint}.c*", 1.0, _ORIFICE_STD, low, high)
        return
    which = slice(None)
    if len(valve.spools) > 1:  # each spool has its own chamber
        which = slice(0, 1) if spool is valve else slice(1, 2)
    for way in sorted(directions, reverse=True):
        for name in (f"valve.{spool.joint}.{x}" for x in _ORIFICES_BY_DIRECTION[way][which]):
            if parameters[name]:
                yield _positive_candidate(
                    name, parameters[name], _ORIFICE_STD, _MAX_ORIFICE_FACTOR
                )


def _friction_candidates(
    joint: str, hydraulics: Hydraulics, parameters: Mapping[str, float], is_moved: bool
) -> Iterator[Unknown]:
    """Candidates of the friction of a cylinder, which holds one that is not moved."""
    pressure, area = hydraulics.supply.pressure, hydraulics.cylinders[joint].area_a
    force = _FRICTION_FORCE_SHARE * pressure * area
    max_speed = hydraulics.valves[joint].c1 * np.sqrt(pressure) / area
    sizes = {"coulomb": force} | ({"viscous": force / max_speed} if is_moved else {})
    for what, size in sizes.items():
        if (name := f"friction.{joint}.{what}") in parameters:
            start = parameters[name]
            std = max(3.0 * start, size)
            yield _candidate(name, start, std, 0.0, start + 5.0 * std)


def _cylinder_candidates(
    joint: str,
    machine: Machine,
    hydraulics: Hydraulics,
    parameters: Mapping[str, float],
    cases: Sequence[RecordingCase],
) -> Iterator[Unknown]:
    cylinder, valve = hydraulics.cylinders[joint], hydraulics.valves[joint]
    pressure = hydraulics.supply.pressure
    index = machine.active.index(joint)
    stroke = 0.0 if cylinder.motor else float(machine.upper[index] - machine.lower[index])
    volumes = (
        cylinder.area_a * stroke + cylinder.hose_a,
        cylinder.area_b * stroke + cylinder.hose_b,
    )
    leakage_coefficient = _LEAKAGE_FLOW_SHARE * valve.c1 / np.sqrt(pressure)
    for side, volume in zip("ab", volumes, strict=True):
        chamber = f"{PRESSURE_PREFIX}{joint}_{side}"
        measured = [
            np.mean(table_column(x.table, chamber)) for x in cases if chamber in x.table.units
        ]
        mean = max(float(np.mean(measured)) if measured else 0.5 * pressure, _GAS_PRESSURE)
        gas = _GAS_PRESSURE / mean * volume
        for what, size in (("gas", gas), ("leakage", leakage_coefficient)):
            name = f"cylinder.{joint}.{what}_{side}"
            start = parameters[name]
            yield _candidate(name, start, max(start, size), 0.0)
    name = f"cylinder.{joint}.leakage"
    yield _candidate(name, parameters[name], max(parameters[name], leakage_coefficient), 0.0)
    if cylinder.motor:  # a motor has no structural compliance
        return
    oil = hydraulics.oil.bulk_modulus
    oil_stiffness = sum(
        oil * area**2 / volume
        for area, volume in zip((cylinder.area_a, cylinder.area_b), volumes, strict=True)
    )
    name = f"cylinder.{joint}.stiffness"
    known = parameters[name] or oil_stiffness
    low, high = known / _MAX_STIFFNESS_REDUCTION, known * _MAX_STIFFNESS_INCREASE
    start = parameters[name] or high  # about rigid
    yield _candidate(name, start, start, low, high)
    name = f"cylinder.{joint}.damping"
    yield _positive_candidate(name, parameters[name], 1.0, 20.0)
