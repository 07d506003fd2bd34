"""Rated loads over one stroke or two, the others held: lift curves and load zones."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from crane.common.errors import InputError, check_name
from crane.common.samples import Array, as_number
from crane.machine.machine import Machine
from crane.ratings.capacity_report import (
    capacity_facts,
    markdown_table,
    round_levels,
    slew_labels,
)
from crane.ratings.configuration_search import ConfigurationSet
from crane.ratings.lifting_capacity import RatingLoads, load_conditions
from crane.ratings.limiting_factors import TIPPING, RatingConditions
from crane.ratings.posture_search import PostureSearch, smallest_value
from crane.ratings.rating_chart import rate_postures
from crane.ratings.rating_rules import Rule
from crane.ratings.strokes import Strokes

_VALUE_COUNTS = {1: (65,), 2: (33, 17)}  # of each stroke, by how many there are
_TABLE_SIZES = 13, 9  # rows and columns
_BISECTIONS = 32  # of an interval in which a zone ends
_MAX_ZONES = 6
_ANGLE_DIGITS = 11  # decimal places; further ones are rounding errors


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class LiftChart(RatingLoads):
    """Rated loads over one stroke (a,) or two (b, a), the others held; see `RatingLoads`.

    Attributes:
        strokes: (b, a, k) their values; b = 1 for one stroke. The first rises with a.
        postures: Search for the postures: what is swept, and what is held.
        zones: Loads of zones [kg].
        positions: (b, a, 2) positions of the frame in its section, with the slew at home [m].
        angles: (b, a) angle of the frame's x axis above the horizontal [rad].
        holding_forces: (b, a, n) forces of the active joints without load, at home [N], [N m].
    """

    strokes: Array
    postures: PostureSearch
    zones: tuple[float, ...]
    positions: Array
    angles: Array
    holding_forces: Array

    @property
    def over(self) -> tuple[str, ...]:
        """Joints of the strokes."""
        return self.postures.over

    def _one_line(self) -> str:
        return f"{self._range_text()} {' and '.join(self.over)}, rule '{self.rule.name}'"

    def at_strokes(self, strokes: Array) -> "LiftChart":
        """Return the same ratings at other values (b, a, k) of the strokes."""
        slews = None if self.section.slewing_joint is None else self.slews.tolist()
        return _compute(self, self.postures, strokes, slews, self.zones)

    def least_load(
        self, slew_index: int = 0, only_tipping: bool = False
    ) -> tuple[float, "LiftChart"]:
        """Find the smallest load over one stroke, exactly: the rated one, or the tipping load.

        ISO 14397-1 rates a share of the tipping load at the largest reach of the lift, where it is
        about smallest, or what the hydraulics lift if that is less.

        Args:
            slew_index: Index among `slews`.
            only_tipping: Whether it is the whole load that tips the machine.

        Returns:
            The load [kg], infinite without a limit, and the chart of its single posture.
        """
        share = self.rule.tipping if only_tipping else 1.0
        chosen = [x.reason == TIPPING or not only_tipping for x in self.limiting_factors]

        def loads(chart: LiftChart) -> Array:
            by_factor = chart.values_by_factor[slew_index, 0][:, chosen]
            return np.asarray(by_factor.min(axis=1, initial=np.inf) / share)

        posture = self._smallest(loads)
        return float(loads(posture)[0]), posture

    def angle_range(self) -> tuple[float, float]:
        """Return the smallest and the largest angle of the frame over one stroke [rad].

        Their difference is the error of self-levelling over the lift.
        """
        low = self._smallest(lambda x: x.angles[0])
        high = self._smallest(lambda x: -x.angles[0])
        return float(low.angles[0, 0]), float(high.angles[0, 0])

    def _smallest(self, measure: Callable[["LiftChart"], Array]) -> "LiftChart":
        def at(values: Array) -> LiftChart:
            return self.at_strokes(values[None, :, None])

        return at(np.array([smallest_value(lambda x: measure(at(x)), self.strokes[0, :, 0])[1]]))

    @cached_property
    def zone_edges(self) -> Array:
        """(s, z, a) values of the second of two strokes that end the zones of rated loads.

        Over each value of the first stroke, a zone goes from the smallest value of the second one
        to the first at which less than the load is rated; NaN where the zone is empty.
        """
        edges = [[self._zone_edge(k, load) for load in self.zones] for k in range(len(self.slews))]
        return np.array(edges).reshape(len(self.slews), len(self.zones), -1)

    def _zone_edge(self, slew_index: int, load: float) -> Array:
        # bisects the first interval in which the load passes; NaN, out of reach, is less
        is_less = np.logical_not(self.values[slew_index] >= load)
        last = np.where(is_less.any(axis=0), is_less.argmax(axis=0), len(is_less) - 1)
        ends = np.stack([np.maximum(last - 1, 0), last]), np.arange(len(last))
        inner, outer = self.strokes[..., 1][ends]
        for _ in range(_BISECTIONS):
            middle = (inner + outer) / 2
            chart = self.at_strokes(np.stack([self.strokes[0, :, 0], middle], axis=-1)[None])
            is_inside = chart.values[slew_index, 0] >= load
            inner, outer = np.where(is_inside, middle, inner), np.where(is_inside, outer, middle)
        return np.where(is_less[0], np.nan, np.where(is_less.any(axis=0), inner, outer))

    def boom_angles(self) -> Array:
        """(a,) angles above the horizontal of the second stroke's way, as a telescope's [rad]."""
        ways = self.positions[-1] - self.positions[0]
        return np.arctan2(ways[:, 1], ways[:, 0])

    def _places(self, b: Any, a: Any) -> dict[str, tuple[str, Array]]:
        active, unit = self.machine.active, self.machine.unit
        forces = zip(active, self.holding_forces[b, a].T, strict=True)
        return {
            "radius": ("m", self.positions[b, a, 0]), "height": ("m", self.positions[b, a, 1]),
            "angle": ("rad", self.angles[b, a]),
            **{f"force_{x}": ("N" if unit(x) == "m" else "N m", force) for x, force in forces},
        }  # fmt: skip

    def facts(self) -> list[tuple[str, str]]:
        """Return the conditions as (name, text)."""
        held = ", ".join(f"{x} = {value:.4g}" for x, value in self.postures.at.items())
        over = ("over", " and ".join(self.over)), ("held", held or "all at home")
        return [*capacity_facts(self), *over]

    def to_markdown(self) -> str:
        """Return the conditions, the loads and, over one stroke, the smallest ones as Markdown."""
        tables = self._curve_tables() if len(self.over) == 1 else self._chart_tables()
        return "\n".join([
            f"# Lift chart of {self.machine.name}\n",
            *(f"- {x}: {text}" for x, text in self.facts()), "",
            *tables, "\n* limited by drives or pins, all others by tipping\n",
        ])  # fmt: skip

    def _cell(self, k: int, b: int, a: int) -> str:
        factor = self.limiting_factors[self.limiting_factor_index[k, b, a]]
        mark = "" if factor.reason == TIPPING else "*"
        return f"{self.values[k, b, a] // 1:.0f}{mark}".replace("nan*", "").replace("inf*", "∞")

    def _curve_tables(self) -> list[str]:
        labels, unit = slew_labels(self), self.machine.unit(self.over[0])
        forces = self.holding_forces[0, :, self.machine.active.index(self.over[0])] / 1e3
        columns = np.column_stack(
            [self.strokes[0, :, 0], self.positions[0], np.rad2deg(self.angles[0]), forces]
        )
        head = [f"{self.over[0]} [{unit}]", *(f"{x} [m]" for x in self.section.coordinate_names)]
        rows = [[*(f"{x:.3f}" for x in columns[a]),
                 *(self._cell(k, 0, a) for k in range(len(labels)))]
                for a in _spread(len(columns), _TABLE_SIZES[0])]  # fmt: skip
        least = [
            [f"{name} {label}".strip(), f"{load // 1:.0f}", f"{x.strokes[0, 0, 0]:.4g}",
             *(f"{y:.3f}" for y in x.positions[0, 0])]
            for k, label in enumerate(labels) for name, tips in (("rated", False), ("tips", True))
            for load, x in [self.least_load(k, tips)] if np.isfinite(load)
        ]  # fmt: skip
        low, high = np.rad2deg(self.angle_range())
        return [
            *markdown_table([*head, "angle [deg]", f"holds [kN{' m' * (unit == 'rad')}]",
                             *(f"load [kg] {x}".strip() for x in labels)], rows),
            "", *markdown_table(["smallest load", "kg", *head], least),
            f"\nThe angle goes from {low:.3f}° to {high:.3f}°: {high - low:.3f}° over the stroke.",
        ]  # fmt: skip

    def _chart_tables(self) -> list[str]:
        # for each slew angle the loads, and where the second stroke ends the zones
        lines, second = list[str](), _spread(self.strokes.shape[0], _TABLE_SIZES[1])
        first = _spread(self.strokes.shape[1], _TABLE_SIZES[0])
        names = [f"{self.strokes[0, a, 0]:.4g} ({x:.1f}°)"
                 for a, x in enumerate(np.rad2deg(self.boom_angles()))]  # fmt: skip
        for k, label in enumerate(slew_labels(self)):
            loads = [[names[a], *(self._cell(k, b, a) for b in second)]
                     for a in first]  # fmt: skip
            edges = [[names[a], *(f"{x[a]:.4g}".replace("nan", "") for x in self.zone_edges[k])]
                     for a in first]  # fmt: skip
            lines += [
                f"\n{label} loads in kg by {self.over[1]}:\n".lstrip(" "),
                *markdown_table([self.over[0], *(f"{self.strokes[b, 0, 1]:.4g}" for b in second)],
                                loads),
                f"\n{label} {self.over[1]} up to which loads are rated:\n".lstrip(" "),
                *markdown_table([self.over[0], *(f"{x:g} kg" for x in self.zones)], edges),
            ]  # fmt: skip
        return lines


def _spread(count: int, most: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, most).round().astype(int)).tolist()


def lift_chart(
    machine: Machine,
    over: Sequence[str] | None = None,
    frame: str | None = None,
    *,
    at: Mapping[str, float] | None = None,
    zones: Sequence[float] | None = None,
    rule: str | Rule = "none",
    raising: Collection[str] | None = None,
    slews: Sequence[float] | None = None,
    slope: float = 0.0,
    friction: bool = False,
) -> LiftChart:
    """Compute the largest load that a machine holds at rest, over one stroke or two.

    One stroke gives the lift curve of a loader, a lift or a platform; two give the chart of a
    telehandler over boom and extension, with zones of equal rated load. The limits are those of
    `capacity`; a machine whose supports turn with the slewing joint, as with an articulated frame,
    is also rated as far as that joint turns.

    Args:
        machine: A machine with hydraulics, or with `effort` limits in its URDFs.
        over: One or two active joints; by default the only one that moves the frame.
        frame: Link at which the load hangs; the tip by default.
        at: What is held: coordinates of active joints, "angle" [rad] and "height" [m] of the
            frame, see `PostureSearch`; all else stays at home.
        zones: Loads of zones over two strokes; by default round ones [kg].
        rule: See `capacity`.
        raising: See `capacity`.
        slews: See `capacity`.
        slope: See `capacity`.
        friction: See `capacity`.

    Raises:
        InputError: A joint does not move the frame, is given twice, or three are; zones are given
            over one stroke; there is no such posture; or as `capacity`.
    """
    places = Strokes(machine, frame)
    machine, names = places.machine, [places.machine.active[i] for i in places.moving]
    if over is None:
        over = names
    for name in over:
        check_name(name, names, f"'{name}' does not move '{places.statics.frame}'")
    if len(over) not in _VALUE_COUNTS:
        raise InputError(
            f"a lift chart takes one stroke or two, not {', '.join(over) or 'none'}: name them "
            "with --over, or lock the others"
        )
    if zones is not None and len(over) == 1:
        raise InputError(f"zones are over two strokes, not over '{over[0]}' alone, leave them out")
    conditions = load_conditions(places, rule, raising, slope, friction)
    indices = [machine.active.index(x) for x in over]
    counts = _VALUE_COUNTS[len(over)]
    axes = [
        np.linspace(places.low[i], places.high[i], n) for i, n in zip(indices, counts, strict=True)
    ]
    strokes = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, counts[0], len(over))
    chart = _compute(conditions, PostureSearch(places, at or {}, over), strokes, slews, ())
    if zones is None:
        loads = chart.loads[np.isfinite(chart.loads) & (chart.loads > 0)]
        zones = round_levels(loads, _MAX_ZONES)
    zones = [as_number(x, "the load of a zone", "kg", greater_than=0.0) for x in zones]
    return replace(chart, zones=tuple(zones))


def _compute(
    conditions: RatingConditions,
    postures: PostureSearch,
    strokes: Array,
    slews: Sequence[float] | None,
    zones: tuple[float, ...],
) -> LiftChart:
    places, machine, grid = conditions.places, conditions.machine, strokes.shape[:2]
    q, is_found = postures.configurations(strokes.reshape(-1, len(postures.over)))
    if not is_found.any():
        raise InputError(
            f"'{conditions.frame}' reaches no such posture over {' and '.join(postures.over)}: "
            "hold other strokes, or another angle or height"
        )
    best = ConfigurationSet(
        np.flatnonzero(is_found), q[is_found], places.statics.evaluate(q[is_found])
    )
    rows = np.full((len(q), 3 + len(machine.active)), np.nan)
    rows[is_found] = np.column_stack([
        places.section.coordinates(best.statics.tip_positions),
        np.round(postures.angles(best.q), _ANGLE_DIGITS) + 0.0,
        best.statics.holding_forces(np.array(machine.gravity)),
    ])  # fmt: skip
    rows = rows.reshape(*grid, -1)
    return LiftChart(
        **rate_postures(conditions, grid, lambda _: best, slews), strokes=strokes,
        postures=postures, zones=zones, positions=rows[..., :2], angles=rows[..., 2],
        holding_forces=rows[..., 3:],
    )  # fmt: skip
