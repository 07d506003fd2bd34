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


class Bound(NamedTuple):
    """One end of what a cause lets: a + b m + |c + d m| <= 0.

    Attributes:
        cause: Its index.
        drive: Whose force it is, None for a line.
        line: About which, None for a drive.
        sign: 1 of the most that a drive pushes, -1 of the most that it pulls, and of lines.
    """

    cause: int
    drive: Strength | None
    line: "Line | None"
    sign: float


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
        bounds: Their ends.
    """

    def __init__(
        self, statics: Statics, strengths: Iterable[Strength], rule: Rule, slope: float = 0.0
    ):
        machine = self.machine = statics.machine
        self._up = upwards(machine)
        weight = float(np.linalg.norm(machine.model.gravity.linear))
        if not weight:
            raise InputError(f"'{machine.name}' has no gravity, a load has no weight there")
        self._down, self._aside = weight * np.cos(slope), weight * np.sin(slope)
        drives, lines = list(strengths), list(lines_of(machine))
        self.all = tuple(
            [Cause(x.joint, x.why, rule.hydraulic) for x in drives]
            + [Cause(x.name, TIPS, rule.tipping) for x in lines]
        )
        self.bounds = [
            Bound(k, drive, None, sign) for k, drive in enumerate(drives) for sign in (1.0, -1.0)
        ] + [Bound(k, None, line, -1.0) for k, line in enumerate(lines, start=len(drives))]
        self.shares = np.array([cause.share for cause in self.all])

    def loads(self, at: AtRest) -> Array:
        """The load (N, K) [kg] of each cause, times its share; infinite where it never ends."""
        out = np.full((len(at.mass), len(self.all)), np.inf)
        for bound in self.bounds:
            end = self.end(self.terms(bound, at))
            out[:, bound.cause] = np.minimum(out[:, bound.cause], end)
        return np.asarray(out * self.shares)

    def end(self, terms: tuple[Array, ...]) -> Array:
        """The load (N,) at which a bound of these terms ends."""
        a, b, c, d = terms
        return largest(a, b, c, d) if self._aside else largest(a, b)

    def terms(self, bound: Bound, at: AtRest, still: float = 1.0) -> tuple[Array, ...]:
        """What a bound's a, b (N,), c and d (N, 3) are; linear in `at` but for what stands still.

        Args:
            bound: One of `bounds`.
            at: The machine at rest, or derivatives of it.
            still: 0 for derivatives: what does not depend on the posture is left out.
        """
        if bound.drive is not None:
            i = bound.drive.column
            weighs, lifts, rest = at.slopes[:, :, i], at.ways[:, :, i], -at.passive[:, i]
            rest = rest - still * (bound.drive.most if bound.sign > 0 else bound.drive.least)
        else:
            assert bound.line is not None
            foot, way = bound.line.foot, bound.line.way
            weighs = np.cross(way, at.moment - at.mass[:, None] * foot)
            lifts, rest = np.cross(way, at.tip - still * foot), np.zeros(len(at.mass))
        out = []
        for vectors in (weighs, lifts):
            rises = vectors @ self._up
            out.append((self._down * rises, self._aside * (vectors - rises[:, None] * self._up)))
        (a, c), (b, d) = out
        return bound.sign * (a + rest), bound.sign * b, c, d


class Line(NamedTuple):
    """A tipping line: its name, a point on it, and its direction."""

    name: str
    foot: Array
    way: Array


def lines_of(machine: Machine) -> Iterable[Line]:
    """The tipping lines of a machine whose supports stand still; none of others."""
    if not has_supports(machine):
        return
    stability = Stability(machine)
    if not stability.stands:
        return
    (points,) = stability.places(machine.home[None])
    for (first, second), names in zip(stability.edges, stability.lines, strict=True):
        way = points[second] - points[first]
        yield Line(" to ".join(names), points[first], way / np.linalg.norm(way))
