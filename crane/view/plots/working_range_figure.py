"""Figures of working ranges: reach of the lip, machine and dimension lines."""

import string
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.motion.workspaces import Workspace
from crane.ratings.working_range_dimensions import Dimension
from crane.ratings.working_ranges import WorkingRange
from crane.recordings.recording_summary import result_title
from crane.view.plots.figure_style import (
    DASHED_STYLE,
    INK_COLOUR,
    RECORDED_COLOUR,
    add_heading,
    escape_label,
    figure_style,
    set_round_ticks,
)
from crane.view.plots.workspace_figure import skeleton_lines

_REGION_COLOUR, _SOIL_COLOUR, _LINE_COLOUR = "#e3ecf6", "#8a6d4b", "#666666"
_LINE_GAP_SHARE = 0.055  # between dimension lines, of the drawing's larger extent


@figure_style
def working_range_figure(result: WorkingRange) -> Figure:
    """Return the figure of a working range.

    It shows the reach of the lip, the machine at home, the ground, and a lettered line for every
    dimension: vertical ones on the right, horizontal ones from the slewing axis below and above.
    Shorter lines are closer to the machine, so that no line crosses another one.
    """
    reach = result.workspace
    skeleton = skeleton_lines(reach)
    points = np.vstack([skeleton.reshape(-1, 2), reach.section_positions])
    lower, upper = points.min(axis=0), points.max(axis=0)
    lower = np.minimum(lower, [0.0, result.ground_height])
    gap = _LINE_GAP_SHARE * float((upper - lower).max())
    figure = Figure(figsize=(9.6, 6.8), layout="constrained")
    axes = figure.subplots()
    _draw_reach(axes, reach, skeleton)
    letters = dict(zip(string.ascii_uppercase, result.dimensions, strict=False))
    right = _draw_vertical_lines(axes, letters, result.ground_height, max(upper[0], 0.0), gap)
    axes.plot(
        [lower[0] - gap, right], [result.ground_height] * 2, color=_SOIL_COLOUR, linewidth=1.4,
        zorder=4,
    )  # fmt: skip
    bottom, top = _draw_horizontal_lines(axes, letters, lower[1], upper[1], gap)
    _draw_level_bottom(axes, result)
    names = reach.section.coordinate_names
    axes.set(xlim=(lower[0] - gap, right), ylim=(bottom, top), aspect="equal",
             xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]")  # fmt: skip
    axes.grid(False)
    set_round_ticks(axes, 9)
    digits = 2 if max(upper[0], upper[1]) > 2 else 3
    legend = [f"{a}  {x.name}  {x.value:.{digits}f} m" for a, x in letters.items()]
    axes.text(1.03, 1.0, "\n".join(legend), transform=axes.transAxes, va="top", linespacing=1.8)
    add_heading(figure, escape_label(result_title(result.machine.name, "working range")))
    return figure


def _draw_reach(axes: Axes, reach: Workspace, skeleton: Array) -> None:
    raster = reach.raster
    covered = raster.fill_cracks(2 if reach.is_complete else 6)
    axes.contourf(raster.u, raster.w, covered, [0.5, 1.5], colors=[_REGION_COLOUR], zorder=1)
    axes.contour(
        raster.u, raster.w, covered, [0.5], colors=[RECORDED_COLOUR], linewidths=1.2, zorder=3
    )
    for line in skeleton:
        axes.plot(*line.T, color=INK_COLOUR, linewidth=1.6, solid_capstyle="round", zorder=5)
    axes.plot(*skeleton.reshape(-1, 2).T, "o", ms=2.6, color=INK_COLOUR, zorder=5)


def _is_vertical(dimension: Dimension) -> bool:
    return any(word in dimension.name for word in ("depth", "height"))


def _draw_vertical_lines(
    axes: Axes, letters: Mapping[str, Dimension], ground: float, right: float, gap: float
) -> float:
    """Draw lines on the right of the reach, and return the right end of the drawing."""
    columns = _dimension_columns({a: x for a, x in letters.items() if _is_vertical(x)}, ground)
    for k, column in enumerate(columns):
        u = right + gap * (k + 1)
        for letter, dimension in column:
            position = dimension.section_position
            _draw_dimension_line(axes, letter, (u, ground), (u, position[1]), position)
    return right + gap * (len(columns) + 0.7)


def _draw_horizontal_lines(
    axes: Axes, letters: Mapping[str, Dimension], bottom: float, top: float, gap: float
) -> tuple[float, float]:
    """Draw lines below and above the reach, and return the vertical limits of the drawing."""
    horizontal = {a: x for a, x in letters.items() if not _is_vertical(x)}
    heights = [bottom, top]
    for is_above, edge, direction in ((False, bottom, -1.0), (True, top, 1.0)):
        items = [(a, x) for a, x in horizontal.items() if ("slewing" in x.name) == is_above]
        for k, (letter, dimension) in enumerate(sorted(items, key=lambda item: item[1].value)):
            w, position = edge + direction * gap * (k + 1), dimension.section_position
            _draw_dimension_line(axes, letter, (0.0, w), (position[0], w), position)
            heights.append(w)
    limits = min(heights) - gap, max(heights) + gap
    if horizontal:
        style: Any = {"color": _LINE_COLOUR, "linewidth": 0.8, "linestyle": (0, (8, 2, 1, 2))}
        axes.plot([0, 0], limits, zorder=2, **style)
    return limits


def _dimension_columns(
    vertical: dict[str, Dimension], ground_height: float
) -> list[list[tuple[str, Dimension]]]:
    """Return pairs of dimensions above and below ground that share a line, shortest first."""
    sides = [
        sorted(
            (
                item
                for item in vertical.items()
                if (item[1].section_position[1] > ground_height) == is_above
            ),
            key=lambda item: item[1].value,
        )
        for is_above in (False, True)
    ]
    return [
        [side[k] for side in sides if k < len(side)]
        for k in range(max(len(side) for side in sides))
    ]


def _draw_dimension_line(
    axes: Axes,
    letter: str,
    start: tuple[float, float],
    end: tuple[float, float],
    measured_point: Array,
) -> None:
    axes.plot(
        [measured_point[0], end[0]],
        [measured_point[1], end[1]],
        color=_LINE_COLOUR,
        linewidth=0.5,
        zorder=2,
    )
    axes.plot(*measured_point, "o", ms=3.2, color=DASHED_STYLE["color"], zorder=6)
    axes.annotate(
        "", end, start, zorder=6,
        arrowprops={"arrowstyle": "<|-|>", "color": INK_COLOUR, "linewidth": 0.9, "shrinkA": 0,
                    "shrinkB": 0, "mutation_scale": 9},
    )  # fmt: skip
    middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    axes.annotate(
        letter, middle, ha="center", va="center", fontsize=9, fontweight="bold", zorder=7,
        bbox={"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": "none"},
    )  # fmt: skip


def _draw_level_bottom(axes: Axes, result: WorkingRange) -> None:
    for dimension in result.dimensions:
        if "level bottom" in dimension.name:
            line_ends = [
                dimension.section_position[0],
                dimension.section_position[0] + result.level_length,
            ]
            axes.plot(
                line_ends,
                [dimension.section_position[1]] * 2,
                color=DASHED_STYLE["color"],
                linewidth=1.8,
                zorder=6,
            )
