"""Sensitivities as one picture: what a small change of each number does to each output."""

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from crane.common.units import display_unit
from crane.description.machine_lookup import CHANGES_SEPARATOR
from crane.recordings.recording_summary import result_title
from crane.simulation.sensitivity.motion_sensitivities import ZERO_TOLERANCE, Sensitivities
from crane.view.plots.figure_text import escape_label
from crane.view.plots.recording_figure import FIGURE_STYLE

_MAX_PANELS = 18  # panels


def sensitivities_figure(sensitivities: Sensitivities) -> Figure:
    """A panel per output that depends on something, a line per number."""
    effects = sensitivities.derivatives * sensitivities.typical_changes
    panels = []
    for k, output in enumerate(sensitivities.outputs):
        largest = float(np.abs(effects[:, k]).max())
        unit, scale = display_unit(sensitivities.unit(output), largest)
        if scale * largest > ZERO_TOLERANCE:
            panels.append((output, unit, scale * effects[:, k]))
    panels = panels[:_MAX_PANELS]
    with mpl.rc_context(FIGURE_STYLE):
        columns = 2 if len(panels) > 1 else 1
        rows = max(1, -(-len(panels) // columns))
        figure = Figure(figsize=(5.6 * columns, 1.9 * rows + 0.9), layout="constrained")
        for k, (output, unit, values) in enumerate(panels):
            axes = figure.add_subplot(rows, columns, k + 1)
            for i, name in enumerate(sensitivities.parameters):
                label = escape_label(f"{name} + {sensitivities.typical_changes[i]:.3g}")
                axes.plot(sensitivities.recording.time, values[:, i], linewidth=1.0, label=label)
            axes.set_title(escape_label(f"{output} [{unit}]"), fontsize=8.5)
            if k >= len(panels) - columns:
                axes.set_xlabel("time [s]")
        if panels:
            handles, labels = figure.axes[0].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside lower center", ncols=3)
        heading = result_title(
            sensitivities.recording.machine.partition(CHANGES_SEPARATOR)[0], "sensitivities"
        )
        figure.suptitle(escape_label(heading), x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure
