"""Canvas of a circuit drawing: wires of nets, ports, lines and texts, in points."""

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
from crane.view.plots.figure_style import INK_COLOUR

SheetPoint = tuple[float, float]
_COORDINATE_TOLERANCE = 1e-6  # [points]
_SIGNAL_DASHES = (0, (3, 2))
SMALL_TEXT_SIZE, NAME_TEXT_SIZE, MIN_TEXT_SIZE = 6.3, 8.0, 5.2  # sizes of words [points]


def _fit_text(text: str, size: float, available_width: float, weight: str) -> tuple[str, float]:
    font = FontProperties(family="DejaVu Sans", weight=weight)

    def measure_width(text: str) -> float:
        return float(TextPath((0, 0), text, size=size, prop=font).get_extents().width)

    text_width, min_scale = measure_width(text), min(MIN_TEXT_SIZE / size, 1.0)
    if text_width * min_scale > available_width and not text.startswith("$"):
        end = len(text)
        while (
            measure_width(text[:end].rstrip("\\") + "…") * min_scale > available_width and end > 1
        ):
            end -= 1
        text = text[:end].rstrip("\\") + "…"
        text_width = measure_width(text)
    return text, size * min(available_width / text_width, 1.0)


@dataclass(frozen=True)
class SymbolPose:
    """Pose of a symbol, which is drawn about the origin with its flow upwards.

    Attributes:
        x: To the right [points].
        y: Upwards [points].
        quarter_turns: Quarter turns counterclockwise.
        is_mirrored: Whether the symbol is mirrored left to right before it is turned.
    """

    x: float
    y: float
    quarter_turns: int = 0
    is_mirrored: bool = False

    def __call__(self, *points: SheetPoint) -> list[SheetPoint]:
        """Transform points to the sheet."""
        out = []
        for x, y in points:
            x, y = (-x if self.is_mirrored else x), y
            for _ in range(self.quarter_turns % 4):
                x, y = -y, x
            out.append((self.x + x, self.y + y))
        return out

    def transform_point(self, x: float, y: float) -> SheetPoint:
        """Transform one point to the sheet."""
        return self((x, y))[0]


@dataclass(frozen=True)
class CircuitWire:
    """A straight segment of a line.

    Attributes:
        net: Net of the segment; segments of different nets are not connected, even if they cross.
        start: [points]
        end: [points]
    """

    net: str
    start: SheetPoint
    end: SheetPoint

    def contains(self, point: SheetPoint) -> bool:
        """Return whether a point lies on the wire."""
        (a, b), (c, d), (x, y) = self.start, self.end, point
        is_within = min(a, c) - _COORDINATE_TOLERANCE <= x <= max(a, c) + _COORDINATE_TOLERANCE
        is_within = (
            is_within
            and min(b, d) - _COORDINATE_TOLERANCE <= y <= max(b, d) + _COORDINATE_TOLERANCE
        )
        return (
            is_within and abs((c - a) * (y - b) - (d - b) * (x - a)) < _COORDINATE_TOLERANCE * 100
        )


@dataclass(frozen=True)
class SymbolPort:
    """Connection of a symbol to a net.

    Attributes:
        component: The symbol's name.
        net: See `CircuitWire`.
        position: [points]
    """

    component: str
    net: str
    position: SheetPoint


class CircuitCanvas:
    """Draws on axes whose coordinates are points.

    Args:
        axes: Axes of equal scales.

    Attributes:
        wires: Segments of all wires.
        ports: Ports of all symbols.
    """

    def __init__(self, axes: Axes):
        self.axes = axes
        self.wires: list[CircuitWire] = []
        self.ports: list[SymbolPort] = []

    def draw_wire(self, net: str, *points: SheetPoint, is_signal: bool = False) -> None:
        """Draw a line of a net through points; dashed for a signal."""
        distinct_points = [points[0]]
        distinct_points += [b for a, b in zip(points, points[1:], strict=False) if a != b]
        if len(distinct_points) < 2:
            return
        self.wires += [
            CircuitWire(net, a, b)
            for a, b in zip(distinct_points, distinct_points[1:], strict=False)
        ]
        style: dict[str, Any] = {"linewidth": 1.0}
        if is_signal:
            style = {"linewidth": 0.7, "linestyle": _SIGNAL_DASHES}
        self.draw_line(distinct_points, zorder=2.0, gid=f"wire {net}", **style)

    def add_port(self, component: str, net: str, position: SheetPoint) -> None:
        """Add a port of a symbol."""
        self.ports.append(SymbolPort(component, net, position))

    def draw_line(self, points: Sequence[SheetPoint], **options: Any) -> None:
        """Draw a line of a symbol."""
        style: dict[str, Any] = {
            "color": INK_COLOUR, "linewidth": 0.8, "zorder": 3.2, "solid_capstyle": "round",
            "solid_joinstyle": "round",
        } | options  # fmt: skip
        self.axes.plot(*np.array(points, dtype=float).T, **style)

    def draw_shape(
        self, points: Sequence[SheetPoint], is_filled: bool = False, **options: Any
    ) -> None:
        """Draw a closed outline, white or filled."""
        style = {
            "facecolor": INK_COLOUR if is_filled else "white",
            "edgecolor": INK_COLOUR,
            "linewidth": 0.8,
            "zorder": 3.0,
            "joinstyle": "miter",
        } | options
        self.axes.add_patch(Polygon(np.array(points, dtype=float), closed=True, **style))

    def draw_circle(self, position: SheetPoint, radius: float, **options: Any) -> None:
        """Draw a circle, white by default."""
        style = {
            "facecolor": "white",
            "edgecolor": INK_COLOUR,
            "linewidth": 0.8,
            "zorder": 3.0,
        } | options
        self.axes.add_patch(Circle(position, radius, **style))

    def draw_arrow(
        self, start: SheetPoint, end: SheetPoint, *, size: float = 3.2, **options: Any
    ) -> None:
        """Draw a line with a filled head at its end."""
        first, second = np.array(start), np.array(end)
        direction = (second - first) / float(np.linalg.norm(second - first))
        normal = np.array([-direction[1], direction[0]])
        head_base: Array = second - size * direction
        self.draw_line(
            [start, (float(head_base[0]), float(head_base[1]))], solid_capstyle="butt", **options
        )
        head_points = [second, head_base + 0.38 * size * normal, head_base - 0.38 * size * normal]
        corners = [(float(x), float(y)) for x, y in head_points]
        self.draw_shape(corners, is_filled=True, linewidth=0.0, zorder=3.3)

    def draw_spring(self, start: SheetPoint, end: SheetPoint, *, half_width: float = 2.2) -> None:
        """Draw a spring."""
        first, second = np.array(start), np.array(end)
        direction = second - first
        normal = (
            np.array([-direction[1], direction[0]]) / float(np.linalg.norm(direction)) * half_width
        )
        shares = np.linspace(0, 1, 7)
        sides = [0, 1, -1, 1, -1, 1, 0]
        points = [first + s * direction + k * normal for s, k in zip(shares, sides, strict=True)]
        self.draw_line([(float(x), float(y)) for x, y in points], linewidth=0.7)

    def draw_text(
        self, x: float, y: float, text: str, gid: str, size: float = SMALL_TEXT_SIZE,
        available_width: float = math.inf, **options: Any,
    ) -> None:  # fmt: skip
        """Write a line of text centred at y; reduced and cut if it does not fit the width."""
        if len(text) * size > available_width:  # no letter is wider than its height
            text, size = _fit_text(text, size, available_width, options.get("weight", "normal"))
        style: dict[str, Any] = {"ha": "center", "va": "center", "zorder": 9} | options
        halo = [withStroke(linewidth=1.6, foreground="white")]
        self.axes.text(x, y, text, fontsize=size, gid=gid, path_effects=halo, **style)

    def draw_junctions(self) -> None:
        """Mark points where three or more wires of a net meet."""
        ends = sorted({(w.net, at) for w in self.wires for at in (w.start, w.end)})
        for net, position in ends:
            if any(
                p.position == position and p.component.startswith("shuttle") for p in self.ports
            ):
                continue
            branch_count = 0
            for wire in self.wires:
                if wire.net == net and wire.contains(position):
                    branch_count += 1 if position in (wire.start, wire.end) else 2
            if branch_count > 2:
                self.draw_circle(
                    position,
                    1.5,
                    facecolor=INK_COLOUR,
                    linewidth=0.0,
                    zorder=4.0,
                    gid=f"dot {net}",
                )
