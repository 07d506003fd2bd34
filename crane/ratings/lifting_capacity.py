"""Lifting capacity: the largest load at every place, and what ends it."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from crane.common.samples import Array, as_number
from crane.machine import Machine
from crane.ratings.capacity_report import to_markdown
from crane.ratings.chamber_pressures import chamber_pressures
from crane.ratings.configuration_search import ConfigurationSearch
from crane.ratings.holding_forces import buckling_margins
from crane.ratings.load_tables import LoadTable, load_table
from crane.ratings.pin_forces import pin_forces
from crane.ratings.rating_chart import RatingChart, compute_chart, configuration_search
from crane.ratings.rating_rules import Rule, find_rule
from crane.ratings.unit_actions import gravity_action

_MAX_GROUND_SLOPE = np.deg2rad(45.0)


@dataclass(frozen=True, eq=False, repr=False)
class Capacity(RatingChart):
    """Rated loads over reach and height [kg], see `RatingChart`."""

    quantity: ClassVar[tuple[str, str]] = ("load", "kg")

    def _one_line(self) -> str:
        """The range of its loads and places."""
        loads = self.loads[np.isfinite(self.loads)]
        range_text = f"{loads.min():.4g} to {loads.max():.4g} kg" if len(loads) else "no load"
        return (
            f"Capacity of '{self.machine.name}' at '{self.frame}': {range_text} over "
            f"{self.radii[0]:.4g} to {self.radii[-1]:.4g} m, rule '{self.rule.name}'"
        )

    @property
    def loads(self) -> Array:
        """(s, b, a) rated loads [kg]: its values."""
        return self.values

    @property
    def raising_joints(self) -> tuple[str, ...]:
        """Joints whose drives raise the load; others hold."""
        return self.working_joints

    def file_notes(self) -> dict[str, str]:
        """Its rule."""
        return {"rule": self.rule.description}

    def pressures(self) -> dict[str, Array]:
        """Pressures that hold the rated loads, see `crane.ratings.chamber_pressures`.

        Returns:
            By joint (s, b, a, 2) of its chambers A and B [Pa].
        """
        return chamber_pressures(self)

    def pin_forces(self) -> dict[str, Array]:
        """Forces in the pins under the rated loads, see `crane.ratings.pin_forces`.

        Returns:
            By joint and loop (s, b, a) [N].

        Raises:
            InputError: The ground leans.
        """
        return pin_forces(self)

    def buckling(self) -> dict[str, Array]:
        """Loads that buckle the cylinders over the forces that press them under the rated loads.

        Returns:
            By cylinder (s, b, a), infinite where it is pulled, see `crane.ratings.holding_forces`.
        """
        return buckling_margins(self)

    @cached_property
    def table(self) -> LoadTable:
        """Its table at round steps, as manuals print it."""
        return load_table(self)

    def at_positions(self, radii: Sequence[float], heights: Sequence[float]) -> "Capacity":
        """The same at other places, see `capacity`."""
        slews = None if self.section.slewing_joint is None else self.slews.tolist()
        return compute_chart(
            Capacity,
            self.machine,
            self.places,
            self.action,
            self.rule,
            self.raising_joints,
            ground_slope=self.ground_slope,
            with_friction=self.with_friction,
            slews=slews,
            radii=radii,
            heights=heights,
        )

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
    rule = find_rule(rule)
    slope = max(
        abs(as_number(slope, "the slope", "rad", max_magnitude=_MAX_GROUND_SLOPE)),
        rule.min_ground_slope,
    )
    search = configuration_search(machine, frame)
    if raising is None:
        raising = (
            [find_raising_joint(search)] if rule.only_raising_drive else machine.driven_joints
        )
    return compute_chart(
        Capacity, machine, search, gravity_action(machine), rule, raising, ground_slope=slope,
        with_friction=friction, slews=slews, step=step, radii=radii, heights=heights,
    )  # fmt: skip


def find_raising_joint(search: ConfigurationSearch) -> str:
    """The drive that carries most: whose stroke moves the machine's first moment farthest."""
    machine, strokes = search.machine, search.moving
    statics = search.statics.evaluate(machine.home[None])
    moment_changes = np.linalg.norm(statics.moment_jacobian[0], axis=0) * (
        search.high - search.low
    )
    return machine.active[max(strokes, key=lambda i: moment_changes[i])]
