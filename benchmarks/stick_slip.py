"""A block that a moving spring pulls over friction that falls with its velocity.

m x'' = k (s t - x) - (F - c x') while it slides. With x = s t - (F - c s) / k + z that is
m z'' = c z' - k z: a growing oscillation, z = exp(c t / 2 m) (A cos w t + B sin w t). It stops
where z' = -s, and rests until k (s t - x) = F.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import cos, exp, sin, sqrt

import numpy as np
from hand_equations import PLAIN, Array, Functions, HandEquations, Numbers
from scipy.optimize import brentq


@dataclass(frozen=True)
class Slip:
    """A slip, whose z begins with z0 and the rate -s."""

    z0: float
    speed: float
    growth: float
    frequency: float

    def evaluate(self, t: float) -> tuple[float, float]:
        """Both z and z' at a time since the begin of the slip."""
        w, g = self.frequency, self.growth
        b = (-self.speed - g * self.z0) / w
        wave, slope = self.z0 * cos(w * t) + b * sin(w * t), b * cos(w * t) - self.z0 * sin(w * t)
        return exp(g * t) * wave, exp(g * t) * (g * wave + w * slope)

    def duration(self) -> float:
        """Time until the block stops [s]."""
        turn = np.pi / self.frequency
        return float(brentq(lambda t: self.evaluate(t)[1] + self.speed, turn, 2.0 * turn,
                            xtol=1e-15, rtol=1e-15))  # fmt: skip


class StickSlip(HandEquations):
    """The block; its state is x, v."""

    def __init__(self, data: Numbers):
        super().__init__(data)
        ((self.joint, law),) = self.machine["friction"].items()
        self.friction, self.falling = law["coulomb"], -law["viscous_offset"]
        self.mass, self.spring, self.speed = self.masses[self.joint], data["spring"], data["speed"]
        self.start = np.array([data["start"][self.joint], 0.0])

    def rate(self, t: float, y: Sequence[float], functions: Functions = PLAIN) -> list[float]:
        """Of a slip, in the direction of the pull; see `HandEquations.rate`."""
        x, v = y
        pull = self.spring * (self.speed * t - x)
        return [v, (pull - self.friction + self.falling * v) / self.mass]

    def outputs(self, y: Array) -> Array:
        """See `HandEquations.outputs`."""
        return y[:1]

    def slips_at(self, x: float) -> float:
        """Time at which the block at rest begins to slip [s]."""
        return (self.friction / self.spring + x) / self.speed

    def slips(self) -> Iterator[tuple[float, float, float, Callable[[float], float]]]:
        """Begin and end of each slip [s], x before it [m], and x over time within it."""
        growth = self.falling / (2.0 * self.mass)
        frequency = sqrt(self.spring / self.mass - growth**2)
        behind = (self.friction - self.falling * self.speed) / self.spring
        x, begin = float(self.start[0]), 0.0
        while begin < self.data["duration"]:
            begin = self.slips_at(x)
            z0 = x - self.speed * begin + behind
            slip = Slip(z0, self.speed, growth, frequency)
            end = begin + slip.duration()

            def position(t: float, slip: Slip = slip, begin: float = begin) -> float:
                return self.speed * t - behind + slip.evaluate(t - begin)[0]

            yield begin, end, x, position
            x = position(end)

    def closed_form(self, times: Array) -> Array:
        """Positions x (N,) at times (N,) [m]."""
        found = []
        for t in times:
            begin, _, x, position = next(slip for slip in self.slips() if t <= slip[1])
            found.append(position(t) if t > begin else x)
        return np.array(found)
