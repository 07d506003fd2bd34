"""Points of a grid that lie within a patch of a workspace."""

import numpy as np
from numpy.typing import NDArray

from crane.common.samples import Array
from crane.motion.workspaces.workspace_patch import WorkspacePatch

_EXTRAPOLATION_SHARE = 0.5  # of a triangle, by which triangles at a patch's border are extended
_TRIANGLE_TOLERANCE = 1e-9  # share of a triangle


def grid_points_in_patch(
    patch: WorkspacePatch, node_positions: Array, axes: tuple[Array, Array]
) -> tuple[NDArray[np.intp], Array]:
    """Find the points of a grid within a patch, and configurations close to them.

    Each cell of the patch is split into two triangles, within which configurations are
    interpolated. Triangles at the border of the patch and at folds are extended, because there
    the patch ends, or turns back, in a curve.

    Args:
        patch: The patch.
        node_positions: (a, b, 2) positions of its nodes in the section [m]; NaN where open.
        axes: Coordinates of the grid [m].

    Returns:
        (M,) indices of points, the first coordinate fastest, and (M, nq) configurations.
    """
    corner_slices = ((slice(-1), slice(-1)), (slice(1, None), slice(-1)),
              (slice(1, None), slice(1, None)), (slice(-1), slice(1, None)))  # fmt: skip
    is_closed_cell = np.stack([patch.is_closed[x] for x in corner_slices]).all(axis=0)
    padded = np.pad(is_closed_cell, 1)
    is_inner_cell = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    is_inner_cell &= _is_unfolded_cell(node_positions)
    corners = np.stack([node_positions[x] for x in corner_slices], axis=2)[is_closed_cell]
    configurations = np.stack([patch.configurations[x] for x in corner_slices], axis=2)[
        is_closed_cell
    ]
    extrapolation_shares = np.where(
        is_inner_cell[is_closed_cell], _TRIANGLE_TOLERANCE, _EXTRAPOLATION_SHARE
    )
    triangle_corners = [[0, 1, 2], [0, 2, 3]]
    corners, configurations = (
        x[:, triangle_corners].reshape(-1, 3, x.shape[-1]) for x in (corners, configurations)
    )
    return _grid_points_in_triangles(
        corners, configurations, np.repeat(extrapolation_shares, 2), axes
    )


def _is_unfolded_cell(node_positions: Array) -> NDArray[np.bool_]:
    """Return which cells (a - 1, b - 1) have the orientation of their neighbours: no fold."""
    first = (node_positions[1:] - node_positions[:-1])[:, :-1]
    second = (node_positions[:, 1:] - node_positions[:, :-1])[:-1]
    orientations = np.sign(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
    padded = np.pad(orientations, 1, mode="edge")
    neighbours = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
    return np.all([orientations == x for x in neighbours], axis=0)


def _grid_points_in_triangles(
    corners: Array, configurations: Array, extrapolation_shares: Array, axes: tuple[Array, Array]
) -> tuple[NDArray[np.intp], Array]:
    """Return the points of a grid within triangles (T, 3, 2), and interpolated configurations."""
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    margin = extrapolation_shares[:, None] * (upper - lower)
    first_indices = [np.searchsorted(x, lower[:, k] - margin[:, k]) for k, x in enumerate(axes)]
    last_indices = [
        np.searchsorted(x, upper[:, k] + margin[:, k], "right") for k, x in enumerate(axes)
    ]
    point_counts = [b - a for a, b in zip(first_indices, last_indices, strict=True)]
    points_per_triangle = point_counts[0] * point_counts[1]
    triangle_indices = np.repeat(np.arange(len(corners)), points_per_triangle)
    k = np.arange(len(triangle_indices)) - np.repeat(
        np.cumsum(points_per_triangle) - points_per_triangle, points_per_triangle
    )
    i, j = (
        first_indices[0][triangle_indices] + k % point_counts[0][triangle_indices],
        first_indices[1][triangle_indices] + k // point_counts[0][triangle_indices],
    )
    point = np.column_stack([axes[0][i], axes[1][j]])
    first_edges, second_edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = first_edges[:, 0] * second_edges[:, 1] - first_edges[:, 1] * second_edges[:, 0]
    offsets = point - corners[triangle_indices, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        second_weight = (
            offsets[:, 0] * second_edges[triangle_indices, 1]
            - offsets[:, 1] * second_edges[triangle_indices, 0]
        ) / area[triangle_indices]
        third_weight = (
            first_edges[triangle_indices, 0] * offsets[:, 1]
            - first_edges[triangle_indices, 1] * offsets[:, 0]
        ) / area[triangle_indices]
    barycentric_weights = np.column_stack(
        [1.0 - second_weight - third_weight, second_weight, third_weight]
    )
    is_inside = (barycentric_weights >= -extrapolation_shares[triangle_indices, None]).all(axis=1)
    triangle_indices, barycentric_weights = (
        triangle_indices[is_inside],
        barycentric_weights[is_inside],
    )
    q = np.einsum("tk,tkq->tq", barycentric_weights, configurations[triangle_indices])
    return np.asarray(j[is_inside] * len(axes[0]) + i[is_inside]), q
