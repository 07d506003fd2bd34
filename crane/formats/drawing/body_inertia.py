"""Inertias of bodies that are given by plates, tubes, or a mass and points.

The plane of the drawing is x, z; y points across.
"""

import numpy as np
import pinocchio as pin

from crane.common.samples import Array

_FLATNESS_TOLERANCE = 1e-6  # extent of points that counts as none, by the largest or by 1 mm


def polygon_moments(outline: Array) -> tuple[float, Array, Array]:
    """Return area, centroid (2,) and central second moments (2, 2) of a polygon (n, 2).

    With a_i = x_i z_i+1 - x_i+1 z_i, by Green's theorem: A = sum a_i / 2,
    c = sum (p_i + p_i+1) a_i / (6 A), and the integral of p p^T
    sum a_i (2 p_i p_i^T + 2 p_i+1 p_i+1^T + p_i p_i+1^T + p_i+1 p_i^T) / 24.
    """
    first = outline - outline[0]  # small numbers, whatever the origin
    second = np.roll(first, -1, axis=0)
    cross = first[:, 0] * second[:, 1] - second[:, 0] * first[:, 1]
    area = cross.sum() / 2
    centroid = (first + second).T @ cross / (6 * area or 1.0)  # a line has none: its first point
    products = np.einsum("k,ki,kj->ij", cross, first, second)
    squares = np.einsum("k,ki,kj->ij", cross, first, first)
    squares += np.einsum("k,ki,kj->ij", cross, second, second)
    moments = (2 * squares + products + products.T) / 24 - area * np.outer(centroid, centroid)
    sign = np.sign(area)
    return abs(area), centroid + outline[0], sign * moments


def plate_inertia(outline: Array, thickness: float, y: float, density: float) -> pin.Inertia:
    """Return the inertia of a plate (n, 3) in the plane x, z, centred at y."""
    area, centroid, moments = polygon_moments(outline[:, [0, 2]])
    mass, second_moments = density * area * thickness, np.zeros((3, 3))
    second_moments[np.ix_([0, 2], [0, 2])] = density * thickness * moments
    second_moments[1, 1] = mass * thickness**2 / 12
    return inertia_from_moments(mass, np.array([centroid[0], y, centroid[1]]), second_moments)


def bar_axes(ends: Array) -> tuple[float, Array, Array, Array]:
    """Return length [m] and direction of a bar, and the axes of its width and of its height."""
    axis = ends[1] - ends[0]
    length = float(np.linalg.norm(axis))
    direction = axis / length
    side = np.array([0.0, 1.0, 0.0])
    if abs(direction[1]) > 0.9:
        side = np.array([1.0, 0.0, 0.0])
    side -= (side @ direction) * direction
    side /= np.linalg.norm(side)
    return length, direction, side, np.cross(direction, side)


def tube_inertia(
    ends: Array, height: float, width: float | None, wall: float | None, density: float
) -> pin.Inertia:
    """Return the inertia of a tube or bar between two points (2, 3).

    Args:
        ends: (2, 3) centres of its end faces [m].
        height: Outer height in the plane of the drawing, or diameter [m].
        width: Outer width across it [m]; None: a round tube.
        wall: Thickness of the wall [m]; None: solid.
        density: [kg/m3].
    """
    length, direction, side, up = bar_axes(ends)
    is_round, outer = width is None, np.array([height, height if width is None else width])
    inner = np.zeros(2) if wall is None else np.maximum(outer - 2 * wall, 0.0)
    shape, divisor = (np.pi / 4, 16.0) if is_round else (1.0, 12.0)
    masses = density * length * shape * np.array([outer.prod(), inner.prod()])
    mass = masses[0] - masses[1]
    across, along = (masses[0] * outer**2 - masses[1] * inner**2) / divisor, mass * length**2 / 12
    second_moments = sum(
        moment * np.outer(x, x)
        for moment, x in ((along, direction), (across[0], up), (across[1], side))
    )
    return inertia_from_moments(mass, ends.mean(axis=0), np.asarray(second_moments))


def spread_inertia(mass: float, points: Array, width: float) -> pin.Inertia:
    """Return the inertia of a mass spread over points (n, 3), and a width across.

    It is a thin rod if the points are in a line, a plate if they are in a plane, with their convex
    hull as outline; else the plate of their projection to the plane x, z, and spread over their
    extent across.
    """
    from scipy.spatial import ConvexHull

    mean = points.mean(axis=0)
    values, axes = np.linalg.eigh((points - mean).T @ (points - mean))
    is_flat, is_line = values[:2] <= _FLATNESS_TOLERANCE**2 * max(values[2], 1e-6)
    if not is_flat:
        projected = np.column_stack([points[:, 0], np.full(len(points), mean[1]), points[:, 2]])
        return spread_inertia(mass, projected, float(np.hypot(width, np.ptp(points[:, 1]))))
    plane = axes[:, 1:].T
    flat = (points - mean) @ plane.T
    if is_line:
        centre = mean + (flat[:, 1].min() + flat[:, 1].max()) / 2 * plane[1]
        moments = mass * np.ptp(flat[:, 1]) ** 2 / 12 * np.outer(plane[1], plane[1])
    else:
        area, centroid, planar = polygon_moments(flat[ConvexHull(flat).vertices])
        centre = mean + centroid @ plane
        moments = mass / area * plane.T @ planar @ plane
    moments[1, 1] += mass * width**2 / 12
    return inertia_from_moments(mass, centre, moments)


def scale_inertia(body: pin.Inertia, mass: float) -> pin.Inertia:
    """Return the inertia of the same shape with another mass."""
    return rigid_inertia(mass, body.lever, body.inertia * (mass / body.mass))


def inertia_from_moments(mass: float, centre: Array, second_moments: Array) -> pin.Inertia:
    """Return the inertia I = tr(S) 1 - S of central second moments S (3, 3) of mass."""
    return rigid_inertia(mass, centre, np.trace(second_moments) * np.eye(3) - second_moments)


def rigid_inertia(mass: float, centre: Array, tensor: Array) -> pin.Inertia:
    """Return an inertia without a check, which the reader of links makes with names."""
    found = pin.Inertia(float(mass), np.asarray(centre, dtype=np.float64), np.zeros((3, 3)))
    if np.isfinite(tensor).all():  # else a number has been refused
        found.inertia = (tensor + tensor.T) / 2
    return found
