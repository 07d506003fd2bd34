"""What can be measured of a variant, and how it changes with the numbers that vary."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import minimize

from crane.common.errors import CraneError, InputError, known
from crane.common.samples import Array
from crane.dynamics import Dynamics
from crane.dynamics.statics import Statics
from crane.formats.loading import Variants
from crane.machine import Machine
from crane.motion.workspaces.section import upwards
from crane.ratings import capacity, torques
from crane.ratings.places import Places
from crane.ratings.rules import Rule
from crane.studies.design.dual import FUNCTIONS, Dual, constant
from crane.studies.design.expressions import Expression
from crane.studies.design.own import Measure, measured
from crane.studies.measures import of_strokes, of_task, stroke_measures, task_measures, together

_STEP = 1e-4  # of a number's range, of differences
_STARTS = 6  # of the search for an extreme of the tip
_CHARTS = {"load": (2, 3), "nearest": (3, 3), "net_torque": (1, 1), "number": (1, 1)}
_CHART_UNITS = {"load": "kg", "nearest": "m", "net_torque": "N m", "number": ""}
PLAIN = {
    "highest": "m", "lowest": "m", "mass": "kg", "gross_torque": "N m", "slewing_torque": "N m",
}  # fmt: skip


@dataclass(frozen=True)
class Terms:
    """What measures are taken with.

    Attributes:
        frame: Where loads hang; the tip if None.
        rule: Of `load` and `net_torque`.
        tasks: Of peak_JOINT and its like.
        own: Functions of a user's own.
    """

    frame: str | None = None
    rule: str | Rule = "none"
    tasks: tuple[str, ...] = ()
    own: Mapping[str, Measure] = field(default_factory=dict)


class Point:
    """A variant: its measures, and their slopes by the numbers that vary.

    Slopes of `load`, reach, highest, lowest, `nearest` and mass are exact, through the closed
    loops; those of all else central differences of variants beside it.

    Args:
        variants: Of the machine.
        names: Numbers that vary, in order.
        values: (k,) theirs.
        ranges: (k,) their ranges, to measure steps by.
        terms: What measures are taken with.
        places: All arguments of `load` that will be asked for, to be computed together.

    Raises:
        CraneError: No machine can be made with them.
    """

    def __init__(
        self,
        variants: Variants,
        names: Sequence[str],
        values: Array,
        ranges: Array,
        terms: Terms,
        places: Sequence[tuple[float, ...]] = (),
    ):
        self._variants, self._names, self._values = variants, list(names), values
        self._ranges, self._terms, self._places = ranges, terms, list(places)
        self.machine = variants.machine(dict(zip(names, values.tolist(), strict=True)))
        self._known: dict[tuple[Any, ...], float] = {}
        self._loads: dict[tuple[bool, tuple[float, ...]], Dual] = {}

    def value(self, expression: Expression) -> float:
        """Of an expression."""
        return float(expression(self._number, self._call))

    def dual(self, expression: Expression) -> Dual:
        """Of an expression, with its slopes."""
        count = len(self._names)

        def named(name: str) -> Dual:
            return self._sloped(name, ())

        def called(name: str, arguments: tuple[Any, ...]) -> Dual:
            if name in FUNCTIONS:
                return FUNCTIONS[name](*arguments)
            plain = [x.value if isinstance(x, Dual) else x for x in arguments]
            return self._sloped(name, tuple(plain))

        found = expression(named, called, lambda x: constant(x, count))
        return found if isinstance(found, Dual) else constant(float(found), count)

    def _number(self, name: str) -> float:
        return self._measure(name, ())

    def _call(self, name: str, arguments: tuple[Any, ...]) -> float:
        if name in FUNCTIONS:
            plain = [constant(x, 0) for x in arguments]
            return FUNCTIONS[name](*plain).value
        return self._measure(name, arguments)

    def _sloped(self, name: str, arguments: tuple[Any, ...]) -> Dual:
        """A measure with its slopes."""
        if name == "load":
            return self._load(arguments)
        if name in ("reach", "highest", "lowest", "nearest"):
            value, q = self._extreme(name, arguments)
            return Dual(value, self._tip_slopes(name, arguments, q))
        if name == "mass":
            rows = self._statics.by_numbers(self._home, self._names) if self._names else None
            slopes = np.zeros(0) if rows is None else rows.mass[0]
            return Dual(self._measure(name, ()), slopes)
        if name == "number" or (name in self._variants.values and not arguments):
            number = str(arguments[0]) if name == "number" else name
            slopes = np.array([float(number == other) for other in self._names])
            return Dual(self._measure(name, arguments), slopes)
        return Dual(self._measure(name, arguments), self._differences(name, arguments))

    def _differences(self, name: str, arguments: tuple[Any, ...]) -> Array:
        """Central differences of a measure, one-sided where one side cannot be made."""
        here = self._measure(name, arguments)
        out = np.zeros(len(self._names))
        for i, step in enumerate(_STEP * self._ranges):
            found = []
            for sign in (1.0, -1.0):
                try:
                    found.append((sign, self._beside(i, sign * step)._measure(name, arguments)))
                except CraneError:
                    found.append((0.0, here))
            (one, above), (two, below) = found
            if one == two:
                raise InputError(f"'{name}' cannot be followed as '{self._names[i]}' varies")
            out[i] = (above - below) / ((one - two) * step)
        return out

    def _beside(self, i: int, step: float) -> "Point":
        key = i, step
        if key not in self._neighbours:
            values = self._values.copy()
            values[i] += step
            self._neighbours[key] = Point(
                self._variants, self._names, values, self._ranges, self._terms, self._places
            )
        return self._neighbours[key]

    @cached_property
    def _neighbours(self) -> dict[tuple[int, float], "Point"]:
        return {}

    def _measure(self, name: str, arguments: tuple[Any, ...]) -> float:
        key = name, *arguments
        if key not in self._known:
            self._known[key] = float(self._measured(name, arguments))
        return self._known[key]

    def _measured(self, name: str, arguments: tuple[Any, ...]) -> float:
        machine = self.machine
        if name == "load":
            return self._load(arguments, False).value
        if name in ("reach", "highest", "lowest", "nearest"):
            return self._extreme(name, arguments)[0]
        if name == "net_torque":
            return torques(
                machine, self._terms.frame, radius=arguments[0], rule=self._terms.rule
            ).net
        if name in ("gross_torque", "slewing_torque"):
            found = torques(
                machine, self._terms.frame, rule=self._terms.rule, radius=self._some_radius
            )
            return found.gross if name == "gross_torque" else found.slewing
        if name == "mass":
            return float(self._statics.at(self._home).mass[0])
        if name == "number":
            return self._numbered(str(arguments[0]))
        if name in self._terms.own:
            return measured(name, self._terms.own[name], machine)
        if name in self._task_measures:
            return self._of_tasks[name]
        if name in stroke_measures(machine):
            if name not in self._of_strokes:
                raise InputError(f"'{name}' has no value: no posture closes")
            return self._of_strokes[name]
        return self._numbered(name)

    def _numbered(self, name: str) -> float:
        if name in self._names:
            return float(self._values[self._names.index(name)])
        if name in self._variants.values:
            return float(self._variants.values[name])
        raise InputError(
            f"measure '{name}' is unknown, {known(available(self.machine, self._terms.own), name)}"
        )

    @cached_property
    def _statics(self) -> Statics:
        return Statics(self.machine, self._terms.frame)

    @cached_property
    def _tip(self) -> Places:
        return Places(self._statics)

    @property
    def _home(self) -> Array:
        return self.machine.home[None]

    @cached_property
    def _some_radius(self) -> float:
        return float(np.median(self._tip.reach[:, 0]))

    @cached_property
    def _task_measures(self) -> dict[str, str]:
        return task_measures(self.machine)

    @cached_property
    def _of_tasks(self) -> dict[str, float]:
        if not self._terms.tasks:
            raise InputError(f"'{self.machine.name}' has no task to measure it with")
        dynamics = Dynamics(self.machine)
        return together([of_task(self.machine, dynamics, x) for x in self._terms.tasks])

    @cached_property
    def _of_strokes(self) -> dict[str, float]:
        return of_strokes(self.machine)

    def _load(self, place: tuple[float, ...], sloped: bool = True) -> Dual:
        """The rated load at a place, 0 where it is out of reach; with its slopes if asked for."""
        if (sloped, place) not in self._loads:
            every = [place, *(x for x in self._places if (sloped, x) not in self._loads)]
            slews = sorted({x[2] for x in every if len(x) == 3})
            for slew in [None, *slews]:
                here = [x for x in every if (x[2] if len(x) == 3 else None) == slew]
                if here:
                    self._charted(here, slew, sloped)
        return self._loads[sloped, place]

    def _charted(
        self, places: Sequence[tuple[float, ...]], slew: float | None, sloped: bool
    ) -> None:
        radii, heights = (sorted({x[i] for x in places}) for i in (0, 1))
        nothing = constant(0.0, len(self._names))
        try:
            chart = capacity(
                self.machine, self._terms.frame, rule=self._terms.rule, radii=radii,
                heights=heights, slews=None if slew is None else [np.deg2rad(slew)],
            )  # fmt: skip
        except InputError as error:
            if "reaches none" not in str(error):
                raise
            self._loads |= {(sloped, place): nothing for place in places}
            return
        slopes = chart.slopes(self._names) if sloped else None
        for place in places:
            a, b = radii.index(place[0]), heights.index(place[1])
            loads = np.nan_to_num(chart.loads[:, b, a], nan=0.0)
            s = int(loads.argmin())
            if not np.isfinite(loads[s]):
                raise InputError(f"nothing ends the load at {place}, ask for another place")
            slope = nothing.slopes
            if slopes is not None and loads[s] > 0:
                slope = slopes[s, b, a]
                if np.isnan(slope).any():  # where a pin ends it
                    slope = self._differences("load", place)
            self._loads[sloped, place] = Dual(float(loads[s]), slope)

    def _extreme(self, name: str, arguments: tuple[Any, ...]) -> tuple[float, Array]:
        """Largest reach or height, lowest depth, or distance to a point, and its posture."""
        key = name, *arguments
        if key not in self._extremes:
            self._extremes[key] = self._sought(name, arguments)
        return self._extremes[key]

    @cached_property
    def _extremes(self) -> dict[tuple[Any, ...], tuple[float, Array]]:
        return {}

    def _goal(self, name: str, arguments: tuple[Any, ...], tip: Array) -> tuple[Array, Array]:
        """What is the least at the extreme, (N,), and its slopes by the tip (N, 3)."""
        if name == "nearest":
            away = tip - np.array(arguments, dtype=float)
            length = np.linalg.norm(away, axis=1)
            return length, away / np.maximum(length, 1e-300)[:, None]
        up = upwards(self.machine)
        rises = tip @ up
        if name in ("highest", "lowest"):
            sign = -1.0 if name == "highest" else 1.0
            return sign * rises, np.broadcast_to(sign * up, tip.shape)
        across = tip - rises[:, None] * up
        length = np.linalg.norm(across, axis=1)
        return -length, -across / np.maximum(length, 1e-300)[:, None]

    def _sought(self, name: str, arguments: tuple[Any, ...]) -> tuple[float, Array]:
        """From the best of the postures all over the strokes, by their exact slopes."""
        places, closure = self._tip, self.machine.closure
        strokes = places.moving
        columns = closure.active[strokes]
        low, span = places.low[strokes], (places.high - places.low)[strokes]
        values = self._goal(name, arguments, places.statics.at(places.postures).tip)[0]
        order = np.argsort(values, kind="stable")
        best, found = np.inf, places.postures[order[0]]
        for first in order[:: max(1, len(order) // 50)][:_STARTS].tolist():
            start = places.postures[first]
            last = [start]

            def cost(x: Array, last: list[Array] = last) -> tuple[float, Array]:
                q = last[0].copy()
                q[columns] = low + x * span
                closed, good = places.statics.closed(q[None])
                if not good[0]:
                    return 1e6, np.zeros(len(x))
                last[0] = closed[0]
                at = places.statics.at(closed)
                value, slope = self._goal(name, arguments, at.tip)
                return float(value[0]), (slope[0] @ at.ways[0][:, strokes]) * span

            ended = minimize(
                cost, (start[columns] - low) / span, jac=True, method="L-BFGS-B",
                bounds=[(0.0, 1.0)] * len(strokes), options={"ftol": 1e-15, "gtol": 1e-10},
            )  # fmt: skip
            cost(ended.x)
            if ended.fun < best:
                best, found = float(ended.fun), last[0]
        sign = -1.0 if name in ("reach", "highest") else 1.0
        return sign * best, found

    def _tip_slopes(self, name: str, arguments: tuple[Any, ...], q: Array) -> Array:
        """By the envelope theorem: those at the posture of the extreme, held."""
        if not self._names:
            return np.zeros(0)
        by = self._statics.by_numbers(q[None], self._names).tip[0]
        _, slope = self._goal(name, arguments, self._statics.at(q[None]).tip)
        sign = -1.0 if name in ("reach", "highest") else 1.0
        return np.asarray(sign * slope[0] @ by)


def available(machine: Machine, own: Mapping[str, Measure]) -> dict[str, str]:
    """All measures and functions of a machine, and their units."""
    return {
        **task_measures(machine), **stroke_measures(machine), **PLAIN, **_CHART_UNITS,
        **dict.fromkeys(own, ""),
    }  # fmt: skip


def refuse_taken(own: Mapping[str, Measure], available: Mapping[str, str]) -> None:
    """Refuse functions of a user's own that are called like a measure.

    Raises:
        InputError: One is.
    """
    for name in own:
        if name in available or name in PLAIN or name in _CHARTS or name in FUNCTIONS:
            raise InputError(f"a measure '{name}' is there already, call your own otherwise")


def places_in(expressions: Sequence[Expression]) -> list[tuple[float, ...]]:
    """All arguments of `load` that are plain numbers."""
    found: list[tuple[float, ...]] = []

    def named(name: str) -> float:
        if name in _CHARTS or name in FUNCTIONS:
            raise InputError(f"'{name}' is a function, write {name}(...)")
        return 1.0

    def called(name: str, arguments: tuple[Any, ...]) -> float:
        _check(name, arguments)
        if name == "load" and all(isinstance(x, float) for x in arguments):
            found.append(arguments)
        return 1.0

    for expression in expressions:
        expression(named, called)
    return list(dict.fromkeys(found))


def _check(name: str, arguments: tuple[Any, ...]) -> None:
    """Refuse functions that are not there, or with other arguments."""
    if name not in FUNCTIONS and name not in _CHARTS:
        raise InputError(f"function '{name}' is unknown, {known([*_CHARTS, *FUNCTIONS], name)}")
    words = [x for x in arguments if isinstance(x, str)]
    if words and name != "number":
        raise InputError(f"'{name}' takes numbers, not '{words[0]}'")
    if name in FUNCTIONS:
        if not arguments or (len(arguments) > 1 and name not in ("min", "max")):
            count = "arguments" if name in ("min", "max") else "one argument"
            raise InputError(f"'{name}' takes {count}, not {len(arguments)}")
        return
    least, most = _CHARTS[name]
    if not least <= len(arguments) <= most:
        count = f"{least}" if least == most else f"{least} or {most}"
        raise InputError(f"'{name}' takes {count} arguments, not {len(arguments)}")
