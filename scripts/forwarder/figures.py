"""Figures like 8 to 10 of the paper, and effects of formulations and reconstructions."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from crane.common.atomic_output import replace_file
from crane.common.samples import Array
from crane.view.plots.figure_style import FIGURE_STYLE
from forwarder.paper import JOINTS, SIGNALS, TASKS, published
from forwarder.runs import Run

LOOK = {
    "virtual rig": {"color": "#b9b9b9", "linewidth": 1.0},
    "reference": {"color": "#333333", "linestyle": (0, (4, 2)), "linewidth": 1.0},
    "exact": {"color": "#1f5fa8"},
    "decoupled": {"color": "#e0701a"},
}
UNITS = (("deg", "deg/s", "N m"), ("mm", "mm/s", "N"), ("mm", "mm/s", "N"))


def save(figure: Figure, path: Path) -> None:
    """Write a figure whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(FIGURE_STYLE), replace_file(path) as part:
        figure.savefig(part, format="png", dpi=110)


def trajectory(number: int, runs: dict[str, Run], reference: tuple[Array, Array]) -> Figure:
    """Displacements, velocities, forces and tip path of one trajectory.

    Args:
        number: Of the trajectory.
        runs: By name, a key of `LOOK`.
        reference: Coordinates and velocities (N, 3) to follow.
    """
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(12.5, 7.2), layout="constrained")
        grid = figure.add_gridspec(3, 4, width_ratios=[1, 1, 1, 1.25])
        time = next(iter(runs.values())).time
        for j, joint in enumerate(JOINTS):
            scale = np.degrees(1) if j == 0 else 1e3
            for row in range(3):
                axes = figure.add_subplot(grid[row, j])
                for name, run in runs.items():
                    values = (scale * run.q, scale * run.v, run.tau)[row][:, j]
                    axes.plot(run.time, values, label=name, **LOOK[name])
                if row < 2:
                    axes.plot(time, scale * reference[row][:, j], **LOOK["reference"])
                what = (joint, f"{joint}'", SIGNALS[j])[row]
                axes.set_ylabel(f"{what} [{UNITS[j][row]}]")
                if row == 2:
                    axes.set_xlabel("time [s]")
        space = figure.add_subplot(grid[:2, 3], projection="3d")
        wanted = next(iter(runs.values())).wanted
        for name, run in runs.items():
            space.plot(*(1e3 * run.tip.T), label=name, **LOOK[name])
        space.plot(*(1e3 * wanted.T), label="reference", **LOOK["reference"])
        for axis, set_label in zip(
            "xyz", (space.set_xlabel, space.set_ylabel, space.set_zlabel), strict=True
        ):
            set_label(f"{axis} [mm]")
        space.locator_params(nbins=4)
        space.set_title("tip")
        space.legend(loc="upper left", bbox_to_anchor=(-0.15, 1.05))
        error = figure.add_subplot(grid[2, 3])
        for name, run in runs.items():
            error.plot(run.time, 1e3 * run.tip_error, **LOOK[name])
        error.set_ylabel("distance of the tip [mm]")
        error.set_xlabel("time [s]")
        figure.suptitle(f"Trajectory {number}: simulations, and the virtual rig's measurements")
    return figure


def scoreboard(rms: dict[str, dict[str, Array]], ranges: dict[str, dict[str, Array]]) -> Figure:
    """RMS of the nine forces in their published intervals.

    Args:
        rms: (3,) by task and formulation.
        ranges: (2, 3) least and largest over the feasible set, by task and formulation.
    """
    with mpl.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(10.5, 3.4), layout="constrained")
        for j, (axes, signal) in enumerate(zip(figure.subplots(1, 3), SIGNALS, strict=True)):
            for k, task in enumerate(TASKS):
                bounds = [(published(task, j), "#7a7a7a", "as printed")]
                if k == 0:
                    bounds.append((published(task, j, 5.0), "#b08cc9", "times five"))
                for place, color, label in bounds:
                    axes.bar(
                        k, place.high - place.low, 0.6, place.low, color=color, alpha=0.35,
                        label=f"published simulation, {label}" if k == 0 else None,
                    )  # fmt: skip
                    axes.hlines(place.rms, k - 0.3, k + 0.3, color=color, linewidth=1.2)
                for shift, name in ((-0.1, "exact"), (0.1, "decoupled")):
                    low, high = ranges[task][name][:, j]
                    color = LOOK[name]["color"]
                    axes.vlines(k + shift, low, high, color=color, linewidth=3, alpha=0.4)
                    axes.plot(
                        k + shift, rms[task][name][j], "o", color=color, markersize=5,
                        label=name if k == 0 else None,
                    )  # fmt: skip
            axes.set_xticks(range(3), ["1", "2", "3"])
            axes.set_xlabel("trajectory")
            axes.set_ylabel(f"RMS of {signal} [{'N m' if j == 0 else 'N'}]")
            axes.set_ylim(bottom=0)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure
