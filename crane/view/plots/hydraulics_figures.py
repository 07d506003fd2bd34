"""Figures of what was identified of a hydraulic cylinder: equation (29), valve curve, friction.

Equations are those of the electro-hydraulic forwarder paper (IROS 2012).
"""

from collections.abc import Callable, Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.identification.hydraulics.cylinder_friction import CylinderFriction
from crane.identification.hydraulics.orifice_equations import EquationSides
from crane.identification.hydraulics.valve_curve import ValveCurve
from crane.view.plots.recording_figure import DASHED_STYLE, FIGURE_STYLE, RECORDED_COLOUR

_DOT_STYLE: Any = {
    "linestyle": "",
    "marker": ".",
    "markersize": 3.5,
    "markeredgewidth": 0,
    "color": "#6f9bca",
    "alpha": 0.5,
}
_MAX_DOTS = 4000  # dots


def equation_sides_figure(runs: Mapping[str, EquationSides], unit: str = "m") -> Figure:
    """Both sides of (29) over time, a row per recording.

    Args:
        runs: By title.
        unit: Of the cylinder's coordinate, "m" or "rad".
    """
    with mpl.rc_context(FIGURE_STYLE):
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
        handles, labels = rows[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=3)
    return figure


def _single_figure(draw: Callable[..., None], *values: object) -> Figure:
    """A figure of one drawing alone."""
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(4.6, 3.4), layout="constrained")
        draw(figure.subplots(), *values)
    return figure


def valve_curve_figure(curve: ValveCurve, unit: str = "m") -> Figure:
    """Steady speeds over the signal, and the curve through them."""
    return _single_figure(draw_valve_curve, curve, unit)


def draw_valve_curve(axes: Axes, curve: ValveCurve, unit: str = "m") -> None:
    """`valve_curve_figure` on axes that are there."""
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
    axes.set_xlabel("signal [V]")
    axes.set_ylabel(f"speed [{text}]")
    axes.legend(markerscale=2)


def friction_figure(friction: CylinderFriction, unit: str = "m") -> Figure:
    """Measured friction over speed, and the law through it."""
    return _single_figure(draw_friction, friction, unit)


def draw_friction(axes: Axes, friction: CylinderFriction, unit: str = "m") -> None:
    """`friction_figure` on axes that are there."""
    scale, text, force = (1e3, "mm/s", "N") if unit == "m" else (1.0, "rad/s", "N m")
    stride = -(-len(friction.speed) // _MAX_DOTS)
    axes.plot(
        scale * friction.speed[::stride],
        friction.force[::stride],
        label="steady samples",
        **_DOT_STYLE,
    )
    extreme_speeds = friction.speed.min(), friction.speed.max()
    lowest_speed = np.abs(friction.speed).min()
    for direction, extreme_speed in zip((-1, 1), extreme_speeds, strict=True):
        v = direction * np.geomspace(
            lowest_speed, max(abs(extreme_speed), 1.01 * lowest_speed), 200
        )
        label = "fit" if direction > 0 else None
        axes.plot(scale * v, friction.predict(v), label=label, **DASHED_STYLE)
    axes.set_xlabel(f"speed [{text}]")
    axes.set_ylabel(f"friction [{force}]")
    axes.legend(loc="upper left", markerscale=2)
