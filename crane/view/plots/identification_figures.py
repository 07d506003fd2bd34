"""Figures of identifications and excitations: forces, residuals, correlations, trajectories."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.common.units import display_unit
from crane.identification.excitation.periodic_excitation import Excitation
from crane.identification.excitation.signal_excitation import SignalExcitation
from crane.identification.hydraulics.cylinder_equations import EquationSides
from crane.identification.hydraulics.cylinder_friction import CylinderFriction
from crane.identification.hydraulics.valve_curve import ValveCurve
from crane.identification.mechanics.force_comparison import ForceComparison
from crane.identification.mechanics.identification_result import Identification
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.recording_summary import DISPLAY_UNITS
from crane.view.plots.figure_style import (
    DASHED_STYLE,
    FAINT_COLOUR,
    INK_COLOUR,
    RECORDED_COLOUR,
    add_residual_legend,
    create_residual_panels,
    envelope,
    escape_label,
    figure_style,
)

_SEGMENT_COUNT = 8  # of a recording, whose periodograms are averaged


def force_time_figure(
    comparison: ForceComparison, drive_index: int, unit: str, name: str
) -> Figure:
    """Return measured and modelled force of a drive over time, with the residual below."""
    figure, upper, lower = create_residual_panels(name, f"force [{unit}]", unit)
    moving_mask = np.where(comparison.is_moving[:, drive_index], 1.0, np.nan)
    upper.plot(
        *envelope(comparison.time, comparison.measured[:, drive_index]),
        color="#9db8d6",
        linewidth=1.6,
        label="measured",
    )
    upper.plot(
        comparison.time,
        comparison.modelled[:, drive_index] * moving_mask,
        **{**DASHED_STYLE, "linewidth": 0.9},
        label="model",
    )
    add_residual_legend(upper, 2)
    lower.plot(
        comparison.time,
        comparison.residuals[:, drive_index] * moving_mask,
        color=INK_COLOUR,
        linewidth=0.7,
    )
    return figure


def residual_spectrum_figure(
    fits: list[tuple[str, ForceComparison, str]], drive_index: int, unit: str
) -> Figure:
    """Return averaged spectral densities of the residuals of a drive (Welch 1967).

    Samples that are left out count as zero.

    Args:
        fits: Name, comparison and colour of each curve.
        drive_index: Column of the drive.
        unit: Unit of its force.
    """
    from scipy.signal import welch

    figure = Figure(figsize=(5.8, 3.3))
    grid = {"left": 0.14, "right": 0.985, "top": 0.9, "bottom": 0.13}
    axes = figure.subplots(gridspec_kw=grid)
    for name, fit, color in fits:
        if not fit.is_moving[:, drive_index].any():  # its joint stood still
            continue
        moving_residuals = np.where(
            fit.is_moving[:, drive_index], fit.residuals[:, drive_index], 0.0
        )
        frequency, power = welch(
            moving_residuals,
            1 / float(np.median(np.diff(fit.time))),
            nperseg=-(-len(moving_residuals) // _SEGMENT_COUNT),
        )
        axes.loglog(frequency[1:], np.sqrt(power[1:]), color=color, linewidth=1.1, label=name)
    axes.set(xlabel="frequency [Hz]", ylabel=f"residual [{unit}/√Hz]")
    axes.set_title("spectrum of the residuals", loc="left", fontsize=8.5)
    axes.margins(x=0.0)
    if len(fits) > 1:
        axes.legend(loc="lower left", fontsize=8)
    return figure


def correlation_figure(R: Array, names: Sequence[str]) -> Figure:
    """Return a correlation matrix (r, r) in colours, with named rows."""
    names = [escape_label(name) for name in names]
    size = float(np.clip(0.11 * len(names), 4.0, 9.0))
    letter_size = float(np.clip(60 * size / max(len(names), 1), 3.0, 7.5))
    label_width = 0.0095 * letter_size * max(map(len, names)) + 0.1  # [inch]
    figure = Figure(figsize=(label_width + size + 0.8, size + 0.2))
    width, height = figure.get_size_inches()
    axes = figure.add_axes((label_width / width, 0.1 / height, size / width, size / height))
    image = axes.imshow(R, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks(range(len(names)), names, fontsize=letter_size)
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
    figure.colorbar(
        image,
        cax=figure.add_axes(((label_width + size + 0.15) / width, 0.35, 0.12 / width, 0.3)),
        ticks=(-1, 0, 1),
    )
    return figure


def force_figures(result: Identification) -> list[Figure]:
    """Return measured and modelled forces of the training data, a figure per drive."""
    return [
        force_time_figure(
            result.training, i, FORCE_UNITS[result.described_machine.unit(joint)], joint
        )
        for i, joint in enumerate(result.training.joints)
    ]


_DOT_STYLE: Any = {
    "linestyle": "",
    "marker": ".",
    "markersize": 3.5,
    "markeredgewidth": 0,
    "color": "#6f9bca",
    "alpha": 0.5,
}
_MAX_DOTS = 4000  # dots


@figure_style
def equation_sides_figure(runs: Mapping[str, EquationSides], unit: str = "m") -> Figure:
    """Return both sides of equation (29) over time, a row per recording.

    Args:
        runs: Both sides of the equation by title.
        unit: Unit of the cylinder's coordinate, "m" or "rad".
    """
    figure = Figure(figsize=(7.2, 0.6 + 1.9 * len(runs)), layout="constrained")
    rows = figure.subplots(len(runs), 1, squeeze=False)[:, 0]
    for axes, (title, equation_sides) in zip(rows, runs.items(), strict=True):
        difference = 1e4 * (equation_sides.measured - equation_sides.predicted)
        axes.plot(
            equation_sides.time,
            difference,
            color="#b9b9b9",
            linewidth=0.7,
            label="10 x difference",
        )
        axes.plot(
            equation_sides.time,
            1e3 * equation_sides.measured,
            color=RECORDED_COLOUR,
            label="measured: right side Y",
        )
        axes.plot(
            equation_sides.time,
            1e3 * equation_sides.predicted,
            label="model: left side A X",
            **DASHED_STYLE,
        )
        axes.set_ylabel(r"$10^{-3}$ " + ("m²/s" if unit == "m" else "m³/(rad s)"))
        error = f"relative error {100 * equation_sides.relative_error:.2g} %"
        axes.set_title(f"{title}: {error}", loc="left", fontsize=9)
        axes.margins(x=0.0)
    rows[-1].set_xlabel("time [s]")
    figure.legend(handles=rows[0].get_lines(), loc="outside upper right", ncols=3)
    return figure


@figure_style
def _single_figure(draw: Callable[..., None], *values: object) -> Figure:
    figure = Figure(figsize=(4.6, 3.4), layout="constrained")
    draw(figure.subplots(), *values)
    return figure


def valve_curve_figure(curve: ValveCurve, unit: str = "m") -> Figure:
    """Return steady speeds over the valve signal with the fitted curve."""
    return _single_figure(draw_valve_curve, curve, unit)


def draw_valve_curve(axes: Axes, curve: ValveCurve, unit: str = "m") -> None:
    """Draw `valve_curve_figure` on existing axes."""
    scale, text = (1e3, "mm/s") if unit == "m" else (1.0, "rad/s")
    stride = -(-len(curve.signal) // _MAX_DOTS)
    axes.plot(
        curve.signal[::stride], scale * curve.speed[::stride], label="steady samples", **_DOT_STYLE
    )
    corners = [curve.signal.min(), *sorted(curve.values[:2]), curve.signal.max()]
    axes.plot(corners, scale * curve.predict(np.array(corners)), label="fit", **DASHED_STYLE)
    lower, upper = sorted(curve.values[:2])
    axes.axvspan(lower, upper, color="#eeeeee", zorder=0, label="dead band")
    axes.axvline(curve.neutral, color="#999999", linewidth=0.7)
    axes.set(xlabel="signal [V]", ylabel=f"speed [{text}]")
    axes.legend(markerscale=2)


def friction_figure(friction: CylinderFriction, unit: str = "m") -> Figure:
    """Return measured friction over speed with the fitted law."""
    return _single_figure(draw_friction, friction, unit)


def draw_friction(axes: Axes, friction: CylinderFriction, unit: str = "m") -> None:
    """Draw `friction_figure` on existing axes."""
    scale, text, force = (1e3, "mm/s", "N") if unit == "m" else (1.0, "rad/s", "N m")
    stride = -(-len(friction.speed) // _MAX_DOTS)
    axes.plot(
        scale * friction.speed[::stride],
        friction.force[::stride],
        label="steady samples",
        **_DOT_STYLE,
    )
    lowest_speed = np.abs(friction.speed).min()
    for direction, extreme_speed in zip(
        (-1, 1), (friction.speed.min(), friction.speed.max()), strict=True
    ):
        v = direction * np.geomspace(
            lowest_speed, max(abs(extreme_speed), 1.01 * lowest_speed), 200
        )
        axes.plot(
            scale * v, friction.predict(v), label="fit" if direction > 0 else None, **DASHED_STYLE
        )
    axes.set(xlabel=f"speed [{text}]", ylabel=f"friction [{force}]")
    axes.legend(loc="upper left", markerscale=2)


_MAX_POINTS = 2000  # instants that a line needs


_MotionRow = tuple[str, Sequence[Array], Sequence[float]]  # label, lines (N,), limits


@figure_style
def excitation_figure(excitation: Excitation) -> Figure:
    """Return the figure of a trajectory; limits are dashed, lead times shaded."""
    machine, reference, bounds = excitation.machine, excitation.trajectory, excitation.limits
    time, q, v, _, tau = (x[:: -(-len(x) // _MAX_POINTS)] for x in excitation.motion())
    columns: dict[str, list[_MotionRow]] = {}
    for i, joint in enumerate(machine.active):
        unit, scale = DISPLAY_UNITS[machine.unit(joint)]
        rows = (
            (f"stroke [{unit}]", scale, q, bounds.stroke_middle[i], bounds.half_stroke[i]),
            (f"velocity [{unit}/s]", scale, v, 0.0, bounds.velocity[i]),
            (f"force [{FORCE_UNITS[machine.unit(joint)]}]", 1.0, tau, 0.0, bounds.force[i]),
        )
        columns[joint] = [
            (label, [factor * x[:, i]], (factor * (centre - limit), factor * (centre + limit)))
            for label, factor, x, centre, limit in rows
        ]
    figure = _motion_figure(time, columns, 2.4)
    for axes in figure.axes:
        for start in (0, reference.duration - reference.lead):
            axes.axvspan(start, start + reference.lead, color=FAINT_COLOUR, alpha=0.5)
    return figure


@figure_style
def signals_figure(excitation: SignalExcitation) -> Figure:
    """Return the figure of valve signals: signal, stroke with dashed limits, pressures."""
    run, machine = excitation.run.columns(), excitation.machine
    bar, per_bar = display_unit("Pa", 1e5)
    columns: dict[str, list[_MotionRow]] = {}
    for joint in excitation.signals:
        unit, scale = DISPLAY_UNITS[machine.unit(joint)]
        index = machine.active.index(joint)
        limits = scale * machine.lower[index], scale * machine.upper[index]
        pressures = [per_bar * run[f"pressure_{joint}_{side}"] for side in "ab"]
        columns[joint] = [
            ("signal [V]", [run[f"voltage_{joint}"]], ()),
            (f"stroke [{unit}]", [scale * run[joint]], limits),
            (f"pressures A, B [{bar}]", pressures, ()),
        ]
    return _motion_figure(excitation.run.time, columns, 3.0)


def _motion_figure(
    time: Array, columns: Mapping[str, Sequence[_MotionRow]], panel_width: float
) -> Figure:
    """Return a figure with a column per joint, whose rows have finite limits dashed."""
    figure = Figure(figsize=(panel_width * len(columns) + 0.6, 6.0), layout="constrained")
    grid = figure.subplots(3, len(columns), sharex=True, squeeze=False)
    for panels, (joint, rows) in zip(grid.T, columns.items(), strict=True):
        panels[0].set_title(escape_label(joint))
        panels[-1].set_xlabel("time [s]")
        for axes, (label, lines, limits) in zip(panels, rows, strict=True):
            for values, colour in zip(lines, (RECORDED_COLOUR, "#2a8c4a"), strict=False):
                axes.plot(time, values, color=colour)
            for limit in filter(np.isfinite, limits):
                axes.axhline(limit, **DASHED_STYLE)
            axes.set_ylabel(label)
            axes.margins(x=0.0)
    return figure
