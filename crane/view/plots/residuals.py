"""What is left of a calibration: of a channel over time, and against the motion of a drive."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.common.units import reading
from crane.identification.calibration.dependence import Left, groups
from crane.identification.calibration.result import Channel
from crane.view.plots.calibration import HELD_OUT, lines_of, spans
from crane.view.plots.recording import DASHED, INK, RECORDED
from crane.view.plots.text import plain
from crane.view.plots.thinning import envelope

_DOTS = 4000  # of a picture
_CLOUD, _MEAN = "#9db8d6", str(DASHED["color"])
_MOVES = {-1: "back", 0: "rest", 1: "out"}


def channel_figure(channel: Channel, name: str) -> Figure:
    """A channel over time, measured, before and fitted; below what the fitted one leaves."""
    figure = Figure(figsize=(5.8, 3.3))
    grid = {"height_ratios": (2.2, 1), "left": 0.14, "right": 0.985, "top": 0.9, "bottom": 0.13}
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={**grid, "hspace": 0.12})
    unit = lines_of(upper, channel)
    left = channel.after - channel.measured
    small, scale = reading(channel.unit, float(np.abs(left).max()))
    lower.plot(*envelope(channel.time, scale * left), color=RECORDED, linewidth=0.7)
    lower.axhline(0.0, color=INK, linewidth=0.6)
    for axes in (upper, lower):
        for start, end in spans(channel.time, np.logical_not(channel.train)):
            axes.axvspan(start, end, color=HELD_OUT, zorder=-1)
        axes.yaxis.set_label_coords(-0.125, 0.5)
    upper.set_ylabel(f"[{unit}]")
    lower.set_ylabel(f"left [{small}]")
    lower.set_xlabel("time [s]")
    upper.margins(x=0.0)
    upper.set_title(plain(name), loc="left", fontsize=8.5)
    upper.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=3, borderpad=0, fontsize=8)
    return figure


def left_figure(left: Left) -> Figure:
    """What is left of a channel against speed, pressure and direction of a drive.

    Dots are instants, the line has the means of groups of as many each; of directions the span of
    95 of 100 instants and the mean.
    """
    figure = Figure(figsize=(11.8, 2.5))
    grid = {"left": 0.065, "right": 0.993, "top": 0.87, "bottom": 0.19, "wspace": 0.06}
    panels = figure.subplots(1, 3, sharey=True, gridspec_kw={**grid, "width_ratios": (2, 2, 1)})
    unit, scale = reading(left.unit, float(np.abs(left.residual).max()))
    y = scale * left.residual
    units = {"speed": left.rate, "pressure": "Pa"}
    for axes, (what, x) in zip(panels, left.motion.items(), strict=True):
        axes.axhline(0.0, color=INK, linewidth=0.6)
        axes.set_title(f"{what}: {100 * left.shares[what]:.0f} %", loc="left", fontsize=8.5)
        if what in units:
            name, size = reading(units[what], float(np.abs(x).max()))
            _dots(axes, size * x, y)
            of = f"{left.drive}, {left.chamber.upper()}" if what == "pressure" else left.drive
            axes.set_xlabel(plain(f"{what} of {of} [{name}]"))
        else:
            _by_direction(axes, x, y)
            axes.set_xlabel(plain(f"direction of {left.drive}"))
    panels[0].set_ylabel(plain(f"left of {left.name} [{unit}]"))
    return figure


def _dots(axes: Axes, x: Array, y: Array) -> None:
    step = -(-len(x) // _DOTS)
    axes.plot(x[::step], y[::step], ".", color=_CLOUD, markersize=2)
    means = np.array([(x[some].mean(), y[some].mean()) for some in groups(x)])
    axes.plot(*means.T, color=_MEAN, linewidth=1.1, marker="o", markersize=3)


def _by_direction(axes: Axes, x: Array, y: Array) -> None:
    for side in _MOVES:
        some = y[x == side]
        if len(some):
            axes.plot([side, side], np.percentile(some, (2.5, 97.5)), color=_CLOUD, linewidth=6)
            axes.plot([side], [some.mean()], color=_MEAN, marker="o", markersize=4)
    axes.set_xticks(list(_MOVES), list(_MOVES.values()))
    axes.set_xlim(-1.5, 1.5)
