"""Break-out forces of bucket and arm, as ISO 6015 and SAE J1179 define them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crane.common.errors import InputError
from crane.common.result import Result
from crane.common.samples import Array
from crane.common.units import format_quantity
from crane.dynamics.statics import StaticsEvaluator
from crane.machine import Machine
from crane.motion.workspaces.workspace_patch import fill_patch
from crane.motion.workspaces.workspace_section import WorkspaceSection
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.force_optimizer import maximize_force
from crane.ratings.limiting_factors import LimitingFactor, LoadLimits
from crane.ratings.pivot_joints import NEAR, Turn, bucket_and_arm_strokes, find_pivot, toggle, turn
from crane.ratings.rating_rules import find_rule
from crane.ratings.strokes import Strokes, check_drives
from crane.ratings.tool_forces import tangent_action

_DIGGING_STROKE_VALUES, _OTHER_STROKE_VALUES = (
    81,
    9,
)  # values of the stroke that digs, and of another, to start from
_START_COUNT = 3  # of the best of them
_ON_PIN = 1e-6  # of the machine's size, from a pin to the centre of rotation
_MIN_RELATIVE_IMPROVEMENT = 1e-9  # share by which a posture farther from home has to be better


class BreakoutForce(NamedTuple):
    """The largest force of one drive along the frame's path, the way the drive is stronger.

    Attributes:
        joint: Whose drive works.
        pivot: The pin that it turns most of those that carry the frame.
        turn: How it turns the frame at the posture of `force`: about that pin, or about an
            instantaneous centre elsewhere.
        isolated_force: With the best lever, if everything else held; infinite at a toggle [N].
        stroke: Of the drive there [m], [rad].
        lever: (n,) active coordinates there.
        home: In the same way at home, whatever the lever is there [N].
        force: With everything else at its limits; infinite where nothing ends it [N].
        limiting_factor: What ends it; None where nothing does.
        forces_by_factor: By cause, at its posture [N].
        q_a: (n,) active coordinates there.
    """

    joint: str
    pivot: str
    turn: Turn
    isolated_force: float
    stroke: float
    lever: Array
    home: float
    force: float
    limiting_factor: LimitingFactor | None
    forces_by_factor: dict[LimitingFactor, float]
    q_a: Array

    @property
    def radius(self) -> float:
        """From the centre of rotation to the frame [m]."""
        return self.turn.radius


@dataclass(frozen=True, eq=False, repr=False)
class Breakout(Result):
    """Break-out forces.

    Attributes:
        machine: The machine.
        frame: Where it digs.
        section: The plane in which it does.
        with_weight: Whether weights and tipping count.
        bucket: Of the bucket's drive.
        arm: Of the arm's; None where there is none.
    """

    machine: Machine
    frame: str
    section: WorkspaceSection
    with_weight: bool
    bucket: BreakoutForce
    arm: BreakoutForce | None

    def _one_line(self) -> str:
        """Both forces."""
        named_forces = (("bucket", self.bucket), ("arm", self.arm))
        force_texts = [
            f"{name} {format_quantity(x.force, 'N', 4)}"
            for name, x in named_forces
            if x is not None
        ]
        return f"Breakout of '{self.machine.name}' at '{self.frame}': {', '.join(force_texts)}"

    def to_markdown(self) -> str:
        """A table: forces, levers, postures, what ends them."""
        weight_text = "weights and tipping count" if self.with_weight else "weights left out"
        lines = [
            f"# Break-out forces of {self.machine.name}\n",
            f"At `{self.frame}`, along its path as the drive moves alone, with friction left out. "
            "Alone: with the drive's best lever, if everything else held. At home: with the lever "
            f"there. Force: {weight_text}, other circuits hold at their relief valves.\n",
            "| | drive | turns about | radius [m] | alone [kN] | at | at home [kN] | force [kN] | "
            "ends by | at |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        ]
        found = [("bucket", self.bucket)] + ([] if self.arm is None else [("arm", self.arm)])
        lines += [self._row(name, breakout_force) for name, breakout_force in found]
        lines += [
            f"\nThe {name} has no largest force alone: it goes through a toggle, where the lip "
            f"stands still as the drive moves, or within {100 * NEAR:g} % of its stroke of one."
            for name, one in found
            if np.isinf(one.isolated_force)
        ]
        return "\n".join([*lines, ""])

    def _row(self, name: str, one: BreakoutForce) -> str:
        machine = self.machine
        at = ", ".join(
            f"{joint} = {x:.4g} {machine.unit(joint)}"
            for joint, x in zip(machine.active, one.q_a, strict=True)
        )
        return (
            f"| {name} | {one.joint} | {self._about(one)} | {one.radius:.4f} | "
            f"{_kn(one.isolated_force)} | "
            f"{one.stroke:.4g} {machine.unit(one.joint)} | {_kn(one.home)} | {_kn(one.force)} | "
            f"{one.limiting_factor or 'nothing'} | {at} |"
        )

    def _about(self, one: BreakoutForce) -> str:
        """The pin that the frame turns about, or where its instantaneous centre is."""
        if np.isinf(one.radius):
            return f"nothing: {one.joint} shifts it"
        if one.turn.offset <= _ON_PIN * self.machine.closure.characteristic_length:
            return one.pivot
        u, w = self.section.coordinates(one.turn.centre[None])[0]
        first, second = self.section.coordinate_names
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
    strokes = Strokes(StaticsEvaluator(check_drives(machine), frame))
    bucket_stroke, arm_stroke = bucket_and_arm_strokes(strokes, bucket, arm)
    held_coordinates = machine.home[machine.closure.active].copy()
    bucket_force, lever = _largest_breakout_force(
        strokes, bucket_stroke, (held_coordinates, machine.home), strokes.moving, weights
    )
    arm_force = None
    if arm_stroke is not None:
        begun = machine.home
        if np.isfinite(bucket_force.isolated_force):
            held_coordinates[bucket_stroke], begun = bucket_force.stroke, lever
        others = [i for i in strokes.moving if i != bucket_stroke]
        arm_force, _ = _largest_breakout_force(
            strokes, arm_stroke, (held_coordinates, begun), others, weights
        )
    return Breakout(
        machine, strokes.statics.frame, strokes.section, weights, bucket_force, arm_force
    )


def _largest_breakout_force(
    strokes: Strokes,
    stroke_index: int,
    near: tuple[Array, Array],
    moved: list[int],
    with_weight: bool,
) -> tuple[BreakoutForce, Array]:
    """Of the drive of stroke i, over some strokes, the others held; and the posture of its lever.

    Args:
        strokes: Of the frame.
        stroke_index: Among the active joints.
        near: (n,) where the others are held, and a closed posture (nq,) to come from.
        moved: The strokes.
        with_weight: Whether weights count.
    """
    machine, frame, active = strokes.machine, strokes.statics.frame, strokes.machine.closure.active
    joint, action, rule = (
        machine.active[stroke_index],
        tangent_action(strokes, stroke_index),
        find_rule("none"),
    )
    drives = drive_force_limits(machine, [joint])
    own_limits = LoadLimits(
        strokes.statics, [x for x in drives if x.joint == joint], rule, action, with_weight=False
    )
    grid = _grid(strokes, stroke_index, near, moved)
    isolated_force, best_lever_configuration, tried = _maximize_over_starts(
        strokes, own_limits, grid, moved
    )
    for q in tried:
        if (found := toggle(strokes, stroke_index, q)) is not None:
            isolated_force, best_lever_configuration = np.inf, found
            break
    load_limits = LoadLimits(strokes.statics, drives, rule, action, with_weight=with_weight)
    force, best_configuration, _ = _maximize_over_starts(strokes, load_limits, grid, moved)
    if not (force > 0 and isolated_force > 0):
        raise InputError(f"'{joint}' exerts no force at '{frame}'")
    forces = load_limits.max_magnitudes(strokes.statics.evaluate(best_configuration[None]))[0]
    least = int(np.nan_to_num(forces, nan=np.inf).argmin())
    home = own_limits.max_magnitudes(strokes.statics.evaluate(machine.home[None]))[0].min()
    digs = BreakoutForce(
        joint=joint,
        pivot=find_pivot(machine, frame, stroke_index),
        turn=turn(machine, frame, stroke_index, best_configuration),
        isolated_force=isolated_force,
        stroke=float(best_lever_configuration[active][stroke_index]),
        lever=best_lever_configuration[active].copy(),
        home=float(np.nan_to_num(home, nan=np.inf)),
        force=force,
        limiting_factor=load_limits.factors[least] if np.isfinite(force) else None,
        forces_by_factor={
            cause: float(x) for cause, x in zip(load_limits.factors, forces, strict=True)
        },
        q_a=best_configuration[active].copy(),
    )
    return digs, best_lever_configuration


def _maximize_over_starts(
    strokes: Strokes, load_limits: LoadLimits, grid: tuple[Array, Array], moved: list[int]
) -> tuple[float, Array, list[Array]]:
    """The largest force of all causes, its posture (nq,), and all postures that were tried.

    From the best posture of those near home first, then from the best of all.
    """

    def largest_forces(q: Array) -> Array:
        forces_by_factor = load_limits.max_magnitudes(strokes.statics.evaluate(q))
        return np.where(np.isnan(forces_by_factor), np.inf, forces_by_factor).min(axis=1)

    value, best_configuration = -np.inf, strokes.machine.home
    tried: list[Array] = []
    for some, count in zip(grid, (1, _START_COUNT), strict=True):
        for q in some[np.argsort(-largest_forces(some), kind="stable")[:count]]:
            configuration = maximize_force(strokes, load_limits, q, moved)
            force = float(largest_forces(configuration[None])[0])
            tried += [q, configuration]
            if force > value * (1 + _MIN_RELATIVE_IMPROVEMENT) or value == -np.inf:
                value, best_configuration = force, configuration
    return value, best_configuration, tried


def _grid(
    strokes: Strokes, i: int, near: tuple[Array, Array], moved: list[int]
) -> tuple[Array, Array]:
    """Postures (N, nq) over stroke i alone, and over it and each of the others in turn."""
    machine, (base, begun) = strokes.machine, near
    low, high = strokes.low, strokes.high
    own = np.linspace(low[i], high[i], _DIGGING_STROKE_VALUES)
    found, beside = [], []
    others = [k for k in moved if k != i]
    if not others:  # the one stroke, along a line
        patch = fill_patch(machine, base, (i, i), (own, base[[i]]), begun)
        if patch is not None:
            found = beside = [patch.configurations[patch.is_closed]]
    for k in others:
        here = np.r_[base[k], np.linspace(low[k], high[k], _OTHER_STROKE_VALUES)]
        order = np.argsort(here)
        patch = fill_patch(machine, base, (i, k), (own, here[order]), begun)
        if patch is None:
            continue
        found.append(patch.configurations[patch.is_closed])
        row = int(np.flatnonzero(order == 0)[0])
        beside.append(patch.configurations[patch.is_closed[:, row], row])
    if not found:
        raise InputError(f"no posture of '{machine.name}' closes on the way from home")
    return np.concatenate(beside), np.concatenate(found)
