"""Mass and inertia of shapes of SDF filled with one density."""

import math

import numpy as np
import pinocchio as pin

from crane.common.packages import find_file
from crane.common.samples import Array
from crane.formats.sdf.values import Item
from crane.formats.visuals.meshes import read_meshes

_SOLIDS = ("box", "capsule", "cone", "cylinder", "ellipsoid", "mesh", "sphere")


def solid(shape: Item, density: float) -> pin.Inertia:
    """The body of a `<collision>` filled with a density [kg/m3], in the frame of its geometry.

    Raises:
        DescriptionError: It has no volume that is known: another shape, or a mesh that is not
            closed or cannot be read.
    """
    geometry = shape.only("geometry")
    tags = [] if geometry is None else [x.tag for x in geometry.element if isinstance(x.tag, str)]
    given = geometry.only(tags[0]) if geometry is not None and tags else None
    if given is None or tags[0] not in _SOLIDS:
        raise _unknown(shape, f"is no {', '.join(_SOLIDS)}")
    if tags[0] == "mesh":
        return _mesh(given, density)
    if tags[0] == "box":
        x, y, z = _sizes(given, "size", 3)
        return pin.Inertia.FromBox(density * x * y * z, x, y, z)
    if tags[0] in ("ellipsoid", "sphere"):
        radii = _sizes(given, "radius", 1) * 3
        if tags[0] == "ellipsoid":
            radii = _sizes(given, "radii", 3)
        mass = density * 4 / 3 * math.pi * float(np.prod(radii))
        return pin.Inertia.FromEllipsoid(mass, *radii)
    radius, length = *_sizes(given, "radius", 1), *_sizes(given, "length", 1)
    mass = density * math.pi * radius**2 * length
    if tags[0] == "cylinder":
        return pin.Inertia.FromCylinder(mass, radius, length)
    if tags[0] == "capsule":  # whose length is that between the centres of its balls
        balls = density * 4 / 3 * math.pi * radius**3
        return pin.Inertia.FromCapsule(mass + balls, radius, length)
    across = 3 / 80 * (4 * radius**2 + length**2)  # a cone, whose tip is up and half its length
    moments = mass / 3 * np.diag([across, across, 0.3 * radius**2])
    return pin.Inertia(mass / 3, np.array([0.0, 0.0, -length / 4]), moments)


def _unknown(item: Item, why: str) -> Exception:
    hint = "write its <mass> and <inertia> instead of auto"
    return item.xml.fail(item.element, f"{item.what} {why}, so that its volume is unknown: {hint}")


def _sizes(given: Item, tag: str, count: int) -> tuple[float, ...]:
    sizes = given.numbers(tag, count, (1.0,) * count)
    if min(sizes) <= 0:
        problem = f"<{tag}> of {given.what} is not positive, give metres"
        raise given.xml.fail(given.element, problem)
    return sizes


def _mesh(given: Item, density: float) -> pin.Inertia:
    name = given.text("uri") or given.text("filename")
    if given.only("submesh") is not None:
        raise _unknown(given, f"takes a part of the mesh '{name}'")
    file = find_file(name, given.xml.file.parent) if name else None
    if file is None or not file.is_file():
        raise _unknown(given, f"has the mesh '{name}', which is not there")
    parts = read_meshes([file])[file]
    if isinstance(parts, str):
        raise _unknown(given, f"has the mesh '{name}', which cannot be read ({parts})")
    scale = np.array(given.numbers("scale", 3, (1.0, 1.0, 1.0)))
    triangles = np.concatenate([part.vertices[part.faces] for part in parts]) * scale
    if edges := _open_edges(triangles):
        raise _unknown(given, f"has the mesh '{name}', which {edges} edges leave open")
    mass, com, tensor = inertia_of_triangles(triangles, density)
    if not mass > 0:
        raise _unknown(given, f"has the mesh '{name}', which is flat")
    return pin.Inertia(mass, com, tensor)


def _open_edges(triangles: Array) -> int:
    """How many edges are not passed as often in one direction as in the other.

    Vertices are the same where they are to nine digits of the size: formats without common
    vertices, such as STL, write each several times.
    """
    points = triangles.reshape(-1, 3)
    grid = float(np.ptp(points, axis=0).max()) * 1e-9 or 1.0
    _, index = np.unique(np.round(points / grid), axis=0, return_inverse=True)
    corners = index.reshape(-1, 3)
    ways = np.concatenate([corners[:, [i, (i + 1) % 3]] for i in range(3)])
    ways = ways[ways[:, 0] != ways[:, 1]]
    sign = np.where(ways[:, 0] < ways[:, 1], 1, -1)
    _, edge = np.unique(np.sort(ways, axis=1), axis=0, return_inverse=True)
    return int(np.count_nonzero(np.bincount(edge.ravel(), weights=sign)))


def inertia_of_triangles(triangles: Array, density: float) -> tuple[float, Array, Array]:
    """Mass, centre (3,) and inertia (3, 3) about it of what closed triangles (F, 3, 3) bound.

    Of the tetrahedron from the origin to a triangle a, b, c, with six times its signed volume
    d = a . (b x c) and s = a + b + c,

        V = d / 6,    int x dV = d s / 24,
        int x x^T dV = d (s s^T + a a^T + b b^T + c c^T) / 120

    and the sum over all is that of the body; negative where the triangles face inwards.
    """
    middle = triangles.reshape(-1, 3).mean(axis=0)  # near which less is lost to rounding
    corners = triangles - middle
    volumes = np.linalg.det(corners)
    sums = corners.sum(axis=1)
    volume = volumes.sum() / 6
    first = volumes @ sums / 24
    second = np.einsum("f,fi,fj->ij", volumes, sums, sums)
    second = (second + np.einsum("f,fki,fkj->ij", volumes, corners, corners)) / 120
    if volume == 0:
        return 0.0, middle, np.zeros((3, 3))
    com = first / volume
    second = math.copysign(density, volume) * (second - volume * np.outer(com, com))
    return density * abs(float(volume)), middle + com, np.trace(second) * np.eye(3) - second
