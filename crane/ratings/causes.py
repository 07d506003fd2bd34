"""What ends a load: drives, tipping lines, and pins."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.stability import Stability, has_supports
from crane.dynamics.statics import AtRest, Statics
from crane.machine import Machine
from crane.motion.workspaces.section import upwards
from crane.ratings.cones import largest
from crane.ratings.rules import Rule
from crane.ratings.strength import Strength

TIPS = "tips"


class Cause(NamedTuple):
    """What may end a load.

    Attributes:
        what: Joint, or tipping line "A to B".
        why: Such as "working pressure" or "tips".
        share: Of the load at its end that counts.
    """

    what: str
    why: str
    share: float

    def __str__(self) -> str:
        """In words."""
        return f"{self.why} over {self.what}" if self.why == TIPS else f"{self.what}: {self.why}"


class Causes:
    """The load at a frame that a machine holds, cause by cause, at rest.

    Drives have to hold its weight and that of the load m, tipping lines have to keep their moment,

        least <= tau(m) <= most,   tau(m) = -(ds/dq + m dp/dq)^T g - gamma^T f,
        w . [(s - M p_1) x -g + m (p - p_1) x -g] >= 0,

    with the first moment s and the mass M of the machine, the frame's place p, and w the direction
    of a line through p_1, as in `Stability`. On a slope g leans by its angle to any side: what is
    least over all sides is a cone in m, see `crane.ratings.cones`.

    Args:
        statics: The machine and the frame.
        strengths: Of its drives.
        rule: What share counts.
        slope: Of the ground [rad].

    Attributes:
        all: The causes.
    """

    def __init__(
        self, statics: Statics, strengths: Iterable[Strength], rule: Rule, slope: float = 0.0
    ):
        machine = self.machine = statics.machine
        self._strengths = list(strengths)
        self._up = upwards(machine)
        weight = float(np.linalg.norm(machine.model.gravity.linear))
        if not weight:
            raise InputError(f"'{machine.name}' has no gravity, a load has no weight there")
        self._down, self._aside = weight * np.cos(slope), weight * np.sin(slope)
        self._lines = list(_lines(machine))
        self.all = tuple(
            [Cause(x.joint, x.why, rule.hydraulic) for x in self._strengths]
            + [Cause(x.name, TIPS, rule.tipping) for x in self._lines]
        )
        self._shares = np.array([cause.share for cause in self.all])

    def loads(self, at: AtRest) -> Array:
        """The load (N, K) [kg] of each cause, times its share; infinite where it never ends."""
        out = np.empty((len(at.mass), len(self.all)))
        for k, drive in enumerate(self._strengths):
            i = drive.column
            weighs, lifts = self._parts(at.slopes[:, :, i]), self._parts(at.ways[:, :, i])
            passive = at.passive[:, i]
            up = self._ends(weighs, lifts, -passive - drive.most)
            down = self._ends(weighs, lifts, passive + drive.least, -1.0)
            out[:, k] = np.minimum(up, down)
        for k, line in enumerate(self._lines, start=len(self._strengths)):
            one = np.cross(line.way, at.moment - at.mass[:, None] * line.foot)
            two = np.cross(line.way, at.tip - line.foot)
            out[:, k] = self._ends(self._parts(one), self._parts(two), np.zeros(len(out)), -1.0)
        return out * self._shares

    def _parts(self, vectors: Array) -> tuple[Array, Array]:
        """What gravity makes of vectors (N, 3): (N,) by its part downwards, (N, 3) by the rest."""
        rises = vectors @ self._up
        return self._down * rises, self._aside * (vectors - rises[:, None] * self._up)

    def _ends(
        self, one: tuple[Array, Array], two: tuple[Array, Array], rest: Array, sign: float = 1.0
    ) -> Array:
        a, b = sign * one[0] + rest, sign * two[0]
        return largest(a, b, one[1], two[1]) if self._aside else largest(a, b)


class _Line(NamedTuple):
    """A tipping line: its name, a point on it, and its direction."""

    name: str
    foot: Array
    way: Array


def _lines(machine: Machine) -> Iterable[_Line]:
    if not has_supports(machine):
        return
    stability = Stability(machine)
    if not stability.stands:
        return
    (points,) = stability.places(machine.home[None])
    for (first, second), names in zip(stability.edges, stability.lines, strict=True):
        way = points[second] - points[first]
        yield _Line(" to ".join(names), points[first], way / np.linalg.norm(way))
