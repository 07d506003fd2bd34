"""The sheet that a mechanism is drawn on: equal axes in metres, heading and legend."""

import re
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from crane.common.samples import Array
from crane.machine import Machine
from crane.recordings.recording_summary import DISPLAY_UNITS
from crane.view.plots.figure_text import escape_label
from crane.view.sketch.drawing_plane import DrawingPlane
from crane.view.sketch.sketch_canvas import SketchCanvas
from crane.view.sketch.sketch_elements import SketchMechanism

_MAX_WIDTH, _MAX_HEIGHT, _MIN_WIDTH = 454.0, 353.0, 331.0  # of the axes [points]
_MARGIN = 36.0  # around the mechanism [points]
_LEFT_MARGIN, _RIGHT_MARGIN, _BOTTOM_MARGIN = 46.0, 12.0, 38.0  # around the axes [points]
_LINE_HEIGHT = 12.5  # height of a line of words [points]


def format_joint_symbol(name: str) -> str:
    """A joint's name as it is set: q1 as q with index 1, X_lift as X with index lift."""
    if match := re.fullmatch(r"([A-Za-z])(\d+|_[A-Za-z]+)", name):
        return f"${match[1]}_{{\\mathrm{{{match[2].removeprefix('_')}}}}}$"
    return escape_label(name)


def create_sketch_layout(
    mechanism: SketchMechanism,
    plane: DrawingPlane,
    machine: Machine,
    q: Array,
    legend: Sequence[tuple[Line2D, ...]],
    other_mechanisms: Sequence[SketchMechanism] = (),
) -> tuple[Figure, SketchCanvas]:
    """A figure with axes for the mechanism, and what draws on them.

    Args:
        mechanism: What is to fit.
        plane: Names its coordinates.
        machine: Named in the heading, with its active coordinates.
        q: (nq,) posture.
        legend: Its entries, each of lines that are drawn on top of each other.
        other_mechanisms: What is to fit, too.
    """
    corners = np.array([_mechanism_bounds(fitted) for fitted in (mechanism, *other_mechanisms)])
    lower, upper = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    span = np.maximum(upper - lower, 0.05 * mechanism.size)
    available = np.array([_MAX_WIDTH, _MAX_HEIGHT]) - 2 * _MARGIN
    point_size = float((span / available).max())  # [m]
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
    axes.set(xlim=(centre[0] - x, centre[0] + x), ylim=(centre[1] - y, centre[1] + y))
    axes.set(xlabel=f"{plane.labels[0]} [m]", ylabel=f"{plane.labels[1]} [m]", aspect="equal")
    axes.grid(visible=False)
    for axis, length in ((axes.xaxis, axes_width), (axes.yaxis, axes_height)):
        axis.set_major_locator(MaxNLocator(max(int(length / 55), 2), steps=[1, 2, 5, 10]))
    left = 12 / width
    name = escape_label(machine.name.replace("_", " "))
    figure.text(left, 1 - 8 / height, name, va="top", fontsize=11, fontweight="bold")
    for row, line in enumerate(coordinate_lines):
        line_y = 1 - (23 + _LINE_HEIGHT * row) / height
        figure.text(left, line_y, line, va="top", fontsize=8, color="#555555")
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
    """Lowest and highest corner (2,) of all points [m]."""
    points = [drawn_pin.position for drawn_pin in mechanism.pins] + [
        item.position for item in mechanism.collars
    ]
    points += [end for x in mechanism.slides for end in (x.start, x.mouth, x.rod_outer_end)]
    points += [corner for body in mechanism.bodies for corner in body.points]
    points += [position for position, _ in mechanism.ground]
    return np.min(points, axis=0), np.max(points, axis=0)


def _coordinate_lines(machine: Machine, q: Array, line_length: int) -> list[str]:
    """The active coordinates in lines of no more than so many letters."""
    lines: list[str] = []
    length = line_length
    for joint, value in zip(machine.active, q[machine.closure.active], strict=True):
        unit, scale = DISPLAY_UNITS[machine.unit(joint)]
        number = f"{scale * value:.1f}".removesuffix(".0").replace("-", "\u2212")
        number = "0" if number == "\u22120" else number
        coordinate_text = (
            f"{format_joint_symbol(joint)} = "
            f"{number}{'°' if unit == 'deg' else chr(0x2009) + unit}"
        )
        text_length = len(joint) + len(number) + 8
        if length + text_length > line_length:
            lines.append(coordinate_text)
            length = text_length
        else:
            lines[-1] += f",   {coordinate_text}"
            length += text_length
    return lines
