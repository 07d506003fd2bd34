"""Numbers that know how they change with k variables."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array


@dataclass(frozen=True, eq=False)
class Dual:
    """A value and its slopes; arithmetic keeps both exact.

    Attributes:
        value: The number.
        slopes: (k,) its derivatives.
    """

    value: float
    slopes: Array

    def __add__(self, other: "Dual | float") -> "Dual":
        two = self._like(other)
        return Dual(self.value + two.value, self.slopes + two.slopes)

    __radd__ = __add__

    def __neg__(self) -> "Dual":
        return Dual(-self.value, -self.slopes)

    def __pos__(self) -> "Dual":
        return self

    def __sub__(self, other: "Dual | float") -> "Dual":
        return self + -self._like(other)

    def __rsub__(self, other: "Dual | float") -> "Dual":
        return self._like(other) - self

    def __mul__(self, other: "Dual | float") -> "Dual":
        two = self._like(other)
        slopes = self.value * two.slopes + two.value * self.slopes
        return Dual(self.value * two.value, slopes)

    __rmul__ = __mul__

    def __truediv__(self, other: "Dual | float") -> "Dual":
        two = self._like(other)
        value = self.value / two.value
        return Dual(value, (self.slopes - value * two.slopes) / two.value)

    def __rtruediv__(self, other: "Dual | float") -> "Dual":
        return self._like(other) / self

    def __pow__(self, power: "Dual | float") -> "Dual":
        if isinstance(power, Dual):
            if power.slopes.any():
                return exp(power * log(self))
            power = power.value
        value = self.value**power
        slope = power * self.value ** (power - 1.0) if power else 0.0
        return Dual(value, slope * self.slopes)

    def __rpow__(self, base: float) -> "Dual":
        return self._like(base) ** self

    def __abs__(self) -> "Dual":
        return -self if self.value < 0 else self

    def _like(self, other: "Dual | float") -> "Dual":
        return other if isinstance(other, Dual) else Dual(other, np.zeros_like(self.slopes))


def _chained(x: Dual, value: float, slope: float) -> Dual:
    return Dual(value, slope * x.slopes)


def sqrt(x: Dual) -> Dual:
    """Its root; with infinite slopes at 0 where it changes at all."""
    root = math.sqrt(x.value)
    if not root:
        with np.errstate(divide="ignore", invalid="ignore"):
            return Dual(0.0, np.where(x.slopes == 0, 0.0, x.slopes / 0.0))
    return _chained(x, root, 0.5 / root)


def exp(x: Dual) -> Dual:
    """The exponential."""
    value = math.exp(x.value)
    return _chained(x, value, value)


def log(x: Dual) -> Dual:
    """The natural logarithm."""
    return _chained(x, math.log(x.value), 1.0 / x.value)


def sin(x: Dual) -> Dual:
    """The sine."""
    return _chained(x, math.sin(x.value), math.cos(x.value))


def cos(x: Dual) -> Dual:
    """The cosine."""
    return _chained(x, math.cos(x.value), -math.sin(x.value))


def degrees(x: Dual) -> Dual:
    """An angle in degrees."""
    return x * (180.0 / math.pi)


def least(*x: Dual) -> Dual:
    """The least of them."""
    return min(x, key=lambda one: one.value)


def most(*x: Dual) -> Dual:
    """The largest of them."""
    return max(x, key=lambda one: one.value)


FUNCTIONS: dict[str, Callable[..., Dual]] = {
    "sqrt": sqrt, "exp": exp, "log": log, "sin": sin, "cos": cos, "degrees": degrees,
    "min": least, "max": most, "abs": abs,
}  # fmt: skip


def constant(value: float, count: int) -> Dual:
    """A number that does not change."""
    return Dual(value, np.zeros(count))


def stacked(numbers: Sequence[Dual]) -> tuple[Array, Array]:
    """Values (m,) and slopes (m, k)."""
    return np.array([x.value for x in numbers]), np.array([x.slopes for x in numbers])
