"""The largest load or force at every place, and what ends it."""

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import InputError
from crane.common.samples import Array, as_number, as_sample
from crane.common.shown import Brief
from crane.dynamics.statics import AtRest, Statics
from crane.machine import Machine
from crane.motion.workspaces.section import Section
from crane.ratings.actions import Action, slewed
from crane.ratings.causes import TIPS, Cause, Causes
from crane.ratings.places import Places
from crane.ratings.rules import Rule
from crane.ratings.slopes import EQUAL, field_slopes
from crane.ratings.strength import strengths
from crane.ratings.strokes import check_drives
from crane.recordings.timeseries import Table, write

_CELLS = {0: 100, 1: 75, 2: 40}  # of the larger extent at most, by how many strokes are free
_NICE = (1.0, 2.5, 5.0, 10.0)  # multiples of a quarter, for tables by 0.5, 1, 1.5 ... m
_DIGITS = 12  # behind the point of places
_MOST = 400  # cells along one axis


@dataclass(frozen=True, eq=False, repr=False)
class Field(Brief):
    """What is largest over reach and height.

    Attributes:
        machine: The machine.
        places: What is acted on, and how it gets anywhere.
        action: What acts on it, per magnitude.
        rule: By which it is rated.
        working: Joints whose drives work; others hold.
        slope: Of the ground [rad].
        friction: Whether drives that work overcome friction.
        weights: Whether the machine has its weight.
        radii: (a,) first coordinate of the section, as a rule the distance from the slewing axis
            [m].
        heights: (b,) second coordinate [m].
        slews: (s,) angles of the slewing joint [rad]; one, at home, where nothing slews.
        causes: What may end it.
        values: (s, b, a) magnitudes; NaN where the frame does not reach, infinite where nothing
            ends them.
        cause: (s, b, a) index of what ends it, the first of those that do together; -1 where
            nothing does.
        each: (s, b, a, K) magnitudes by cause.
        q_a: (s, b, a, n) active coordinates; of all that reach the place those of the largest.
    """

    machine: Machine
    places: Places
    action: Action
    rule: Rule
    working: tuple[str, ...]
    slope: float
    friction: bool
    weights: bool
    radii: Array
    heights: Array
    slews: Array
    causes: tuple[Cause, ...]
    values: Array
    cause: NDArray[np.intp]
    each: Array
    q_a: Array

    quantity: ClassVar[tuple[str, str]] = ("value", "1")

    @property
    def frame(self) -> str:
        """What is acted on."""
        return self.places.statics.frame

    @property
    def section(self) -> Section:
        """The plane of the places."""
        return self.places.section

    @property
    def ends(self) -> tuple[int, ...]:
        """Indices of the causes that are the first to end it somewhere."""
        return tuple(np.unique(self.cause[self.cause >= 0]).tolist())

    @property
    def together(self) -> NDArray[np.bool_]:
        """(s, b, a, K) which causes end it: several where the best posture balances them."""
        return _together(self.each, self.values)

    def slopes(self, names: Sequence[str]) -> Array:
        """Derivatives of the values by numbers of the machine, see `crane.ratings.slopes`.

        Args:
            names: Such as "boom_eye.x" or "cylinder.X_boom.area_a".

        Returns:
            (s, b, a, k) per unit of each.

        Raises:
            InputError: There is no such number, or it moves a support.
        """
        return field_slopes(self, names)

    def to_csv(self, path: str | Path) -> None:
        """Write a row per place: slew, place, value, cause, values by cause, active coordinates.

        Raises:
            OutputError: The file cannot be written.
        """
        machine, (name, unit) = self.machine, self.quantity
        units = {
            "slew": "rad", "radius": "m", "height": "m", name: unit, "cause": "1",
            **{f"{name}_{_short(cause)}": unit for cause in self.causes},
            **{joint: machine.unit(joint) for joint in machine.active},
        }  # fmt: skip
        s, b, a = np.nonzero(np.isfinite(self.values) | (self.cause >= 0))
        rows = np.column_stack(
            [self.slews[s], self.radii[a], self.heights[b], self.values[s, b, a],
             self.cause[s, b, a], self.each[s, b, a], self.q_a[s, b, a]]
        )  # fmt: skip
        rows[~np.isfinite(rows)] = np.nan
        notes = {"machine": machine.call, "frame": self.frame, **self.notes()}
        notes |= {f"cause {k}": str(cause) for k, cause in enumerate(self.causes)}
        write(path, Table(units, rows, notes))

    def slopes_to_csv(self, path: str | Path, names: Sequence[str]) -> None:
        """Write a row per place: slew, place, value, its derivatives by numbers; empty for none.

        Raises:
            InputError: See `slopes`.
            OutputError: The file cannot be written.
        """
        name, unit = self.quantity
        units = {"slew": "rad", "radius": "m", "height": "m", name: unit}
        units |= {f"{name}_by_{number}": f"{unit}/SI" for number in names}
        s, b, a = np.nonzero(np.isfinite(self.values))
        rows = np.column_stack(
            [self.slews[s], self.radii[a], self.heights[b], self.values[s, b, a],
             self.slopes(names)[s, b, a]]
        )  # fmt: skip
        notes = {"machine": self.machine.call, "frame": self.frame, **self.notes()}
        write(path, Table(units, rows, notes))

    def notes(self) -> dict[str, str]:
        """What else a file of it says above its table."""
        return {}


F = TypeVar("F", bound=Field)


def places_of(machine: Machine, frame: str | None) -> Places:
    """The places of a frame of a machine that one can rate.

    Raises:
        InputError: Its drives are not its active joints, or see `Places`.
    """
    return Places(Statics(check_drives(machine), frame))


def charted(
    kind: type[F],
    machine: Machine,
    places: Places,
    action: Action,
    rule: Rule,
    working: Collection[str],
    *,
    slope: float = 0.0,
    friction: bool = False,
    weights: bool = True,
    slews: Sequence[float] | None = None,
    step: float | None = None,
    radii: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
) -> F:
    """The field of an action.

    Args:
        kind: What it becomes.
        machine: The machine.
        places: Of the frame.
        action: What acts on it.
        rule: By which it is rated.
        working: Joints whose drives work; others hold.
        slope: Of the ground [rad].
        friction: Whether drives that work overcome friction.
        weights: Whether the machine has its weight.
        slews: See `capacity`; so the next ones.
        step: Between places [m].
        radii: In place of steps.
        heights: Likewise.

    Raises:
        InputError: See `capacity`.
    """
    statics = places.statics
    causes = Causes(statics, strengths(machine, working, friction), rule, action, slope, weights)
    axes = _axes(places, step, radii, heights)
    tips = any(cause.why == TIPS for cause in causes.all)
    turns = _slews(machine, places, slews, tips)
    found = places.all(axes)
    if not len(found.place):
        raise InputError(f"'{statics.frame}' reaches none of these places, give others")
    a, b, n, count = len(axes[0]), len(axes[1]), len(machine.active), len(causes.all)
    each, q_a = (
        np.full((len(turns), a * b, count), np.nan),
        np.full((len(turns), a * b, n), np.nan),
    )
    slew, active = places.section.slew, machine.closure.active
    angles = slewed(machine, statics.frame, places.section, turns)
    for k, turn in enumerate(turns):

        def values(q: Array, at: AtRest, turn: float = turn, angle: float = angles[k]) -> Array:
            if slew is not None and turn != machine.home[active[slew]]:
                q = q.copy()
                q[:, active[slew]] = turn
                at = statics.at(q)
            return causes.largest(at, np.full(len(q), angle), q)

        best, _ = places.best(found, axes, lambda q, at: values(q, at).min(axis=1))
        each[k, best.place] = values(best.q, best.at)
        q_a[k, best.place] = best.q[:, active]
        if slew is not None:
            q_a[k, best.place, slew] = turn
    reached = np.isfinite(q_a[..., 0])
    least = np.where(reached, np.where(np.isnan(each), np.inf, each).min(axis=2), np.nan)
    first = np.where(np.isfinite(least), _together(each, least).argmax(axis=2), -1)
    shape = (len(turns), b, a)
    return kind(
        machine, places, action, rule, tuple(working), slope, friction, weights, *axes, turns,
        causes.all, least.reshape(shape), first.reshape(shape), each.reshape(*shape, count),
        q_a.reshape(*shape, n),
    )  # fmt: skip


def _together(each: Array, least: Array) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        ends: NDArray[np.bool_] = each <= least[..., None] * (1 + EQUAL)
    return ends & np.isfinite(least)[..., None]


def _axes(
    places: Places,
    step: float | None,
    radii: Sequence[float] | None,
    heights: Sequence[float] | None,
) -> tuple[Array, Array]:
    """Coordinates of the places: multiples of a step within the reach, or those that are given."""
    low, high = places.reach.min(axis=0), places.reach.max(axis=0)
    if step is None:
        rough = float((high - low).max()) / _CELLS[len(places.others)]
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
            count = np.arange(np.floor(one / step), np.ceil(two / step) + 1)
            out.append(np.round(step * count, _DIGITS))  # 3.4, not 3.4000000000000004
            continue
        values = as_sample(given, len(given), name)
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
    turns = as_sample(slews, len(slews), "slews")
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
