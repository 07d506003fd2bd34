"""Lifting and slewing torque, as makers of loader and forestry cranes print them."""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from crane.common import one_line_repr
from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.common.units import format_quantity
from crane.dynamics.statics import StaticsEvaluator
from crane.machine import Machine
from crane.motion.workspaces.workspace_section import find_slewing_joint
from crane.ratings.configuration_search import ConfigurationSearch
from crane.ratings.drive_force_limits import drive_force_limits
from crane.ratings.lifting_capacity import capacity, find_raising_joint
from crane.ratings.pivot_joints import find_pivot
from crane.ratings.rating_rules import Rule

_STROKE_STEPS = 200  # of the stroke, between which the largest lever is sought
_HEIGHT_TOLERANCE = 1e-3  # of the reach


class Torques(NamedTuple):
    """What a crane's drives do about its axes.

    Attributes:
        raising_joint: The joint that raises the boom.
        pivot_joint: The joint that it turns.
        gross_torque: The largest torque of its drive about the pivot, own weight included [N m].
        gross_stroke: At which stroke [m].
        radius: At which distance from the slewing axis the net torque holds [m].
        load: The largest load there, at whatever height carries most [kg].
        height: That height [m].
        net_torque: The torque of that load about the slewing axis, load * g * radius [N m].
        slewing_torque: Torque of the slewing drive [N m]; NaN where nothing slews.
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
        """The torques."""
        texts = [f"gross {format_quantity(self.gross_torque, 'N m', 4)} of '{self.raising_joint}'"]
        texts.append(f"net {format_quantity(self.net_torque, 'N m', 4)} at {self.radius:g} m")
        if np.isfinite(self.slewing_torque):
            texts.append(f"slewing {format_quantity(self.slewing_torque, 'N m', 4)}")
        return f"Torques({', '.join(texts)})"

    def _repr_html_(self) -> str | None:
        """What notebooks show."""
        return one_line_repr.to_html(self)

    def to_markdown(self) -> str:
        """A table of the torques, and what each means."""
        rows = [
            (
                "lifting torque, gross",
                self.gross_torque,
                f"of {self.raising_joint} about {self.pivot_joint}, at its best stroke of "
                f"{self.gross_stroke:.4g}",
            ),
            (
                f"lifting torque, net at {self.radius:g} m",
                self.net_torque,
                f"of {self.load:.0f} kg, the most there, {self.height:.2f} m high",
            ),
        ]
        if np.isfinite(self.slewing_torque):
            rows.append(("slewing torque", self.slewing_torque, "of its drive"))
        lines = ["", "| | kN m | |", "| --- | ---: | --- |"]
        lines += [
            f"| {name} | {torque / 1e3:.1f} | {description} |"
            for name, torque, description in rows
        ]
        return "\n".join([*lines, ""])


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
    """Gross and net lifting torque, and slewing torque.

    With F the force of the drive that raises and phi the angle of its pivot, virtual work gives
    the gross torque F dX/dphi, whose largest value over the stroke is printed. The net torque is
    that of a load: the largest that hangs at a distance, whatever ends it.

    Args:
        machine: The machine.
        frame: Where the load hangs; the tip if not given.
        radius: Of the net torque [m].
        rule: By which the load is rated, see `capacity`.
        raising: Joints whose drives raise the load, see `capacity`.
        slews: Angles of the slewing joint [rad], likewise.
        slope: Of the ground [rad], likewise.
        friction: Whether drives overcome friction.

    Raises:
        InputError: Nothing raises a load, or the frame does not reach that far.
    """
    radius = as_number(radius, "the radius", "m", greater_than=0.0)
    statics = StaticsEvaluator(machine, frame)
    search = ConfigurationSearch(statics)
    joint = find_raising_joint(search)
    driven_joints = machine.driven_joints
    limits_by_joint = {
        x.joint: x
        for x in drive_force_limits(
            machine, driven_joints if raising is None else raising, friction
        )
    }
    if joint not in limits_by_joint:
        raise InputError(f"nothing limits '{joint}', give it a cylinder, or an effort in <limit>")
    i = machine.active.index(joint)
    pivot_joint = find_pivot(machine, statics.frame, i)
    column = machine.column(pivot_joint)
    home = machine.home[machine.closure.active]

    def torque(stroke: float) -> float:
        q_a = home.copy()
        q_a[i] = stroke
        rate = float(machine.closure.gamma(machine.closure.solve(q_a))[column, i])
        statics_values = statics.evaluate(machine.closure.solve(q_a)[None])
        is_lifting = statics_values.tip_load_forces(machine.model.gravity.linear)[0, i] > 0
        return abs(
            (limits_by_joint[joint].max_force if is_lifting else limits_by_joint[joint].min_force)
            / rate
        )

    strokes = np.linspace(search.low[i], search.high[i], _STROKE_STEPS + 1)
    values = np.array([torque(x) for x in strokes])
    best_index = int(values.argmax())
    interval = strokes[max(best_index - 1, 0)], strokes[min(best_index + 1, _STROKE_STEPS)]
    optimum = minimize_scalar(lambda x: -torque(x), bounds=interval, method="bounded",
                            options={"xatol": 1e-9})  # fmt: skip
    grid_optimum = float(values[best_index]), float(strokes[best_index])
    gross_torque, stroke = max(grid_optimum, (-float(optimum.fun), float(optimum.x)))
    slewing_joint = find_slewing_joint(machine, statics.frame)
    slewing_torque = np.nan
    if slewing_joint is not None and machine.active[slewing_joint[0]] in limits_by_joint:
        drive = limits_by_joint[machine.active[slewing_joint[0]]]
        slewing_torque = min(drive.max_force, -drive.min_force)
    options = {
        "rule": rule,
        "raising": raising,
        "slews": slews,
        "slope": slope,
        "friction": friction,
    }
    load, height = _largest_load_at_radius(
        machine, statics.frame, radius, options, search.section_positions
    )
    weight = float(np.linalg.norm(machine.model.gravity.linear))
    return Torques(
        joint,
        pivot_joint,
        gross_torque,
        stroke,
        radius,
        load,
        height,
        load * weight * radius,
        slewing_torque,
    )


def _largest_load_at_radius(
    machine: Machine, frame: str, radius: float, options: dict[str, Any], reach: Array
) -> tuple[float, float]:
    """The largest load at a radius, and the height where it hangs."""
    lower, upper = reach.min(axis=0), reach.max(axis=0)
    if not lower[0] <= radius <= upper[0]:
        raise InputError(
            f"'{frame}' reaches from {lower[0]:.3g} to {upper[0]:.3g} m, not {radius:g} m"
        )
    heights = np.linspace(lower[1], upper[1], 61)
    for _ in range(3):  # finer and finer about the best
        chart = capacity(machine, frame, radii=[radius], heights=heights.tolist(), **options)
        smallest_loads = np.nanmin(np.where(np.isnan(chart.loads), np.inf, chart.loads), axis=0)[
            :, 0
        ]
        loads = np.where(np.isfinite(smallest_loads), smallest_loads, -np.inf)
        best_index = int(loads.argmax())
        step = heights[1] - heights[0]
        if step < _HEIGHT_TOLERANCE * (upper[1] - lower[1]):
            break
        heights = np.linspace(heights[best_index] - step, heights[best_index] + step, 21)
    return float(loads[best_index]), float(heights[best_index])
