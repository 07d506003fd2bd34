"""Figures of power balances: power over time of one run, energies of several runs."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.common.units import display_unit, format_number
from crane.hydraulics.circuit_equations import SHAFT_POWER
from crane.recordings.recording_summary import result_title
from crane.studies.power_balance_result import (
    POWER_CLASSES,
    PowerBalance,
    PowerComparison,
    part_class,
    part_kind,
    part_owner,
)
from crane.view.plots.figure_style import (
    CURVE_COLOURS,
    INK_COLOUR,
    add_heading,
    escape_label,
    figure_style,
)

_CLASS_PALETTE = (
    "#2a8c4a", "#9a6b3f", "#1f5fa8", "#6f9bca", "#e0701a", "#b04a7a", "#7a7a7a", "#8a5fb0",
    "#d9b53f",
)  # fmt: skip
CLASS_COLOURS: Mapping[str, str] = dict(zip(POWER_CLASSES, _CLASS_PALETTE, strict=True))
_MAX_POINTS = 1500  # points of a stack


@figure_style
def power_figure(balance: PowerBalance) -> Figure:
    """Return the power of the shafts over time, stacked by class and by joint.

    Negative powers, such as of a load that drives its cylinder, are stacked below zero.
    """
    by_class = {name: np.zeros_like(balance.time) for name in CLASS_COLOURS}
    by_owner: dict[str, Array] = {}
    for name, power in balance.powers.items():
        if part_kind(name) == SHAFT_POWER:
            continue
        owner = part_owner(name)
        owner = owner if owner in balance.joints else "circuit"
        by_owner[owner] = by_owner.get(owner, np.zeros_like(power)) + power
        by_class[part_class(balance, name)] += power
    unit, scale = display_unit("W", float(np.abs(balance.shaft_power).max()))
    order = [*balance.joints, *(x for x in by_owner if x not in balance.joints)]
    colors = dict(zip(order, itertools.cycle(CURVE_COLOURS), strict=False))
    figure = Figure(figsize=(8.6, 6.4), layout="constrained")
    upper_axes, lower_axes = figure.subplots(2, 1, sharex=True)
    _draw_stack(upper_axes, balance, by_class, CLASS_COLOURS, scale)
    _draw_stack(lower_axes, balance, {x: by_owner[x] for x in order}, colors, scale)
    upper_axes.set_title("by class", loc="left", fontsize=9)
    lower_axes.set_title("by joint", loc="left", fontsize=9)
    lower_axes.set_xlabel("time [s]")
    for axes in (upper_axes, lower_axes):
        axes.set_ylabel(f"power [{unit}]")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), reverse=True)
    add_heading(
        figure,
        escape_label(result_title(balance.machine_name, f"{balance.task_name} power".strip())),
    )
    return figure


def _draw_stack(
    axes: Axes,
    balance: PowerBalance,
    layers: Mapping[str, Array],
    colors: Mapping[str, str],
    scale: float,
) -> None:
    """Stack layers (N,) upwards where positive, downwards where negative."""
    time, shaft = _block_means(balance.time), scale * _block_means(balance.shaft_power)
    min_power = 1e-3 * max(float(np.abs(balance.shaft_power).max()), 1e-9)
    shown = [name for name, power in layers.items() if np.abs(power).max() >= min_power]
    values = scale * np.array([_block_means(layers[name]) for name in shown])
    values = values.reshape(-1, len(time))
    style: Any = {"colors": [colors[name] for name in shown], "linewidth": 0}
    positive, negative = np.maximum(values, 0.0), np.minimum(values, 0.0)
    axes.stackplot(time, positive, labels=[escape_label(name) for name in shown], **style)
    axes.stackplot(time, negative, **style)
    axes.plot(time, shaft, color=INK_COLOUR, linewidth=1.1, label="shafts")
    axes.axhline(0.0, color=INK_COLOUR, linewidth=0.6)
    axes.margins(x=0.0)
    axes.set_ylim(
        -_axis_end(-negative.sum(axis=0), -shaft), _axis_end(positive.sum(axis=0), shaft)
    )


def _axis_end(stack_edge: Array, shaft: Array) -> float:
    """Return the limit of an axis, which may cut single samples of filling lines."""
    stack_end = min(float(stack_edge.max()), 1.5 * float(np.quantile(stack_edge, 0.998)))
    return 1.06 * max(stack_end, float(shaft.max()), 0.02 * float(np.abs(shaft).max()), 1e-3)


def _block_means(values: Array) -> Array:
    """Return means over blocks of samples."""
    block_size = -(-len(values) // _MAX_POINTS)
    return np.add.reduceat(values, starts := np.arange(0, len(values), block_size)) / np.diff(
        [*starts, len(values)]
    )


_BAR_HEIGHT, _GROUP_GAP = 0.14, 0.12  # of a bar, between groups of them [inch]
_MIN_BAR_SHARE = 1e-3  # share of the largest run's energy that has a bar


@figure_style
def power_comparison_figure(comparison: PowerComparison) -> Figure:
    """Return shaft power over time, and energy by class with a bar per run."""
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
    figure = Figure(figsize=(8.6, 3.6 + bars_height), layout="constrained")
    time_axes, bar_axes = figure.subplots(2, 1, height_ratios=(2.4, bars_height))
    peaks = [float(np.abs(balance.shaft_power).max()) for balance in comparison.balances.values()]
    power_unit, power_scale = display_unit("W", max(peaks))
    for i, (run, color) in enumerate(zip(runs, itertools.cycle(CURVE_COLOURS), strict=False)):
        time, power = comparison.shaft_power_over_time(run)
        label = (
            f"{run}: {format_number(scale * totals[run])} {unit} in {format_number(time[-1])} s"
        )
        time_axes.plot(
            time, power_scale * power, color=color, linewidth=1.1, label=escape_label(label)
        )
        values = [scale * energies[run][kind] for kind in classes]
        bars = bar_axes.barh(
            [group_height * k + _BAR_HEIGHT * i for k in range(len(classes))],
            values,
            height=0.92 * _BAR_HEIGHT,
            color=color,
        )
        bar_axes.bar_label(bars, [format_number(x) for x in values], padding=2, fontsize=6.5)
    time_axes.set(xlabel="time [s]", ylabel=f"power of the shafts [{power_unit}]")
    time_axes.margins(x=0.0)
    time_axes.set_ylim(bottom=min(0.0, time_axes.get_ylim()[0]))
    figure.legend(loc="outside upper left", ncols=2)
    group_centre = 0.5 * _BAR_HEIGHT * (len(runs) - 1)
    bar_axes.set_yticks([group_height * k + group_centre for k in range(len(classes))], classes)
    bar_axes.tick_params(axis="y", length=0)
    bar_axes.grid(visible=False, axis="y")
    bar_axes.invert_yaxis()
    bar_axes.axvline(0.0, color=INK_COLOUR, linewidth=0.6)
    bar_axes.margins(x=0.08, y=0.02)
    bar_axes.set_xlabel(f"energy [{unit}]")
    return figure
