"""Sensors: what the channels of a log say of a machine's quantities, and by how much they are off.

A quantity is called by the column of a recording that holds it, X the name of a joint:

    X, X_velocity, X_force            a length or an angle, its rate, what drives it
    pressure_X_a, pressure_X_b        in the chambers of its cylinder
    pressure_supply, pressure_tank
    voltage_X, spool_X                the signal of its valve, and its spool
    voltage_X_b, spool_X_b            of a second spool, of a valve that has two
    inclination_LINK                  of a link's x axis above the horizon, by an inclinometer
    inclination_LINK_velocity         its rate, by a gyro
    time
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import Array, as_number
from crane.description.tree import Tree

T = TypeVar("T", float, Array)

SENSOR = "sensor."  # what the names of its numbers begin with
TIME, VELOCITY, FORCE, INCLINATION = "time", "_velocity", "_force", "inclination_"
SIGNAL, PRESSURE, SUPPLY, TANK = "voltage_", "pressure_", "pressure_supply", "pressure_tank"
VELOCITY_UNITS = {"rad": "rad/s", "m": "m/s"}
FORCE_UNITS = {"rad": "N m", "m": "N"}
NUMBERS = ("zero", "scale", "delay", "noise")


@dataclass(frozen=True)
class Sensor:
    """What a channel makes of what enters it, with white noise n.

        y(t) = scale x(t - delay) + zero + n

    The quantity enters a sensor and its reading comes out. A signal `voltage_X` goes the other
    way: it enters as it was logged, and what comes out is what the valve gets; how late that acts
    is the valve's `delay`, not the sensor's.

    Attributes:
        column: Where a log has the reading, see `crane.recordings.logs`; "" where it is called as
            the quantity is.
        unit: Of that column; "" for the SI unit of the quantity.
        zero: What is added to the quantity, in its SI unit.
        scale: What it is multiplied with, not 0.
        delay: How late it is [s], at least 0.
        noise: Standard deviation, in the SI unit of the quantity; 0 where the recording tells.
    """

    column: str = ""
    unit: str = ""
    zero: float = 0.0
    scale: float = 1.0
    delay: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        for name in NUMBERS:
            value = as_number(getattr(self, name), f"{name} of a sensor", "")
            if name in ("delay", "noise") and value < 0:
                raise InputError(f"{name} of a sensor is {value:g}, it must not be negative")
        if self.scale == 0:
            raise InputError("scale of a sensor is 0, which tells nothing, give another")

    @property
    def ideal(self) -> bool:
        """Whether readings are the quantity itself."""
        return (self.zero, self.scale, self.delay) == (0.0, 1.0, 0.0)

    def out(self, x: T) -> T:
        """Of what enters: scale x + zero."""
        return self.scale * x + self.zero

    def into(self, y: T) -> T:
        """What entered: (y - zero) / scale."""
        return (y - self.zero) / self.scale

    def quantity(self, name: str, time: Array, reading: Array) -> Array:
        """What a channel (N,) of a log stands for; where it ends first, its end goes on.

        Raises:
            InputError: A signal is late, which its valve would have to be.
        """
        if name.startswith(SIGNAL):
            if self.delay:
                raise late_signal(name, name)
            return self.out(reading)
        moved = np.interp(time + self.delay, time, reading) if self.delay else reading
        return self.into(moved)

    def numbers(self) -> dict[str, float]:
        """By the last word of their names."""
        return {name: getattr(self, name) for name in NUMBERS}


def unit_of(tree: Tree, name: str) -> str | None:
    """SI unit of a quantity of a machine, None if it has none of that name."""
    fixed = {TIME: "s", SUPPLY: "Pa", TANK: "Pa"}
    if name in fixed:
        return fixed[name]
    kinds = {x.name: "m" if x.kind == "prismatic" else "rad" for x in tree.moving}
    if name in kinds:
        return kinds[name]
    for end, units in ((VELOCITY, VELOCITY_UNITS), (FORCE, FORCE_UNITS)):
        if (joint := name.removesuffix(end)) != name and joint in kinds:
            return units[kinds[joint]]
    if (what := name.removeprefix(INCLINATION)) != name:
        if what in tree.links:
            return "rad"
        return "rad/s" if what.removesuffix(VELOCITY) in tree.links else None
    chambers, spools = ("_a", "_b"), ("", "_b")
    for head, unit, ends in (
        (PRESSURE, "Pa", chambers), (SIGNAL, "V", spools), ("spool_", "", spools),
    ):  # fmt: skip
        for end in ends:
            if name.startswith(head) and name.endswith(end):
                joint = name[len(head) : len(name) - len(end)]
                if joint in kinds:
                    return unit
    return None


def quantities(tree: Tree) -> list[str]:
    """Names of what sensors of a machine can measure."""
    joints = [joint.name for joint in tree.moving]
    names = [TIME, SUPPLY, TANK]
    names += [x + end for x in joints for end in ("", VELOCITY, FORCE)]
    names += [f"{PRESSURE}{x}_{side}" for x in joints for side in "ab"]
    names += [head + x for x in joints for head in (SIGNAL, "spool_")]
    return names + [INCLINATION + link + end for link in tree.links for end in ("", VELOCITY)]


def parsed(name: str) -> tuple[str, str]:
    """Quantity and number of 'sensor.QUANTITY.zero'.

    Raises:
        InputError: A sensor has no such number.
    """
    quantity, _, what = name.removeprefix(SENSOR).rpartition(".")
    if what not in NUMBERS:
        raise InputError(f"'{name}': a sensor has no '{what}', {known(NUMBERS, what)}")
    if what == "delay" and quantity.startswith(SIGNAL):
        raise late_signal(name, quantity)
    return quantity, what


def late_signal(name: str, quantity: str) -> InputError:
    """What to say of a delay that a signal is given by a name."""
    joint = quantity.removeprefix(SIGNAL)
    return InputError(f"'{name}': a signal is not late, its valve is: give 'valve.{joint}.delay'")


def with_numbers(sensors: Mapping[str, Sensor], numbers: Mapping[str, float]) -> dict[str, Sensor]:
    """Sensors with other numbers, by names such as 'sensor.q2.zero'.

    Raises:
        InputError: A sensor has no such number, or cannot have that value.
    """
    found = dict(sensors)
    for name, value in numbers.items():
        quantity, what = parsed(name)
        try:
            found[quantity] = replace(found.get(quantity, Sensor()), **{what: value})  # type: ignore[arg-type]
        except InputError as error:
            raise InputError(f"'{name}': {error}") from None
    return found


def named_numbers(sensors: Mapping[str, Sensor]) -> dict[str, float]:
    """Numbers of sensors by name."""
    return {
        f"{SENSOR}{quantity}.{what}": value
        for quantity, sensor in sensors.items()
        if quantity != TIME
        for what, value in sensor.numbers().items()
        if what != "delay" or not quantity.startswith(SIGNAL)
    }
