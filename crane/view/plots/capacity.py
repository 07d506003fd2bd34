"""Rated loads over radius and height: contours, coloured by what ends them."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
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
from crane.common.units import reading
from crane.ratings import Capacity
from crane.ratings.words import sides
from crane.recordings.summary import title
from crane.view.plots.recording import INK, STYLE, write_figure
from crane.view.plots.text import plain
from crane.view.sketch.outline import Outline, outline

TINTS = (
    "#a9c8ea", "#f6c08c", "#a6d9b0", "#d5b8e4", "#f0aaa6", "#a5d8df", "#e5d98f", "#c3c7cd",
    "#e2b9d0", "#c9b79c",
)  # fmt: skip
_FREE = "#eeeeee"  # where nothing ends a load
BODY, ROD = "#4a4f57", "#8b929b"
_FONT, _LETTER, _APART = 7, 0.62, 1.5  # of labels: points, width, distance by that
_TRIED = (0.5, 0.35, 0.65, 0.2, 0.8, 0.1, 0.9)  # shares of a line
_ROOM = 0.1  # above and below panels [inch]
_DENSE = 8  # parts of a contour within a cell, to end it where the cells do
_LEVELS, _SHOWN = 8, (0.05, 0.9)  # contours at most, and between which quantiles of the loads
_ROUND = np.array([1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10])


def plot_capacity(chart: Capacity, path: str | Path) -> None:
    """Write the picture of rated loads to a file.

    Args:
        chart: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: capacity_figure(chart))


def capacity_figure(chart: Capacity) -> Figure:
    """The figure of rated loads: one panel per slew angle."""
    low, high = extent(chart)
    many = len(chart.slews)
    columns = min(many, 3)
    lines = -(-many // columns)
    wide, tall = high - low
    height = float(np.clip(8.6 / columns * tall / wide, 3.0, 6.5))
    width = float(np.clip(columns * height * wide / tall + 1.0, 5.0, 10.0))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, lines * height + 1.3), layout="constrained")
        panels = figure.subplots(lines, columns, squeeze=False).ravel()
        for k, axes in enumerate(panels):
            if k < many:
                draw_panel(axes, chart, k)
                if k % columns:
                    axes.set_ylabel("")
            else:
                axes.set_axis_off()
        figure.set_layout_engine("constrained", h_pad=_ROOM)  # or headings touch
        figure.suptitle(plain(heading(chart)), x=0.01, ha="left", fontsize=11, fontweight="bold")
        figure.legend(
            handles=swatches(chart), loc="outside lower center", ncols=2 if many > 1 else 1
        )
    return figure


def heading(chart: Capacity) -> str:
    """What pictures of a chart are headed with."""
    by = "" if chart.rule.name == "none" else f" by {chart.rule.name}"
    return title(chart.machine.name, f"lifting capacity at {chart.frame}{by}")


def colours(chart: Capacity) -> Mapping[int, str]:
    """Of each cause that ends loads, by its index."""
    return {k: TINTS[i % len(TINTS)] for i, k in enumerate(chart.ends)}


def swatches(chart: Capacity) -> list[Patch]:
    """The legend: causes in their colours."""
    found = [
        Patch(color=tint, label=plain(str(chart.causes[k]))) for k, tint in colours(chart).items()
    ]
    if np.isinf(chart.loads).any():
        found.append(Patch(color=_FREE, label="nothing ends it"))
    return found


def homes(chart: Capacity) -> list[Outline]:
    """The machine at home, turned to each slew angle."""
    out, machine = [], chart.machine
    for turn in chart.slews:
        q = machine.home.copy()
        if chart.section.slew is not None:
            q[machine.closure.active[chart.section.slew]] = turn
        out.append(outline(machine, chart.frame, chart.section, q))
    return out


def extent(chart: Capacity) -> tuple[Array, Array]:
    """Lowest and highest corner (2,) of what is shown [m]."""
    b, a = np.nonzero(~np.isnan(chart.loads).all(axis=0))
    points = [np.column_stack([chart.radii[a], chart.heights[b]])]
    for one in homes(chart):
        points += [*one.bodies, one.cylinders.reshape(-1, 2), one.standing]
    every = np.concatenate(points)
    margin = 0.03 * float(np.ptp(every, axis=0).max())
    return every.min(axis=0) - margin, every.max(axis=0) + margin


def draw_panel(axes: Axes, chart: Capacity, k: int) -> None:
    """Loads at one slew angle."""
    low, high = extent(chart)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.grid(visible=False)
    shown = list(chart.ends)
    index = np.full(chart.loads.shape[1:], np.nan)
    for i, cause in enumerate(shown):
        index[chart.cause[k] == cause] = i
    index[np.isinf(chart.loads[k])] = len(shown)
    tints = [*colours(chart).values(), _FREE]
    if len(chart.radii) > 1 and len(chart.heights) > 1:
        axes.pcolormesh(
            chart.radii, chart.heights, np.ma.masked_invalid(index), cmap=ListedColormap(tints),
            vmin=-0.5, vmax=len(tints) - 0.5, shading="nearest", rasterized=True, zorder=1,
        )  # fmt: skip
        _draw_contours(axes, chart, k)
    else:
        b, a = np.nonzero(np.isfinite(index))
        faces = [tints[int(i)] for i in index[b, a]]
        axes.scatter(chart.radii[a], chart.heights[b], c=faces, edgecolors=INK, s=30, zorder=3)
    if low[1] < 0 < high[1] and chart.section.names[1] == "height":
        axes.axhline(0.0, color=INK, linewidth=1.0, zorder=2)
    _draw_machine(axes, homes(chart)[k])
    u, w = chart.section.names
    axes.set(xlabel=f"{u} [m]", ylabel=f"{w} [m]")
    axes.set_title(sides(chart)[k], fontsize=9.5, loc="left")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(8, steps=[1, 2, 2.5, 5, 10]))


def contours(chart: Capacity, k: int) -> list[tuple[float, list[Array]]]:
    """Lines (n, 2) of equal load at one slew angle, by their load [kg]; the same at all angles."""
    if min(len(chart.radii), len(chart.heights)) < 2:
        return []
    finite = chart.loads[np.isfinite(chart.loads)]
    finite = finite[finite > 0]
    if not len(finite):
        return []
    loads = chart.loads[k]
    beyond = np.ma.masked_invalid(_continued(np.where(np.isfinite(loads), loads, np.nan)))
    lines = contour_generator(chart.radii, chart.heights, beyond, name="serial")
    low, high = np.quantile(finite, _SHOWN)
    return [(level, [part for line in lines.lines(level)
                     for part in _parts_within(chart, k, np.asarray(line))])
            for level in _levels(float(low), float(high))]  # fmt: skip


def _continued(loads: Array) -> Array:
    """Loads (b, a), and around them those that two places beside continue, in a straight line.

    Of cells at the border the contours would miss the outer half else.
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
    """Parts of a line (n, 2) within the cells that have loads."""
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
    """Lines of equal load, labelled in kg or t."""
    found = contours(chart, k)
    levels = [level for level, lines in found if lines]
    if not levels:
        return
    lines = ContourSet(axes, levels, [ways for _, ways in found if ways], colors=[INK],
                       linewidths=0.9, zorder=4)  # fmt: skip
    unit, scale = reading("kg", max(level for level, _ in found))

    def said(level: float) -> str:
        return f"{scale * level:g} {unit}"

    axes.apply_aspect()
    size = float(np.ptp(axes.transData.transform([(0, 0), (1, 0)])[:, 0])) * 72 / axes.figure.dpi
    places = label_places([(said(level), lines) for level, lines in found], size)
    if not places:
        return
    words = axes.clabel(lines, fmt=said, fontsize=_FONT, manual=places)
    for word in words or ():
        word.set_path_effects([withStroke(linewidth=1.6, foreground="white")])


def label_places(
    lines: Sequence[tuple[str, list[Array]]], size: float
) -> list[tuple[float, float]]:
    """Where on lines there is room for their labels: none upon another, few on a bundle of lines.

    Args:
        lines: Words, and lines (n, 2) [m] that they stand on.
        size: Points of a metre.
    """
    taken = np.empty((0, 2))
    places: list[tuple[float, float]] = []
    for words, ways in lines:
        wide = _LETTER * _FONT * len(words) / size
        high = _APART * _FONT / size
        for way in ways:
            along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
            if along[-1] < 1.5 * wide:
                continue
            for share in _TRIED:
                at = along[-1] * share + wide * np.linspace(-0.5, 0.5, 5)
                if at[0] < 0 or at[-1] > along[-1]:
                    continue
                spots = np.column_stack([np.interp(at, along, x) for x in way.T])
                apart = np.linalg.norm(spots[:, None] - taken, axis=2)
                if (apart > high).all():
                    taken = np.concatenate([taken, spots])
                    places.append((float(spots[2, 0]), float(spots[2, 1])))
                    break
    return places


def _levels(low: float, high: float) -> list[float]:
    """Round loads, denser where they are small, as the load falls with the radius."""
    out = set()
    for load in np.geomspace(max(low, 1e-3 * high), high, _LEVELS):
        power = 10.0 ** np.floor(np.log10(load))
        out.add(float(power * _ROUND[int(np.abs(_ROUND * power - load).argmin())]))
    return sorted(out)


def _draw_machine(axes: Axes, seen: Outline) -> None:
    if len(seen.standing) > 1:  # an undercarriage is often no more than its feet
        axes.fill(*seen.standing.T, facecolor=ROD, edgecolor=ROD, linewidth=4.0, zorder=4.9)
    for body in seen.bodies:
        if len(body) > 2:
            axes.fill(*body.T, facecolor=BODY, alpha=0.25, linewidth=0, zorder=5)
        axes.plot(*np.vstack([body, body[:1]]).T, color=BODY, linewidth=1.3, zorder=5.2,
                  solid_joinstyle="round", alpha=0.85)  # fmt: skip
    for start, mouth, end in seen.cylinders:
        axes.plot(*np.array([start, end]).T, color=ROD, linewidth=1.2, zorder=5.4)
        axes.plot(*np.array([start, mouth]).T, color=BODY, linewidth=2.8, zorder=5.5,
                  solid_capstyle="butt")  # fmt: skip
