"""Canvas of a sketch: lines and symbols of kinematic diagrams, layout of the figure."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.path import Path
from matplotlib.patheffects import withTickedStroke
from matplotlib.ticker import MaxNLocator

from crane.common.samples import Array
from crane.machine.machine import Machine
from crane.recordings.recording_summary import DISPLAY_UNITS
from crane.view.plots.figure_style import INK_COLOUR, escape_label, joint_symbol
from crane.view.sketches.sketch_elements import DrawingPlane, SketchMechanism

GREY = "#8a8a8a"
JOINT_MARKER: Any = {"marker": "o", "markersize": 6.5, "markerfacecolor": "white"}
LOOP_MARKER: Any = {"marker": "o", "markersize": 10.0, "markerfacecolor": "white"}
DOT_MARKER: Any = {"marker": "o", "markersize": 4.6, "markeredgewidth": 0.0}
CENTRE_MARKER: Any = {"marker": "o", "markersize": 7.0, "markerfacecolor": "white"}
QUARTER_MARKERS: list[Any] = [
    {"marker": Path.wedge(start, start + 90), "markersize": 7.0, "markeredgewidth": 0.0}
    for start in (0, 180)
]
TIP_MARKER: Any = {"marker": "+", "markersize": 17.0, "markeredgewidth": 1.3}


class SketchCanvas:
    """Draws on axes in metres, with widths in points, and collects what labels must not cover.

    Args:
        axes: Axes of equal scales.
        point_size: Length of a printer's point in the coordinates of the axes [m].

    Attributes:
        occupied_segments: Lines (2, 2) [m] that labels keep away from.
        occupied_discs: Centres (2,) [m] and radii [points] of symbols that labels keep away from.
    """

    def __init__(self, axes: Axes, point_size: float):
        self.axes, self.point_size = axes, point_size
        self.occupied_segments: list[Array] = []
        self.occupied_discs: list[tuple[Array, float]] = []

    def draw_line(self, points: Array, colour: str, width: float, **options: Any) -> None:
        """Draw a line through points (k, 2) [m], its width in points."""
        options = {"solid_capstyle": "round", "solid_joinstyle": "round"} | options
        self.axes.plot(*points.T, color=colour, linewidth=width, **options)
        self.occupied_segments += list(np.stack([points[:-1], points[1:]], axis=1))

    def draw_box(
        self, start: Array, end: Array, width: float, colour: str, z_order: float
    ) -> None:
        """Draw a white rectangle about the line from start to end [m], its width in points."""
        axis = (end - start) / max(float(np.linalg.norm(end - start)), 1e-12)
        half_width = np.array([-axis[1], axis[0]]) * width / 2 * self.point_size
        corners = np.array(
            [start + half_width, end + half_width, end - half_width, start - half_width]
        )
        self.axes.add_patch(
            Polygon(
                corners,
                facecolor="white",
                edgecolor=colour,
                linewidth=1.3,
                joinstyle="round",
                zorder=z_order,
            )
        )
        self.occupied_segments += list(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))

    def draw_collar(self, name: str, position: Array, axis: Array) -> None:
        """Draw a revolute joint whose axis lies in the plane."""
        axis_point = axis * self.point_size
        self.draw_box(position - 7 * axis_point, position + 7 * axis_point, 11.0, INK_COLOUR, 4.5)
        self.draw_line(
            np.array([position - 20 * axis_point, position + 20 * axis_point]),
            INK_COLOUR,
            0.8,
            linestyle=(0, (8, 2, 1.5, 2)),
            zorder=5,
        )
        self.draw_marker(position, 4.0, f"joint {name}", DOT_MARKER | {"markersize": 0.1}, 7.0)

    def draw_ground(
        self, position: Array, down_direction: Array, ground_gap: float | None
    ) -> None:
        """Draw the ground: a support under a pin, or a hatched line below a point [points]."""
        lateral = np.array([-down_direction[1], down_direction[0]])
        gap = 11.0 if ground_gap is None else ground_gap
        ground_point = position + gap * self.point_size * down_direction
        if ground_gap is None:
            width = 7 * self.point_size * lateral
            support = np.array([position, ground_point - width, ground_point + width])
            self.axes.add_patch(
                Polygon(support, facecolor="white", edgecolor=INK_COLOUR, linewidth=1.2, zorder=2)
            )
            self.occupied_segments += [support[[0, 1]], support[[0, 2]]]
        half_length = 15 * self.point_size * lateral
        self.draw_hatching(ground_point - half_length, ground_point + half_length, down_direction)

    def draw_hatching(self, start: Array, end: Array, down_direction: Array) -> None:
        """Draw a line from start to end [m], hatched on the side of a unit vector."""
        (x, y), (down_x, down_y) = end - start, down_direction
        angle = -135 if x * down_y < y * down_x else 135
        hatching = withTickedStroke(spacing=5, angle=angle, length=1.4, linewidth=0.7)
        self.draw_line(np.array([start, end]), INK_COLOUR, 1.2, zorder=2, path_effects=[hatching])
        offset = 3 * self.point_size * down_direction
        self.occupied_segments.append(np.array([start + offset, end + offset]))
        self.occupied_segments.append(np.array([start + 2 * offset, end + 2 * offset]))

    def draw_number(self, number: int, position: Array) -> None:
        """Draw the number of a loop in its region."""
        self.axes.text(
            float(position[0]),
            float(position[1]),
            str(number),
            ha="center",
            va="center",
            fontsize=7,
            color="#555555",
            zorder=7,
            gid=f"number {number}",
            bbox={
                "boxstyle": "circle,pad=0.22", "facecolor": "white", "edgecolor": GREY,
                "linewidth": 0.6,
            },
        )  # fmt: skip
        self.occupied_discs.append((position, 7.5))

    def draw_marker(
        self,
        position: Array,
        z_order: float,
        gid: str,
        style: dict[str, Any],
        radius: float | None = None,
    ) -> None:
        """Draw a symbol; with a radius [points] labels keep away from it."""
        self.axes.plot(*position[:, None], zorder=z_order, gid=gid, **marker_options(style))
        if radius is not None:
            self.occupied_discs.append((position, radius))


def marker_options(style: dict[str, Any]) -> dict[str, Any]:
    """Return options of a line that shows only its marker."""
    return {
        "linestyle": "none",
        "color": INK_COLOUR,
        "markeredgecolor": INK_COLOUR,
        "markeredgewidth": 1.2,
    } | style


def convex_hull(points: Array) -> Array:
    """Return the corners (k, 2) of the convex hull of points (n, 2), counterclockwise.

    Those of points on a line are its ends.
    """
    from scipy.spatial import ConvexHull, QhullError  # slow to import

    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        direction = np.linalg.svd(points - points.mean(axis=0))[2][0]
        return points[np.argsort(points @ direction)[[0, -1]]]


_MAX_WIDTH, _MAX_HEIGHT, _MIN_WIDTH = 454.0, 353.0, 331.0  # of the axes [points]
_MARGIN = 36.0  # around the mechanism [points]
_LEFT_MARGIN, _RIGHT_MARGIN, _BOTTOM_MARGIN = 46.0, 12.0, 38.0  # around the axes [points]
_LINE_HEIGHT = 12.5  # height of a line of words [points]


def create_sketch_layout(
    mechanism: SketchMechanism,
    plane: DrawingPlane,
    machine: Machine,
    q: Array,
    legend: Sequence[tuple[Line2D, ...]],
    other_mechanisms: Sequence[SketchMechanism] = (),
) -> tuple[Figure, SketchCanvas]:
    """Return a figure with axes for the mechanism, and the canvas of the axes.

    Args:
        mechanism: Mechanism that has to fit.
        plane: Plane with the labels of its coordinates.
        machine: Machine for the heading.
        q: (nq,) configuration.
        legend: Entries of the legend, each of superposed lines.
        other_mechanisms: Further mechanisms that have to fit.
    """
    corners = np.array([_mechanism_bounds(fitted) for fitted in (mechanism, *other_mechanisms)])
    lower, upper = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    span = np.maximum(upper - lower, 0.05 * mechanism.size)
    point_size = float((span / (np.array([_MAX_WIDTH, _MAX_HEIGHT]) - 2 * _MARGIN)).max())  # [m]
    axes_width, axes_height = np.maximum(span / point_size + 2 * _MARGIN, [_MIN_WIDTH, 0.0])
    coordinate_lines = _coordinate_lines(machine, q, int((axes_width + _LEFT_MARGIN) / 5.2))
    columns = max(int((axes_width + _LEFT_MARGIN) / 92), 1)
    heading_height = 30.0 + _LINE_HEIGHT * (len(coordinate_lines) + -(-len(legend) // columns))
    width, height = (
        axes_width + _LEFT_MARGIN + _RIGHT_MARGIN,
        axes_height + _BOTTOM_MARGIN + heading_height,
    )
    figure = Figure(figsize=(width / 72, height / 72))
    axes = figure.add_axes(
        (_LEFT_MARGIN / width, _BOTTOM_MARGIN / height, axes_width / width, axes_height / height)
    )
    (x, y), centre = np.array([axes_width, axes_height]) / 2 * point_size, (lower + upper) / 2
    axes.set(
        xlim=(centre[0] - x, centre[0] + x),
        ylim=(centre[1] - y, centre[1] + y),
        xlabel=f"{plane.labels[0]} [m]",
        ylabel=f"{plane.labels[1]} [m]",
        aspect="equal",
    )
    axes.grid(visible=False)
    for axis, length in ((axes.xaxis, axes_width), (axes.yaxis, axes_height)):
        axis.set_major_locator(MaxNLocator(max(int(length / 55), 2), steps=[1, 2, 5, 10]))
    left = 12 / width
    figure.text(
        left,
        1 - 8 / height,
        escape_label(machine.name.replace("_", " ")),
        va="top",
        fontsize=11,
        fontweight="bold",
    )
    for row, line in enumerate(coordinate_lines):
        figure.text(
            left,
            1 - (23 + _LINE_HEIGHT * row) / height,
            line,
            va="top",
            fontsize=8,
            color="#555555",
        )
    figure.legend(
        handles=list(legend),
        labels=[str(entry[0].get_label()) for entry in legend],
        handler_map={tuple: HandlerTuple(ndivide=1, pad=0.0)},
        loc="upper left",
        bbox_to_anchor=(left, 1 - (25 + _LINE_HEIGHT * len(coordinate_lines)) / height),
        ncols=columns,
        fontsize=8,
        borderaxespad=0.0,
        borderpad=0.0,
        handlelength=1.6,
        columnspacing=1.4,
    )
    return figure, SketchCanvas(axes, point_size)


def _mechanism_bounds(mechanism: SketchMechanism) -> tuple[Array, Array]:
    """Return the lower and upper corner (2,) of all points [m]."""
    points = [x.position for x in mechanism.pins] + [x.position for x in mechanism.collars]
    points += [end for x in mechanism.slides for end in (x.start, x.mouth, x.rod_outer_end)]
    points += [corner for body in mechanism.bodies for corner in body.points]
    points += [position for position, _ in mechanism.ground]
    return np.min(points, axis=0), np.max(points, axis=0)


def _coordinate_lines(machine: Machine, q: Array, line_length: int) -> list[str]:
    """Return the active coordinates as lines of limited length."""
    lines: list[list[str]] = []
    length = line_length
    for joint, value in zip(machine.active, q[machine.closure.active], strict=True):
        unit, scale = DISPLAY_UNITS[machine.unit(joint)]
        number = f"{scale * value:.1f}".removesuffix(".0").replace("-", "\u2212")
        number = "0" if number == "\u22120" else number
        text_length = len(joint) + len(number) + 8
        if length + text_length > line_length:
            lines.append([])
            length = 0
        length += text_length
        unit_text = "°" if unit == "deg" else f"\u2009{unit}"
        lines[-1].append(f"{joint_symbol(joint)} = {number}{unit_text}")
    return [",   ".join(texts) for texts in lines]
