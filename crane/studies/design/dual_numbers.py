"""Numbers that know how they change with k variables."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from crane.common.samples import Array


@dataclass(frozen=True, eq=False)
class DualNumber:
    """A value and its slopes; arithmetic keeps both exact.

    Attributes:
        value: The number.
        derivatives: (k,) its derivatives.
    """

    value: float
    derivatives: Array

    def __add__(self, other: "DualNumber | float") -> "DualNumber":
        second = self._as_dual(other)
        return DualNumber(self.value + second.value, self.derivatives + second.derivatives)

    __radd__ = __add__

    def __neg__(self) -> "DualNumber":
        return DualNumber(-self.value, -self.derivatives)

    def __pos__(self) -> "DualNumber":
        return self

    def __sub__(self, other: "DualNumber | float") -> "DualNumber":
        return self + -self._as_dual(other)

    def __rsub__(self, other: "DualNumber | float") -> "DualNumber":
        return self._as_dual(other) - self

    def __mul__(self, other: "DualNumber | float") -> "DualNumber":
        second = self._as_dual(other)
        derivatives = self.value * second.derivatives + second.value * self.derivatives
        return DualNumber(self.value * second.value, derivatives)

    __rmul__ = __mul__

    def __truediv__(self, other: "DualNumber | float") -> "DualNumber":
        second = self._as_dual(other)
        value = self.value / second.value
        return DualNumber(value, (self.derivatives - value * second.derivatives) / second.value)

    def __rtruediv__(self, other: "DualNumber | float") -> "DualNumber":
        return self._as_dual(other) / self

    def __pow__(self, power: "DualNumber | float") -> "DualNumber":
        if isinstance(power, DualNumber):
            if power.derivatives.any():
                return exp(power * log(self))
            power = power.value
        value = self.value**power
        outer_derivative = power * self.value ** (power - 1.0) if power else 0.0
        return DualNumber(value, outer_derivative * self.derivatives)

    def __rpow__(self, base: float) -> "DualNumber":
        return self._as_dual(base) ** self

    def __abs__(self) -> "DualNumber":
        return -self if self.value < 0 else self

    def _as_dual(self, other: "DualNumber | float") -> "DualNumber":
        return (
            other
            if isinstance(other, DualNumber)
            else DualNumber(other, np.zeros_like(self.derivatives))
        )


def _apply_chain_rule(x: DualNumber, value: float, outer_derivative: float) -> DualNumber:
    return DualNumber(value, outer_derivative * x.derivatives)


def sqrt(x: DualNumber) -> DualNumber:
    """Its root; with infinite slopes at 0 where it changes at all."""
    root = math.sqrt(x.value)
    if not root:
        with np.errstate(divide="ignore", invalid="ignore"):
            return DualNumber(0.0, np.where(x.derivatives == 0, 0.0, x.derivatives / 0.0))
    return _apply_chain_rule(x, root, 0.5 / root)


def exp(x: DualNumber) -> DualNumber:
    """The exponential."""
    value = math.exp(x.value)
    return _apply_chain_rule(x, value, value)


def log(x: DualNumber) -> DualNumber:
    """The natural logarithm."""
    return _apply_chain_rule(x, math.log(x.value), 1.0 / x.value)


def sin(x: DualNumber) -> DualNumber:
    """The sine."""
    return _apply_chain_rule(x, math.sin(x.value), math.cos(x.value))


def cos(x: DualNumber) -> DualNumber:
    """The cosine."""
    return _apply_chain_rule(x, math.cos(x.value), -math.sin(x.value))


def degrees(x: DualNumber) -> DualNumber:
    """An angle in degrees."""
    return x * (180.0 / math.pi)


def minimum(*x: DualNumber) -> DualNumber:
    """The least of them."""
    return min(x, key=lambda one: one.value)


def maximum(*x: DualNumber) -> DualNumber:
    """The largest of them."""
    return max(x, key=lambda one: one.value)


DUAL_FUNCTIONS: dict[str, Callable[..., DualNumber]] = {
    "sqrt": sqrt, "exp": exp, "log": log, "sin": sin, "cos": cos, "degrees": degrees,
    "min": minimum, "max": maximum, "abs": abs,
}  # fmt: skip


def constant(value: float, count: int) -> DualNumber:
    """A number that does not change."""
    return DualNumber(value, np.zeros(count))


def stack_duals(duals: Sequence[DualNumber]) -> tuple[Array, Array]:
    """Values (m,) and slopes (m, k)."""
    return np.array([x.value for x in duals]), np.array([x.derivatives for x in duals])
