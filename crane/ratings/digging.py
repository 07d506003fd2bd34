"""Break-out forces of bucket and arm, as ISO 6015 and SAE J1179 define them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.common.shown import Brief
from crane.common.units import quantity
from crane.machine import Machine
from crane.motion.workspaces.patch import fill
from crane.ratings.causes import Cause, Causes
from crane.ratings.field import places_of
from crane.ratings.optimum import strongest
from crane.ratings.pivots import digging, pivot, turns
from crane.ratings.places import Places
from crane.ratings.rules import rule_of
from crane.ratings.strength import strengths
from crane.ratings.tool import tangent

_OWN, _OTHER = 81, 9  # values of the stroke that digs, and of another, to start from
_STARTS = 3  # of the best of them
_BETTER = 1e-9  # share by which a posture farther from home has to be better


class Digging(NamedTuple):
    """The largest force of one drive along the frame's path, the way the drive is stronger.

    Attributes:
        joint: Whose drive works.
        pivot: About which it turns the frame.
        radius: From the pivot to the frame [m].
        alone: With the best lever, if everything else held [N].
        stroke: Of the drive there [m], [rad].
        force: With everything else at its limits [N].
        cause: What ends it.
        each: By cause, at its posture [N].
        q_a: (n,) active coordinates there.
    """

    joint: str
    pivot: str
    radius: float
    alone: float
    stroke: float
    force: float
    cause: Cause
    each: dict[Cause, float]
    q_a: Array


@dataclass(frozen=True, eq=False, repr=False)
class Breakout(Brief):
    """Break-out forces.

    Attributes:
        machine: The machine.
        frame: Where it digs.
        weights: Whether weights and tipping count.
        bucket: Of the bucket's drive.
        arm: Of the arm's; None where there is none.
    """

    machine: Machine
    frame: str
    weights: bool
    bucket: Digging
    arm: Digging | None

    def _line(self) -> str:
        """Both forces."""
        both = (("bucket", self.bucket), ("arm", self.arm))
        words = [f"{name} {quantity(x.force, 'N', 4)}" for name, x in both if x is not None]
        return f"Breakout of '{self.machine.name}' at '{self.frame}': {', '.join(words)}"

    def to_markdown(self) -> str:
        """A table: forces, levers, postures, what ends them."""
        counts = "weights and tipping count" if self.weights else "weights left out"
        lines = [
            f"# Break-out forces of {self.machine.name}\n",
            f"At `{self.frame}`, along the circle about the pivot, with friction left out. Alone: "
            f"with the drive's best lever, if everything else held. Force: {counts}, other "
            "circuits hold at their relief valves.\n",
            "| | drive | pivot | radius [m] | alone [kN] | at | force [kN] | ends by | at |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        ]
        for name, one in (("bucket", self.bucket), ("arm", self.arm)):
            if one is None:
                continue
            machine = self.machine
            at = ", ".join(
                f"{joint} = {x:.4g} {machine.unit(joint)}"
                for joint, x in zip(machine.active, one.q_a, strict=True)
            )
            lines.append(
                f"| {name} | {one.joint} | {one.pivot} | {one.radius:.4f} | "
                f"{one.alone / 1e3:.2f} | {one.stroke:.4g} {machine.unit(one.joint)} | "
                f"{one.force / 1e3:.2f} | {one.cause} | {at} |"
            )
        return "\n".join([*lines, ""])


def breakout(
    machine: Machine,
    frame: str | None = None,
    *,
    bucket: str | None = None,
    arm: str | None = None,
    weights: bool = False,
) -> Breakout:
    """The largest forces of bucket and arm at the lip, tangent to the circle about their pivots.

    By ISO 6015 and SAE J1179 one drive works at its pump's pressure, and pushes

        F = tau / |dp/dX|

    at a frame p, with tau the force of the drive and X its stroke. That with the best lever is
    what the drive gives alone. All others hold behind closed valves, at not more than the pressure
    of their relief valves: where one of them yields before, the force is the largest with which
    none does, over all strokes. Weights and friction are left out. The arm's is with the bucket's
    stroke where its drive alone gives most. All are optima within the limits of the strokes. ISO
    takes the lip, SAE the tip of the teeth: that is the choice of the frame.

    Args:
        machine: With hydraulics, or limits of `effort` in its URDFs.
        frame: The lip; the tip if not given.
        bucket: The joint whose drive turns the bucket; that nearest to the lip of three that turn
            it if not given.
        arm: Likewise the arm; the one before it if not given.
        weights: Whether the machine has its weight, which its drives hold and which keeps it from
            tipping: all limits of the posture, with the slewing joint at home.

    Raises:
        InputError: Nothing is a bucket, an unknown frame or joint, or nothing that limits a force.
    """
    places = places_of(machine, frame)
    one, two = digging(places, bucket, arm)
    base = machine.home[machine.closure.active].copy()
    strokes = [*places.pair, *places.others]
    first = _largest(places, one, base, strokes, weights)
    second = None
    if two is not None:
        base[one] = first.stroke
        second = _largest(places, two, base, [i for i in strokes if i != one], weights)
    return Breakout(machine, places.statics.frame, weights, first, second)


def _largest(places: Places, i: int, base: Array, strokes: list[int], weights: bool) -> Digging:
    """Of the drive of stroke i, over some strokes, the others as in `base`."""
    machine, frame, active = places.machine, places.statics.frame, places.machine.closure.active
    joint, action, rule = machine.active[i], tangent(places, i), rule_of("none")
    drives = strengths(machine, [joint])
    own = [drive for drive in drives if drive.joint == joint]
    alone, lever = _best(
        places, Causes(places.statics, own, rule, action, weights=False), i, base, strokes
    )
    causes = Causes(places.statics, drives, rule, action, weights=weights)
    force, best = _best(places, causes, i, base, strokes)
    if not (0 < force < np.inf and 0 < alone < np.inf):
        raise InputError(f"'{joint}' exerts no force at '{frame}' that something ends")
    at = places.statics.at(best[None])
    each = causes.largest(at)[0]
    rate = np.linalg.norm(turns(machine, frame, best)[:, i])
    return Digging(
        joint=joint,
        pivot=pivot(machine, frame, i),
        radius=float(np.linalg.norm(at.ways[0, :, i]) / rate),
        alone=alone,
        stroke=float(lever[active][i]),
        force=force,
        cause=causes.all[int(np.nan_to_num(each, nan=np.inf).argmin())],
        each={cause: float(x) for cause, x in zip(causes.all, each, strict=True)},
        q_a=best[active].copy(),
    )


def _best(
    places: Places, causes: Causes, i: int, base: Array, strokes: list[int]
) -> tuple[float, Array]:
    """The largest force of all causes and its posture (nq,)."""

    def forces(q: Array) -> Array:
        each = causes.largest(places.statics.at(q))
        return np.where(np.isnan(each), np.inf, each).min(axis=1)

    value, best = -np.inf, places.machine.home
    for q in _starts(places, i, base, strokes, forces):
        found = strongest(places, causes, q, strokes)
        force = float(forces(found[None])[0])
        if np.isfinite(force) and (force > value * (1 + _BETTER) or value == -np.inf):
            value, best = force, found
    return value, best


def _starts(
    places: Places,
    i: int,
    base: Array,
    strokes: list[int],
    forces: Callable[[Array], Array],
) -> list[Array]:
    """Postures (nq,) to start from: the best near home first, then the best of all."""
    low, high = places.low, places.high
    own = np.linspace(low[i], high[i], _OWN)
    found, near = [], []
    others = [k for k in strokes if k != i]
    if not others:  # the one stroke, along a line
        patch = fill(places.machine, base, (i, i), (own, base[[i]]))
        if patch is not None:
            found = near = [patch.q[patch.closed]]
    for k in others:
        here = np.r_[base[k], np.linspace(low[k], high[k], _OTHER)]
        order = np.argsort(here)
        patch = fill(places.machine, base, (i, k), (own, here[order]))
        if patch is None:
            continue
        found.append(patch.q[patch.closed])
        row = int(np.flatnonzero(order == 0)[0])
        near.append(patch.q[patch.closed[:, row], row])
    if not found:
        raise InputError(f"no posture of '{places.machine.name}' closes on the way from home")
    out = []
    for some, count in ((np.concatenate(near), 1), (np.concatenate(found), _STARTS)):
        values = forces(some)
        out += list(some[np.argsort(-values, kind="stable")[:count]])
    return out
