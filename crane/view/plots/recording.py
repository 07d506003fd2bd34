"""A recording as one figure: displacements, velocities and forces, and the path of the tip."""

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec, SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from crane.common.errors import OutputError
from crane.common.output import replacing
from crane.common.samples import Array
from crane.common.scratch import release
from crane.common.units import reading
from crane.recordings.recording import FORCE_UNITS, Recording
from crane.recordings.summary import heading, points, tip_error
from crane.view.plots.text import plain
from crane.view.plots.thinning import envelope, thinned

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
_FLAT = 0.01  # of a path's size, what it may leave a plane by
MOST_COLUMNS = 5  # joints beside each other
_LETTER, _ENTRY = 0.11, 1.0  # [in] of a title, and of an entry of a legend
# Least height of an axis [SI], so that rounding noise of a joint at rest looks like rest.
LEAST_SPAN = {
    "rad": 3e-3, "m": 2e-4, "rad/s": 3e-3, "m/s": 2e-4, "N m": 0.02, "N": 0.2, "Pa": 1e4,
    "m3/s": 1e-7, "V": 0.01,
}  # fmt: skip
# Rows of a hydraulic machine: quantity, unit, channels of a joint by what a line is called.
HYDRAULIC_ROWS = (
    ("pressure", "Pa", {"A": "pressure_{}_a", "B": "pressure_{}_b", "supply": "pressure_supply"}),
    ("flow", "m3/s", {"A": "flow_{}_a", "B": "flow_{}_b"}),
    ("signal", "V", {"recording": "voltage_{}", "B": "voltage_{}_b"}),
)
LINES: Mapping[str, Any] = {
    "recording": {"color": RECORDED},
    "A": {"color": RECORDED},
    "B": {"color": "#2a8c4a"},
    "supply": {"color": "#a8a8a8", "linewidth": 1.0},
    "reference": DASHED,
}


@dataclass(frozen=True, eq=False)
class _Panel:
    """One quantity of one joint over time [SI]: lines (N,) by what they are called.

    With what they should be, errors to that: computed as they are drawn, as a long recording is
    more than memory has room for.
    """

    quantity: str
    unit: str
    lines: dict[str, Array]
    wanted: Array | None = None

    def drawn(self) -> Iterator[tuple[str, Array]]:
        """Each line with its values (N,)."""
        for label, values in self.lines.items():
            release()
            yield label, values if self.wanted is None else self.wanted - values


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

    One column per active joint with its displacement, velocity and force over time, in the units
    that the page of a run has, many joints in several bands below each other; of cylinders with
    valves also pressures, flows and signals. Where the channels tip_x, tip_y, tip_z exist, the
    path of the tip is beside them, in space, or in the plane of two coordinates where the third
    hardly changes. References (channels reference_<joint>,
    reference_velocity_<joint>, reference_tip_x, ...) are dashed; errors (references less
    displacements) have a row of their own, and the tip its distance from its reference.
    """
    tip, joints = points(recording, "tip"), recording.joints
    level = None if tip is None else _plane(tip, points(recording, "reference_tip"))
    by_joint = [_panels(recording, index) for index in range(len(joints))]
    kept = [i for i in range(len(by_joint[0])) if any(x[i].lines for x in by_joint)]
    panels = [[column[row] for column in by_joint] for row in kept]
    rows = len(kept)
    with mpl.rc_context(STYLE):
        bands = -(-len(joints) // MOST_COLUMNS)
        columns = -(-len(joints) // bands)
        in_space = tip is not None and level is None
        widths = [1.0] * columns + [1.6 if in_space else 1.0] * (tip is not None)
        width = 2.4 * sum(widths) + 0.3
        margin = 0.3 if in_space else 0.0  # the layout overlooks the label of the z axis
        layout = ConstrainedLayoutEngine(rect=(0.0, 0.0, 1.0 - margin / width, 1.0))
        figure = Figure(figsize=(width, 2.0 * rows * bands), layout=layout)
        grid = figure.add_gridspec(rows * bands, len(widths), width_ratios=widths)
        letters = iter(ascii_lowercase)
        for band, row in itertools.product(range(bands), range(rows)):
            beside = range(band * columns, min((band + 1) * columns, len(joints)))
            places = {i: grid[rows * band + row, i - beside.start] for i in beside}
            _draw_row(figure, places, recording, panels, row, letters)
        if tip is not None:
            _draw_tip(figure, grid, recording, tip, level, letters)
        _caption(figure, recording)
    return figure


def _panels(recording: Recording, column: int) -> list[_Panel]:
    """Displacement, velocity, force and error of an active joint, its cylinder's; some empty."""
    name, channels = recording.joints[column], recording.channels
    unit = recording.units[name]
    turns, wanted = unit == "rad", f"reference_{name}"

    def lines(values: Array, reference: str = "") -> dict[str, Array]:
        beside = {"reference": channels[reference]} if reference in channels else {}
        return {"recording": values[:, column], **beside}

    found = [
        _Panel("angle" if turns else "displacement", unit, lines(recording.q, wanted)),
        _Panel("velocity", f"{unit}/s", lines(recording.v, f"reference_velocity_{name}")),
        _Panel(
            "torque" if turns else "force",
            FORCE_UNITS[unit],
            {} if name in recording.free else lines(recording.tau),
        ),
    ]
    if wanted in channels:
        found.append(_Panel("error", unit, lines(recording.q), channels[wanted]))
    else:
        found.append(_Panel("error", unit, {}))
    for quantity, shown, names in HYDRAULIC_ROWS:
        own = [label for label, channel in names.items() if channel.format(name) != channel]
        there = {
            label: channels[channel]
            for label, channel in ((label, text.format(name)) for label, text in names.items())
            if recording.channel_units.get(channel) == shown
        }
        found.append(_Panel(quantity, shown, there if any(x in there for x in own) else {}))
    return found


def _scales(panels: Sequence[_Panel]) -> dict[str, tuple[str, float]]:
    """The unit that panels of a row are read in, and its scale, the same for equal units."""
    peaks: dict[str, float] = {}
    for panel in panels:
        for _, values in panel.drawn():
            peaks[panel.unit] = max(peaks.get(panel.unit, 0.0), float(np.abs(values).max()))
    return {unit: reading(unit, peak) for unit, peak in peaks.items()}


def _draw_panel(axes: Axes, time: Array, panel: _Panel, unit: str, scale: float) -> None:
    marker = "o" if len(time) == 1 else None
    for label, values in panel.drawn():
        axes.plot(*envelope(time, scale * values), marker=marker, label=label, **LINES[label])
    axes.set_ylabel(f"{panel.quantity} [{unit}]")
    axes.margins(x=0.0, y=0.08)
    low, high = axes.get_ylim()
    if (lacking := scale * LEAST_SPAN[panel.unit] - (high - low)) > 0:
        axes.set_ylim(low - lacking / 2, high + lacking / 2)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))


def _draw_row(
    figure: Figure,
    places: Mapping[int, SubplotSpec],
    recording: Recording,
    panels: Sequence[Sequence[_Panel]],
    row: int,
    letters: Iterator[str],
) -> None:
    """A row of panels at the places of some joints; `panels` has those of all, row by row."""
    scales = _scales(panels[row])
    for index, place in places.items():
        panel = panels[row][index]
        if not panel.lines:
            continue
        axes = figure.add_subplot(place)
        _draw_panel(axes, recording.time, panel, *scales[panel.unit])
        _letter(axes, letters)
        if row == 0:
            axes.set_title(joint_symbol(recording.joints[index]))
        if not any(below[index].lines for below in panels[row + 1 :]):
            axes.set_xlabel("time [s]")
        else:
            axes.tick_params(labelbottom=False)


def _draw_tip(
    figure: Figure, grid: GridSpec, recording: Recording, tip: Array,
    level: tuple[int, int] | None, letters: Iterator[str],
) -> None:  # fmt: skip
    """The path of the tip in the last column, and its distance from a reference below it."""
    reference, distance = points(recording, "reference_tip"), tip_error(recording)
    tall = slice(3) if reference is None else slice(2)
    if level is None:
        space = figure.add_subplot(grid[tall, -1], projection="3d")
        _draw_path(space, tip, reference)
        _letter(space, letters)
    else:
        flat = figure.add_subplot(grid[tall, -1])
        _draw_flat_path(flat, tip, reference, level)
        _letter(flat, letters)
    if distance is None:
        return
    axes = figure.add_subplot(grid[2, -1])
    panel = _Panel("tip to reference", "m", {"recording": distance})
    _draw_panel(axes, recording.time, panel, "mm", 1e3)
    _letter(axes, letters)
    axes.set_xlabel("time [s]")


def _plane(tip: Array, reference: Array | None) -> tuple[int, int] | None:
    """The two coordinates that a path lies in the plane of, but for 1 % of its size; else None.

    Of a straight path upright planes go first, that of x and z before that of y and z.
    """
    low, high = _ends(tip, reference)
    flat = high - low <= _FLAT * (high - low).max()
    planes = (((0, 2), 1), ((1, 2), 0), ((0, 1), 2))
    return next((plane for plane, across in planes if flat[across]), None)


def _ends(tip: Array, reference: Array | None) -> tuple[Array, Array]:
    """Lowest and highest corner (3,) of a path and its reference [m]."""
    shown = [tip] if reference is None else [tip, reference]
    low, high = zip(*((x.min(axis=0), x.max(axis=0)) for x in shown), strict=True)
    return np.min(low, axis=0), np.max(high, axis=0)


def _around(tip: Array, reference: Array | None) -> tuple[Array, Array]:
    """Corners (3,) of a box around them that is nowhere flat [m]."""
    low, high = _ends(tip, reference)
    span = np.maximum(high - low, 0.4 * max(float((high - low).max()), 1e-2)) * 1.1
    return (low + high - span) / 2, (low + high + span) / 2


def _draw_flat_path(
    axes: Axes, tip: Array, reference: Array | None, plane: tuple[int, int]
) -> None:
    """The path of the tip [m] in a plane, to scale."""
    i, j = plane
    x, y = thinned(tip)[:, plane].T
    axes.plot(x, y, color=RECORDED, label="recording")
    if reference is not None:
        axes.plot(*thinned(reference)[:, plane].T, label="reference", **DASHED)
    ends = ((0, "start", "white"), (-1, "end", RECORDED))
    for end, name, face in ends:
        place = x[end], y[end]
        axes.plot(*place, "o", color=RECORDED, markerfacecolor=face, ms=5, label=name)
        axes.annotate(name, place, (5, 4), textcoords="offset points", fontsize=7.5)
    axes.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]", title="path of the tip")
    low, high = _around(tip, reference)
    axes.set(xlim=(low[i], high[i]), ylim=(low[j], high[j]), aspect="equal", anchor="N")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))


def _draw_path(axes: Axes3D, tip: Array, reference: Array | None) -> None:
    """The path of the tip [m] in space, to scale, with its shadow on the ground of the box."""
    tip, reference = thinned(tip), None if reference is None else thinned(reference)
    low, high = _around(tip, reference)
    span = high - low
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


def _letter(axes: Axes, letters: Iterator[str]) -> None:
    """(a), (b), ... as panels are referred to in a text."""
    if letter := next(letters, ""):
        axes.annotate(f"({letter})", (0, 1), (-28, 7), "axes fraction", "offset points")


def _caption(figure: Figure, recording: Recording) -> None:
    """What is shown, and which line is what."""
    words = heading(recording)
    if words:
        figure.suptitle(plain(words), x=0.01, ha="left", fontsize=11, fontweight="bold")
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    if shown := [lines[label] for label in LINES if label in lines and label != "recording"]:
        beside = _LETTER * len(words) + _ENTRY * (1 + len(shown)) < figure.get_figwidth()
        figure.legend(
            handles=[lines["recording"], *shown],
            loc="outside upper right" if beside else "outside lower center",
            ncols=1 + len(shown),
        )


def joint_symbol(name: str) -> str:
    """A joint's name as mathematics where it is a letter and a number, q1 as q with index 1."""
    if match := re.fullmatch(r"([A-Za-z])(\d+)", name):
        return f"${match[1]}_{{{match[2]}}}$"
    return plain(name)
