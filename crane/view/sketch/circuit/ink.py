"""What a circuit is drawn with: wires that belong to nets, ports, lines, words, in points."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke
from matplotlib.textpath import TextPath

from crane.common.samples import Array
from crane.view.plots.recording import INK

Point = tuple[float, float]
_SAME = 1e-6  # [points]
_SIGNAL = (0, (3, 2))
SMALL, NAME, LEAST = 6.3, 8.0, 5.2  # sizes of words [points]


def _fitting(text: str, size: float, room: float, weight: str) -> tuple[str, float]:
    """A text and its size, so that it is no wider than its room."""
    font = FontProperties(family="DejaVu Sans", weight=weight)

    def width(text: str) -> float:
        return float(TextPath((0, 0), text, size=size, prop=font).get_extents().width)

    wide, least = width(text), min(LEAST / size, 1.0)
    if wide * least > room and not text.startswith("$"):
        end = len(text)
        while width(text[:end].rstrip("\\") + "…") * least > room and end > 1:
            end -= 1
        text = text[:end].rstrip("\\") + "…"
        wide = width(text)
    return text, size * min(room / wide, 1.0)


@dataclass(frozen=True)
class Pose:
    """Where a symbol stands, drawn about the origin with its flow upwards.

    Attributes:
        x: To the right [points].
        y: Upwards [points].
        turn: Quarter turns counterclockwise.
        flip: Whether left and right are changed before.
    """

    x: float
    y: float
    turn: int = 0
    flip: bool = False

    def __call__(self, *points: Point) -> list[Point]:
        """Points on the sheet."""
        out = []
        for x, y in points:
            x, y = (-x if self.flip else x), y
            for _ in range(self.turn % 4):
                x, y = -y, x
            out.append((self.x + x, self.y + y))
        return out

    def at(self, x: float, y: float) -> Point:
        """One point on the sheet."""
        return self((x, y))[0]


@dataclass(frozen=True)
class Wire:
    """A straight piece of a line.

    Attributes:
        net: What it belongs to; pieces of two nets are not joined, even where they cross.
        start: [points]
        end: [points]
    """

    net: str
    start: Point
    end: Point

    def holds(self, point: Point) -> bool:
        """Whether a point lies on it."""
        (a, b), (c, d), (x, y) = self.start, self.end, point
        beyond = min(a, c) - _SAME <= x <= max(a, c) + _SAME
        beyond = beyond and min(b, d) - _SAME <= y <= max(b, d) + _SAME
        return beyond and abs((c - a) * (y - b) - (d - b) * (x - a)) < _SAME * 100


@dataclass(frozen=True)
class Port:
    """Where a symbol is joined to a net.

    Attributes:
        part: The symbol's name.
        net: See `Wire`.
        at: [points]
    """

    part: str
    net: str
    at: Point


class Ink:
    """Draws onto axes whose coordinates are points.

    Args:
        axes: Axes of equal scales.

    Attributes:
        wires: All pieces of wires.
        ports: Of all symbols.
    """

    def __init__(self, axes: Axes):
        self.axes = axes
        self.wires: list[Wire] = []
        self.ports: list[Port] = []

    def wire(self, net: str, *points: Point, signal: bool = False) -> None:
        """A line of a net through points; of a signal it is dashed."""
        kept = [points[0]]
        kept += [b for a, b in zip(points, points[1:], strict=False) if a != b]
        if len(kept) < 2:
            return
        self.wires += [Wire(net, a, b) for a, b in zip(kept, kept[1:], strict=False)]
        look: dict[str, Any] = {"linewidth": 1.0}
        if signal:
            look = {"linewidth": 0.7, "linestyle": _SIGNAL}
        self.line(kept, zorder=2.0, gid=f"wire {net}", **look)

    def port(self, part: str, net: str, at: Point) -> None:
        """Note where a symbol is joined."""
        self.ports.append(Port(part, net, at))

    def line(self, points: Sequence[Point], **options: Any) -> None:
        """A line of a symbol."""
        look: dict[str, Any] = {
            "color": INK, "linewidth": 0.8, "zorder": 3.2, "solid_capstyle": "round",
            "solid_joinstyle": "round",
        } | options  # fmt: skip
        self.axes.plot(*np.array(points, dtype=float).T, **look)

    def shape(self, points: Sequence[Point], filled: bool = False, **options: Any) -> None:
        """A closed outline, white or filled."""
        look = {
            "facecolor": INK if filled else "white", "edgecolor": INK, "linewidth": 0.8,
            "zorder": 3.0, "joinstyle": "miter",
        } | options  # fmt: skip
        self.axes.add_patch(Polygon(np.array(points, dtype=float), closed=True, **look))

    def circle(self, at: Point, radius: float, **options: Any) -> None:
        """A circle, white unless told otherwise."""
        look = {"facecolor": "white", "edgecolor": INK, "linewidth": 0.8, "zorder": 3.0} | options
        self.axes.add_patch(Circle(at, radius, **look))

    def arrow(self, start: Point, end: Point, *, size: float = 3.2, **options: Any) -> None:
        """A line with a filled head at its end."""
        one, other = np.array(start), np.array(end)
        along = (other - one) / float(np.linalg.norm(other - one))
        across = np.array([-along[1], along[0]])
        foot: Array = other - size * along
        self.line([start, (float(foot[0]), float(foot[1]))], solid_capstyle="butt", **options)
        head = [other, foot + 0.38 * size * across, foot - 0.38 * size * across]
        corners = [(float(x), float(y)) for x, y in head]
        self.shape(corners, filled=True, linewidth=0.0, zorder=3.3)

    def spring(self, start: Point, end: Point, *, half: float = 2.2) -> None:
        """A zigzag."""
        one, other = np.array(start), np.array(end)
        along = other - one
        across = np.array([-along[1], along[0]]) / float(np.linalg.norm(along)) * half
        shares = np.linspace(0, 1, 7)
        sides = [0, 1, -1, 1, -1, 1, 0]
        points = [one + s * along + k * across for s, k in zip(shares, sides, strict=True)]
        self.line([(float(x), float(y)) for x, y in points], linewidth=0.7)

    def words(
        self, x: float, y: float, text: str, gid: str, size: float = SMALL,
        room: float = math.inf, **options: Any,
    ) -> None:  # fmt: skip
        """A line of words, its middle at y; smaller and cut where it would not fit its room."""
        if len(text) * size > room:  # no letter is wider than its height
            text, size = _fitting(text, size, room, options.get("weight", "normal"))
        look: dict[str, Any] = {"ha": "center", "va": "center", "zorder": 9} | options
        halo = [withStroke(linewidth=1.6, foreground="white")]
        self.axes.text(x, y, text, fontsize=size, gid=gid, path_effects=halo, **look)

    def dots(self) -> None:
        """Mark where three pieces of a net or more meet."""
        ends = sorted({(w.net, at) for w in self.wires for at in (w.start, w.end)})
        for net, at in ends:
            if any(p.at == at and p.part.startswith("shuttle") for p in self.ports):
                continue
            ways = 0
            for wire in self.wires:
                if wire.net == net and wire.holds(at):
                    ways += 1 if at in (wire.start, wire.end) else 2
            if ways > 2:
                self.circle(at, 1.5, facecolor=INK, linewidth=0.0, zorder=4.0, gid=f"dot {net}")
