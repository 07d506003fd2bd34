"""Mass and inertia of shapes of SDF filled with one density."""

import math

import numpy as np
import pinocchio as pin

from crane.common.package_search import find_file
from crane.common.samples import Array
from crane.formats.sdf.sdf_element import SdfElement
from crane.formats.visuals.mesh_files import read_meshes

_SOLID_TYPES = ("box", "capsule", "cone", "cylinder", "ellipsoid", "mesh", "sphere")


def solid_inertia(shape: SdfElement, density: float) -> pin.Inertia:
    """The body of a `<collision>` filled with a density [kg/m3], in the frame of its geometry.

    Raises:
        DescriptionError: It has no volume that is known: another shape, or a mesh that is not
            closed or cannot be read.
    """
    geometry = shape.single_child("geometry")
    tags = [] if geometry is None else [x.tag for x in geometry.element if isinstance(x.tag, str)]
    solid_element = geometry.single_child(tags[0]) if geometry is not None and tags else None
    if solid_element is None or tags[0] not in _SOLID_TYPES:
        raise _unknown_volume_error(shape, f"is no {', '.join(_SOLID_TYPES)}")
    if tags[0] == "mesh":
        return _mesh_inertia(solid_element, density)
    if tags[0] == "box":
        x, y, z = _read_sizes(solid_element, "size", 3)
        return pin.Inertia.FromBox(density * x * y * z, x, y, z)
    if tags[0] in ("ellipsoid", "sphere"):
        radii = _read_sizes(solid_element, "radius", 1) * 3
        if tags[0] == "ellipsoid":
            radii = _read_sizes(solid_element, "radii", 3)
        mass = density * 4 / 3 * math.pi * float(np.prod(radii))
        return pin.Inertia.FromEllipsoid(mass, *radii)
    radius, length = (
        *_read_sizes(solid_element, "radius", 1),
        *_read_sizes(solid_element, "length", 1),
    )
    mass = density * math.pi * radius**2 * length
    if tags[0] == "cylinder":
        return pin.Inertia.FromCylinder(mass, radius, length)
    if tags[0] == "capsule":  # whose length is that between the centres of its balls
        sphere_mass = density * 4 / 3 * math.pi * radius**3
        return pin.Inertia.FromCapsule(mass + sphere_mass, radius, length)
    transverse_factor = (
        3 / 80 * (4 * radius**2 + length**2)
    )  # a cone, whose tip is up and half its length
    moments = mass / 3 * np.diag([transverse_factor, transverse_factor, 0.3 * radius**2])
    return pin.Inertia(mass / 3, np.array([0.0, 0.0, -length / 4]), moments)


def _unknown_volume_error(item: SdfElement, reason: str) -> Exception:
    hint = "write its <mass> and <inertia> instead of auto"
    return item.xml.error_at(
        item.element, f"{item.label} {reason}, so that its volume is unknown: {hint}"
    )


def _read_sizes(element: SdfElement, tag: str, count: int) -> tuple[float, ...]:
    sizes = element.numbers(tag, count, (1.0,) * count)
    if min(sizes) <= 0:
        problem = f"<{tag}> of {element.label} is not positive, give metres"
        raise element.xml.error_at(element.element, problem)
    return sizes


def _mesh_inertia(mesh_element: SdfElement, density: float) -> pin.Inertia:
    name = mesh_element.text("uri") or mesh_element.text("filename")
    if mesh_element.single_child("submesh") is not None:
        raise _unknown_volume_error(mesh_element, f"takes a part of the mesh '{name}'")
    file = find_file(name, mesh_element.xml.file.parent) if name else None
    if file is None or not file.is_file():
        raise _unknown_volume_error(mesh_element, f"has the mesh '{name}', which is not there")
    parts = read_meshes([file])[file]
    if isinstance(parts, str):
        raise _unknown_volume_error(
            mesh_element, f"has the mesh '{name}', which cannot be read ({parts})"
        )
    scale = np.array(mesh_element.numbers("scale", 3, (1.0, 1.0, 1.0)))
    triangles = np.concatenate([part.vertices[part.faces] for part in parts]) * scale
    if edges := _count_open_edges(triangles):
        raise _unknown_volume_error(
            mesh_element, f"has the mesh '{name}', which {edges} edges leave open"
        )
    mass, com, tensor = inertia_of_triangles(triangles, density)
    if not mass > 0:
        raise _unknown_volume_error(mesh_element, f"has the mesh '{name}', which is flat")
    return pin.Inertia(mass, com, tensor)


def _count_open_edges(triangles: Array) -> int:
    """How many edges are not passed as often in one direction as in the other.

    Vertices are the same where they are to nine digits of the size: formats without common
    vertices, such as STL, write each several times.
    """
    points = triangles.reshape(-1, 3)
    grid = float(np.ptp(points, axis=0).max()) * 1e-9 or 1.0
    _, index = np.unique(np.round(points / grid), axis=0, return_inverse=True)
    corners = index.reshape(-1, 3)
    directed_edges = np.concatenate([corners[:, [i, (i + 1) % 3]] for i in range(3)])
    directed_edges = directed_edges[directed_edges[:, 0] != directed_edges[:, 1]]
    sign = np.where(directed_edges[:, 0] < directed_edges[:, 1], 1, -1)
    _, edge = np.unique(np.sort(directed_edges, axis=1), axis=0, return_inverse=True)
    return int(np.count_nonzero(np.bincount(edge.ravel(), weights=sign)))


def inertia_of_triangles(triangles: Array, density: float) -> tuple[float, Array, Array]:
    """Mass, centre (3,) and inertia (3, 3) about it of what closed triangles (F, 3, 3) bound.

    Of the tetrahedron from the origin to a triangle a, b, c, with six times its signed volume
    d = a . (b x c) and s = a + b + c,

        V = d / 6,    int x dV = d s / 24,
        int x x^T dV = d (s s^T + a a^T + b b^T + c c^T) / 120

    and the sum over all is that of the body; negative where the triangles face inwards.
    """
    centroid = triangles.reshape(-1, 3).mean(axis=0)  # near which less is lost to rounding
    corners = triangles - centroid
    volumes = np.linalg.det(corners)
    sums = corners.sum(axis=1)
    volume = volumes.sum() / 6
    first = volumes @ sums / 24
    second = np.einsum("f,fi,fj->ij", volumes, sums, sums)
    second = (second + np.einsum("f,fki,fkj->ij", volumes, corners, corners)) / 120
    if volume == 0:
        return 0.0, centroid, np.zeros((3, 3))
    com = first / volume
    second = math.copysign(density, volume) * (second - volume * np.outer(com, com))
    return density * abs(float(volume)), centroid + com, np.trace(second) * np.eye(3) - second
