"""Triangles of the section that the patches of a workspace cover."""

import numpy as np

from crane.common.samples import Array
from crane.motion.workspaces.singular_curves import MAX_CURVE_STROKES, GridEdge, cell_edges
from crane.motion.workspaces.workspace_patch import (
    GridNode,
    WorkspacePatch,
    last_closed_configuration,
)
from crane.motion.workspaces.workspace_section import WorkspaceKinematics

_MAX_SIDE_STEPS = 4.0  # longest side of a fine cell, per extent and step of the grid
# of a coarse cell; in one of many random patches
_MAX_SUBDIVISIONS, _REDUCED_SUBDIVISIONS = 6, 2

CellCorner = tuple[Array, Array]  # configuration (nq,), section position (2,)


def covered_triangles(
    kinematics: WorkspaceKinematics,
    patch: WorkspacePatch,
    positions: Array,
    branch_edges: dict[GridEdge, Array],
) -> Array:
    """Triangles (N, 3, 2) that a patch covers: its cells, cut at the ends of the branch.

    Long cells are subdivided: near configurations where passive joints can turn freely, small
    strokes turn them far. Cells that remain long are omitted.

    Args:
        kinematics: The machine and the section.
        patch: The patch.
        positions: (N, 2) section positions of its closed nodes [m].
        branch_edges: Ends of the branch, see `branch_edges`.
    """
    count = min(len(axis) for axis in patch.axes)
    if count < 2 or not patch.is_closed.any():
        return np.empty((0, 3, 2))
    max_side = _MAX_SIDE_STEPS * kinematics.extent / (count - 1)
    nodes = np.full((*patch.is_closed.shape, 2), np.nan)
    nodes[patch.is_closed] = positions
    corner_slices = ((slice(-1), slice(-1)), (slice(1, None), slice(-1)),
              (slice(1, None), slice(1, None)), (slice(-1), slice(1, None)))  # fmt: skip
    corners = np.stack([nodes[i, j] for i, j in corner_slices], axis=2)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=2), axis=3).max(axis=2)
    fine_cells = corners[sides <= max_side]  # all closed
    out = [fine_cells[:, [0, 1, 2]], fine_cells[:, [0, 2, 3]]]
    for i, j in np.argwhere(sides > max_side):
        cell = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        ring = [(patch.configurations[node], nodes[node]) for node in cell]
        subdivisions = (
            _MAX_SUBDIVISIONS
            if len(kinematics.strokes) <= MAX_CURVE_STROKES
            else _REDUCED_SUBDIVISIONS
        )
        out.append(
            np.array(_subdivide_cell(kinematics, ring, max_side, subdivisions)).reshape(-1, 3, 2)
        )
    if branch_edges:
        edge_positions = kinematics.section.coordinates(
            kinematics.tip_positions(np.array(list(branch_edges.values())))
        )
        out.append(
            _boundary_cell_triangles(
                patch, nodes, dict(zip(branch_edges, edge_positions, strict=True)), max_side
            )
        )
    return np.concatenate(out)


def _has_long_side(polygon: list[Array], max_side: float) -> bool:
    return any(
        float(np.linalg.norm(start - end)) > max_side
        for start, end in zip(polygon, [*polygon[1:], polygon[0]], strict=True)
    )


def _subdivide_cell(
    kinematics: WorkspaceKinematics, polygon: list[CellCorner], max_side: float, subdivisions: int
) -> list[list[Array]]:
    """Triangles of a cell with corners (i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)."""
    positions = [position for _, position in polygon]
    if not _has_long_side(positions, max_side):
        return [
            [positions[0], positions[1], positions[2]],
            [positions[0], positions[2], positions[3]],
        ]
    if subdivisions == 0:
        return []
    active = kinematics.machine.closure.active

    def midpoint(*corners: CellCorner) -> CellCorner | None:
        target = np.mean([q[active] for q, _ in corners], axis=0)
        q, is_closed = last_closed_configuration(kinematics.machine, corners[0][0], target)
        if not is_closed:
            return None
        return q, kinematics.section.coordinates(kinematics.tip_positions(q[None]))[0]

    sides = [midpoint(polygon[k], polygon[(k + 1) % 4]) for k in range(4)]
    centre = midpoint(*polygon)
    out: list[list[Array]] = []
    for k in range(4):
        optional_corners = [polygon[k], sides[k], centre, sides[k - 1]]
        cell_corners = [corner for corner in optional_corners if corner is not None]
        if len(cell_corners) == 4:
            out += _subdivide_cell(kinematics, cell_corners, max_side, subdivisions - 1)
    return out


def _closed_polygon(
    patch: WorkspacePatch, corners: Array, edge_positions: dict[GridEdge, Array], cell: GridNode
) -> list[Array]:
    """Section positions (2,) around the closed part of a cell: corners and ends of the branch."""
    i, j = cell
    polygon = []
    nodes = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
    for node, edge in zip(nodes, cell_edges(i, j), strict=True):
        if patch.is_closed[node]:
            polygon.append(corners[node])
        if edge in edge_positions:
            polygon.append(edge_positions[edge])
    return polygon


def _boundary_cell_triangles(
    patch: WorkspacePatch, corners: Array, edge_positions: dict[GridEdge, Array], max_side: float
) -> Array:
    """Triangle fans (N, 3, 2) over the closed parts of cells with open corners."""
    out = []
    cells = {
        (i - di, j - dj)
        for i, j, side in edge_positions
        for di, dj in ((0, 0), ((0, 1) if side == 0 else (1, 0)))
    }
    a, b = patch.is_closed.shape
    for i, j in sorted(cells):
        if not (0 <= i < a - 1 and 0 <= j < b - 1):
            continue
        polygon = _closed_polygon(patch, corners, edge_positions, (i, j))
        if not _has_long_side(polygon, 2 * max_side):
            out += [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]
    return np.array(out).reshape(-1, 3, 2)
