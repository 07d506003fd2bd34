"""Lifting capacity over radius and height, and lifting and slewing torque."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crane.common import one_line_repr
from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.common.units import format_quantity
from crane.dynamics.buckling import Buckling
from crane.dynamics.statics import StaticsEvaluator
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_section import find_slewing_joint
from crane.ratings.capacity_report import LoadTable, load_table, to_markdown
from crane.ratings.configuration_search import ConfigurationSearch
from crane.ratings.drive_force_limits import DriveForceLimits, PinForces, drive_force_limits
from crane.ratings.limiting_factors import RatingConditions
from crane.ratings.posture_search import PostureSearch, smallest_value
from crane.ratings.rating_chart import RatingChart, RatingValues, compute_chart
from crane.ratings.rating_rules import MAX_GROUND_SLOPE, Rule, find_rule, gravity_action
from crane.ratings.strokes import Strokes, find_pivot

_STROKE_STEPS = 200  # steps of the stroke over which the gross torque is sampled
_HEIGHT_COUNT, _HEIGHT_ROUNDS = 61, 2  # heights over the reach, and refinements of them


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RatingLoads(RatingValues):
    """Rated loads at the postures of a grid [kg], see `RatingValues`."""

    quantity: ClassVar[tuple[str, str]] = ("load", "kg")

    def _range_text(self) -> str:
        loads = self.loads[np.isfinite(self.loads)]
        range_text = f"{loads.min():.4g} to {loads.max():.4g} kg" if len(loads) else "no load"
        return (
            f"{type(self).__name__} of '{self.machine.name}' at '{self.frame}': {range_text} over"
        )

    @property
    def loads(self) -> Array:
        """(s, b, a) rated loads [kg], the same as `values`."""
        return self.values

    @property
    def raising_joints(self) -> tuple[str, ...]:
        """Joints whose drives raise the load; all others hold."""
        return self.working_joints

    def pressures(self) -> dict[str, Array]:
        """Compute the pressures of the chambers that hold the rated loads at rest.

        A force F of a cylinder comes from one chamber; the other one has the tank's pressure p_T:

            p_A = max(p_T, (F + p_T B) / A),    p_B = max(p_T, (p_T A - F) / B).

        On sloping ground each pressure is that for the worst direction of the slope. With
        friction, the pressure of a drive that raises is the one that starts its motion.

        Returns:
            By joint, an array (s, b, a, 2) for chambers A and B [Pa]; NaN where there is no finite
            load. Empty without a circuit.
        """
        if self.machine.hydraulics is None:
            return {}
        tank, (forces, slope_forces) = self.machine.hydraulics.supply.tank, self._holding_forces()
        out = {}
        for drive in self.drive_limits():
            if not drive.chamber_pressures:
                continue
            force, slope_force = forces[:, drive.active_index], slope_forces[:, drive.active_index]
            differences = (
                force + slope_force - drive.max_force, drive.min_force - force + slope_force,
            )  # fmt: skip
            pressures = [
                np.maximum(limit + difference / area, tank)
                for limit, difference, area in zip(
                    drive.chamber_pressures, differences, drive.chamber_areas, strict=True
                )
            ]
            out[drive.joint] = self._on_grid(np.column_stack(pressures))
        return out

    def pin_forces(self) -> dict[str, Array]:
        """Compute the forces in the pins at rest under the rated loads, on level ground.

        Returns:
            By joint and loop, an array (s, b, a) [N] of the magnitude of the components that
            statics determines, see `PinForces`; NaN where there is no finite load.

        Raises:
            InputError: The ground of the chart slopes.
            SingularConfigurationError: The passive joints are not determined at a position.
        """
        if self.ground_slope:
            raise InputError(
                f"forces in pins are those on level ground, but the chart's ground slopes by "
                f"{np.rad2deg(self.ground_slope):.3g} degrees: rate without slope"
            )
        machine, has_load = self.machine, np.isfinite(self.values)
        pins = PinForces(machine, self.frame)
        q = machine.closure.solve(np.ascontiguousarray(self.q_a[has_load]))
        unloaded, increments = pins.load_forces(
            q, np.broadcast_to(machine.model.gravity.linear, (len(q), 3))
        )
        forces = unloaded + self.values[has_load][:, None, None] * increments
        rows = np.linalg.norm(forces, axis=2).T
        return {x: self._on_grid(row) for x, row in zip(pins.names, rows, strict=True)}

    def buckling(self) -> dict[str, Array]:
        """Compute the margins to buckling of the cylinders under the rated loads.

        Returns:
            By cylinder that `crane.dynamics.Buckling` evaluates, an array (s, b, a): the buckling
            force over the pressing force, on sloping ground for the worst direction of the slope;
            infinite where the cylinder is pulled, NaN where there is no finite load. Empty without
            a circuit.
        """
        machine = self.machine
        if machine.hydraulics is None:
            return {}
        buckling = Buckling(machine)
        forces, slope_forces = self._holding_forces()
        for joint, column in buckling.columns.items():
            i = machine.active.index(joint)
            forces[:, i] += column.compression_sign * slope_forces[:, i]
        rows = buckling.buckling_margins(self.q_a[np.isfinite(self.values)], forces).T
        return {x: self._on_grid(row) for x, row in zip(buckling.columns, rows, strict=True)}

    def _holding_forces(self) -> tuple[Array, Array]:
        """Compute the forces of the active joints at rest under the rated loads.

        Returns:
            Two arrays (N, n) over the N positions with a finite load [N], [N m]: the forces
            without the lateral part of gravity on a slope, and the largest change by it over all
            directions of the slope.
        """
        machine, has_load = self.machine, np.isfinite(self.values)
        up = machine.up_direction
        statics = StaticsEvaluator(machine, self.frame).evaluate(
            machine.closure.solve(np.ascontiguousarray(self.q_a[has_load]))
        )
        gravity = float(np.linalg.norm(machine.model.gravity.linear))
        loads = self.values[has_load][:, None, None]
        moment_jacobian = statics.moment_jacobian + loads * statics.tip_jacobian
        vertical_parts = np.einsum("nix,i->nx", moment_jacobian, up)
        lateral_parts = moment_jacobian - vertical_parts[:, None] * up[:, None]
        return (
            gravity * np.cos(self.ground_slope) * vertical_parts - statics.passive_forces,
            gravity * np.sin(self.ground_slope) * np.linalg.norm(lateral_parts, axis=1),
        )

    def _on_grid(self, values: Array) -> Array:
        """Return values (N, ...) of positions with a finite load on the grid; NaN elsewhere."""
        out = np.full((*self.values.shape, *values.shape[1:]), np.nan)
        out[np.isfinite(self.values)] = values
        return out


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Capacity(RatingLoads, RatingChart):
    """Rated loads over radius and height [kg], see `RatingChart`."""

    def _one_line(self) -> str:
        return (
            f"{self._range_text()} {self.radii[0]:.4g} to {self.radii[-1]:.4g} m, "
            f"rule '{self.rule.name}'"
        )

    @cached_property
    def table(self) -> LoadTable:
        """Load table at round steps, as in manuals."""
        return load_table(self)

    def to_markdown(self) -> str:
        """Return the conditions, the load table and the limiting factors as Markdown."""
        return to_markdown(self, self.table)


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
    """Compute the largest load that a machine holds at rest, over its whole reach.

    At each position the load is the smallest over all limiting factors: the pressure of each
    cylinder, given by its pump or held by its closed valve, or the torque of a motor; tipping
    over each line between supports; and the capacities of pins, on level ground. What the machine
    already carries is part of the machine. If several configurations reach a position, the one
    with the largest load counts.

    Args:
        machine: A machine with hydraulics, or with `effort` limits in its URDFs.
        frame: Link at which the load hangs; the tip by default.
        rule: A name in `RULES`, or a `Rule`.
        raising: Joints whose drives raise the load at the pressure of their pump, while all
            others hold it behind closed valves. By default all, or, if the rule says so, the one
            that moves the load most.
        slews: Angles of the slewing joint [rad]. By default home and a quarter turn from home if
            the machine can tip, else home.
        slope: Slope of the ground, in the worst direction [rad].
        friction: Whether drives that raise have to overcome the friction of their joints.
        step: Distance between positions [m].
        radii: First coordinates of the positions, in place of a step [m].
        heights: Second coordinates of the positions, in place of a step [m].

    Raises:
        InputError: A rule, frame or joint is unknown, nothing limits the load, pins have limits
            and the ground slopes, or the frame is not moved by two to four strokes in a plane
            through the slewing axis.
    """
    conditions = load_conditions(
        ConfigurationSearch(machine, frame), rule, raising, slope, friction
    )
    return compute_chart(
        Capacity, conditions, slews=slews, step=step, radii=radii, heights=heights
    )


def load_conditions(
    places: Strokes,
    rule: str | Rule,
    raising: Collection[str] | None,
    slope: float,
    friction: bool,
) -> RatingConditions:
    """Return the conditions of a rated load, see `capacity`.

    Raises:
        InputError: The rule is unknown, or the slope is no such number.
    """
    machine, rule = places.machine, find_rule(rule)
    slope = abs(as_number(slope, "the slope", "rad", max_magnitude=MAX_GROUND_SLOPE))
    if raising is None:
        raising = (
            [find_raising_joint(places)] if rule.only_raising_drive else machine.driven_joints
        )
    return RatingConditions(
        machine=machine, places=places, action=gravity_action(machine), rule=rule,
        working_joints=tuple(raising), ground_slope=max(slope, rule.min_ground_slope),
        with_friction=friction,
    )  # fmt: skip


def find_raising_joint(search: Strokes) -> str:
    """Return the joint whose stroke changes the machine's first moment most."""
    machine = search.machine
    changes = np.linalg.norm(
        search.statics.evaluate(machine.home[None]).moment_jacobian[0], axis=0
    ) * (search.high - search.low)
    return machine.active[max(search.moving, key=lambda i: changes[i])]


class Torques(NamedTuple):
    """Torques of a crane's drives about its axes.

    Attributes:
        raising_joint: Joint whose drive raises the boom.
        pivot_joint: Joint that this drive turns.
        gross_torque: Largest torque of the drive about the pivot, own weight included [N m].
        gross_stroke: Stroke at which the gross torque is reached [m].
        radius: Distance from the slewing axis for the net torque [m].
        load: Largest load at this distance, over all heights [kg].
        height: Height of this load [m].
        net_torque: Torque of this load about the slewing axis, load * g * radius [N m].
        slewing_torque: Torque of the slewing drive [N m]; NaN if nothing slews.
    """

    raising_joint: str
    pivot_joint: str
    gross_torque: float
    gross_stroke: float
    radius: float
    load: float
    height: float
    net_torque: float
    slewing_torque: float

    def __repr__(self) -> str:
        """Return the torques in one line."""
        texts = [f"gross {format_quantity(self.gross_torque, 'N m', 4)} of '{self.raising_joint}'"]
        texts.append(f"net {format_quantity(self.net_torque, 'N m', 4)} at {self.radius:g} m")
        if np.isfinite(self.slewing_torque):
            texts.append(f"slewing {format_quantity(self.slewing_torque, 'N m', 4)}")
        return f"Torques({', '.join(texts)})"

    def _repr_html_(self) -> str | None:
        return one_line_repr.to_html(self)

    def to_markdown(self) -> str:
        """Return a table of the torques with their definitions."""
        gross = (f"of {self.raising_joint} about {self.pivot_joint}, at its best stroke of "
                 f"{self.gross_stroke:.4g}")  # fmt: skip
        net = f"of {self.load:.0f} kg, the most there, {self.height:.2f} m high"
        rows = [
            ("lifting torque, gross", self.gross_torque, gross),
            (f"lifting torque, net at {self.radius:g} m", self.net_torque, net),
        ]
        if np.isfinite(self.slewing_torque):
            rows.append(("slewing torque", self.slewing_torque, "of its drive"))
        lines = [f"| {name} | {torque / 1e3:.1f} | {text} |" for name, torque, text in rows]
        return "\n".join(["", "| | kN m | |", "| --- | ---: | --- |", *lines, ""])


def torques(
    machine: Machine,
    frame: str | None = None,
    *,
    radius: float = 4.0,
    rule: str | Rule = "none",
    raising: Collection[str] | None = None,
    slews: Sequence[float] | None = None,
    slope: float = 0.0,
    friction: bool = False,
) -> Torques:
    """Compute gross and net lifting torque, and slewing torque.

    With the force F of the drive that raises and the angle phi of its pivot, virtual work gives
    the gross torque F dX/dphi; the result is its largest value over the stroke. The net torque is
    that of the largest load at a radius, whatever limits the load.

    Args:
        machine: The machine.
        frame: Link at which the load hangs; the tip by default.
        radius: Radius of the net torque [m].
        rule: Rating rule of the load, see `capacity`.
        raising: Joints whose drives raise the load, see `capacity`.
        slews: Angles of the slewing joint, see `capacity` [rad].
        slope: Slope of the ground, see `capacity` [rad].
        friction: Whether drives that raise overcome friction.

    Raises:
        InputError: No drive raises a load, or the frame does not reach the radius.
    """
    radius = as_number(radius, "the radius", "m", greater_than=0.0)
    search = ConfigurationSearch(machine, frame)
    joint = find_raising_joint(search)
    limits = {
        x.joint: x
        for x in drive_force_limits(
            machine, machine.driven_joints if raising is None else raising, friction
        )
    }
    if joint not in limits:
        raise InputError(f"nothing limits '{joint}', give it a cylinder, or an effort in <limit>")
    pivot_joint = find_pivot(machine, search.statics.frame, machine.active.index(joint))
    gross_torque, stroke = _gross_torque(search, limits[joint], pivot_joint)
    slewing, slewing_torque = find_slewing_joint(machine, search.statics.frame), np.nan
    if slewing is not None and machine.active[slewing[0]] in limits:
        drive = limits[machine.active[slewing[0]]]
        slewing_torque = min(drive.max_force, -drive.min_force)
    load, height = _largest_load_at_radius(
        machine, search.statics.frame, radius, search.section_positions,
        rule=rule, raising=raising, slews=slews, slope=slope, friction=friction,
    )  # fmt: skip
    weight = float(np.linalg.norm(machine.model.gravity.linear))
    return Torques(
        joint, pivot_joint, gross_torque, stroke, radius, load, height, load * weight * radius,
        slewing_torque,
    )  # fmt: skip


def _gross_torque(
    search: ConfigurationSearch, drive: DriveForceLimits, pivot_joint: str
) -> tuple[float, float]:
    """Return the largest torque of a drive about a pivot [N m], and its stroke [m]."""
    machine, i = search.machine, drive.active_index
    column = machine.column(pivot_joint)

    def negative_torques(strokes: Array) -> Array:
        q = PostureSearch(search, {}, [drive.joint]).configurations(strokes[:, None])[0]
        load_forces = search.statics.evaluate(q).tip_load_forces(machine.model.gravity.linear)
        forces = np.where(load_forces[:, i] > 0, drive.max_force, drive.min_force)
        return -np.abs(forces / machine.closure.gamma(q)[:, column, i])

    strokes = np.linspace(search.low[i], search.high[i], _STROKE_STEPS + 1)
    negative, stroke = smallest_value(negative_torques, strokes)
    return -negative, stroke


def _largest_load_at_radius(
    machine: Machine, frame: str, radius: float, reach: Array, **options: Any
) -> tuple[float, float]:
    """Return the largest load at a radius [kg], and its height [m]."""
    lower, upper = reach.min(axis=0), reach.max(axis=0)
    if not lower[0] <= radius <= upper[0]:
        raise InputError(
            f"'{frame}' reaches from {lower[0]:.3g} to {upper[0]:.3g} m, not {radius:g} m"
        )

    def negative_loads(heights: Array) -> Array:
        chart = capacity(machine, frame, radii=[radius], heights=heights.tolist(), **options)
        loads = chart.loads.min(axis=0)[:, 0]
        return -np.where(np.isfinite(loads), loads, np.nan)

    heights = np.linspace(lower[1], upper[1], _HEIGHT_COUNT)
    load, height = smallest_value(negative_loads, heights, _HEIGHT_ROUNDS)
    return -load, height
