"""Selection of active joints, and the condition number of a selection.

With the Jacobian J of the loop equations at a closed configuration, D = diag(scales) and an
orthonormal basis N (nv, n) of the null space of J D, the motions of the machine are v = D N y.
For n active joints A, v_A = D_A N_A y, so that the scaled derivative of all joints with respect
to the active ones is

    D^-1 gamma D_A = N N_A^-1,    condition number = ||D^-1 gamma D_A||_2 = 1 / sigma_min(N_A).

It is 1 where no other joint moves, and infinite at a dead centre: sigma_min(N_A) is also the least
singular value of J_P once the rows of J D are orthonormal. It depends neither on how the equations
are written nor on units, see `Coordinates.motion_scales`.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crane.closure.coordinates import Indices
from crane.closure.loop_equations import LoopEquations
from crane.common.samples import Array

# sigma_min below which a selection drives nothing at home, see `constraint_structure`
DEAD_CENTRE_TOLERANCE = 1e-5
_UNDRIVEN_NAME = re.compile("passive|free", re.IGNORECASE)  # names of undriven joints
# condition number up to which actuators are preferred
_MAX_ACTUATOR_CONDITION = 100.0
_MAX_EXCHANGES = 200
_ROUNDING_TOLERANCE = 1e-9  # relative difference that counts as rounding


@dataclass(frozen=True)
class ActiveJointSelection:
    """A set of active joints with its condition number at home.

    Attributes:
        joints: Names of the joints, in the order of the tree.
        condition_number: See the module.
    """

    joints: tuple[str, ...]
    condition_number: float

    def __str__(self) -> str:
        return f"[{', '.join(self.joints)}] (condition {self.condition_number:.3g})"


def null_space_basis(jacobian: Array, scales_of_motion: Array, tolerance: float) -> Array:
    """N (nv, n): orthonormal basis of the scaled motions that the equations allow to first order.

    Args:
        jacobian: (m, nv).
        scales_of_motion: (nv,).
        tolerance: Singular values below this fraction of the largest one count as zero.
    """
    if not jacobian.size:
        return np.eye(len(scales_of_motion))
    _, values, right = np.linalg.svd(jacobian * scales_of_motion)
    return np.asarray(right[int((values > tolerance * values[0]).sum()) :].T)


def condition_number(gamma: Array, scales_of_motion: Array, active: Indices) -> Array:
    """Condition numbers of a selection of active joints.

    Args:
        gamma: (nv, n) or (N, nv, n), of closed configurations.
        scales_of_motion: (nv,), see `Coordinates.motion_scales`.
        active: (n,) columns of the active joints.

    Returns:
        () or (N,), at least 1.
    """
    return np.asarray(
        np.linalg.norm(
            gamma * scales_of_motion[active] / scales_of_motion[:, None], 2, axis=(-2, -1)
        )
    )


def select_columns(
    basis: Array, candidates: Sequence[int], required: Sequence[int] = ()
) -> Indices | None:
    """Select the joints A with (nearly) the largest |det N_A|.

    Starts from a QR factorization of N^T with column pivoting. Then a selected joint i is
    exchanged for the joint j with the largest |N N_A^-1|_ji > 1, which multiplies |det N_A| by
    this factor (Goreinov and Tyrtyshnikov 2001). At the end no joint moves by more than its scale
    when one selected joint moves by its own, so that condition number <= sqrt(1 + n (nv - n)).

    Args:
        basis: N (nv, n).
        candidates: Columns to select from.
        required: Columns that are selected in any case.

    Returns:
        (n,) columns in ascending order; None if no selection drives the machine.
    """
    free = [i for i in candidates if i not in required]
    rows = basis[free]
    if len(required):
        if np.linalg.matrix_rank(basis[list(required)], DEAD_CENTRE_TOLERANCE) < len(required):
            return None
        _, _, right = np.linalg.svd(basis[list(required)])
        rows = (
            rows @ right[len(required) :].T
        )  # motions that are left with the required joints held
    missing = basis.shape[1] - len(required)
    if len(free) < missing:
        return None
    chosen = list(required)
    if missing:
        chosen += [free[i] for i in _pivot_rows(rows, missing)]
    if np.linalg.svd(basis[chosen], compute_uv=False).min(initial=1.0) < DEAD_CENTRE_TOLERANCE:
        return None
    for _ in range(_MAX_EXCHANGES if missing else 0):
        gains = np.abs(np.linalg.solve(basis[chosen].T, basis[free].T)).T  # (free, n)
        gains[:, : len(required)] = 0.0
        j, i = np.unravel_index(_argmax_up_to_rounding(gains.ravel()), gains.shape)
        if gains[j, i] <= 1.0 + _ROUNDING_TOLERANCE:
            break
        chosen[int(i)] = free[int(j)]
    return np.sort(np.array(chosen, dtype=np.intp))


def _pivot_rows(rows: Array, count: int) -> list[int]:
    """Pivots of a QR factorization of rows^T with column pivoting."""
    remaining, found = rows.copy(), []
    for _ in range(count):
        sizes = np.linalg.norm(remaining, axis=1)
        found.append(at := _argmax_up_to_rounding(sizes))
        direction = remaining[at] / max(float(sizes[at]), 1e-300)
        remaining -= np.outer(remaining @ direction, direction)
    return found


def _argmax_up_to_rounding(values: Array) -> int:
    """Index of the largest value; the first one of values that differ by rounding only."""
    return int(np.argmax(values >= (1.0 - _ROUNDING_TOLERANCE) * values.max()))


def propose_active_joints(
    equations: LoopEquations,
    jacobian: Array,
    candidates: Sequence[int] | None = None,
    required: Sequence[int] = (),
) -> list[ActiveJointSelection]:
    """Propose at most two selections of active joints at a configuration.

    Actuators are preferred if their condition number is below 100: prismatic joints, and joints
    with an effort limit. Joints whose name contains "passive" or "free" are only used if the
    others do not suffice, joints in couplings last. The second proposal is the selection with the
    best condition number of all joints, or the best one without that joint of the first proposal
    that is needed least.

    Args:
        equations: The loop equations.
        jacobian: (m, nv) of all loop equations, or of the independent ones.
        candidates: Columns to select from; all if not given.
        required: Columns that are selected in any case.
    """
    basis = null_space_basis(jacobian, equations.motion_scales, DEAD_CENTRE_TOLERANCE)
    if basis.shape[1] == 0:
        return []
    coordinates, effort = equations.coordinates, np.asarray(equations.model.effortLimit)
    names = coordinates.names
    columns = range(len(names)) if candidates is None else candidates
    is_coupled = equations.is_coupled.any(axis=0)
    free = [i for i in columns if not is_coupled[i]]
    looks_actuated = coordinates.is_translation | (np.isfinite(effort) & (effort > 0))
    actuators = [i for i in free if looks_actuated[i]]

    def select_first(*alternatives: Sequence[int]) -> ActiveJointSelection | None:
        """The selection from the first columns that drive the machine."""
        for some in alternatives:
            found = select_columns(basis, some, required)
            if found is not None:
                least = float(np.linalg.svd(basis[found], compute_uv=False)[-1])
                return ActiveJointSelection(tuple(names[i] for i in found), 1.0 / least)
        return None

    best = select_first(free, columns)
    if best is None:
        return []
    driven = select_first([i for i in actuators if not _UNDRIVEN_NAME.search(names[i])], actuators)
    if driven is None or driven.condition_number >= _MAX_ACTUATOR_CONDITION:
        driven = best
    if driven.joints != best.joints:
        return [driven, best]
    others = [
        select_first([i for i in free if names[i] != name])
        for name in driven.joints
        if names.index(name) not in required
    ]
    acceptable = [
        choice
        for choice in others
        if choice is not None and choice.condition_number < _MAX_ACTUATOR_CONDITION
    ]
    return [driven, *sorted(acceptable, key=lambda choice: choice.condition_number)[:1]]
