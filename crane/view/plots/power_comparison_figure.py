"""Power accounts of several runs beside each other: bars of energy, and power over time."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from crane.common.units import display_unit, format_number
from crane.hydraulics.power_balance import SHAFT_POWER
from crane.studies.power_balance_result import POWER_CLASSES
from crane.studies.power_balance_result import PowerComparison
from crane.view.plots.figure_text import escape_label
from crane.view.plots.recording_figure import FIGURE_STYLE, INK_COLOUR, write_figure

_RUN_COLOURS = (
    "#1f5fa8",
    "#e0701a",
    "#2a8c4a",
    "#8a5fb0",
    "#b04a7a",
    "#3f8f9f",
    "#9a6b3f",
    "#7a7a7a",
)
_BAR_HEIGHT, _GROUP_GAP = 0.14, 0.12  # of a bar, between groups of them [inch]
_MIN_BAR_SHARE = 1e-3  # share of the largest run's energy that has a bar


def plot_power_comparison(comparison: PowerComparison, path: str | Path) -> None:
    """Write the picture to a file; see `plot_power`."""
    write_figure(path, lambda: power_comparison_figure(comparison))


def power_comparison_figure(comparison: PowerComparison) -> Figure:
    """What the shafts' energy goes into, a bar per run, and above it what they give over time."""
    runs = list(comparison.balances)
    energies = {run: comparison.energy_by_class(run) for run in runs}
    totals = {run: comparison.balances[run].totals[SHAFT_POWER] for run in runs}
    largest_total = max(map(abs, totals.values()))
    classes = [
        energy_class
        for energy_class in POWER_CLASSES
        if max(abs(energies[x][energy_class]) for x in runs) > _MIN_BAR_SHARE * largest_total
    ]
    unit, scale = display_unit("J", largest_total)
    group_height = len(runs) * _BAR_HEIGHT + _GROUP_GAP
    bars_height = max(group_height * len(classes), 1.0)
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(8.6, 3.6 + bars_height), layout="constrained")
        time_axes, bar_axes = figure.subplots(2, 1, height_ratios=(2.4, bars_height))
        peaks = [
            float(np.abs(balance.shaft_power).max()) for balance in comparison.balances.values()
        ]
        power_unit, power_scale = display_unit("W", max(peaks))
        for run, color in zip(runs, _run_colours(len(runs)), strict=True):
            time, power = comparison.shaft_power_over_time(run)
            label = (
                f"{run}: {format_number(scale * totals[run])} {unit} in "
                f"{format_number(time[-1])} s"
            )
            time_axes.plot(
                time, power_scale * power, color=color, linewidth=1.1, label=escape_label(label)
            )
        time_axes.set_xlabel("time [s]")
        time_axes.set_ylabel(f"power of the shafts [{power_unit}]")
        time_axes.margins(x=0.0)
        time_axes.set_ylim(bottom=min(0.0, time_axes.get_ylim()[0]))
        figure.legend(loc="outside upper left", ncols=2)
        for i, (run, color) in enumerate(zip(runs, _run_colours(len(runs)), strict=True)):
            bar_positions = [group_height * k + _BAR_HEIGHT * i for k in range(len(classes))]
            values = [scale * energies[run][kind] for kind in classes]
            bars = bar_axes.barh(bar_positions, values, height=0.92 * _BAR_HEIGHT, color=color)
            bar_axes.bar_label(bars, [format_number(x) for x in values], padding=2, fontsize=6.5)
        group_centre = 0.5 * _BAR_HEIGHT * (len(runs) - 1)
        bar_axes.set_yticks(
            [group_height * k + group_centre for k in range(len(classes))], classes
        )
        bar_axes.tick_params(axis="y", length=0)
        bar_axes.grid(visible=False, axis="y")
        bar_axes.invert_yaxis()
        bar_axes.axvline(0.0, color=INK_COLOUR, linewidth=0.6)
        bar_axes.margins(x=0.08, y=0.02)
        bar_axes.set_xlabel(f"energy [{unit}]")
    return figure


def _run_colours(count: int) -> list[str]:
    return [_RUN_COLOURS[i % len(_RUN_COLOURS)] for i in range(count)]
