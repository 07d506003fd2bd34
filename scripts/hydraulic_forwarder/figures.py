"""Figures like 4 to 9 of the paper, and of valve and friction."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.atomic_output import replace_file
from crane.common.samples import Array
from crane.identification.hydraulics.cylinder_friction import CylinderFriction
from crane.identification.hydraulics.valve_curve import ValveCurve
from crane.identification.signals.signal_processing import Motion
from crane.view.plots.figure_style import DASHED_STYLE, FIGURE_STYLE, RECORDED_COLOUR
from crane.view.plots.identification_figures import draw_friction, draw_valve_curve
from hydraulic_forwarder.mechanics import HeldOutForces

LIGHT = {"color": "#c9c9c9", "linewidth": 0.6}
REFERENCE = {"color": "#333333", "linestyle": (0, (4, 2)), "linewidth": 0.9}


def save(figure: Figure, path: Path) -> None:
    """Write a figure whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(FIGURE_STYLE), replace_file(path) as part:
        figure.savefig(part, format="png", dpi=110)


def data(motion: Motion, reference: tuple[Array, Array, Array], title: str) -> Figure:
    """Figures 4 and 5: coordinates, velocities and accelerations of the joints.

    Args:
        motion: Averaged and smoothed.
        reference: q, q', q'' (N, 3) that was followed.
        title: Of the figure.
    """
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(9.6, 6.0), layout="constrained")
        grid = figure.subplots(3, 3, sharex=True)
        heads = (r"first link, $q_2$", r"second link, $q_3$", r"telescope, $q_4$")
        for j in range(3):
            unit = "m" if j == 2 else "rad"
            for row, (values, wanted) in enumerate(
                zip((motion.q, motion.v, motion.a), reference, strict=True)
            ):
                axes = grid[row, j]
                what = ("coordinate", "velocity", "acceleration")[row]
                axes.plot(
                    motion.time,
                    values[:, j],
                    color=RECORDED_COLOUR,
                    linewidth=(1.4, 1.2, 0.7)[row],
                )
                if row < 2:
                    axes.plot(motion.time, wanted[:, j], **REFERENCE)
                axes.set_ylabel(f"{what} [{unit}{('', '/s', '/s²')[row]}]")
                axes.margins(x=0.0)
            grid[0, j].set_title(heads[j])
            grid[2, j].set_xlabel("time [s]")
        _legend(figure, grid[0, 0], ("average of the periods, Kalman estimates", "reference"))
        figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
    return figure


def torques(judged: HeldOutForces, measured: Array, title: str) -> Figure:
    """Figures 6 and 7: measured and modelled tau_2, tau_3, F_4.

    Args:
        judged: Both through the filter.
        measured: (N, 3) before the filter.
        title: Of the figure.
    """
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(8.2, 7.0), layout="constrained")
        rows = figure.subplots(3, 1, sharex=True)
        labels = (r"$\tau_2$ [kN m]", r"$\tau_3$ [kN m]", r"$F_4$ [kN]")
        for i, (axes, label) in enumerate(zip(rows, labels, strict=True)):
            axes.plot(judged.time, measured[:, i] / 1e3, **LIGHT)
            axes.plot(judged.time, judged.measured[:, i] / 1e3, color=RECORDED_COLOUR)
            axes.plot(judged.time, judged.modelled[:, i] / 1e3, **DASHED_STYLE)
            share = f"relative error {100 * judged.relative_error[i]:.2g} %"
            error = f"RMS error {judged.rmse[i]:.2g} {'N' if i == 2 else 'N m'}"
            axes.set_title(f"{error}, {share}", loc="left", fontsize=9)
            low, high = (f(judged.measured[:, i] / 1e3) for f in (np.min, np.max))
            room = 0.25 * (high - low)
            axes.set_ylim(low - room, high + room)
            axes.set_ylabel(label)
            axes.margins(x=0.0)
        rows[-1].set_xlabel("time [s]")
        _legend(
            figure, rows[0], ("measured, average of the periods", "measured, 2 Hz", "model, 2 Hz")
        )
        figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
    return figure


def lifting(runs: list[tuple[Array, Array, Array, Array]]) -> Figure:
    """Figure 8: of each recording time, reference of q2, u and F' [N/s], (N,) each."""
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(9.6, 6.2), layout="constrained")
        grid = figure.subplots(3, 3)
        heads = ("reference of the first link", "control input", "estimate of the force's rate")
        for row, run in enumerate(runs):
            time = run[0]
            for j, (values, label) in enumerate(
                zip(
                    (run[1], run[2], run[3] / 1e3),
                    (r"$q_2^{\rm ref}$ [rad]", r"$u$", r"$\dot F_2$ [kN/s]"),
                    strict=True,
                )
            ):
                axes = grid[row, j]
                axes.plot(time, values, color=RECORDED_COLOUR, linewidth=(1.4, 1.0, 0.6)[j])
                axes.set_ylabel(label)
                axes.margins(x=0.0)
                if row == 0:
                    axes.set_title(heads[j])
                if row == 2:
                    axes.set_xlabel("time [s]")
    return figure


def valve_and_friction(curve: ValveCurve, friction: CylinderFriction, law: Array) -> Figure:
    """Valve curve of the extension, and friction of the lift cylinder with its true law.

    Args:
        curve: Of a compensated valve.
        friction: Of a cylinder.
        law: (2, N) speeds and true friction.
    """
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(9.0, 3.6), layout="constrained")
        left, right = figure.subplots(1, 2)
        draw_valve_curve(left, curve)
        left.set_title("valve of the extension", loc="left", fontsize=9)
        draw_friction(right, friction)
        for part in (law[:, law[0] < 0], law[:, law[0] > 0]):
            label = "true" if part[0, 0] > 0 else None
            right.plot(1e3 * part[0], part[1], color="#333333", linewidth=0.9, label=label)
        right.set_ylim(-620, 620)
        right.legend(loc="upper left", markerscale=2)
        right.set_title("friction of the lift cylinder", loc="left", fontsize=9)
    return figure


def _legend(figure: Figure, axes: Axes, labels: tuple[str, ...]) -> None:
    figure.legend(axes.get_lines(), labels, loc="outside upper right", ncols=len(labels))
