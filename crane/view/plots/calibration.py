"""A calibration as one picture: every channel measured, and simulated before and after."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.units import reading
from crane.identification.calibration.result import Calibration, Channel
from crane.recordings.summary import title
from crane.view.plots.recording import DASHED, INK, RECORDED, STYLE, write_figure
from crane.view.plots.text import plain

HELD_OUT = "#f1efe8"
_MOST = 18  # panels


def plot_calibration(found: Calibration, path: str | Path) -> None:
    """Write the picture of a calibration to a file.

    Args:
        found: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: calibration_figure(found))


def calibration_figure(found: Calibration) -> Figure:
    """A panel per channel; instants that were held out stand on a darker ground."""
    sensors = found.sensors[:_MOST]
    with mpl.rc_context(STYLE):
        columns = 2 if len(sensors) > 1 else 1
        rows = -(-len(sensors) // columns)
        size = (5.6 * columns, 1.9 * rows + 0.8)
        figure = Figure(figsize=size, layout="constrained")
        several = len({sensor.recording for sensor in sensors}) > 1
        for i, sensor in enumerate(sensors):
            axes = figure.add_subplot(rows, columns, i + 1)
            unit = lines_of(axes, sensor)
            for start, end in spans(sensor.time, np.logical_not(sensor.train)):
                axes.axvspan(start, end, color=HELD_OUT, zorder=-1)
            name = f"{sensor.recording}: {sensor.name}" if several else sensor.name
            axes.set_title(plain(f"{name} [{unit}]"), fontsize=8.5)
            if i >= len(sensors) - columns:
                axes.set_xlabel("time [s]")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        words = title(found.machine.name, "calibration")
        figure.suptitle(plain(words), x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def lines_of(axes: Axes, sensor: Channel) -> str:
    """Draw a channel measured, before and fitted; the unit it is read in.

    The axis holds what was measured and what is fitted, whatever was before.
    """
    every = np.concatenate([sensor.measured, sensor.after])
    unit, scale = reading(sensor.unit, float(np.ptp(every)))
    for values, style in (
        (sensor.measured, {"color": INK, "linewidth": 0.9, "label": "measured"}),
        (sensor.before, DASHED | {"linewidth": 0.9, "label": "before"}),
        (sensor.after, {"color": RECORDED, "linewidth": 1.1, "label": "fitted"}),
    ):
        axes.plot(sensor.time, scale * values, **style)
    low, high = scale * every.min(), scale * every.max()
    room = 0.15 * (high - low) or 1.0
    axes.set_ylim(low - room, high + room)
    return unit


def spans(time: "np.ndarray", mask: "np.ndarray") -> list[tuple[float, float]]:
    """Stretches of time over which something holds."""
    edges = np.diff(np.concatenate([[0], mask.astype(int), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [(float(time[a]), float(time[b])) for a, b in zip(starts, ends, strict=True)]
