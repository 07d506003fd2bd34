"""Meshcat's commands for shapes and the ground, kept instead of sent."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from crane.common.samples import Array
from crane.formats.visuals.urdf_shapes import (
    BoxShape,
    CylinderShape,
    MeshShape,
    SphereShape,
    Visual,
)

_TOP_COLOUR, _BOTTOM_COLOUR, _GRID_COLOUR = [0.80, 0.87, 0.93], [0.97, 0.97, 0.95], 0xB4BAC0
_IDENTIFIED_PARTS = ("geometry", "material", "map", "image")  # that meshcat identifies, too
_CYLINDER_ROTATION = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass
class CommandRecorder:
    """Stands in for meshcat's window: no server, no port, only a list of commands.

    Meshcat's identifiers tell time and computer. Here they are numbers in the order of the
    commands, so that equal runs give equal pages.
    """

    commands: list[dict[str, Any]] = field(default_factory=list)
    _object_count: int = 0

    def send(self, command: Any) -> None:
        """Keep a command."""
        if hasattr(command, "object"):
            self._assign_identifier(command.object)
        self.commands.append(command.lower())

    def _assign_identifier(self, element: Any) -> None:
        """Number an object of meshcat and what it is made of."""
        element.uuid, self._object_count = str(self._object_count), self._object_count + 1
        for part in filter(None, map(vars(element).get, _IDENTIFIED_PARTS)):
            self._assign_identifier(part)


def draw_visuals(viewer: Any, visuals: Sequence[Visual]) -> None:
    """Put the visuals of each link into the group of that link."""
    import meshcat.geometry as g

    for index, visual in enumerate(visuals):
        red, green, blue, opacity = (min(max(value, 0.0), 1.0) for value in visual.colour)
        colour = (round(255 * red) << 16) + (round(255 * green) << 8) + round(255 * blue)
        placement = visual.placement
        match visual.shape:
            case BoxShape(size):
                geometry = g.Box(list(size))
            case CylinderShape(radius, length):
                geometry = g.Cylinder(length, radius)
                placement = placement @ _CYLINDER_ROTATION  # meshcat's cylinder lies along y
            case SphereShape(radius):
                geometry = g.Sphere(radius)
            case MeshShape(vertices, faces):
                geometry = g.TriangularMeshGeometry(vertices, faces)
        shape = viewer[visual.link][f"visual_{index}"]
        shape.set_object(geometry, g.MeshPhongMaterial(color=colour, opacity=opacity))
        shape.set_transform(placement)


def draw_surroundings(viewer: Any, lower: Array, upper: Array, ground_height: float) -> None:
    """Background and a grid with round spacing at a height, around a box (3,), (3,) [m]."""
    import meshcat.geometry as g

    viewer["/Background"].set_property("top_color", _TOP_COLOUR)
    viewer["/Background"].set_property("bottom_color", _BOTTOM_COLOUR)
    viewer["/Grid"].set_property("visible", False)
    viewer["/Axes"].set_property("visible", False)
    size = float(np.linalg.norm(upper - lower))
    power_of_ten = 10.0 ** np.floor(np.log10(size / 12))
    spacing = power_of_ten * min(
        (1, 2, 5, 10), key=lambda step: abs(np.log(12 * step * power_of_ten / size))
    )
    count = int(np.ceil(size / spacing))
    ticks, half_length = np.arange(-count, count + 1) * spacing, count * spacing
    line_ends = np.array([[(tick, -half_length), (tick, half_length)] for tick in ticks]).reshape(
        -1, 2
    )
    centre = np.round((lower + upper)[:2] / 2 / spacing) * spacing
    grid_points = np.concatenate([line_ends, line_ends[:, ::-1]]) + centre
    points = np.column_stack([grid_points, np.full(len(grid_points), ground_height)])
    viewer.set_object(
        g.LineSegments(_points_geometry(points), g.LineBasicMaterial(color=_GRID_COLOUR))
    )


def _points_geometry(points: Array) -> Any:
    import meshcat.geometry as g

    return g.PointsGeometry(np.ascontiguousarray(points.T, dtype=np.float32))
