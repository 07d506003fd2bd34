"""Meshcat's commands for shapes and the ground, kept instead of sent."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from crane.common.samples import Array
from crane.formats.visuals.visuals import Box, Cylinder, Mesh, Sphere, Visual

_SKY, _HAZE, _GRID = [0.80, 0.87, 0.93], [0.97, 0.97, 0.95], 0xB4BAC0
_UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass
class Recorder:
    """Stands in for meshcat's window: no server, no port, only a list of commands.

    Meshcat's identifiers tell time and computer. Here they are numbers in the order of the
    commands, so that equal runs give equal pages.
    """

    commands: list[dict[str, Any]] = field(default_factory=list)
    _numbers: dict[str, str] = field(default_factory=dict)

    def send(self, command: Any) -> None:
        """Keep a command."""
        lowered = command.lower()
        self._number(lowered)
        self.commands.append(self._numbered(lowered))

    def _number(self, part: Any) -> None:
        for key, value in part.items() if isinstance(part, dict) else enumerate(part):
            if key == "uuid":
                self._numbers.setdefault(value, str(len(self._numbers)))
            elif isinstance(value, dict | list):
                self._number(value)

    def _numbered(self, part: Any) -> Any:
        if isinstance(part, dict):
            return {key: self._numbered(value) for key, value in part.items()}
        if isinstance(part, list):
            return [self._numbered(value) for value in part]
        return self._numbers.get(part, part) if isinstance(part, str) else part


def draw_visuals(viewer: Any, visuals: Sequence[Visual]) -> None:
    """Put the visuals of each link into the group of that link."""
    import meshcat.geometry as g

    for index, visual in enumerate(visuals):
        red, green, blue, opacity = (min(max(value, 0.0), 1.0) for value in visual.colour)
        colour = (round(255 * red) << 16) + (round(255 * green) << 8) + round(255 * blue)
        placement = visual.placement
        match visual.shape:
            case Box(size):
                geometry = g.Box(list(size))
            case Cylinder(radius, length):
                geometry = g.Cylinder(length, radius)
                placement = placement @ _UPRIGHT  # meshcat's cylinder lies along y
            case Sphere(radius):
                geometry = g.Sphere(radius)
            case Mesh(vertices, faces):
                geometry = g.TriangularMeshGeometry(vertices, faces)
        shape = viewer[visual.link][f"visual_{index}"]
        shape.set_object(geometry, g.MeshPhongMaterial(color=colour, opacity=opacity))
        shape.set_transform(placement)


def draw_surroundings(viewer: Any, lower: Array, upper: Array, floor: float) -> None:
    """Background and a grid with round spacing at a height, around a box (3,), (3,) [m]."""
    import meshcat.geometry as g

    viewer["/Background"].set_property("top_color", _SKY)
    viewer["/Background"].set_property("bottom_color", _HAZE)
    viewer["/Grid"].set_property("visible", False)
    viewer["/Axes"].set_property("visible", False)
    size = float(np.linalg.norm(upper - lower))
    decade = 10.0 ** np.floor(np.log10(size / 12))
    spacing = decade * min((1, 2, 5, 10), key=lambda step: abs(np.log(12 * step * decade / size)))
    count = int(np.ceil(size / spacing))
    ticks, end = np.arange(-count, count + 1) * spacing, count * spacing
    along = np.array([[(tick, -end), (tick, end)] for tick in ticks]).reshape(-1, 2)
    centre = np.round((lower + upper)[:2] / 2 / spacing) * spacing
    level = np.concatenate([along, along[:, ::-1]]) + centre
    points = np.column_stack([level, np.full(len(level), floor)])
    viewer.set_object(g.LineSegments(_points(points), g.LineBasicMaterial(color=_GRID)))


def _points(points: Array) -> Any:
    import meshcat.geometry as g

    return g.PointsGeometry(np.ascontiguousarray(points.T, dtype=np.float32))
