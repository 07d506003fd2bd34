"""Tool forces: how hard a machine pushes at a frame, all over its reach, and what ends it."""

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import Array, as_sample
from crane.common.units import quantity
from crane.dynamics.statics import Statics
from crane.machine import Machine
from crane.motion.workspaces.section import upwards
from crane.ratings.actions import Action, Along, Fixed, slewed, turned
from crane.ratings.field import Field, charted, places_of
from crane.ratings.pivots import digging, turns
from crane.ratings.places import Places
from crane.ratings.rules import rule_of
from crane.ratings.strength import strengths
from crane.ratings.strokes import Strokes

DIRECTIONS = ("up", "down", "in", "out", "tangent", "-tangent", "normal", "-normal")


@dataclass(frozen=True, eq=False, repr=False)
class ToolForce(Field):
    """Tool forces over reach and height [N], see `Field`.

    Attributes:
        direction: In which the tool pushes, in words.
    """

    direction: str = ""

    quantity: ClassVar[tuple[str, str]] = ("force", "N")

    def _line(self) -> str:
        """Its direction, and the largest force."""
        forces = self.forces[np.isfinite(self.forces)]
        words = f"up to {quantity(forces.max(), 'N', 4)}" if len(forces) else "no force"
        return f"ToolForce of '{self.machine.name}' at '{self.frame}', {self.direction}: {words}"

    @property
    def forces(self) -> Array:
        """(s, b, a) the largest forces [N]: its values."""
        return self.values

    def notes(self) -> dict[str, str]:
        """Its direction."""
        return {"direction": self.direction}

    def to_markdown(self) -> str:
        """A summary: the largest force and where, and how often each cause ends it."""
        counts = "weights and tipping count" if self.weights else "weights left out"
        working = ", ".join(self.working)
        lines = [
            f"# Tool force of {self.machine.name}, {self.direction}\n",
            f"At `{self.frame}`; working {working}; {counts}, friction left out.\n",
            "| slew [deg] | largest [kN] | radius [m] | height [m] | ends by |",
            "| --- | --- | --- | --- | --- |",
        ]
        for turn, forces, cause in zip(self.slews, self.forces, self.cause, strict=True):
            shown = np.where(np.isfinite(forces), forces, -np.inf)
            b, a = np.unravel_index(int(shown.argmax()), shown.shape)
            if not np.isfinite(shown[b, a]):
                continue
            lines.append(
                f"| {np.rad2deg(turn):.4g} | {shown[b, a] / 1e3:.2f} | {self.radii[a]:.4g} | "
                f"{self.heights[b]:.4g} | {self.causes[cause[b, a]]} |"
            )
        lines += ["", "| ends by | of the places |", "| --- | --- |"]
        reached = np.isfinite(self.q_a[..., 0]).sum()
        for k in self.ends:
            lines.append(f"| {self.causes[k]} | {100 * (self.cause == k).sum() / reached:.3g} % |")
        return "\n".join([*lines, ""])

    def ways(self) -> Array:
        """(s, b, a, 2) unit vectors of the tool's pushing, in the section; NaN out of reach."""
        out = np.full((*self.values.shape, 2), np.nan)
        s, b, a = np.nonzero(np.isfinite(self.q_a[..., 0]))
        angles = slewed(self.machine, self.frame, self.section, self.slews[s])
        at = Statics(self.machine, self.frame).at(self.machine.closure.solve(self.q_a[s, b, a]))
        unit = -turned(self.action.unit(at, angles), upwards(self.machine), -angles)
        first = np.broadcast_to(self.section.first, unit.shape)
        if self.section.around:  # outwards from the axis, wherever the frame is
            first = at.tip - self.section.origin
            first = first - (first @ self.section.second)[:, None] * self.section.second
            first = turned(first, upwards(self.machine), -angles)
            first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
        out[s, b, a] = np.column_stack([(unit * first).sum(axis=1), unit @ self.section.second])
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
    places = places_of(machine, frame)
    action, alone = _action(places, direction, joint)
    if working is None:
        working = machine.driven_joints if alone is None else [alone]
    found = charted(
        ToolForce, machine, places, action, rule_of("none"), working, weights=weights,
        slews=slews, step=step, radii=radii, heights=heights,
    )  # fmt: skip
    return dataclasses.replace(found, direction=_words(direction, action, machine))


def _words(direction: str | Sequence[float], action: Action, machine: Machine) -> str:
    if not isinstance(direction, str):
        return "({:g}, {:g}, {:g})".format(*direction)
    return direction + (
        f" of {machine.active[action.stroke]}" if isinstance(action, Along) else ""
    )


def tangent(strokes: Strokes, i: int) -> Along:
    """What acts on the frame that stroke i moves as its drive pushes where it is stronger.

    Raises:
        InputError: Nothing limits the drive.
    """
    machine = strokes.machine
    joint = machine.active[i]
    drives = {x.joint: x for x in strengths(machine, [joint])}
    if joint not in drives:
        raise InputError(f"nothing limits '{joint}', give it a cylinder, or an effort in <limit>")
    pushes = drives[joint].most >= -drives[joint].least
    return Along(i, -1.0 if pushes else 1.0, upwards(machine))


def _action(
    places: Places, direction: str | Sequence[float], joint: str | None
) -> tuple[Action, str | None]:
    """What acts on the frame, and the joint along whose path it does."""
    machine, section = places.machine, places.section
    up = upwards(machine)
    if not isinstance(direction, str):
        way = as_sample(direction, 3, "the direction", ("x", "y", "z"))
        if not way.any():
            raise InputError("the direction is zero, give a vector of any length")
        return _fixed(-way / np.linalg.norm(way), up, joint)
    if direction not in DIRECTIONS:
        raise InputError(
            f"direction '{direction}' is unknown, {known(DIRECTIONS, direction)}, or a vector"
        )
    sign = -1.0 if direction in ("down", "in") or direction.startswith("-") else 1.0
    if direction in ("up", "down"):
        return _fixed(-sign * up, up, joint)
    if section.around and direction.removeprefix("-") != "tangent":
        raise InputError(
            f"'{places.statics.frame}' stays in no plane through the slewing axis, "
            f"'{direction}' is no direction there: give up, down, tangent or a vector"
        )
    if direction in ("in", "out"):
        return _fixed(-sign * section.first, up, joint)
    i = digging(places, joint)[0]
    along = tangent(places, i)
    along = Along(i, sign * along.sign, up)
    if direction.endswith("tangent"):
        return along, machine.active[i]
    return _across(places, along, sign), None


def _fixed(way: Array, up: Array, joint: str | None) -> tuple[Action, None]:
    if joint is not None:
        raise InputError(
            f"'{joint}' is named, but only tangent and normal are of a joint's path: leave it out"
        )
    return Fixed(way, up), None


def _across(places: Places, along: Along, sign: float) -> Along:
    """Away from the pivot, or towards it; what acts on the frame is the opposite."""
    machine, frame, section = places.machine, places.statics.frame, places.section
    normal = np.cross(section.first, section.second)
    at = places.statics.at(machine.home[None])
    way, rate = at.ways[0, :, along.stroke], turns(machine, frame, machine.home)[:, along.stroke]
    away = np.cross(way, rate)  # r w^2, from the centre of rotation
    sense = np.sign(np.cross(normal, way) @ away)
    return Along(along.stroke, -sign * float(sense), along.up, normal)
