"""Stick-slip modes of joints: which of them slip and which are at rest, and when that changes.

The friction of a joint k with stiction is set-valued, F_k sign(v_k) with sign(0) = [-1, 1]. The
accelerations of joints at rest are the unique minimum of

    1/2 a^T M a - a^T f + sum F_k |Gamma_k a + d_k|,

with Gamma_k their rows of gamma and d_k their drift. This convex problem always has a solution,
also with more joints at rest than degrees of freedom. Its dual variables are the forces at rest r,

    min 1/2 |C^-1 (f - Gamma^T r)|^2 - d^T r,    |r_k| <= F_k,    M = C C^T,

a bounded least-squares problem (Moreau 1988; Glocker, Set-Valued Force Laws, 2001). Between the
transitions the motion is that of an ordinary differential equation.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from crane.closure.closure import Closure
from crane.closure.coordinates import Indices
from crane.common.one_line_repr import list_first
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.joint_forces import REST_VELOCITY
from crane.machine.machine import Machine

# accuracy of located events; see `StickSlipAccelerations.transition_margin`
EVENT_TOLERANCE = 1e-10
MAX_VELOCITY_CHANGE = 1e-6  # relative change of velocities by stopping a joint at rest
MAX_LIMIT_SHARE = 1.0 - 1e-12  # share of its breakaway force at which a joint slips
RANK_TOLERANCE = 1e-9  # share of the largest singular value, or of its norm, of zero rows
_MAX_NAMED_JOINTS = 4  # joints that a message names
_MAX_TRIALS = 200  # trial steps to locate an event

TrialStep = Callable[[float], tuple[Array, float]]
"""Step size [s] -> state and margin after the step."""


class StickSlipTransition(NamedTuple):
    """A stick-slip transition.

    Attributes:
        time: [s].
        state: State at the transition.
        slip_signs: (k,) see `StickSlipModes`, after the transition.
        is_held: (k,) see `StickSlipModes`, after the transition.
        is_moving: See `StickSlipModes`, after the transition.
    """

    time: float
    state: Array
    slip_signs: Array
    is_held: Array
    is_moving: bool


class StickSlipModes:
    """Stick-slip modes of the joints with stiction.

    Args:
        machine: The machine, in any coordinates.
        columns: Columns of these joints.

    Attributes:
        columns: Columns of the joints.
        slip_signs: (k,) signs of the slip velocities; of a joint at rest that is not held, its
            friction as a share of its breakaway force.
        is_held: (k,) whether a joint is held at rest by a constraint.
        is_moving: Whether the machine moves.
        has_modes: Whether the modes are known.
        is_undetermined: Whether the forces at rest were not unique.
        transitions: Transitions with the start as the first, if set to a list; else None.
    """

    def __init__(self, machine: Machine, columns: tuple[int, ...]):
        self.columns = list(columns)
        self._joints = [machine.joints[column] for column in columns]
        self._inverse_velocities = (
            machine.closure.characteristic_time / machine.closure.units[self.columns]
        )
        self.slip_signs = np.zeros(len(columns))
        self.is_held = np.zeros(len(columns), dtype=bool)
        self.is_moving, self.has_modes, self.is_undetermined = True, False, False
        self.transitions: list[StickSlipTransition] | None = None

    @property
    def notes(self) -> list[str]:
        """Notes for the user of a run."""
        if not self.is_undetermined:
            return []
        names = [f"'{joint}'" for joint in self._joints]
        return [
            f"friction of {list_first(names, 'joints', _MAX_NAMED_JOINTS)} holds the machine at "
            "rest in more ways than one: the motion is determined, how they share the load is "
            "not, and their 'rest_' channels are one way"
        ]

    def record_transition(self, time: float, state: Array) -> None:
        """Record the present modes as a transition at a time [s] and a state."""
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
        """Set the modes of the dynamics of a machine."""
        dynamics.set_stick_slip_modes(
            self.slip_signs,
            self.is_held.astype(np.float64),
            self._inverse_velocities,
            self.is_moving,
        )

    def find_modes(self, dynamics: Dynamics, q: Array, v_a: Array, tau: Array) -> Array:
        """Determine the modes at a closed configuration.

        Args:
            dynamics: Dynamics of the machine, whose modes are set; it has the circuit friction.
            q: (nq,) configuration.
            v_a: (n,) active velocities.
            tau: (n,) forces along the same coordinates.

        Returns:
            (n,) velocities, exactly 0 for joints at rest.
        """
        closure, n, k = dynamics.machine.closure, len(v_a), len(self.columns)
        parts = dynamics.evaluate_closed("resting", q, v_a, tau)
        mass, rows = parts[: n * n].reshape(n, n), parts[n * n : n * (n + k)].reshape(k, n)
        v = rows @ v_a
        # rounding moves held joints
        rest_velocities = np.where(self.is_held, MAX_VELOCITY_CHANGE, REST_VELOCITY)
        resting: Indices = np.flatnonzero(np.abs(v) * self._inverse_velocities <= rest_velocities)
        try:
            whitening = np.linalg.inv(np.linalg.cholesky(mass)).astype(np.float64)
        except np.linalg.LinAlgError as error:
            raise dynamics.singular_mass_error(q) or error from None
        if len(resting) and v_a.any():
            v_a = self._remove_resting_velocities(
                closure, mass, whitening, resting, rows[resting], v[resting], v_a
            )
            v = rows @ v_a
        self.slip_signs[:] = np.sign(v)
        self.is_held[:], self.is_moving = False, True
        self.slip_signs[resting], self.has_modes = 0.0, True
        self.apply_to(dynamics)
        if not len(resting):
            return v_a
        parts = dynamics.evaluate_closed("resting", q, v_a, tau)
        drift, net_force = parts[n * (n + k) : -n][resting], whitening @ parts[-n:]
        limits = dynamics.forces.breakaway[resting]
        holding_forces = whitening @ rows[resting].T * limits
        if drift.any():
            net_force += np.linalg.lstsq(holding_forces.T, limits * drift, rcond=None)[0]
        limit_shares = _bounded_least_squares(holding_forces, net_force)
        below_limit = np.flatnonzero(np.abs(limit_shares) < MAX_LIMIT_SHARE)
        independent, rank = _independent_columns(
            holding_forces[:, below_limit] * (1.0 - np.abs(limit_shares[below_limit]))
        )
        self.slip_signs[resting] = np.where(
            np.abs(limit_shares) < MAX_LIMIT_SHARE, limit_shares, np.sign(limit_shares)
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
        mass: Array,
        whitening: Array,
        candidates: Indices,
        rows: Array,
        v: Array,
        v_a: Array,
    ) -> Array:
        """Velocities after joints at rest are stopped by least impulses.

        A joint at a reversal while others move is not at rest. `whitening` is C^-1 of M = C C^T.
        """
        impulse_directions = whitening @ rows.T
        rates = closure.characteristic_time / closure.units[closure.active]
        sizes = np.maximum((impulse_directions**2).sum(0), 1e-300)
        velocity_changes = whitening.T @ (impulse_directions * (v / sizes)) * rates[:, None]
        is_resting = np.abs(velocity_changes).max(0) <= MAX_VELOCITY_CHANGE
        candidates, impulse_directions = candidates[is_resting], impulse_directions[:, is_resting]
        if not len(candidates):
            return v_a
        basis = impulse_directions / np.sqrt(sizes[is_resting])
        if len(candidates) > 1:
            basis, values, _ = np.linalg.svd(impulse_directions, full_matrices=False)
            basis = basis[:, values > RANK_TOLERANCE * values[0]]
        out = np.zeros_like(v_a)
        if basis.shape[1] < len(v_a):
            momentum = whitening @ (mass @ v_a)  # C^T v
            out[:] = whitening.T @ (momentum - basis @ (basis.T @ momentum))
        out[np.isin(closure.active, np.take(self.columns, candidates))] = 0.0
        return out if np.abs((out - v_a) * rates).max() <= MAX_VELOCITY_CHANGE else v_a


def _bounded_least_squares(matrix: Array, right_side: Array) -> Array:
    """The x (k,) within -1 and 1 of least |right_side - matrix x|, and of these the smallest."""
    if matrix.shape[1] == 1:  # the usual case, one joint comes to rest
        return np.clip(matrix.T @ right_side / max((matrix**2).sum(), 1e-300), -1.0, 1.0)
    shares, _, rank, _ = np.linalg.lstsq(matrix, right_side, rcond=None)
    is_bounded = np.abs(shares) > 1.0
    if not is_bounded.any():
        return shares.astype(np.float64)
    # set violated bounds active and solve for the others: optimal under the conditions of Karush,
    # Kuhn and Tucker
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
    """Indices of independent columns, and the rank.

    Columns are compared with their own norm: a breakaway force may be small.
    """
    count = columns.shape[1]
    column_norms = np.linalg.norm(columns, axis=0)
    # the distance of a unit column from the span of others is at least the singular value
    if count == 1 and column_norms.all():
        return np.arange(1), 1
    if count <= len(columns) and column_norms.all():
        least_singular_value = np.linalg.svd(columns / column_norms, compute_uv=False).min(
            initial=1.0
        )
        if least_singular_value > 2.0 * RANK_TOLERANCE:
            return np.arange(count), count
    from scipy.linalg import qr  # slow to call

    upper, order = qr(columns, mode="r", pivoting=True)
    sizes = np.abs(np.diag(upper))
    rank = int((sizes > RANK_TOLERANCE * column_norms[order[: len(sizes)]]).sum())
    return np.asarray(order[:rank], dtype=np.intp), rank


def locate_event(
    trial: TrialStep, margin_before: float, length: float, margin_behind: float
) -> tuple[float, Array]:
    """The step that ends at a stick-slip transition, by the secant method with bisection.

    Args:
        trial: Makes a step of a given size.
        margin_before: Margin at the start, at least -`EVENT_TOLERANCE`.
        length: Size of a step beyond the transition [s].
        margin_behind: Margin after this step, below -`EVENT_TOLERANCE`.

    Returns:
        Step size [s] and state, with a margin between -1 and -2 `EVENT_TOLERANCE`, or where the
        margin jumps.
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
        if abs(side) >= 3:  # one end does not move: bisect
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
