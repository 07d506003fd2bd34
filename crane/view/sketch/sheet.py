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
from crane.recordings.summary import READING_UNITS
from crane.view.plots.text import plain
from crane.view.sketch.canvas import Canvas
from crane.view.sketch.parts import Mechanism
from crane.view.sketch.plane import Plane

_WIDEST, _TALLEST, _LEAST = 454.0, 353.0, 331.0  # of the axes [points]
_MARGIN = 36.0  # around the mechanism [points]
_LEFT, _RIGHT, _BELOW = 46.0, 12.0, 38.0  # around the axes [points]
_LINE = 12.5  # height of a line of words [points]


def symbol(name: str) -> str:
    """A joint's name as it is set: q1 as q with index 1, X_lift as X with index lift."""
    if match := re.fullmatch(r"([A-Za-z])(\d+|_[A-Za-z]+)", name):
        return f"${match[1]}_{{\\mathrm{{{match[2].removeprefix('_')}}}}}$"
    return plain(name)


def lay_out(
    mechanism: Mechanism,
    plane: Plane,
    machine: Machine,
    q: Array,
    legend: Sequence[tuple[Line2D, ...]],
    beside: Sequence[Mechanism] = (),
) -> tuple[Figure, Canvas]:
    """A figure with axes for the mechanism, and what draws on them.

    Args:
        mechanism: What is to fit.
        plane: Names its coordinates.
        machine: Named in the heading, with its active coordinates.
        q: (nq,) posture.
        legend: Its entries, each of lines that are drawn on top of each other.
        beside: What is to fit, too.
    """
    corners = np.array([_bounds(one) for one in (mechanism, *beside)])
    low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    span = np.maximum(high - low, 0.05 * mechanism.size)
    room = np.array([_WIDEST, _TALLEST]) - 2 * _MARGIN
    point = float((span / room).max())  # [m]
    wide, tall = np.maximum(span / point + 2 * _MARGIN, [_LEAST, 0.0])
    posture = _posture(machine, q, int((wide + _LEFT) / 5.2))
    columns = max(int((wide + _LEFT) / 92), 1)
    head = 30.0 + _LINE * (len(posture) + -(-len(legend) // columns))
    width, height = wide + _LEFT + _RIGHT, tall + _BELOW + head
    figure = Figure(figsize=(width / 72, height / 72))
    axes = figure.add_axes((_LEFT / width, _BELOW / height, wide / width, tall / height))
    (x, y), middle = np.array([wide, tall]) / 2 * point, (low + high) / 2
    axes.set(xlim=(middle[0] - x, middle[0] + x), ylim=(middle[1] - y, middle[1] + y))
    axes.set(xlabel=f"{plane.labels[0]} [m]", ylabel=f"{plane.labels[1]} [m]", aspect="equal")
    axes.grid(visible=False)
    for axis, length in ((axes.xaxis, wide), (axes.yaxis, tall)):
        axis.set_major_locator(MaxNLocator(max(int(length / 55), 2), steps=[1, 2, 5, 10]))
    left = 12 / width
    name = plain(machine.name.replace("_", " "))
    figure.text(left, 1 - 8 / height, name, va="top", fontsize=11, fontweight="bold")
    for row, line in enumerate(posture):
        below = 1 - (23 + _LINE * row) / height
        figure.text(left, below, line, va="top", fontsize=8, color="#555555")
    figure.legend(
        handles=list(legend),
        labels=[str(entry[0].get_label()) for entry in legend],
        handler_map={tuple: HandlerTuple(ndivide=1, pad=0.0)},
        loc="upper left",
        bbox_to_anchor=(left, 1 - (25 + _LINE * len(posture)) / height),
        ncols=columns,
        fontsize=8,
        borderaxespad=0.0,
        borderpad=0.0,
        handlelength=1.6,
        columnspacing=1.4,
    )
    return figure, Canvas(axes, point)


def _bounds(mechanism: Mechanism) -> tuple[Array, Array]:
    """Lowest and highest corner (2,) of all points [m]."""
    points = [shown.at for shown in mechanism.pins] + [item.at for item in mechanism.collars]
    points += [end for x in mechanism.slides for end in (x.start, x.mouth, x.end)]
    points += [corner for body in mechanism.bodies for corner in body.points]
    points += [at for at, _ in mechanism.ground]
    return np.min(points, axis=0), np.max(points, axis=0)


def _posture(machine: Machine, q: Array, room: int) -> list[str]:
    """The active coordinates in lines of no more than so many letters."""
    lines: list[str] = []
    length = room
    for joint, value in zip(machine.active, q[machine.closure.active], strict=True):
        unit, scale = READING_UNITS[machine.unit(joint)]
        number = f"{scale * value:.1f}".removesuffix(".0").replace("-", "\u2212")
        number = "0" if number == "\u22120" else number
        word = f"{symbol(joint)} = {number}{'°' if unit == 'deg' else chr(0x2009) + unit}"
        used = len(joint) + len(number) + 8
        if length + used > room:
            lines.append(word)
            length = used
        else:
            lines[-1] += f",   {word}"
            length += used
    return lines
