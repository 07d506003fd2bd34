"""How exactly loop equations hold, and which of them lock an overconstrained machine.

A planar linkage in space has redundant equations. Where a file gives few digits, its axes are not
quite parallel and its pins not quite coplanar: the redundant equations contradict the others by
that much and, taken literally, leave no degree of freedom. In the scaled Jacobian

    J D = U S V^T

singular values below 1e-3 of the largest are therefore attributed to the file precision and
dropped: the rest has the rank of the intended linkage. That many independent equations are
selected and closed to rounding. They span the largest volume, so that each other row of U is a
combination of them with factors of at most 1 (see
`crane.closure.active_joint_selection.select_columns`): the gap of a redundant equation is at most
the sum of the contradictions, without amplification. Moving the machine confirms this: over a
revolution, or within the limits, the gaps stay below 1e-4 of the characteristic length.

Where redundant equations hold at home only, the null space of J contains motions that do not
exist: a small step h along them, closed with the independent rows, leaves the redundant rows open
by c h^2. Such a machine is locked.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from crane.closure.active_joint_selection import null_space_basis, select_columns
from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.closure.multi_start_search import damped_step
from crane.common.samples import Array, solve_linear

_STEP_SIZE = 0.02  # step as a fraction of a joint's scale
_MIN_FINITE_MOTION_RATIO = 0.05  # fraction of a step that a finite motion keeps at least
_OPEN_TOLERANCE = 1e-9  # scaled residual that counts as open
_CLOSINGS_PER_DIRECTION = 2  # repetitions of a step
_RANDOM_DIRECTIONS = 3  # besides those of single joints
_STEPS_TO_LIMIT = 16  # steps to the limit of a joint


def largest_redundant_gap(
    equations: LoopEquations,
    home: Array,
    independent_rows: Indices,
    redundant_rows: Indices,
    active: Indices,
) -> tuple[int, float] | None:
    """The redundant equation with the largest gap near home, and its scaled gap.

    Active joints step one by one, and all together in random directions; the others follow by the
    independent rows. The search ends at the first gap above tolerance.
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
    """Largest scaled gap of each redundant equation along motions from home.

    The motions reach the limits, at least 1 rad or one characteristic length; half a revolution
    without limits. They end at the end of the branch.

    Returns:
        (k,), and whether each active joint moves at all.
    """
    unit = equations.coordinate_units[active]
    turns = ~equations.coordinates.is_translation[active]
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
    for active_columns, direction in _active_directions(equations.model.nv, active):
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
    """Columns (nv, n) of the active joints with directions (n,): single joints, then random."""
    active_columns = np.zeros((nv, len(active)))
    active_columns[active, np.arange(len(active))] = 1.0
    directions = [*np.eye(len(active))]
    if len(active) > 1:
        directions += [*np.random.default_rng(2).uniform(-1, 1, (_RANDOM_DIRECTIONS, len(active)))]
    return ((active_columns, way) for way in directions)


def _close_independent_rows(
    equations: LoopEquations, q: Array, independent_rows: Indices, held_directions: Array
) -> Array | None:
    """Close independent rows near q (nq,) with held_directions^T q unchanged, or None."""
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
        q = equations.displace(q, np.arange(len(q)), change)
    return q if np.abs(phi[independent_rows]).max(initial=0.0) < 1e-11 else None


# scaled values (rad, characteristic length): the same for machines of any size
CLOSED_TOLERANCE = 1e-9
FILE_PRECISION = 1e-4  # scaled residual that file precision explains
_MIN_SINGULAR_VALUE_RATIO = 1e-3  # singular values below are due to file precision
_ROUNDING_TOLERANCE = 1e-12  # gap of redundant equations that hold to rounding
_LOCKED_TOLERANCE = 1e-9  # gap of equations that lock a machine


@dataclass(frozen=True)
class RedundancyGap:
    """Tolerance of the redundant equations.

    Attributes:
        tolerance: Largest accepted scaled residual.
        largest_row: The row with the largest gap along the motions that were checked; -1 if exact.
        largest_gap: Its scaled residual.
    """

    tolerance: float = CLOSED_TOLERANCE
    largest_row: int = -1
    largest_gap: float = 0.0


# the row with the largest gap, and its scaled gap
LockedEquation = tuple[int, float] | None


class ExactConstraints:
    """Equations that hold to rounding.

    Args:
        equations: All loop equations.

    Attributes:
        closed_tolerances: (m,) largest residuals of closed loops [m], [rad].
    """

    def __init__(self, equations: LoopEquations):
        self._equations = equations
        self._residual_units = equations.residual_units
        self._coordinate_units = equations.coordinate_units
        self.closed_tolerances = CLOSED_TOLERANCE * self._residual_units

    def is_closed(self, q: Array) -> bool:
        """Whether all loops are closed."""
        return bool((np.abs(self._equations.evaluate(q)[0]) < self.closed_tolerances).all())

    def close_loops(self, q: Array, movable: Indices) -> Array:
        """Close all loops with some columns; check the residual for success."""
        return self._reduce_residual(q, movable, 1e-13)

    def _reduce_residual(self, q: Array, movable: Indices, tolerance: float) -> Array:
        """Damped Gauss-Newton steps towards a scaled residual."""
        q, units = q.copy(), self._equations.step_units[movable]
        for _ in range(200):
            phi, jacobian = self._equations.evaluate(q)
            if np.abs(phi / self._residual_units).max(initial=0.0) < tolerance:
                break
            scales = self._equations.step_residual_units
            scaled_jacobian = jacobian[:, movable] / scales[:, None] * units
            step = least_squares_step(scaled_jacobian, phi / scales)
            step *= units / self._coordinate_units[movable]
            q = self._equations.displace(q, movable, step)
        return q

    def intended_jacobian(self, q: Array) -> Array:
        """(m, nv) Jacobian of the intended equations, rows scaled."""
        return self._equations.evaluate(q)[1] / self._residual_units[:, None]

    def find_locked_equation(self, q: Array, mobility: int, tolerance: float) -> LockedEquation:
        """Find the equation that locks a machine although its Jacobian allows motion.

        Steps in random directions of the null space N are closed with all equations, and repeated
        in the direction that remains: this finds finite motions far from the first one, and
        reduces motions that do not exist to rounding. Groups of joints that no equation connects
        step at once, each as far as it would alone, so that the number of steps is that of the
        group with the most directions. Joints that N moves and that stay fixed in all remaining
        motions are locked. At a change point N has more columns than the mobility, too, but all
        its joints move.

        Args:
            q: (nq,) closed configuration.
            mobility: Mobility at other closed configurations.
            tolerance: Relative singular values of J below it count as zero.

        Returns:
            The row with the largest gap, and its scaled gap; None if nothing is locked.
        """
        from scipy.linalg import qr  # slow to import, only needed with loops

        equations, scale = self._equations, self._equations.motion_scales
        all_columns = np.arange(len(q))
        jacobian = equations.evaluate(q)[1] / equations.residual_units[:, None]
        basis = null_space_basis(jacobian, scale, tolerance)
        if basis.shape[1] <= mobility:
            return None
        group, group_of_row = equations.coupled_groups(all_columns)
        first_order_motion = np.linalg.norm(basis, axis=1)
        directions = np.bincount(
            group, first_order_motion**2
        )  # number per group: the trace of a projector
        random = np.random.default_rng(1)
        finite_motion = np.zeros(len(q))  # as fractions of the step
        for _ in range(2 * round(directions.max())):
            direction = basis @ random.normal(size=basis.shape[1])
            for _ in range(_CLOSINGS_PER_DIRECTION):
                length = np.sqrt(np.bincount(group, direction**2))[group]
                step = _STEP_SIZE * scale * direction / np.where(length > 0, length, 1.0)
                closed = self.close_loops(q + step, all_columns)
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

    def select_independent_rows(
        self, home: Array, passive: Indices, rank: int, tolerance: float
    ) -> tuple[Indices, Indices] | None:
        """Independent rows (rank,) and the others; None if the rank of J_P is lower."""
        equations = self._equations
        jacobian = equations.evaluate(home)[1] / equations.step_residual_units[:, None]
        jacobian = (jacobian * equations.step_units)[:, passive]
        from scipy.linalg import qr  # slow to import, only needed with loops

        _, upper, pivots = qr(jacobian.T, mode="economic", pivoting=True)
        diagonal = np.abs(np.diag(upper))
        if (diagonal > tolerance * diagonal[0]).sum() < rank:
            return None
        rows, redundant = (np.sort(part).astype(np.intp) for part in np.split(pivots, [rank]))
        return rows, redundant

    def assess_redundancy(
        self, home: Array, independent_rows: Indices, redundant_rows: Indices, active: Indices
    ) -> tuple[LockedEquation, RedundancyGap]:
        """The equation that locks the machine at home, or else the redundancy tolerance.

        Equations that hold to nearly all digits close at home, and no longer half a revolution
        away.
        """
        lock = largest_redundant_gap(
            self._equations, home, independent_rows, redundant_rows, active
        )
        if lock is None or lock[1] <= _ROUNDING_TOLERANCE:
            return None, RedundancyGap()
        if lock[1] > _LOCKED_TOLERANCE:
            return lock, RedundancyGap()
        return None, self._assess_file_precision(home, independent_rows, redundant_rows, active)[1]

    def _assess_file_precision(
        self, home: Array, independent_rows: Indices, redundant_rows: Indices, active: Indices
    ) -> tuple[LockedEquation, RedundancyGap]:
        if not len(redundant_rows):
            return None, RedundancyGap()
        largest_gaps, moves = redundant_gaps_along_motions(
            self._equations, home, independent_rows, redundant_rows, active
        )
        worst = int(largest_gaps.argmax())
        row, gap = int(redundant_rows[worst]), float(largest_gaps[worst])
        if gap > FILE_PRECISION or not moves:
            return (row, gap), RedundancyGap()
        decade = 10.0 ** np.ceil(
            np.log10(max(2 * gap, CLOSED_TOLERANCE))
        )  # machines with equal tolerance share machine code
        return None, RedundancyGap(
            max(CLOSED_TOLERANCE, min(float(decade), FILE_PRECISION)), row, gap
        )


class RoundedConstraints(ExactConstraints):
    """Equations that hold to the precision of a file.

    Args:
        equations: All loop equations.
    """

    def __init__(self, equations: LoopEquations):
        super().__init__(equations)
        self.closed_tolerances = FILE_PRECISION * self._residual_units

    def close_loops(self, q: Array, movable: Indices) -> Array:
        """Close by least squares; contradictions within the file precision stay open."""
        q = self._reduce_residual(q, movable, 10 * FILE_PRECISION)
        for _ in range(20):
            phi, jacobian = self._equations.evaluate_scaled(q)
            if not np.isfinite(jacobian).all():  # diverged: not closed
                break
            step = np.linalg.lstsq(jacobian[:, movable], -phi, rcond=_MIN_SINGULAR_VALUE_RATIO)[0]
            q = self._equations.displace(q, movable, step)
            if not 1e-14 < np.abs(step).max(initial=0.0) < 1.0:
                break
        return q

    def intended_jacobian(self, q: Array) -> Array:
        """(m, nv) Jacobian without the singular values that are due to the file precision."""
        left, values, right = np.linalg.svd(
            self._equations.evaluate_scaled(q)[1], full_matrices=False
        )
        values[values < _MIN_SINGULAR_VALUE_RATIO * values[0]] = 0.0
        return np.asarray((left * values @ right) / self._coordinate_units)

    def find_locked_equation(self, q: Array, mobility: int, tolerance: float) -> LockedEquation:
        """None: `assess_redundancy` checks this, over larger motions."""
        return None

    def select_independent_rows(
        self, home: Array, passive: Indices, rank: int, tolerance: float
    ) -> tuple[Indices, Indices] | None:
        """Rows of the largest volume and the others; None if the rank of J_P is lower."""
        jacobian = self._equations.evaluate_scaled(home)[1][:, passive]
        left, values, _ = np.linalg.svd(jacobian, full_matrices=False)
        if rank != len(passive) or values[-1] < _MIN_SINGULAR_VALUE_RATIO * values[0]:
            return None
        rows = select_columns(left, range(len(jacobian)))
        return None if rows is None else (rows, np.setdiff1d(np.arange(len(jacobian)), rows))

    def assess_redundancy(
        self, home: Array, independent_rows: Indices, redundant_rows: Indices, active: Indices
    ) -> tuple[LockedEquation, RedundancyGap]:
        """The equation that locks the machine, or else the tolerance of redundant equations."""
        return self._assess_file_precision(home, independent_rows, redundant_rows, active)


def least_squares_step(jacobian: Array, phi: Array) -> Array:
    """Damped Gauss-Newton step towards phi = 0, at most 0.3 in any joint; scaled."""
    return damped_step(jacobian, phi, 1e-12, 0.3, np.inf)
