"""Break-out forces of bucket and arm, as ISO 6015 and SAE J1179 define them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.common.shown import Brief
from crane.common.units import quantity
from crane.dynamics.statics import Statics
from crane.machine import Machine
from crane.motion.workspaces.patch import fill
from crane.motion.workspaces.section import Section
from crane.ratings.causes import Cause, Causes
from crane.ratings.optimum import strongest
from crane.ratings.pivots import NEAR, Turn, digging, pivot, toggle, turn
from crane.ratings.rules import rule_of
from crane.ratings.strength import strengths
from crane.ratings.strokes import Strokes, check_drives
from crane.ratings.tool import tangent

_OWN, _OTHER = 81, 9  # values of the stroke that digs, and of another, to start from
_STARTS = 3  # of the best of them
_ON_PIN = 1e-6  # of the machine's size, from a pin to the centre of rotation
_BETTER = 1e-9  # share by which a posture farther from home has to be better


class Digging(NamedTuple):
    """The largest force of one drive along the frame's path, the way the drive is stronger.

    Attributes:
        joint: Whose drive works.
        pivot: The pin that it turns most of those that carry the frame.
        turn: How it turns the frame at the posture of `force`: about that pin, or about an
            instantaneous centre elsewhere.
        alone: With the best lever, if everything else held; infinite at a toggle [N].
        stroke: Of the drive there [m], [rad].
        lever: (n,) active coordinates there.
        home: In the same way at home, whatever the lever is there [N].
        force: With everything else at its limits; infinite where nothing ends it [N].
        cause: What ends it; None where nothing does.
        each: By cause, at its posture [N].
        q_a: (n,) active coordinates there.
    """

    joint: str
    pivot: str
    turn: Turn
    alone: float
    stroke: float
    lever: Array
    home: float
    force: float
    cause: Cause | None
    each: dict[Cause, float]
    q_a: Array

    @property
    def radius(self) -> float:
        """From the centre of rotation to the frame [m]."""
        return self.turn.radius


@dataclass(frozen=True, eq=False, repr=False)
class Breakout(Brief):
    """Break-out forces.

    Attributes:
        machine: The machine.
        frame: Where it digs.
        section: The plane in which it does.
        weights: Whether weights and tipping count.
        bucket: Of the bucket's drive.
        arm: Of the arm's; None where there is none.
    """

    machine: Machine
    frame: str
    section: Section
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
            f"At `{self.frame}`, along its path as the drive moves alone, with friction left out. "
            "Alone: with the drive's best lever, if everything else held. At home: with the lever "
            f"there. Force: {counts}, other circuits hold at their relief valves.\n",
            "| | drive | turns about | radius [m] | alone [kN] | at | at home [kN] | force [kN] | "
            "ends by | at |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        ]
        found = [("bucket", self.bucket)] + ([] if self.arm is None else [("arm", self.arm)])
        lines += [self._row(name, one) for name, one in found]
        lines += [
            f"\nThe {name} has no largest force alone: it goes through a toggle, where the lip "
            f"stands still as the drive moves, or within {100 * NEAR:g} % of its stroke of one."
            for name, one in found
            if np.isinf(one.alone)
        ]
        return "\n".join([*lines, ""])

    def _row(self, name: str, one: Digging) -> str:
        machine = self.machine
        at = ", ".join(
            f"{joint} = {x:.4g} {machine.unit(joint)}"
            for joint, x in zip(machine.active, one.q_a, strict=True)
        )
        return (
            f"| {name} | {one.joint} | {self._about(one)} | {one.radius:.4f} | {_kn(one.alone)} | "
            f"{one.stroke:.4g} {machine.unit(one.joint)} | {_kn(one.home)} | {_kn(one.force)} | "
            f"{one.cause or 'nothing'} | {at} |"
        )

    def _about(self, one: Digging) -> str:
        """The pin that the frame turns about, or where its instantaneous centre is."""
        if np.isinf(one.radius):
            return f"nothing: {one.joint} shifts it"
        if one.turn.offset <= _ON_PIN * self.machine.closure.size:
            return one.pivot
        u, w = self.section.coordinates(one.turn.centre[None])[0]
        first, second = self.section.names
        return (
            f"instantaneous centre, {first} {u:.3f}, {second} {w:.3f} m, {one.turn.offset:.3f} m "
            f"off {one.pivot}"
        )


def _kn(force: float) -> str:
    return f"{force / 1e3:.2f}" if np.isfinite(force) else "unbounded"


def breakout(
    machine: Machine,
    frame: str | None = None,
    *,
    bucket: str | None = None,
    arm: str | None = None,
    weights: bool = False,
) -> Breakout:
    """The largest forces of bucket and arm at the lip, tangent to its path.

    By ISO 6015 and SAE J1179 one drive works at its pump's pressure, and pushes

        F = tau / |dp/dX|

    at a frame p, with tau the force of the drive and X its stroke. That with the best lever is
    what the drive gives alone. All others hold behind closed valves, at not more than the pressure
    of their relief valves: where one of them yields before, the force is the largest with which
    none does, over all strokes. Weights and friction are left out. The arm's is with the bucket's
    stroke where its drive alone gives most. All are optima within the limits of the strokes. ISO
    takes the lip, SAE the tip of the teeth: that is the choice of the frame.

    The path is a circle about the pivot where the stroke turns one pin alone. Where it turns more,
    as the boom of a loader does whose tilt cylinder stands on the frame, it is one about the
    instantaneous centre, see `Turn`.

    At a toggle, dp/dX = 0, statics sets no limit to what the drive gives alone, which is infinite
    then; so it is within 1 % of the stroke from one, where the give of the oil, not the lever of
    rigid links decides. The arm's is with the bucket at home then.

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
    strokes = Strokes(Statics(check_drives(machine), frame))
    one, two = digging(strokes, bucket, arm)
    base = machine.home[machine.closure.active].copy()
    first, lever = _largest(strokes, one, (base, machine.home), strokes.moving, weights)
    second = None
    if two is not None:
        begun = machine.home
        if np.isfinite(first.alone):
            base[one], begun = first.stroke, lever
        others = [i for i in strokes.moving if i != one]
        second, _ = _largest(strokes, two, (base, begun), others, weights)
    return Breakout(machine, strokes.statics.frame, strokes.section, weights, first, second)


def _largest(
    strokes: Strokes, i: int, near: tuple[Array, Array], moved: list[int], weights: bool
) -> tuple[Digging, Array]:
    """Of the drive of stroke i, over some strokes, the others held; and the posture of its lever.

    Args:
        strokes: Of the frame.
        i: Among the active joints.
        near: (n,) where the others are held, and a closed posture (nq,) to come from.
        moved: The strokes.
        weights: Whether weights count.
    """
    machine, frame, active = strokes.machine, strokes.statics.frame, strokes.machine.closure.active
    joint, action, rule = machine.active[i], tangent(strokes, i), rule_of("none")
    drives = strengths(machine, [joint])
    own = Causes(
        strokes.statics, [x for x in drives if x.joint == joint], rule, action, weights=False
    )
    grid = _grid(strokes, i, near, moved)
    alone, lever, tried = _best(strokes, own, grid, moved)
    for q in tried:
        if (found := toggle(strokes, i, q)) is not None:
            alone, lever = np.inf, found
            break
    causes = Causes(strokes.statics, drives, rule, action, weights=weights)
    force, best, _ = _best(strokes, causes, grid, moved)
    if not (force > 0 and alone > 0):
        raise InputError(f"'{joint}' exerts no force at '{frame}'")
    each = causes.largest(strokes.statics.at(best[None]))[0]
    least = int(np.nan_to_num(each, nan=np.inf).argmin())
    home = own.largest(strokes.statics.at(machine.home[None]))[0].min()
    digs = Digging(
        joint=joint,
        pivot=pivot(machine, frame, i),
        turn=turn(machine, frame, i, best),
        alone=alone,
        stroke=float(lever[active][i]),
        lever=lever[active].copy(),
        home=float(np.nan_to_num(home, nan=np.inf)),
        force=force,
        cause=causes.all[least] if np.isfinite(force) else None,
        each={cause: float(x) for cause, x in zip(causes.all, each, strict=True)},
        q_a=best[active].copy(),
    )
    return digs, lever


def _best(
    strokes: Strokes, causes: Causes, grid: tuple[Array, Array], moved: list[int]
) -> tuple[float, Array, list[Array]]:
    """The largest force of all causes, its posture (nq,), and all postures that were tried.

    From the best posture of those near home first, then from the best of all.
    """

    def forces(q: Array) -> Array:
        each = causes.largest(strokes.statics.at(q))
        return np.where(np.isnan(each), np.inf, each).min(axis=1)

    value, best = -np.inf, strokes.machine.home
    tried: list[Array] = []
    for some, count in zip(grid, (1, _STARTS), strict=True):
        for q in some[np.argsort(-forces(some), kind="stable")[:count]]:
            found = strongest(strokes, causes, q, moved)
            force = float(forces(found[None])[0])
            tried += [q, found]
            if force > value * (1 + _BETTER) or value == -np.inf:
                value, best = force, found
    return value, best, tried


def _grid(
    strokes: Strokes, i: int, near: tuple[Array, Array], moved: list[int]
) -> tuple[Array, Array]:
    """Postures (N, nq) over stroke i alone, and over it and each of the others in turn."""
    machine, (base, begun) = strokes.machine, near
    low, high = strokes.low, strokes.high
    own = np.linspace(low[i], high[i], _OWN)
    found, beside = [], []
    others = [k for k in moved if k != i]
    if not others:  # the one stroke, along a line
        patch = fill(machine, base, (i, i), (own, base[[i]]), begun)
        if patch is not None:
            found = beside = [patch.q[patch.closed]]
    for k in others:
        here = np.r_[base[k], np.linspace(low[k], high[k], _OTHER)]
        order = np.argsort(here)
        patch = fill(machine, base, (i, k), (own, here[order]), begun)
        if patch is None:
            continue
        found.append(patch.q[patch.closed])
        row = int(np.flatnonzero(order == 0)[0])
        beside.append(patch.q[patch.closed[:, row], row])
    if not found:
        raise InputError(f"no posture of '{machine.name}' closes on the way from home")
    return np.concatenate(beside), np.concatenate(found)
