"""Figures of workspaces and working ranges: reach, map of the strokes, dimension lines."""

import string
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch as Swatch

from crane.common.samples import Array
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces import Workspace
from crane.ratings.working_range_dimensions import Dimension
from crane.ratings.working_ranges import WorkingRange
from crane.recordings.recording_summary import DISPLAY_UNITS, result_title
from crane.view.plots.figure_style import (
    DASHED_STYLE,
    INK_COLOUR,
    RECORDED_COLOUR,
    add_heading,
    add_side_colour_bar,
    escape_label,
    figure_style,
    joint_symbol,
    set_round_ticks,
)
from crane.view.plots.rating_figures import draw_machine
from crane.view.sketches.mechanism_projection import MachineOutline, machine_outline

_REGION_COLOUR, _GRID_COLOUR, _OPEN_COLOUR = "#e3ecf6", "#a9c3e0", "#d9d9d9"
_CURVE_STYLES = {
    "branch": {"color": "#c2452d", "linewidth": 1.8},
    "tip": {
        "color": DASHED_STYLE["color"],
        "linewidth": 1.3,
        "linestyle": DASHED_STYLE["linestyle"],
    },
}
_CURVE_LABELS = {"branch": "end of the branch", "tip": "tip singular"}
_MAX_GAP_SHARE = 0.1  # share of the extent that neighbours on a line are not apart
_MAX_SHOWN_CONDITION = 30.0  # condition at which colours end
_MIN_SHOWN_CONDITION = 1.2  # condition up to which a drive has nothing to show
_CONDITION_TICKS = (1, 1.1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 7, 10, 15, 20, 30)
_GRID_LINE_COUNT = 10  # of the grid, per stroke


@figure_style
def workspace_figure(reachable_space: Workspace) -> Figure:
    """Return the figure of a workspace.

    On the left are the reach of the tip in the section, images of grid lines of the two strokes
    that move it most, and the machine at home. On the right, over these two strokes, are the
    condition number of the drive and the smallest singular value of the tip's Jacobian, grey where
    the loops do not close.
    """
    outline = _home_outline(reachable_space)
    points = np.concatenate([reachable_space.section_positions, outline.points])
    width, height = np.ptp(points, axis=0)
    stroke_map = reachable_space.stroke_map
    has_condition_panel = float(np.nanmax(stroke_map.condition)) > _MIN_SHOWN_CONDITION
    aspect = np.clip(height / max(width, 1e-9), 0.45, 1.5)
    figure_height = float(np.clip(4.6 * aspect, 4.2, 6.2)) + 0.7
    figure = Figure(figsize=(9.6, figure_height), layout="constrained")
    grid = figure.add_gridspec(1 + has_condition_panel, 2, width_ratios=[1.3, 1.0])
    _draw_section(figure.add_subplot(grid[:, 0]), reachable_space, outline, points)
    right = [figure.add_subplot(grid[k, 1]) for k in range(1 + has_condition_panel)]
    if has_condition_panel:
        _draw_stroke_map(
            right[0], reachable_space, stroke_map.condition, "condition number of the drive"
        )
        right[0].sharex(right[1])
        right[0].tick_params(labelbottom=False)
        right[0].set_xlabel("")
    _draw_stroke_map(
        right[-1],
        reachable_space,
        stroke_map.least_singular_value,
        "smallest singular value, tip [m]",
    )
    right[0].set_title(_stroke_title(reachable_space))
    _add_caption(figure, reachable_space)
    return figure


def _draw_section(
    axes: Axes, reachable_space: Workspace, outline: MachineOutline, points: Array
) -> None:
    if reachable_space.area:
        _draw_region(axes, reachable_space, 1.1)
        lines = _grid_images(reachable_space)
        axes.add_collection(LineCollection(lines, colors=_GRID_COLOUR, linewidths=0.6, zorder=2))
    else:
        stroke = reachable_space.machine.active.index(reachable_space.strokes[0])
        path = reachable_space.section_positions[np.argsort(reachable_space.q_a[:, stroke])]
        axes.plot(*path.T, color=RECORDED_COLOUR, linewidth=1.8, zorder=3)
        axes.plot(*path[[0, -1]].T, "o", ms=4.5, color=RECORDED_COLOUR, mfc="white", zorder=4)
    for curve in reachable_space.curves:
        style = _CURVE_STYLES[curve.kind]
        if len(curve.section_positions) > 1:
            axes.plot(*curve.section_positions.T, zorder=4, **style)
        else:
            axes.plot(*curve.section_positions.T, "o", ms=5, color=style["color"], zorder=5)
    draw_machine(axes, outline)
    home = _section_positions(reachable_space, reachable_space.machine.home[None])
    axes.plot(*home[0], "o", ms=6, color=INK_COLOUR, mfc="white", mew=1.3, zorder=6)
    lower, upper = points.min(axis=0), points.max(axis=0)
    margin = 0.05 * float((upper - lower).max())
    u, w = reachable_space.section.coordinate_names
    axes.set(
        aspect="equal",
        xlim=(lower[0] - margin, upper[0] + margin),
        ylim=(lower[1] - margin, upper[1] + margin),
        anchor="N",
        xlabel=f"{u} [m]",
        ylabel=f"{w} [m]",
        title=f"reach of {escape_label(reachable_space.frame)}",
    )
    set_round_ticks(axes, 7)


def _grid_images(reachable_space: Workspace) -> list[Array]:
    """Return images (k, 2) in the section of grid lines of the two strokes."""
    patch = reachable_space.stroke_map.patch
    positions = np.full((*patch.is_closed.shape, 2), np.nan)
    positions[patch.is_closed] = _section_positions(
        reachable_space, patch.configurations[patch.is_closed]
    )
    extent = float(np.ptp(reachable_space.section_positions, axis=0).max())
    lines: list[Array] = []
    for rows in (positions, positions.swapaxes(0, 1)):
        for row in rows[
            np.unique(np.linspace(0, len(rows) - 1, _GRID_LINE_COUNT + 1).round().astype(int))
        ]:
            steps = np.linalg.norm(np.diff(row, axis=0), axis=1)
            gap_indices = np.flatnonzero(~(steps < _MAX_GAP_SHARE * extent)) + 1
            lines += [
                segment for segment in np.split(row, gap_indices) if not np.isnan(segment).any()
            ]
    return [line for line in lines if len(line) > 1]


def _section_positions(reachable_space: Workspace, configurations: Array) -> Array:
    """Return the positions (N, 2) of the frame in the section."""
    kinematics = Kinematics(reachable_space.machine, reachable_space.frame)
    positions = kinematics.positions_at_configurations(configurations)
    return reachable_space.section.coordinates(positions)


def _home_outline(reach: Workspace) -> MachineOutline:
    """Return the outline of the machine at home."""
    return machine_outline(reach.machine, reach.frame, reach.section, reach.machine.home)


def _draw_stroke_map(axes: Axes, reachable_space: Workspace, values: Array, label: str) -> None:
    """Draw values (a, b) over the two strokes of the map, or over the single stroke."""
    machine, stroke_map = reachable_space.machine, reachable_space.stroke_map
    patch, strokes = stroke_map.patch, list(stroke_map.patch.stroke_pair)
    names = [machine.active[i] for i in strokes]
    units = [DISPLAY_UNITS[machine.unit(name)] for name in names]
    factors = np.array([factor for _, factor in units])
    labels = [f"{joint_symbol(n)} [{u}]" for n, (u, _) in zip(names, units, strict=True)]
    home = machine.home[machine.closure.active][strokes] * factors
    x = patch.axes[0] * factors[0]
    axes.set(xlabel=labels[0], anchor="N")
    if strokes[0] == strokes[1]:
        axes.plot(x, values[:, 0], color=RECORDED_COLOUR)
        for curve in stroke_map.curves:
            axes.axvline(curve.q_a[0, strokes[0]] * factors[0], **_CURVE_STYLES[curve.kind])
        axes.plot(
            home[0],
            np.interp(home[0], x, values[:, 0]),
            "o",
            ms=6,
            color=INK_COLOUR,
            mfc="white",
            mew=1.3,
        )
        axes.set(
            xlim=(x[0], x[-1]),
            ylabel=label,
            ylim=(
                0,
                1.1
                * min(
                    float(np.nanmax(values)), _MAX_SHOWN_CONDITION * float(np.nanmin(values)) + 1
                ),
            ),
        )
        return
    y = patch.axes[1] * factors[1]
    axes.grid(False)
    axes.set_facecolor(_OPEN_COLOUR)
    largest, is_condition = float(np.nanmax(values)), values is stroke_map.condition
    norm: Normalize = Normalize(0.0, largest)
    if is_condition:
        bottom = float(np.nanmin(values))
        norm = LogNorm(bottom, max(min(largest, _MAX_SHOWN_CONDITION), 1.5 * bottom))
    mesh = axes.pcolormesh(
        x, y, np.ma.masked_invalid(values.T), norm=norm, shading="nearest", rasterized=True,
        cmap="viridis" if is_condition else "cividis_r",
    )  # fmt: skip
    for curve in stroke_map.curves:
        axes.plot(*(curve.q_a[:, strokes] * factors).T, **_CURVE_STYLES[curve.kind])
    axes.plot(*home, "o", ms=6, color=INK_COLOUR, mfc="white", mew=1.3)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), ylabel=labels[1])
    colour_bar = add_side_colour_bar(
        axes,
        mesh,
        label,
        extend="max" if (is_condition and largest > _MAX_SHOWN_CONDITION) else "neither",
    )
    if is_condition:
        ticks = [
            value for value in _CONDITION_TICKS if (norm.vmin or 0) <= value <= (norm.vmax or 0)
        ]
        colour_bar.set_ticks(ticks, labels=[f"{value:g}" for value in ticks])
    colour_bar.ax.minorticks_off()


def _stroke_title(reachable_space: Workspace) -> str:
    active, pair = reachable_space.machine.active, reachable_space.stroke_map.patch.stroke_pair
    others = [joint_symbol(x) for x in reachable_space.strokes if active.index(x) not in pair]
    if not others:
        return "strokes" if len(reachable_space.strokes) > 1 else "along the stroke"
    return f"strokes, {', '.join(others) if len(others) < 3 else 'others'} at home"


def _add_caption(figure: Figure, reachable_space: Workspace) -> None:
    heading = escape_label(result_title(reachable_space.machine.name, "workspace"))
    if (slewing := reachable_space.slewing_joint_name) is not None:
        i = reachable_space.machine.active.index(slewing)
        lower, upper = np.rad2deg([reachable_space.lower[i], reachable_space.upper[i]])
        heading += f", turned by {joint_symbol(slewing)} from {lower:.4g}° to {upper:.4g}°"
    add_heading(figure, heading)
    handles: list[Line2D | Swatch] = [
        Line2D([], [], marker="o", ls="", color=INK_COLOUR, mfc="white", mew=1.3, label="home")
    ]
    kinds = {curve.kind for curve in (*reachable_space.curves, *reachable_space.stroke_map.curves)}
    handles += [
        Line2D([], [], label=label, **_CURVE_STYLES[kind])
        for kind, label in _CURVE_LABELS.items()
        if kind in kinds
    ]
    if not reachable_space.stroke_map.patch.is_closed.all() and reachable_space.area:
        handles.append(Swatch(color=_OPEN_COLOUR, label="loops do not close"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


_SOIL_COLOUR, _LINE_COLOUR = "#8a6d4b", "#666666"
_VERTICAL_WORDS = ("depth", "height")
_LINE_GAP_SHARE = 0.055  # between dimension lines, of the drawing's larger extent


@figure_style
def working_range_figure(result: WorkingRange) -> Figure:
    """Return the figure of a working range.

    It shows the reach of the lip, the machine at home, the ground, and a lettered line for every
    dimension: vertical ones on the right, horizontal ones from the slewing axis below and above.
    Shorter lines are closer to the machine, so that no line crosses another one.
    """
    reach = result.workspace
    outline = _home_outline(reach)
    points = np.concatenate([outline.points, reach.section_positions])
    lower, upper = points.min(axis=0), points.max(axis=0)
    lower = np.minimum(lower, [0.0, result.ground_height])
    gap = _LINE_GAP_SHARE * float((upper - lower).max())
    figure = Figure(figsize=(9.6, 6.8), layout="constrained")
    axes = figure.subplots()
    _draw_region(axes, reach, 1.2)
    draw_machine(axes, outline)
    letters = dict(zip(string.ascii_uppercase, result.dimensions, strict=False))
    right = _draw_vertical_lines(axes, letters, result.ground_height, max(upper[0], 0.0), gap)
    axes.plot(
        [lower[0] - gap, right], [result.ground_height] * 2, color=_SOIL_COLOUR, linewidth=1.4,
        zorder=4,
    )  # fmt: skip
    bottom, top = _draw_horizontal_lines(axes, letters, lower[1], upper[1], gap)
    for dimension in result.dimensions:
        if "level bottom" in dimension.name:
            u, w = dimension.section_position
            ends = [u, u + result.level_length]
            axes.plot(ends, [w, w], color=DASHED_STYLE["color"], linewidth=1.8, zorder=6)
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


def _draw_region(axes: Axes, reach: Workspace, line_width: float) -> None:
    """Draw the region of the section that is reached, with its border."""
    raster = reach.raster
    covered = raster.fill_cracks(2 if reach.is_complete else 6)
    axes.contourf(raster.u, raster.w, covered, [0.5, 1.5], colors=[_REGION_COLOUR], zorder=1)
    axes.contour(
        raster.u, raster.w, covered, [0.5], colors=[RECORDED_COLOUR], linewidths=line_width,
        zorder=3,
    )  # fmt: skip


def _draw_vertical_lines(
    axes: Axes, letters: Mapping[str, Dimension], ground: float, right: float, gap: float
) -> float:
    """Draw lines on the right of the reach, and return the right end of the drawing.

    Dimensions above and below ground share a line, the shortest first.
    """
    counts = {False: 0, True: 0}
    for letter, dimension in _shortest_first(letters, is_vertical=True):
        position = dimension.section_position
        is_above = bool(position[1] > ground)
        counts[is_above] += 1
        u = right + gap * counts[is_above]
        _draw_dimension_line(axes, letter, (u, ground), (u, position[1]), position)
    return right + gap * (max(counts.values()) + 0.7)


def _draw_horizontal_lines(
    axes: Axes, letters: Mapping[str, Dimension], bottom: float, top: float, gap: float
) -> tuple[float, float]:
    """Draw lines below and above the reach, and return the vertical limits of the drawing."""
    heights = {False: bottom, True: top}
    lines = _shortest_first(letters, is_vertical=False)
    for letter, dimension in lines:
        is_above, position = "slewing" in dimension.name, dimension.section_position
        heights[is_above] += gap if is_above else -gap
        w = heights[is_above]
        _draw_dimension_line(axes, letter, (0.0, w), (position[0], w), position)
    limits = heights[False] - gap, heights[True] + gap
    if lines:
        dashes = (0, (8, 2, 1, 2))
        axes.plot([0, 0], limits, zorder=2, color=_LINE_COLOUR, linewidth=0.8, linestyle=dashes)
    return limits


def _shortest_first(
    letters: Mapping[str, Dimension], is_vertical: bool
) -> list[tuple[str, Dimension]]:
    """Return the vertical or the horizontal dimensions with their letters."""
    return [
        (letter, dimension)
        for letter, dimension in sorted(letters.items(), key=lambda item: item[1].value)
        if any(word in dimension.name for word in _VERTICAL_WORDS) == is_vertical
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
