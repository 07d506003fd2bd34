"""How long a cylinder has to be over the range of the joint that it drives."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crane.closure.choice import units
from crane.common.errors import CraneError, InputError
from crane.common.samples import Array
from crane.formats.adding.eyes import Eye, apart, path_between
from crane.machine import Machine

_GRID = 400  # postures over the range of the joint
_COARSE = 24  # the same while it is not known which joint
_STILL = 1e-9  # change of the length, as a share of it, that is none
_DEAD = 0.02  # share of the best lever arm below which a posture is as good as a dead centre


@dataclass(frozen=True)
class Span:
    """The distance between two eyes over the range of one active joint, others at home.

    Attributes:
        joint: The joint.
        values: (N,) its coordinates where the machine closes [m], [rad].
        q: (N, nq) postures.
        length: (N,) between the eyes [m].
        home: Index of the home posture.
        others: Joints that a cylinder could drive instead.
    """

    joint: str
    values: Array
    q: Array
    length: Array
    home: int
    others: tuple[str, ...] = ()

    @property
    def lever(self) -> Array:
        """(N,) change of the length with the coordinate: the lever arm [m], or a ratio."""
        return np.asarray(np.gradient(self.length, self.values))

    def driven(self, least: float, most: float) -> "tuple[int, range] | None":
        """Where a cylinder of that length drives the joint.

        Args:
            least: Its length with the rod in [m].
            most: With the rod out [m].

        Returns:
            The posture to start from: home, or the nearest to it with a length between and a
            lever arm; and what is reached from there before the stroke ends or a dead centre
            comes. None where no posture has such a length.
        """
        slack = 1e-9 * most
        fits = (self.length >= least - slack) & (self.length <= most + slack)
        lever = self.lever
        able = fits & (np.abs(lever) > _DEAD * np.abs(lever).max())
        if not able.any():
            return None
        start = int(min(np.flatnonzero(able), key=lambda k: abs(int(k) - self.home)))
        good = fits & (lever * lever[start] > 0)
        ends = []
        for step in (-1, 1):
            k = start
            while 0 <= k + step < len(good) and good[k + step]:
                k += step
            ends.append(k)
        return start, range(ends[0], ends[1] + 1)


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
            at_home = abs(float(span.lever[span.home]))
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
        q = machine.closure.solve(targets)
        kept = range(len(values))
    except CraneError:  # part of the range cannot be closed
        q, kept = _outwards(machine, targets, at)
    length = np.linalg.norm(apart(machine, eyes, q), axis=1)
    return Span(joint, values[kept.start : kept.stop], q, length, at - kept.start)


def _outwards(machine: Machine, targets: Array, at: int) -> tuple[Array, range]:
    """Postures from that at home on to both sides, as far as the machine closes."""
    found, ends = {at: np.array(machine.home)}, [at, at]
    for side, step in enumerate((-1, 1)):
        k = at + step
        while 0 <= k < len(targets):
            try:
                found[k] = machine.closure.solve(targets[k], found[k - step])
            except CraneError:
                break
            ends[side] = k
            k += step
    kept = range(ends[0], ends[1] + 1)
    return np.array([found[k] for k in kept]), kept
