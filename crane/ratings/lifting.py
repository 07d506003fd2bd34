"""Lifting capacity: the largest load at every place, and what ends it."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from crane.common.samples import Array, as_number
from crane.machine import Machine
from crane.ratings.actions import load_on
from crane.ratings.field import Field, charted, places_of
from crane.ratings.held import buckling_margins
from crane.ratings.pins import pin_forces
from crane.ratings.places import Places
from crane.ratings.pressures import chamber_pressures
from crane.ratings.rules import Rule, rule_of
from crane.ratings.tables import LoadTable, load_table
from crane.ratings.words import to_markdown

_STEEPEST = np.deg2rad(45.0)


@dataclass(frozen=True, eq=False, repr=False)
class Capacity(Field):
    """Rated loads over reach and height [kg], see `Field`."""

    quantity: ClassVar[tuple[str, str]] = ("load", "kg")

    def _line(self) -> str:
        """The range of its loads and places."""
        loads = self.loads[np.isfinite(self.loads)]
        words = f"{loads.min():.4g} to {loads.max():.4g} kg" if len(loads) else "no load"
        return (
            f"Capacity of '{self.machine.name}' at '{self.frame}': {words} over "
            f"{self.radii[0]:.4g} to {self.radii[-1]:.4g} m, rule '{self.rule.name}'"
        )

    @property
    def loads(self) -> Array:
        """(s, b, a) rated loads [kg]: its values."""
        return self.values

    @property
    def raising(self) -> tuple[str, ...]:
        """Joints whose drives raise the load; others hold."""
        return self.working

    def notes(self) -> dict[str, str]:
        """Its rule."""
        return {"rule": self.rule.says}

    def pressures(self) -> dict[str, Array]:
        """Pressures that hold the rated loads, see `crane.ratings.pressures`.

        Returns:
            By joint (s, b, a, 2) of its chambers A and B [Pa].
        """
        return chamber_pressures(self)

    def pin_forces(self) -> dict[str, Array]:
        """Forces in the pins under the rated loads, see `crane.ratings.pins`.

        Returns:
            By joint and loop (s, b, a) [N].

        Raises:
            InputError: The ground leans.
        """
        return pin_forces(self)

    def buckling(self) -> dict[str, Array]:
        """Loads that buckle the cylinders over the forces that press them under the rated loads.

        Returns:
            By cylinder (s, b, a), infinite where it is pulled, see `crane.ratings.held`.
        """
        return buckling_margins(self)

    @cached_property
    def table(self) -> LoadTable:
        """Its table at round steps, as manuals print it."""
        return load_table(self)

    def at_places(self, radii: Sequence[float], heights: Sequence[float]) -> "Capacity":
        """The same at other places, see `capacity`."""
        slews = None if self.section.slew is None else self.slews.tolist()
        return charted(
            Capacity, self.machine, self.places, self.action, self.rule, self.raising,
            slope=self.slope, friction=self.friction, slews=slews, radii=radii, heights=heights,
        )  # fmt: skip

    def to_markdown(self) -> str:
        """What the loads hold for, their table as manuals print it, and what ends them."""
        return to_markdown(self)


def capacity(
    machine: Machine,
    frame: str | None = None,
    *,
    rule: str | Rule = "none",
    raising: Collection[str] | None = None,
    slews: Sequence[float] | None = None,
    slope: float = 0.0,
    friction: bool = False,
    step: float | None = None,
    radii: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
) -> Capacity:
    """The largest load that a machine holds at rest, all over its reach.

    Of each place the least over all causes: the pressure of each cylinder, its own or that which
    its closed valve holds, or a motor's torque; tipping over each line between its supports; the
    limits of its pins, on level ground. What the machine carries already belongs to it. Where
    several postures reach a place it is the one that carries most.

    Args:
        machine: With hydraulics, or limits of `effort` in its URDFs.
        frame: Where the load hangs; the tip if not given.
        rule: One of `RULES`, or shares of your own.
        raising: Joints whose drives raise the load, at the pressure of their pump, while others
            hold it behind closed valves. All if not given, or by the rule the one that moves
            most.
        slews: Angles of the slewing joint [rad]; home and a quarter turn from it if not given
            where the machine can tip, else home.
        slope: Of the ground, towards whichever side is worst [rad].
        friction: Whether drives that raise have to overcome their joints' friction.
        step: Between places [m].
        radii: First coordinates of the places [m], in place of steps.
        heights: Second coordinates [m].

    Raises:
        InputError: An unknown rule, frame or joint, nothing that limits a load, limits of pins on
            ground that leans, or a frame that two to four strokes do not move in a plane through
            the slewing axis.
    """
    rule = rule_of(rule)
    slope = max(abs(as_number(slope, "the slope", "rad", most=_STEEPEST)), rule.slope)
    places = places_of(machine, frame)
    if raising is None:
        raising = [raiser(places)] if rule.raises else machine.driven_joints
    return charted(
        Capacity, machine, places, load_on(machine), rule, raising, slope=slope,
        friction=friction, slews=slews, step=step, radii=radii, heights=heights,
    )  # fmt: skip


def raiser(places: Places) -> str:
    """The drive that carries most: whose stroke moves the machine's first moment farthest."""
    machine, strokes = places.machine, places.moving
    at = places.statics.at(machine.home[None])
    moved = np.linalg.norm(at.slopes[0], axis=0) * (places.high - places.low)
    return machine.active[max(strokes, key=lambda i: moved[i])]
