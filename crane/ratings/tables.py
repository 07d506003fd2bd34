"""Rated loads as tables of manuals: a row per height, columns by radius."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crane.common.samples import Array
from crane.ratings.causes import PIN, TIPS, Cause

if TYPE_CHECKING:
    from crane.ratings.lifting import Capacity

_NICE = (1.0, 1.5, 2.0, 2.5, 5.0)
_ROWS, _COLUMNS = 12, 18  # at most, columns over all slews
_FINER = 25  # parts of a step, to which the largest radius is sought
_DIGITS = 3  # of the largest load
_SAME = 1e-6  # of a step


class LoadTable(NamedTuple):
    """Some heights and radii of a chart, and the largest radius of each height.

    Attributes:
        heights: (h,) from above [m].
        radii: (r,) [m].
        loads: (s, h, r) [kg]; NaN out of reach, infinite where nothing ends them.
        drives: (s, h, r) whether drives end them.
        far: (h,) largest radius, to a 25th of the chart's step below it [m].
        far_loads: (s, h) [kg] there.
        far_drives: (s, h) whether drives end them.
        tips: Whether tipping is among the causes.
    """

    heights: Array
    radii: Array
    loads: Array
    drives: NDArray[np.bool_]
    far: Array
    far_loads: Array
    far_drives: NDArray[np.bool_]
    tips: bool

    def words(self, load: float, drives: bool) -> str:
        """A load as it is printed: rounded down, with an asterisk where drives end it.

        Where nothing tips there is no asterisk.
        """
        if math.isnan(load):
            return ""
        if math.isinf(load):
            return "∞"
        peak = max(self.loads[np.isfinite(self.loads)].max(initial=0.0), 1e-9)
        digits = max(_DIGITS - 1 - math.floor(math.log10(peak)), 0)
        down = math.floor(load * 10**digits * (1 + 1e-12)) / 10**digits
        return f"{down:.{digits}f}{'*' if drives and self.tips else ''}"

    def rows(self) -> list[list[str]]:
        """Cells (h, s * (r + 1) + 1): loads by radius and slew, those farthest, their radius."""
        s, _, r = self.loads.shape
        return [
            [self.words(self.loads[k, i, j], self.drives[k, i, j]) for j in range(r)
             for k in range(s)]
            + [self.words(self.far_loads[k, i], self.far_drives[k, i]) for k in range(s)]
            + [f"{self.far[i]:.{_places(self.far)}f}"]
            for i in range(len(self.heights))
        ]  # fmt: skip


def load_table(chart: "Capacity") -> LoadTable:
    """The table of a chart: places at round steps, and the largest radius at each height.

    Of a machine that slews, radii before the axis only, if there are any.
    """
    columns = max(_COLUMNS // len(chart.slews), 4)
    forward = chart.radii > 0 if chart.section.slew is not None else np.isfinite(chart.radii)
    reached: NDArray[np.bool_] = np.any(~np.isnan(chart.loads), axis=0)
    if np.any(reached & forward):
        reached = reached & forward
    across, up = np.flatnonzero(reached.any(axis=0)), np.flatnonzero(reached.any(axis=1))
    step = _step(chart.radii[across], chart.heights[up], columns)
    a = across[_spread(chart.radii[across], step, columns)]
    b = up[_spread(chart.heights[up], step, _ROWS)][::-1]
    drives = np.array([_drive(cause) for cause in chart.causes] + [False])[chart.cause]
    far = [_farthest(chart, int(i), np.flatnonzero(reached[i])) for i in b]
    return LoadTable(
        chart.heights[b], chart.radii[a], chart.loads[:, b][:, :, a], drives[:, b][:, :, a],
        np.array([radius for radius, _, _ in far]),
        np.array([loads for _, loads, _ in far]).T,
        np.array([ends for _, _, ends in far]).T,
        any(cause.why == TIPS for cause in chart.causes),
    )  # fmt: skip


def _drive(cause: Cause) -> bool:
    """Whether it is a drive."""
    return cause.why not in (TIPS, PIN)


def _step(radii: Array, heights: Array, columns: int) -> float:
    """The least round step that takes no more than so many columns and rows."""
    least = max(np.ptp(radii) / columns, np.ptp(heights) / _ROWS)
    if not least:
        return 0.0
    between = np.concatenate([np.diff(radii), np.diff(heights)]).min()
    power = 10.0 ** np.floor(np.log10(least))
    nice = [x * power * ten for ten in (1.0, 10.0) for x in _NICE]
    fits = [x for x in nice if x >= least and abs(x / between - round(x / between)) < _SAME]
    return float(fits[0] if fits else between * np.ceil(least / between))


def _spread(values: Array, step: float, count: int) -> NDArray[np.intp]:
    """Indices of all values where so many fit, else of multiples of a step, or evenly."""
    if len(values) > count and step:
        whole = np.flatnonzero(np.abs(values / step - np.round(values / step)) < _SAME)
        if len(whole):
            return whole
    return np.arange(0, len(values), -(-len(values) // count))


def _farthest(
    chart: "Capacity", i: int, reached: NDArray[np.intp]
) -> tuple[float, Array, NDArray[np.bool_]]:
    """The largest radius at height i, the loads (s,) there, and whether drives end them."""
    last = int(reached[-1])
    if len(chart.radii) > 1:
        beside = chart.radii[last : last + 2] if last + 1 < len(chart.radii) else chart.radii[-2:]
        beyond = chart.radii[last] + np.linspace(0.0, 1.0, _FINER + 1) * np.diff(beside)
        row = beyond, chart.heights[[i]]
        farthest = beyond[chart.places.all(row).place.max()]
        chart, i, last = chart.at_places([farthest], [chart.heights[i]]), 0, 0
    loads = chart.loads[:, i, last]
    ends = [k >= 0 and _drive(chart.causes[k]) for k in chart.cause[:, i, last]]
    return float(chart.radii[last]), loads, np.array(ends)


def _places(values: Array) -> int:
    """Decimals that lengths are written with: of centimetres, more of small machines."""
    return max(2 - math.floor(math.log10(max(np.abs(values).max(), 1e-9))), 2)
