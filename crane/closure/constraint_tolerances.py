"""How exactly loop equations hold: to rounding, or to the digits that a file was written with.

A planar linkage in space has more equations than it needs. Written with few digits, its axes are
not quite parallel and its pins not quite in one plane, so the surplus equations contradict the
others by that much: taken at their word they leave the linkage no freedom. With

    J D = U S V^T        rows and columns in shares of the machine's size and in rad

singular values below 1e-3 of the largest are digits, and are cut off: what remains has the rank of
the linkage that was meant. As many independent equations as that rank are chosen and closed to
rounding. They span the largest volume, so that each other row of U is a combination of theirs with
factors of at most 1 (see `crane.closure.active_joint_selection.select_columns`): surplus equations
stay open by no more than the sum of what the digits contradict, nowhere magnified.

That they are digits shows when the machine moves: over a turn, or its limits, they stay below 1e-4
of the machine's size. What locks up opens further than that.
"""

from dataclasses import dataclass

import numpy as np

from crane.closure.active_joint_selection import Indices, select_columns
from crane.closure.loop_equations import LoopEquations
from crane.closure.mobility import (
    find_locked_equation,
    largest_redundant_gap,
    redundant_gaps_along_motions,
)
from crane.common.samples import Array

# in rad and shares of the machine's size, so that these are the same machine at any scale
CLOSED_TOLERANCE = 1e-9
FILE_PRECISION = 1e-4  # what counts as digits
_MIN_SINGULAR_VALUE_RATIO = 1e-3  # share of the largest singular value from which on one is meant
_ROUNDING_TOLERANCE = 1e-12  # of surplus equations that hold to rounding
_LOCKED_TOLERANCE = 1e-9  # of those that lock a machine up


@dataclass(frozen=True)
class RedundancyGap:
    """How far surplus equations may be open.

    Attributes:
        tolerance: What they may be open by [rad], [machine's size].
        largest_row: The one that is open by most on the way that was looked at, -1 for exact ones.
        largest_gap: By how much it is, likewise.
    """

    tolerance: float = CLOSED_TOLERANCE
    largest_row: int = -1
    largest_gap: float = 0.0


# the row that stays open by most, and by how much [rad], [machine's size]
LockedEquation = tuple[int, float] | None


class ExactConstraints:
    """Equations that hold to rounding.

    Args:
        equations: All of them.

    Attributes:
        closed_tolerances: (m,) what residuals of closed loops are at most [m], [rad].
    """

    closed_tolerances: Array

    def __init__(self, equations: LoopEquations):
        self._equations = equations
        self._residual_units, self._coordinate_units = (
            equations.residual_units,
            equations.coordinate_units,
        )
        self.closed_tolerances = CLOSED_TOLERANCE * self._residual_units

    def is_closed(self, q: Array) -> bool:
        """Whether all loops are closed."""
        return bool((np.abs(self._equations.evaluate(q)[0]) < self.closed_tolerances).all())

    def close_loops(self, q: Array, movable: Indices) -> Array:
        """Close all loops by moving the free joints; the residual tells whether that worked."""
        q = q.copy()
        for _ in range(200):
            phi, jacobian = self._equations.evaluate_scaled(q)
            if np.abs(phi).max(initial=0.0) < 1e-13:
                break
            q[movable] += (
                least_squares_step(jacobian[:, movable], phi) * self._coordinate_units[movable]
            )
        return q

    def intended_jacobian(self, q: Array) -> Array:
        """(m, nv) slopes of the equations as they were meant, in shares of the machine's size."""
        return self._equations.evaluate(q)[1] / self._residual_units[:, None]

    def find_locked_equation(self, q: Array, mobility: int, tolerance: float) -> LockedEquation:
        """See `crane.closure.mobility.find_locked_equation`."""
        all_columns = np.arange(self._equations.model.nv)
        return find_locked_equation(
            self._equations,
            q,
            mobility,
            tolerance,
            lambda near: self.close_loops(near, all_columns),
        )

    def select_independent_rows(
        self, home: Array, passive: Indices, rank: int, tolerance: float
    ) -> tuple[Indices, Indices] | None:
        """As many independent rows as the rank, and the others; None where J_P has a lower one."""
        jacobian = self._equations.evaluate_scaled(home)[1][:, passive]
        from scipy.linalg import qr  # slow to import, and not needed without loops

        _, upper, pivots = qr(jacobian.T, mode="economic", pivoting=True)
        diagonal = np.abs(np.diag(upper))
        if (diagonal > tolerance * diagonal[0]).sum() < rank:
            return None
        rows, redundant = (np.sort(part).astype(np.intp) for part in np.split(pivots, [rank]))
        return rows, redundant

    def assess_redundancy(
        self, home: Array, independent_rows: Indices, redundant_rows: Indices, active: Indices
    ) -> tuple[LockedEquation, RedundancyGap]:
        """What locks the machine up beside home, or else how far surplus equations may open.

        Digits that are almost enough hold at home, and no longer half a turn away.
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
        decade = 10.0 ** np.ceil(np.log10(max(2 * gap, CLOSED_TOLERANCE)))  # code is shared by it
        return None, RedundancyGap(
            max(CLOSED_TOLERANCE, min(float(decade), FILE_PRECISION)), row, gap
        )


class RoundedConstraints(ExactConstraints):
    """Equations that hold to the digits of a file.

    Args:
        equations: All of them.
    """

    def __init__(self, equations: LoopEquations):
        super().__init__(equations)
        self.closed_tolerances = FILE_PRECISION * self._residual_units

    def close_loops(self, q: Array, movable: Indices) -> Array:
        """Least squares; what the digits contradict is left open, and moves nothing."""
        q = q.copy()
        for _ in range(200):
            phi, jacobian = self._equations.evaluate_scaled(q)
            if (np.abs(phi) < 10 * FILE_PRECISION).all():
                break
            q[movable] += (
                least_squares_step(jacobian[:, movable], phi) * self._coordinate_units[movable]
            )
        for _ in range(20):
            phi, jacobian = self._equations.evaluate_scaled(q)
            if not np.isfinite(jacobian).all():  # beyond all numbers: not closed
                break
            step = np.linalg.lstsq(jacobian[:, movable], -phi, rcond=_MIN_SINGULAR_VALUE_RATIO)[0]
            q[movable] += step * self._coordinate_units[movable]
            if not 1e-14 < np.abs(step).max(initial=0.0) < 1.0:
                break
        return q

    def intended_jacobian(self, q: Array) -> Array:
        """(m, nv) slopes without the singular values that are digits."""
        jacobian = self._equations.evaluate_scaled(q)[1]
        left, values, right = np.linalg.svd(jacobian, full_matrices=False)
        values[values < _MIN_SINGULAR_VALUE_RATIO * values[0]] = 0.0
        return np.asarray((left * values @ right) / self._coordinate_units)

    def find_locked_equation(self, q: Array, mobility: int, tolerance: float) -> LockedEquation:
        """Left to `assess_redundancy`, which looks farther."""
        return None

    def select_independent_rows(
        self, home: Array, passive: Indices, rank: int, tolerance: float
    ) -> tuple[Indices, Indices] | None:
        """Rows of the largest volume, and the others; None where J_P has a lower rank."""
        jacobian = self._equations.evaluate_scaled(home)[1][:, passive]
        left, values, _ = np.linalg.svd(jacobian, full_matrices=False)
        if rank != len(passive) or values[-1] < _MIN_SINGULAR_VALUE_RATIO * values[0]:
            return None
        rows = select_columns(left, range(len(jacobian)))
        return None if rows is None else (rows, np.setdiff1d(np.arange(len(jacobian)), rows))

    def assess_redundancy(
        self, home: Array, independent_rows: Indices, redundant_rows: Indices, active: Indices
    ) -> tuple[LockedEquation, RedundancyGap]:
        """What locks the machine up, or else how far surplus equations may open."""
        return self._assess_file_precision(home, independent_rows, redundant_rows, active)


def least_squares_step(jacobian: Array, phi: Array) -> Array:
    """A damped Gauss-Newton step towards phi = 0, at most 0.3 in any joint; all in shares."""
    gram = jacobian.T @ jacobian
    rounding = 1e-15 * float(gram.diagonal().max(initial=0.0))
    damping = 1e-12 + rounding + 1e-3 * float(phi @ phi)
    step = np.linalg.solve(gram + damping * np.eye(len(gram)), -jacobian.T @ phi)
    largest = float(np.abs(step).max(initial=0.0))
    return np.asarray(step * min(1.0, 0.3 / largest) if largest > 0 else step, dtype=np.float64)
