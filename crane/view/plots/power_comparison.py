"""Power accounts of several runs beside each other: bars of energy, and power over time."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from crane.common.units import number, reading
from crane.hydraulics.powers import SHAFT
from crane.studies.power import CLASSES
from crane.studies.power_comparison import PowerComparison
from crane.view.plots.recording import INK, STYLE, write_figure
from crane.view.plots.text import plain

_RUNS = ("#1f5fa8", "#e0701a", "#2a8c4a", "#8a5fb0", "#b04a7a", "#3f8f9f", "#9a6b3f", "#7a7a7a")
_BAR, _GAP = 0.14, 0.12  # of a bar, between groups of them [inch]
_LEAST = 1e-3  # share of the largest run's energy that has a bar


def plot_power_comparison(comparison: PowerComparison, path: str | Path) -> None:
    """Write the picture to a file; see `plot_power`."""
    write_figure(path, lambda: power_comparison_figure(comparison))


def power_comparison_figure(comparison: PowerComparison) -> Figure:
    """What the shafts' energy goes into, a bar per run, and above it what they give over time."""
    runs = list(comparison.accounts)
    energies = {run: comparison.classes(run) for run in runs}
    totals = {run: comparison.accounts[run].totals[SHAFT] for run in runs}
    most = max(map(abs, totals.values()))
    kinds = [kind for kind in CLASSES if max(abs(energies[x][kind]) for x in runs) > _LEAST * most]
    unit, scale = reading("J", most)
    group = len(runs) * _BAR + _GAP
    tall = max(group * len(kinds), 1.0)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.6, 3.6 + tall), layout="constrained")
        top, bottom = figure.subplots(2, 1, height_ratios=(2.4, tall))
        peaks = [float(np.abs(account.shaft).max()) for account in comparison.accounts.values()]
        power_unit, power_scale = reading("W", max(peaks))
        for run, color in zip(runs, _colors(len(runs)), strict=True):
            time, power = comparison.over_time(run)
            words = f"{run}: {number(scale * totals[run])} {unit} in {number(time[-1])} s"
            top.plot(time, power_scale * power, color=color, linewidth=1.1, label=plain(words))
        top.set_xlabel("time [s]")
        top.set_ylabel(f"power of the shafts [{power_unit}]")
        top.margins(x=0.0)
        top.set_ylim(bottom=min(0.0, top.get_ylim()[0]))
        figure.legend(loc="outside upper left", ncols=2)
        for i, (run, color) in enumerate(zip(runs, _colors(len(runs)), strict=True)):
            places = [group * k + _BAR * i for k in range(len(kinds))]
            values = [scale * energies[run][kind] for kind in kinds]
            bars = bottom.barh(places, values, height=0.92 * _BAR, color=color)
            bottom.bar_label(bars, [number(x) for x in values], padding=2, fontsize=6.5)
        middle = 0.5 * _BAR * (len(runs) - 1)
        bottom.set_yticks([group * k + middle for k in range(len(kinds))], kinds)
        bottom.tick_params(axis="y", length=0)
        bottom.grid(visible=False, axis="y")
        bottom.invert_yaxis()
        bottom.axvline(0.0, color=INK, linewidth=0.6)
        bottom.margins(x=0.08, y=0.02)
        bottom.set_xlabel(f"energy [{unit}]")
    return figure


def _colors(count: int) -> list[str]:
    return [_RUNS[i % len(_RUNS)] for i in range(count)]
