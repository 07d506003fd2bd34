"""Figures of studies and design optimizations: curves, maps, scatter plots, solutions."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from scipy.stats import rankdata

from crane.common.samples import Array
from crane.recordings.recording_summary import result_title
from crane.studies.optimization.design_optimization import Design
from crane.studies.study_table import Study
from crane.view.plots.figure_style import (
    CURVE_COLOURS,
    DASHED_STYLE,
    RECORDED_COLOUR,
    add_heading,
    escape_label,
    figure_style,
)

_MAX_PANELS = 12  # measures of one picture
_MAX_SCATTER_ROWS = 6
_MAX_COLUMNS = 3
_INFEASIBLE_COLOUR = "#d9d9d9"


@figure_style
def study_figure(study: Study) -> Figure:
    """Return the figure of a study, a panel per measure that varies.

    One parameter gives curves, a grid of two gives maps with the best variant; otherwise points
    are drawn over each parameter with their rank correlation.
    """
    shown_measures = [name for name in study.measures if _is_varying(study.columns[name])]
    shown_measures = (shown_measures or list(study.measures))[:_MAX_PANELS]
    if not study.grid_shape or len(study.parameters) > 2:
        figure = _draw_scatter(study, shown_measures[:_MAX_SCATTER_ROWS])
    else:
        figure = _draw_panels(study, shown_measures)
    add_heading(
        figure,
        escape_label(result_title(Path(study.machine_reference).stem, ", ".join(study.tasks))),
    )
    return figure


def _is_varying(values: Array) -> bool:
    finite_values = values[np.isfinite(values)]
    return bool(
        len(finite_values)
        and np.ptp(finite_values) > 1e-6 * max(np.abs(finite_values).max(), 1e-12)
    )


def _column_label(study: Study, name: str) -> str:
    unit = study.units[name]
    return escape_label(f"{name} [{unit}]" if unit else name)


def _draw_panels(study: Study, shown_measures: list[str]) -> Figure:
    columns = 2 if len(shown_measures) == 4 else min(_MAX_COLUMNS, len(shown_measures))
    rows = -(-len(shown_measures) // columns)
    figure = Figure(figsize=(max(5.2, 4.0 * columns), 3.3 * rows + 0.5), layout="constrained")
    for index, name in enumerate(shown_measures):
        axes = figure.add_subplot(rows, columns, index + 1)
        if len(study.parameters) == 1:
            _draw_curves(axes, study, name)
        else:
            _draw_map(figure, axes, study, name)
        axes.set(
            title=_column_label(study, name), xlabel=_column_label(study, study.parameters[0])
        )
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    named = [line for label, line in lines.items() if not str(label).startswith("_")]
    if named:
        figure.legend(handles=named, loc="outside lower center", ncols=min(len(named), 6))
    return figure


def _draw_curves(axes: Axes, study: Study, name: str) -> None:
    """Draw one measure over one parameter, over all tasks and by task."""
    x = study.columns[study.parameters[0]]
    order = np.argsort(x)
    x = x[order]
    marker = "o" if len(x) < 40 else ""
    for k, task in enumerate(study.tasks):
        values = study.columns.get(f"{name} {task}")
        if values is not None:
            axes.plot(
                x,
                values[order],
                marker=marker,
                ms=2.5,
                lw=1.0,
                color=CURVE_COLOURS[2 + k % 10],
                label=escape_label(task),
            )
    measure_values = study.columns[name][order]
    label = (
        "together" if f"{name} {study.tasks[0] if study.tasks else ''}" in study.columns else ""
    )
    width, color = (
        (5.0, "#c4ccd4") if label else (1.4, RECORDED_COLOUR)
    )  # below the lines of the tasks
    axes.plot(
        x,
        measure_values,
        marker=marker,
        ms=width,
        lw=width,
        color=color,
        label=label or "_",
        zorder=1.5,
    )
    best_variant = study.rank(name)[:1]
    axes.plot(
        study.columns[study.parameters[0]][best_variant],
        study.columns[name][best_variant],
        "*",
        ms=11,
        color=DASHED_STYLE["color"],
        label="best",
    )
    missing = x[~np.isfinite(measure_values)]
    if len(missing):  # crosses at the foot
        axes.plot(
            missing, np.full(len(missing), 0.02), "x", ms=4, color="#909090",
            label="not possible", transform=axes.get_xaxis_transform(),
        )  # fmt: skip


def _draw_map(figure: Figure, axes: Axes, study: Study, name: str) -> None:
    """Draw one measure over a grid of two parameters; grey where it is not possible."""
    first_values, second_values = (
        study.columns[name].reshape(study.grid_shape) for name in study.parameters
    )
    x, y = first_values[:, 0], second_values[0]
    values = study.columns[name].reshape(study.grid_shape).T
    is_infeasible = ~np.isfinite(values)
    axes.grid(False)
    mesh = axes.pcolormesh(
        x, y, np.ma.masked_array(values, is_infeasible), cmap="viridis", shading="nearest"
    )
    if is_infeasible.any():
        axes.pcolormesh(
            x,
            y,
            np.ma.masked_array(np.zeros_like(values), ~is_infeasible),
            cmap=ListedColormap([_INFEASIBLE_COLOUR]),
            shading="nearest",
        )
        axes.plot([], [], "s", ms=8, color=_INFEASIBLE_COLOUR, label="not possible")
    if min(values.shape) > 1 and _is_varying(values):
        lines = axes.contour(x, y, np.ma.masked_array(values, is_infeasible), 6, colors="white",
                             linewidths=0.7)  # fmt: skip
        axes.clabel(lines, fontsize=6.5)
    figure.colorbar(mesh, ax=axes, shrink=0.9).outline.set_visible(False)
    best_variant = study.rank(name)[0]
    axes.plot(
        study.columns[study.parameters[0]][best_variant],
        study.columns[study.parameters[1]][best_variant],
        "*",
        ms=13,
        color=DASHED_STYLE["color"],
        mec="white",
        mew=0.8,
        ls="",
        label="best",
        clip_on=False,
    )
    axes.set_ylabel(_column_label(study, study.parameters[1]))


def _draw_cloud(axes: Axes, x: Array, values: Array, best_variant: Sequence[int]) -> None:
    """Draw a measure over a parameter with ticks for missing values and rank correlation."""
    is_finite = np.isfinite(values)
    axes.plot(x[is_finite], values[is_finite], "o", ms=3, color=RECORDED_COLOUR, alpha=0.7)
    axes.plot(x[best_variant], values[best_variant], "*", ms=11, color=DASHED_STYLE["color"])
    for missing_value in x[~is_finite]:
        axes.axvline(missing_value, ymax=0.04, color="#909090", lw=0.8)
    if is_finite.sum() > 2:
        r = np.corrcoef(rankdata(x[is_finite]), rankdata(values[is_finite]))[0, 1]
        axes.set_title(f"rank correlation {r:+.2f}", fontsize=7.5, loc="right")


def _draw_scatter(study: Study, shown_measures: list[str]) -> Figure:
    """Draw measures over each parameter, while all parameters vary."""
    size = (2.5 * len(study.parameters) + 0.8, 2.0 * len(shown_measures) + 0.6)
    figure = Figure(figsize=(max(4.5, size[0]), size[1]), layout="constrained")
    panels = figure.subplots(
        len(shown_measures), len(study.parameters), sharex="col", sharey="row", squeeze=False
    )
    for row, name in zip(panels, shown_measures, strict=True):
        best_variant = study.rank(name)[:1]
        for axes, parameter in zip(row, study.parameters, strict=True):
            _draw_cloud(axes, study.columns[parameter], study.columns[name], best_variant)
        row[0].set_ylabel(_column_label(study, name))
    for axes, parameter in zip(panels[-1], study.parameters, strict=True):
        axes.set_xlabel(_column_label(study, parameter))
    return figure


@figure_style
def design_figure(result: Design) -> Figure:
    """Return solutions over their ranges, and of several objectives the first two."""
    is_multi_objective = len(result.objectives) > 1
    figure = Figure(
        figsize=(
            10.0 if is_multi_objective else 7.0,
            max(
                max(2.2, 0.9 + 0.34 * len(result.parameter_names)),
                3.6 if is_multi_objective else 2.2,
            ),
        )
    )
    axes = figure.subplots(1, 2 if is_multi_objective else 1, squeeze=False)[0]
    parameter_axes, ranges = axes[-1], result.upper - result.lower
    rows = np.arange(len(result.parameter_names))
    for k, x in enumerate(reversed(result.solutions)):
        is_best = k == len(result.solutions) - 1
        parameter_axes.plot(
            (x.values - result.lower) / ranges,
            rows,
            "o-" if is_best and not is_multi_objective else "o",
            color=RECORDED_COLOUR if is_best or is_multi_objective else "#b8b8b8",
            markersize=5,
            linewidth=1.2,
            label=("best" if not is_multi_objective else "solutions") if is_best else None,
        )
    parameter_axes.plot(
        (result.initial.values - result.lower) / ranges,
        rows,
        "D",
        color="#c2452d",
        markersize=5,
        label="before",
    )
    parameter_axes.set_yticks(rows, [escape_label(name) for name in result.parameter_names])
    parameter_axes.set(
        ylim=(len(rows) - 0.5, -0.5), xlim=(-0.03, 1.03), xlabel="share of the range"
    )
    parameter_axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=2, frameon=False)
    if is_multi_objective:
        axes[0].plot(
            *np.array([x.objectives[:2] for x in result.solutions]).T,
            "o",
            linestyle=DASHED_STYLE["linestyle"],
            color=RECORDED_COLOUR,
            markersize=5,
            linewidth=1.0,
        )
        axes[0].plot(*result.initial.objectives[:2], "D", color="#c2452d", markersize=6)
        axes[0].set(
            xlabel=escape_label(result.objectives[0]), ylabel=escape_label(result.objectives[1])
        )
    goal = "; ".join(result.objectives)
    add_heading(figure, escape_label(f"{result.machine.name}: {goal}"))
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    return figure
