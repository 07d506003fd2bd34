"""Joints that stick: which of them slip and which are at rest, and when that changes.

Friction of a joint k that sticks is set-valued, F_k sign(v_k) with sign(0) = [-1, 1]. The
accelerations of those at rest are the unique ones of least

    1/2 a^T M a - a^T f + sum F_k |Gamma_k a + d_k|,

with Gamma_k their rows of gamma and d_k their drift; a convex problem with an answer always, also
where more joints stick than there are freedoms. Its dual are the forces at rest r,

    min 1/2 |C^-1 (f - Gamma^T r)|^2 - d^T r,    |r_k| <= F_k,    M = C C^T,

bounded least squares (Moreau 1988; Glocker, Set-Valued Force Laws, 2001). Between the instants
where a joint starts or stops, the motion is that of an ordinary differential equation.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from crane.closure import Closure
from crane.closure.structure import Indices
from crane.common.samples import Array
from crane.dynamics import Dynamics
from crane.dynamics.joint_forces import AT_REST
from crane.machine import Machine

NEAR = 1e-10  # how far beyond a margin an event is that has been found; see `Moved.margin`
_JERK = 1e-6  # of velocities, what no joint at rest changes when it is brought to it
_FULL = 1.0 - 1e-12  # share of its limit from which a joint at rest gives way
_INDEPENDENT = 1e-9  # of the largest, or of its own size, what rows that are independent have
_SHOWN = 4  # joints that are named
_HALVES = 200  # trials until an event is found

Trial = Callable[[float], tuple[Array, float]]
"""Length of a step [s] -> the state behind it and the margin there."""


class Switch(NamedTuple):
    """A joint that starts or stops.

    Attributes:
        time: [s].
        state: Then.
        slip: (k,) see `Sticking`, from then on.
        held: (k,) likewise.
        moving: Likewise.
    """

    time: float
    state: Array
    slip: Array
    held: Array
    moving: bool


class Sticking:
    """What the joints of a machine do whose friction sticks.

    Args:
        machine: The machine, in any coordinates.
        columns: Of these joints.

    Attributes:
        columns: The same.
        slip: (k,) signs of slips; of a joint at rest, the share of its limit, where others take
            what is left.
        held: (k,) whether a joint is kept at rest by whatever that takes.
        moving: Whether anything moves.
        settled: Whether all this has been found.
        undetermined: Whether forces at rest were, of joints that hold the same.
        switches: What has happened, the start first, of who asks for it by an empty list.
    """

    def __init__(self, machine: Machine, columns: tuple[int, ...]):
        self.columns = list(columns)
        self._joints = [machine.joints[column] for column in columns]
        units = machine.closure.units[self.columns]
        self._pace = machine.closure.pace / units
        self.slip = np.zeros(len(columns))
        self.held = np.zeros(len(columns), dtype=bool)
        self.moving, self.settled, self.undetermined = True, False, False
        self.switches: list[Switch] | None = None

    @property
    def notes(self) -> list[str]:
        """What is to be said of them."""
        if not self.undetermined:
            return []
        names = [f"'{joint}'" for joint in self._joints]
        more = f" and {len(names) - _SHOWN} more joints" if len(names) > _SHOWN else ""
        return [
            f"friction of {', '.join(names[:_SHOWN])}{more} holds the machine at rest in more "
            "ways than one: the motion is determined, how they share the load is not, and their "
            "'rest_' channels are one way"
        ]

    def note(self, time: float, state: Array) -> None:
        """Remember what has changed at a time [s] and a state, if asked to."""
        if self.switches is not None:
            now = Switch(
                time, state.copy(), self.slip.copy(), self.held.astype(float), self.moving
            )
            self.switches.append(now)

    def tell(self, dynamics: Dynamics) -> None:
        """Make the present modes those of a machine's dynamics."""
        dynamics.set_modes(self.slip, self.held.astype(np.float64), self._pace, self.moving)

    def settle(self, dynamics: Dynamics, q: Array, v_a: Array, tau: Array) -> Array:
        """Find the modes at a closed posture.

        Args:
            dynamics: Of the machine; it is told the modes, and knows what a circuit adds to
                friction.
            q: (nq,).
            v_a: (n,).
            tau: (n,) forces along the same coordinates.

        Returns:
            (n,) velocities, in which what is at rest is so to the last bit.
        """
        closure, n, k = dynamics.machine.closure, len(v_a), len(self.columns)
        parts = dynamics.at("resting", q, v_a, tau)
        mass, rows = parts[: n * n].reshape(n, n), parts[n * n : n * (n + k)].reshape(k, n)
        v = rows @ v_a
        rest: Indices = np.flatnonzero(np.abs(v) * self._pace <= AT_REST)
        half = np.linalg.cholesky(mass).astype(np.float64)
        if len(rest) and v_a.any():
            v_a = self._stopped(closure, half, rest, rows[rest], v[rest], v_a)
            v = rows @ v_a
        self.slip[:] = np.sign(v)
        self.held[:], self.moving = False, True
        self.slip[rest], self.settled = 0.0, True
        self.tell(dynamics)
        if not len(rest):
            return v_a
        parts = dynamics.at("resting", q, v_a, tau)
        drift, net = parts[n * (n + k) : -n], np.linalg.solve(half, parts[-n:])
        limits = dynamics.forces.breakaway[rest]
        reach = np.linalg.solve(half, rows[rest].T) * limits
        bent = np.linalg.lstsq(reach.T, limits * drift[rest], rcond=None)[0]
        shares = _bounded(reach, net + bent)
        holding = np.flatnonzero(np.abs(shares) < _FULL)
        independent, rank = _independent(reach[:, holding] * (1.0 - np.abs(shares[holding])))
        self.slip[rest] = np.where(np.abs(shares) < _FULL, shares, np.sign(shares))
        kept = rest[holding[independent]]
        self.slip[kept], self.held[kept] = 0.0, True
        self.undetermined |= len(holding) > rank
        self.moving = bool(v_a.any()) or rank < len(v_a)
        self.tell(dynamics)
        return v_a

    def _stopped(
        self, closure: Closure, half: Array, rest: Indices, rows: Array, v: Array, v_a: Array
    ) -> Array:
        """Velocities without those of joints at rest, by the least impulses.

        A joint that turns while others move on is not at rest.
        """
        reach = np.linalg.solve(half, rows.T)
        momentum = half.T @ v_a
        rates = closure.pace / closure.units[closure.active]
        sizes = np.maximum((reach**2).sum(0), 1e-300)
        jerks = np.linalg.solve(half.T, reach * (v / sizes)) * rates[:, None]
        resting = np.abs(jerks).max(0) <= _JERK
        rest, reach = rest[resting], reach[:, resting]
        if not len(rest):
            return v_a
        basis, values, _ = np.linalg.svd(reach, full_matrices=False)
        basis = basis[:, values > _INDEPENDENT * values[0]]
        out = np.zeros_like(v_a)
        if basis.shape[1] < len(v_a):
            out[:] = np.linalg.solve(half.T, momentum - basis @ (basis.T @ momentum))
        out[np.isin(closure.active, np.array(self.columns)[rest])] = 0.0
        return out if np.abs((out - v_a) * rates).max() <= _JERK else v_a


def _bounded(reach: Array, net: Array) -> Array:
    """Shares (k,) of the limits, least |net - reach shares|; of many the smallest."""
    shares, _, rank, _ = np.linalg.lstsq(reach, net, rcond=None)
    full = np.abs(shares) > 1.0
    if not full.any():
        return shares.astype(np.float64)
    # those beyond their limits on them, and the others anew: the least if these are within theirs
    # and no slope leads back from a limit (Karush, Kuhn and Tucker's conditions)
    found = np.where(full, np.sign(shares), 0.0)
    found[~full] = np.linalg.lstsq(reach[:, ~full], net - reach @ found, rcond=None)[0]
    slopes = reach.T @ (net - reach @ found)
    least = np.abs(found).max() <= 1.0 and (slopes * found)[full].min() >= 0.0
    if least and rank == len(shares):
        return found
    from scipy.optimize import lsq_linear  # slow to import

    return np.asarray(lsq_linear(reach, net, (-1.0, 1.0), method="bvls", tol=1e-15).x)


def _independent(columns: Array) -> tuple[Indices, int]:
    """Indices of columns that span them all, and how many there are.

    Each is looked at in its own size: a limit may be next to nothing, of a brake that is released.
    """
    count = columns.shape[1]
    own = np.linalg.norm(columns, axis=0)
    # a column of length 1 is no nearer to what others span than their least singular value
    if count <= len(columns) and own.all():
        least = np.linalg.svd(columns / own, compute_uv=False).min(initial=1.0)
        if least > 2.0 * _INDEPENDENT:
            return np.arange(count), count
    from scipy.linalg import qr  # slow to import

    upper, order = qr(columns, mode="r", pivoting=True)
    sizes = np.abs(np.diag(upper))
    rank = int((sizes > _INDEPENDENT * own[order[: len(sizes)]]).sum())
    return np.asarray(order[:rank], dtype=np.intp), rank


def located(trial: Trial, before: float, length: float, behind: float) -> tuple[float, Array]:
    """The step that ends where a joint starts or stops, by the secant method with safeguards.

    Args:
        trial: Makes a step of some length.
        before: Margin at its beginning, not below -`NEAR`.
        length: Of a step beyond the event [s].
        behind: Margin behind it, below -`NEAR`.

    Returns:
        Length [s] and the state then, from 1 to 2 `NEAR` beyond the margin, or where it jumps.
    """
    lower, low, upper, high = 0.0, before, length, behind
    aim, side = -1.5 * NEAR, 0
    state = None
    for _ in range(_HALVES):
        if state is not None and high >= -2.0 * NEAR:
            break
        gap = low - high
        share = (low - aim) / gap if 0.0 < gap < np.inf else 0.5
        middle = lower + min(max(share, 1e-3), 1.0 - 1e-3) * (upper - lower)
        if abs(side) >= 3:  # one end stays: halve
            middle, side = 0.5 * (lower + upper), 0
        if not lower < middle < upper or upper - lower < 1e-14 * length:
            break
        there, margin = trial(middle)
        if margin >= -NEAR:
            lower, low, side = middle, margin, max(side, 0) + 1
        else:
            upper, high, state, side = middle, margin, there, min(side, 0) - 1
    if state is None:
        state, _ = trial(upper)
    return upper, state
