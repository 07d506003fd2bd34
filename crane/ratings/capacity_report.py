"""Rated loads as a table and as text: conditions, limits, limiting factors."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import SingularConfigurationError
from crane.common.samples import Array
from crane.common.units import format_quantity
from crane.ratings.limiting_factors import PIN_FORCE, TIPPING
from crane.ratings.rating_chart import RatingChart, RatingValues

if TYPE_CHECKING:
    from crane.ratings.lifting_capacity import Capacity

_ROUND_STEPS = (1.0, 1.5, 2.0, 2.5, 5.0)
_MAX_ROWS, _MAX_COLUMNS = 12, 18  # columns over all slews
_RADIUS_SUBDIVISIONS = 25  # of a step, for the largest radius
_SIGNIFICANT_DIGITS = 3  # of the largest load
_STEP_TOLERANCE = 1e-6  # of a step
_LEVEL_QUANTILES = 0.05, 0.9  # of loads, between which round levels are
_ROUND_VALUES = np.array([1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10])


class LoadTable(NamedTuple):
    """Loads at some heights and radii of a chart, and at the largest radius of each height.

    Attributes:
        heights: (h,) heights, descending [m].
        radii: (r,) radii [m].
        loads: (s, h, r + 1) loads at these radii and at the largest one [kg]; NaN out of reach,
            infinite where there is no limit.
        limited_by_drives: (s, h, r + 1) whether a drive limits the load.
        max_radii: (h,) largest radius, rounded down to a 25th of the chart's step [m].
        can_tip: Whether tipping is among the limiting factors.
    """

    heights: Array
    radii: Array
    loads: Array
    limited_by_drives: NDArray[np.bool_]
    max_radii: Array
    can_tip: bool

    def format_load(self, load: float, limited_by_drive: bool) -> str:
        """Return a load as text: rounded down, with an asterisk if a drive limits it.

        There is no asterisk if the machine cannot tip.
        """
        if math.isnan(load):
            return ""
        if math.isinf(load):
            return "∞"
        finite_loads = self.loads[..., :-1][np.isfinite(self.loads[..., :-1])]
        largest_load = max(finite_loads.max(initial=0.0), 1e-9)
        digits = max(_SIGNIFICANT_DIGITS - 1 - math.floor(math.log10(largest_load)), 0)
        rounded_down = math.floor(load * 10**digits * (1 + 1e-12)) / 10**digits
        return f"{rounded_down:.{digits}f}{'*' if limited_by_drive and self.can_tip else ''}"

    def format_rows(self) -> list[list[str]]:
        """Return h rows of s * (r + 1) + 1 cells: loads by radius and slew, largest radius.

        The loads at the largest radius precede that radius.
        """
        largest_radius = max(np.abs(self.max_radii).max(), 1e-9)  # small machines need more places
        decimals = max(2 - math.floor(math.log10(largest_radius)), 2)
        return [
            [
                *(
                    self.format_load(self.loads[k, i, j], self.limited_by_drives[k, i, j])
                    for j in range(self.loads.shape[2])
                    for k in range(len(self.loads))
                ),
                f"{self.max_radii[i]:.{decimals}f}",
            ]
            for i in range(len(self.heights))
        ]


def load_table(chart: RatingChart) -> LoadTable:
    """Return the loads of a chart at round steps and at the largest radius of each height.

    For a machine that slews, only radii in front of the axis are listed, if it reaches any.
    """
    columns = max(_MAX_COLUMNS // len(chart.slews), 4)
    is_reached: NDArray[np.bool_] = np.any(~np.isnan(chart.values), axis=0)
    if chart.section.slewing_joint is not None and np.any(is_reached & (chart.radii > 0)):
        is_reached = is_reached & (chart.radii > 0)
    a, b = np.flatnonzero(is_reached.any(axis=0)), np.flatnonzero(is_reached.any(axis=1))
    step = _round_step(chart.radii[a], chart.heights[b], columns)
    a = a[_select_indices(chart.radii[a], step, columns)]
    b = b[_select_indices(chart.heights[b], step, _MAX_ROWS)][::-1]
    largest = [_at_largest_radius(chart, int(i), np.flatnonzero(is_reached[i])) for i in b]
    max_radii, *farthest = (np.array(column).T for column in zip(*largest, strict=True))
    loads, is_limited = (
        np.dstack([values[:, b][:, :, a], last])
        for values, last in zip((chart.values, _is_drive_limited(chart)), farthest, strict=True)
    )
    can_tip = any(factor.reason == TIPPING for factor in chart.limiting_factors)
    return LoadTable(chart.heights[b], chart.radii[a], loads, is_limited, max_radii, can_tip)


def _is_drive_limited(chart: RatingChart) -> NDArray[np.bool_]:
    """Return whether a drive limits the load (s, b, a)."""
    is_drive = [x.reason not in (TIPPING, PIN_FORCE) for x in chart.limiting_factors]
    return np.array([*is_drive, False])[chart.limiting_factor_index]  # index -1: no limit


def _round_step(radii: Array, heights: Array, columns: int) -> float:
    min_step = max(np.ptp(radii) / columns, np.ptp(heights) / _MAX_ROWS)
    if not min_step:
        return 0.0
    smallest_spacing = np.concatenate([np.diff(radii), np.diff(heights)]).min()
    power = 10.0 ** np.floor(np.log10(min_step))
    round_steps = [x * power * ten for ten in (1.0, 10.0) for x in _ROUND_STEPS]
    fitting_steps = [
        x
        for x in round_steps
        if x >= min_step
        and abs(x / smallest_spacing - round(x / smallest_spacing)) < _STEP_TOLERANCE
    ]
    return float(
        fitting_steps[0]
        if fitting_steps
        else smallest_spacing * np.ceil(min_step / smallest_spacing)
    )


def _select_indices(values: Array, step: float, count: int) -> NDArray[np.intp]:
    """Return indices of at most `count` values: all, multiples of the step, or evenly spaced."""
    if len(values) > count and step:
        multiples = np.flatnonzero(
            np.abs(values / step - np.round(values / step)) < _STEP_TOLERANCE
        )
        if len(multiples):
            return multiples
    return np.arange(0, len(values), -(-len(values) // count))


def _at_largest_radius(
    chart: RatingChart, height_index: int, reached: NDArray[np.intp]
) -> tuple[float, Array, NDArray[np.bool_]]:
    """Return the largest radius at a height, and its loads (s,) and whether drives limit them.

    Args:
        chart: The chart.
        height_index: Index of the height.
        reached: Indices of the radii that are reached at this height.
    """
    last = int(reached[-1])
    if len(chart.radii) > 1:
        neighbours = slice(last, last + 2) if last + 1 < len(chart.radii) else slice(-2, None)
        shares = np.linspace(0.0, 1.0, _RADIUS_SUBDIVISIONS + 1)
        radii = chart.radii[last] + shares * np.diff(chart.radii[neighbours])
        height = chart.heights[height_index]
        found = chart.places.find_all((radii, np.array([height])))
        chart = chart.at_positions([radii[found.position_index.max()]], [height])
        height_index = last = 0
    return (
        float(chart.radii[last]),
        chart.values[:, height_index, last],
        _is_drive_limited(chart)[:, height_index, last],
    )


_SIDE_NAMES = {0: "front", 90: "side", -90: "side", 180: "rear", -180: "rear"}  # [deg]
ASTERISK_NOTE = "* limited by drives, all others by tipping"


def capacity_facts(chart: RatingValues) -> list[tuple[str, str]]:
    """Return the conditions of a load chart: names and texts."""
    holding = [x for x in chart.machine.driven_joints if x not in chart.working_joints]
    raising_text = ", ".join(chart.working_joints) or "nothing"
    if holding:
        raising_text += f" ({', '.join(holding)} held)"
    slope = np.rad2deg(chart.ground_slope)
    rows = [
        ("load", f"at '{chart.frame}', in kg, in addition to what the machine carries already"),
        ("rule", chart.rule.description),
        ("raised by", raising_text),
        ("ground", f"slope of {slope:.3g} degrees" if slope else "level"),
    ]
    if chart.with_friction:
        rows.append(("friction", "overcome from rest by the drives that raise"))
    return [*rows, ("limits", "; ".join(limit_texts(chart)))]


def limit_texts(chart: RatingValues) -> list[str]:
    """Return the limits of drives and pins as texts: "X_boom 350 bar (working pressure)"."""
    out = []
    for drive in chart.drive_limits():
        if drive.chamber_pressures:
            a, b = (format_quantity(pressure, "Pa", 4) for pressure in drive.chamber_pressures)
            value = a if a == b else f"A {a}, B {b}"
        else:
            value = format_quantity(
                drive.max_force, "N" if chart.machine.unit(drive.joint) == "m" else "N m", 4
            )
        out.append(f"{drive.joint} {value} ({drive.limit_kind})")
    limited_pins = {x.element for x in chart.limiting_factors if x.reason == PIN_FORCE}
    return out + [
        f"{name} {format_quantity(force, 'N', 4)} ({PIN_FORCE})"
        for name, force in chart.machine.pin_capacities.items()
        if name in limited_pins
    ]


def slew_labels(chart: RatingValues) -> list[str]:
    """Return a label for each slew angle: front, side, rear or degrees; empty for home alone."""
    slewing_joint = chart.section.slewing_joint
    if slewing_joint is None:
        return [""]
    if (
        len(chart.slews) == 1
        and chart.slews[0] == chart.machine.home[chart.machine.closure.active[slewing_joint]]
    ):
        return [""]
    degrees = [float(f"{x:.6g}") for x in np.rad2deg(chart.slews)]
    names = [_SIDE_NAMES.get(x, f"{x:.4g}°") for x in degrees]  # type: ignore[call-overload]
    return [
        name if names.count(name) == 1 else f"{x:.4g}°"
        for name, x in zip(names, degrees, strict=True)
    ]


def factor_shares(chart: RatingChart) -> list[tuple[str, float, float]]:
    """Return limiting factors with the shares of positions that each limits, alone or not.

    Returns:
        Rows, largest share first: the limiting factor, the share of all positions that it limits,
        and the share that it limits simultaneously with another factor.
    """
    count = max(int((~np.isnan(chart.values)).sum()), 1)
    has_several = chart.simultaneous_factors.sum(axis=-1) > 1
    rows = []
    for k in chart.active_factors:
        limits = chart.simultaneous_factors[..., k]
        share, both = (float(x.sum()) / count for x in (limits, limits & has_several))
        rows.append((str(chart.limiting_factors[k]), share, both))
    return sorted(rows, key=lambda row: -row[1])


def to_markdown(chart: "Capacity", table: LoadTable) -> str:
    """Return the conditions of a load chart, its table and its limiting factors as Markdown."""
    names, labels = slew_labels(chart), [f"{radius:g} m" for radius in table.radii]
    columns = [f"{label} {name}".strip() for label in [*labels, "farthest"] for name in names]
    rows = [
        [f"{height:g}", *row]
        for height, row in zip(table.heights, table.format_rows(), strict=True)
    ]
    lines = [
        f"# Lifting capacity of {chart.machine.name}\n",
        *(f"- {name}: {text}" for name, text in capacity_facts(chart)),
        "",
        *markdown_table([f"{chart.section.coordinate_names[1]} [m]", *columns, "at [m]"], rows),
        "",
        table_note(chart, table),
        "\n| limited by | of all positions | of all, with another |",
        "| --- | ---: | ---: |",
        *(
            f"| {factor} | {100 * share:.3g} % | {100 * both:.3g} % |"
            for factor, share, both in factor_shares(chart)
        ),
    ]
    if rows := _structural_rows(chart):
        heading = ["under these loads", "", *chart.section.coordinate_names, "slew"]
        lines += ["", *markdown_table(heading, rows)]
    return "\n".join(lines) + "\n"


def _structural_rows(chart: "Capacity") -> list[list[str]]:
    """Return the largest force in a pin and the smallest margin to buckling, with positions.

    Pins are left out on sloping ground, and if the passive joints are not determined.
    """
    machine, found = chart.machine, []
    if not np.isfinite(chart.values).any():
        return []
    slides = {x.name for x in machine.tree.moving_joints if x.kind == "prismatic"}
    slides |= {x.name for x in machine.closure.equations.loops if x.type == "prismatic"}
    try:
        forces = {} if chart.ground_slope else chart.pin_forces()
    except SingularConfigurationError:
        forces = {}
    if pins := {name: x for name, x in forces.items() if name not in slides}:
        name = max(pins, key=lambda pin: np.nanmax(pins[pin]))
        index = int(np.nanargmax(pins[name]))
        force = format_quantity(float(pins[name].flat[index]), "N", 4)
        found.append((f"largest force in a pin: {name}", force, index))
    if margins := {name: x for name, x in chart.buckling().items() if np.isfinite(x).any()}:
        name = min(margins, key=lambda joint: np.nanmin(margins[joint]))
        index = int(np.nanargmin(margins[name]))
        margin = f"{margins[name].flat[index]:.3g} times its force"
        found.append((f"first to buckle: {name}", margin, index))
    rows = []
    for title, value, index in found:
        s, b, a = np.unravel_index(index, chart.values.shape)
        position = f"{chart.radii[a]:.4g} m", f"{chart.heights[b]:.4g} m"
        rows.append([title, value, *position, f"{np.rad2deg(chart.slews[s]):.4g}°"])
    return rows


def table_note(chart: RatingChart, table: LoadTable) -> str:
    """Return the explanation of the marks and columns of a load table."""
    radius_note = (
        f"Loads in kg by {chart.section.coordinate_names[0]}; 'farthest' is at the largest one "
        f"of each row."
    )
    if table.can_tip:
        pins = (
            " or by pins"
            if any(factor.reason == PIN_FORCE for factor in chart.limiting_factors)
            else ""
        )
        return f"{radius_note} {ASTERISK_NOTE[0]}: {ASTERISK_NOTE[2:]}{pins}."
    return f"{radius_note} Nothing tips: {chart.machine.name} has no supports."


def round_levels(values: Array, count: int) -> list[float]:
    """Return round values between quantiles of some, denser at small ones."""
    if not len(values):
        return []
    low, high = np.quantile(values, _LEVEL_QUANTILES)
    levels = set()
    for value in np.geomspace(max(low, 1e-3 * high), high, count):
        power = 10.0 ** np.floor(np.log10(value))
        levels.add(float(power * _ROUND_VALUES[np.abs(_ROUND_VALUES * power - value).argmin()]))
    return sorted(levels)


def markdown_table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table, with its columns aligned."""
    width = [max(map(len, column)) for column in zip(heading, *rows, strict=True)]
    separator = ["-" * (w - 1) + ":" for w in width]
    cells = [
        [cell.rjust(w) for cell, w in zip(row, width, strict=True)] for row in (heading, *rows)
    ]
    return [f"| {' | '.join(row)} |" for row in (cells[0], separator, *cells[1:])]
