"""Figures of simulated and measured channels: calibrations, residuals, comparisons."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.common.units import display_unit
from crane.identification.calibration.calibration_result import (
    Calibration,
    CalibrationChannel,
    ResidualDependence,
    group_samples,
)
from crane.recordings.recording_summary import result_title
from crane.simulation.recording_replay import Comparison
from crane.view.plots.figure_style import (
    DASHED_STYLE,
    INK_COLOUR,
    RECORDED_COLOUR,
    add_heading,
    add_residual_legend,
    create_residual_panels,
    create_time_panels,
    envelope,
    escape_label,
    figure_style,
)

_HELD_OUT_COLOUR = "#f1efe8"
_MAX_PANELS = 18  # panels


@figure_style
def calibration_figure(calibration: Calibration) -> Figure:
    """Return a panel per channel; held-out instants have a darker background."""
    sensors = calibration.channels[:_MAX_PANELS]
    figure, panels = create_time_panels(len(sensors), 2, 5.6, 0.8)
    has_several_recordings = len({sensor.recording for sensor in sensors}) > 1
    for axes, sensor in zip(panels, sensors, strict=True):
        unit = draw_channel(axes, sensor)
        _shade_held_out(axes, sensor)
        name = f"{sensor.recording}: {sensor.name}" if has_several_recordings else sensor.name
        axes.set_title(escape_label(f"{name} [{unit}]"), fontsize=8.5)
    figure.legend(handles=panels[0].get_lines(), loc="outside lower center", ncols=3)
    add_heading(figure, escape_label(result_title(calibration.machine.name, "calibration")))
    return figure


def draw_channel(axes: Axes, sensor: CalibrationChannel) -> str:
    """Draw a channel measured, before and fitted, and return its display unit.

    The limits of the axis contain the measured and the fitted values only.
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


def _shade_held_out(axes: Axes, channel: CalibrationChannel) -> None:
    axes.fill_between(
        channel.time,
        0.0,
        1.0,
        where=(~channel.train_mask).tolist(),
        step="mid",
        transform=axes.get_xaxis_transform(),
        color=_HELD_OUT_COLOUR,
        linewidth=0,
        zorder=-1,
    )


_MAX_DOTS = 4000  # of a picture
_CLOUD_COLOUR, _MEAN_COLOUR = "#9db8d6", str(DASHED_STYLE["color"])
_DIRECTION_LABELS = {-1: "back", 0: "rest", 1: "out"}


def channel_residual_figure(channel: CalibrationChannel, name: str) -> Figure:
    """Return a channel over time, measured, before and fitted, with the residual below."""
    residual = channel.simulated_after - channel.measured
    residual_unit, scale = display_unit(channel.unit, float(np.abs(residual).max()))
    figure, upper, lower = create_residual_panels(escape_label(name), "", residual_unit)
    upper.set_ylabel(f"[{draw_channel(upper, channel)}]")
    lower.plot(*envelope(channel.time, scale * residual), color=RECORDED_COLOUR, linewidth=0.7)
    lower.axhline(0.0, color=INK_COLOUR, linewidth=0.6)
    for axes in (upper, lower):
        _shade_held_out(axes, channel)
    add_residual_legend(upper, 3)
    return figure


def residual_dependence_figure(dependence: ResidualDependence) -> Figure:
    """Return the residual of a channel against speed, pressure and direction of a drive.

    Dots are instants, the line shows means of groups of equal size; for directions, bars show the
    central 95 % and dots the means.
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
    panels[0].set_ylabel(escape_label(f"residual of {dependence.name} [{unit}]"))
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


_MAX_COLUMNS = 3
_MAX_POINTS = 4000  # instants that a line needs


@figure_style
def comparison_figure(comparison: Comparison) -> Figure:
    """Return the figure of a comparison, a panel per channel.

    Raises:
        InputError: The comparison has no channel.
    """
    if not comparison.channels:
        raise InputError("the file has no channel that the simulation has too")
    figure, panels = create_time_panels(len(comparison.channels), _MAX_COLUMNS, 3.4, 0.4)
    stride = -(-len(comparison.time) // _MAX_POINTS)
    time = comparison.time[::stride]
    for axes, channel in zip(panels, comparison.channels, strict=True):
        unit, scale = display_unit(
            channel.unit,
            max(float(np.abs(x).max()) for x in (channel.measured, channel.simulated)),
        )
        axes.plot(
            time, scale * channel.measured[::stride], color=RECORDED_COLOUR, label="measured"
        )
        axes.plot(time, scale * channel.simulated[::stride], label="simulated", **DASHED_STYLE)
        label = f" [{unit}]" if unit else ""
        error_text = f"RMS {scale * channel.rms:.3g} {unit}, {100 * channel.relative_rms:.3g} %"
        axes.set_title(escape_label(f"{channel.name}{label}\n{error_text}"), fontsize=8)
        axes.margins(x=0.0)
    panels[0].legend(loc="best", fontsize=7)
    return figure
