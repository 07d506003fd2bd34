"""Singular curves of a workspace."""

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

MAX_CURVE_STROKES = 3  # strokes up to which curves are computed
_MAX_GAP_SHARE = 0.1  # distance of two neighbours on a curve, per extent of the section

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
    if len(kinematics.strokes) > MAX_CURVE_STROKES:
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
    lines = join_polylines(patch, branch_edges)
    curves = [curve for line in lines for curve in _split_curve("branch", kinematics, line)]
    if patch.stroke_pair[0] == patch.stroke_pair[1]:
        return curves
    lines = join_polylines(patch, _tip_singular_edges(kinematics, patch))
    return curves + [curve for line in lines for curve in _split_curve("tip", kinematics, line)]


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
        configurations, signs = (
            [patch.configurations[one], patch.configurations[two]],
            [values[one], values[two]],
        )
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
    """Crossings by edges of the grid."""
    a, b = patch.is_closed.shape
    crossings: dict[GridEdge, Array] = {}
    for i, j, side in itertools.product(range(a), range(b), (0, 1)):
        neighbour = (i + 1, j) if side == 0 else (i, j + 1)
        if (
            neighbour[0] < a
            and neighbour[1] < b
            and (q := crossing((i, j), neighbour)) is not None
        ):
            crossings[i, j, side] = q
    return crossings


def cell_edges(i: int, j: int) -> list[GridEdge]:
    """Edges of a cell, from its corners (i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)."""
    return [(i, j, 0), (i + 1, j, 1), (i, j + 1, 0), (i, j, 1)]


def join_polylines(patch: WorkspacePatch, points: dict[GridEdge, Array]) -> list[Array]:
    """Polylines (k, nq) of points (nq,) on edges, joined within cells."""
    a, b = patch.is_closed.shape
    links: dict[GridEdge, list[GridEdge]] = {key: [] for key in points}
    for i, j in itertools.product(range(a - 1), range(b - 1)):
        cell_crossings = [key for key in cell_edges(i, j) if key in points]
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
    jump_indices = np.flatnonzero(distances > _MAX_GAP_SHARE * kinematics.extent) + 1
    rows = np.split(np.arange(len(q)), jump_indices)
    active = kinematics.machine.closure.active
    return [SingularCurve(kind, q[k][:, active], tips[k], section_positions[k]) for k in rows]
