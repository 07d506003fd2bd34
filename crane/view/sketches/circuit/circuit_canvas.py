"""Canvas of a circuit drawing: wires of nets, ports, lines and texts, in points."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke
from matplotlib.textpath import TextPath
from numpy.typing import ArrayLike

from crane.view.plots.figure_style import INK_COLOUR

SheetPoint = tuple[float, float]
_COORDINATE_TOLERANCE = 1e-6  # [points]
_SIGNAL_DASHES = (0, (3, 2))
LINE_HEIGHT = 7.6  # of words [points]
SMALL_TEXT_SIZE, NAME_TEXT_SIZE, MIN_TEXT_SIZE = 6.3, 8.0, 5.2  # sizes of words [points]


def _fit_text(text: str, size: float, available_width: float, weight: str) -> tuple[str, float]:
    font = FontProperties(family="DejaVu Sans", weight=weight)

    def measure_width(text: str) -> float:
        return float(TextPath((0, 0), text, size=size, prop=font).get_extents().width)

    min_scale = min(MIN_TEXT_SIZE / size, 1.0)
    shortened, end = text, 1 if text.startswith("$") else len(text)
    while measure_width(shortened) * min_scale > available_width and end > 1:
        end -= 1
        shortened = text[:end].rstrip("\\") + "…"
    return shortened, size * min(available_width / measure_width(shortened), 1.0)


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
            x = -x if self.is_mirrored else x
            for _ in range(self.quarter_turns):
                x, y = -y, x
            out.append((self.x + x, self.y + y))
        return out


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
        tolerance = _COORDINATE_TOLERANCE
        is_within_x = min(a, c) - tolerance <= x <= max(a, c) + tolerance
        is_within_y = min(b, d) - tolerance <= y <= max(b, d) + tolerance
        return (
            is_within_x
            and is_within_y
            and abs((c - a) * (y - b) - (d - b) * (x - a)) < tolerance * 100
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
        segments = [pair for pair in itertools.pairwise(points) if pair[0] != pair[1]]
        if not segments:
            return
        self.wires += [CircuitWire(net, a, b) for a, b in segments]
        style: dict[str, Any] = {"linewidth": 1.0}
        if is_signal:
            style = {"linewidth": 0.7, "linestyle": _SIGNAL_DASHES}
        self.draw_line(
            [segments[0][0], *(end for _, end in segments)], zorder=2.0, gid=f"wire {net}", **style
        )

    def add_port(self, component: str, net: str, position: SheetPoint) -> None:
        """Add a port of a symbol."""
        self.ports.append(SymbolPort(component, net, position))

    def draw_line(self, points: Sequence[ArrayLike], **options: Any) -> None:
        """Draw a line of a symbol."""
        style: dict[str, Any] = {
            "color": INK_COLOUR, "linewidth": 0.8, "zorder": 3.2, "solid_capstyle": "round",
            "solid_joinstyle": "round",
        } | options  # fmt: skip
        self.axes.plot(*np.array(points, dtype=float).T, **style)

    def draw_shape(
        self, points: Sequence[ArrayLike], is_filled: bool = False, **options: Any
    ) -> None:
        """Draw a closed outline, white or filled."""
        self.axes.add_patch(
            Polygon(
                np.array(points, dtype=float),
                closed=True,
                **(
                    {
                        "facecolor": INK_COLOUR if is_filled else "white",
                        "edgecolor": INK_COLOUR,
                        "linewidth": 0.8,
                        "zorder": 3.0,
                        "joinstyle": "miter",
                    }
                    | options
                ),
            )
        )

    def draw_box(self, corner: SheetPoint, opposite_corner: SheetPoint, **options: Any) -> None:
        """Draw a white rectangle with sides along the sheet."""
        (x, y), (end_x, end_y) = corner, opposite_corner
        self.draw_shape([(x, y), (end_x, y), (end_x, end_y), (x, end_y)], **options)

    def draw_circle(self, position: SheetPoint, radius: float, **options: Any) -> None:
        """Draw a circle, white by default."""
        self.axes.add_patch(
            Circle(
                position,
                radius,
                **(
                    {
                        "facecolor": "white",
                        "edgecolor": INK_COLOUR,
                        "linewidth": 0.8,
                        "zorder": 3.0,
                    }
                    | options
                ),
            )
        )

    def draw_arrow(
        self, start: SheetPoint, end: SheetPoint, *, size: float = 3.2, **options: Any
    ) -> None:
        """Draw a line with a filled head at its end."""
        first, second = np.array(start), np.array(end)
        direction = (second - first) / float(np.linalg.norm(second - first))
        half_width = 0.38 * size * np.array([-direction[1], direction[0]])
        base = second - size * direction
        self.draw_line([first, base], solid_capstyle="butt", **options)
        self.draw_shape(
            [second, base + half_width, base - half_width],
            is_filled=True,
            linewidth=0.0,
            zorder=3.3,
        )

    def draw_spring(self, start: SheetPoint, end: SheetPoint, *, half_width: float = 2.2) -> None:
        """Draw a spring."""
        first, direction = np.array(start), np.array(end) - np.array(start)
        self.draw_line(
            [
                first
                + share * direction
                + side
                * half_width
                * (np.array([-direction[1], direction[0]]) / float(np.linalg.norm(direction)))
                for share, side in zip(np.linspace(0, 1, 7), (0, 1, -1, 1, -1, 1, 0), strict=True)
            ],
            linewidth=0.7,
        )

    def draw_text(
        self, x: float, y: float, text: str, gid: str, size: float = SMALL_TEXT_SIZE,
        available_width: float = math.inf, **options: Any,
    ) -> None:  # fmt: skip
        """Write a line of text centred at y; reduced and cut if it does not fit the width."""
        if len(text) * size > available_width:  # no letter is wider than its height
            text, size = _fit_text(text, size, available_width, options.get("weight", "normal"))
        style: dict[str, Any] = {"ha": "center", "va": "center", "zorder": 9} | options
        self.axes.text(
            x,
            y,
            text,
            fontsize=size,
            gid=gid,
            path_effects=[withStroke(linewidth=1.6, foreground="white")],
            **style,
        )

    def draw_texts(
        self, x: float, y: float, texts: Iterable[str], gid: str, **options: Any
    ) -> None:
        """Write lines of text below each other, the first centred at y; see `draw_text`."""
        for k, text in enumerate(texts):
            self.draw_text(x, y - LINE_HEIGHT * k, text, gid, **options)

    def draw_labels(
        self,
        position: SheetPoint,
        component: str,
        name: str,
        texts: Iterable[str],
        available_width: float,
    ) -> None:
        """Write the name of a component, and texts below it."""
        x, y = position
        self.draw_text(
            x, y, name, f"name {component}", NAME_TEXT_SIZE, available_width, weight="bold"
        )
        self.draw_texts(x, y - 9, texts, f"label {component}", available_width=available_width)

    def draw_junctions(self) -> None:
        """Mark points where three or more wires of a net meet."""
        shuttles = {x.position for x in self.ports if x.component.startswith("shuttle")}
        for net, position in sorted({(w.net, at) for w in self.wires for at in (w.start, w.end)}):
            if position in shuttles:
                continue
            if (
                sum(
                    1 if position in (wire.start, wire.end) else 2
                    for wire in self.wires
                    if wire.net == net and wire.contains(position)
                )
                > 2
            ):
                self.draw_circle(
                    position,
                    1.5,
                    gid=f"dot {net}",
                    **{"facecolor": INK_COLOUR, "linewidth": 0.0, "zorder": 4.0},
                )
