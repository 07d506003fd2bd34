"""Curves of data sheets: straight between points."""

from collections.abc import Sequence
from dataclasses import dataclass

from crane.codegen import Scalar
from crane.common.errors import InputError
from crane.hydraulics.orifice_flow import clip


@dataclass(frozen=True)
class OpeningCurve:
    """Shares of a coefficient over the spool's stroke |u|, level before and behind its points.

    Attributes:
        points: Pairs of |u|, increasing from 0 to 1, and shares, at least 0.
    """

    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if len(self.points) < 2:
            raise InputError("a curve has two points at least, give pairs [u, value]")
        strokes = [u for u, _ in self.points]
        if strokes[0] < 0 or strokes[-1] > 1:
            raise InputError(
                f"a curve goes over the share of the spool's stroke, from 0 to 1, this one from "
                f"{strokes[0]:g} to {strokes[-1]:g}"
            )
        if any(after <= before for before, after in zip(strokes, strokes[1:], strict=False)):
            raise InputError("strokes of a curve do not increase, sort its points")
        if not all(0 <= share < float("inf") for _, share in self.points):
            raise InputError("values of a curve are negative or no finite numbers, correct them")
        if not any(share for _, share in self.points):
            raise InputError("all values of a curve are 0, leave it out")

    def evaluate(self, u: Scalar) -> Scalar:
        """Its value at |u|."""
        total: Scalar = self.points[0][1]
        for (u0, one), (u1, other) in self._segments():
            slope = (other - one) / (u1 - u0)
            total = total + slope * (clip(u, u0, u1) - u0)
        return total

    def _segments(self) -> Sequence[tuple[tuple[float, float], tuple[float, float]]]:
        return list(zip(self.points, self.points[1:], strict=False))
