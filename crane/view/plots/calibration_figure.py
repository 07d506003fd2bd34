"""A calibration as one picture: every channel measured, and simulated before and after."""

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.units import display_unit
from crane.identification.calibration.calibration_result import Calibration, CalibrationChannel
from crane.recordings.recording_summary import result_title
from crane.view.plots.figure_text import escape_label
from crane.view.plots.recording_figure import (
    DASHED_STYLE,
    FIGURE_STYLE,
    INK_COLOUR,
    RECORDED_COLOUR,
)

HELD_OUT_COLOUR = "#f1efe8"
_MAX_PANELS = 18  # panels


def calibration_figure(calibration: Calibration) -> Figure:
    """A panel per channel; instants that were held out stand on a darker ground."""
    sensors = calibration.channels[:_MAX_PANELS]
    with mpl.rc_context(FIGURE_STYLE):
        columns = 2 if len(sensors) > 1 else 1
        rows = -(-len(sensors) // columns)
        size = (5.6 * columns, 1.9 * rows + 0.8)
        figure = Figure(figsize=size, layout="constrained")
        has_several_recordings = len({sensor.recording for sensor in sensors}) > 1
        for i, sensor in enumerate(sensors):
            axes = figure.add_subplot(rows, columns, i + 1)
            unit = draw_channel(axes, sensor)
            for start, end in mask_spans(sensor.time, np.logical_not(sensor.train_mask)):
                axes.axvspan(start, end, color=HELD_OUT_COLOUR, zorder=-1)
            name = f"{sensor.recording}: {sensor.name}" if has_several_recordings else sensor.name
            axes.set_title(escape_label(f"{name} [{unit}]"), fontsize=8.5)
            if i >= len(sensors) - columns:
                axes.set_xlabel("time [s]")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        heading = result_title(calibration.machine.name, "calibration")
        figure.suptitle(escape_label(heading), x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def draw_channel(axes: Axes, sensor: CalibrationChannel) -> str:
    """Draw a channel measured, before and fitted; the unit it is read in.

    The axis holds what was measured and what is fitted, whatever was before.
    """
    all_values = np.concatenate([sensor.measured, sensor.simulated_after])
    unit, scale = display_unit(sensor.unit, float(np.ptp(all_values)))
    for values, style in (
        (sensor.measured, {"color": INK_COLOUR, "linewidth": 0.9, "label": "measured"}),
        (sensor.simulated_before, DASHED_STYLE | {"linewidth": 0.9, "label": "before"}),
        (sensor.simulated_after, {"color": RECORDED_COLOUR, "linewidth": 1.1, "label": "fitted"}),
    ):
        axes.plot(sensor.time, scale * values, **style)
    lowest, highest = scale * all_values.min(), scale * all_values.max()
    margin = 0.15 * (highest - lowest) or 1.0
    axes.set_ylim(lowest - margin, highest + margin)
    return unit


def mask_spans(time: "np.ndarray", mask: "np.ndarray") -> list[tuple[float, float]]:
    """Stretches of time over which something holds."""
    edges = np.diff(np.concatenate([[0], mask.astype(int), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [(float(time[a]), float(time[b])) for a, b in zip(starts, ends, strict=True)]
