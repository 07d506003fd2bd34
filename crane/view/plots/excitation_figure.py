"""Figures of excitations: trajectories with their limits, or valve signals."""

from collections.abc import Sequence

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
    count = len(excitation.machine.active)
    columns = tuple(x[:: -(-len(x) // _MAX_POINTS)] for x in excitation.motion())
    figure = Figure(figsize=(2.4 * count + 0.6, 6.0), layout="constrained")
    grid = figure.subplots(3, count, sharex=True, squeeze=False)
    for i in range(count):
        _draw_joint(list(grid[:, i]), excitation, columns, i)
    return figure


def _draw_joint(
    joint_axes: Sequence[Axes], excitation: Excitation, motion: tuple[Array, ...], joint_index: int
) -> None:
    """Draw stroke, velocity and force of an active joint."""
    machine, reference, bounds = excitation.machine, excitation.trajectory, excitation.limits
    time, q, v, _, tau = motion
    joint = machine.active[joint_index]
    unit, scale = DISPLAY_UNITS[machine.unit(joint)]
    stroke_middle, half_range = bounds.stroke_middle[joint_index], bounds.half_stroke[joint_index]
    force = FORCE_UNITS[machine.unit(joint)]
    rows = (
        ("stroke", unit, scale, q, (stroke_middle - half_range, stroke_middle + half_range)),
        (
            "velocity",
            f"{unit}/s",
            scale,
            v,
            (-bounds.velocity[joint_index], bounds.velocity[joint_index]),
        ),
        ("force", force, 1.0, tau, (-bounds.force[joint_index], bounds.force[joint_index])),
    )
    for axes, (quantity_name, label, factor, values, limit_values) in zip(
        joint_axes, rows, strict=True
    ):
        axes.plot(time, factor * values[:, joint_index], color=RECORDED_COLOUR)
        for limit_value in [end for end in limit_values if np.isfinite(end)]:
            axes.axhline(factor * limit_value, **DASHED_STYLE)
        for lead_span in (
            (0, reference.lead),
            (reference.duration - reference.lead, reference.duration),
        ):
            axes.axvspan(*lead_span, color=FAINT_COLOUR, alpha=0.5)
        axes.set_ylabel(f"{quantity_name} [{label}]")
        axes.margins(x=0.0)
    joint_axes[0].set_title(escape_label(joint))
    joint_axes[-1].set_xlabel("time [s]")


@figure_style
def signals_figure(excitation: SignalExcitation) -> Figure:
    """Return the figure of valve signals: signal, stroke with dashed limits, pressures."""
    count = len(excitation.signals)
    figure = Figure(figsize=(3.0 * count + 0.6, 6.0), layout="constrained")
    grid = figure.subplots(3, count, sharex=True, squeeze=False)
    for i, joint in enumerate(excitation.signals):
        _draw_valve(list(grid[:, i]), excitation, joint)
    return figure


def _draw_valve(valve_axes: Sequence[Axes], excitation: SignalExcitation, joint: str) -> None:
    """Draw signal, stroke and pressures of a cylinder."""
    run, machine = excitation.run.columns(), excitation.machine
    i = machine.active.index(joint)
    unit, scale = DISPLAY_UNITS[machine.unit(joint)]
    stroke_limits = machine.lower[i], machine.upper[i]
    bar, per_bar = display_unit("Pa", 1e5)
    rows = (
        ("signal", "V", 1.0, [f"voltage_{joint}"], ()),
        ("stroke", unit, scale, [joint], stroke_limits),
        ("pressures A, B", bar, per_bar, [f"pressure_{joint}_{side}" for side in "ab"], ()),
    )
    for axes, (quantity_name, label, factor, names, limits) in zip(valve_axes, rows, strict=True):
        for name, color in zip(names, (RECORDED_COLOUR, "#2a8c4a"), strict=False):
            axes.plot(excitation.run.time, factor * run[name], color=color)
        for limit_value in limits:
            axes.axhline(factor * limit_value, **DASHED_STYLE)
        axes.set_ylabel(f"{quantity_name} [{label}]")
        axes.margins(x=0.0)
    valve_axes[0].set_title(escape_label(joint))
    valve_axes[-1].set_xlabel("time [s]")
