"""Selection of active joints, and the condition number of a selection.

With the Jacobian J of the loop equations at a closed configuration, D = diag(scales) and an
orthonormal basis N (nv, n) of the null space of J D, the motions of the machine are v = D N y.
For n active joints A, v_A = D_A N_A y, so that the scaled derivative of all joints with respect
to the active ones is

    D^-1 gamma D_A = N N_A^-1,    condition number = ||D^-1 gamma D_A||_2 = 1 / sigma_min(N_A).

It is 1 where no other joint moves, and infinite at a dead centre: sigma_min(N_A) is also the least
singular value of J_P once the rows of J D are orthonormal. It depends neither on how the equations
are written nor on units, see `motion_scales`.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from crane.closure.coordinates import Coordinates
from crane.common.samples import Array

Indices = NDArray[np.intp]

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


def translational_coordinates(model: pin.Model) -> NDArray[np.bool_]:
    """Mask (nv,) of the coordinates that are lengths."""
    return Coordinates(model).is_translation


def characteristic_length(model: pin.Model) -> float:
    """The characteristic length of a machine [m]: the largest distance between adjacent joints.

    Where all joints coincide: the largest distance of a link from its joint, else the largest
    limit of a prismatic joint, else 1 m.
    """
    joints = (place.translation for place in list(model.jointPlacements)[1:])
    links = (frame.placement.translation for frame in model.frames)
    coordinates = Coordinates(model)
    limits = np.abs(np.stack([coordinates.lower, coordinates.upper]))[
        :, coordinates.is_translation
    ]
    distances = (float(np.abs(list(places)).max(initial=0.0)) for places in (joints, links))
    return (
        next(filter(None, distances), float(limits[np.isfinite(limits)].max(initial=0.0))) or 1.0
    )


def coordinate_units(model: pin.Model) -> Array:
    """(nv,) units that make coordinates comparable: 1 rad, and the characteristic length [m]."""
    return np.where(translational_coordinates(model), characteristic_length(model), 1.0)


def motion_scales(model: pin.Model) -> Array:
    """(nv,) comparable displacements of the joints.

    The range of a joint, at most 1 rad or the characteristic length; that bound for joints without
    limits.
    """
    units_of_coordinates = coordinate_units(model)
    coordinates = Coordinates(model)
    ranges = coordinates.upper - coordinates.lower
    return np.where(ranges > 0, np.minimum(ranges, units_of_coordinates), units_of_coordinates)


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
        scales_of_motion: (nv,), see `motion_scales`.
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
    count = basis.shape[1]
    free = [i for i in candidates if i not in required]
    rows = basis[free]
    if len(required):
        if np.linalg.matrix_rank(basis[list(required)], DEAD_CENTRE_TOLERANCE) < len(required):
            return None
        _, _, right = np.linalg.svd(basis[list(required)])
        rows = (
            rows @ right[len(required) :].T
        )  # motions that are left with the required joints held
    missing = count - len(required)
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
    model: pin.Model,
    jacobian: Array,
    coupled: Sequence[int] = (),
    candidates: Sequence[int] | None = None,
    required: Sequence[int] = (),
) -> list[ActiveJointSelection]:
    """Propose at most two selections of active joints at a configuration.

    Actuators are preferred if their condition number is below 100: prismatic joints, and joints
    with an effort limit. Joints whose name contains "passive" or "free" are only used if the
    others do not suffice. The second proposal is the selection with the best condition number of
    all joints, or the best one without that joint of the first proposal that is needed least.

    Args:
        model: The spanning tree.
        jacobian: (m, nv) of all loop equations.
        coupled: Columns of joints in couplings, which are used last.
        candidates: Columns to select from; all if not given.
        required: Columns that are selected in any case.
    """
    basis = null_space_basis(jacobian, motion_scales(model), DEAD_CENTRE_TOLERANCE)
    names = Coordinates(model).names
    columns = range(model.nv) if candidates is None else candidates
    free = [i for i in columns if i not in coupled]
    effort = np.asarray(model.effortLimit)
    looks_actuated = translational_coordinates(model) | (np.isfinite(effort) & (effort > 0))
    actuators = [i for i in free if looks_actuated[i]]
    if basis.shape[1] == 0:
        return []

    def valued(found: Indices | None) -> ActiveJointSelection | None:
        if found is None:
            return None
        least = float(np.linalg.svd(basis[found], compute_uv=False)[-1])
        return ActiveJointSelection(tuple(names[i] for i in found), 1.0 / least)

    best = valued(select_columns(basis, free, required)) or valued(
        select_columns(basis, columns, required)
    )
    if best is None:
        return []
    not_idle_by_name = [i for i in actuators if not _UNDRIVEN_NAME.search(names[i])]
    driven = valued(select_columns(basis, not_idle_by_name, required)) or valued(
        select_columns(basis, actuators, required)
    )
    first = (
        driven
        if driven is not None and driven.condition_number < _MAX_ACTUATOR_CONDITION
        else best
    )
    out = [first]
    if first.joints != best.joints:
        return [first, best]
    others = [
        valued(select_columns(basis, [i for i in free if names[i] != name], required))
        for name in first.joints
        if names.index(name) not in required
    ]
    acceptable = [
        choice
        for choice in others
        if choice is not None and choice.condition_number < _MAX_ACTUATOR_CONDITION
    ]
    return out + sorted(acceptable, key=lambda choice: choice.condition_number)[:1]


def format_selections(selections: Sequence[ActiveJointSelection]) -> str:
    """The selections as text for error messages."""
    return ", or ".join(str(choice) for choice in selections)
