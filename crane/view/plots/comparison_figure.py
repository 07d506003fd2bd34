"""Measured beside simulated channels as one figure."""

import numpy as np
from matplotlib.figure import Figure

from crane.common.errors import InputError
from crane.common.units import display_unit
from crane.simulation.recording_replay import Comparison
from crane.view.plots.figure_text import escape_label
from crane.view.plots.recording_figure import DASHED_STYLE, RECORDED_COLOUR

_MAX_COLUMNS = 3
_MAX_POINTS = 4000  # instants that a line needs


def comparison_figure(comparison: Comparison) -> Figure:
    """The figure of a comparison, a panel per channel.

    Raises:
        InputError: It has none.
    """
    if not comparison.channels:
        raise InputError("the file has no channel that the simulation has too")
    count = len(comparison.channels)
    column_count = min(_MAX_COLUMNS, count)
    rows = -(-count // column_count)
    figure = Figure(figsize=(3.4 * column_count, 1.9 * rows + 0.4), layout="constrained")
    panels = figure.subplots(rows, column_count, sharex=True, squeeze=False).ravel()
    stride = -(-len(comparison.time) // _MAX_POINTS)
    time = comparison.time[::stride]
    for axes, channel in zip(panels, comparison.channels, strict=False):
        channel_values = channel.measured, channel.simulated
        unit, scale = display_unit(
            channel.unit, max(float(np.abs(x).max()) for x in channel_values)
        )
        axes.plot(
            time, scale * channel.measured[::stride], color=RECORDED_COLOUR, label="measured"
        )
        axes.plot(time, scale * channel.simulated[::stride], label="simulated", **DASHED_STYLE)
        label = f" [{unit}]" if unit else ""
        error_text = f"RMS {scale * channel.rms:.3g} {unit}, {100 * channel.relative_rms:.3g} %"
        axes.set_title(escape_label(f"{channel.name}{label}\n{error_text}"), fontsize=8)
        axes.margins(x=0.0)
    for axes in panels[count:]:
        axes.set_visible(False)
    for axes in panels[max(count - column_count, 0) : count]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("time [s]")
    panels[0].legend(loc="best", fontsize=7)
    return figure
