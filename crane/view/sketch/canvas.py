"""Lines and symbols of kinematic diagrams, in sizes that do not depend on the machine's."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from matplotlib.path import Path

from crane.common.samples import Array
from crane.view.plots.recording import INK

Corner = tuple[float, ...]

GREY = "#8a8a8a"
JOINT: Any = {"marker": "o", "markersize": 6.5, "markerfacecolor": "white"}
RING: Any = {"marker": "o", "markersize": 10.0, "markerfacecolor": "white"}
DOT: Any = {"marker": "o", "markersize": 4.6, "markeredgewidth": 0.0}
CENTRE: Any = {"marker": "o", "markersize": 7.0, "markerfacecolor": "white"}
QUARTERS: list[Any] = [
    {"marker": Path.wedge(start, start + 90), "markersize": 7.0, "markeredgewidth": 0.0}
    for start in (0, 180)
]
TIP: Any = {"marker": "+", "markersize": 17.0, "markeredgewidth": 1.3}


class Canvas:
    """Draws onto axes in metres, with widths in points; remembers what labels must not cover.

    Args:
        axes: Axes of equal scales.
        point: Length of a printer's point in the coordinates of the axes [m].

    Attributes:
        segments: Lines (2, 2) [m] that labels keep away from.
        discs: Centres (2,) [m] and radii [points] of symbols that labels keep away from.
    """

    def __init__(self, axes: Axes, point: float):
        self.axes, self.point = axes, point
        self.segments: list[Array] = []
        self.discs: list[tuple[Array, float]] = []

    def line(self, points: Array, colour: str, width: float, **options: Any) -> None:
        """A line through points (k, 2) [m], its width in points."""
        options = {"solid_capstyle": "round", "solid_joinstyle": "round"} | options
        self.axes.plot(*points.T, color=colour, linewidth=width, **options)
        self.segments += list(np.stack([points[:-1], points[1:]], axis=1))

    def polygon(self, points: Array, colour: str, width: float, tint: float, order: float) -> None:
        """A closed line around corners (k, 2) [m], filled with a tint of its colour."""
        closed = np.vstack([points, points[:1]])
        self.axes.add_patch(
            Polygon(points, facecolor=colour, alpha=tint, linewidth=0, zorder=order)
        )
        self.line(closed, colour, width, zorder=order)

    def box(self, start: Array, end: Array, width: float, colour: str, order: float) -> None:
        """A white rectangle about the line from start to end [m], its width in points."""
        along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-12)
        across = np.array([-along[1], along[0]]) * width / 2 * self.point
        corners = np.array([start + across, end + across, end - across, start - across])
        self.axes.add_patch(
            Polygon(
                corners,
                facecolor="white",
                edgecolor=colour,
                linewidth=1.3,
                joinstyle="round",
                zorder=order,
            )
        )
        closed = np.vstack([corners, corners[:1]])
        self.segments += list(np.stack([closed[:-1], closed[1:]], axis=1))

    def joint(self, name: str, at: Array) -> None:
        """A pin of the tree."""
        self._mark(at, 6.0, f"joint {name}", JOINT)
        self.discs.append((at, 4.0))

    def loop(self, name: str, at: Array, mate: Array) -> None:
        """A pin that closes a loop: a ring where its first body has it, a dot for its second."""
        self._mark(at, 5.5, f"loop {name}", RING)
        self._mark(mate, 6.5, f"loop {name} mate", DOT)
        self.discs.append((at, 6.0))

    def collar(self, name: str, at: Array, along: Array) -> None:
        """A joint that turns about a line in the plane, drawn with that line."""
        half = along * self.point
        self.box(at - 7 * half, at + 7 * half, 11.0, INK, 4.5)
        reach = np.array([at - 20 * half, at + 20 * half])
        self.axes.plot(*reach.T, color=INK, linewidth=0.8, linestyle=(0, (8, 2, 1.5, 2)), zorder=5)
        self._mark(at, 4.0, f"joint {name}", DOT | {"markersize": 0.1})
        self.segments.append(reach)
        self.discs.append((at, 7.0))

    def ground(self, at: Array, down: Array, gap: float | None) -> None:
        """What stands still: a support under a pin, or a hatched line below, so many points."""
        side = np.array([-down[1], down[0]])
        foot = at + (11.0 if gap is None else gap) * self.point * down
        if gap is None:
            width = 7 * self.point * side
            support = np.array([at, foot - width, foot + width])
            self.axes.add_patch(
                Polygon(support, facecolor="white", edgecolor=INK, linewidth=1.2, zorder=2)
            )
            self.segments += [support[[0, 1]], support[[0, 2]]]
        self.hatch(foot - 15 * self.point * side, foot + 15 * self.point * side, down)

    def hatch(self, start: Array, end: Array, down: Array) -> None:
        """A line from start to end [m], hatched on the side of the unit vector down."""
        self.line(np.array([start, end]), INK, 1.2, zorder=2)
        along = (end - start) / np.linalg.norm(end - start)
        count = max(int(np.linalg.norm(end - start) / (5 * self.point)), 2)
        for share in (np.arange(count) + 0.9) / count:
            at = start + share * (end - start)
            stroke = np.array([at, at + 6 * self.point * (down - 0.8 * along)])
            self.axes.plot(*stroke.T, color=INK, linewidth=0.7, zorder=2)
        below = 3 * self.point * down
        self.segments.append(np.array([start + below, end + below]))
        self.segments.append(np.array([start + 2 * below, end + 2 * below]))

    def centre_of_mass(self, at: Array) -> None:
        """A circle with two black quarters."""
        for order, look in zip((5.2, 5.3, 5.3), (CENTRE, *QUARTERS), strict=True):
            self._mark(at, order, "centre of mass", look)
        self.discs.append((at, 4.5))

    def tip(self, at: Array) -> None:
        """A cross whose arms stick out of whatever pin is there."""
        self._mark(at, 5.4, "tip", TIP)
        self.discs.append((at, 6.0))

    def number(self, number: int, at: Array) -> None:
        """The number of a loop, within what it encloses."""
        self.axes.text(
            float(at[0]),
            float(at[1]),
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
        self.discs.append((at, 7.5))

    def _mark(self, at: Array, order: float, gid: str, look: dict[str, Any]) -> None:
        self.axes.plot(*at[:, None], zorder=order, gid=gid, **mark(look))


def mark(look: dict[str, Any]) -> dict[str, Any]:
    """Options of a line that shows a symbol alone."""
    plain = {"linestyle": "none", "color": INK, "markeredgecolor": INK, "markeredgewidth": 1.2}
    return plain | look


def hull(points: Array) -> Array:
    """Corners (k, 2) of the convex hull of points (n, 2), counterclockwise."""
    ordered = sorted(map(tuple, points.tolist()))

    def turns_left(one: Corner, two: Corner, three: Corner) -> bool:
        (a, b), (c, d), (x, y) = one, two, three
        return (c - a) * (y - b) - (d - b) * (x - a) > 0

    def half(row: Sequence[Corner]) -> list[Corner]:
        chain: list[Corner] = []
        for corner in row:
            while len(chain) > 1 and not turns_left(chain[-2], chain[-1], corner):
                chain.pop()
            chain.append(corner)
        return chain[:-1]

    return np.array(half(ordered) + half(ordered[::-1]) or ordered)
