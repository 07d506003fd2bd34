"""Sensitivities as one picture: what a small change of each number does to each output."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from crane.common.units import reading
from crane.description.sources import WITH
from crane.recordings.summary import title
from crane.simulation.sensitivity.named import NOTHING, Sensitivities
from crane.view.plots.recording import STYLE, write_figure
from crane.view.plots.text import plain

_MOST = 18  # panels


def plot_sensitivities(found: Sensitivities, path: str | Path) -> None:
    """Write the picture to a file.

    Args:
        found: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: sensitivities_figure(found))


def sensitivities_figure(found: Sensitivities) -> Figure:
    """A panel per output that depends on something, a line per number."""
    effects = found.slopes * found.changes
    panels = []
    for k, output in enumerate(found.outputs):
        largest = float(np.abs(effects[:, k]).max())
        unit, scale = reading(found.unit(output), largest)
        if scale * largest > NOTHING:
            panels.append((output, unit, scale * effects[:, k]))
    panels = panels[:_MOST]
    with mpl.rc_context(STYLE):
        columns = 2 if len(panels) > 1 else 1
        rows = max(1, -(-len(panels) // columns))
        figure = Figure(figsize=(5.6 * columns, 1.9 * rows + 0.9), layout="constrained")
        for k, (output, unit, values) in enumerate(panels):
            axes = figure.add_subplot(rows, columns, k + 1)
            for i, name in enumerate(found.by):
                label = plain(f"{name} + {found.changes[i]:.3g}")
                axes.plot(found.recording.time, values[:, i], linewidth=1.0, label=label)
            axes.set_title(plain(f"{output} [{unit}]"), fontsize=8.5)
            if k >= len(panels) - columns:
                axes.set_xlabel("time [s]")
        if panels:
            handles, labels = figure.axes[0].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside lower center", ncols=3)
        words = title(found.recording.machine.partition(WITH)[0], "sensitivities")
        figure.suptitle(plain(words), x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure
