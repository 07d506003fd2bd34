"""Figures of load charts and tool forces by limiting factor, and of sections of bodies."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from contourpy import contour_generator
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from crane.common.samples import Array
from crane.common.units import display_unit
from crane.dynamics.section_forces import SECTION_UNITS, SectionChart, section_unit
from crane.ratings.capacity_report import round_levels, slew_labels
from crane.ratings.lift_charts import LiftChart
from crane.ratings.lifting_capacity import Capacity
from crane.ratings.rating_chart import RatingChart, RatingValues
from crane.ratings.tool_forces import ToolForce
from crane.recordings.recording_summary import result_title
from crane.view.plots.figure_style import (
    CURVE_COLOURS,
    FAINT_COLOUR,
    INK_COLOUR,
    add_heading,
    add_side_colour_bar,
    escape_label,
    figure_style,
    set_round_ticks,
)
from crane.view.sketches.mechanism_projection import MachineOutline, machine_outline

FACTOR_COLOURS = (
    "#a9c8ea", "#f6c08c", "#a6d9b0", "#d5b8e4", "#f0aaa6", "#a5d8df", "#e5d98f", "#c3c7cd",
    "#e2b9d0", "#c9b79c",
)  # fmt: skip
_UNLIMITED_COLOUR = "#eeeeee"  # where nothing ends a load
BODY_COLOUR, ROD_COLOUR = "#4a4f57", "#8b929b"
_LABEL_SIZE = 7  # of contours [points]
_ROOM = 0.1  # above and below panels [inch]
_DENSE = 8  # parts of a contour within a cell, to end it where the cells do
_MAX_CONTOURS = 8


@figure_style
def capacity_figure(chart: Capacity) -> Figure:
    """Return the figure of a load chart, a panel per slew angle."""
    lower, upper = drawing_extent(chart)
    panel_count = len(chart.slews)
    columns = min(panel_count, 3)
    lines = -(-panel_count // columns)
    content_width, content_height = upper - lower
    height = float(np.clip(8.6 / columns * content_height / content_width, 3.0, 6.5))
    width = float(np.clip(columns * height * content_width / content_height + 1.0, 5.0, 10.0))
    figure = Figure(figsize=(width, lines * height + 1.3), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for k, axes in enumerate(panels[:panel_count]):
        draw_capacity_panel(axes, chart, k)
        if k % columns:
            axes.set_ylabel("")
    for axes in panels[panel_count:]:
        axes.set_axis_off()
    figure.set_layout_engine("constrained", h_pad=_ROOM)  # or headings touch
    add_heading(figure, escape_label(capacity_heading(chart)))
    figure.legend(
        handles=legend_patches(chart),
        loc="outside lower center",
        ncols=2 if panel_count > 1 else 1,
    )
    return figure


def _draw_factors(axes: Axes, chart: RatingChart, k: int) -> None:
    """Draw the limiting factors at slew angle k."""
    active_factors = list(chart.active_factors)
    index = np.full(chart.values.shape[1:], np.nan)
    for i, cause in enumerate(active_factors):
        index[chart.limiting_factor_index[k] == cause] = i
    index[np.isinf(chart.values[k])] = len(active_factors)
    tints = [*factor_colours(chart).values(), _UNLIMITED_COLOUR]
    if min(index.shape) > 1:
        axes.pcolormesh(
            chart.radii,
            chart.heights,
            np.ma.masked_invalid(index),
            cmap=ListedColormap(tints),
            vmin=-0.5,
            vmax=len(tints) - 0.5,
            shading="nearest",
            rasterized=True,
            zorder=1,
        )
        return
    b, a = np.nonzero(np.isfinite(index))
    axes.scatter(
        chart.radii[a],
        chart.heights[b],
        c=[tints[int(i)] for i in index[b, a]],
        edgecolors=INK_COLOUR,
        s=30,
        zorder=3,
    )


def capacity_heading(chart: RatingValues) -> str:
    """Return the heading of a load chart."""
    rule_text = "" if chart.rule.name == "none" else f" by {chart.rule.name}"
    return result_title(chart.machine.name, f"lifting capacity at {chart.frame}{rule_text}")


def factor_colours(chart: RatingValues) -> Mapping[int, str]:
    """Return the colour of each active limiting factor, by index."""
    return {k: FACTOR_COLOURS[i % len(FACTOR_COLOURS)] for i, k in enumerate(chart.active_factors)}


def legend_patches(chart: RatingValues) -> list[Patch]:
    """Return the legend: limiting factors in their colours."""
    patches = [
        Patch(color=colour, label=escape_label(str(chart.limiting_factors[k])))
        for k, colour in factor_colours(chart).items()
    ]
    if np.isinf(chart.values).any():
        patches.append(Patch(color=_UNLIMITED_COLOUR, label="no limit"))
    return patches


def home_outlines(chart: RatingValues) -> list[MachineOutline]:
    """Return outlines of the machine at home, turned to each slew angle."""
    outlines, machine = [], chart.machine
    for slew_coordinate in chart.slews:
        q = machine.home.copy()
        if chart.section.slewing_joint is not None:
            q[machine.closure.active[chart.section.slewing_joint]] = slew_coordinate
        outlines.append(machine_outline(machine, chart.frame, chart.section, q))
    return outlines


def drawing_extent(chart: Capacity | LiftChart) -> tuple[Array, Array]:
    """Return the lower and upper corner (2,) of the drawing [m]."""
    reached = chart.positions[~np.isnan(chart.loads).all(axis=0)]
    all_points = np.concatenate([reached, *(x.points for x in home_outlines(chart))])
    margin = 0.03 * float(np.ptp(all_points, axis=0).max())
    return all_points.min(axis=0) - margin, all_points.max(axis=0) + margin


def draw_capacity_panel(axes: Axes, chart: Capacity, k: int) -> None:
    """Draw the loads at slew angle k."""
    lower, upper = drawing_extent(chart)
    axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal")
    axes.grid(visible=False)
    _draw_factors(axes, chart, k)
    _draw_contours(axes, chart, k)
    if lower[1] < 0 < upper[1] and chart.section.coordinate_names[1] == "height":
        axes.axhline(0.0, color=INK_COLOUR, linewidth=1.0, zorder=2)
    draw_machine(axes, home_outlines(chart)[k])
    u, w = chart.section.coordinate_names
    axes.set(xlabel=f"{u} [m]", ylabel=f"{w} [m]")
    axes.set_title(slew_labels(chart)[k], fontsize=9.5, loc="left")
    set_round_ticks(axes, 8)


def load_contours(chart: Capacity, k: int) -> list[tuple[float, list[Array]]]:
    """Return contours (n, 2) at slew angle k by load [kg]; levels are equal at all angles."""
    if min(len(chart.radii), len(chart.heights)) < 2:
        return []
    finite_loads = chart.loads[np.isfinite(chart.loads)]
    finite_loads = finite_loads[finite_loads > 0]
    if not len(finite_loads):
        return []
    loads = chart.loads[k]
    beyond = np.ma.masked_invalid(_continued(np.where(np.isfinite(loads), loads, np.nan)))
    lines = contour_generator(chart.radii, chart.heights, beyond, name="serial")
    return [(level, [part for line in lines.lines(level)
                     for part in _parts_within(chart, k, np.asarray(line))])
            for level in round_levels(finite_loads, _MAX_CONTOURS)]  # fmt: skip


def _continued(loads: Array) -> Array:
    """Extrapolate loads (b, a) linearly by one cell around the positions that have loads.

    Otherwise contours would not reach the outer half of cells at the border.
    """
    b, a = loads.shape
    wide = np.pad(loads, 2, constant_values=np.nan)
    sums, counts = np.zeros(loads.shape), np.zeros(loads.shape)
    for i, j in itertools.product((-1, 0, 1), repeat=2):
        one, two = (wide[2 + n * i :, 2 + n * j :][:b, :a] for n in (1, 2))
        ahead = np.where(np.isfinite(two), 2 * one - two, one)
        sums += np.where(np.isfinite(ahead), ahead, 0.0)
        counts += np.isfinite(ahead)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(np.isfinite(loads), loads, sums / counts))


def _parts_within(chart: Capacity, k: int, line: Array) -> list[Array]:
    """Return the parts of a line (n, 2) within cells that have loads."""
    along = np.arange(len(line))
    fine = np.linspace(0.0, len(line) - 1.0, _DENSE * (len(line) - 1) + 1)
    points = np.column_stack([np.interp(fine, along, x) for x in line.T])
    a, b = (
        np.searchsorted((x[1:] + x[:-1]) / 2, points[:, i])
        for i, x in enumerate((chart.radii, chart.heights))
    )
    inside = np.isfinite(chart.loads[k, b, a])
    cuts = np.flatnonzero(np.diff(inside)) + 1
    parts = zip(np.split(points, cuts), np.split(inside, cuts), strict=True)
    return [part for part, kept in parts if kept[0] and len(part) > 1]


def _draw_contours(axes: Axes, chart: Capacity, k: int) -> None:
    """Draw contours, labelled in kg or t."""
    contour_lines = load_contours(chart, k)
    levels = [level for level, lines in contour_lines if lines]
    if not levels:
        return
    lines = ContourSet(
        axes,
        levels,
        [ways for _, ways in contour_lines if ways],
        colors=[INK_COLOUR],
        linewidths=0.9,
        zorder=4,
    )
    unit, scale = display_unit("kg", max(level for level, _ in contour_lines))

    axes.apply_aspect()
    style: Any = {"fmt": lambda level: f"{scale * level:g} {unit}", "fontsize": _LABEL_SIZE}
    positions: list[tuple[float, float]] = []
    boxes: list[Any] = []
    for draft in axes.clabel(lines, inline=False, **style):
        box = draft.get_window_extent()
        if not box.count_overlaps(boxes):
            positions.append(draft.get_position())
            boxes.append(box)
        draft.remove()
    labels = axes.clabel(lines, manual=positions, **style) if positions else []
    for label in labels:
        label.set_path_effects([withStroke(linewidth=1.6, foreground="white")])


def draw_machine(axes: Axes, machine_outline: MachineOutline) -> None:
    """Draw the outline of a machine."""
    if len(machine_outline.stationary_hull) > 1:  # an undercarriage is often no more than its feet
        axes.fill(
            *machine_outline.stationary_hull.T,
            facecolor=ROD_COLOUR,
            edgecolor=ROD_COLOUR,
            linewidth=4.0,
            zorder=4.9,
        )
    for body in machine_outline.bodies:
        if len(body) > 2:
            axes.fill(*body.T, facecolor=BODY_COLOUR, alpha=0.25, linewidth=0, zorder=5)
        axes.plot(*np.vstack([body, body[:1]]).T, color=BODY_COLOUR, linewidth=1.3, zorder=5.2,
                  solid_joinstyle="round", alpha=0.85)  # fmt: skip
    for start, mouth, end in machine_outline.cylinders:
        axes.plot(*np.array([start, end]).T, color=ROD_COLOUR, linewidth=1.2, zorder=5.4)
        axes.plot(*np.array([start, mouth]).T, color=BODY_COLOUR, linewidth=2.8, zorder=5.5,
                  solid_capstyle="butt")  # fmt: skip


@figure_style
def lift_figure(chart: LiftChart) -> Figure:
    """Return curves of load, force and angle over one stroke, or zones of load over two."""
    is_curve, (u, w) = len(chart.over) == 1, chart.section.coordinate_names
    count = 3 if is_curve else len(chart.slews)
    figure = Figure(figsize=(9.6 if is_curve else 6.4 * count, 5.4), layout="constrained")
    panels = figure.subplots(1, count, sharey=True, squeeze=False)[0]
    panels[0].set_ylabel(f"{w} [m]")
    if is_curve:
        _draw_lift_curves(panels, chart)
        figure.legend(handles=legend_patches(chart), loc="outside lower center", ncols=3)
    for k, axes in enumerate([] if is_curve else panels):
        draw_machine(axes, home_outlines(chart)[k])
        _draw_zones(axes, chart, k)
        axes.set(aspect="equal", xlabel=f"{u} [m]")
        axes.set_title(slew_labels(chart)[k], fontsize=9.5, loc="left")
    add_heading(figure, escape_label(capacity_heading(chart)))
    return figure


def _draw_lift_curves(panels: list[Axes], chart: LiftChart) -> None:
    # loads in the colours of their limiting factors, holding force and angle
    height, joint = chart.positions[0, :, 1], chart.over[0]
    unit = "kN" if chart.machine.unit(joint) == "m" else "kN m"
    force = chart.holding_forces[0, :, chart.machine.active.index(joint)] / 1e3
    for loads, factors, label in zip(
        chart.loads[:, 0], chart.limiting_factor_index[:, 0], slew_labels(chart), strict=True
    ):
        for k, colour in factor_colours(chart).items():
            panels[0].plot(np.where(factors == k, loads, np.nan), height, "o-", color=colour,
                           markersize=3.5)  # fmt: skip
        panels[0].annotate(f" {label}", (loads[0], height[0]), va="top", fontsize=_LABEL_SIZE)
    panels[0].set(xlabel="rated load [kg]", xlim=(0, None))
    panels[1].plot(force, height, color=CURVE_COLOURS[0])
    panels[1].set_xlabel(f"force of {escape_label(joint)} without load [{unit}]")
    panels[2].plot(np.rad2deg(chart.angles[0]), height, color=CURVE_COLOURS[0])
    panels[2].set_xlabel(f"angle of {escape_label(chart.frame)} [deg]")


def _draw_zones(axes: Axes, chart: LiftChart, k: int) -> None:
    # the reach with lines of the first stroke, and the edges of the zones of load
    style: Any = {"path_effects": [withStroke(linewidth=1.6, foreground="white")], "zorder": 6}
    for line in (*chart.positions, *np.swapaxes(chart.positions, 0, 1)[:: _DENSE // 2]):
        axes.plot(*line.T, color=FAINT_COLOUR, linewidth=0.6, zorder=1)
    for line, angle in list(zip(np.swapaxes(chart.positions, 0, 1), chart.boom_angles(),
                                strict=True))[:: _DENSE // 2]:  # fmt: skip
        axes.annotate(f" {np.rad2deg(angle):.0f}°", line[-1], fontsize=_LABEL_SIZE)
    for (load, [places]), colour in zip(zone_lines(chart, k), CURVE_COLOURS, strict=False):
        axes.plot(*places.T, color=colour, linewidth=2.0, zorder=5)
        axes.annotate(f"{load:g} kg", places[len(places) // 4], ha="center", rotation=90, **style)


def zone_lines(chart: LiftChart, k: int) -> list[tuple[float, list[Array]]]:
    """Return the edge (n, 2) of each zone at slew angle k by load [kg]; none over one stroke."""
    edges = chart.zone_edges[k] if len(chart.over) > 1 else ()
    rows = [np.column_stack([chart.strokes[0, :, 0], x])[np.isfinite(x)] for x in edges]
    return [
        (load, [chart.at_strokes(strokes[None]).positions[0]])
        for load, strokes in zip(chart.zones, rows, strict=False)
        if len(strokes)
    ]


_MAX_ARROWS = 12  # along the larger side


@figure_style
def tool_force_figure(chart: ToolForce) -> Figure:
    """Return a row per slew angle: forces with arrows, and limiting factors."""
    count = len(chart.slews)
    all_forces, directions = chart.forces / 1e3, chart.section_directions()
    largest_force = float(np.nanmax(np.where(np.isfinite(all_forces), all_forces, np.nan)))
    aspect = float(np.ptp(chart.heights)) / max(float(np.ptp(chart.radii)), 1e-9)
    height = float(np.clip(4.2 * aspect, 2.6, 6.5)) * count + 2.0
    figure = Figure(figsize=(9.6, height), layout="constrained")
    grid = figure.subplots(count, 2, squeeze=False, sharex=True, sharey=True)
    u, w = chart.section.coordinate_names
    for axes in grid[-1]:
        axes.set_xlabel(f"{u} [m]")
    for s, (left, right) in enumerate(grid):
        forces = np.ma.masked_invalid(all_forces[s])
        mesh = left.pcolormesh(
            chart.radii, chart.heights, forces, cmap="viridis", vmin=0.0, vmax=largest_force,
            shading="nearest", rasterized=True,
        )  # fmt: skip
        if np.ptp(forces.compressed()) > 0 and min(forces.shape) > 1:
            lines = left.contour(chart.radii, chart.heights, forces,
                                 levels=MaxNLocator(8).tick_values(0, largest_force),
                                 colors="white", linewidths=0.7)  # fmt: skip
            left.clabel(lines, fmt="%g", fontsize=7)
        _draw_arrows(left, chart, all_forces[s], directions[s], largest_force)
        add_side_colour_bar(left, mesh, "force [kN]")
        _draw_factors(right, chart, s)
        slew_text = f", slewed {np.rad2deg(chart.slews[s]):.4g}°" if count > 1 else ""
        left.set(title=f"largest force{slew_text}", ylabel=f"{w} [m]")
        right.set_title("limiting factor")
        for axes in (left, right):
            axes.set_aspect("equal")
            axes.grid(False)
    figure.legend(handles=legend_patches(chart), loc="outside lower center", ncols=2, fontsize=8)
    add_heading(
        figure, escape_label(result_title(chart.machine.name, f"tool force, {chart.direction}"))
    )
    return figure


def _draw_arrows(
    axes: Axes, chart: ToolForce, forces: Array, directions: Array, largest_force: float
) -> None:
    """Draw the direction of the force at some positions; the length shows the magnitude."""
    step = max(1, max(forces.shape) // _MAX_ARROWS)
    rows, columns = (np.arange(n % step // 2, n, step) for n in forces.shape)
    b, a = np.meshgrid(rows, columns, indexing="ij")
    b, a = (x[np.isfinite(forces[b, a])] for x in (b, a))
    if len(b):
        arrow_length = max(np.ptp(chart.radii), np.ptp(chart.heights)) / _MAX_ARROWS
        arrow_vectors = directions[b, a] * (forces[b, a] / largest_force * arrow_length)[:, None]
        axes.quiver(
            chart.radii[a],
            chart.heights[b],
            *arrow_vectors.T,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            color="#f2f2f2",
            edgecolor=INK_COLOUR,
            linewidth=0.4,
            width=0.008,
            pivot="mid",
        )


@figure_style
def section_figure(chart: SectionChart) -> Figure:
    """Return panels of the envelopes along the axis, one per quantity; stresses in one."""
    figure = Figure(figsize=(7.0, 8.4), layout="constrained")
    panels = figure.subplots(4, 1, sharex=True)
    drawn = (*panels, panels[-1]), (*CURVE_COLOURS[:1] * 4, CURVE_COLOURS[1])
    for (name, envelope), axes, color in zip(chart.envelopes.items(), *drawn, strict=True):
        unit, scale = section_unit(SECTION_UNITS[name], float(np.nanmax(np.abs(envelope))))
        low, high = scale * envelope
        label = name.replace("_", " ")
        axes.axhline(0.0, color="0.6", lw=0.6)
        axes.fill_between(chart.positions, low, high, alpha=0.25, color=color, label=label)
        axes.plot(chart.positions, low, chart.positions, high, color=color)
        axes.set_ylabel(f"{label.removeprefix('upper ')} [{unit}]")
    panels[3].legend(loc="best")
    panels[3].set_xlabel("position along the axis [m]")
    add_heading(
        figure, escape_label(result_title(chart.machine_name, f"sections of {chart.body}"))
    )
    return figure
