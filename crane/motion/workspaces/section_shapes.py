"""Singular curves in the section of a workspace, and triangles that its patches cover."""

import itertools
from collections.abc import Callable

import numpy as np

from crane.common.samples import Array
from crane.machine.machine import Machine
from crane.motion.workspaces.workspace_patch import (
    GridNode,
    WorkspacePatch,
    last_closed_configuration,
)
from crane.motion.workspaces.workspace_result import SingularCurve
from crane.motion.workspaces.workspace_section import WorkspaceKinematics

_MAX_CURVE_STROKES = 3  # strokes up to which curves are computed
_MAX_GAP_SHARE = 0.1  # distance of two neighbours on a curve, per extent of the section

_MAX_SIDE_STEPS = 4.0  # longest side of a fine cell, per extent and step of the grid
# of a coarse cell; in one of many random patches
_MAX_SUBDIVISIONS, _REDUCED_SUBDIVISIONS = 6, 2

CellCorner = tuple[Array, Array]  # configuration (nq,), section position (2,)
GridEdge = tuple[int, int, int]  # node (i, j), and the axis of the edge


def singular_curves(
    kinematics: WorkspaceKinematics,
    patches: list[WorkspacePatch],
    edges_by_patch: list[dict[GridEdge, Array]],
    limits: tuple[Array, Array],
) -> list[SingularCurve]:
    """Singular curves on patches that are faces of the box of strokes, for up to three strokes.

    Args:
        kinematics: The machine and the section.
        patches: The patches.
        edges_by_patch: Ends of the branch in each of them, see `branch_edges`.
        limits: Limits (n,) of the active coordinates.
    """
    if len(kinematics.strokes) > _MAX_CURVE_STROKES:
        return []
    curves: list[SingularCurve] = []
    lower, upper = limits
    for patch, patch_edges in zip(patches, edges_by_patch, strict=True):
        others = [i for i in kinematics.strokes if i not in patch.stroke_pair]
        if all(patch.held_coordinates[i] in (lower[i], upper[i]) for i in others):
            curves += patch_curves(kinematics, patch, patch_edges)
    return curves


def patch_curves(
    kinematics: WorkspaceKinematics, patch: WorkspacePatch, branch_edges: dict[GridEdge, Array]
) -> list[SingularCurve]:
    """Singular curves of a patch: ends of the branch ("branch"), and of the tip ("tip")."""
    if not patch.is_closed.any():
        return []
    edges_by_kind = {"branch": branch_edges}
    if patch.stroke_pair[0] != patch.stroke_pair[1]:
        edges_by_kind["tip"] = _tip_singular_edges(kinematics, patch)
    return [
        curve
        for kind, edges in edges_by_kind.items()
        for line in _join_polylines(patch, edges)
        for curve in _split_curve(kind, kinematics, line)
    ]


def branch_edges(machine: Machine, patch: WorkspacePatch) -> dict[GridEdge, Array]:
    """Configurations (nq,) at the ends of the branch, by edges of the grid."""

    def branch_end(one: GridNode, two: GridNode) -> Array | None:
        if patch.is_closed[one] == patch.is_closed[two]:
            return None
        inside, outside = (one, two) if patch.is_closed[one] else (two, one)
        return last_closed_configuration(
            machine, patch.configurations[inside], patch.active_coordinates(outside)
        )[0]

    return _find_crossings(patch, branch_end)


def _tip_singular_edges(
    kinematics: WorkspaceKinematics, patch: WorkspacePatch
) -> dict[GridEdge, Array]:
    """Configurations (nq,) at sign changes of the determinant of d(u, w) by the strokes."""
    active = kinematics.machine.closure.active
    values = np.zeros(patch.is_closed.shape)
    values[patch.is_closed] = kinematics.tip_determinant(
        patch.stroke_pair, patch.configurations[patch.is_closed]
    )
    size, is_nonnegative = np.abs(values).max(), values >= 0

    def sign_change(one: GridNode, two: GridNode) -> Array | None:
        if (
            not (patch.is_closed[one] and patch.is_closed[two])
            or is_nonnegative[one] == is_nonnegative[two]
        ):
            return None
        configurations = [patch.configurations[one], patch.configurations[two]]
        signs = [values[one], values[two]]
        for k in range(60):  # bisection and false position in turn
            start_strokes, end_strokes = (q[active] for q in configurations)
            share = 0.5 if k % 2 else np.clip(signs[0] / (signs[0] - signs[1]), 0.01, 0.99)
            midpoint, is_closed = last_closed_configuration(
                kinematics.machine,
                configurations[0],
                start_strokes + share * (end_strokes - start_strokes),
            )
            if not is_closed:
                return None
            value = float(kinematics.tip_determinant(patch.stroke_pair, midpoint[None])[0])
            if abs(value) < 1e-9 * size:
                return None if kinematics.is_on_axis(midpoint) else midpoint
            side = int((value >= 0) != (signs[0] >= 0))
            configurations[side], signs[side] = midpoint, value
        return None  # a jump, where the distance from an axis reverses

    return _find_crossings(patch, sign_change)


def _find_crossings(
    patch: WorkspacePatch, crossing: Callable[[GridNode, GridNode], Array | None]
) -> dict[GridEdge, Array]:
    a, b = patch.is_closed.shape
    crossings: dict[GridEdge, Array] = {}
    for i, j, side in itertools.product(range(a), range(b), (0, 1)):
        neighbour = (i + 1, j) if side == 0 else (i, j + 1)
        is_inside = neighbour[0] < a and neighbour[1] < b
        if is_inside and (q := crossing((i, j), neighbour)) is not None:
            crossings[i, j, side] = q
    return crossings


def _cell_edges(i: int, j: int) -> list[GridEdge]:
    """Edges of a cell, from its corners (i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)."""
    return [(i, j, 0), (i + 1, j, 1), (i, j + 1, 0), (i, j, 1)]


def _join_polylines(patch: WorkspacePatch, points: dict[GridEdge, Array]) -> list[Array]:
    """Polylines (k, nq) of points (nq,) on edges, joined within cells."""
    a, b = patch.is_closed.shape
    links: dict[GridEdge, list[GridEdge]] = {key: [] for key in points}
    for i, j in itertools.product(range(a - 1), range(b - 1)):
        cell_crossings = [key for key in _cell_edges(i, j) if key in points]
        for first, second in zip(cell_crossings[::2], cell_crossings[1::2], strict=False):
            links[first].append(second)
            links[second].append(first)
    lines, remaining = [], dict.fromkeys(points)
    while remaining:
        open_ends = [
            key for key in remaining if len([k for k in links[key] if k in remaining]) < 2
        ]
        line = [open_ends[0] if open_ends else next(iter(remaining))]
        del remaining[line[0]]
        while next_edges := [key for key in links[line[-1]] if key in remaining]:
            line.append(next_edges[0])
            del remaining[next_edges[0]]
        if not open_ends and line[0] in links[line[-1]] and len(line) > 2:
            line.append(line[0])
        lines.append(np.array([points[key] for key in line]))
    return lines


def _split_curve(kind: str, kinematics: WorkspaceKinematics, q: Array) -> list[SingularCurve]:
    """Curves of a polyline of configurations (k, nq), cut where the tip jumps."""
    tips = kinematics.tip_positions(q)
    section_positions = kinematics.section.coordinates(tips)
    distances = np.linalg.norm(np.diff(section_positions, axis=0), axis=1)
    rows = np.split(
        np.arange(len(q)), np.flatnonzero(distances > _MAX_GAP_SHARE * kinematics.extent) + 1
    )
    active = kinematics.machine.closure.active
    return [SingularCurve(kind, q[k][:, active], tips[k], section_positions[k]) for k in rows]


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
        is_reduced = len(kinematics.strokes) > _MAX_CURVE_STROKES
        subdivisions = _REDUCED_SUBDIVISIONS if is_reduced else _MAX_SUBDIVISIONS
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

    def midpoint(*corners: CellCorner) -> CellCorner | None:
        target = np.mean([q for q, _ in corners], axis=0)[kinematics.machine.closure.active]
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
        polygon = []  # closed corners and ends of the branch
        nodes = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
        for node, edge in zip(nodes, _cell_edges(i, j), strict=True):
            polygon += [corners[node]] if patch.is_closed[node] else []
            polygon += [edge_positions[edge]] if edge in edge_positions else []
        if not _has_long_side(polygon, 2 * max_side):
            out += [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]
    return np.array(out).reshape(-1, 3, 2)
