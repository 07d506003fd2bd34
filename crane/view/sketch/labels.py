"""Where labels go: beside what they name, on nothing else."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from numpy.typing import NDArray

from crane.common.samples import Array
from crane.view.sketch.canvas import GREY, Canvas

_RINGS = (2.0, 5.0, 9.0, 15.0, 23.0, 33.0, 45.0, 60.0)  # gaps to what is named [points]
_FAR = 12.0  # gap from which a thin line leads to the label [points]
_ANGLES = np.linspace(0, 2 * np.pi, 32, endpoint=False) + np.pi / 4
_SWEEPS = 6


@dataclass(frozen=True, eq=False)
class Label:
    """Words beside a point.

    Attributes:
        text: The words.
        at: (2,) what they name [m].
        radius: Of the symbol there [points].
        gid: The text's name in the figure.
    """

    text: str
    at: Array
    radius: float
    gid: str


def place_labels(canvas: Canvas, labels: Sequence[Label]) -> None:
    """Put labels beside what they name, clear of each other and of all lines and symbols.

    Candidates stand in rings around each point; each costs what it covers, its distance, and
    nearness to other symbols. The label with the dearest best place chooses first, then all choose
    again in turn.
    """
    axes, point = canvas.axes, canvas.point
    figure = axes.figure
    assert isinstance(figure, Figure)
    renderer = FigureCanvasAgg(figure).get_renderer()
    texts: list[Text] = []
    boxes, costs = [], []
    for label in labels:
        text = axes.text(
            float(label.at[0]),
            float(label.at[1]),
            label.text,
            ha="center",
            va="center",
            fontsize=8.5,
            zorder=9,
            gid=label.gid,
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )
        extent = text.get_window_extent(renderer)
        half = np.array([extent.width, extent.height]) / 2 * 72 / figure.dpi * point
        texts.append(text)
        candidates, gaps = _candidates(label, half, point)
        boxes.append(candidates)
        costs.append(_cost(canvas, label, candidates, gaps))
    chosen = _choose(boxes, costs, point)
    for label, text, candidates, best in zip(labels, texts, boxes, chosen, strict=True):
        low, high = candidates[best]
        text.set_position(tuple((low + high) / 2))
        nearest = np.clip(label.at, low, high)
        if np.linalg.norm(nearest - label.at) > (label.radius + _FAR) * point:
            start = label.at + (nearest - label.at) * label.radius / _length(
                (nearest - label.at) / point
            )
            axes.plot(*np.array([start, nearest]).T, color=GREY, linewidth=0.6, zorder=8)


def _candidates(label: Label, half: Array, point: float) -> tuple[Array, Array]:
    """Boxes (k, 2, 2) as lowest and highest corners [m], and their gaps (k,) [points]."""
    directions = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
    # a box whose nearest point lies in that direction: corners for slanted ones, sides for others
    lean = np.clip(1.6 * directions, -1, 1)
    gaps = np.repeat(_RINGS, len(_ANGLES))
    reach = (label.radius + gaps)[:, None] * point
    centres = label.at + np.tile(directions, (len(_RINGS), 1)) * reach
    centres = centres + np.tile(lean, (len(_RINGS), 1)) * half
    return np.stack([centres - half, centres + half], axis=1), gaps


def _cost(canvas: Canvas, label: Label, boxes: Array, gaps: Array) -> Array:
    """(k,) what a label would cover and how far it would be, without other labels."""
    point = canvas.point
    low, high = boxes[:, 0] - 1.2 * point, boxes[:, 1] + 1.2 * point
    cost = 0.14 * gaps
    for segment in canvas.segments:
        inside = _length_inside(segment, low, high) / point
        cost = cost + np.where(inside > 0, 12 + 1.5 * inside, 0)
    for centre, radius in canvas.discs:
        distance = np.linalg.norm(np.clip(centre, low, high) - centre, axis=1) / point
        cost = cost + np.where(distance < radius, 60.0, 0)
        if (
            np.abs(centre - label.at).max() > 1e-6 * point
        ):  # nearer to another symbol than to its own
            cost = cost + np.where(distance - radius < gaps + 2.0, 5.0, 0)
    limits = np.array([canvas.axes.get_xlim(), canvas.axes.get_ylim()])
    outside = (low < limits[:, 0]).any(axis=1) | (high > limits[:, 1]).any(axis=1)
    return cost + np.where(outside, 500.0, 0)


def _beside(others: Sequence[Array], boxes: Array, cost: Array, point: float) -> Array:
    """Costs (k,) of the boxes (k, 2, 2) of a label with other labels in their boxes (2, 2)."""
    for low, high in others:
        gap = np.maximum(boxes[:, 0] - high, low - boxes[:, 1]).max(axis=1)
        cost = cost + np.where(gap < 4 * point, 1000.0, 0)
    return cost


def _choose(boxes: Sequence[Array], costs: Sequence[Array], point: float) -> list[int]:
    """Index of the candidate of each label."""
    order = sorted(range(len(boxes)), key=lambda i: -float(costs[i].min()))
    chosen: dict[int, int] = {}
    for sweep in range(_SWEEPS):
        before = dict(chosen)
        for i in order:
            others = [boxes[j][best] for j, best in chosen.items() if j != i]
            chosen[i] = int(_beside(others, boxes[i], costs[i], point).argmin())
        if sweep and chosen == before:
            break
    return [chosen[i] for i in range(len(boxes))]


def _length_inside(segment: Array, low: Array, high: Array) -> Array:
    """(k,) length of a line (2, 2) within boxes (k, 2), (k, 2)."""
    start, way = segment[0], segment[1] - segment[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (low - start) / way, (high - start) / way
    enter, leave = np.fmin(one, other), np.fmax(one, other)
    beside = (way == 0) & ((start < low) | (start > high))
    enter = np.where(way == 0, -np.inf, enter).max(axis=1)
    leave = np.where(way == 0, np.inf, leave).min(axis=1)
    share = np.minimum(leave, 1.0) - np.maximum(enter, 0.0)
    share = np.where(beside.any(axis=1), 0.0, np.maximum(share, 0.0))
    return np.asarray(share * np.linalg.norm(way))


def _length(vector: Array) -> float:
    return max(float(np.linalg.norm(vector)), 1e-12)


def clear_spot(
    inside: Array, segments: Sequence[Array], others: Sequence[Array]
) -> tuple[Array, float]:
    """A point (2,) within corners (k, 2), outside of others, and its distance to all lines [m]."""
    low, high = inside.min(axis=0), inside.max(axis=0)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 41).T), axis=-1).reshape(-1, 2)
    grid = grid[_within(grid, inside)]
    for other in others:
        if len(left := grid[np.logical_not(_within(grid, other))]):
            grid = left
    if not len(grid):
        return inside.mean(axis=0), 0.0
    distance = np.full(len(grid), np.inf)
    for start, end in segments:
        way = end - start
        share = np.clip((grid - start) @ way / max(float(way @ way), 1e-30), 0, 1)
        distance = np.minimum(
            distance, np.linalg.norm(grid - start - share[:, None] * way, axis=1)
        )
    return grid[distance.argmax()], float(distance.max())


def _within(points: Array, corners: Array) -> NDArray[np.bool_]:
    """(n,) whether points (n, 2) lie within a polygon (k, 2)."""
    inside = np.zeros(len(points), dtype=bool)
    x, y = points.T
    for (a, b), (c, d) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        crosses = (b > y) != (d > y)
        if b != d:
            inside ^= crosses & (x < a + (y - b) * (c - a) / (d - b))
    return inside
