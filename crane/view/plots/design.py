"""Designs as a picture: the front of two goals, or where numbers ended, and how much it helped."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from crane.studies.design import Design
from crane.view.plots.recording import DASHED, RECORDED, STYLE, write_figure
from crane.view.plots.text import plain


def plot_design(found: Design, path: str | Path) -> None:
    """Write the picture of a design to a file.

    Args:
        found: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: design_figure(found))


def design_figure(found: Design) -> Figure:
    """Solutions over their ranges, and of two goals or more the first two against each other."""
    several = len(found.goals) > 1
    with mpl.rc_context(STYLE):
        height = max(2.2, 0.9 + 0.34 * len(found.names))
        figure = Figure(figsize=(10.0 if several else 7.0, max(height, 3.6 if several else 2.2)))
        axes = figure.subplots(1, 2 if several else 1, squeeze=False)[0]
        numbers, span = axes[-1], found.high - found.low
        rows = np.arange(len(found.names))
        for k, x in enumerate(reversed(found.solutions)):
            best = k == len(found.solutions) - 1
            numbers.plot(
                (x.values - found.low) / span, rows, "o-" if best and not several else "o",
                color=RECORDED if best or several else "#b8b8b8", markersize=5, linewidth=1.2,
                label=("best" if not several else "solutions") if best else None,
            )  # fmt: skip
        numbers.plot((found.before.values - found.low) / span, rows, "D", color="#c2452d",
                     markersize=5, label="before")  # fmt: skip
        numbers.set_yticks(rows, [plain(name) for name in found.names])
        numbers.set_ylim(len(rows) - 0.5, -0.5)
        numbers.set_xlim(-0.03, 1.03)
        numbers.set_xlabel("from the lower to the upper end of its range")
        numbers.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=2, frameon=False)
        if several:
            front = np.array([x.goals[:2] for x in found.solutions])
            axes[0].plot(*front.T, "o", linestyle=DASHED, color=RECORDED, markersize=5,
                         linewidth=1.0)  # fmt: skip
            axes[0].plot(*found.before.goals[:2], "D", color="#c2452d", markersize=6)
            axes[0].set_xlabel(plain(found.goals[0]))
            axes[0].set_ylabel(plain(found.goals[1]))
        goal = "; ".join(found.goals)
        figure.suptitle(plain(f"{found.machine.name}: {goal}"), x=0.01, ha="left", fontsize=10,
                        fontweight="bold")  # fmt: skip
        figure.tight_layout(rect=(0, 0, 1, 0.97))
    return figure
