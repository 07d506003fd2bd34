"""Figures of recordings, and the style of all figures."""

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

from crane.common.atomic_output import replace_file
from crane.common.errors import OutputError
from crane.common.samples import Array
from crane.common.scratch_arrays import release_pages
from crane.common.units import display_unit
from crane.recordings.recording import FORCE_UNITS, Recording
from crane.recordings.recording_summary import heading, point_channel, tip_error
from crane.view.plots.figure_text import envelope, escape_label, thin_path

FIGURE_FORMATS: dict[str, dict[str, None] | None] = {  # metadata without dates
    "png": None,
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}
DASHED_STYLE: Any = {"color": "#e0701a", "linestyle": (0, (4, 2)), "linewidth": 1.1}
RECORDED_COLOUR, INK_COLOUR, FAINT_COLOUR = "#1f5fa8", "#333333", "#d4d4d4"
FIGURE_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": 10,
    "axes.labelsize": 8.5,
    "axes.edgecolor": INK_COLOUR,
    "axes.labelcolor": INK_COLOUR,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": FAINT_COLOUR,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.4,
    "text.color": INK_COLOUR,
    "xtick.color": INK_COLOUR,
    "ytick.color": INK_COLOUR,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.hashsalt": "crane",
}
# Distances of words from the axes of a box [points], of which matplotlib adds the last by itself.
TICK_OFFSET, LABEL_OFFSET, PAD_OFFSET = 8.0, 14.0, 8.0
_FLATNESS_TOLERANCE = 0.01  # distance from a plane, as a share of the size of a path
MAX_COLUMNS = 5  # joints beside each other
_LETTER_WIDTH, _LEGEND_ENTRY_WIDTH = 0.11, 1.0  # [in] of a title, and of an entry of a legend
# Least height of an axis [SI], so that rounding noise of a joint at rest looks like rest.
MIN_AXIS_SPAN = {
    "rad": 3e-3, "m": 2e-4, "rad/s": 3e-3, "m/s": 2e-4, "N m": 0.02, "N": 0.2, "Pa": 1e4,
    "m3/s": 1e-7, "V": 0.01,
}  # fmt: skip
# rows of a hydraulic machine: quantity, unit, channel of a joint by label
HYDRAULIC_ROWS = (
    ("pressure", "Pa", {"A": "pressure_{}_a", "B": "pressure_{}_b", "supply": "pressure_supply"}),
    ("flow", "m3/s", {"A": "flow_{}_a", "B": "flow_{}_b"}),
    ("signal", "V", {"recording": "voltage_{}", "B": "voltage_{}_b"}),
)
LINE_STYLES: Mapping[str, Any] = {
    "recording": {"color": RECORDED_COLOUR},
    "A": {"color": RECORDED_COLOUR},
    "B": {"color": "#2a8c4a"},
    "supply": {"color": "#a8a8a8", "linewidth": 1.0},
    "reference": DASHED_STYLE,
}


@dataclass(frozen=True, eq=False)
class _TimePanel:
    """One quantity of one joint over time: lines (N,) by label, in SI units.

    With a reference, the lines are errors, which are computed while they are drawn, because long
    recordings exceed the memory.
    """

    quantity: str
    unit: str
    lines: dict[str, Array]
    reference: Array | None = None

    def drawn_lines(self) -> Iterator[tuple[str, Array]]:
        """Yield each line with its values (N,)."""
        for label, values in self.lines.items():
            release_pages()
            yield label, values if self.reference is None else self.reference - values


def write_figure(path: str | Path, draw: Callable[[], Figure]) -> None:
    """Draw a figure and write it to a file.

    Args:
        path: File to write; the suffix .png, .svg or .pdf determines the format.
        draw: Function that draws the figure.

    Raises:
        OutputError: The suffix is another one, or the file cannot be written.
    """
    path = Path(path)
    file_format = path.suffix.lower().removeprefix(".")
    if file_format not in FIGURE_FORMATS:
        raise OutputError(f"{path}: unknown kind of picture, end the name in .png, .svg or .pdf")
    figure = draw()
    with mpl.rc_context(FIGURE_STYLE), replace_file(path) as part:
        figure.savefig(part, format=file_format, dpi=200, metadata=FIGURE_FORMATS[file_format])


def add_heading(figure: Figure, text: str) -> None:
    """Add a bold heading at the upper left."""
    figure.suptitle(text, x=0.01, ha="left", fontsize=11, fontweight="bold")


@mpl.rc_context(FIGURE_STYLE)
def recording_figure(recording: Recording) -> Figure:
    """Return the figure of a recording.

    There is one column per active joint with displacement, velocity and force over time; for
    cylinders with valves also pressures, flows and signals. Many joints are drawn in several
    bands. With the channels tip_x, tip_y, tip_z, the path of the tip is drawn in space, or in a
    plane if one coordinate hardly changes. References (channels reference_<joint>,
    reference_velocity_<joint>, reference_tip_x, ...) are dashed; errors (reference minus
    displacement) have a separate row, and the tip its distance from the reference.
    """
    tip, joints = point_channel(recording, "tip"), recording.joints
    path_plane = (
        None if tip is None else _path_plane(tip, point_channel(recording, "reference_tip"))
    )
    panels_by_joint = [_joint_panels(recording, index) for index in range(len(joints))]
    used_rows = [
        i for i in range(len(panels_by_joint[0])) if any(x[i].lines for x in panels_by_joint)
    ]
    panels = [[column[row] for column in panels_by_joint] for row in used_rows]
    rows = len(used_rows)
    bands = -(-len(joints) // MAX_COLUMNS)
    columns = -(-len(joints) // bands)
    is_spatial = tip is not None and path_plane is None
    widths = [1.0] * columns + [1.6 if is_spatial else 1.0] * (tip is not None)
    width = 2.4 * sum(widths) + 0.3
    margin = 0.3 if is_spatial else 0.0  # the layout overlooks the label of the z axis
    layout = ConstrainedLayoutEngine(rect=(0.0, 0.0, 1.0 - margin / width, 1.0))
    figure = Figure(figsize=(width, 2.0 * rows * bands), layout=layout)
    grid = figure.add_gridspec(rows * bands, len(widths), width_ratios=widths)
    letters = iter(ascii_lowercase)
    for band, row in itertools.product(range(bands), range(rows)):
        joints_in_band = range(band * columns, min((band + 1) * columns, len(joints)))
        grid_cells = {i: grid[rows * band + row, i - joints_in_band.start] for i in joints_in_band}
        _draw_row(figure, grid_cells, recording, panels, row, letters)
    if tip is not None:
        _draw_tip_path(figure, grid, recording, tip, path_plane, letters)
    _add_caption(figure, recording)
    return figure


def _joint_panels(recording: Recording, column: int) -> list[_TimePanel]:
    """Return the panels of an active joint and its cylinder; some without lines."""
    name, channels = recording.joints[column], recording.channels
    unit = recording.units[name]
    is_revolute, reference_name = unit == "rad", f"reference_{name}"

    def lines(values: Array, reference: str = "") -> dict[str, Array]:
        reference_lines = {"reference": channels[reference]} if reference in channels else {}
        return {"recording": values[:, column], **reference_lines}

    panels = [
        _TimePanel(
            "angle" if is_revolute else "displacement", unit, lines(recording.q, reference_name)
        ),
        _TimePanel("velocity", f"{unit}/s", lines(recording.v, f"reference_velocity_{name}")),
        _TimePanel(
            "torque" if is_revolute else "force",
            FORCE_UNITS[unit],
            {} if name in recording.free else lines(recording.tau),
        ),
    ]
    if reference_name in channels:
        panels.append(_TimePanel("error", unit, lines(recording.q), channels[reference_name]))
    else:
        panels.append(_TimePanel("error", unit, {}))
    for quantity, row_unit, channel_templates in HYDRAULIC_ROWS:
        joint_labels = [
            label
            for label, channel in channel_templates.items()
            if channel.format(name) != channel
        ]
        available_lines = {
            label: channels[channel]
            for label, channel in (
                (label, text.format(name)) for label, text in channel_templates.items()
            )
            if recording.channel_units.get(channel) == row_unit
        }
        panels.append(
            _TimePanel(
                quantity,
                row_unit,
                available_lines if any(x in available_lines for x in joint_labels) else {},
            )
        )
    return panels


def _row_scales(panels: Sequence[_TimePanel]) -> dict[str, tuple[str, float]]:
    """Return display unit and scale by unit, the same for all panels of a row."""
    peaks: dict[str, float] = {}
    for panel in panels:
        for _, values in panel.drawn_lines():
            peaks[panel.unit] = max(peaks.get(panel.unit, 0.0), float(np.abs(values).max()))
    return {unit: display_unit(unit, peak) for unit, peak in peaks.items()}


def _draw_panel(axes: Axes, time: Array, panel: _TimePanel, unit: str, scale: float) -> None:
    marker = "o" if len(time) == 1 else None
    for label, values in panel.drawn_lines():
        axes.plot(
            *envelope(time, scale * values), marker=marker, label=label, **LINE_STYLES[label]
        )
    axes.set_ylabel(f"{panel.quantity} [{unit}]")
    axes.margins(x=0.0, y=0.08)
    lower, upper = axes.get_ylim()
    if (missing_span := scale * MIN_AXIS_SPAN[panel.unit] - (upper - lower)) > 0:
        axes.set_ylim(lower - missing_span / 2, upper + missing_span / 2)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))


def _draw_row(
    figure: Figure,
    grid_cells: Mapping[int, SubplotSpec],
    recording: Recording,
    panels: Sequence[Sequence[_TimePanel]],
    row: int,
    letters: Iterator[str],
) -> None:
    """Draw a row of panels of some joints; `panels` has all panels by row."""
    scales = _row_scales(panels[row])
    for index, grid_cell in grid_cells.items():
        panel = panels[row][index]
        if not panel.lines:
            continue
        axes = figure.add_subplot(grid_cell)
        _draw_panel(axes, recording.time, panel, *scales[panel.unit])
        _add_panel_letter(axes, letters)
        if row == 0:
            axes.set_title(joint_symbol(recording.joints[index]))
        if not any(lower_row[index].lines for lower_row in panels[row + 1 :]):
            axes.set_xlabel("time [s]")
        else:
            axes.tick_params(labelbottom=False)


def _draw_tip_path(
    figure: Figure, grid: GridSpec, recording: Recording, tip: Array,
    path_plane: tuple[int, int] | None, letters: Iterator[str],
) -> None:  # fmt: skip
    """Draw the path of the tip and its distance from a reference, in the last column."""
    reference, distance = point_channel(recording, "reference_tip"), tip_error(recording)
    grid_rows = slice(3) if reference is None else slice(2)
    if path_plane is None:
        space_axes = figure.add_subplot(grid[grid_rows, -1], projection="3d")
        _draw_space_path(space_axes, tip, reference)
        _add_panel_letter(space_axes, letters)
    else:
        plane_axes = figure.add_subplot(grid[grid_rows, -1])
        _draw_plane_path(plane_axes, tip, reference, path_plane)
        _add_panel_letter(plane_axes, letters)
    if distance is None:
        return
    axes = figure.add_subplot(grid[2, -1])
    panel = _TimePanel("tip to reference", "m", {"recording": distance})
    _draw_panel(axes, recording.time, panel, "mm", 1e3)
    _add_panel_letter(axes, letters)
    axes.set_xlabel("time [s]")


def _path_plane(tip: Array, reference: Array | None) -> tuple[int, int] | None:
    """Return the two coordinates of the plane of a path, to 1 % of its size; None if not plane.

    For a straight path the plane of x and z is preferred, then that of y and z.
    """
    lower, upper = _path_bounds(tip, reference)
    is_flat = upper - lower <= _FLATNESS_TOLERANCE * (upper - lower).max()
    planes = (((0, 2), 1), ((1, 2), 0), ((0, 1), 2))
    return next((plane for plane, normal_axis in planes if is_flat[normal_axis]), None)


def _path_bounds(tip: Array, reference: Array | None) -> tuple[Array, Array]:
    """Return the lower and upper corner (3,) of a path and its reference [m]."""
    paths = [tip] if reference is None else [tip, reference]
    lower, upper = zip(*((x.min(axis=0), x.max(axis=0)) for x in paths), strict=True)
    return np.min(lower, axis=0), np.max(upper, axis=0)


def _drawing_box(tip: Array, reference: Array | None) -> tuple[Array, Array]:
    """Return the corners (3,) of a box around a path that is not flat [m]."""
    lower, upper = _path_bounds(tip, reference)
    span = np.maximum(upper - lower, 0.4 * max(float((upper - lower).max()), 1e-2)) * 1.1
    return (lower + upper - span) / 2, (lower + upper + span) / 2


def _draw_plane_path(
    axes: Axes, tip: Array, reference: Array | None, plane: tuple[int, int]
) -> None:
    """Draw the path of the tip [m] in a plane, to scale."""
    i, j = plane
    x, y = thin_path(tip)[:, plane].T
    axes.plot(x, y, color=RECORDED_COLOUR, label="recording")
    if reference is not None:
        axes.plot(*thin_path(reference)[:, plane].T, label="reference", **DASHED_STYLE)
    end_markers = ((0, "start", "white"), (-1, "end", RECORDED_COLOUR))
    for end_index, name, face_colour in end_markers:
        end_point = x[end_index], y[end_index]
        axes.plot(
            *end_point, "o", color=RECORDED_COLOUR, markerfacecolor=face_colour, ms=5, label=name
        )
        axes.annotate(name, end_point, (5, 4), textcoords="offset points", fontsize=7.5)
    axes.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]", title="path of the tip")
    lower, upper = _drawing_box(tip, reference)
    axes.set(xlim=(lower[i], upper[i]), ylim=(lower[j], upper[j]), aspect="equal", anchor="N")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))


def _draw_space_path(axes: Axes3D, tip: Array, reference: Array | None) -> None:
    """Draw the path of the tip [m] in space, to scale, with its shadow."""
    tip, reference = thin_path(tip), None if reference is None else thin_path(reference)
    lower, upper = _drawing_box(tip, reference)
    span = upper - lower
    x, y, z = tip.T
    axes.plot(x, y, np.full_like(z, lower[2]), color="#a8a8a8", linewidth=1.0, label="shadow")
    axes.plot(x, y, z, color=RECORDED_COLOUR, label="recording")
    if reference is not None:
        axes.plot(*reference.T, label="reference", **DASHED_STYLE)
    for end_point, name, face_colour in (
        (tip[0], "start", "white"),
        (tip[-1], "end", RECORDED_COLOUR),
    ):
        axes.plot(
            *end_point[:, None],
            "o",
            color=RECORDED_COLOUR,
            markerfacecolor=face_colour,
            ms=5,
            label=name,
        )
        axes.text(*end_point, f" {name}", fontsize=7.5, va="bottom")
    axes.set(
        xlim=(lower[0], upper[0]),
        ylim=(lower[1], upper[1]),
        zlim=(lower[2], upper[2]),
        xlabel="x [m]",
        ylabel="y [m]",
        zlabel="z [m]",
        title="path of the tip",
    )
    axes.set_box_aspect(span, zoom=0.88)
    axes.view_init(elev=24, azim=-60)
    for i, axis in enumerate((axes.xaxis, axes.yaxis, axes.zaxis)):
        axis.set_major_locator(
            FixedLocator(_inner_ticks(lower[i], upper[i], span[i] / span.max()))
        )
        axis.set_pane_color("#fafafa")
        # matplotlib moves words away from an axis in proportion to the widths across it
        cross_width = float(np.delete(span, i).max() / span.max())
        axis.set_tick_params(pad=TICK_OFFSET / cross_width - PAD_OFFSET)
        axis.labelpad = LABEL_OFFSET / cross_width - PAD_OFFSET


def _inner_ticks(lower: float, upper: float, axis_share: float) -> list[float]:
    """Return round values away from the ends of an axis; few on a short axis."""
    margin = 0.12 * (upper - lower)
    lower, upper = lower + margin, upper - margin
    min_count, max_count = (2, 3) if axis_share > 0.5 else (1, 2)
    inner_values: list[float] = []
    for count in range(1, 9):  # how many fit between round values depends on where they lie
        values = MaxNLocator(count, steps=[1, 2, 5, 10]).tick_values(lower, upper)
        inner_values = [
            float(value) for value in values if lower <= value <= upper
        ] or inner_values
        if len(inner_values) >= min_count:
            break
    return inner_values[:: -(-len(inner_values) // max_count)]


def _add_panel_letter(axes: Axes, letters: Iterator[str]) -> None:
    """Label a panel (a), (b), ... for references in a text."""
    if letter := next(letters, ""):
        axes.annotate(f"({letter})", (0, 1), (-28, 7), "axes fraction", "offset points")


def _add_caption(figure: Figure, recording: Recording) -> None:
    """Add heading and legend."""
    heading_text = heading(recording)
    if heading_text:
        add_heading(figure, escape_label(heading_text))
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    if legend_lines := [
        lines[label] for label in LINE_STYLES if label in lines and label != "recording"
    ]:
        fits_beside = (
            _LETTER_WIDTH * len(heading_text) + _LEGEND_ENTRY_WIDTH * (1 + len(legend_lines))
            < figure.get_figwidth()
        )
        figure.legend(
            handles=[lines["recording"], *legend_lines],
            loc="outside upper right" if fits_beside else "outside lower center",
            ncols=1 + len(legend_lines),
        )


def joint_symbol(name: str) -> str:
    """Return a joint's name as a label; q1 is set as q with index 1."""
    if match := re.fullmatch(r"([A-Za-z])(\d+)", name):
        return f"${match[1]}_{{{match[2]}}}$"
    return escape_label(name)
