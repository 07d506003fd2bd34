"""Figures of tool forces: magnitude, direction and limiting factors."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch as Swatch
from matplotlib.ticker import MaxNLocator

from crane.common.samples import Array
from crane.ratings.tool_forces import ToolForce
from crane.recordings.recording_summary import result_title
from crane.view.plots.figure_style import (
    INK_COLOUR,
    add_heading,
    add_side_colour_bar,
    escape_label,
    figure_style,
)

_FACTOR_COLOURS = (
    "#1f5fa8",
    "#e0701a",
    "#2a8c4a",
    "#8a5fb0",
    "#d9b53f",
    "#b04a7a",
    "#3f8f9f",
    "#9a6b3f",
    "#7a7a7a",
    "#6f9bca",
    "#c2452d",
    "#333333",
)
_MAX_ARROWS = 12  # along the larger side


@figure_style
def tool_force_figure(chart: ToolForce) -> Figure:
    """Return a row per slew angle: forces with arrows, and limiting factors."""
    count, active_factors = len(chart.slews), chart.active_factors
    all_forces, directions = chart.forces / 1e3, chart.section_directions()
    largest_force = float(np.nanmax(np.where(np.isfinite(all_forces), all_forces, np.nan)))
    aspect = float(np.ptp(chart.heights)) / max(float(np.ptp(chart.radii)), 1e-9)
    height = float(np.clip(4.2 * aspect, 2.6, 6.5)) * count + 2.0
    figure = Figure(figsize=(9.6, height), layout="constrained")
    grid = figure.subplots(count, 2, squeeze=False, sharex=True, sharey=True)
    colors = {k: _FACTOR_COLOURS[j % len(_FACTOR_COLOURS)] for j, k in enumerate(active_factors)}
    options: Any = {"shading": "nearest", "rasterized": True}
    for s, (left, right) in enumerate(grid):
        forces = np.ma.masked_invalid(all_forces[s])
        mesh = left.pcolormesh(
            chart.radii, chart.heights, forces, cmap="viridis", vmin=0.0, vmax=largest_force,
            **options,
        )  # fmt: skip
        if np.ptp(forces.compressed()) > 0 and min(forces.shape) > 1:
            lines = left.contour(chart.radii, chart.heights, forces,
                                 levels=MaxNLocator(8).tick_values(0, largest_force),
                                 colors="white", linewidths=0.7)  # fmt: skip
            left.clabel(lines, fmt="%g", fontsize=7)
        _draw_arrows(left, chart, all_forces[s], directions[s], largest_force)
        add_side_colour_bar(left, mesh, "force [kN]")
        factor_index = np.full(forces.shape, np.nan)
        for j, k in enumerate(active_factors):
            factor_index[chart.limiting_factor_index[s] == k] = j
        palette = ListedColormap(list(colors.values()) or [INK_COLOUR])
        right.pcolormesh(chart.radii, chart.heights, np.ma.masked_invalid(factor_index),
                         cmap=palette, vmin=-0.5, vmax=max(len(colors), 1) - 0.5,
                         **options)  # fmt: skip
        slew_text = f", slewed {np.rad2deg(chart.slews[s]):.4g}°" if count > 1 else ""
        u, w = chart.section.coordinate_names
        left.set(title=f"largest force{slew_text}", ylabel=f"{w} [m]")
        right.set_title("limiting factor")
        for axes in (left, right):
            axes.set_aspect("equal")
            axes.grid(False)
            if s == count - 1:
                axes.set_xlabel(f"{u} [m]")
    figure.legend(
        handles=[
            Swatch(color=color, label=escape_label(str(chart.limiting_factors[k])))
            for k, color in colors.items()
        ],
        loc="outside lower center",
        ncols=2,
        fontsize=8,
    )
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
