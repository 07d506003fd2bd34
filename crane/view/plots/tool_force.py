"""Tool forces over the reach: how large, which way, and what ends them."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch as Swatch
from matplotlib.ticker import MaxNLocator

from crane.common.samples import Array
from crane.ratings.tool import ToolForce
from crane.recordings.summary import title
from crane.view.plots.recording import INK, STYLE, write_figure
from crane.view.plots.text import plain

_COLORS = ("#1f5fa8", "#e0701a", "#2a8c4a", "#8a5fb0", "#d9b53f", "#b04a7a", "#3f8f9f", "#9a6b3f",
           "#7a7a7a", "#6f9bca", "#c2452d", "#333333")  # fmt: skip
_ARROWS = 12  # along the larger side


def plot_tool_force(field: ToolForce, path: str | Path) -> None:
    """Write the picture of tool forces to a file.

    Args:
        field: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: tool_force_figure(field))


def tool_force_figure(field: ToolForce) -> Figure:
    """The figure: a row per slew, forces with arrows on the left, causes on the right."""
    count = len(field.slews)
    wide, tall = float(np.ptp(field.radii)), float(np.ptp(field.heights))
    ways = field.ways()
    top = float(np.nanmax(np.where(np.isfinite(field.forces), field.forces, np.nan))) / 1e3
    with mpl.rc_context(STYLE):
        height = np.clip(4.2 * tall / max(wide, 1e-9), 2.6, 6.5) * count + 2.0
        figure = Figure(figsize=(9.6, float(height)), layout="constrained")
        grid = figure.subplots(count, 2, squeeze=False, sharex=True, sharey=True)
        ends = field.ends
        colors = {k: _COLORS[j % len(_COLORS)] for j, k in enumerate(ends)}
        for s, (left, right) in enumerate(grid):
            forces = field.forces[s] / 1e3
            shown = np.ma.masked_invalid(forces)
            mesh = left.pcolormesh(
                field.radii, field.heights, shown, shading="nearest", cmap="viridis", vmin=0.0,
                vmax=top, rasterized=True,
            )  # fmt: skip
            if np.ptp(shown.compressed()) > 0 and min(shown.shape) > 1:
                lines = left.contour(field.radii, field.heights, shown,
                                     levels=MaxNLocator(8).tick_values(0, top),
                                     colors="white", linewidths=0.7)  # fmt: skip
                left.clabel(lines, fmt="%g", fontsize=7)
            _arrows(left, field, forces, ways[s], top)
            bar = figure.colorbar(
                mesh, cax=left.inset_axes((1.03, 0.03, 0.04, 0.94)), label="force [kN]"
            )
            bar.outline.set_visible(False)
            which = np.full(forces.shape, np.nan)
            for j, k in enumerate(ends):
                which[field.cause[s] == k] = j
            palette = ListedColormap([colors[k] for k in ends] or [INK])
            right.pcolormesh(field.radii, field.heights, np.ma.masked_invalid(which),
                             shading="nearest", cmap=palette, vmin=-0.5,
                             vmax=max(len(ends), 1) - 0.5, rasterized=True)  # fmt: skip
            turn = f", slewed {np.rad2deg(field.slews[s]):.4g}°" if count > 1 else ""
            left.set_title(f"largest force{turn}")
            right.set_title("what ends it")
            left.set_ylabel(f"{field.section.names[1]} [m]")
            for axes in (left, right):
                axes.set_aspect("equal")
                axes.grid(False)
                if s == count - 1:
                    axes.set_xlabel(f"{field.section.names[0]} [m]")
        handles = [Swatch(color=colors[k], label=plain(str(field.causes[k]))) for k in ends]
        figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=8)
        heading = plain(title(field.machine.name, f"tool force, {field.direction}"))
        figure.suptitle(heading, x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def _arrows(axes: Axes, field: ToolForce, forces: Array, ways: Array, top: float) -> None:
    """Which way the tool pushes, at some places, as long as the force is large."""
    step = max(1, max(forces.shape) // _ARROWS)
    rows, columns = (np.arange(n % step // 2, n, step) for n in forces.shape)
    b, a = np.meshgrid(rows, columns, indexing="ij")
    b, a = (x[np.isfinite(forces[b, a])] for x in (b, a))
    if len(b):
        spread = max(np.ptp(field.radii), np.ptp(field.heights)) / _ARROWS
        along = ways[b, a] * (forces[b, a] / top * spread)[:, None]
        axes.quiver(field.radii[a], field.heights[b], *along.T, angles="xy", scale_units="xy",
                    scale=1.0, color="#f2f2f2", edgecolor=INK, linewidth=0.4, width=0.008,
                    pivot="mid")  # fmt: skip
