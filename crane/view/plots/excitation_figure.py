"""Figures of excitations: trajectories with their limits, or valve signals."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.common.units import display_unit
from crane.identification.excitation.periodic_excitation import Excitation
from crane.identification.excitation.signal_excitation import SignalExcitation
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.recording_summary import DISPLAY_UNITS
from crane.view.plots.figure_style import (
    DASHED_STYLE,
    FAINT_COLOUR,
    RECORDED_COLOUR,
    escape_label,
    figure_style,
)

_MAX_POINTS = 2000  # instants that a line needs


@figure_style
def excitation_figure(excitation: Excitation) -> Figure:
    """Return the figure of a trajectory; limits are dashed, lead times shaded."""
    machine, reference, bounds = excitation.machine, excitation.trajectory, excitation.limits
    time, q, v, _, tau = (x[:: -(-len(x) // _MAX_POINTS)] for x in excitation.motion())
    leads = (0, reference.lead), (reference.duration - reference.lead, reference.duration)
    figure, grid = _create_grid(2.4, len(machine.active))
    for i, joint in enumerate(machine.active):
        unit, scale = DISPLAY_UNITS[machine.unit(joint)]
        force_unit, middle = FORCE_UNITS[machine.unit(joint)], bounds.stroke_middle[i]
        rows = (
            ("stroke", unit, scale, q, middle, bounds.half_stroke[i]),
            ("velocity", f"{unit}/s", scale, v, 0.0, bounds.velocity[i]),
            ("force", force_unit, 1.0, tau, 0.0, bounds.force[i]),
        )
        for axes, (name, label, factor, values, centre, limit) in zip(
            grid[:, i], rows, strict=True
        ):
            lines = [(factor * values[:, i], RECORDED_COLOUR)]
            limits = [factor * (centre - limit), factor * (centre + limit)]
            _draw_lines(axes, time, lines, limits, f"{name} [{label}]")
            for lead in leads:
                axes.axvspan(*lead, color=FAINT_COLOUR, alpha=0.5)
        grid[0, i].set_title(escape_label(joint))
    return figure


@figure_style
def signals_figure(excitation: SignalExcitation) -> Figure:
    """Return the figure of valve signals: signal, stroke with dashed limits, pressures."""
    run, machine = excitation.run.columns(), excitation.machine
    bar, per_bar = display_unit("Pa", 1e5)
    figure, grid = _create_grid(3.0, len(excitation.signals))
    for i, joint in enumerate(excitation.signals):
        unit, scale = DISPLAY_UNITS[machine.unit(joint)]
        index = machine.active.index(joint)
        limits = scale * machine.lower[index], scale * machine.upper[index]
        rows = (
            ("signal [V]", 1.0, [f"voltage_{joint}"], ()),
            (f"stroke [{unit}]", scale, [joint], limits),
            (f"pressures A, B [{bar}]", per_bar, [f"pressure_{joint}_{x}" for x in "ab"], ()),
        )
        for axes, (label, factor, names, dashed) in zip(grid[:, i], rows, strict=True):
            colours = zip(names, (RECORDED_COLOUR, "#2a8c4a"), strict=False)
            lines = [(factor * run[name], colour) for name, colour in colours]
            _draw_lines(axes, excitation.run.time, lines, dashed, label)
        grid[0, i].set_title(escape_label(joint))
    return figure


def _create_grid(panel_width: float, columns: int) -> tuple[Figure, Any]:
    """Return a figure with three rows of panels over time."""
    figure = Figure(figsize=(panel_width * columns + 0.6, 6.0), layout="constrained")
    grid = figure.subplots(3, columns, sharex=True, squeeze=False)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    return figure, grid


def _draw_lines(
    axes: Axes,
    time: Array,
    lines: Sequence[tuple[Array, str]],
    limits: Sequence[float],
    label: str,
) -> None:
    """Draw lines (N,) in their colours, and finite limits dashed."""
    for values, colour in lines:
        axes.plot(time, values, color=colour)
    for limit in limits:
        if np.isfinite(limit):
            axes.axhline(limit, **DASHED_STYLE)
    axes.set_ylabel(label)
    axes.margins(x=0.0)
