"""Work-precision curves of the benchmark: interpolation between them, and their picture."""

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from crane.view.plots.recording_figure import FIGURE_STYLE, INK_COLOUR, RECORDED_COLOUR

Tip = Callable[[], np.ndarray | None]  # its position (3,) [m], None if unstable
Engine = Callable[[float], Tip]  # runs with a step [s]
Curves = dict[str, list[tuple[float, float, float]]]  # (step [s], tip error [m], time [s])

DURATION = 2.4  # [s], a whole number of each step
LOOKS = {
    "compiled backend": (RECORDED_COLOUR, "o"),
    "Pinocchio backend": ("#7fb0e0", "s"),
    "constraintDynamics": ("#3c8c4a", "^"),
    "MuJoCo Euler": ("#b9b9b9", "v"),
    "MuJoCo implicitfast": ("#e0a060", "D"),
    "MuJoCo RK4": ("#c8501a", "P"),
}


def time_for(points: list[tuple[float, float, float]], error: float) -> float | None:
    """Least time [s] in which an engine gets below an error, None if it never does.

    Times between two steps are interpolated on logarithmic scales; an error above that of the
    longest step takes the time of the longest step.
    """
    frontier: list[tuple[float, float]] = []
    for _, e, t in sorted(points, key=lambda point: point[2]):
        if not frontier or e < frontier[-1][0]:
            frontier.append((e, t))
    if not frontier or frontier[-1][0] > error:
        return None
    if frontier[0][0] <= error:
        return frontier[0][1]
    errors, times = np.log(frontier[::-1]).T
    return float(np.exp(np.interp(np.log(error), errors, times)))


def ratios(curves: Curves) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Head and rows of a table: times of all engines at equal errors, relative to the first."""
    ours, *others = curves
    head = ("tip error", f"{ours} [ms]", *(f"{name}, ratio" for name in others))
    rows = []
    for power in range(-4, -12, -1):
        own = time_for(curves[ours], 10.0**power)
        if own is None:
            break
        row = [f"1e{power} m", f"{1e3 * own:.3g}"]
        for name in others:
            theirs = time_for(curves[name], 10.0**power)
            row.append("not reached" if theirs is None else f"{theirs / own:.0f}")
        rows.append(tuple(row))
    return head, rows


def draw(curves: Curves, path: Path) -> None:
    """The curves as a picture."""
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(7.2, 4.4), layout="constrained")
        axes = figure.add_subplot()
        for name, points in curves.items():
            colour, marker = LOOKS[name]
            _, errors, times = np.array(points).T
            axes.loglog(1e3 * times, errors, marker + "-", color=colour, ms=5, label=name)
        first = curves["compiled backend"]
        for step, error, t in first:
            axes.annotate(
                f"{1e3 * step:g} ms", (1e3 * t, error), (-5, -3), textcoords="offset points",
                ha="right", va="top", color=INK_COLOUR, fontsize=7,
            )  # fmt: skip
        axes.set(
            xlabel="CPU time [ms]",
            ylabel=f"error of the tip after {DURATION:g} s [m]",
            title=f"{DURATION:g} s of the mini forwarder in springs and dampers",
        )
        low = min(t for _, _, t in first)
        axes.set_xlim(left=1e3 * low / 3)
        figure.legend(loc="outside right upper")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=160)
