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
    one, two = (
        int(np.abs(x - begun[closure.active][i]).argmin())
        for i, x in zip(stroke_pair, axes, strict=True)
    )
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
        for direction in _GRID_DIRECTIONS:
            pending_nodes += _close_row(machine, patch, node, direction)
    return patch


def _close_row(
    machine: Machine, patch: WorkspacePatch, node: GridNode, direction: GridNode
) -> list[GridNode]:
    """Close the open nodes from a closed node in one direction; returns the newly closed ones.

    Without machine code it closes the first of them.
    """
    (a, b), row = patch.is_closed.shape, []
    i, j = node[0] + direction[0], node[1] + direction[1]
    while 0 <= i < a and 0 <= j < b and not patch.is_closed[i, j]:
        row.append((i, j))
        i, j = i + direction[0], j + direction[1]
    if not row:
        return []
    start = patch.configurations[node]
    targets = np.array([patch.active_coordinates(x) for x in row])
    if machine.closure.is_compiled:
        closed = follow_branch(machine, start, targets)
    else:
        last_configuration, is_closed = last_closed_configuration(machine, start, targets[0])
        closed = last_configuration[None][: int(is_closed)]
    if machine.closure.is_compiled and len(closed) < len(row):
        previous = closed[-1] if len(closed) else start
        strokes = previous[machine.closure.active]
        shares = np.linspace(0, 1, _CONTINUATION_STEPS + 1)[1:, None]
        path = strokes + shares * (targets[len(closed)] - strokes)
        steps = follow_branch(machine, previous, path)
        if len(steps) == _CONTINUATION_STEPS:
            closed = np.vstack([closed, steps[-1:]])
    for x, q in zip(row, closed, strict=False):
        patch.is_closed[x], patch.configurations[x] = True, q
    return row[: len(closed)]


def follow_branch(machine: Machine, start: Array, targets: Array) -> Array:
    """Configurations (k, nq) at the first k of targets (N, n) to which the branch leads.

    In machine code; none if the start is singular.
    """
    compiled_closure, out = machine.closure.compiled_closure, np.empty((len(targets), len(start)))
    cursor = compiled_closure.new_cursor()
    is_started = compiled_closure.start_cursor_at(cursor, start)
    return out[: compiled_closure.follow_targets(cursor, targets, out) if is_started else 0]
