"""What is left of a calibration: of a channel over time, and against the motion of a drive."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.common.units import display_unit
from crane.identification.calibration.calibration_result import (
    CalibrationChannel,
    ResidualDependence,
    group_samples,
)
from crane.view.plots.calibration_figure import HELD_OUT_COLOUR, draw_channel, mask_spans
from crane.view.plots.curve_thinning import envelope
from crane.view.plots.figure_text import escape_label
from crane.view.plots.recording_figure import DASHED_STYLE, INK_COLOUR, RECORDED_COLOUR

_MAX_DOTS = 4000  # of a picture
_CLOUD_COLOUR, _MEAN_COLOUR = "#9db8d6", str(DASHED_STYLE["color"])
_DIRECTION_LABELS = {-1: "back", 0: "rest", 1: "out"}


def channel_residual_figure(channel: CalibrationChannel, name: str) -> Figure:
    """A channel over time, measured, before and fitted; below what the fitted one leaves."""
    figure = Figure(figsize=(5.8, 3.3))
    grid = {"height_ratios": (2.2, 1), "left": 0.14, "right": 0.985, "top": 0.9, "bottom": 0.13}
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={**grid, "hspace": 0.12})
    unit = draw_channel(upper, channel)
    residual = channel.simulated_after - channel.measured
    residual_unit, scale = display_unit(channel.unit, float(np.abs(residual).max()))
    lower.plot(*envelope(channel.time, scale * residual), color=RECORDED_COLOUR, linewidth=0.7)
    lower.axhline(0.0, color=INK_COLOUR, linewidth=0.6)
    for axes in (upper, lower):
        for start, end in mask_spans(channel.time, np.logical_not(channel.train_mask)):
            axes.axvspan(start, end, color=HELD_OUT_COLOUR, zorder=-1)
        axes.yaxis.set_label_coords(-0.125, 0.5)
    upper.set_ylabel(f"[{unit}]")
    lower.set_ylabel(f"left [{residual_unit}]")
    lower.set_xlabel("time [s]")
    upper.margins(x=0.0)
    upper.set_title(escape_label(name), loc="left", fontsize=8.5)
    upper.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3, borderpad=0, fontsize=8)
    return figure


def residual_dependence_figure(dependence: ResidualDependence) -> Figure:
    """What is left of a channel against speed, pressure and direction of a drive.

    Dots are instants, the line has the means of groups of as many each; of directions the span of
    95 of 100 instants and the mean.
    """
    figure = Figure(figsize=(11.8, 2.5))
    grid = {"left": 0.065, "right": 0.993, "top": 0.87, "bottom": 0.19, "wspace": 0.06}
    panels = figure.subplots(1, 3, sharey=True, gridspec_kw={**grid, "width_ratios": (2, 2, 1)})
    unit, scale = display_unit(dependence.unit, float(np.abs(dependence.residual).max()))
    y = scale * dependence.residual
    units = {"speed": dependence.speed_unit, "pressure": "Pa"}
    for axes, (cause, x) in zip(panels, dependence.motion.items(), strict=True):
        axes.axhline(0.0, color=INK_COLOUR, linewidth=0.6)
        axes.set_title(
            f"{cause}: {100 * dependence.correlation_ratios[cause]:.0f} %",
            loc="left",
            fontsize=8.5,
        )
        if cause in units:
            name, unit_scale = display_unit(units[cause], float(np.abs(x).max()))
            _draw_cloud_with_means(axes, unit_scale * x, y)
            source_text = (
                f"{dependence.drive}, {dependence.chamber.upper()}"
                if cause == "pressure"
                else dependence.drive
            )
            axes.set_xlabel(escape_label(f"{cause} of {source_text} [{name}]"))
        else:
            _draw_by_direction(axes, x, y)
            axes.set_xlabel(escape_label(f"direction of {dependence.drive}"))
    panels[0].set_ylabel(escape_label(f"left of {dependence.name} [{unit}]"))
    return figure


def _draw_cloud_with_means(axes: Axes, x: Array, y: Array) -> None:
    step = -(-len(x) // _MAX_DOTS)
    axes.plot(x[::step], y[::step], ".", color=_CLOUD_COLOUR, markersize=2)
    means = np.array([(x[group].mean(), y[group].mean()) for group in group_samples(x)])
    axes.plot(*means.T, color=_MEAN_COLOUR, linewidth=1.1, marker="o", markersize=3)


def _draw_by_direction(axes: Axes, x: Array, y: Array) -> None:
    for direction in _DIRECTION_LABELS:
        direction_values = y[x == direction]
        if len(direction_values):
            axes.plot(
                [direction, direction],
                np.percentile(direction_values, (2.5, 97.5)),
                color=_CLOUD_COLOUR,
                linewidth=6,
            )
            axes.plot(
                [direction],
                [direction_values.mean()],
                color=_MEAN_COLOUR,
                marker="o",
                markersize=4,
            )
    axes.set_xticks(list(_DIRECTION_LABELS), list(_DIRECTION_LABELS.values()))
    axes.set_xlim(-1.5, 1.5)
