"""What ends a load or a force: drives, tipping lines, and pins."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.stability import Stability, has_supports
from crane.dynamics.statics import AtRest, Statics
from crane.machine import Machine
from crane.motion.workspaces.section import upwards
from crane.ratings.actions import Action
from crane.ratings.cones import largest
from crane.ratings.pins import Pins
from crane.ratings.rules import Rule
from crane.ratings.strength import Strength

TIPS, PIN = "tips", "pin force"


class Cause(NamedTuple):
    """What may end a load.

    Attributes:
        what: Joint or loop, or tipping line "A to B".
        why: Such as "working pressure", "tips" or "pin force".
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
        drive: Whose force it is, None for a line or a pin.
        line: About which, None for a drive or a pin.
        sign: 1 of the most that a drive pushes, -1 of the most that it pulls, and of lines.
        pin: Its index among those with a limit, None for a drive or a line.
    """

    cause: int
    drive: Strength | None
    line: "Line | None"
    sign: float
    pin: int | None = None


class Causes:
    """The load or force at a frame that a machine holds, cause by cause, at rest.

    With x its magnitude and e what acts on the frame per magnitude (gravity g of a load in kg, a
    unit vector of a force in N), drives have to hold it and the machine's weight, tipping lines
    have to keep their moment,

        least <= tau(x) <= most,   tau(x) = -(ds/dq)^T g - x (dp/dq)^T e - gamma^T f,
        w . [(s - M p_1) x -g + x (p - p_1) x -e] >= 0,

    with the first moment s and the mass M of the machine, the frame's place p, and w the direction
    of a line through p_1, as in `Stability`. On a slope g leans by its angle to any side: what is
    least over all sides is a cone in x, see `crane.ratings.cones`. So is a pin's limit,

        |R_0 + x R_1| <= R_max,

    with its force R_0 without load and what a load adds per kg; of loads on level ground alone.

    Args:
        statics: The machine and the frame.
        strengths: Of its drives.
        rule: What share counts.
        action: What acts on the frame.
        slope: Of the ground [rad].
        weights: Whether the machine has its weight; without, nothing tips.

    Attributes:
        all: The causes.
        bounds: Their ends.

    Raises:
        InputError: Pins have limits and the ground leans, or statics does not determine their
            forces.
    """

    def __init__(
        self,
        statics: Statics,
        strengths: Iterable[Strength],
        rule: Rule,
        action: Action,
        slope: float = 0.0,
        weights: bool = True,
    ):
        machine = self.machine = statics.machine
        self.action, self._up = action, upwards(machine)
        weight = weights * float(np.linalg.norm(machine.model.gravity.linear))
        self._lean = np.tan(slope)
        self._down, self._aside = weight * np.cos(slope), weight * np.sin(slope)
        drives, lines = list(strengths), list(lines_of(machine)) if weights else []
        pins = machine.pins if action.weight else {}
        if pins and slope:
            raise InputError(
                f"pins of '{machine.name}' are rated on level ground, and this leans by "
                f"{np.rad2deg(slope):.3g} degrees: rate without slope, or leave 'pins' out"
            )
        self._pins = Pins(machine, statics.frame, pins) if pins else None
        self._most = list(pins.values())
        self.all = tuple(
            [Cause(x.joint, x.why, rule.hydraulic) for x in drives]
            + [Cause(x.name, TIPS, rule.tipping) for x in lines]
            + [Cause(name, PIN, rule.structural) for name in pins]
        )
        self.bounds = [
            Bound(k, drive, None, sign) for k, drive in enumerate(drives) for sign in (1.0, -1.0)
        ]
        self.bounds += [Bound(k, None, x, -1.0) for k, x in enumerate(lines, start=len(drives))]
        before = len(drives) + len(lines)
        self.bounds += [Bound(before + k, None, None, 1.0, k) for k in range(len(pins))]
        self.shares = np.array([cause.share for cause in self.all])

    def largest(self, at: AtRest, angles: Array | None = None, q: Array | None = None) -> Array:
        """The magnitude (N, K) [kg], [N] of each cause, times its share; infinite without end.

        Args:
            at: The machine at rest.
            angles: (N,) by which it is slewed from home; 0 if not given.
            q: (N, nq) its postures, which pins need.
        """
        pins = self.in_pins(at, angles, q)
        out = np.full((len(at.mass), len(self.all)), np.inf)
        unit = self.action.unit(at, np.zeros(len(at.mass)) if angles is None else angles)
        for bound in self.bounds:
            end = self.end(bound, self.terms(bound, at, unit, pins))
            out[:, bound.cause] = np.minimum(out[:, bound.cause], end)
        return np.asarray(out * self.shares)

    def in_pins(
        self, at: AtRest, angles: Array | None = None, q: Array | None = None
    ) -> tuple[Array, Array] | None:
        """Forces (N, p, 3) of pins with limits, without load and per kg; None without limits."""
        if self._pins is None:
            return None
        assert q is not None
        angles = np.zeros(len(q)) if angles is None else angles
        return self._pins.under(q, self.action.unit(at, angles))

    def end(self, bound: Bound, terms: tuple[Array, ...]) -> Array:
        """The magnitude (N,) at which a bound of these terms ends."""
        a, b, c, d = terms
        leans = self._aside or bound.pin is not None
        return largest(a, b, c, d) if leans else largest(a, b)

    def terms(
        self,
        bound: Bound,
        at: AtRest,
        unit: Array,
        pins: tuple[Array, Array] | None = None,
    ) -> tuple[Array, ...]:
        """What a bound's a, b (N,), c and d (N, 3) are: a + b x + |c + d x| <= 0.

        Args:
            bound: One of `bounds`.
            at: The machine at rest.
            unit: (N, 3) of what acts, see `Action`.
            pins: See `in_pins`.
        """
        if bound.pin is not None:
            assert pins is not None
            none = np.zeros(len(at.mass))
            return none - self._most[bound.pin], none, *(x[:, bound.pin] for x in pins)
        weighs, lever, rest = self._levers(bound, at, 1.0)
        return self._terms(bound, weighs, rest, [(lever, unit)])

    def changes(
        self, bound: Bound, at: AtRest, by: AtRest, angles: Array | None = None
    ) -> tuple[Array, ...]:
        """Derivatives of `terms`, not of pins, with those of the machine at rest by one number."""
        angles = np.zeros(len(at.mass)) if angles is None else angles
        unit, moved = self.action.unit(at, angles), self.action.change(at, by, angles)
        weighs, lever, rest = self._levers(bound, by, 0.0)
        pairs = [(lever, unit), (self._levers(bound, at, 1.0)[1], moved)]
        return self._terms(bound, weighs, rest, pairs)

    def _terms(
        self, bound: Bound, weighs: Array, rest: Array, pairs: list[tuple[Array, Array]]
    ) -> tuple[Array, ...]:
        """With pairs of levers and units whose products are summed."""
        rises = weighs @ self._up
        a, c = self._down * rises, self._aside * (weighs - rises[:, None] * self._up)
        b, d = np.zeros(len(rises)), np.zeros_like(c)
        for lever, unit in pairs:
            if self.action.weight:  # of a load, which leans with the ground
                down = -(unit @ self._up) / np.hypot(1.0, self._lean)
                rises = lever @ self._up
                b = b + down * rises
                d = d + self._lean * down[:, None] * (lever - rises[:, None] * self._up)
            else:
                b = b - (lever * unit).sum(axis=1)
        return bound.sign * (a + rest), bound.sign * b, c, d

    def _levers(self, bound: Bound, at: AtRest, still: float) -> tuple[Array, Array, Array]:
        """Of the weight (N, 3), of what acts (N, 3), and the rest (N,).

        Linear in `at` but for what stands still, which is left out of derivatives.
        """
        if bound.drive is not None:
            i = bound.drive.column
            rest = -at.passive[:, i]
            rest = rest - still * (bound.drive.most if bound.sign > 0 else bound.drive.least)
            return at.slopes[:, :, i], at.ways[:, :, i], rest
        assert bound.line is not None
        foot, way = bound.line.foot, bound.line.way
        weighs = np.cross(way, at.moment - at.mass[:, None] * foot)
        return weighs, np.cross(way, at.tip - still * foot), np.zeros(len(at.mass))


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
