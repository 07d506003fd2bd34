"""A grid over one or two active coordinates: which postures close."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crane.common.errors import ClosureError
from crane.common.samples import Array
from crane.common.shown import Brief
from crane.machine import Machine

Node = tuple[int, int]
_SIDES: tuple[Node, ...] = ((1, 0), (-1, 0), (0, 1), (0, -1))

_STEPS = 16  # from one posture of the grid to the next, where one step fails
_EDGE = 2.0**-30  # share of a way to which its last closed posture is found


@dataclass(frozen=True, eq=False, repr=False)
class Patch(Brief):
    """Postures over two active coordinates (one, if the second axis has one value).

    Attributes:
        pair: Indices of both among the active joints.
        base: (n,) where the others are held.
        axes: Values of both, (a,) and (b,).
        closed: (a, b) whether the loops close, connected with home along lines of the grid.
        q: (a, b, nq) postures, NaN where open.
    """

    pair: tuple[int, int]
    base: Array
    axes: tuple[Array, Array]
    closed: NDArray[np.bool_]
    q: Array

    def target(self, node: Node) -> Array:
        """Active coordinates (n,) of a node."""
        q_a = self.base.copy()
        for joint, axis, k in zip(self.pair, self.axes, node, strict=True):
            if len(axis) > 1:
                q_a[joint] = axis[k]
        return q_a


def last_closed(machine: Machine, q: Array, target: Array) -> tuple[Array, bool]:
    """Follow the branch along the straight line of q_A as far as it leads.

    In machine code that is until an entry of gamma exceeds 1000, some 1e-5 rad or m short of the
    end at most.

    Args:
        machine: The machine.
        q: (nq,) closed posture to start from.
        target: (n,) active coordinates.

    Returns:
        The last closed posture (nq,), and whether it is at the target.
    """
    closure = machine.closure
    start = q[closure.active]
    out = np.empty((1, len(q)))
    cursor = closure.fast.cursor() if closure.compiled else None
    if cursor is not None and not closure.fast.start_near(cursor, q):
        return q, False
    done, step, last = 0.0, 1.0, q
    while done < 1.0 and step > _EDGE:
        goal = min(1.0, done + step)
        way = (target if goal == 1.0 else start + goal * (target - start))[None]
        if cursor is not None:
            able = closure.fast.follow(cursor, way, out) == 1
        else:
            able = _solved(machine, way, last, out)
        if able:
            done, last = goal, out[0].copy()
        step = step * 2 if able else step / 2
    return last, done == 1.0


def _solved(machine: Machine, targets: Array, guess: Array, out: Array) -> bool:
    """Close the loops at targets (1, n) into out (1, nq); whether that worked."""
    try:
        out[0] = machine.closure.solve(targets[0], guess=guess)
    except ClosureError:
        return False
    return True


def fill(
    machine: Machine,
    base: Array,
    pair: tuple[int, int],
    axes: tuple[Array, Array],
    start: Array | None = None,
) -> Patch | None:
    """The closed postures of a patch, from the one nearest to home on.

    Args:
        machine: The machine.
        base: (n,) where the active joints are held that are not of the pair.
        pair: Two of them, or one twice.
        axes: Their values; an axis of one value is held at the base.
        start: (nq,) closed posture to come from; home if not given.

    Returns:
        None where the way from there to the patch is barred.
    """
    closure, shape = machine.closure, (len(axes[0]), len(axes[1]))
    patch = Patch(
        pair, base, axes, np.zeros(shape, dtype=bool), np.full((*shape, machine.model.nv), np.nan)
    )
    begun = machine.home if start is None else start
    near = begun[closure.active]
    one, two = (int(np.abs(x - near[i]).argmin()) for i, x in zip(pair, axes, strict=True))
    first = (one, two)
    q, able = last_closed(machine, begun, patch.target(first))
    if not able:
        return None
    patch.closed[first], patch.q[first] = True, q
    waiting = [first]
    while waiting:
        at = waiting.pop()
        if closure.compiled:
            waiting += _close_rows(machine, patch, at)
        else:
            waiting += _close_beside(machine, patch, at)
    return patch


def _close_beside(machine: Machine, patch: Patch, at: Node) -> list[Node]:
    """Close the neighbours of a closed node; those that now are."""
    found = []
    for near in _beside(at, patch.closed.shape):
        if patch.closed[near]:
            continue
        q, able = last_closed(machine, patch.q[at], patch.target(near))
        if able:
            patch.closed[near], patch.q[near] = True, q
            found.append(near)
    return found


def _close_rows(machine: Machine, patch: Patch, at: Node) -> list[Node]:
    """Close rows of nodes at once, on all sides of a closed node; those that now are closed."""
    fast, cursor = machine.closure.fast, machine.closure.fast.cursor()
    found = []
    for way in _SIDES:
        row = _open_row(patch, at, way)
        if not row or not fast.start_near(cursor, patch.q[at]):
            continue
        targets = np.array([patch.target(node) for node in row])
        out = np.empty((len(row), patch.q.shape[2]))
        count = fast.follow(cursor, targets, out)
        for node, q in zip(row[:count], out[:count], strict=True):
            patch.closed[node], patch.q[node] = True, q
        found += row[:count]
        before = row[count - 1] if count else at
        if count < len(row) and _close_in_steps(machine, patch, before, row[count]):
            found.append(row[count])
    return found


def _open_row(patch: Patch, at: Node, way: Node) -> list[Node]:
    """The open nodes from a node on along one way, up to a closed one."""
    (a, b), row = patch.closed.shape, []
    i, j = at[0] + way[0], at[1] + way[1]
    while 0 <= i < a and 0 <= j < b and not patch.closed[i, j]:
        row.append((i, j))
        i, j = i + way[0], j + way[1]
    return row


def _close_in_steps(machine: Machine, patch: Patch, at: Node, near: Node) -> bool:
    """Close a node from a closed one beside it in small steps; whether that worked."""
    fast, q = machine.closure.fast, patch.q[at]
    from_a = q[machine.closure.active]
    way = from_a + np.linspace(0, 1, _STEPS + 1)[1:, None] * (patch.target(near) - from_a)
    steps, cursor = np.empty((_STEPS, len(q))), fast.cursor()
    able = fast.start_near(cursor, q) and fast.follow(cursor, way, steps) == _STEPS
    if able:
        patch.closed[near], patch.q[near] = True, steps[-1]
    return bool(able)


def _beside(at: Node, shape: Node) -> list[Node]:
    near = [(at[0] + i, at[1] + j) for i, j in _SIDES]
    return [(k, m) for k, m in near if 0 <= k < shape[0] and 0 <= m < shape[1]]
