"""Singular curves of a workspace."""

import itertools
from collections.abc import Callable

import numpy as np

from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.workspaces.patch import Node, Patch, last_closed
from crane.motion.workspaces.probe import Probe
from crane.motion.workspaces.result import Curve

MOST = 3  # strokes for which there are curves
_JUMP = 0.1  # share of the section's extent that two neighbours on a curve are not apart

Edge = tuple[int, int, int]  # node, and whether it goes on along the first or the second axis


def singular_curves(
    probe: Probe, patches: list[Patch], edges: list[dict[Edge, Array]], ends: tuple[Array, Array]
) -> list[Curve]:
    """Singular curves on patches that are faces of the box, or all of it; up to three strokes.

    Args:
        probe: The machine and the section.
        patches: The patches.
        edges: Where the branch ends in each of them, see `branch_edges`.
        ends: Limits (n,) of the active coordinates.
    """
    if len(probe.strokes) > MOST:
        return []
    found: list[Curve] = []
    low, high = ends
    for patch, here in zip(patches, edges, strict=True):
        others = [i for i in probe.strokes if i not in patch.pair]
        if all(patch.base[i] in (low[i], high[i]) for i in others):
            found += curves_of(probe, patch, here)
    return found


def curves_of(probe: Probe, patch: Patch, edges: dict[Edge, Array]) -> list[Curve]:
    """Where the branch ends ("branch"), and where both strokes move the tip one way ("tip")."""
    if not patch.closed.any():
        return []
    lines = polylines(patch, edges)
    found = [curve for line in lines for curve in _curves("branch", probe, line)]
    if patch.pair[0] == patch.pair[1]:
        return found
    lines = polylines(patch, _tip_singular(probe, patch))
    return found + [curve for line in lines for curve in _curves("tip", probe, line)]


def branch_edges(machine: Machine, patch: Patch) -> dict[Edge, Array]:
    """Postures (nq,) where the branch ends, by edges of the grid."""

    def crossing(one: Node, two: Node) -> Array | None:
        if patch.closed[one] == patch.closed[two]:
            return None
        inside, outside = (one, two) if patch.closed[one] else (two, one)
        return last_closed(machine, patch.q[inside], patch.target(outside))[0]

    return _crossings(patch, crossing)


def _tip_singular(probe: Probe, patch: Patch) -> dict[Edge, Array]:
    """Postures (nq,) where the determinant of d(u, w) by the strokes changes its sign."""
    active = probe.machine.closure.active
    values = np.zeros(patch.closed.shape)
    values[patch.closed] = probe.determinant(patch.pair, patch.q[patch.closed])
    size, above = np.abs(values).max(), values >= 0

    def crossing(one: Node, two: Node) -> Array | None:
        if not (patch.closed[one] and patch.closed[two]) or above[one] == above[two]:
            return None
        ends, signs = [patch.q[one], patch.q[two]], [values[one], values[two]]
        for k in range(60):  # halving and false position by turns
            from_a, to_a = (q[active] for q in ends)
            share = 0.5 if k % 2 else np.clip(signs[0] / (signs[0] - signs[1]), 0.01, 0.99)
            middle, able = last_closed(probe.machine, ends[0], from_a + share * (to_a - from_a))
            if not able:
                return None
            value = float(probe.determinant(patch.pair, middle[None])[0])
            if abs(value) < 1e-9 * size:
                return None if probe.on_axis(middle) else middle
            side = int((value >= 0) != (signs[0] >= 0))
            ends[side], signs[side] = middle, value
        return None  # a jump: where a distance from an axis turns back

    return _crossings(patch, crossing)


def _crossings(patch: Patch, crossing: Callable[[Node, Node], Array | None]) -> dict[Edge, Array]:
    """What crosses the edges of the grid."""
    a, b = patch.closed.shape
    found: dict[Edge, Array] = {}
    for i, j, side in itertools.product(range(a), range(b), (0, 1)):
        near = (i + 1, j) if side == 0 else (i, j + 1)
        if near[0] < a and near[1] < b and (q := crossing((i, j), near)) is not None:
            found[i, j, side] = q
    return found


def edges_around(i: int, j: int) -> list[Edge]:
    """The edges of a cell, after its corners (i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)."""
    return [(i, j, 0), (i + 1, j, 1), (i, j + 1, 0), (i, j, 1)]


def polylines(patch: Patch, points: dict[Edge, Array]) -> list[Array]:
    """Points (nq,) on edges joined within cells, then end to end, to lines (k, nq)."""
    a, b = patch.closed.shape
    links: dict[Edge, list[Edge]] = {key: [] for key in points}
    for i, j in itertools.product(range(a - 1), range(b - 1)):
        there = [key for key in edges_around(i, j) if key in points]
        for one, two in zip(there[::2], there[1::2], strict=False):
            links[one].append(two)
            links[two].append(one)
    lines, left = [], dict.fromkeys(points)
    while left:
        ends = [key for key in left if len([k for k in links[key] if k in left]) < 2]
        line = [ends[0] if ends else next(iter(left))]
        del left[line[0]]
        while following := [key for key in links[line[-1]] if key in left]:
            line.append(following[0])
            del left[following[0]]
        if not ends and line[0] in links[line[-1]] and len(line) > 2:
            line.append(line[0])
        lines.append(np.array([points[key] for key in line]))
    return lines


def _curves(kind: str, probe: Probe, q: Array) -> list[Curve]:
    """A line of postures (k, nq), cut where the tip jumps: past a posture that turns it freely."""
    tips = probe.tips(q)
    places = probe.section.coordinates(tips)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    cuts = np.flatnonzero(steps > _JUMP * probe.extent) + 1
    rows = np.split(np.arange(len(q)), cuts)
    active = probe.machine.closure.active
    return [Curve(kind, q[k][:, active], tips[k], places[k]) for k in rows]
