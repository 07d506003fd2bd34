"""What patches cover in the section."""

import numpy as np

from crane.common.samples import Array
from crane.motion.workspaces.curves import MOST, Edge, edges_around
from crane.motion.workspaces.patch import Node, Patch, last_closed
from crane.motion.workspaces.probe import Probe

_LONGEST = 4.0  # side of a cell that is fine, in shares of the extent per step of the grid
_HALVINGS, _FEW = 6, 2  # of a cell that is not, and where the patch is one of many that are drawn

Corner = tuple[Array, Array]  # posture (nq,), place (2,)


def triangles(probe: Probe, patch: Patch, places: Array, edges: dict[Edge, Array]) -> Array:
    """Triangles (N, 3, 2) that a patch covers: its cells, cut where the branch ends.

    Cells that become long are divided: beside a posture where the passive joints may turn freely,
    a short way of the strokes turns them by much. What stays long is left out.

    Args:
        probe: The machine and the section.
        patch: The patch.
        places: (N, 2) of its closed nodes [m].
        edges: Where its branch ends, see `branch_edges`.
    """
    count = min(len(axis) for axis in patch.axes)
    if count < 2 or not patch.closed.any():
        return np.empty((0, 3, 2))
    longest = _LONGEST * probe.extent / (count - 1)
    nodes = np.full((*patch.closed.shape, 2), np.nan)
    nodes[patch.closed] = places
    around = ((slice(-1), slice(-1)), (slice(1, None), slice(-1)),
              (slice(1, None), slice(1, None)), (slice(-1), slice(1, None)))  # fmt: skip
    corners = np.stack([nodes[i, j] for i, j in around], axis=2)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=2), axis=3).max(axis=2)
    fine = corners[sides <= longest]  # all closed
    out = [fine[:, [0, 1, 2]], fine[:, [0, 2, 3]]]
    for i, j in np.argwhere(sides > longest):
        cell = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        ring = [(patch.q[node], nodes[node]) for node in cell]
        halvings = _HALVINGS if len(probe.strokes) <= MOST else _FEW
        out.append(np.array(_divided(probe, ring, longest, halvings)).reshape(-1, 3, 2))
    if edges:
        ends = probe.section.coordinates(probe.tips(np.array(list(edges.values()))))
        out.append(_cut_cells(patch, nodes, dict(zip(edges, ends, strict=True)), longest))
    return np.concatenate(out)


def _long(ring: list[Array], longest: float) -> bool:
    return any(
        float(np.linalg.norm(one - two)) > longest
        for one, two in zip(ring, [*ring[1:], ring[0]], strict=True)
    )


def _divided(probe: Probe, ring: list[Corner], longest: float, halvings: int) -> list[list[Array]]:
    """Triangles of a cell with corners (i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)."""
    at = [place for _, place in ring]
    if not _long(at, longest):
        return [[at[0], at[1], at[2]], [at[0], at[2], at[3]]]
    if halvings == 0:
        return []
    active = probe.machine.closure.active

    def middle(*corners: Corner) -> Corner | None:
        target = np.mean([q[active] for q, _ in corners], axis=0)
        q, able = last_closed(probe.machine, corners[0][0], target)
        if not able:
            return None
        return q, probe.section.coordinates(probe.tips(q[None]))[0]

    sides = [middle(ring[k], ring[(k + 1) % 4]) for k in range(4)]
    centre = middle(*ring)
    out: list[list[Array]] = []
    for k in range(4):
        parts = [ring[k], sides[k], centre, sides[k - 1]]
        part = [corner for corner in parts if corner is not None]
        if len(part) == 4:
            out += _divided(probe, part, longest, halvings - 1)
    return out


def _closed_part(patch: Patch, corners: Array, ends: dict[Edge, Array], cell: Node) -> list[Array]:
    """Places (2,) around the closed part of a cell: closed corners, and ends of the branch."""
    i, j = cell
    ring = []
    nodes = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
    for node, edge in zip(nodes, edges_around(i, j), strict=True):
        if patch.closed[node]:
            ring.append(corners[node])
        if edge in ends:
            ring.append(ends[edge])
    return ring


def _cut_cells(patch: Patch, corners: Array, ends: dict[Edge, Array], longest: float) -> Array:
    """Fans of triangles (N, 3, 2) over the closed parts of cells with open corners."""
    out = []
    cells = {
        (i - di, j - dj)
        for i, j, side in ends
        for di, dj in ((0, 0), ((0, 1) if side == 0 else (1, 0)))
    }
    a, b = patch.closed.shape
    for i, j in sorted(cells):
        if not (0 <= i < a - 1 and 0 <= j < b - 1):
            continue
        ring = _closed_part(patch, corners, ends, (i, j))
        if not _long(ring, 2 * longest):
            out += [[ring[0], ring[k], ring[k + 1]] for k in range(1, len(ring) - 1)]
    return np.array(out).reshape(-1, 3, 2)
