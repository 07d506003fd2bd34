"""Tool forces: the largest force at a frame over the whole reach, and its limiting factors."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array, as_sample
from crane.common.units import format_quantity
from crane.dynamics.statics import StaticsEvaluator
from crane.machine.machine import Machine
from crane.ratings.configuration_search import ConfigurationSearch
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.limiting_factors import RatingConditions
from crane.ratings.rating_chart import RatingChart, compute_chart
from crane.ratings.rating_rules import (
    FixedUnitAction,
    PathUnitAction,
    UnitAction,
    find_rule,
    rotate_about_axis,
    slew_angles,
)
from crane.ratings.strokes import Strokes, bucket_and_arm_strokes, frame_rates

TOOL_DIRECTIONS = ("up", "down", "in", "out", "tangent", "-tangent", "normal", "-normal")


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ToolForce(RatingChart):
    """Tool forces over radius and height [N], see `RatingChart`.

    Attributes:
        direction: Description of the direction in which the tool pushes.
    """

    direction: str = ""

    quantity: ClassVar[tuple[str, str]] = ("force", "N")

    def _one_line(self) -> str:
        forces = self.forces[np.isfinite(self.forces)]
        force_text = (
            f"up to {format_quantity(forces.max(), 'N', 4)}" if len(forces) else "no force"
        )
        return (
            f"ToolForce of '{self.machine.name}' at '{self.frame}', {self.direction}: {force_text}"
        )

    @property
    def forces(self) -> Array:
        """(s, b, a) largest forces [N], the same as `values`."""
        return self.values

    def file_notes(self) -> dict[str, str]:
        """Return the direction for the head of a file."""
        return {"direction": self.direction}

    def to_markdown(self) -> str:
        """Return the largest force and its position, and the share of each limiting factor."""
        weight_text = f"weight and tipping {'included' if self.with_weight else 'left out'}"
        working = ", ".join(self.working_joints)
        lines = [
            f"# Tool force of {self.machine.name}, {self.direction}\n",
            f"At `{self.frame}`; working: {working}; {weight_text}; without friction.\n",
            "| slew [deg] | largest [kN] | radius [m] | height [m] | limited by |",
            "| --- | --- | --- | --- | --- |",
        ]
        for slew, forces, factors in zip(
            self.slews, self.forces, self.limiting_factor_index, strict=True
        ):
            finite_forces = np.where(np.isfinite(forces), forces, -np.inf)
            b, a = np.unravel_index(int(finite_forces.argmax()), finite_forces.shape)
            if not np.isfinite(finite_forces[b, a]):
                continue
            lines.append(
                f"| {np.rad2deg(slew):.4g} | {finite_forces[b, a] / 1e3:.2f} | "
                f"{self.radii[a]:.4g} | {self.heights[b]:.4g} | "
                f"{self.limiting_factors[factors[b, a]]} |"
            )
        lines += ["", "| limited by | of all positions |", "| --- | --- |"]
        reached_count = np.isfinite(self.q_a[..., 0]).sum()
        lines += [
            f"| {self.limiting_factors[k]} | "
            f"{100 * (self.limiting_factor_index == k).sum() / reached_count:.3g} % |"
            for k in self.active_factors
        ]
        return "\n".join([*lines, ""])

    def section_directions(self) -> Array:
        """Return unit vectors (s, b, a, 2) of the tool force in the section; NaN out of reach."""
        out = np.full((*self.values.shape, 2), np.nan)
        s, b, a = np.nonzero(np.isfinite(self.q_a[..., 0]))
        angles = slew_angles(self.machine, self.section, self.slews[s])
        statics = StaticsEvaluator(self.machine, self.frame).evaluate(
            self.machine.closure.solve(self.q_a[s, b, a])
        )
        # the section stands at home: directions and positions are turned back
        up, origin = self.machine.up_direction, self.section.origin
        directions = -rotate_about_axis(self.action.unit_vectors(statics, angles), up, -angles)
        points = origin + rotate_about_axis(statics.tip_positions - origin, up, -angles)
        out[s, b, a] = self.section.section_jacobian(points, directions[:, :, None])[:, :, 0]
        return out


def tool_force(
    machine: Machine,
    direction: str | Sequence[float] = "tangent",
    frame: str | None = None,
    *,
    joint: str | None = None,
    working: Collection[str] | None = None,
    weights: bool = True,
    slews: Sequence[float] | None = None,
    step: float | None = None,
    radii: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
) -> ToolForce:
    """Compute the largest force of a machine at rest at a frame, over its whole reach.

    At each position the force is the smallest over all limiting factors: the forces that the
    drives exert and hold, and tipping over each line between supports, which includes lifting
    off the ground. If several configurations reach a position, the one with the largest force
    counts. The reaction on the frame is opposite to the force; a machine that pushes upwards
    lifts, with the loads of `capacity` in newtons.

    Args:
        machine: A machine with hydraulics, or with `effort` limits in its URDFs.
        direction: Direction in which the tool pushes: "up", "down", "in" (towards the slewing
            axis), "out"; "tangent" to the frame's path when one stroke alone moves, in the
            direction in which its drive is stronger (a bucket that curls); "normal" to this path,
            away from the pivot; "-tangent" and "-normal"; or a vector (3,) in the world with the
            slewing joint at home, with which it turns.
        frame: Link at which the tool pushes; the tip by default.
        joint: Joint of the path for tangent and normal; the bucket's by default, see `breakout`.
        working: Joints whose drives work at the pressure of their pump, while all others hold
            behind closed valves. By default all, or for a tangent the joint of the path.
        weights: Whether the machine has weight; without weight it does not tip.
        slews: Angles of the slewing joint, see `capacity` [rad].
        step: Distance between positions [m].
        radii: First coordinates of the positions, in place of a step [m].
        heights: Second coordinates of the positions, in place of a step [m].

    Raises:
        InputError: A direction, frame or joint is unknown, nothing limits the force, or the frame
            is not moved by two to four strokes in a plane through the slewing axis.
    """
    search = ConfigurationSearch(machine, frame)
    action, single_joint = direction_action(search, direction, joint)
    if working is None:
        working = machine.driven_joints if single_joint is None else [single_joint]
    conditions = RatingConditions(
        machine=machine, places=search, action=action, rule=find_rule("none"),
        working_joints=tuple(working), with_weight=weights,
    )  # fmt: skip
    text = direction_text(direction)
    if isinstance(action, PathUnitAction):
        text += f" of {machine.active[action.stroke]}"
    return compute_chart(
        ToolForce, conditions, slews=slews, step=step, radii=radii, heights=heights, direction=text
    )


def direction_text(direction: str | Sequence[float]) -> str:
    """Return a direction as text."""
    return direction if isinstance(direction, str) else "({:g}, {:g}, {:g})".format(*direction)


def tangent_action(strokes: Strokes, stroke_index: int) -> PathUnitAction:
    """Return the reaction on the frame when a stroke's drive pushes in its stronger direction.

    Raises:
        InputError: The drive has no limit.
    """
    machine = strokes.machine
    joint = machine.active[stroke_index]
    limits = next((x for x in drive_force_limits(machine, [joint]) if x.joint == joint), None)
    if limits is None:
        raise InputError(f"nothing limits '{joint}', give it a cylinder, or an effort in <limit>")
    pushes_harder = limits.max_force >= -limits.min_force
    return PathUnitAction(stroke_index, -1.0 if pushes_harder else 1.0, machine.up_direction)


def direction_action(
    search: Strokes, direction: str | Sequence[float], joint: str | None
) -> tuple[UnitAction, str | None]:
    """Return the unit action on the frame, and the joint for a tangent of a path."""
    machine, section = search.machine, search.section
    up = machine.up_direction
    if isinstance(direction, str):
        if direction not in TOOL_DIRECTIONS:
            raise InputError(
                f"direction '{direction}' is unknown, "
                f"{suggest_names(TOOL_DIRECTIONS, direction)}, or a vector"
            )
        if section.is_radial and direction not in ("up", "down", "tangent", "-tangent"):
            raise InputError(
                f"'{search.statics.frame}' stays in no plane through the slewing axis, "
                f"'{direction}' is no direction there: give up, down, tangent or a vector"
            )
        if direction.endswith(("tangent", "normal")):
            i = bucket_and_arm_strokes(search, joint)[0]
            sign = -1.0 if direction.startswith("-") else 1.0
            tangent = PathUnitAction(i, sign * tangent_action(search, i).sign, up)
            is_tangent = direction.endswith("tangent")
            action = tangent if is_tangent else _normal_action(search, tangent, sign)
            return action, machine.active[i] if is_tangent else None
        outward = section.first_direction
        pushed = {"up": up, "down": -up, "in": -outward, "out": outward}[direction]
    else:
        pushed = as_sample(direction, 3, "the direction", ("x", "y", "z"))
        if not pushed.any():
            raise InputError("the direction is zero, give a vector of any length")
        pushed = pushed / np.linalg.norm(pushed)
    if joint is not None:
        raise InputError(
            f"'{joint}' is named, but only tangent and normal are of a joint's path: leave it out"
        )
    return FixedUnitAction(-pushed, up), None


def _normal_action(search: Strokes, path_action: PathUnitAction, sign: float) -> PathUnitAction:
    """Return the reaction to a force away from the pivot, or with sign -1 towards it."""
    machine, frame, section = search.machine, search.statics.frame, search.section
    normal = np.cross(section.first_direction, section.second_direction)
    statics = search.statics.evaluate(machine.home[None])
    tip_tangent = statics.tip_jacobian[0, :, path_action.stroke]
    angular_rate = frame_rates(machine, frame, machine.home)[3:, path_action.stroke]
    outward = np.cross(tip_tangent, angular_rate)  # r w^2, from the centre of rotation
    orientation = np.sign(np.cross(normal, tip_tangent) @ outward)
    return PathUnitAction(path_action.stroke, -sign * float(orientation), path_action.up, normal)
