"""Rated loads as tables of manuals: a row per height, columns by radius."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crane.common.samples import Array
from crane.ratings.limiting_factors import PIN_FORCE, TIPPING, LimitingFactor

if TYPE_CHECKING:
    from crane.ratings.lifting_capacity import Capacity

_ROUND_STEPS = (1.0, 1.5, 2.0, 2.5, 5.0)
_MAX_ROWS, _MAX_COLUMNS = 12, 18  # at most, columns over all slews
_RADIUS_SUBDIVISIONS = 25  # parts of a step, to which the largest radius is sought
_SIGNIFICANT_DIGITS = 3  # of the largest load
_STEP_TOLERANCE = 1e-6  # of a step


class LoadTable(NamedTuple):
    """Some heights and radii of a chart, and the largest radius of each height.

    Attributes:
        heights: (h,) from above [m].
        radii: (r,) [m].
        loads: (s, h, r) [kg]; NaN out of reach, infinite where nothing ends them.
        limited_by_drives: (s, h, r) whether drives end them.
        max_radii: (h,) largest radius, to a 25th of the chart's step below it [m].
        max_radius_loads: (s, h) [kg] there.
        max_radius_limited_by_drives: (s, h) whether drives end them.
        can_tip: Whether tipping is among the causes.
    """

    heights: Array
    radii: Array
    loads: Array
    limited_by_drives: NDArray[np.bool_]
    max_radii: Array
    max_radius_loads: Array
    max_radius_limited_by_drives: NDArray[np.bool_]
    can_tip: bool

    def format_load(self, load: float, limited_by_drive: bool) -> str:
        """A load as it is printed: rounded down, with an asterisk where drives end it.

        Where nothing tips there is no asterisk.
        """
        if math.isnan(load):
            return ""
        if math.isinf(load):
            return "∞"
        largest_load = max(self.loads[np.isfinite(self.loads)].max(initial=0.0), 1e-9)
        digits = max(_SIGNIFICANT_DIGITS - 1 - math.floor(math.log10(largest_load)), 0)
        rounded_down = math.floor(load * 10**digits * (1 + 1e-12)) / 10**digits
        return f"{rounded_down:.{digits}f}{'*' if limited_by_drive and self.can_tip else ''}"

    def format_rows(self) -> list[list[str]]:
        """Cells (h, s * (r + 1) + 1): loads by radius and slew, those farthest, their radius."""
        s, _, r = self.loads.shape
        return [
            [
                self.format_load(self.loads[k, i, j], self.limited_by_drives[k, i, j])
                for j in range(r)
                for k in range(s)
            ]
            + [
                self.format_load(
                    self.max_radius_loads[k, i], self.max_radius_limited_by_drives[k, i]
                )
                for k in range(s)
            ]
            + [f"{self.max_radii[i]:.{_decimal_places(self.max_radii)}f}"]
            for i in range(len(self.heights))
        ]


def load_table(chart: "Capacity") -> LoadTable:
    """The table of a chart: places at round steps, and the largest radius at each height.

    Of a machine that slews, radii before the axis only, if there are any.
    """
    columns = max(_MAX_COLUMNS // len(chart.slews), 4)
    is_forward = (
        chart.radii > 0 if chart.section.slewing_joint is not None else np.isfinite(chart.radii)
    )
    is_reached: NDArray[np.bool_] = np.any(~np.isnan(chart.loads), axis=0)
    if np.any(is_reached & is_forward):
        is_reached = is_reached & is_forward
    radius_indices, height_indices = (
        np.flatnonzero(is_reached.any(axis=0)),
        np.flatnonzero(is_reached.any(axis=1)),
    )
    step = _round_step(chart.radii[radius_indices], chart.heights[height_indices], columns)
    a = radius_indices[_select_indices(chart.radii[radius_indices], step, columns)]
    b = height_indices[_select_indices(chart.heights[height_indices], step, _MAX_ROWS)][::-1]
    is_drive_limited = np.array(
        [_is_drive_limit(cause) for cause in chart.limiting_factors] + [False]
    )[chart.limiting_factor_index]
    max_radius_rows = [_largest_radius(chart, int(i), np.flatnonzero(is_reached[i])) for i in b]
    return LoadTable(
        chart.heights[b],
        chart.radii[a],
        chart.loads[:, b][:, :, a],
        is_drive_limited[:, b][:, :, a],
        np.array([radius for radius, _, _ in max_radius_rows]),
        np.array([loads for _, loads, _ in max_radius_rows]).T,
        np.array([is_limited_by_drive for _, _, is_limited_by_drive in max_radius_rows]).T,
        any(cause.reason == TIPPING for cause in chart.limiting_factors),
    )


def _is_drive_limit(factor: LimitingFactor) -> bool:
    """Whether it is a drive."""
    return factor.reason not in (TIPPING, PIN_FORCE)


def _round_step(radii: Array, heights: Array, columns: int) -> float:
    """The least round step that takes no more than so many columns and rows."""
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
    """Indices of all values where so many fit, else of multiples of a step, or evenly."""
    if len(values) > count and step:
        multiples = np.flatnonzero(
            np.abs(values / step - np.round(values / step)) < _STEP_TOLERANCE
        )
        if len(multiples):
            return multiples
    return np.arange(0, len(values), -(-len(values) // count))


def _largest_radius(
    chart: "Capacity", height_index: int, reached_indices: NDArray[np.intp]
) -> tuple[float, Array, NDArray[np.bool_]]:
    """The largest radius at height i, the loads (s,) there, and whether drives end them."""
    last_index = int(reached_indices[-1])
    if len(chart.radii) > 1:
        adjacent_radii = (
            chart.radii[last_index : last_index + 2]
            if last_index + 1 < len(chart.radii)
            else chart.radii[-2:]
        )
        refined_radii = chart.radii[last_index] + np.linspace(
            0.0, 1.0, _RADIUS_SUBDIVISIONS + 1
        ) * np.diff(adjacent_radii)
        row = refined_radii, chart.heights[[height_index]]
        farthest = refined_radii[chart.places.find_all(row).position_index.max()]
        chart, height_index, last_index = (
            chart.at_positions([farthest], [chart.heights[height_index]]),
            0,
            0,
        )
    loads = chart.loads[:, height_index, last_index]
    is_drive_limited = [
        k >= 0 and _is_drive_limit(chart.limiting_factors[k])
        for k in chart.limiting_factor_index[:, height_index, last_index]
    ]
    return float(chart.radii[last_index]), loads, np.array(is_drive_limited)


def _decimal_places(values: Array) -> int:
    """Decimals that lengths are written with: of centimetres, more of small machines."""
    return max(2 - math.floor(math.log10(max(np.abs(values).max(), 1e-9))), 2)
