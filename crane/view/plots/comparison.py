"""Measured beside simulated channels as one figure."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from crane.common.errors import InputError
from crane.common.units import reading
from crane.simulation.replays import Comparison
from crane.view.plots.recording import DASHED, RECORDED, write_figure
from crane.view.plots.text import plain

_ACROSS = 3
_MOST = 4000  # instants that a line needs


def plot_comparison(comparison: Comparison, path: str | Path) -> None:
    """Write the figure of a comparison: measured lines, dashed what the model says.

    Raises:
        OutputError: The file cannot be written.
    """
    write_figure(path, lambda: comparison_figure(comparison))


def comparison_figure(comparison: Comparison) -> Figure:
    """The figure of a comparison, a panel per channel.

    Raises:
        InputError: It has none.
    """
    if not comparison.channels:
        raise InputError("the file has no channel that the simulation has too")
    count = len(comparison.channels)
    across = min(_ACROSS, count)
    rows = -(-count // across)
    figure = Figure(figsize=(3.4 * across, 1.9 * rows + 0.4), layout="constrained")
    panels = figure.subplots(rows, across, sharex=True, squeeze=False).ravel()
    every = -(-len(comparison.time) // _MOST)
    time = comparison.time[::every]
    for axes, channel in zip(panels, comparison.channels, strict=False):
        both = channel.measured, channel.simulated
        unit, scale = reading(channel.unit, max(float(np.abs(x).max()) for x in both))
        axes.plot(time, scale * channel.measured[::every], color=RECORDED, label="measured")
        axes.plot(time, scale * channel.simulated[::every], label="simulated", **DASHED)
        label = f" [{unit}]" if unit else ""
        off = f"RMS {scale * channel.rms:.3g} {unit}, {100 * channel.relative:.3g} %"
        axes.set_title(plain(f"{channel.name}{label}\n{off}"), fontsize=8)
        axes.margins(x=0.0)
    for axes in panels[count:]:
        axes.set_visible(False)
    for axes in panels[max(count - across, 0) : count]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("time [s]")
    panels[0].legend(loc="best", fontsize=7)
    return figure
