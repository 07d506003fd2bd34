"""How long a cylinder has to be over the range of the joint that it drives."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from crane.closure.choice import units
from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.formats.adding.eyes import Eye, apart, lever, path_between
from crane.machine import Machine

_GRID = 400  # postures over the range of the joint
_COARSE = 24  # the same while it is not known which joint
_STILL = 1e-9  # change of the length, as a share of it, that is none
_CLOSING = 1e-7  # share of the range to which it is known where the machine still closes
_ROUNDING = 1e-15  # of a coordinate's size
_DEAD = 0.02  # share of the best lever arm below which a posture is as good as a dead centre

Sample = tuple[float, Array]  # a coordinate and the posture (nq,) there


@dataclass(frozen=True)
class Span:
    """The distance between two eyes over the range of one active joint, others at home.

    Attributes:
        machine: Whose they are.
        eyes: The two.
        joint: The joint.
        values: (N,) its coordinates where the machine closes [m], [rad].
        q: (N, nq) postures.
        length: (N,) between the eyes [m].
        home: Index of the home posture.
        others: Joints that a cylinder could drive instead.
    """

    machine: Machine
    eyes: Sequence[Eye]
    joint: str
    values: Array
    q: Array
    length: Array
    home: int
    others: tuple[str, ...] = ()

    @property
    def lever(self) -> Array:
        """(N,) change of the length with the coordinate: the lever arm [m], or a ratio."""
        return np.array([lever(self.machine, self.eyes, q, self.joint) for q in self.q])

    def driven(self, least: float, most: float) -> "tuple[int, Span] | None":
        """Where a cylinder of that length drives the joint.

        Args:
            least: Its length with the rod in [m].
            most: With the rod out [m].

        Returns:
            The posture to start from: home, or the nearest to it with a length between and a
            lever arm; and what is reached from there before the stroke ends or a dead centre
            comes, its ends found between the postures. None where no posture has such a length.
        """
        slack = 1e-9 * most
        fits = (self.length >= least - slack) & (self.length <= most + slack)
        rates = np.abs(np.gradient(self.length, self.values))
        able = fits & (rates > _DEAD * rates.max())
        if not able.any():
            return None
        start = int(min(np.flatnonzero(able), key=lambda k: abs(int(k) - self.home)))
        levers = self.lever
        good = fits & (levers * levers[start] > 0)

        def drives(q: Array) -> bool:
            length = float(np.linalg.norm(apart(self.machine, self.eyes, q)))
            if not least - slack <= length <= most + slack:
                return False
            return lever(self.machine, self.eyes, q, self.joint) * levers[start] > 0

        first = last = start
        while first > 0 and good[first - 1]:
            first -= 1
        while last + 1 < len(good) and good[last + 1]:
            last += 1
        within = _ROUNDING * max(abs(self.values[0]), abs(self.values[-1]))
        samples = list(zip(self.values, self.q, strict=True))
        reached = samples[first : last + 1]
        if first > 0:
            beyond = self.values[first - 1]
            reached.insert(
                0, last_posture(self.machine, self.joint, reached[0], beyond, within, drives)
            )
        if last + 1 < len(good):
            beyond = self.values[last + 1]
            reached.append(
                last_posture(self.machine, self.joint, reached[-1], beyond, within, drives)
            )
        at = start - first + (first > 0)
        return start, Span.of(self.machine, self.eyes, self.joint, reached, at)

    @classmethod
    def of(
        cls,
        machine: Machine,
        eyes: Sequence[Eye],
        joint: str,
        samples: Sequence[Sample],
        home: int,
    ) -> "Span":
        """The span over some postures, that at home among them."""
        values, q = (np.array(part) for part in zip(*samples, strict=True))
        length = np.linalg.norm(apart(machine, eyes, q), axis=1)
        return cls(machine, eyes, joint, values, q, length, home)


def span_of(machine: Machine, eyes: Sequence[Eye]) -> Span:
    """The span over the active joint that a cylinder between two eyes takes the place of.

    That is an active joint between the two bodies, or one that turns and moves them by way of a
    linkage; of several the one whose scaled coordinate changes the length the most, as the
    condition of the drive wants it (see `crane.closure.choice`).

    Raises:
        InputError: No joint changes the distance.
    """
    between = [joint.name for joint in path_between(machine, eyes[0].link, eyes[1].link)]
    if not between:
        raise InputError(
            f"'{eyes[0]}' and '{eyes[1]}' are on one body, choose points of two that move "
            "against each other"
        )
    scale = machine.closure.equations.scales
    found: dict[str, float] = {}
    for joint in machine.active:
        span = _scanned(machine, eyes, joint, _COARSE)
        change = np.ptp(span.length) / max(span.length.max(), 1e-300)
        if len(span.length) > 1 and change > _STILL:
            at_home = abs(lever(machine, eyes, span.q[span.home], joint))
            found[joint] = at_home * scale[machine.column(joint)]
    if not found:
        raise InputError(
            f"no active joint changes the distance between '{eyes[0]}' and '{eyes[1]}' "
            f"(between them: {', '.join(between)}), choose other points"
        )
    moved = {joint for joint in found if joint in between or machine.unit(joint) == "rad"}
    able = {joint: value for joint, value in found.items() if joint in moved or not moved}
    best = max(able, key=lambda joint: able[joint])
    others = tuple(joint for joint in able if joint != best)
    return dataclasses.replace(_scanned(machine, eyes, best, _GRID), others=others)


def _scanned(machine: Machine, eyes: Sequence[Eye], joint: str, count: int) -> Span:
    column, index = machine.column(joint), machine.active.index(joint)
    home = float(machine.home[column])
    reach = np.pi if machine.unit(joint) == "rad" else float(units(machine.model)[column])
    lower, upper = (float(limits[index]) for limits in (machine.lower, machine.upper))
    lower = lower if np.isfinite(lower) else min(home, upper) - reach
    upper = upper if np.isfinite(upper) else max(home, lower) + reach
    values = np.linspace(lower, upper, count + 1)
    at = int(np.argmin(np.abs(values - home)))
    values[at] = home  # between its neighbours: it is nearer to this value than to them
    targets = np.tile(machine.home[machine.closure.active], (len(values), 1))
    targets[:, index] = values
    try:
        samples = list(zip(values, machine.closure.solve(targets), strict=True))
    except CraneError:  # part of the range cannot be closed
        before, after = (
            _outwards(machine, joint, (home, np.array(machine.home)), rest.tolist())
            for rest in (values[:at][::-1], values[at + 1 :])
        )
        samples, at = [*before[::-1], (home, np.array(machine.home)), *after], len(before)
    return Span.of(machine, eyes, joint, samples, at)


def _outwards(
    machine: Machine, joint: str, sample: Sample, values: Sequence[float]
) -> list[Sample]:
    """Postures behind one, at coordinates of a joint, and the last at which the machine closes."""
    found: list[Sample] = []
    for value in values:
        posture = _posture(machine, joint, value, sample[1])
        if posture is None:
            within = _CLOSING * abs(value - sample[0])
            return [*found, last_posture(machine, joint, sample, value, within)]
        sample = value, posture
        found.append(sample)
    return found


def last_posture(
    machine: Machine,
    joint: str,
    sample: Sample,
    beyond: float,
    within: float,
    holds: Callable[[Array], bool] = lambda q: True,
) -> Sample:
    """The last posture, between one and a coordinate beyond, that closes and where it holds.

    By bisection, until it is known to `within`.
    """
    value, q = sample
    while abs(beyond - value) > within:
        middle = (value + beyond) / 2
        posture = _posture(machine, joint, middle, q)
        if posture is not None and holds(posture):
            value, q = middle, posture
        else:
            beyond = middle
    return value, q


def _posture(machine: Machine, joint: str, value: float, guess: Array) -> Array | None:
    """Posture with a joint at a coordinate, others at home; None where it does not close."""
    target = machine.home[machine.closure.active]
    target[machine.active.index(joint)] = value
    try:
        return machine.closure.solve(target, guess)
    except CraneError:
        return None
