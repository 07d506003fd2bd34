"""Patches of a workspace: grids of closed configurations over one or two active coordinates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import ClosureError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.machine.machine import Machine

GridNode = tuple[int, int]
_GRID_DIRECTIONS: tuple[GridNode, ...] = ((1, 0), (-1, 0), (0, 1), (0, -1))

_CONTINUATION_STEPS = 16  # between neighbouring nodes, if one step fails
_MIN_STEP_SHARE = 2.0**-30  # smallest step of a continuation, relative to its path


@dataclass(frozen=True, eq=False, repr=False)
class WorkspacePatch(OneLineRepr):
    """Grid of configurations over two active coordinates (one, if the second axis has one value).

    Attributes:
        stroke_pair: Indices of both coordinates among the active ones.
        held_coordinates: (n,) values of the other coordinates.
        axes: Values of both coordinates, (a,) and (b,).
        is_closed: (a, b) whether the loops close, connected with home along lines of the grid.
        configurations: (a, b, nq) configurations, NaN where the loops do not close.
    """

    stroke_pair: tuple[int, int]
    held_coordinates: Array
    axes: tuple[Array, Array]
    is_closed: NDArray[np.bool_]
    configurations: Array

    def active_coordinates(self, node: GridNode) -> Array:
        """Active coordinates (n,) of a grid node."""
        q_a = self.held_coordinates.copy()
        for joint, axis, k in zip(self.stroke_pair, self.axes, node, strict=True):
            if len(axis) > 1:
                q_a[joint] = axis[k]
        return q_a


def last_closed_configuration(machine: Machine, q: Array, target: Array) -> tuple[Array, bool]:
    """Follow the branch along a straight line in q_A as far as it leads.

    In machine code the continuation ends where an entry of gamma exceeds 1000, at most some 1e-5
    rad or m before the end.

    Args:
        machine: The machine.
        q: (nq,) closed configuration to start from.
        target: (n,) active coordinates.

    Returns:
        The last closed configuration (nq,), and whether it is the target.
    """
    closure = machine.closure
    start = q[closure.active]
    out = np.empty((1, len(q)))
    cursor = closure.compiled_closure.new_cursor() if closure.is_compiled else None
    if cursor is not None and not closure.compiled_closure.start_cursor_at(cursor, q):
        return q, False
    completed_share, step, last_configuration = 0.0, 1.0, q
    while completed_share < 1.0 and step > _MIN_STEP_SHARE:
        target_share = min(1.0, completed_share + step)
        intermediate_target = (
            target if target_share == 1.0 else start + target_share * (target - start)
        )[None]
        if cursor is not None:
            is_closed = (
                closure.compiled_closure.follow_targets(cursor, intermediate_target, out) == 1
            )
        else:
            is_closed = _try_closure(machine, intermediate_target, last_configuration, out)
        if is_closed:
            completed_share, last_configuration = target_share, out[0].copy()
        step = step * 2 if is_closed else step / 2
    return last_configuration, completed_share == 1.0


def _try_closure(machine: Machine, targets: Array, initial_guess: Array, out: Array) -> bool:
    """Close the loops at targets (1, n) into out (1, nq); returns whether they close."""
    try:
        out[0] = machine.closure.solve(targets[0], initial_guess=initial_guess)
    except ClosureError:
        return False
    return True


def fill_patch(
    machine: Machine,
    held_coordinates: Array,
    stroke_pair: tuple[int, int],
    axes: tuple[Array, Array],
    start: Array | None = None,
) -> WorkspacePatch | None:
    """Compute the closed configurations of a patch, starting next to home.

    Args:
        machine: The machine.
        held_coordinates: (n,) values of the active coordinates outside of the pair.
        stroke_pair: Indices of two active coordinates, or one twice.
        axes: Values of both; an axis with one value stays at the held coordinate.
        start: (nq,) closed start configuration; default home.

    Returns:
        The patch, or None if the branch does not lead from the start to it.
    """
    closure, shape = machine.closure, (len(axes[0]), len(axes[1]))
    patch = WorkspacePatch(
        stroke_pair,
        held_coordinates,
        axes,
        np.zeros(shape, dtype=bool),
        np.full((*shape, machine.model.nv), np.nan),
    )
    begun = machine.home if start is None else start
    near = begun[closure.active]
    one, two = (int(np.abs(x - near[i]).argmin()) for i, x in zip(stroke_pair, axes, strict=True))
    nearest_node = (one, two)
    q, is_closed = last_closed_configuration(
        machine, begun, patch.active_coordinates(nearest_node)
    )
    if not is_closed:
        return None
    patch.is_closed[nearest_node], patch.configurations[nearest_node] = True, q
    pending_nodes = [nearest_node]
    while pending_nodes:
        node = pending_nodes.pop()
        if closure.is_compiled:
            pending_nodes += _close_rows(machine, patch, node)
        else:
            pending_nodes += _close_neighbours(machine, patch, node)
    return patch


def _close_neighbours(machine: Machine, patch: WorkspacePatch, node: GridNode) -> list[GridNode]:
    """Close the neighbours of a closed node; returns the newly closed ones."""
    closed_nodes = []
    for neighbour in _neighbours(node, patch.is_closed.shape):
        if patch.is_closed[neighbour]:
            continue
        q, is_closed = last_closed_configuration(
            machine, patch.configurations[node], patch.active_coordinates(neighbour)
        )
        if is_closed:
            patch.is_closed[neighbour], patch.configurations[neighbour] = True, q
            closed_nodes.append(neighbour)
    return closed_nodes


def _close_rows(machine: Machine, patch: WorkspacePatch, closed_node: GridNode) -> list[GridNode]:
    """Close rows of nodes in all directions from a closed node; returns the newly closed ones."""
    compiled_closure, cursor = (
        machine.closure.compiled_closure,
        machine.closure.compiled_closure.new_cursor(),
    )
    closed_nodes = []
    for direction in _GRID_DIRECTIONS:
        row = _open_nodes(patch, closed_node, direction)
        if not row or not compiled_closure.start_cursor_at(
            cursor, patch.configurations[closed_node]
        ):
            continue
        targets = np.array([patch.active_coordinates(node) for node in row])
        out = np.empty((len(row), patch.configurations.shape[2]))
        count = compiled_closure.follow_targets(cursor, targets, out)
        for node, q in zip(row[:count], out[:count], strict=True):
            patch.is_closed[node], patch.configurations[node] = True, q
        closed_nodes += row[:count]
        previous_node = row[count - 1] if count else closed_node
        if count < len(row) and _close_by_continuation(machine, patch, previous_node, row[count]):
            closed_nodes.append(row[count])
    return closed_nodes


def _open_nodes(patch: WorkspacePatch, node: GridNode, direction: GridNode) -> list[GridNode]:
    """Open nodes from a node in one direction, up to a closed one."""
    (a, b), row = patch.is_closed.shape, []
    i, j = node[0] + direction[0], node[1] + direction[1]
    while 0 <= i < a and 0 <= j < b and not patch.is_closed[i, j]:
        row.append((i, j))
        i, j = i + direction[0], j + direction[1]
    return row


def _close_by_continuation(
    machine: Machine, patch: WorkspacePatch, node: GridNode, neighbour: GridNode
) -> bool:
    """Close a node from a closed neighbour in small steps; returns whether it closes."""
    compiled_closure, q = machine.closure.compiled_closure, patch.configurations[node]
    start_strokes = q[machine.closure.active]
    targets = start_strokes + np.linspace(0, 1, _CONTINUATION_STEPS + 1)[1:, None] * (
        patch.active_coordinates(neighbour) - start_strokes
    )
    configurations, cursor = np.empty((_CONTINUATION_STEPS, len(q))), compiled_closure.new_cursor()
    is_closed = (
        compiled_closure.start_cursor_at(cursor, q)
        and compiled_closure.follow_targets(cursor, targets, configurations) == _CONTINUATION_STEPS
    )
    if is_closed:
        patch.is_closed[neighbour], patch.configurations[neighbour] = True, configurations[-1]
    return bool(is_closed)


def _neighbours(node: GridNode, grid_shape: GridNode) -> list[GridNode]:
    candidates = [(node[0] + i, node[1] + j) for i, j in _GRID_DIRECTIONS]
    return [(k, m) for k, m in candidates if 0 <= k < grid_shape[0] and 0 <= m < grid_shape[1]]
