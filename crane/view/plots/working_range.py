"""A working range as brochures draw it: the lip's reach, the machine, and dimension lines."""

import string
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from crane.common.samples import Array
from crane.ratings.dimensions import Dimension
from crane.ratings.ranges import WorkingRange
from crane.recordings.summary import title
from crane.view.plots.recording import DASHED, INK, RECORDED, STYLE, write_figure
from crane.view.plots.text import plain
from crane.view.plots.workspace import skeleton_of

_REGION, _SOIL, _LINE = "#e3ecf6", "#8a6d4b", "#666666"
_GAP = 0.055  # between dimension lines, of the drawing's larger extent
_UP = ("depth", "height")  # words of what is measured upright


def plot_working_range(found: WorkingRange, path: str | Path) -> None:
    """Write the picture of a working range to a file.

    Args:
        found: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: working_range_figure(found))


def working_range_figure(found: WorkingRange) -> Figure:
    """The figure of a working range.

    What the lip reaches, the machine at home, the ground, and a lettered line for every
    dimension: those upright to the right, the shorter the nearer, those from the slewing axis
    below and above. Shorter ones lie inside, so that no line crosses another one.
    """
    space = found.space
    with mpl.rc_context(STYLE):
        skeleton = skeleton_of(space)
        points = skeleton.reshape(-1, 2)
        low = [min(space.places[:, k].min(), points[:, k].min()) for k in (0, 1)]
        high = [max(space.places[:, k].max(), points[:, k].max()) for k in (0, 1)]
        low[1], low[0] = min(low[1], found.ground), min(low[0], 0.0)
        gap = _GAP * max(high[0] - low[0], high[1] - low[1])
        lettered = dict(zip(string.ascii_uppercase, found.dimensions, strict=False))
        upright = {a: x for a, x in lettered.items() if _UP[0] in x.name or _UP[1] in x.name}
        flat = {a: x for a, x in lettered.items() if a not in upright}
        above = {a: x for a, x in flat.items() if "slewing" in x.name}
        below = {a: x for a, x in flat.items() if a not in above}
        figure = Figure(figsize=(9.6, 6.8), layout="constrained")
        axes = figure.subplots()
        raster = space.raster
        covered = raster.without_cracks(2 if space.complete else 6)
        axes.contourf(raster.u, raster.w, covered, [0.5, 1.5], colors=[_REGION], zorder=1)
        axes.contour(
            raster.u, raster.w, covered, [0.5], colors=[RECORDED], linewidths=1.2, zorder=3
        )
        for line in skeleton:
            axes.plot(*line.T, color=INK, linewidth=1.6, solid_capstyle="round", zorder=5)
        axes.plot(*points.T, "o", ms=2.6, color=INK, zorder=5)
        right = max(high[0], 0.0)
        columns = _columns(upright, found.ground)
        end = right + gap * (len(columns) + 0.7)
        axes.plot([low[0] - gap, end], [found.ground] * 2, color=_SOIL, linewidth=1.4, zorder=4)
        for k, column in enumerate(columns):
            for letter, one in column:
                u = right + gap * (k + 1)
                _line(axes, letter, (u, found.ground), (u, one.place[1]), one.place)
        rows: list[tuple[str, Dimension, float]] = []
        for some, edge, way in ((below, low[1], -1.0), (above, high[1], 1.0)):
            order = sorted(some.items(), key=lambda item: item[1].value)
            rows += [(a, x, edge + way * gap * (k + 1)) for k, (a, x) in enumerate(order)]
        for letter, one, w in rows:
            _line(axes, letter, (0.0, w), (one.place[0], w), one.place)
        heights = [w for *_, w in rows]
        bottom, top = min([low[1], *heights]) - gap, max([high[1], *heights]) + gap
        if flat:
            axes.plot([0, 0], [bottom, top], color=_LINE, linewidth=0.8, zorder=2,
                      linestyle=(0, (8, 2, 1, 2)))  # fmt: skip
        _level(axes, found)
        axes.set_aspect("equal")
        axes.set(xlim=(low[0] - gap, end), ylim=(bottom, top))
        axes.grid(False)
        names = space.section.names
        axes.set(xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(9, steps=[1, 2, 2.5, 5, 10]))
        digits = 2 if max(high[0], high[1]) > 2 else 3
        words = [f"{a}  {x.name}  {x.value:.{digits}f} m" for a, x in lettered.items()]
        axes.text(1.03, 1.0, "\n".join(words), transform=axes.transAxes, va="top",
                  linespacing=1.8)  # fmt: skip
        heading = plain(title(found.machine.name, "working range"))
        figure.suptitle(heading, x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def _columns(upright: dict[str, Dimension], ground: float) -> list[list[tuple[str, Dimension]]]:
    """What shares a line: one above the ground and one below it, the shorter ones first."""
    sides = [
        sorted(
            (item for item in upright.items() if (item[1].place[1] > ground) == over),
            key=lambda item: item[1].value,
        )
        for over in (False, True)
    ]
    count = max(len(side) for side in sides)
    return [[side[k] for side in sides if k < len(side)] for k in range(count)]


def _line(
    axes: Axes, letter: str, start: tuple[float, float], end: tuple[float, float], place: Array
) -> None:
    """A dimension line with its letter, and a thin one from the place that it measures."""
    axes.plot([place[0], end[0]], [place[1], end[1]], color=_LINE, linewidth=0.5, zorder=2)
    axes.plot(*place, "o", ms=3.2, color=DASHED["color"], zorder=6)
    axes.annotate(
        "", end, start, zorder=6,
        arrowprops={"arrowstyle": "<|-|>", "color": INK, "linewidth": 0.9, "shrinkA": 0,
                    "shrinkB": 0, "mutation_scale": 9},
    )  # fmt: skip
    middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    axes.annotate(
        letter, middle, ha="center", va="center", fontsize=9, fontweight="bold", zorder=7,
        bbox={"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": "none"},
    )  # fmt: skip


def _level(axes: Axes, found: WorkingRange) -> None:
    """The level bottom itself."""
    for one in found.dimensions:
        if "level bottom" in one.name:
            ends = [one.place[0], one.place[0] + found.level]
            axes.plot(ends, [one.place[1]] * 2, color=DASHED["color"], linewidth=1.8, zorder=6)
