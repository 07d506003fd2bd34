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

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array, as_number
from crane.description.kinematic_tree import Tree

T = TypeVar("T", float, Array)

SENSOR_PREFIX = "sensor."  # what the names of its numbers begin with
TIME, VELOCITY_SUFFIX, FORCE_SUFFIX, INCLINATION_PREFIX = (
    "time",
    "_velocity",
    "_force",
    "inclination_",
)
VALVE_SIGNAL_PREFIX, PRESSURE_PREFIX, SUPPLY_PRESSURE, TANK_PRESSURE = (
    "voltage_",
    "pressure_",
    "pressure_supply",
    "pressure_tank",
)
VELOCITY_UNITS = {"rad": "rad/s", "m": "m/s"}
FORCE_UNITS = {"rad": "N m", "m": "N"}
SENSOR_PARAMETERS = ("zero", "scale", "delay", "noise")


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
        for name in SENSOR_PARAMETERS:
            value = as_number(getattr(self, name), f"{name} of a sensor", "")
            if name in ("delay", "noise") and value < 0:
                raise InputError(f"{name} of a sensor is {value:g}, it must not be negative")
        if self.scale == 0:
            raise InputError("scale of a sensor is 0, which tells nothing, give another")

    @property
    def is_ideal(self) -> bool:
        """Whether readings are the quantity itself."""
        return (self.zero, self.scale, self.delay) == (0.0, 1.0, 0.0)

    def apply(self, quantity: T) -> T:
        """Of what enters: scale x + zero."""
        return self.scale * quantity + self.zero

    def invert(self, reading: T) -> T:
        """What entered: (y - zero) / scale."""
        return (reading - self.zero) / self.scale

    def correct_readings(self, quantity_name: str, time: Array, readings: Array) -> Array:
        """What a channel (N,) of a log stands for; where it ends first, its end goes on.

        Raises:
            InputError: A signal is late, which its valve would have to be.
        """
        if quantity_name.startswith(VALVE_SIGNAL_PREFIX):
            if self.delay:
                raise signal_delay_error(quantity_name, quantity_name)
            return self.apply(readings)
        undelayed = np.interp(time + self.delay, time, readings) if self.delay else readings
        return self.invert(undelayed)

    def parameters(self) -> dict[str, float]:
        """By the last word of their names."""
        return {name: getattr(self, name) for name in SENSOR_PARAMETERS}


def quantity_unit(tree: Tree, name: str) -> str | None:
    """SI unit of a quantity of a machine, None if it has none of that name."""
    fixed_units = {TIME: "s", SUPPLY_PRESSURE: "Pa", TANK_PRESSURE: "Pa"}
    if name in fixed_units:
        return fixed_units[name]
    joint_units = {x.name: "m" if x.kind == "prismatic" else "rad" for x in tree.moving_joints}
    if name in joint_units:
        return joint_units[name]
    for suffix, units in ((VELOCITY_SUFFIX, VELOCITY_UNITS), (FORCE_SUFFIX, FORCE_UNITS)):
        if (joint := name.removesuffix(suffix)) != name and joint in joint_units:
            return units[joint_units[joint]]
    if (link_name := name.removeprefix(INCLINATION_PREFIX)) != name:
        if link_name in tree.links:
            return "rad"
        return "rad/s" if link_name.removesuffix(VELOCITY_SUFFIX) in tree.links else None
    chambers, spools = ("_a", "_b"), ("", "_b")
    for prefix, unit, suffixes in (
        (PRESSURE_PREFIX, "Pa", chambers),
        (VALVE_SIGNAL_PREFIX, "V", spools),
        ("spool_", "", spools),
    ):
        for suffix in suffixes:
            if name.startswith(prefix) and name.endswith(suffix):
                joint = name[len(prefix) : len(name) - len(suffix)]
                if joint in joint_units:
                    return unit
    return None


def quantity_names(tree: Tree) -> list[str]:
    """Names of what sensors of a machine can measure."""
    joints = [joint.name for joint in tree.moving_joints]
    names = [TIME, SUPPLY_PRESSURE, TANK_PRESSURE]
    names += [x + end for x in joints for end in ("", VELOCITY_SUFFIX, FORCE_SUFFIX)]
    names += [f"{PRESSURE_PREFIX}{x}_{side}" for x in joints for side in "ab"]
    names += [head + x for x in joints for head in (VALVE_SIGNAL_PREFIX, "spool_")]
    return names + [
        INCLINATION_PREFIX + link + end for link in tree.links for end in ("", VELOCITY_SUFFIX)
    ]


def parse_sensor_parameter(name: str) -> tuple[str, str]:
    """Quantity and number of 'sensor.QUANTITY.zero'.

    Raises:
        InputError: A sensor has no such number.
    """
    quantity, _, parameter = name.removeprefix(SENSOR_PREFIX).rpartition(".")
    if parameter not in SENSOR_PARAMETERS:
        raise InputError(
            f"'{name}': a sensor has no '{parameter}', "
            f"{suggest_names(SENSOR_PARAMETERS, parameter)}"
        )
    if parameter == "delay" and quantity.startswith(VALVE_SIGNAL_PREFIX):
        raise signal_delay_error(name, quantity)
    return quantity, parameter


def signal_delay_error(parameter_name: str, quantity: str) -> InputError:
    """What to say of a delay that a signal is given by a name."""
    joint = quantity.removeprefix(VALVE_SIGNAL_PREFIX)
    return InputError(
        f"'{parameter_name}': a signal is not late, its valve is: give 'valve.{joint}.delay'"
    )


def with_sensor_parameters(
    sensors: Mapping[str, Sensor], values: Mapping[str, float]
) -> dict[str, Sensor]:
    """Sensors with other numbers, by names such as 'sensor.q2.zero'.

    Raises:
        InputError: A sensor has no such number, or cannot have that value.
    """
    found = dict(sensors)
    for name, value in values.items():
        quantity, parameter = parse_sensor_parameter(name)
        try:
            found[quantity] = replace(found.get(quantity, Sensor()), **{parameter: value})  # type: ignore[arg-type]
        except InputError as error:
            raise InputError(f"'{name}': {error}") from None
    return found


def sensor_parameters(sensors: Mapping[str, Sensor]) -> dict[str, float]:
    """Numbers of sensors by name."""
    return {
        f"{SENSOR_PREFIX}{quantity}.{what}": value
        for quantity, sensor in sensors.items()
        if quantity != TIME
        for what, value in sensor.parameters().items()
        if what != "delay" or not quantity.startswith(VALVE_SIGNAL_PREFIX)
    }
