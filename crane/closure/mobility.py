"""Motions of first order that no finite motion follows: overconstrained machines that lock up.

Planar linkages in space, Sarrus' and Bennett's linkages have more equations than they need, and
the surplus ones hold all along their motion. Where surplus equations hold at home only, the null
space of J promises motions that are none: a small step h along them, closed with independent rows,
leaves the surplus rows open by c h^2.
"""

from collections.abc import Callable, Iterator

import numpy as np

from crane.closure.choice import Indices, motions, slides, units
from crane.closure.equations import LoopEquations
from crane.common.samples import Array, solve

_STEP = 0.02  # of a joint's scale
_MOVED = 0.05  # share of a step that a finite motion keeps at least
_OPEN = 1e-9  # residual that counts as open [rad], [machine's size]
_AGAIN = 2  # closings of each direction
_DIRECTIONS = 3  # drawn, beside those of single joints
_WALK = 16  # steps to the end of the range


def locked_up(
    equations: LoopEquations,
    q: Array,
    freedom: int,
    tolerance: float,
    close: Callable[[Array], Array],
) -> tuple[int, float] | None:
    """Where a machine has less freedom than its equations promise at a closed posture.

    Steps in drawn directions of the null space N are closed with all equations, the shortest way,
    and again from as far in the direction that was left: a finite motion far from the first one is
    found that way, and of no motion rounding is left. Groups of joints that no equation ties to
    each other step at once, each as far as it would alone, so that a machine of many loops takes
    as many steps as the group with the most directions.
    Joints that N lets move and that stay in all the ways that remain are locked. A linkage in line
    that may go on in several ways (a bifurcation) has more columns of N than freedom, too, but all
    its joints move.

    Args:
        equations: All loop equations.
        q: (nq,) closed posture.
        freedom: What the equations leave at other closed postures.
        tolerance: Relative singular values of J below it count as zero.
        close: Closes all loops from a near posture.

    Returns:
        The row that stays open by most, and by how much [rad], [machine's size]; None where all is
        well.
    """
    from scipy.linalg import qr  # slow to import, and not needed without loops

    scale = equations.scales
    jacobian = equations.evaluate(q)[1] / equations.row_units[:, None]
    basis = motions(jacobian, scale, tolerance)
    if basis.shape[1] <= freedom:
        return None
    group, group_of_row = equations.groups(np.arange(len(q)))
    promised = np.linalg.norm(basis, axis=1)
    directions = np.bincount(group, promised**2)  # of each group; the trace of a projector
    random = np.random.default_rng(1)
    moved = np.zeros(len(q))  # shares of the step
    for _ in range(2 * round(directions.max())):
        way = basis @ random.normal(size=basis.shape[1])
        for _ in range(_AGAIN):
            length = np.sqrt(np.bincount(group, way**2))[group]
            near = close(q + _STEP * scale * way / np.where(length > 0, length, 1.0))
            gap = np.zeros(len(directions))
            np.maximum.at(gap, group_of_row, np.abs(equations.scaled(near)[0]))
            way = np.where(gap[group] < _OPEN, (near - q) / scale, 0.0)
            moved = np.maximum(moved, np.abs(way) / _STEP)
            if not way.any():
                break
    if not ((promised > 1e-3) & (moved < _MOVED * promised)).any():
        return None
    rank = equations.model.nv - basis.shape[1]
    rows = qr((jacobian * scale).T, mode="r", pivoting=True)[1][:rank].astype(np.intp)
    worst, size = 0, 0.0
    for way in basis.T:
        beside = _closed(equations, q + _STEP * scale * way, rows, basis / scale[:, None])
        if beside is None:
            continue
        phi = np.abs(equations.scaled(beside)[0])
        if phi.max() > size:
            worst, size = int(phi.argmax()), float(phi.max())
    return worst, size


def surplus_open(
    equations: LoopEquations, home: Array, rows: Indices, surplus: Indices, active: Indices
) -> tuple[int, float] | None:
    """The surplus equation that holds least beside home, and how far it is open, in shares.

    Active joints step one by one, and all together in drawn directions; the others follow by the
    independent rows. What is open far enough to tell ends the search.
    """
    if not len(surplus) or not len(active):
        return None
    scale = equations.scales
    worst = int(surplus[0]), 0.0
    for held, way in _ways(equations.model.nv, active):
        # the smaller step where the branch ends within the larger one
        starts = [home + held @ (size * scale[active] * way) for size in (_STEP, _STEP / 16)]
        closed = (_closed(equations, q, rows, held) for q in starts)
        moved = next((q for q in closed if q is not None), None)
        if moved is not None:
            phi = np.abs(equations.scaled(moved)[0][surplus])
            worst = max(worst, (int(surplus[phi.argmax()]), float(phi.max())), key=lambda x: x[1])
        if worst[1] > _OPEN:
            break
    return worst


def surplus_along(
    equations: LoopEquations, home: Array, rows: Indices, surplus: Indices, active: Indices
) -> tuple[Array, bool]:
    """How far each surplus equation opens all along the motions from home, in shares.

    Ways lead to the limits, at least 1 rad or the machine's size far; half a turn where there are
    none. They end where the branch does.

    Returns:
        (k,), and whether each active joint moves at all.
    """
    model = equations.model
    unit, turns = units(model)[active], ~slides(model)[active]
    room = [
        np.abs(limit[active] - home[active])
        for limit in (equations.coordinates.lower, equations.coordinates.upper)
    ]
    reach = [
        np.where(np.isfinite(x), np.maximum(x, unit), np.where(turns, np.pi, unit)) for x in room
    ]
    widest = np.abs(equations.scaled(home)[0][surplus])
    moves = np.zeros(len(active), dtype=bool)
    for held, way in _ways(model.nv, active):
        for side, far in zip((-1.0, 1.0), reach, strict=True):
            q = home
            for _ in range(_WALK):
                near = _closed(equations, q + held @ (side * way * far / _WALK), rows, held)
                if near is None:
                    break
                q = near
                moves |= way != 0
                widest = np.maximum(widest, np.abs(equations.scaled(q)[0][surplus]))
    return widest, bool(moves.all())


def _ways(nv: int, active: Indices) -> Iterator[tuple[Array, Array]]:
    """Columns (nv, n) of the active joints and directions (n,): one by one, then some drawn."""
    held = np.zeros((nv, len(active)))
    held[active, np.arange(len(active))] = 1.0
    ways = [*np.eye(len(active))]
    if len(active) > 1:
        ways += [*np.random.default_rng(2).uniform(-1, 1, (_DIRECTIONS, len(active)))]
    return ((held, way) for way in ways)


def _closed(equations: LoopEquations, q: Array, rows: Indices, held: Array) -> Array | None:
    """The posture near q (nq,) where independent rows are closed and held^T q is what it was."""
    q = q.copy()
    none = np.zeros(held.shape[1])
    for _ in range(12):
        phi, jacobian = equations.scaled(q)
        if np.abs(phi[rows]).max(initial=0.0) < 1e-13:
            return q
        ways = held.T * equations.units
        try:
            change = solve(np.vstack([jacobian[rows], ways]), np.concatenate([-phi[rows], none]))
        except np.linalg.LinAlgError:
            return None
        if not np.abs(change).max() < 1.0:
            return None
        q += change * equations.units
    return q if np.abs(phi[rows]).max(initial=0.0) < 1e-11 else None
