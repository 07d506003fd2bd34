"""Unknowns of a calibration: machine parameters, common factors, sensor parameters."""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from crane.common.errors import InputError, suggest_names
from crane.description.machine_parameters import unknown_parameter_text
from crane.description.sensors import SENSOR_PREFIX
from crane.description.specification import MachineSpec

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
    if name.startswith(SENSOR_PREFIX):
        column, _, what = name.removeprefix(SENSOR_PREFIX).rpartition(".")
        if column not in sensor_units:
            raise InputError(f"'{name}' is of no sensor, {suggest_names(sensor_units, column)}")
        if what not in SENSOR_PARAMETER_DEFAULTS:
            raise InputError(
                f"'{name}': a sensor has no '{what}', "
                f"{suggest_names(SENSOR_PARAMETER_DEFAULTS, what)}"
            )
        described = parameters.get(name, SENSOR_PARAMETER_DEFAULTS[what])
        size = _DELAY_SCALE if what == "delay" else _ZERO_SCALES.get(sensor_units[column], 1.0)
        size = 0.05 if what == "scale" else size
        initial = described if start is None else start
        lower = (0.0 if what == "delay" else -float("inf")) if low is None else low
        return _bounded_unknown(name, initial, lower, high, size, ((name, described),), column)
    if "*" in name:
        found = {x: parameters[x] for x in fnmatch.filter(parameters, name) if parameters[x]}
        if not found:
            raise InputError(f"'{name}' matches no nonzero parameter of the machine")
        initial = 1.0 if start is None else start
        lower = _MIN_SHARE if low is None else low
        return _bounded_unknown(name, initial, lower, high, 1.0, tuple(found.items()))
    if name not in parameters:
        raise InputError(unknown_parameter_text(spec, parameters, name))
    initial = parameters[name] if start is None else start
    if name.endswith(".delay"):
        lower = 0.0 if low is None else low
        return _bounded_unknown(
            name, initial, lower, high, _DELAY_SCALE, ((name, parameters[name]),)
        )
    signed = name.endswith(tuple("." + word for word in _SIGNED_PARAMETERS))
    if not signed and initial >= 0:
        low = _MIN_SHARE * initial if low is None else low
    elif not signed:
        high = _MIN_SHARE * initial if high is None else high
    if initial:
        size = abs(initial)
    elif low is not None and high is not None:
        size = high - low
    else:
        raise InputError(f"'{name}' is 0 initially, give its range: '{name}=0,LOW~HIGH'")
    if name.endswith((".x", ".y", ".z")):
        size = min(size, 0.1)
    return _bounded_unknown(name, initial, low, high, size, ((name, parameters[name]),))


def _read_bounds(name: str, given: object) -> tuple[float | None, float | None, float | None]:
    if given is None:
        return None, None, None
    if isinstance(given, int | float):
        return float(given), None, None
    if not isinstance(given, Sequence) or len(given) != 3:
        raise InputError(f"'{name}': give a start, or (start, low, high)")
    start, low, high = (None if x is None else float(x) for x in given)
    return start, low, high


def _bounded_unknown(
    name: str,
    start: float,
    low: float | None,
    high: float | None,
    scale: float,
    members: tuple[tuple[str, float], ...] = (),
    sensor: str = "",
) -> Unknown:
    lower = -float("inf") if low is None else float(low)
    upper = float("inf") if high is None else float(high)
    if not lower < upper or not lower <= start <= upper:
        raise InputError(f"'{name}': {start:g} does not lie within {lower:g} to {upper:g}")
    return Unknown(name, float(start), lower, upper, scale, members, sensor)
