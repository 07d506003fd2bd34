"""Sensors: relation of the channels of a log to quantities of a machine.

A quantity has the name of the column of a recording that contains it; X is the name of a joint:

    X, X_velocity, X_force            coordinate, its rate, drive force pressure_X_a, pressure_X_b
    pressures in the chambers of its cylinder pressure_supply, pressure_tank voltage_X, spool_X
    signal and spool position of its valve voltage_X_b, spool_X_b            the same of a second
    spool inclination_LINK                  angle of a link's x axis above the horizon, by an
    inclinometer inclination_LINK_velocity         its rate, by a gyroscope time
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array, as_number
from crane.description.force_elements import as_nonnegative_number
from crane.description.kinematic_tree import Tree

T = TypeVar("T", float, Array)

SENSOR_PREFIX = "sensor."  # of parameter names
TIME, VELOCITY_SUFFIX, FORCE_SUFFIX = "time", "_velocity", "_force"
INCLINATION_PREFIX, VALVE_SIGNAL_PREFIX, PRESSURE_PREFIX = "inclination_", "voltage_", "pressure_"
_VALVE_UNITS = {VALVE_SIGNAL_PREFIX: "V", "spool_": ""}
SUPPLY_PRESSURE, TANK_PRESSURE = "pressure_supply", "pressure_tank"
VELOCITY_UNITS = {"rad": "rad/s", "m": "m/s"}
FORCE_UNITS = {"rad": "N m", "m": "N"}
SENSOR_PARAMETERS = ("zero", "scale", "delay", "noise")


@dataclass(frozen=True)
class Sensor:
    """Model of a channel with white noise n.

        y(t) = scale x(t - delay) + zero + n

    x is the quantity and y the reading. For a signal `voltage_X`, x is the logged value and y the
    input of the valve; its delay is the `delay` of the valve, not of the sensor.

    Attributes:
        column: Column of the reading in a log, see `crane.recordings.logs`; "" for the name of the
            quantity.
        unit: Unit of the column; "" for the SI unit of the quantity.
        zero: Offset in the SI unit of the quantity.
        scale: Factor, not 0.
        delay: [s], at least 0.
        noise: Standard deviation in the SI unit of the quantity; 0: estimated from the recording.
    """

    column: str = ""
    unit: str = ""
    zero: float = 0.0
    scale: float = 1.0
    delay: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        for name in SENSOR_PARAMETERS:
            check = as_nonnegative_number if name in ("delay", "noise") else as_number
            check(getattr(self, name), f"{name} of a sensor", "")
        if self.scale == 0:
            raise InputError("scale of a sensor is 0, so that it measures nothing, give another")

    @property
    def is_ideal(self) -> bool:
        """Whether readings equal the quantity."""
        return (self.zero, self.scale, self.delay) == (0.0, 1.0, 0.0)

    def apply(self, quantity: T) -> T:
        """Return scale x + zero."""
        return self.scale * quantity + self.zero

    def invert(self, reading: T) -> T:
        """Return (y - zero) / scale."""
        return (reading - self.zero) / self.scale

    def correct_readings(self, quantity_name: str, time: Array, readings: Array) -> Array:
        """Return the quantity (N,) of readings (N,) of a log; a delay repeats the last value.

        Raises:
            InputError: A signal has a delay, which belongs to its valve.
        """
        if quantity_name.startswith(VALVE_SIGNAL_PREFIX):
            if self.delay:
                raise signal_delay_error(quantity_name, quantity_name)
            return self.apply(readings)
        return self.invert(
            np.interp(time + self.delay, time, readings) if self.delay else readings
        )

    def parameters(self) -> dict[str, float]:
        """Return its parameters by the last part of their names."""
        return {name: getattr(self, name) for name in SENSOR_PARAMETERS}


def quantity_units(tree: Tree) -> dict[str, str]:
    """Return the SI units of all quantities that sensors of a machine can measure, by name."""
    joints = {x.name: "m" if x.kind == "prismatic" else "rad" for x in tree.moving_joints}
    named = [(TIME, "s"), (SUPPLY_PRESSURE, "Pa"), (TANK_PRESSURE, "Pa")]
    for x, unit in joints.items():
        named += [(x, unit), (x + VELOCITY_SUFFIX, VELOCITY_UNITS[unit])]
        named.append((x + FORCE_SUFFIX, FORCE_UNITS[unit]))
    named += [(f"{PRESSURE_PREFIX}{x}_{side}", "Pa") for x in joints for side in "ab"]
    named += [(head + x, unit) for x in joints for head, unit in _VALVE_UNITS.items()]
    rates = ("", "rad"), (VELOCITY_SUFFIX, VELOCITY_UNITS["rad"])
    named += [(INCLINATION_PREFIX + x + end, unit) for x in tree.links for end, unit in rates]
    units = dict(reversed(named))  # of equal names the first counts
    return {name: units[name] for name, _ in named}


def quantity_unit(tree: Tree, name: str) -> str | None:
    """Return the SI unit of a quantity of a machine, None if it is unknown."""
    units = quantity_units(tree)
    is_valve = name.startswith(tuple(_VALVE_UNITS))
    return units.get(name, units.get(name.removesuffix("_b") if is_valve else name))


def parse_sensor_parameter(name: str) -> tuple[str, str]:
    """Return quantity and parameter of 'sensor.QUANTITY.zero'.

    Raises:
        InputError: Sensors do not have the parameter.
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
    """Return the error about a delay of a signal."""
    joint = quantity.removeprefix(VALVE_SIGNAL_PREFIX)
    return InputError(
        f"'{parameter_name}': a signal is not late, its valve is: give 'valve.{joint}.delay'"
    )


def with_sensor_parameters(
    sensors: Mapping[str, Sensor], values: Mapping[str, float]
) -> dict[str, Sensor]:
    """Return sensors with other parameters, by names such as 'sensor.q2.zero'.

    Raises:
        InputError: Sensors do not have the parameter, or the value is not allowed.
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
    """Return the parameters of sensors by name."""
    return {
        f"{SENSOR_PREFIX}{quantity}.{what}": value
        for quantity, sensor in sensors.items()
        if quantity != TIME
        for what, value in sensor.parameters().items()
        if what != "delay" or not quantity.startswith(VALVE_SIGNAL_PREFIX)
    }
