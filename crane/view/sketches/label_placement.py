"""Placement of labels beside their points, clear of lines and symbols."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

from crane.common.samples import Array
from crane.view.sketches.sketch_canvas import GREY, SketchCanvas

_RING_GAPS = (2.0, 5.0, 9.0, 15.0, 23.0, 33.0, 45.0, 60.0)  # gaps to the symbol [points]
_LEADER_LINE_GAP = 12.0  # gap from which a thin line leads to the label [points]
_ANGLES = np.linspace(0, 2 * np.pi, 32, endpoint=False) + np.pi / 4
_MAX_SWEEPS = 6


@dataclass(frozen=True, eq=False)
class SketchLabel:
    """A label beside a point.

    Attributes:
        text: Text.
        position: (2,) labelled point [m].
        radius: Radius of the symbol at the point [points].
        gid: Identifier of the text in the figure.
    """

    text: str
    position: Array
    radius: float
    gid: str


def place_labels(canvas: SketchCanvas, labels: Sequence[SketchLabel]) -> None:
    """Place labels beside their points, clear of each other and of all lines and symbols.

    Candidates lie on rings around each point. The cost of a candidate depends on what it covers,
    on its distance, and on the distance to other symbols. The label with the most expensive best
    candidate is placed first, then all are placed again in turn.
    """
    axes, point = canvas.axes, canvas.point_size
    figure = axes.figure
    assert isinstance(figure, Figure)
    renderer = FigureCanvasAgg(figure).get_renderer()
    texts: list[Text] = []
    boxes, costs = [], []
    for label in labels:
        text = axes.text(
            float(label.position[0]),
            float(label.position[1]),
            label.text,
            ha="center",
            va="center",
            fontsize=8.5,
            zorder=9,
            gid=label.gid,
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )
        texts.append(text)
        candidates, gaps = _candidates(
            label,
            np.array(text.get_window_extent(renderer).size) / 2 * 72 / figure.dpi * point,
            point,
        )
        boxes.append(candidates)
        costs.append(_placement_costs(canvas, label, candidates, gaps))
    chosen = _choose_candidates(boxes, costs, point)
    for label, text, (lower, upper) in zip(labels, texts, chosen, strict=True):
        text.set_position(tuple((lower + upper) / 2))
        nearest = np.clip(label.position, lower, upper)
        distance = float(np.linalg.norm(nearest - label.position)) / point
        if distance > label.radius + _LEADER_LINE_GAP:
            axes.plot(
                *np.array(
                    [
                        label.position + (nearest - label.position) * label.radius / distance,
                        nearest,
                    ]
                ).T,
                color=GREY,
                linewidth=0.6,
                zorder=8,
            )


def _candidates(label: SketchLabel, half_size: Array, point_size: float) -> tuple[Array, Array]:
    """Return boxes (k, 2, 2) as lower and upper corners [m], and their gaps (k,) [points]."""
    directions = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
    # a box whose nearest point lies in that direction: corners for slanted ones, sides for others
    gaps = np.repeat(_RING_GAPS, len(_ANGLES))
    centres = label.position + np.tile(directions, (len(_RING_GAPS), 1)) * (
        (label.radius + gaps)[:, None] * point_size
    )
    centres = centres + np.tile(np.clip(1.6 * directions, -1, 1), (len(_RING_GAPS), 1)) * half_size
    return np.stack([centres - half_size, centres + half_size], axis=1), gaps


def _placement_costs(canvas: SketchCanvas, label: SketchLabel, boxes: Array, gaps: Array) -> Array:
    """Return costs (k,) of what a label covers and of its distance, without other labels."""
    point = canvas.point_size
    lower, upper = boxes[:, 0] - 1.2 * point, boxes[:, 1] + 1.2 * point
    cost = 0.14 * gaps
    for segment in canvas.occupied_segments:
        inside = _length_inside(segment, lower, upper) / point
        cost = cost + np.where(inside > 0, 12 + 1.5 * inside, 0)
    for centre, radius in canvas.occupied_discs:
        distance = np.linalg.norm(np.clip(centre, lower, upper) - centre, axis=1) / point
        cost = cost + np.where(distance < radius, 60.0, 0)
        if (
            np.abs(centre - label.position).max() > 1e-6 * point
        ):  # closer to another symbol than to its own
            cost = cost + np.where(distance - radius < gaps + 2.0, 5.0, 0)
    limits = np.array([canvas.axes.get_xlim(), canvas.axes.get_ylim()])
    return cost + np.where(
        (lower < limits[:, 0]).any(axis=1) | (upper > limits[:, 1]).any(axis=1), 500.0, 0
    )


def _choose_candidates(
    boxes: Sequence[Array], costs: Sequence[Array], point_size: float
) -> list[Array]:
    """Return the chosen candidate (2, 2) of each label; labels (k, 2, 2) should not overlap."""
    chosen: dict[int, int] = {}
    for sweep in range(_MAX_SWEEPS):
        previous = dict(chosen)
        for i in sorted(range(len(boxes)), key=lambda i: -float(costs[i].min())):
            others = [boxes[j][best_index] for j, best_index in chosen.items() if j != i]
            cost = _costs_with_labels(others, boxes[i], costs[i], point_size)
            chosen[i] = int(cost.argmin())
        if sweep and chosen == previous:
            break
    return [candidates[chosen[i]] for i, candidates in enumerate(boxes)]


def _costs_with_labels(
    other_boxes: Sequence[Array], boxes: Array, cost: Array, point_size: float
) -> Array:
    """Return costs (k,) of boxes (k, 2, 2) of a label, with other labels in boxes (2, 2)."""
    for lower, upper in other_boxes:
        gap = np.maximum(boxes[:, 0] - upper, lower - boxes[:, 1]).max(axis=1)
        cost = cost + np.where(gap < 4 * point_size, 1000.0, 0)
    return cost


def _length_inside(segment: Array, lower: Array, upper: Array) -> Array:
    """Return the length (k,) of a line (2, 2) within boxes (k, 2), (k, 2)."""
    start, direction = segment[0], segment[1] - segment[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = np.array([(lower - start) / direction, (upper - start) / direction])
    entry = np.where(direction == 0, -np.inf, np.fmin(*crossings)).max(axis=1)
    end = np.where(direction == 0, np.inf, np.fmax(*crossings)).min(axis=1)
    share = np.maximum(np.minimum(end, 1.0) - np.maximum(entry, 0.0), 0.0)
    return np.asarray(
        np.where(((direction == 0) & ((start < lower) | (start > upper))).any(axis=1), 0.0, share)
        * np.linalg.norm(direction)
    )


def find_clear_point(
    polygon: Array, segments: Sequence[Array], excluded_polygons: Sequence[Array]
) -> tuple[Array, float]:
    """Find a point (2,) in a polygon, outside of others, and its distance to all lines [m]."""
    lower, upper = polygon.min(axis=0), polygon.max(axis=0)
    grid = np.stack(np.meshgrid(*np.linspace(lower, upper, 41).T), axis=-1).reshape(-1, 2)
    grid = grid[Path(polygon).contains_points(grid)]
    for excluded_polygon in excluded_polygons:
        is_excluded = Path(excluded_polygon).contains_points(grid)
        if not is_excluded.all():
            grid = grid[~is_excluded]
    if not len(grid):
        return polygon.mean(axis=0), 0.0
    distance = np.full(len(grid), np.inf)
    for start, end in segments:
        direction = end - start
        distance = np.minimum(
            distance,
            np.linalg.norm(
                grid
                - start
                - np.clip(
                    (grid - start) @ direction / max(float(direction @ direction), 1e-30), 0, 1
                )[:, None]
                * direction,
                axis=1,
            ),
        )
    return grid[distance.argmax()], float(distance.max())
