"""Motions of first order that no finite motion follows: overconstrained machines that lock up.

Planar linkages in space, Sarrus' and Bennett's linkages have more equations than they need, and
the surplus ones hold all along their motion. Where surplus equations hold at home only, the null
space of J promises motions that are none: a small step h along them, closed with independent rows,
leaves the surplus rows open by c h^2.
"""

from collections.abc import Callable, Iterator

import numpy as np

from crane.closure.active_joint_selection import (
    Indices,
    coordinate_units,
    null_space_basis,
    translational_coordinates,
)
from crane.closure.loop_equations import LoopEquations
from crane.common.samples import Array, solve_linear

_STEP_SIZE = 0.02  # of a joint's scale
_MIN_FINITE_MOTION_RATIO = 0.05  # share of a step that a finite motion keeps at least
_OPEN_TOLERANCE = 1e-9  # residual that counts as open [rad], [machine's size]
_CLOSINGS_PER_DIRECTION = 2  # closings of each direction
_RANDOM_DIRECTIONS = 3  # drawn, beside those of single joints
_STEPS_TO_LIMIT = 16  # steps to the end of the range


def find_locked_equation(
    equations: LoopEquations,
    q: Array,
    mobility: int,
    tolerance: float,
    close_loops: Callable[[Array], Array],
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
        mobility: What the equations leave at other closed postures.
        tolerance: Relative singular values of J below it count as zero.
        close_loops: Closes all loops from a near posture.

    Returns:
        The row that stays open by most, and by how much [rad], [machine's size]; None where all is
        well.
    """
    from scipy.linalg import qr  # slow to import, and not needed without loops

    scale = equations.motion_scales
    jacobian = equations.evaluate(q)[1] / equations.residual_units[:, None]
    basis = null_space_basis(jacobian, scale, tolerance)
    if basis.shape[1] <= mobility:
        return None
    group, group_of_row = equations.coupled_groups(np.arange(len(q)))
    first_order_motion = np.linalg.norm(basis, axis=1)
    directions = np.bincount(
        group, first_order_motion**2
    )  # of each group; the trace of a projector
    random = np.random.default_rng(1)
    finite_motion = np.zeros(len(q))  # shares of the step
    for _ in range(2 * round(directions.max())):
        direction = basis @ random.normal(size=basis.shape[1])
        for _ in range(_CLOSINGS_PER_DIRECTION):
            length = np.sqrt(np.bincount(group, direction**2))[group]
            closed = close_loops(
                q + _STEP_SIZE * scale * direction / np.where(length > 0, length, 1.0)
            )
            gap = np.zeros(len(directions))
            np.maximum.at(gap, group_of_row, np.abs(equations.evaluate_scaled(closed)[0]))
            direction = np.where(gap[group] < _OPEN_TOLERANCE, (closed - q) / scale, 0.0)
            finite_motion = np.maximum(finite_motion, np.abs(direction) / _STEP_SIZE)
            if not direction.any():
                break
    if not (
        (first_order_motion > 1e-3)
        & (finite_motion < _MIN_FINITE_MOTION_RATIO * first_order_motion)
    ).any():
        return None
    rank = equations.model.nv - basis.shape[1]
    rows = qr((jacobian * scale).T, mode="r", pivoting=True)[1][:rank].astype(np.intp)
    worst, largest_gap = 0, 0.0
    for direction in basis.T:
        closed_neighbour = _close_independent_rows(
            equations, q + _STEP_SIZE * scale * direction, rows, basis / scale[:, None]
        )
        if closed_neighbour is None:
            continue
        phi = np.abs(equations.evaluate_scaled(closed_neighbour)[0])
        if phi.max() > largest_gap:
            worst, largest_gap = int(phi.argmax()), float(phi.max())
    return worst, largest_gap


def largest_redundant_gap(
    equations: LoopEquations,
    home: Array,
    independent_rows: Indices,
    redundant_rows: Indices,
    active: Indices,
) -> tuple[int, float] | None:
    """The surplus equation that holds least beside home, and how far it is open, in shares.

    Active joints step one by one, and all together in drawn directions; the others follow by the
    independent rows. What is open far enough to tell ends the search.
    """
    if not len(redundant_rows) or not len(active):
        return None
    scale = equations.motion_scales
    worst = int(redundant_rows[0]), 0.0
    for active_columns, direction in _active_directions(equations.model.nv, active):
        # the smaller step where the branch ends within the larger one
        starts = [
            home + active_columns @ (size * scale[active] * direction)
            for size in (_STEP_SIZE, _STEP_SIZE / 16)
        ]
        closed = (
            _close_independent_rows(equations, q, independent_rows, active_columns) for q in starts
        )
        neighbour = next((q for q in closed if q is not None), None)
        if neighbour is not None:
            phi = np.abs(equations.evaluate_scaled(neighbour)[0][redundant_rows])
            worst = max(
                worst, (int(redundant_rows[phi.argmax()]), float(phi.max())), key=lambda x: x[1]
            )
        if worst[1] > _OPEN_TOLERANCE:
            break
    return worst


def redundant_gaps_along_motions(
    equations: LoopEquations,
    home: Array,
    independent_rows: Indices,
    redundant_rows: Indices,
    active: Indices,
) -> tuple[Array, bool]:
    """How far each surplus equation opens all along the motions from home, in shares.

    Ways lead to the limits, at least 1 rad or the machine's size far; half a turn where there are
    none. They end where the branch does.

    Returns:
        (k,), and whether each active joint moves at all.
    """
    model = equations.model
    unit, turns = coordinate_units(model)[active], ~translational_coordinates(model)[active]
    distances_to_limits = [
        np.abs(limit[active] - home[active])
        for limit in (equations.coordinates.lower, equations.coordinates.upper)
    ]
    ranges = [
        np.where(np.isfinite(x), np.maximum(x, unit), np.where(turns, np.pi, unit))
        for x in distances_to_limits
    ]
    largest_gaps = np.abs(equations.evaluate_scaled(home)[0][redundant_rows])
    moves = np.zeros(len(active), dtype=bool)
    for active_columns, direction in _active_directions(model.nv, active):
        for side, distance in zip((-1.0, 1.0), ranges, strict=True):
            q = home
            for _ in range(_STEPS_TO_LIMIT):
                near = _close_independent_rows(
                    equations,
                    q + active_columns @ (side * direction * distance / _STEPS_TO_LIMIT),
                    independent_rows,
                    active_columns,
                )
                if near is None:
                    break
                q = near
                moves |= direction != 0
                largest_gaps = np.maximum(
                    largest_gaps, np.abs(equations.evaluate_scaled(q)[0][redundant_rows])
                )
    return largest_gaps, bool(moves.all())


def _active_directions(nv: int, active: Indices) -> Iterator[tuple[Array, Array]]:
    """Columns (nv, n) of the active joints and directions (n,): one by one, then some drawn."""
    active_columns = np.zeros((nv, len(active)))
    active_columns[active, np.arange(len(active))] = 1.0
    directions = [*np.eye(len(active))]
    if len(active) > 1:
        directions += [*np.random.default_rng(2).uniform(-1, 1, (_RANDOM_DIRECTIONS, len(active)))]
    return ((active_columns, way) for way in directions)


def _close_independent_rows(
    equations: LoopEquations, q: Array, independent_rows: Indices, held_directions: Array
) -> Array | None:
    """The posture near q (nq,) where independent rows are closed and held^T q is what it was."""
    q = q.copy()
    none = np.zeros(held_directions.shape[1])
    for _ in range(12):
        phi, jacobian = equations.evaluate_scaled(q)
        if np.abs(phi[independent_rows]).max(initial=0.0) < 1e-13:
            return q
        scaled_directions = held_directions.T * equations.coordinate_units
        try:
            change = solve_linear(
                np.vstack([jacobian[independent_rows], scaled_directions]),
                np.concatenate([-phi[independent_rows], none]),
            )
        except np.linalg.LinAlgError:
            return None
        if not np.abs(change).max() < 1.0:
            return None
        q += change * equations.coordinate_units
    return q if np.abs(phi[independent_rows]).max(initial=0.0) < 1e-11 else None
