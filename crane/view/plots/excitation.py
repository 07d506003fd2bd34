"""A reference for identification as one figure: strokes, velocities, forces, and their limits."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from crane.common.output import replacing
from crane.identification.excitation.excite import Excitation
from crane.recordings.recording import FORCE_UNITS
from crane.recordings.summary import READING_UNITS
from crane.view.plots.recording import DASHED, FAINT, RECORDED, STYLE
from crane.view.plots.text import plain

_MOST = 2000  # instants that a line needs


def plot_excitation(excitation: Excitation, path: str | Path) -> None:
    """Write the figure of a reference as png: limits dashed, ways from and to rest shaded.

    Raises:
        OutputError: The file cannot be written.
    """
    machine, reference, bounds = excitation.machine, excitation.path, excitation.limits
    columns = excitation.motion()
    time, q, v, _, tau = (x[:: -(-len(x) // _MOST)] for x in columns)
    with mpl.rc_context(STYLE), replacing(path) as part:
        count = len(machine.active)
        figure = Figure(figsize=(2.4 * count + 0.6, 6.0), layout="constrained")
        grid = figure.subplots(3, count, sharex=True, squeeze=False)
        for i, joint in enumerate(machine.active):
            unit, scale = READING_UNITS[machine.unit(joint)]
            middle, half = bounds.middle[i], bounds.half[i]
            force = FORCE_UNITS[machine.unit(joint)]
            rows = (
                ("stroke", unit, scale, q, (middle - half, middle + half)),
                ("velocity", f"{unit}/s", scale, v, (-bounds.velocity[i], bounds.velocity[i])),
                ("force", force, 1.0, tau, (-bounds.force[i], bounds.force[i])),
            )
            for axes, (what, label, factor, values, ends) in zip(grid[:, i], rows, strict=True):
                axes.plot(time, factor * values[:, i], color=RECORDED)
                for end in ends:
                    if np.isfinite(end):
                        axes.axhline(factor * end, **DASHED)
                axes.axvspan(0, reference.lead, color=FAINT, alpha=0.5)
                axes.axvspan(
                    reference.duration - reference.lead, reference.duration, color=FAINT, alpha=0.5
                )
                axes.set_ylabel(f"{what} [{label}]")
                axes.margins(x=0.0)
            grid[0, i].set_title(plain(joint))
            grid[2, i].set_xlabel("time [s]")
        figure.savefig(part, format="png", dpi=200)
