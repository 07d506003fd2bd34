"""A design study as one picture: curves, maps, or scatter plots with rank correlations."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from scipy.stats import rankdata

from crane.common.samples import Array
from crane.recordings.summary import title
from crane.studies import Study
from crane.view.plots.recording import DASHED, RECORDED, STYLE, write_figure
from crane.view.plots.text import plain

_MOST_PANELS = 12  # measures of one picture
_MOST_SCATTERED = 6
_MOST_COLUMNS = 3
_TASK_COLORS = ("#2a9d6f", "#8a5fb0", "#c2452d", "#7f7f3f", "#3f8f9f")
_UNABLE = "#d9d9d9"


def plot_study(study: Study, path: str | Path) -> None:
    """Write the picture of a study to a file.

    Args:
        study: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: study_figure(study))


def study_figure(study: Study) -> Figure:
    """The figure of a study, a panel per measure; measures that do not change are left out.

    Of one parameter curves, of a grid of two maps with the best variant marked; of anything else
    points over each parameter with their rank correlation.
    """
    shown = [name for name in study.measures if _changes(study.columns[name])]
    shown = (shown or list(study.measures))[:_MOST_PANELS]
    with mpl.rc_context(STYLE):
        if not study.grid or len(study.parameters) > 2:
            figure = _scatter(study, shown[:_MOST_SCATTERED])
        else:
            figure = _panels(study, shown)
        words = title(Path(study.machine).stem, ", ".join(study.tasks))
        figure.suptitle(plain(words), x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def _changes(values: Array) -> bool:
    able = values[np.isfinite(values)]
    return bool(len(able) and np.ptp(able) > 1e-6 * max(np.abs(able).max(), 1e-12))


def _label(study: Study, name: str) -> str:
    unit = study.units[name]
    return plain(f"{name} [{unit}]" if unit else name)


def _panels(study: Study, shown: list[str]) -> Figure:
    columns = 2 if len(shown) == 4 else min(_MOST_COLUMNS, len(shown))
    rows = -(-len(shown) // columns)
    size = (max(5.2, 4.0 * columns), 3.3 * rows + 0.5)
    figure = Figure(figsize=size, layout="constrained")
    for index, name in enumerate(shown):
        axes = figure.add_subplot(rows, columns, index + 1)
        if len(study.parameters) == 1:
            _curves(axes, study, name)
        else:
            _map(figure, axes, study, name)
        axes.set_title(_label(study, name))
        axes.set_xlabel(_label(study, study.parameters[0]))
    lines = {
        line.get_label(): line
        for axes in figure.axes
        for line in axes.get_lines()
        if not str(line.get_label()).startswith("_")
    }
    if lines:
        handles, labels = list(lines.values()), [str(label) for label in lines]
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(lines), 6))
    return figure


def _curves(axes: Axes, study: Study, name: str) -> None:
    """One measure over one parameter, the values of each task below that of all together."""
    x = study.columns[study.parameters[0]]
    order = np.argsort(x)
    x = x[order]
    marker = "o" if len(x) < 40 else ""
    for k, task in enumerate(study.tasks):
        values = study.columns.get(f"{name} {task}")
        if values is not None:
            color = _TASK_COLORS[k % len(_TASK_COLORS)]
            axes.plot(
                x, values[order], marker=marker, ms=2.5, lw=1.0, color=color, label=plain(task)
            )
    able = study.columns[name][order]
    label = (
        "together" if f"{name} {study.tasks[0] if study.tasks else ''}" in study.columns else ""
    )
    width, color = (5.0, "#c4ccd4") if label else (1.4, RECORDED)  # below the lines of the tasks
    axes.plot(
        x, able, marker=marker, ms=width, lw=width, color=color, label=label or "_", zorder=1.5
    )
    best = study.order(name)[:1]
    axes.plot(
        study.columns[study.parameters[0]][best], study.columns[name][best], "*", ms=11,
        color=DASHED["color"], label="best",
    )  # fmt: skip
    for at, value in zip(x, able, strict=True):
        if not np.isfinite(value):  # a cross at the foot
            axes.plot(
                [at], [0.02], "x", ms=4, color="#909090", label="not possible",
                transform=axes.get_xaxis_transform(),
            )  # fmt: skip


def _map(figure: Figure, axes: Axes, study: Study, name: str) -> None:
    """One measure over a grid of two parameters, hatched where it cannot be measured."""
    first, second = (study.columns[name].reshape(study.grid) for name in study.parameters)
    x, y = first[:, 0], second[0]
    values = study.columns[name].reshape(study.grid).T
    unable = ~np.isfinite(values)
    axes.grid(False)
    mesh = axes.pcolormesh(
        x, y, np.ma.masked_array(values, unable), cmap="viridis", shading="nearest"
    )
    if unable.any():
        gray = np.ma.masked_array(np.zeros_like(values), ~unable)
        axes.pcolormesh(x, y, gray, cmap=ListedColormap([_UNABLE]), shading="nearest")
        axes.plot([], [], "s", ms=8, color=_UNABLE, label="not possible")
    if min(values.shape) > 1 and _changes(values):
        lines = axes.contour(x, y, np.ma.masked_array(values, unable), 6, colors="white",
                             linewidths=0.7)  # fmt: skip
        axes.clabel(lines, fontsize=6.5)
    figure.colorbar(mesh, ax=axes, shrink=0.9).outline.set_visible(False)
    best = study.order(name)[0]
    axes.plot(
        study.columns[study.parameters[0]][best], study.columns[study.parameters[1]][best], "*",
        ms=13, color=DASHED["color"], mec="white", mew=0.8, ls="", label="best", clip_on=False,
    )  # fmt: skip
    axes.set_ylabel(_label(study, study.parameters[1]))


def _draw_cloud(axes: Axes, x: Array, values: Array, best: Sequence[int]) -> None:
    """A measure over a parameter, ticks where it is missing, and how well their ranks agree."""
    able = np.isfinite(values)
    axes.plot(x[able], values[able], "o", ms=3, color=RECORDED, alpha=0.7)
    axes.plot(x[best], values[best], "*", ms=11, color=DASHED["color"])
    for at in x[~able]:
        axes.axvline(at, ymax=0.04, color="#909090", lw=0.8)
    if able.sum() > 2:
        r = np.corrcoef(rankdata(x[able]), rankdata(values[able]))[0, 1]
        axes.set_title(f"rank correlation {r:+.2f}", fontsize=7.5, loc="right")


def _scatter(study: Study, shown: list[str]) -> Figure:
    """Measures over parameters, all other parameters varying too."""
    size = (2.5 * len(study.parameters) + 0.8, 2.0 * len(shown) + 0.6)
    figure = Figure(figsize=(max(4.5, size[0]), size[1]), layout="constrained")
    panels = figure.subplots(
        len(shown), len(study.parameters), sharex="col", sharey="row", squeeze=False
    )
    for row, name in zip(panels, shown, strict=True):
        values = study.columns[name]
        best = study.order(name)[:1]
        for axes, parameter in zip(row, study.parameters, strict=True):
            x = study.columns[parameter]
            _draw_cloud(axes, x, values, best)
        row[0].set_ylabel(_label(study, name))
    for axes, parameter in zip(panels[-1], study.parameters, strict=True):
        axes.set_xlabel(_label(study, parameter))
    return figure
