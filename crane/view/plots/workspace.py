"""A workspace as one picture: what the tip reaches, and which strokes close."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch as Swatch
from matplotlib.ticker import MaxNLocator

from crane.common.samples import Array
from crane.motion.workspaces import Workspace
from crane.recordings.summary import READING_UNITS, title
from crane.view.plots.recording import DASHED, INK, RECORDED, STYLE, joint_symbol, write_figure
from crane.view.plots.text import plain

_REGION, _LINES, _OPEN = "#e3ecf6", "#a9c3e0", "#d9d9d9"
_STYLES = {
    "branch": {"color": "#c2452d", "linewidth": 1.8},
    "tip": {"color": DASHED["color"], "linewidth": 1.3, "linestyle": DASHED["linestyle"]},
}
_WORDS = {"branch": "end of the branch", "tip": "tip singular"}
_JUMP = 0.1  # share of the extent that neighbours on a line are not apart
_MOST = 30.0  # condition at which colours end
_DULL = 1.2  # condition up to which a drive has nothing to show
_TICKS = (1, 1.1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 7, 10, 15, 20, 30)
_LINES_SHOWN = 10  # of the grid, per stroke


def plot_workspace(space: Workspace, path: str | Path) -> None:
    """Write the picture of a workspace to a file.

    Args:
        space: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: workspace_figure(space))


def workspace_figure(space: Workspace) -> Figure:
    """The figure of a workspace.

    Left what the tip covers in the section, the images of even steps of the two strokes that
    move it most, and the machine at home; right over these two strokes the condition of the drive
    and the least singular value of the tip's slopes, grey where the loops do not close.
    """
    with mpl.rc_context(STYLE):
        low, high = space.places.min(axis=0), space.places.max(axis=0)
        skeleton = skeleton_of(space)
        low = np.minimum(low, skeleton.reshape(-1, 2).min(axis=0))
        high = np.maximum(high, skeleton.reshape(-1, 2).max(axis=0))
        tall = np.clip((high - low)[1] / max((high - low)[0], 1e-9), 0.45, 1.5)
        drives = float(np.nanmax(space.stroke_map.condition)) > _DULL
        height = float(np.clip(4.6 * tall, 4.2, 6.2)) + 0.7
        figure = Figure(figsize=(9.6, height), layout="constrained")
        grid = figure.add_gridspec(1 + drives, 2, width_ratios=[1.3, 1.0])
        _draw_section(figure.add_subplot(grid[:, 0]), space, skeleton, (low, high))
        right = [figure.add_subplot(grid[k, 1]) for k in range(1 + drives)]
        if drives:
            _draw_strokes(right[0], space, space.stroke_map.condition, "condition of the drive")
            right[0].sharex(right[1])
            right[0].tick_params(labelbottom=False)
            right[0].set_xlabel("")
        _draw_strokes(right[-1], space, space.stroke_map.least, "tip, least singular [m]")
        right[0].set_title(_held(space))
        _caption(figure, space)
    return figure


def _draw_section(
    axes: Axes, space: Workspace, skeleton: Array, limits: tuple[Array, Array]
) -> None:
    if space.area:
        raster = space.raster
        covered = raster.without_cracks(2 if space.complete else 6)
        axes.contourf(raster.u, raster.w, covered, [0.5, 1.5], colors=[_REGION], zorder=1)
        lines = _grid(space)
        axes.add_collection(LineCollection(lines, colors=_LINES, linewidths=0.6, zorder=2))
        axes.contour(
            raster.u, raster.w, covered, [0.5], colors=[RECORDED], linewidths=1.1, zorder=3
        )
    else:
        way = space.places[np.argsort(space.q_a[:, space.machine.active.index(space.strokes[0])])]
        axes.plot(*way.T, color=RECORDED, linewidth=1.8, zorder=3)
        axes.plot(*way[[0, -1]].T, "o", ms=4.5, color=RECORDED, mfc="white", zorder=4)
    for curve in space.curves:
        if len(curve.places) > 1:
            axes.plot(*curve.places.T, zorder=4, **_STYLES[curve.kind])
        else:
            axes.plot(*curve.places.T, "o", ms=5, color=_STYLES[curve.kind]["color"], zorder=5)
    axes.add_collection(LineCollection(list(skeleton), colors=INK, linewidths=1.6, zorder=5,
                                       capstyle="round", alpha=0.75))  # fmt: skip
    axes.plot(*skeleton.reshape(-1, 2).T, "o", ms=2.6, color=INK, zorder=5, alpha=0.75)
    home = space.section.coordinates(_home(space)[None])[0]
    axes.plot(*home, "o", ms=6, color=INK, mfc="white", mew=1.3, zorder=6)
    axes.set_aspect("equal")
    margin = 0.05 * float((limits[1] - limits[0]).max())
    axes.set_xlim(limits[0][0] - margin, limits[1][0] + margin)
    axes.set_ylim(limits[0][1] - margin, limits[1][1] + margin)
    axes.set_anchor("N")
    u, w = space.section.names
    axes.set(xlabel=f"{u} [m]", ylabel=f"{w} [m]", title=f"reach of {plain(space.frame)}")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(7, steps=[1, 2, 2.5, 5, 10]))


def _grid(space: Workspace) -> list[Array]:
    """Images (k, 2) of even steps of the two strokes of the map."""
    patch = space.stroke_map.patch
    places = np.full((*patch.closed.shape, 2), np.nan)
    kinematics = [_tip(space, q) for q in patch.q[patch.closed]]
    places[patch.closed] = space.section.coordinates(np.array(kinematics))
    extent = float(np.ptp(space.places, axis=0).max())
    lines: list[Array] = []
    for rows in (places, places.swapaxes(0, 1)):
        chosen = np.unique(np.linspace(0, len(rows) - 1, _LINES_SHOWN + 1).round().astype(int))
        for row in rows[chosen]:
            steps = np.linalg.norm(np.diff(row, axis=0), axis=1)
            cuts = np.flatnonzero(~(steps < _JUMP * extent)) + 1
            lines += [part for part in np.split(row, cuts) if not np.isnan(part).any()]
    return [line for line in lines if len(line) > 1]


def _tip(space: Workspace, q: Array) -> Array:
    model, data = space.machine.model, space.machine.model.createData()
    pin.forwardKinematics(model, data, space.machine.coordinates.configuration(q))
    frame = space.machine.frame(space.frame)
    return np.array(pin.updateFramePlacement(model, data, frame).translation)


def _home(space: Workspace) -> Array:
    return _tip(space, space.machine.home)


def skeleton_of(space: Workspace) -> Array:
    """Lines (k, 2, 2) between the joints of the machine at home, in the section."""
    machine, model = space.machine, space.machine.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, machine.coordinates.configuration(machine.home))
    ends = []
    for joint in range(1, model.njoints):
        if model.parents[joint] > 0:
            ends.append((data.oMi[model.parents[joint]].translation, data.oMi[joint].translation))
    loops = machine.closure.equations.loops
    for name in [name for loop in loops for name in (loop.predecessor, loop.successor)]:
        frame = machine.frame(name)
        parent = model.frames[frame].parentJoint
        if parent > 0:
            ends.append((data.oMi[parent].translation, data.oMf[frame].translation))
    frame = machine.frame(space.frame)
    parent = model.frames[frame].parentJoint
    ends.append((data.oMi[parent].translation, data.oMf[frame].translation))
    return space.section.coordinates(np.array(ends).reshape(-1, 3)).reshape(-1, 2, 2)


def _draw_strokes(axes: Axes, space: Workspace, values: Array, label: str) -> None:
    """A number (a, b) over the two strokes of the map, or over the only one."""
    machine, shown = space.machine, space.stroke_map
    patch = shown.patch
    names = [machine.active[i] for i in patch.pair]
    units = [READING_UNITS[machine.unit(name)] for name in names]
    factors = np.array([factor for _, factor in units])
    labels = [f"{joint_symbol(n)} [{u}]" for n, (u, _) in zip(names, units, strict=True)]
    home = machine.home[machine.closure.active][list(patch.pair)] * factors
    x = patch.axes[0] * factors[0]
    axes.set_xlabel(labels[0])
    axes.set_anchor("N")
    if patch.pair[0] == patch.pair[1]:
        axes.plot(x, values[:, 0], color=RECORDED)
        for curve in shown.curves:
            axes.axvline(curve.q_a[0, patch.pair[0]] * factors[0], **_STYLES[curve.kind])
        at = np.interp(home[0], x, values[:, 0])
        axes.plot(home[0], at, "o", ms=6, color=INK, mfc="white", mew=1.3)
        axes.set(xlim=(x[0], x[-1]), ylabel=label)
        top = min(float(np.nanmax(values)), _MOST * float(np.nanmin(values)) + 1)
        axes.set_ylim(0, 1.1 * top)
        return
    y = patch.axes[1] * factors[1]
    axes.grid(False)
    axes.set_facecolor(_OPEN)
    high = float(np.nanmax(values))
    cut = values is shown.condition and high > _MOST
    norm: Normalize = Normalize(0.0, high)
    if values is shown.condition:
        bottom = float(np.nanmin(values))
        norm = LogNorm(bottom, max(min(high, _MOST), 1.5 * bottom))
    mesh = axes.pcolormesh(
        x, y, np.ma.masked_invalid(values.T), norm=norm, shading="nearest", rasterized=True,
        cmap="viridis" if values is shown.condition else "cividis_r",
    )  # fmt: skip
    for curve in shown.curves:
        axes.plot(*(curve.q_a[:, list(patch.pair)] * factors).T, **_STYLES[curve.kind])
    axes.plot(*home, "o", ms=6, color=INK, mfc="white", mew=1.3)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), ylabel=labels[1])
    figure = axes.get_figure()
    assert figure is not None, "axes belong to a figure"
    place = axes.inset_axes((1.03, 0.03, 0.04, 0.94))
    bar = figure.colorbar(mesh, cax=place, label=label, extend="max" if cut else "neither")
    bar.outline.set_visible(False)
    if values is shown.condition:
        ticks = [value for value in _TICKS if (norm.vmin or 0) <= value <= (norm.vmax or 0)]
        bar.set_ticks(ticks, labels=[f"{value:g}" for value in ticks])
    bar.ax.minorticks_off()


def _held(space: Workspace) -> str:
    shown = [space.machine.active[i] for i in space.stroke_map.patch.pair]
    others = [joint_symbol(joint) for joint in space.strokes if joint not in shown]
    if not others:
        return "strokes" if len(space.strokes) > 1 else "along the stroke"
    return f"strokes, {', '.join(others) if len(others) < 3 else 'others'} at home"


def _caption(figure: Figure, space: Workspace) -> None:
    words = plain(title(space.machine.name, "workspace"))
    if space.slew is not None:
        i = space.machine.active.index(space.slew)
        turn = np.rad2deg([space.low[i], space.high[i]])
        words += f", turned by {joint_symbol(space.slew)} from {turn[0]:.4g}° to {turn[1]:.4g}°"
    figure.suptitle(words, x=0.01, ha="left", fontsize=11, fontweight="bold")
    handles: list[Line2D | Swatch] = [
        Line2D([], [], marker="o", ls="", color=INK, mfc="white", mew=1.3, label="home")
    ]
    kinds = {curve.kind for curve in (*space.curves, *space.stroke_map.curves)}
    for kind, words in _WORDS.items():
        if kind in kinds:
            handles.append(Line2D([], [], label=words, **_STYLES[kind]))
    if not space.stroke_map.patch.closed.all() and space.area:
        handles.append(Swatch(color=_OPEN, label="loops do not close"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
