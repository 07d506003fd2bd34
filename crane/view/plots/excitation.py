"""What excites a machine as one figure: a reference and its limits, or signals of valves."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crane.common.samples import Array
from crane.common.units import reading
from crane.identification.excitation.excite import Excitation
from crane.identification.excitation.signals import SignalExcitation
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.summary import READING_UNITS
from crane.view.plots.recording import DASHED, FAINT, RECORDED, STYLE, write_figure
from crane.view.plots.text import plain

_MOST = 2000  # instants that a line needs


def plot_excitation(excitation: Excitation, path: str | Path) -> None:
    """Write the figure of a reference.

    Raises:
        OutputError: The suffix is none of png, svg, pdf, or the file cannot be written.
    """
    write_figure(path, lambda: excitation_figure(excitation))


def excitation_figure(excitation: Excitation) -> Figure:
    """The figure of a reference: limits dashed, ways from and to rest shaded."""
    count = len(excitation.machine.active)
    columns = tuple(x[:: -(-len(x) // _MOST)] for x in excitation.motion())
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(2.4 * count + 0.6, 6.0), layout="constrained")
        grid = figure.subplots(3, count, sharex=True, squeeze=False)
        for i in range(count):
            _draw_joint(list(grid[:, i]), excitation, columns, i)
    return figure


def _draw_joint(
    column: Sequence[Axes], excitation: Excitation, motion: tuple[Array, ...], i: int
) -> None:
    """Stroke, velocity and force of an active joint below each other."""
    machine, reference, bounds = excitation.machine, excitation.trajectory, excitation.limits
    time, q, v, _, tau = motion
    joint = machine.active[i]
    unit, scale = READING_UNITS[machine.unit(joint)]
    middle, half = bounds.middle[i], bounds.half[i]
    force = FORCE_UNITS[machine.unit(joint)]
    rows = (
        ("stroke", unit, scale, q, (middle - half, middle + half)),
        ("velocity", f"{unit}/s", scale, v, (-bounds.velocity[i], bounds.velocity[i])),
        ("force", force, 1.0, tau, (-bounds.force[i], bounds.force[i])),
    )
    for axes, (what, label, factor, values, ends) in zip(column, rows, strict=True):
        axes.plot(time, factor * values[:, i], color=RECORDED)
        for end in [end for end in ends if np.isfinite(end)]:
            axes.axhline(factor * end, **DASHED)
        for way in (
            (0, reference.lead),
            (reference.duration - reference.lead, reference.duration),
        ):
            axes.axvspan(*way, color=FAINT, alpha=0.5)
        axes.set_ylabel(f"{what} [{label}]")
        axes.margins(x=0.0)
    column[0].set_title(plain(joint))
    column[-1].set_xlabel("time [s]")


def plot_signals(excitation: SignalExcitation, path: str | Path) -> None:
    """Write the figure of valve signals.

    Raises:
        OutputError: The suffix is none of png, svg, pdf, or the file cannot be written.
    """
    write_figure(path, lambda: signals_figure(excitation))


def signals_figure(excitation: SignalExcitation) -> Figure:
    """The figure of valve signals: signal, stroke with its ends dashed, pressures."""
    count = len(excitation.signals)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.0 * count + 0.6, 6.0), layout="constrained")
        grid = figure.subplots(3, count, sharex=True, squeeze=False)
        for i, joint in enumerate(excitation.signals):
            _draw_valve(list(grid[:, i]), excitation, joint)
    return figure


def _draw_valve(column: Sequence[Axes], excitation: SignalExcitation, joint: str) -> None:
    """Signal, stroke and pressures of a cylinder below each other."""
    run, machine = excitation.run.columns(), excitation.machine
    i = machine.active.index(joint)
    unit, scale = READING_UNITS[machine.unit(joint)]
    ends = machine.lower[i], machine.upper[i]
    bar, per_bar = reading("Pa", 1e5)
    rows = (
        ("signal", "V", 1.0, [f"voltage_{joint}"], ()),
        ("stroke", unit, scale, [joint], ends),
        ("pressures A, B", bar, per_bar, [f"pressure_{joint}_{side}" for side in "ab"], ()),
    )
    for axes, (what, label, factor, names, limits) in zip(column, rows, strict=True):
        for name, color in zip(names, (RECORDED, "#2a8c4a"), strict=False):
            axes.plot(excitation.run.time, factor * run[name], color=color)
        for end in limits:
            axes.axhline(factor * end, **DASHED)
        axes.set_ylabel(f"{what} [{label}]")
        axes.margins(x=0.0)
    column[0].set_title(plain(joint))
    column[-1].set_xlabel("time [s]")
