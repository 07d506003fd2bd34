"""What a calibration fits: numbers of the machine, shares of several, sensors, starts."""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from crane.common.errors import InputError, known
from crane.description.changes import unknown_parameter
from crane.description.sensors import SENSOR
from crane.description.spec import MachineSpec

FITTED = {"zero": 0.0, "scale": 1.0, "delay": 0.0}
_SIZES = {
    "rad": 0.02,
    "m": 5e-3,
    "rad/s": 0.02,
    "m/s": 0.01,
    "Pa": 1e5,
    "V": 0.05,
}  # of zeros that sensors have
_DELAY = 0.02  # [s]
_LEAST = 1e-3  # share of a number's start below which it does not go, where it must be positive
# Words that numbers end with which may have either sign.
_SIGNED = (
    "x", "y", "z", "roll", "pitch", "yaw", "xx", "xy", "xz", "yy", "yz", "zz", "neutral", "full",
    "lower", "upper", "coulomb_offset", "viscous_offset",
)  # fmt: skip


@dataclass(frozen=True)
class Unknown:
    """One number that is fitted, value = start + scale z.

    Attributes:
        name: Of a number of the machine; with `*` a common factor of all numbers that match;
            `sensor.COLUMN.zero`, `.scale` or `.delay`.
        start: Where the search begins.
        low: Least value.
        high: Largest.
        scale: How much counts as 1.
        members: Numbers of the machine that it changes, with what they are at first.
        sensor: Column of the sensor, "" of a number of the machine.
        prior: One over the standard deviation of what is known of it before, in its scale; 0 if
            nothing is.
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
        """Numbers of the machine at a value."""
        if "*" in self.name:
            return {name: value * start for name, start in self.members}
        return {name: value for name, _ in self.members}

    @property
    def what(self) -> str:
        """Of a sensor: zero, scale or delay."""
        return self.name.rpartition(".")[2] if self.sensor else ""


def unknowns_of(
    fit: Mapping[str, object] | Sequence[str],
    spec: MachineSpec,
    numbers: Mapping[str, float],
    sensors: Mapping[str, str],
) -> list[Unknown]:
    """What is to be fitted.

    Args:
        fit: By name None, a start, or (start, low, high); None of these where not known. Or names.
        spec: The machine's description.
        numbers: Of the machine and its sensors by name, see `parameters`.
        sensors: Units by column.

    Raises:
        InputError: An unknown name, bounds that hold no value, or a number of which nothing tells
            how large it may be.
    """
    given = dict(fit) if isinstance(fit, Mapping) else dict.fromkeys(fit)
    if not given:
        raise InputError("nothing is to be fitted, name numbers such as 'payload.mass'")
    return [_unknown(name, value, spec, numbers, sensors) for name, value in given.items()]


def _unknown(
    name: str,
    given: object,
    spec: MachineSpec,
    numbers: Mapping[str, float],
    sensors: Mapping[str, str],
) -> Unknown:
    start, low, high = _bounds(name, given)
    if name.startswith(SENSOR):
        column, _, what = name.removeprefix(SENSOR).rpartition(".")
        if column not in sensors:
            raise InputError(f"'{name}' is of no sensor, {known(sensors, column)}")
        if what not in FITTED:
            raise InputError(f"'{name}': a sensor has no '{what}', {known(FITTED, what)}")
        usual = numbers.get(name, FITTED[what])
        size = _DELAY if what == "delay" else _SIZES.get(sensors[column], 1.0)
        size = 0.05 if what == "scale" else size
        begin = usual if start is None else start
        least = (0.0 if what == "delay" else -float("inf")) if low is None else low
        return _made(name, begin, least, high, size, ((name, usual),), column)
    if "*" in name:
        found = {x: numbers[x] for x in fnmatch.filter(numbers, name) if numbers[x]}
        if not found:
            raise InputError(f"'{name}' matches no number of the machine that is not 0")
        begin = 1.0 if start is None else start
        least = _LEAST if low is None else low
        return _made(name, begin, least, high, 1.0, tuple(found.items()))
    if name not in numbers:
        raise InputError(unknown_parameter(spec, numbers, name))
    begin = numbers[name] if start is None else start
    if name.endswith(".delay"):
        least = 0.0 if low is None else low
        return _made(name, begin, least, high, _DELAY, ((name, numbers[name]),))
    signed = name.endswith(tuple("." + word for word in _SIGNED))
    if not signed and begin >= 0:
        low = _LEAST * begin if low is None else low
    elif not signed:
        high = _LEAST * begin if high is None else high
    if begin:
        size = abs(begin)
    elif low is not None and high is not None:
        size = high - low
    else:
        raise InputError(f"'{name}' is 0 at first, say how large it may be: '{name}=0,LOW~HIGH'")
    if name.endswith((".x", ".y", ".z")):
        size = min(size, 0.1)
    return _made(name, begin, low, high, size, ((name, numbers[name]),))


def _bounds(name: str, given: object) -> tuple[float | None, float | None, float | None]:
    if given is None:
        return None, None, None
    if isinstance(given, int | float):
        return float(given), None, None
    if not isinstance(given, Sequence) or len(given) != 3:
        raise InputError(f"'{name}': give a start, or (start, low, high)")
    start, low, high = (None if x is None else float(x) for x in given)
    return start, low, high


def _made(
    name: str,
    start: float,
    low: float | None,
    high: float | None,
    scale: float,
    members: tuple[tuple[str, float], ...] = (),
    sensor: str = "",
) -> Unknown:
    least = -float("inf") if low is None else float(low)
    most = float("inf") if high is None else float(high)
    if not least < most or not least <= start <= most:
        raise InputError(f"'{name}': {start:g} does not lie within {least:g} to {most:g}")
    return Unknown(name, float(start), least, most, scale, members, sensor)
