"""Lifting capacity: the largest load at every place, and what ends it."""

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.samples import Array, Brief, as_number
from crane.dynamics.statics import AtRest, Statics
from crane.machine import Machine
from crane.motion.workspaces.section import Section
from crane.ratings.causes import Cause, Causes
from crane.ratings.places import Places
from crane.ratings.pressures import chamber_pressures
from crane.ratings.rules import Rule, rule_of
from crane.ratings.slopes import load_slopes
from crane.ratings.strength import strengths
from crane.ratings.tables import LoadTable, load_table
from crane.ratings.words import to_markdown
from crane.recordings.timeseries import Table, write

_CELLS = 50  # about how many the larger extent is divided into
_NICE = (1.0, 2.0, 2.5, 5.0, 10.0)
_MOST = 400  # cells along one axis
_STEEPEST = np.deg2rad(45.0)


@dataclass(frozen=True, eq=False, repr=False)
class Capacity(Brief):
    """Rated loads over reach and height.

    Attributes:
        machine: The machine.
        frame: Where the load hangs.
        section: The plane of the places.
        rule: By which it is rated.
        raising: Joints whose drives raise the load; others hold.
        slope: Of the ground [rad].
        friction: Whether drives that raise overcome friction.
        radii: (a,) first coordinate of the section, as a rule the distance from the slewing axis
            [m].
        heights: (b,) second coordinate [m].
        slews: (s,) angles of the slewing joint [rad]; one, at home, where nothing slews.
        causes: What may end a load.
        loads: (s, b, a) rated loads [kg]; NaN where the frame does not reach, infinite where
            nothing ends it.
        cause: (s, b, a) index of what ends it, -1 where nothing does.
        each: (s, b, a, K) rated loads by cause.
        q_a: (s, b, a, n) active coordinates; of all that reach the place those that carry most.
    """

    machine: Machine
    frame: str
    section: Section
    rule: Rule
    raising: tuple[str, ...]
    slope: float
    friction: bool
    radii: Array
    heights: Array
    slews: Array
    causes: tuple[Cause, ...]
    loads: Array
    cause: NDArray[np.intp]
    each: Array
    q_a: Array

    @property
    def ends(self) -> tuple[int, ...]:
        """Indices of the causes that end a load somewhere."""
        return tuple(np.unique(self.cause[self.cause >= 0]).tolist())

    def slopes(self, names: Sequence[str]) -> Array:
        """Derivatives of the loads by numbers of the machine, see `crane.ratings.slopes`.

        Args:
            names: Such as "boom_eye.x" or "cylinder.X_boom.area_a".

        Returns:
            (s, b, a, k) [kg] per unit of each.

        Raises:
            InputError: There is no such number, or it moves a support.
        """
        return load_slopes(self, names)

    def pressures(self) -> dict[str, Array]:
        """Pressures that hold the rated loads, see `crane.ratings.pressures`.

        Returns:
            By joint (s, b, a, 2) of its chambers A and B [Pa].
        """
        return chamber_pressures(self)

    @cached_property
    def table(self) -> LoadTable:
        """Its table at round steps, as manuals print it."""
        return load_table(self)

    def at_places(self, radii: Sequence[float], heights: Sequence[float]) -> "Capacity":
        """The same at other places, see `capacity`."""
        slews = None if self.section.slew is None else self.slews.tolist()
        return capacity(
            self.machine, self.frame, rule=self.rule, raising=self.raising, slews=slews,
            slope=self.slope, friction=self.friction, radii=radii, heights=heights,
        )  # fmt: skip

    def to_markdown(self) -> str:
        """What the loads hold for, their table as manuals print it, and what ends them."""
        return to_markdown(self)

    def to_csv(self, path: str | Path) -> None:
        """Write a row per place: slew, place, load, cause, loads by cause, active coordinates.

        Raises:
            OutputError: The file cannot be written.
        """
        machine = self.machine
        units = {
            "slew": "rad", "radius": "m", "height": "m", "load": "kg", "cause": "1",
            **{f"load_{_short(cause)}": "kg" for cause in self.causes},
            **{joint: machine.unit(joint) for joint in machine.active},
        }  # fmt: skip
        s, b, a = np.nonzero(np.isfinite(self.loads) | (self.cause >= 0))
        rows = np.column_stack(
            [self.slews[s], self.radii[a], self.heights[b], self.loads[s, b, a],
             self.cause[s, b, a], self.each[s, b, a], self.q_a[s, b, a]]
        )  # fmt: skip
        rows[~np.isfinite(rows)] = np.nan
        notes = {"machine": machine.call, "frame": self.frame, "rule": self.rule.says}
        notes |= {f"cause {k}": str(cause) for k, cause in enumerate(self.causes)}
        write(path, Table(units, rows, notes))


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
    its closed valve holds, or a motor's torque; tipping over each line between its supports. What
    the machine carries already belongs to it. Where several postures reach a place it is the one
    that carries most.

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
        InputError: An unknown rule, frame or joint, nothing that limits a load, or a frame that
            two to four strokes do not move in a plane through the slewing axis.
    """
    rule = rule_of(rule) if isinstance(rule, str) else rule
    slope = max(abs(as_number(slope, "the slope", "rad", most=_STEEPEST)), rule.slope)
    if machine.motors and any(
        drive.name not in machine.active or len(drive.factors) > 1 for drive in machine.motors
    ):
        raise InputError(
            f"the drives of '{machine.name}' are not its active joints, choose them: --active"
        )
    statics = Statics(machine, frame)
    places = Places(statics)
    if raising is None:
        raising = [raiser(places)] if rule.raises else machine.driven_joints
    causes = Causes(statics, strengths(machine, raising, friction), rule, slope)
    axes = _axes(places, step, radii, heights)
    turns = _slews(machine, places, slews, tips=len(causes.all) > len(machine.driven_joints))
    found = places.all(axes)
    if not len(found.place):
        raise InputError(f"'{statics.frame}' reaches none of these places, give others")
    a, b, n, count = len(axes[0]), len(axes[1]), len(machine.active), len(causes.all)
    each, q_a = (
        np.full((len(turns), a * b, count), np.nan),
        np.full((len(turns), a * b, n), np.nan),
    )
    slew, active = places.section.slew, machine.closure.active
    for k, turn in enumerate(turns):

        def loads(q: Array, at: AtRest, turn: float = turn) -> Array:
            if slew is not None and turn != machine.home[active[slew]]:
                q = q.copy()
                q[:, active[slew]] = turn
                at = statics.at(q)
            return causes.loads(at)

        best, _ = places.best(found, axes, lambda q, at: loads(q, at).min(axis=1))
        each[k, best.place] = loads(best.q, best.at)
        q_a[k, best.place] = best.q[:, active]
        if slew is not None:
            q_a[k, best.place, slew] = turn
    reached = np.isfinite(q_a[..., 0])
    least = np.where(reached, np.where(np.isnan(each), np.inf, each).min(axis=2), np.nan)
    first = np.where(np.isfinite(least), np.nan_to_num(each, nan=np.inf).argmin(axis=2), -1)
    shape = (len(turns), b, a)
    return Capacity(
        machine, statics.frame, places.section, rule, tuple(raising), slope, friction, *axes,
        turns, causes.all, least.reshape(shape), first.reshape(shape),
        each.reshape(*shape, count), q_a.reshape(*shape, n),
    )  # fmt: skip


def raiser(places: Places) -> str:
    """The drive that carries most: whose stroke moves the machine's first moment farthest."""
    machine, strokes = places.machine, [*places.pair, *places.others]
    at = places.statics.at(machine.home[None])
    moved = np.linalg.norm(at.slopes[0], axis=0) * (places.high - places.low)
    return machine.active[max(strokes, key=lambda i: moved[i])]


def _axes(
    places: Places,
    step: float | None,
    radii: Sequence[float] | None,
    heights: Sequence[float] | None,
) -> tuple[Array, Array]:
    """Coordinates of the places: multiples of a step within the reach, or those that are given."""
    low, high = places.reach.min(axis=0), places.reach.max(axis=0)
    if step is None:
        rough = float((high - low).max()) / _CELLS
        power = 10.0 ** np.floor(np.log10(rough))
        step = float(power * next(x for x in _NICE if x * power >= rough))
    step = as_number(step, "the step", "m", above=0.0)
    if float((high - low).max()) / step > _MOST:
        raise InputError(
            f"a step of {step:g} m divides {float((high - low).max()):.3g} m into more than "
            f"{_MOST} cells, give a larger one"
        )
    out = []
    for given, name, one, two in zip(
        (radii, heights), ("radii", "heights"), low, high, strict=True
    ):
        if given is None:
            out.append(step * np.arange(np.floor(one / step), np.ceil(two / step) + 1))
            continue
        values = np.array(given, dtype=float).ravel()
        if not len(values) or not np.isfinite(values).all() or (np.diff(values) <= 0).any():
            raise InputError(f"{name} must be numbers that rise [m]")
        out.append(values)
    return out[0], out[1]


def _slews(machine: Machine, places: Places, slews: Sequence[float] | None, tips: bool) -> Array:
    """Angles of the slewing joint."""
    slew = places.section.slew
    home = 0.0 if slew is None else float(machine.home[machine.closure.active[slew]])
    if slews is None:
        quarter = home + np.pi / 2
        fits = slew is not None and tips and places.low[slew] <= quarter <= places.high[slew]
        return np.array([home, quarter] if fits else [home])
    if slew is None:
        raise InputError(f"nothing slews '{machine.name}', leave slews out")
    turns = np.array(slews, dtype=float).ravel()
    if not len(turns) or not np.isfinite(turns).all():
        raise InputError("slews must be angles [rad]")
    for turn in turns:
        if not places.low[slew] <= turn <= places.high[slew]:
            raise InputError(
                f"'{machine.active[slew]}' turns from {places.low[slew]:.4g} to "
                f"{places.high[slew]:.4g} rad, not to {turn:.4g}"
            )
    return turns


def _short(cause: Cause) -> str:
    return "_".join(itertools.chain(cause.why.split(), cause.what.split()))
