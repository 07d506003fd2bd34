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
from crane.identification.hydraulics.orifice_rows import Sides
from crane.identification.hydraulics.valve import ValveCurve
from crane.view.plots.recording import DASHED, RECORDED, STYLE

_DOTS: Any = {
    "linestyle": "",
    "marker": ".",
    "markersize": 3.5,
    "markeredgewidth": 0,
    "color": "#6f9bca",
    "alpha": 0.5,
}
_MOST = 4000  # dots


def sides_figure(runs: Mapping[str, Sides], unit: str = "m") -> Figure:
    """Both sides of (29) over time, a row per recording.

    Args:
        runs: By title.
        unit: Of the cylinder's coordinate, "m" or "rad".
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 0.6 + 1.9 * len(runs)), layout="constrained")
        rows = figure.subplots(len(runs), 1, squeeze=False)[:, 0]
        for axes, (title, both) in zip(rows, runs.items(), strict=True):
            gap = 1e4 * (both.right - both.left)
            axes.plot(both.time, gap, color="#b9b9b9", linewidth=0.7, label="10 x difference")
            axes.plot(both.time, 1e3 * both.right, color=RECORDED, label="measured: right side Y")
            axes.plot(both.time, 1e3 * both.left, label="model: left side A X", **DASHED)
            axes.set_ylabel(r"$10^{-3}$ " + ("m²/s" if unit == "m" else "m³/(rad s)"))
            error = f"relative error {100 * both.relative:.2g} %"
            axes.set_title(f"{title}: {error}", loc="left", fontsize=9)
            axes.margins(x=0.0)
        rows[-1].set_xlabel("time [s]")
        handles, labels = rows[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=3)
    return figure


def _figure(draw: Callable[..., None], *shown: object) -> Figure:
    """A figure of one drawing alone."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.6, 3.4), layout="constrained")
        draw(figure.subplots(), *shown)
    return figure


def valve_figure(curve: ValveCurve, unit: str = "m") -> Figure:
    """Steady speeds over the signal, and the curve through them."""
    return _figure(draw_valve, curve, unit)


def draw_valve(axes: Axes, curve: ValveCurve, unit: str = "m") -> None:
    """`valve_figure` on axes that are there."""
    scale, text = (1e3, "mm/s") if unit == "m" else (1.0, "rad/s")
    every = -(-len(curve.signal) // _MOST)
    axes.plot(curve.signal[::every], scale * curve.speed[::every], label="steady samples", **_DOTS)
    corners = [curve.signal.min(), *sorted(curve.values[:2]), curve.signal.max()]
    axes.plot(corners, scale * curve.predict(np.array(corners)), label="fit", **DASHED)
    low, high = sorted(curve.values[:2])
    axes.axvspan(low, high, color="#eeeeee", zorder=0, label="dead band")
    axes.axvline(curve.neutral, color="#999999", linewidth=0.7)
    axes.set_xlabel("signal [V]")
    axes.set_ylabel(f"speed [{text}]")
    axes.legend(markerscale=2)


def friction_figure(found: CylinderFriction, unit: str = "m") -> Figure:
    """Measured friction over speed, and the law through it."""
    return _figure(draw_friction, found, unit)


def draw_friction(axes: Axes, found: CylinderFriction, unit: str = "m") -> None:
    """`friction_figure` on axes that are there."""
    scale, text, force = (1e3, "mm/s", "N") if unit == "m" else (1.0, "rad/s", "N m")
    every = -(-len(found.speed) // _MOST)
    axes.plot(scale * found.speed[::every], found.force[::every], label="steady samples", **_DOTS)
    ends = found.speed.min(), found.speed.max()
    slowest = np.abs(found.speed).min()
    for sense, end in zip((-1, 1), ends, strict=True):
        v = sense * np.geomspace(slowest, max(abs(end), 1.01 * slowest), 200)
        label = "fit" if sense > 0 else None
        axes.plot(scale * v, found.predict(v), label=label, **DASHED)
    axes.set_xlabel(f"speed [{text}]")
    axes.set_ylabel(f"friction [{force}]")
    axes.legend(loc="upper left", markerscale=2)
