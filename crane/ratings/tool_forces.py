"""Tool forces: how hard a machine pushes at a frame, all over its reach, and what ends it."""

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array, as_sample
from crane.common.units import format_quantity
from crane.dynamics.statics import StaticsEvaluator
from crane.machine import Machine
from crane.motion.workspaces.workspace_section import up_direction
from crane.ratings.configuration_search import ConfigurationSearch
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.pivot_joints import bucket_and_arm_strokes, frame_angular_jacobian
from crane.ratings.rating_chart import RatingChart, compute_chart, configuration_search
from crane.ratings.rating_rules import find_rule
from crane.ratings.strokes import Strokes
from crane.ratings.unit_actions import (
    FixedUnitAction,
    PathUnitAction,
    UnitAction,
    rotate_about_axis,
    slew_angles,
)

TOOL_DIRECTIONS = ("up", "down", "in", "out", "tangent", "-tangent", "normal", "-normal")


@dataclass(frozen=True, eq=False, repr=False)
class ToolForce(RatingChart):
    """Tool forces over reach and height [N], see `RatingChart`.

    Attributes:
        direction: In which the tool pushes, in words.
    """

    direction: str = ""

    quantity: ClassVar[tuple[str, str]] = ("force", "N")

    def _one_line(self) -> str:
        """Its direction, and the largest force."""
        forces = self.forces[np.isfinite(self.forces)]
        force_text = (
            f"up to {format_quantity(forces.max(), 'N', 4)}" if len(forces) else "no force"
        )
        return (
            f"ToolForce of '{self.machine.name}' at '{self.frame}', {self.direction}: {force_text}"
        )

    @property
    def forces(self) -> Array:
        """(s, b, a) the largest forces [N]: its values."""
        return self.values

    def file_notes(self) -> dict[str, str]:
        """Its direction."""
        return {"direction": self.direction}

    def to_markdown(self) -> str:
        """A summary: the largest force and where, and how often each cause ends it."""
        weight_text = "weights and tipping count" if self.with_weight else "weights left out"
        working = ", ".join(self.working_joints)
        lines = [
            f"# Tool force of {self.machine.name}, {self.direction}\n",
            f"At `{self.frame}`; working {working}; {weight_text}, friction left out.\n",
            "| slew [deg] | largest [kN] | radius [m] | height [m] | ends by |",
            "| --- | --- | --- | --- | --- |",
        ]
        for slew_coordinate, forces, cause in zip(
            self.slews, self.forces, self.limiting_factor_index, strict=True
        ):
            finite_forces = np.where(np.isfinite(forces), forces, -np.inf)
            b, a = np.unravel_index(int(finite_forces.argmax()), finite_forces.shape)
            if not np.isfinite(finite_forces[b, a]):
                continue
            lines.append(
                f"| {np.rad2deg(slew_coordinate):.4g} | {finite_forces[b, a] / 1e3:.2f} | "
                f"{self.radii[a]:.4g} | "
                f"{self.heights[b]:.4g} | {self.limiting_factors[cause[b, a]]} |"
            )
        lines += ["", "| ends by | of the places |", "| --- | --- |"]
        reached_count = np.isfinite(self.q_a[..., 0]).sum()
        for k in self.active_factors:
            lines.append(
                f"| {self.limiting_factors[k]} | "
                f"{100 * (self.limiting_factor_index == k).sum() / reached_count:.3g} % |"
            )
        return "\n".join([*lines, ""])

    def section_directions(self) -> Array:
        """(s, b, a, 2) unit vectors of the tool's pushing, in the section; NaN out of reach."""
        out = np.full((*self.values.shape, 2), np.nan)
        s, b, a = np.nonzero(np.isfinite(self.q_a[..., 0]))
        angles = slew_angles(self.machine, self.frame, self.section, self.slews[s])
        statics = StaticsEvaluator(self.machine, self.frame).evaluate(
            self.machine.closure.solve(self.q_a[s, b, a])
        )
        unit_vectors = -rotate_about_axis(
            self.action.unit_vectors(statics, angles), up_direction(self.machine), -angles
        )
        first_directions = np.broadcast_to(self.section.first_direction, unit_vectors.shape)
        if self.section.is_radial:  # outwards from the axis, wherever the frame is
            first_directions = statics.tip_positions - self.section.origin
            first_directions = (
                first_directions
                - (first_directions @ self.section.second_direction)[:, None]
                * self.section.second_direction
            )
            first_directions = rotate_about_axis(
                first_directions, up_direction(self.machine), -angles
            )
            first_directions /= np.maximum(
                np.linalg.norm(first_directions, axis=1, keepdims=True), 1e-300
            )
        out[s, b, a] = np.column_stack(
            [
                (unit_vectors * first_directions).sum(axis=1),
                unit_vectors @ self.section.second_direction,
            ]
        )
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
    """The largest force with which a machine at rest pushes at a frame, all over its reach.

    Of each place the least over all causes, of all postures that reach it the largest: what the
    drives exert and hold, and tipping over each line between the supports, which is where the
    machine pushes itself off the ground, too. What acts on the frame is the opposite; a machine
    that pushes upwards lifts, and so has the loads of `capacity` in newtons.

    Args:
        machine: With hydraulics, or limits of `effort` in its URDFs.
        direction: In which the tool pushes: "up", "down", "in" (towards the slewing axis), "out";
            "tangent" to the frame's path as one stroke alone moves, in the sense in which its
            drive is stronger (a bucket that curls), "normal" to it, away from the pivot, and both
            with a minus sign; or (3,) in the world while the slewing joint is at home, with which
            it turns.
        frame: Where it pushes; the tip if not given.
        joint: Whose path tangent and normal are of; the bucket's if not given, see `breakout`.
        working: Joints whose drives work at the pressure of their pump, while others hold behind
            closed valves. All if not given, or of the tangent the joint.
        weights: Whether the machine has its weight; without it, nothing tips.
        slews: Angles of the slewing joint [rad], as in `capacity`; so the next ones.
        step: Between places [m].
        radii: First coordinates of the places [m], in place of steps.
        heights: Second coordinates [m].

    Raises:
        InputError: An unknown direction, frame or joint, nothing that limits a force, or a frame
            that two to four strokes do not move in a plane through the slewing axis.
    """
    search = configuration_search(machine, frame)
    action, single_joint = _direction_action(search, direction, joint)
    if working is None:
        working = machine.driven_joints if single_joint is None else [single_joint]
    chart = compute_chart(
        ToolForce, machine, search, action, find_rule("none"), working, with_weight=weights,
        slews=slews, step=step, radii=radii, heights=heights,
    )  # fmt: skip
    return dataclasses.replace(chart, direction=_direction_text(direction, action, machine))


def _direction_text(direction: str | Sequence[float], action: UnitAction, machine: Machine) -> str:
    if not isinstance(direction, str):
        return "({:g}, {:g}, {:g})".format(*direction)
    return direction + (
        f" of {machine.active[action.stroke]}" if isinstance(action, PathUnitAction) else ""
    )


def tangent_action(strokes: Strokes, stroke_index: int) -> PathUnitAction:
    """What acts on the frame that stroke i moves as its drive pushes where it is stronger.

    Raises:
        InputError: Nothing limits the drive.
    """
    machine = strokes.machine
    joint = machine.active[stroke_index]
    limits_by_joint = {x.joint: x for x in drive_force_limits(machine, [joint])}
    if joint not in limits_by_joint:
        raise InputError(f"nothing limits '{joint}', give it a cylinder, or an effort in <limit>")
    pushes_harder = limits_by_joint[joint].max_force >= -limits_by_joint[joint].min_force
    return PathUnitAction(stroke_index, -1.0 if pushes_harder else 1.0, up_direction(machine))


def _direction_action(
    search: ConfigurationSearch, direction: str | Sequence[float], joint: str | None
) -> tuple[UnitAction, str | None]:
    """What acts on the frame, and the joint along whose path it does."""
    machine, section = search.machine, search.section
    up = up_direction(machine)
    if not isinstance(direction, str):
        direction_vector = as_sample(direction, 3, "the direction", ("x", "y", "z"))
        if not direction_vector.any():
            raise InputError("the direction is zero, give a vector of any length")
        return _fixed_action(-direction_vector / np.linalg.norm(direction_vector), up, joint)
    if direction not in TOOL_DIRECTIONS:
        raise InputError(
            f"direction '{direction}' is unknown, {suggest_names(TOOL_DIRECTIONS, direction)}, "
            f"or a vector"
        )
    sign = -1.0 if direction in ("down", "in") or direction.startswith("-") else 1.0
    if direction in ("up", "down"):
        return _fixed_action(-sign * up, up, joint)
    if section.is_radial and direction.removeprefix("-") != "tangent":
        raise InputError(
            f"'{search.statics.frame}' stays in no plane through the slewing axis, "
            f"'{direction}' is no direction there: give up, down, tangent or a vector"
        )
    if direction in ("in", "out"):
        return _fixed_action(-sign * section.first_direction, up, joint)
    i = bucket_and_arm_strokes(search, joint)[0]
    path_action = tangent_action(search, i)
    path_action = PathUnitAction(i, sign * path_action.sign, up)
    if direction.endswith("tangent"):
        return path_action, machine.active[i]
    return _normal_action(search, path_action, sign), None


def _fixed_action(
    direction: Array, up_direction: Array, joint: str | None
) -> tuple[UnitAction, None]:
    if joint is not None:
        raise InputError(
            f"'{joint}' is named, but only tangent and normal are of a joint's path: leave it out"
        )
    return FixedUnitAction(direction, up_direction), None


def _normal_action(
    search: ConfigurationSearch, path_action: PathUnitAction, sign: float
) -> PathUnitAction:
    """Away from the pivot, or towards it; what acts on the frame is the opposite."""
    machine, frame, section = search.machine, search.statics.frame, search.section
    normal = np.cross(section.first_direction, section.second_direction)
    statics = search.statics.evaluate(machine.home[None])
    tip_tangent, angular_rate = (
        statics.tip_jacobian[0, :, path_action.stroke],
        frame_angular_jacobian(machine, frame, machine.home)[:, path_action.stroke],
    )
    outward = np.cross(tip_tangent, angular_rate)  # r w^2, from the centre of rotation
    orientation = np.sign(np.cross(normal, tip_tangent) @ outward)
    return PathUnitAction(path_action.stroke, -sign * float(orientation), path_action.up, normal)
