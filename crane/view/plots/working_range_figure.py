"""A working range as brochures draw it: the lip's reach, the machine, and dimension lines."""

import string

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from crane.common.samples import Array
from crane.ratings.working_range_dimensions import Dimension
from crane.ratings.working_ranges import WorkingRange
from crane.recordings.recording_summary import result_title
from crane.view.plots.figure_text import escape_label
from crane.view.plots.recording_figure import (
    DASHED_STYLE,
    FIGURE_STYLE,
    INK_COLOUR,
    RECORDED_COLOUR,
)
from crane.view.plots.workspace_figure import skeleton_lines

_REGION_COLOUR, _SOIL_COLOUR, _LINE_COLOUR = "#e3ecf6", "#8a6d4b", "#666666"
_LINE_GAP_SHARE = 0.055  # between dimension lines, of the drawing's larger extent
_VERTICAL_WORDS = ("depth", "height")  # words of what is measured upright


def working_range_figure(result: WorkingRange) -> Figure:
    """The figure of a working range.

    What the lip reaches, the machine at home, the ground, and a lettered line for every
    dimension: those upright to the right, the shorter the nearer, those from the slewing axis
    below and above. Shorter ones lie inside, so that no line crosses another one.
    """
    reachable_space = result.workspace
    with mpl.rc_context(FIGURE_STYLE):
        skeleton = skeleton_lines(reachable_space)
        points = skeleton.reshape(-1, 2)
        lower = [
            min(reachable_space.section_positions[:, k].min(), points[:, k].min()) for k in (0, 1)
        ]
        upper = [
            max(reachable_space.section_positions[:, k].max(), points[:, k].max()) for k in (0, 1)
        ]
        lower[1], lower[0] = min(lower[1], result.ground_height), min(lower[0], 0.0)
        gap = _LINE_GAP_SHARE * max(upper[0] - lower[0], upper[1] - lower[1])
        dimensions_by_letter = dict(zip(string.ascii_uppercase, result.dimensions, strict=False))
        vertical = {
            a: x
            for a, x in dimensions_by_letter.items()
            if _VERTICAL_WORDS[0] in x.name or _VERTICAL_WORDS[1] in x.name
        }
        horizontal = {a: x for a, x in dimensions_by_letter.items() if a not in vertical}
        dimensions_above = {a: x for a, x in horizontal.items() if "slewing" in x.name}
        dimensions_below = {a: x for a, x in horizontal.items() if a not in dimensions_above}
        figure = Figure(figsize=(9.6, 6.8), layout="constrained")
        axes = figure.subplots()
        raster = reachable_space.raster
        covered = raster.fill_cracks(2 if reachable_space.is_complete else 6)
        axes.contourf(raster.u, raster.w, covered, [0.5, 1.5], colors=[_REGION_COLOUR], zorder=1)
        axes.contour(
            raster.u, raster.w, covered, [0.5], colors=[RECORDED_COLOUR], linewidths=1.2, zorder=3
        )
        for line in skeleton:
            axes.plot(*line.T, color=INK_COLOUR, linewidth=1.6, solid_capstyle="round", zorder=5)
        axes.plot(*points.T, "o", ms=2.6, color=INK_COLOUR, zorder=5)
        right = max(upper[0], 0.0)
        columns = _dimension_columns(vertical, result.ground_height)
        line_end = right + gap * (len(columns) + 0.7)
        axes.plot(
            [lower[0] - gap, line_end],
            [result.ground_height] * 2,
            color=_SOIL_COLOUR,
            linewidth=1.4,
            zorder=4,
        )
        for k, column in enumerate(columns):
            for letter, dimension in column:
                u = right + gap * (k + 1)
                _draw_dimension_line(
                    axes,
                    letter,
                    (u, result.ground_height),
                    (u, dimension.section_position[1]),
                    dimension.section_position,
                )
        rows: list[tuple[str, Dimension, float]] = []
        for dimensions_on_side, edge, direction in (
            (dimensions_below, lower[1], -1.0),
            (dimensions_above, upper[1], 1.0),
        ):
            order = sorted(dimensions_on_side.items(), key=lambda item: item[1].value)
            rows += [(a, x, edge + direction * gap * (k + 1)) for k, (a, x) in enumerate(order)]
        for letter, dimension, w in rows:
            _draw_dimension_line(
                axes,
                letter,
                (0.0, w),
                (dimension.section_position[0], w),
                dimension.section_position,
            )
        heights = [w for *_, w in rows]
        lower_edge, upper_edge = min([lower[1], *heights]) - gap, max([upper[1], *heights]) + gap
        if horizontal:
            axes.plot(
                [0, 0],
                [lower_edge, upper_edge],
                color=_LINE_COLOUR,
                linewidth=0.8,
                zorder=2,
                linestyle=(0, (8, 2, 1, 2)),
            )
        _draw_level_bottom(axes, result)
        axes.set_aspect("equal")
        axes.set(xlim=(lower[0] - gap, line_end), ylim=(lower_edge, upper_edge))
        axes.grid(False)
        names = reachable_space.section.coordinate_names
        axes.set(xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(9, steps=[1, 2, 2.5, 5, 10]))
        digits = 2 if max(upper[0], upper[1]) > 2 else 3
        legend_lines = [
            f"{a}  {x.name}  {x.value:.{digits}f} m" for a, x in dimensions_by_letter.items()
        ]
        axes.text(1.03, 1.0, "\n".join(legend_lines), transform=axes.transAxes, va="top",
                  linespacing=1.8)  # fmt: skip
        heading = escape_label(result_title(result.machine.name, "working range"))
        figure.suptitle(heading, x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def _dimension_columns(
    vertical: dict[str, Dimension], ground_height: float
) -> list[list[tuple[str, Dimension]]]:
    """What shares a line: one above the ground and one below it, the shorter ones first."""
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
    count = max(len(side) for side in sides)
    return [[side[k] for side in sides if k < len(side)] for k in range(count)]


def _draw_dimension_line(
    axes: Axes,
    letter: str,
    start: tuple[float, float],
    end: tuple[float, float],
    measured_point: Array,
) -> None:
    """A dimension line with its letter, and a thin one from the place that it measures."""
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
    """The level bottom itself."""
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
