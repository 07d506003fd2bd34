"""A recording as one figure: displacements, velocities and forces, and the path of the tip."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from crane.errors import OutputError
from crane.output import replacing
from crane.recording import FORCE_UNITS, Recording
from crane.samples import Array
from crane.summary import READING_UNITS, points
from crane.view.thinning import envelope, thinned

FORMATS: dict[str, dict[str, None] | None] = {  # with the date left out of what is written
    "png": None,
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}
DASHED: Any = {"color": "#e0701a", "linestyle": (0, (4, 2)), "linewidth": 1.1}
RECORDED, INK, FAINT = "#1f5fa8", "#333333", "#d4d4d4"
STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": 10,
    "axes.labelsize": 8.5,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": FAINT,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.4,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.hashsalt": "crane",
}
# Distances of words from the axes of a box [points], of which matplotlib adds the last by itself.
TICK_OFFSET, LABEL_OFFSET, PAD_OFFSET = 8.0, 14.0, 8.0
MOST_COLUMNS = 5  # joints beside each other
# Least height of an axis, so that rounding noise of a joint at rest looks like rest.
LEAST_SPAN = {"deg": 0.2, "mm": 0.2, "deg/s": 0.2, "mm/s": 0.2, "N m": 0.02, "N": 0.2}


@dataclass(frozen=True, eq=False)
class _Panel:
    """One quantity of one joint over time, in the units to read it in."""

    quantity: str
    unit: str
    values: Array
    reference: Array | None


def plot_recording(recording: Recording, path: str | Path) -> None:
    """Write the figure of a recording to a file.

    Args:
        recording: What to show.
        path: Where to write; its suffix .png, .svg or .pdf chooses the format.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    write_figure(path, lambda: recording_figure(recording))


def write_figure(path: str | Path, draw: Callable[[], Figure]) -> None:
    """Draw a figure into a file whose suffix is a known format; see `plot_recording`."""
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise OutputError(f"{path}: unknown kind of picture, end the name in .png, .svg or .pdf")
    figure = draw()
    with mpl.rc_context(STYLE), replacing(path) as part:
        figure.savefig(part, format=kind, dpi=200, metadata=FORMATS[kind])


def recording_figure(recording: Recording) -> Figure:
    """The figure of a recording.

    One column per active joint with its displacement, velocity and force over time, in degrees
    and millimetres, many joints in several bands below each other; where the channels tip_x,
    tip_y, tip_z exist, the path of the tip beside them. References (channels reference_<joint>,
    reference_velocity_<joint>, reference_tip_x, ...) are dashed; with one for the tip comes its
    distance from it.
    """
    tip, joints = points(recording, "tip"), recording.joints
    with mpl.rc_context(STYLE):
        bands = -(-len(joints) // MOST_COLUMNS)
        columns = -(-len(joints) // bands)
        widths = [1.0] * columns + [1.6] * (tip is not None)
        width = 2.4 * sum(widths) + 0.3
        margin = 0.3 if tip is not None else 0.0  # the layout overlooks the label of the z axis
        layout = ConstrainedLayoutEngine(rect=(0.0, 0.0, 1.0 - margin / width, 1.0))
        figure = Figure(figsize=(width, 6.0 * bands), layout=layout)
        grid = figure.add_gridspec(3 * bands, len(widths), width_ratios=widths)
        for index, name in enumerate(joints):
            band, column = divmod(index, columns)
            beside = min(columns, len(joints) - band * columns)
            for row, panel in enumerate(_panels(recording, index)):
                axes = figure.add_subplot(grid[3 * band + row, column])
                _draw_panel(axes, recording.time, panel)
                _letter(axes, 3 * band * columns + row * beside + column)
                if row == 0:
                    axes.set_title(joint_symbol(name))
                if row == 2:
                    axes.set_xlabel("time [s]")
                else:
                    axes.tick_params(labelbottom=False)
        if tip is not None:
            reference = points(recording, "reference_tip")
            rows = slice(3) if reference is None else slice(2)
            space = figure.add_subplot(grid[rows, -1], projection="3d")
            _draw_path(space, tip, reference)
            _letter(space, 3 * len(joints))
            if reference is not None:
                axes = figure.add_subplot(grid[2, -1])
                _draw_panel(axes, recording.time, _tip_error(tip, reference))
                _letter(axes, 3 * len(joints) + 1)
                axes.set_xlabel("time [s]")
        _caption(figure, recording)
    return figure


def _panels(recording: Recording, column: int) -> tuple[_Panel, _Panel, _Panel]:
    """Displacement, velocity and force of one active joint."""
    name = recording.joints[column]
    unit, scale = READING_UNITS[recording.units[name]]
    turns = unit == "deg"

    def reference(prefix: str) -> Array | None:
        values = recording.channels.get(prefix + name)
        return None if values is None else scale * values

    return (
        _Panel(
            "angle" if turns else "displacement",
            unit,
            scale * recording.q[:, column],
            reference("reference_"),
        ),
        _Panel(
            "velocity",
            f"{unit}/s",
            scale * recording.v[:, column],
            reference("reference_velocity_"),
        ),
        _Panel(
            "torque" if turns else "force",
            FORCE_UNITS[recording.units[name]],
            recording.tau[:, column],
            None,
        ),
    )


def _tip_error(tip: Array, reference: Array) -> _Panel:
    distance = np.linalg.norm(tip - reference, axis=1)
    return _Panel("tip to reference", "mm", 1e3 * distance, None)


def _draw_panel(axes: Axes, time: Array, panel: _Panel) -> None:
    marker = "o" if len(time) == 1 else None
    curve = envelope(time, panel.values)
    axes.plot(*curve, color=RECORDED, marker=marker, label="recording")
    if panel.reference is not None:
        curve = envelope(time, panel.reference)
        axes.plot(*curve, marker=marker, label="reference", **DASHED)
    axes.set_ylabel(f"{panel.quantity} [{panel.unit}]")
    axes.margins(x=0.0, y=0.08)
    low, high = axes.get_ylim()
    if (lacking := LEAST_SPAN[panel.unit] - (high - low)) > 0:
        axes.set_ylim(low - lacking / 2, high + lacking / 2)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))


def _draw_path(axes: Axes3D, tip: Array, reference: Array | None) -> None:
    """The path of the tip [m] in space, to scale, with its shadow on the ground of the box."""
    tip, reference = thinned(tip), None if reference is None else thinned(reference)
    shown = tip if reference is None else np.vstack([tip, reference])
    low, high = shown.min(axis=0), shown.max(axis=0)
    span = np.maximum(high - low, 0.4 * max(float((high - low).max()), 1e-2)) * 1.1
    low, high = (low + high - span) / 2, (low + high + span) / 2
    x, y, z = tip.T
    axes.plot(x, y, np.full_like(z, low[2]), color="#a8a8a8", linewidth=1.0, label="shadow")
    axes.plot(x, y, z, color=RECORDED, label="recording")
    if reference is not None:
        axes.plot(*reference.T, label="reference", **DASHED)
    for end, name, face in ((tip[0], "start", "white"), (tip[-1], "end", RECORDED)):
        axes.plot(*end[:, None], "o", color=RECORDED, markerfacecolor=face, ms=5, label=name)
        axes.text(*end, f" {name}", fontsize=7.5, va="bottom")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="path of the tip")
    axes.set_box_aspect(span, zoom=0.88)
    axes.view_init(elev=24, azim=-60)
    for i, axis in enumerate((axes.xaxis, axes.yaxis, axes.zaxis)):
        axis.set_major_locator(FixedLocator(_ticks(low[i], high[i], span[i] / span.max())))
        axis.set_pane_color("#fafafa")
        # matplotlib moves words away from an axis in proportion to the widths across it
        across = float(np.delete(span, i).max() / span.max())
        axis.set_tick_params(pad=TICK_OFFSET / across - PAD_OFFSET)
        axis.labelpad = LABEL_OFFSET / across - PAD_OFFSET


def _ticks(low: float, high: float, share: float) -> list[float]:
    """Round values away from the ends, where other axes begin; few on a short axis."""
    margin = 0.12 * (high - low)
    low, high = low + margin, high - margin
    least, most = (2, 3) if share > 0.5 else (1, 2)
    inside: list[float] = []
    for count in range(1, 9):  # how many fit between round values depends on where they lie
        values = MaxNLocator(count, steps=[1, 2, 5, 10]).tick_values(low, high)
        inside = [float(value) for value in values if low <= value <= high] or inside
        if len(inside) >= least:
            break
    return inside[:: -(-len(inside) // most)]


def _letter(axes: Axes, index: int) -> None:
    """(a), (b), ... as panels are referred to in a text."""
    if index < len(ascii_lowercase):
        text, corner = f"({ascii_lowercase[index]})", "axes fraction"
        axes.annotate(text, (0, 1), (-28, 7), corner, "offset points")


def _caption(figure: Figure, recording: Recording) -> None:
    """What is shown, and which line is what."""
    machine = Path(recording.machine).stem.replace("_", " ")
    words = ": ".join(word for word in (machine, recording.task) if word)
    if words:
        figure.suptitle(words, x=0.01, ha="left", fontsize=11, fontweight="bold")
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    if "reference" in lines:
        shown = [lines["recording"], lines["reference"]]
        figure.legend(handles=shown, loc="outside upper right", ncols=2)


def joint_symbol(name: str) -> str:
    """A joint's name as mathematics where it is a letter and a number, q1 as q with index 1."""
    if match := re.fullmatch(r"([A-Za-z])(\d+)", name):
        return f"${match[1]}_{{{match[2]}}}$"
    return name.replace("$", r"\$")
