"""Figures of recordings: coordinates, forces and path of the tip over time."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, MaxNLocator

from crane.common.samples import Array
from crane.common.scratch_arrays import release_pages
from crane.common.units import display_unit
from crane.recordings.recording import FORCE_UNITS, Recording
from crane.recordings.recording_summary import heading, point_channel, tip_error
from crane.view.plots.figure_style import (
    DASHED_STYLE,
    RECORDED_COLOUR,
    add_heading,
    envelope,
    escape_label,
    figure_style,
    joint_symbol,
    set_round_ticks,
    thin_path,
)

# Distances of words from the axes of a box [points], of which matplotlib adds the last by itself.
TICK_OFFSET, LABEL_OFFSET, PAD_OFFSET = 8.0, 14.0, 8.0
_FLATNESS_TOLERANCE = 0.01  # distance from a plane, as a share of the size of a path
_PLANES = (((0, 2), 1), ((1, 2), 0), ((0, 1), 2))  # coordinates and normal, in order of preference
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


@figure_style
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
    panels = [
        row
        for row in zip(
            *[_joint_panels(recording, index) for index in range(len(joints))], strict=True
        )
        if any(x.lines for x in row)
    ]
    rows, bands = len(panels), -(-len(joints) // MAX_COLUMNS)
    columns = -(-len(joints) // bands)
    widths = [1.0] * columns
    margin = 0.0
    if tip is not None:
        reference = point_channel(recording, "reference_tip")
        paths = [tip] if reference is None else [tip, reference]
        lower = np.min([x.min(axis=0) for x in paths], axis=0)
        bounds = np.array([lower, np.max([x.max(axis=0) for x in paths], axis=0)])
        is_flat = np.ptp(bounds, axis=0) <= _FLATNESS_TOLERANCE * np.ptp(bounds, axis=0).max()
        plane = next((plane for plane, normal_axis in _PLANES if is_flat[normal_axis]), None)
        widths.append(1.0 if plane else 1.6)
        margin = 0.0 if plane else 0.3  # the layout overlooks the label of the z axis
    width = 2.4 * sum(widths) + 0.3
    figure = Figure(
        figsize=(width, 2.0 * rows * bands),
        layout=ConstrainedLayoutEngine(rect=(0.0, 0.0, 1.0 - margin / width, 1.0)),
    )
    grid = figure.add_gridspec(rows * bands, len(widths), width_ratios=widths)
    letters = iter(ascii_lowercase)
    for band, row in itertools.product(range(bands), range(rows)):
        joints_in_band = range(band * columns, min((band + 1) * columns, len(joints)))
        grid_cells = {i: grid[rows * band + row, i - joints_in_band.start] for i in joints_in_band}
        _draw_row(figure, grid_cells, recording, panels, row, letters)
    if tip is not None:
        axes = figure.add_subplot(
            grid[: 3 if reference is None else 2, -1], projection=None if plane else "3d"
        )
        _draw_path(axes, [thin_path(x) for x in paths], bounds, plane)
        _add_panel_letter(axes, letters)
        if (distance := tip_error(recording)) is not None:
            axes = figure.add_subplot(grid[2, -1])
            _draw_panel(
                axes,
                recording.time,
                _TimePanel("tip to reference", "m", {"recording": distance}),
                "mm",
                1e3,
            )
            _add_panel_letter(axes, letters)
            axes.set_xlabel("time [s]")
    _add_caption(figure, heading(recording))
    return figure


def _joint_panels(recording: Recording, column: int) -> list[_TimePanel]:
    """Return the panels of an active joint and its cylinder; some without lines."""
    name, channels = recording.joints[column], recording.channels
    unit, reference_name = recording.units[name], f"reference_{name}"
    displacement, force = ("angle", "torque") if unit == "rad" else ("displacement", "force")

    def lines(values: Array, reference: str = "") -> dict[str, Array]:
        reference_lines = {"reference": channels[reference]} if reference in channels else {}
        return {"recording": values[:, column], **reference_lines}

    force_lines = {} if name in recording.free else lines(recording.tau)
    error_lines = lines(recording.q) if reference_name in channels else {}
    panels = [
        _TimePanel(displacement, unit, lines(recording.q, reference_name)),
        _TimePanel("velocity", f"{unit}/s", lines(recording.v, f"reference_velocity_{name}")),
        _TimePanel(force, FORCE_UNITS[unit], force_lines),
        _TimePanel("error", unit, error_lines, channels.get(reference_name)),
    ]
    for quantity, row_unit, templates in HYDRAULIC_ROWS:
        names = {label: text.format(name) for label, text in templates.items()}
        available = [x for x in names if recording.channel_units.get(names[x]) == row_unit]
        if all(names[x] == templates[x] for x in available):
            available = []  # nothing of this joint
        panels.append(_TimePanel(quantity, row_unit, {x: channels[names[x]] for x in available}))
    return panels


def _draw_panel(axes: Axes, time: Array, panel: _TimePanel, unit: str, scale: float) -> None:
    for label, values in panel.drawn_lines():
        axes.plot(
            *envelope(time, scale * values),
            marker="o" if len(time) == 1 else None,
            label=label,
            **LINE_STYLES[label],
        )
    axes.set_ylabel(f"{panel.quantity} [{unit}]")
    axes.margins(x=0.0, y=0.08)
    lower, upper = axes.get_ylim()
    if (missing_span := scale * MIN_AXIS_SPAN[panel.unit] - (upper - lower)) > 0:
        axes.set_ylim(lower - missing_span / 2, upper + missing_span / 2)
    set_round_ticks(axes, 5)


def _draw_row(
    figure: Figure,
    grid_cells: Mapping[int, SubplotSpec],
    recording: Recording,
    panels: Sequence[Sequence[_TimePanel]],
    row: int,
    letters: Iterator[str],
) -> None:
    """Draw a row of panels of some joints; `panels` has all panels by row.

    Display units are the same for all panels of the row.
    """
    peaks: dict[str, float] = {}
    for panel in panels[row]:
        for _, values in panel.drawn_lines():
            peaks[panel.unit] = max(peaks.get(panel.unit, 0.0), float(np.abs(values).max()))
    for index, grid_cell in grid_cells.items():
        panel = panels[row][index]
        if not panel.lines:
            continue
        axes = figure.add_subplot(grid_cell)
        _draw_panel(axes, recording.time, panel, *display_unit(panel.unit, peaks[panel.unit]))
        _add_panel_letter(axes, letters)
        if row == 0:
            axes.set_title(joint_symbol(recording.joints[index]))
        if not any(lower_row[index].lines for lower_row in panels[row + 1 :]):
            axes.set_xlabel("time [s]")
        else:
            axes.tick_params(labelbottom=False)


def _draw_path(
    axes: Any, paths: Sequence[Array], bounds: Array, plane: tuple[int, int] | None
) -> None:
    """Draw the path of the tip [m] and its reference to scale, in a plane or in space.

    Args:
        axes: Axes of the plane, or three-dimensional axes.
        paths: (N, 3) path of the tip, and its reference if there is one.
        bounds: (2, 3) lower and upper corner of the paths.
        plane: The two coordinates of the plane, to 1 % of its size; None for a path in space. For
            a straight path the plane of x and z is preferred, then that of y and z.
    """
    span = np.ptp(bounds, axis=0)
    span = np.maximum(span, 0.4 * max(float(span.max()), 1e-2)) * 1.1
    lower, upper = (bounds.sum(axis=0) - span) / 2, (bounds.sum(axis=0) + span) / 2
    coordinates = list(plane or range(3))
    points = paths[0][:, coordinates]
    if plane is None:
        axes.plot(
            *(*points.T[:2], np.full(len(points), lower[2])),
            color="#a8a8a8",
            linewidth=1.0,
            label="shadow",
        )
    axes.plot(*points.T, color=RECORDED_COLOUR, label="recording")
    for reference in paths[1:]:
        axes.plot(*reference[:, coordinates].T, label="reference", **DASHED_STYLE)
    for end, name, face_colour in ((0, "start", "white"), (-1, "end", RECORDED_COLOUR)):
        style = {"color": RECORDED_COLOUR, "markerfacecolor": face_colour, "ms": 5}
        axes.plot(*points[end][:, None], "o", label=name, **style)
        if plane is None:
            axes.text(*points[end], f" {name}", fontsize=7.5, va="bottom")
        else:
            axes.annotate(name, points[end], (5, 4), textcoords="offset points", fontsize=7.5)
    axes.set(title="path of the tip")
    for i, axis in zip(coordinates, "xyz", strict=False):
        axes.set(**{f"{axis}lim": (lower[i], upper[i]), f"{axis}label": f"{'xyz'[i]} [m]"})
    if plane is not None:
        axes.set(aspect="equal", anchor="N")
        set_round_ticks(axes, 4)
        return
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


def _add_caption(figure: Figure, heading_text: str) -> None:
    """Add heading and legend."""
    if heading_text:
        add_heading(figure, escape_label(heading_text))
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    if legend_lines := [
        lines[label] for label in LINE_STYLES if label in lines and label != "recording"
    ]:
        figure.legend(
            handles=[lines["recording"], *legend_lines],
            loc="outside upper right"
            if (
                _LETTER_WIDTH * len(heading_text) + _LEGEND_ENTRY_WIDTH * (1 + len(legend_lines))
                < figure.get_figwidth()
            )
            else "outside lower center",
            ncols=1 + len(legend_lines),
        )
