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
from crane.closure.constraint_structure import Indices
from crane.common.samples import Array
from crane.dynamics import Dynamics
from crane.dynamics.joint_forces import REST_VELOCITY
from crane.machine import Machine

# how far beyond a margin an event is that has been found; see
# `StickSlipAccelerations.transition_margin`
EVENT_TOLERANCE = 1e-10
_MAX_VELOCITY_CHANGE = (
    1e-6  # of velocities, what no joint at rest changes when it is brought to it
)
_MAX_LIMIT_SHARE = 1.0 - 1e-12  # share of its limit from which a joint at rest gives way
_RANK_TOLERANCE = 1e-9  # of the largest, or of its own size, what rows that are independent have
_MAX_NAMED_JOINTS = 4  # joints that are named
_MAX_TRIALS = 200  # trials until an event is found

TrialStep = Callable[[float], tuple[Array, float]]
"""Length of a step [s] -> the state behind it and the margin there."""


class StickSlipTransition(NamedTuple):
    """A joint that starts or stops.

    Attributes:
        time: [s].
        state: Then.
        slip_signs: (k,) see `StickSlipModes`, from then on.
        is_held: (k,) likewise.
        is_moving: Likewise.
    """

    time: float
    state: Array
    slip_signs: Array
    is_held: Array
    is_moving: bool


class StickSlipModes:
    """What the joints of a machine do whose friction sticks.

    Args:
        machine: The machine, in any coordinates.
        columns: Of these joints.

    Attributes:
        columns: The same.
        slip_signs: (k,) signs of slips; of a joint at rest, the share of its limit, where others
            take what is left.
        is_held: (k,) whether a joint is kept at rest by whatever that takes.
        is_moving: Whether anything moves.
        has_modes: Whether all this has been found.
        is_undetermined: Whether forces at rest were, of joints that hold the same.
        transitions: What has happened, the start first, of who asks for it by an empty list.
    """

    def __init__(self, machine: Machine, columns: tuple[int, ...]):
        self.columns = list(columns)
        self._joints = [machine.joints[column] for column in columns]
        units = machine.closure.units[self.columns]
        self._inverse_velocities = machine.closure.characteristic_time / units
        self.slip_signs = np.zeros(len(columns))
        self.is_held = np.zeros(len(columns), dtype=bool)
        self.is_moving, self.has_modes, self.is_undetermined = True, False, False
        self.transitions: list[StickSlipTransition] | None = None

    @property
    def notes(self) -> list[str]:
        """What is to be said of them."""
        if not self.is_undetermined:
            return []
        names = [f"'{joint}'" for joint in self._joints]
        more = (
            f" and {len(names) - _MAX_NAMED_JOINTS} more joints"
            if len(names) > _MAX_NAMED_JOINTS
            else ""
        )
        return [
            f"friction of {', '.join(names[:_MAX_NAMED_JOINTS])}{more} holds the machine at "
            f"rest in more "
            "ways than one: the motion is determined, how they share the load is not, and their "
            "'rest_' channels are one way"
        ]

    def record_transition(self, time: float, state: Array) -> None:
        """Remember what has changed at a time [s] and a state, if asked to."""
        if self.transitions is not None:
            transition = StickSlipTransition(
                time,
                state.copy(),
                self.slip_signs.copy(),
                self.is_held.astype(float),
                self.is_moving,
            )
            self.transitions.append(transition)

    def apply_to(self, dynamics: Dynamics) -> None:
        """Make the present modes those of a machine's dynamics."""
        dynamics.set_stick_slip_modes(
            self.slip_signs,
            self.is_held.astype(np.float64),
            self._inverse_velocities,
            self.is_moving,
        )

    def find_modes(self, dynamics: Dynamics, q: Array, v_a: Array, tau: Array) -> Array:
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
        parts = dynamics.evaluate_closed("resting", q, v_a, tau)
        mass, rows = parts[: n * n].reshape(n, n), parts[n * n : n * (n + k)].reshape(k, n)
        v = rows @ v_a
        resting: Indices = np.flatnonzero(np.abs(v) * self._inverse_velocities <= REST_VELOCITY)
        cholesky_factor = np.linalg.cholesky(mass).astype(np.float64)
        if len(resting) and v_a.any():
            v_a = self._remove_resting_velocities(
                closure, cholesky_factor, resting, rows[resting], v[resting], v_a
            )
            v = rows @ v_a
        self.slip_signs[:] = np.sign(v)
        self.is_held[:], self.is_moving = False, True
        self.slip_signs[resting], self.has_modes = 0.0, True
        self.apply_to(dynamics)
        if not len(resting):
            return v_a
        parts = dynamics.evaluate_closed("resting", q, v_a, tau)
        drift, net_force = parts[n * (n + k) : -n], np.linalg.solve(cholesky_factor, parts[-n:])
        limits = dynamics.forces.breakaway[resting]
        holding_forces = np.linalg.solve(cholesky_factor, rows[resting].T) * limits
        drift_term = np.linalg.lstsq(holding_forces.T, limits * drift[resting], rcond=None)[0]
        limit_shares = _bounded_least_squares(holding_forces, net_force + drift_term)
        below_limit = np.flatnonzero(np.abs(limit_shares) < _MAX_LIMIT_SHARE)
        independent, rank = _independent_columns(
            holding_forces[:, below_limit] * (1.0 - np.abs(limit_shares[below_limit]))
        )
        self.slip_signs[resting] = np.where(
            np.abs(limit_shares) < _MAX_LIMIT_SHARE, limit_shares, np.sign(limit_shares)
        )
        held_joints = resting[below_limit[independent]]
        self.slip_signs[held_joints], self.is_held[held_joints] = 0.0, True
        self.is_undetermined |= len(below_limit) > rank
        self.is_moving = bool(v_a.any()) or rank < len(v_a)
        self.apply_to(dynamics)
        return v_a

    def _remove_resting_velocities(
        self,
        closure: Closure,
        cholesky_factor: Array,
        candidates: Indices,
        rows: Array,
        v: Array,
        v_a: Array,
    ) -> Array:
        """Velocities without those of joints at rest, by the least impulses.

        A joint that turns while others move on is not at rest.
        """
        impulse_directions = np.linalg.solve(cholesky_factor, rows.T)
        momentum = cholesky_factor.T @ v_a
        rates = closure.characteristic_time / closure.units[closure.active]
        sizes = np.maximum((impulse_directions**2).sum(0), 1e-300)
        velocity_changes = (
            np.linalg.solve(cholesky_factor.T, impulse_directions * (v / sizes)) * rates[:, None]
        )
        is_resting = np.abs(velocity_changes).max(0) <= _MAX_VELOCITY_CHANGE
        candidates, impulse_directions = candidates[is_resting], impulse_directions[:, is_resting]
        if not len(candidates):
            return v_a
        basis, values, _ = np.linalg.svd(impulse_directions, full_matrices=False)
        basis = basis[:, values > _RANK_TOLERANCE * values[0]]
        out = np.zeros_like(v_a)
        if basis.shape[1] < len(v_a):
            out[:] = np.linalg.solve(cholesky_factor.T, momentum - basis @ (basis.T @ momentum))
        out[np.isin(closure.active, np.array(self.columns)[candidates])] = 0.0
        return out if np.abs((out - v_a) * rates).max() <= _MAX_VELOCITY_CHANGE else v_a


def _bounded_least_squares(matrix: Array, right_side: Array) -> Array:
    """Shares (k,) of the limits, least |net - reach shares|; of many the smallest."""
    shares, _, rank, _ = np.linalg.lstsq(matrix, right_side, rcond=None)
    is_bounded = np.abs(shares) > 1.0
    if not is_bounded.any():
        return shares.astype(np.float64)
    # those beyond their limits on them, and the others anew: the least if these are within theirs
    # and no slope leads back from a limit (Karush, Kuhn and Tucker's conditions)
    solution = np.where(is_bounded, np.sign(shares), 0.0)
    solution[~is_bounded] = np.linalg.lstsq(
        matrix[:, ~is_bounded], right_side - matrix @ solution, rcond=None
    )[0]
    gradient = matrix.T @ (right_side - matrix @ solution)
    is_optimal = np.abs(solution).max() <= 1.0 and (gradient * solution)[is_bounded].min() >= 0.0
    if is_optimal and rank == len(shares):
        return solution
    from scipy.optimize import lsq_linear  # slow to import

    return np.asarray(lsq_linear(matrix, right_side, (-1.0, 1.0), method="bvls", tol=1e-15).x)


def _independent_columns(columns: Array) -> tuple[Indices, int]:
    """Indices of columns that span them all, and how many there are.

    Each is looked at in its own size: a limit may be next to nothing, of a brake that is released.
    """
    count = columns.shape[1]
    column_norms = np.linalg.norm(columns, axis=0)
    # a column of length 1 is no nearer to what others span than their least singular value
    if count <= len(columns) and column_norms.all():
        least_singular_value = np.linalg.svd(columns / column_norms, compute_uv=False).min(
            initial=1.0
        )
        if least_singular_value > 2.0 * _RANK_TOLERANCE:
            return np.arange(count), count
    from scipy.linalg import qr  # slow to import

    upper, order = qr(columns, mode="r", pivoting=True)
    sizes = np.abs(np.diag(upper))
    rank = int((sizes > _RANK_TOLERANCE * column_norms[order[: len(sizes)]]).sum())
    return np.asarray(order[:rank], dtype=np.intp), rank


def locate_event(
    trial: TrialStep, margin_before: float, length: float, margin_behind: float
) -> tuple[float, Array]:
    """The step that ends where a joint starts or stops, by the secant method with safeguards.

    Args:
        trial: Makes a step of some length.
        margin_before: Margin at its beginning, not below -`EVENT_TOLERANCE`.
        length: Of a step beyond the event [s].
        margin_behind: Margin behind it, below -`EVENT_TOLERANCE`.

    Returns:
        Length [s] and the state then, from 1 to 2 `EVENT_TOLERANCE` beyond the margin, or where it
        jumps.
    """
    lower, low, upper, high = 0.0, margin_before, length, margin_behind
    target_margin, side = -1.5 * EVENT_TOLERANCE, 0
    state = None
    for _ in range(_MAX_TRIALS):
        if state is not None and high >= -2.0 * EVENT_TOLERANCE:
            break
        gap = low - high
        share = (low - target_margin) / gap if 0.0 < gap < np.inf else 0.5
        middle = lower + min(max(share, 1e-3), 1.0 - 1e-3) * (upper - lower)
        if abs(side) >= 3:  # one end stays: halve
            middle, side = 0.5 * (lower + upper), 0
        if not lower < middle < upper or upper - lower < 1e-14 * length:
            break
        trial_state, margin = trial(middle)
        if margin >= -EVENT_TOLERANCE:
            lower, low, side = middle, margin, max(side, 0) + 1
        else:
            upper, high, state, side = middle, margin, trial_state, min(side, 0) - 1
    if state is None:
        state, _ = trial(upper)
    return upper, state
