"""How exactly loop equations hold: to rounding, or to the digits that a file was written with.

A planar linkage in space has more equations than it needs. Written with few digits, its axes are
not quite parallel and its pins not quite in one plane, so the surplus equations contradict the
others by that much: taken at their word they leave the linkage no freedom. With

    J D = U S V^T        rows and columns in shares of the machine's size and in rad

singular values below 1e-3 of the largest are digits, and are cut off: what remains has the rank of
the linkage that was meant. As many independent equations as that rank are chosen and closed to
rounding. They span the largest volume, so that each other row of U is a combination of theirs with
factors of at most 1 (see `crane.closure.choice.choose`): surplus equations stay open by no more
than the sum of what the digits contradict, nowhere magnified.

That they are digits shows when the machine moves: over a turn, or its limits, they stay below 1e-4
of the machine's size. What locks up opens further than that.
"""

from dataclasses import dataclass

import numpy as np

from crane.closure.choice import Indices, choose
from crane.closure.equations import LoopEquations
from crane.closure.mobility import locked_up, surplus_along, surplus_open
from crane.common.samples import Array

# in rad and shares of the machine's size, so that these are the same machine at any scale
CLOSED = 1e-9
DIGITS = 1e-4  # what counts as digits
_MEANT = 1e-3  # share of the largest singular value from which on one is meant
_ROUNDING = 1e-12  # of surplus equations that hold to rounding
_OPEN = 1e-9  # of those that lock a machine up


@dataclass(frozen=True)
class Surplus:
    """How far surplus equations may be open.

    Attributes:
        allowed: What they may be open by [rad], [machine's size].
        row: The one that is open by most on the way that was looked at, -1 for exact ones.
        gap: By how much it is, likewise.
    """

    allowed: float = CLOSED
    row: int = -1
    gap: float = 0.0


# the row that stays open by most, and by how much [rad], [machine's size]
Lock = tuple[int, float] | None


class Exact:
    """Equations that hold to rounding.

    Args:
        equations: All of them.

    Attributes:
        closed: (m,) what residuals of closed loops are at most [m], [rad].
    """

    closed: Array

    def __init__(self, equations: LoopEquations):
        self._equations = equations
        self._share, self._unit = equations.row_units, equations.units
        self.closed = CLOSED * self._share

    def is_closed(self, q: Array) -> bool:
        """Whether all loops are closed."""
        return bool((np.abs(self._equations.evaluate(q)[0]) < self.closed).all())

    def close(self, q: Array, free: Indices) -> Array:
        """Close all loops by moving the free joints; the residual tells whether that worked."""
        q = q.copy()
        for _ in range(200):
            phi, jacobian = self._equations.scaled(q)
            if np.abs(phi).max(initial=0.0) < 1e-13:
                break
            q[free] += least_squares_step(jacobian[:, free], phi) * self._unit[free]
        return q

    def jacobian(self, q: Array) -> Array:
        """(m, nv) slopes of the equations as they were meant, in shares of the machine's size."""
        return self._equations.evaluate(q)[1] / self._share[:, None]

    def locked_up(self, q: Array, freedom: int, tolerance: float) -> Lock:
        """See `crane.closure.mobility.locked_up`."""
        everything = np.arange(self._equations.model.nv)
        return locked_up(
            self._equations, q, freedom, tolerance, lambda near: self.close(near, everything)
        )

    def independent(
        self, home: Array, passive: Indices, rank: int, tolerance: float
    ) -> tuple[Indices, Indices] | None:
        """As many independent rows as the rank, and the others; None where J_P has a lower one."""
        jacobian = self._equations.scaled(home)[1][:, passive]
        from scipy.linalg import qr  # slow to import, and not needed without loops

        _, upper, pivots = qr(jacobian.T, mode="economic", pivoting=True)
        diagonal = np.abs(np.diag(upper))
        if (diagonal > tolerance * diagonal[0]).sum() < rank:
            return None
        rows, redundant = (np.sort(part).astype(np.intp) for part in np.split(pivots, [rank]))
        return rows, redundant

    def surplus(
        self, home: Array, rows: Indices, redundant: Indices, active: Indices
    ) -> tuple[Lock, Surplus]:
        """What locks the machine up beside home, or else how far surplus equations may open.

        Digits that are almost enough hold at home, and no longer half a turn away.
        """
        lock = surplus_open(self._equations, home, rows, redundant, active)
        if lock is None or lock[1] <= _ROUNDING:
            return None, Surplus()
        if lock[1] > _OPEN:
            return lock, Surplus()
        return None, self._digits(home, rows, redundant, active)[1]

    def _digits(
        self, home: Array, rows: Indices, redundant: Indices, active: Indices
    ) -> tuple[Lock, Surplus]:
        if not len(redundant):
            return None, Surplus()
        widest, moves = surplus_along(self._equations, home, rows, redundant, active)
        worst = int(widest.argmax())
        row, gap = int(redundant[worst]), float(widest[worst])
        if gap > DIGITS or not moves:
            return (row, gap), Surplus()
        decade = 10.0 ** np.ceil(np.log10(max(2 * gap, CLOSED)))  # code is shared by it
        return None, Surplus(max(CLOSED, min(float(decade), DIGITS)), row, gap)


class Rounded(Exact):
    """Equations that hold to the digits of a file.

    Args:
        equations: All of them.
    """

    def __init__(self, equations: LoopEquations):
        super().__init__(equations)
        self.closed = DIGITS * self._share

    def close(self, q: Array, free: Indices) -> Array:
        """Least squares; what the digits contradict is left open, and moves nothing."""
        q = q.copy()
        for _ in range(200):
            phi, jacobian = self._equations.scaled(q)
            if (np.abs(phi) < 10 * DIGITS).all():
                break
            q[free] += least_squares_step(jacobian[:, free], phi) * self._unit[free]
        for _ in range(20):
            phi, jacobian = self._equations.scaled(q)
            if not np.isfinite(jacobian).all():  # beyond all numbers: not closed
                break
            step = np.linalg.lstsq(jacobian[:, free], -phi, rcond=_MEANT)[0]
            q[free] += step * self._unit[free]
            if not 1e-14 < np.abs(step).max(initial=0.0) < 1.0:
                break
        return q

    def jacobian(self, q: Array) -> Array:
        """(m, nv) slopes without the singular values that are digits."""
        slope = self._equations.scaled(q)[1]
        left, values, right = np.linalg.svd(slope, full_matrices=False)
        values[values < _MEANT * values[0]] = 0.0
        return np.asarray((left * values @ right) / self._unit)

    def locked_up(self, q: Array, freedom: int, tolerance: float) -> Lock:
        """Left to `surplus`, which looks farther."""
        return None

    def independent(
        self, home: Array, passive: Indices, rank: int, tolerance: float
    ) -> tuple[Indices, Indices] | None:
        """Rows of the largest volume, and the others; None where J_P has a lower rank."""
        slope = self._equations.scaled(home)[1][:, passive]
        left, values, _ = np.linalg.svd(slope, full_matrices=False)
        if rank != len(passive) or values[-1] < _MEANT * values[0]:
            return None
        rows = choose(left, range(len(slope)))
        return None if rows is None else (rows, np.setdiff1d(np.arange(len(slope)), rows))

    def surplus(
        self, home: Array, rows: Indices, redundant: Indices, active: Indices
    ) -> tuple[Lock, Surplus]:
        """What locks the machine up, or else how far surplus equations may open."""
        return self._digits(home, rows, redundant, active)


def least_squares_step(jacobian: Array, phi: Array) -> Array:
    """A damped Gauss-Newton step towards phi = 0, at most 0.3 in any joint; all in shares."""
    gram = jacobian.T @ jacobian
    rounding = 1e-15 * float(gram.diagonal().max(initial=0.0))
    damping = 1e-12 + rounding + 1e-3 * float(phi @ phi)
    step = np.linalg.solve(gram + damping * np.eye(len(gram)), -jacobian.T @ phi)
    largest = float(np.abs(step).max(initial=0.0))
    return np.asarray(step * min(1.0, 0.3 / largest) if largest > 0 else step, dtype=np.float64)
