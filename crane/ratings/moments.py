"""Lifting and slewing torque, as makers of loader and forestry cranes print them."""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from crane.common import shown
from crane.common.errors import InputError
from crane.common.samples import Array, as_number
from crane.common.units import quantity
from crane.dynamics.statics import Statics
from crane.machine import Machine
from crane.motion.workspaces.section import slewing
from crane.ratings.lifting import capacity, raiser
from crane.ratings.pivots import pivot
from crane.ratings.places import Places
from crane.ratings.rules import Rule
from crane.ratings.strength import strengths

_STEPS = 200  # of the stroke, between which the largest lever is sought
_BESIDE = 1e-3  # of the reach


class Torques(NamedTuple):
    """What a crane's drives do about its axes.

    Attributes:
        raising: The joint that raises the boom.
        pivot: The joint that it turns.
        gross: The largest torque of its drive about the pivot, own weight included [N m].
        stroke: At which stroke [m].
        radius: At which distance from the slewing axis the net torque holds [m].
        load: The largest load there, at whatever height carries most [kg].
        height: That height [m].
        net: The torque of that load about the slewing axis, load * g * radius [N m].
        slewing: Torque of the slewing drive [N m]; NaN where nothing slews.
    """

    raising: str
    pivot: str
    gross: float
    stroke: float
    radius: float
    load: float
    height: float
    net: float
    slewing: float

    def __repr__(self) -> str:
        """The torques."""
        words = [f"gross {quantity(self.gross, 'N m', 4)} of '{self.raising}'"]
        words.append(f"net {quantity(self.net, 'N m', 4)} at {self.radius:g} m")
        if np.isfinite(self.slewing):
            words.append(f"slewing {quantity(self.slewing, 'N m', 4)}")
        return f"Torques({', '.join(words)})"

    def _repr_html_(self) -> str | None:
        """What notebooks show."""
        return shown.to_html(self)

    def to_markdown(self) -> str:
        """A table of the torques, and what each means."""
        rows = [
            ("lifting torque, gross", self.gross,
             f"of {self.raising} about {self.pivot}, at its best stroke of {self.stroke:.4g}"),
            (f"lifting torque, net at {self.radius:g} m", self.net,
             f"of {self.load:.0f} kg, the most there, {self.height:.2f} m high"),
        ]  # fmt: skip
        if np.isfinite(self.slewing):
            rows.append(("slewing torque", self.slewing, "of its drive"))
        lines = ["", "| | kN m | |", "| --- | ---: | --- |"]
        lines += [f"| {name} | {torque / 1e3:.1f} | {words} |" for name, torque, words in rows]
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
    radius = as_number(radius, "the radius", "m", above=0.0)
    statics = Statics(machine, frame)
    places = Places(statics)
    joint = raiser(places)
    every = machine.driven_joints
    found = {
        x.joint: x for x in strengths(machine, every if raising is None else raising, friction)
    }
    if joint not in found:
        raise InputError(f"nothing limits '{joint}', give it a cylinder, or an effort in <limit>")
    i = machine.active.index(joint)
    pin = pivot(machine, statics.frame, i)
    column = machine.column(pin)
    home = machine.home[machine.closure.active]

    def torque(stroke: float) -> float:
        q_a = home.copy()
        q_a[i] = stroke
        rate = float(machine.closure.gamma(machine.closure.solve(q_a))[column, i])
        at = statics.at(machine.closure.solve(q_a)[None])
        lifts = at.under(machine.model.gravity.linear)[0, i] > 0
        return abs((found[joint].most if lifts else found[joint].least) / rate)

    strokes = np.linspace(places.low[i], places.high[i], _STEPS + 1)
    values = np.array([torque(x) for x in strokes])
    best = int(values.argmax())
    around = strokes[max(best - 1, 0)], strokes[min(best + 1, _STEPS)]
    finer = minimize_scalar(lambda x: -torque(x), bounds=around, method="bounded",
                            options={"xatol": 1e-9})  # fmt: skip
    coarse = float(values[best]), float(strokes[best])
    gross, stroke = max(coarse, (-float(finer.fun), float(finer.x)))
    slew = slewing(machine, statics.frame)
    turns = np.nan
    if slew is not None and machine.active[slew[0]] in found:
        drive = found[machine.active[slew[0]]]
        turns = min(drive.most, -drive.least)
    given = {
        "rule": rule,
        "raising": raising,
        "slews": slews,
        "slope": slope,
        "friction": friction,
    }
    load, height = _at(machine, statics.frame, radius, given, places.reach)
    weight = float(np.linalg.norm(machine.model.gravity.linear))
    return Torques(joint, pin, gross, stroke, radius, load, height, load * weight * radius, turns)


def _at(
    machine: Machine, frame: str, radius: float, given: dict[str, Any], reach: Array
) -> tuple[float, float]:
    """The largest load at a radius, and the height where it hangs."""
    low, high = reach.min(axis=0), reach.max(axis=0)
    if not low[0] <= radius <= high[0]:
        raise InputError(
            f"'{frame}' reaches from {low[0]:.3g} to {high[0]:.3g} m, not {radius:g} m"
        )
    heights = np.linspace(low[1], high[1], 61)
    for _ in range(3):  # finer and finer about the best
        chart = capacity(machine, frame, radii=[radius], heights=heights.tolist(), **given)
        least = np.nanmin(np.where(np.isnan(chart.loads), np.inf, chart.loads), axis=0)[:, 0]
        loads = np.where(np.isfinite(least), least, -np.inf)
        best = int(loads.argmax())
        step = heights[1] - heights[0]
        if step < _BESIDE * (high[1] - low[1]):
            break
        heights = np.linspace(heights[best] - step, heights[best] + step, 21)
    return float(loads[best]), float(heights[best])
