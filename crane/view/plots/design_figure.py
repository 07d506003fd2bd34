"""Figures of design optimizations: parameters of all solutions, Pareto front."""

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from crane.studies.optimization.design_optimization import Design
from crane.view.plots.figure_text import escape_label
from crane.view.plots.recording_figure import (
    DASHED_STYLE,
    FIGURE_STYLE,
    RECORDED_COLOUR,
)


@mpl.rc_context(FIGURE_STYLE)
def design_figure(result: Design) -> Figure:
    """Return solutions over their ranges, and of several objectives the first two."""
    is_multi_objective = len(result.objectives) > 1
    height = max(2.2, 0.9 + 0.34 * len(result.parameter_names))
    figure = Figure(
        figsize=(
            10.0 if is_multi_objective else 7.0,
            max(height, 3.6 if is_multi_objective else 2.2),
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
        front = np.array([x.objectives[:2] for x in result.solutions])
        axes[0].plot(
            *front.T,
            "o",
            linestyle=DASHED_STYLE,
            color=RECORDED_COLOUR,
            markersize=5,
            linewidth=1.0,
        )
        axes[0].plot(*result.initial.objectives[:2], "D", color="#c2452d", markersize=6)
        axes[0].set(
            xlabel=escape_label(result.objectives[0]), ylabel=escape_label(result.objectives[1])
        )
    goal = "; ".join(result.objectives)
    figure.suptitle(
        escape_label(f"{result.machine.name}: {goal}"),
        x=0.01,
        ha="left",
        fontsize=10,
        fontweight="bold",
    )
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    return figure
