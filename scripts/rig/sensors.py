"""Sensors and drives of a virtual rig.

Sources: the reduced-scale forwarder paper, sections 2.1, 2.4 and 3.3 (P); assumed (A).
"""

import math
from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.machine import Machine


@dataclass(frozen=True)
class Converter:
    """Rounds to whole steps, counted from `low` (from zero where that is infinite).

    Attributes:
        step: Step, > 0.
        low: Smallest value.
        high: Largest value.
    """

    step: float
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        as_number(self.step, "the step of a converter", "", greater_than=0)

    def __call__(self, x: Array) -> Array:
        """The nearest value that can be told."""
        zero = self.low if math.isfinite(self.low) else 0.0
        steps = np.rint((x - zero) / self.step)
        return np.minimum(np.maximum(zero + self.step * steps, self.low), self.high)


def converter(low: float, high: float, bits: int = 12) -> Converter:
    """An analog-digital converter: 2^bits levels, the first and last at the ends of its range."""
    return Converter((high - low) / (2**bits - 1), low, high)


@dataclass(frozen=True)
class Sensors:
    """Sensor, driver and current measurement of one active joint.

    Equation (8) of the paper, |tau| = gain (I - no_load), gives the current I that a force
    takes, and back. Measured is I (1 + error) + noise, which a converter rounds.

    Attributes:
        position: Of the coordinate [m], [rad].
        noise: Standard deviation before the conversion [m], [rad].
        gain: P_x / C_y or F_x / C_x [N m/A], [N/A].
        no_load: b [A].
        current: Converter of the current [A].
        current_noise: Standard deviation before the conversion [A].
        error: Least and largest relative error of the current's gain, of either sign: the
            tolerance of the resistors. One value per rig.
        driver: Largest current [A] of its driver.
    """

    position: Converter
    noise: float
    gain: float
    no_load: float
    current: Converter
    current_noise: float
    error: tuple[float, float] = (0.05, 0.10)
    driver: float = 2.0

    def __post_init__(self) -> None:
        as_number(self.gain, "the gain of a current", "", greater_than=0)
        as_number(self.driver, "the driver's largest current", "A", greater_than=self.no_load)


def default_sensors(machine: Machine, joint: str) -> Sensors:
    """What the reduced-scale forwarder has at a joint of that unit.

    rad: a motor with encoder, 0.042 deg per count, P_x = 1.765 N m at C_y = 1.5 A (P).
    m: an actuator with a potentiometer over the joint's limits, F_x = 20 N at C_x = 0.05 A,
    b = 0.05 A (P). The resistors' tolerance is 5 to 10 % (P), the driver L298N (P) bears 2 A by
    its data sheet. A: noise of the potentiometer 20 um, of the currents 5 and 1 mA; converters of
    12 bits over 2 and 0.5 A.

    Raises:
        InputError: A potentiometer at a joint without limits.
    """
    if machine.unit(joint) == "rad":
        encoder = Converter(math.radians(0.042))
        return Sensors(encoder, 0.0, 1.765 / 1.5, 0.0, converter(0.0, 2.0), 5e-3)
    i = machine.active.index(joint)
    low, high = float(machine.lower[i]), float(machine.upper[i])
    if not math.isfinite(high - low):
        raise InputError(f"'{joint}' has no limits for a potentiometer, give its sensors")
    return Sensors(
        converter(low, high), 2e-5, 20 / 0.050, 0.050, converter(0.0, 0.5), 1e-3
    )  # fmt: skip
