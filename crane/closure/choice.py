"""Which joints to drive: how well a choice of active joints determines the others.

With J the Jacobian of the loop equations at a closed posture, D = diag(scales) and N (nv, n) an
orthonormal basis of the null space of J D, the motions of the machine are v = D N y. A choice A of
n joints has v_A = D_A N_A y, so that the scaled Jacobian of all joints by the chosen ones is

    D^-1 gamma D_A = N N_A^-1,    condition = ||D^-1 gamma D_A||_2 = 1 / sigma_min(N_A),

which is 1 where no other joint moves, and infinite at a dead centre: sigma_min(N_A) is also the
least singular value of J_P once the rows of J D are made orthonormal. It does not depend on how
equations are written, nor on units: see `scales`.
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

DEAD = 1e-5  # sigma_min of a choice that drives nothing at home, see `crane.closure.structure`
_IDLE = re.compile("passive|free", re.IGNORECASE)  # names of joints that nothing drives
_FAIR = 100.0  # condition up to which actuators are proposed before better joints
_SWAPS = 200
_EQUAL = 1e-9  # share by which what differs only by rounding does


@dataclass(frozen=True)
class Choice:
    """Active joints, and how well they drive the machine at home.

    Attributes:
        joints: Their names, in the order of the tree.
        condition: See the module.
    """

    joints: tuple[str, ...]
    condition: float

    def __str__(self) -> str:
        return f"[{', '.join(self.joints)}] (condition {self.condition:.3g})"


def slides(model: pin.Model) -> NDArray[np.bool_]:
    """(nv,) whether a coordinate is a length."""
    return Coordinates(model).slides


def size(model: pin.Model) -> float:
    """The size of a machine: the largest distance between neighbouring joints [m].

    Where all joints are in one place, that of a link from its joint, or else the farthest limit of
    a slide; 1 m for a machine without any length.
    """
    joints = (place.translation for place in list(model.jointPlacements)[1:])
    links = (frame.placement.translation for frame in model.frames)
    coordinates = Coordinates(model)
    limits = np.abs(np.stack([coordinates.lower, coordinates.upper]))[:, coordinates.slides]
    far = (float(np.abs(list(places)).max(initial=0.0)) for places in (joints, links))
    return next(filter(None, far), float(limits[np.isfinite(limits)].max(initial=0.0))) or 1.0


def units(model: pin.Model) -> Array:
    """(nv,) units of coordinates that compare: 1 rad, and the size of the machine."""
    return np.where(slides(model), size(model), 1.0)


def scales(model: pin.Model) -> Array:
    """(nv,) ways of the joints that compare: their ranges, of at most 1 rad or the machine's size.

    Those also stand for the ranges of joints without limits.
    """
    most = units(model)
    coordinates = Coordinates(model)
    span = coordinates.upper - coordinates.lower
    return np.where(span > 0, np.minimum(span, most), most)


def motions(jacobian: Array, scale: Array, tolerance: float) -> Array:
    """N (nv, n): an orthonormal basis of the scaled motions that equations allow to first order.

    Args:
        jacobian: (m, nv).
        scale: (nv,).
        tolerance: Singular values below this share of the largest count as zero.
    """
    if not jacobian.size:
        return np.eye(len(scale))
    _, values, right = np.linalg.svd(jacobian * scale)
    return np.asarray(right[int((values > tolerance * values[0]).sum()) :].T)


def condition(gamma: Array, scale: Array, active: Indices) -> Array:
    """Condition numbers of a drive.

    Args:
        gamma: (nv, n) or (N, nv, n) of closed postures.
        scale: (nv,), see `scales`.
        active: (n,) columns of the active joints.

    Returns:
        () or (N,), at least 1.
    """
    scaled = gamma * scale[active] / scale[:, None]
    return np.asarray(np.linalg.norm(scaled, 2, axis=(-2, -1)))


def choose(basis: Array, among: Sequence[int], kept: Sequence[int] = ()) -> Indices | None:
    """Joints of the largest |det N_A|, or near it.

    A QR factorisation with column pivoting of N^T starts; then a chosen joint i gives way to any
    other j that it moves by more than itself, |N N_A^-1|_ji > 1, which multiplies |det N_A| by
    that (Goreinov and Tyrtyshnikov 2001). At the end no joint is moved by more than its scale when
    one of the chosen ones moves by its own, so condition <= sqrt(1 + n (nv - n)).

    Args:
        basis: N (nv, n).
        among: Columns to choose from.
        kept: Columns that are chosen in any case.

    Returns:
        (n,) columns in ascending order; None where no choice drives the machine.
    """
    count = basis.shape[1]
    free = [i for i in among if i not in kept]
    rows = basis[free]
    if len(kept):
        if np.linalg.matrix_rank(basis[list(kept)], DEAD) < len(kept):
            return None
        _, _, right = np.linalg.svd(basis[list(kept)])
        rows = rows @ right[len(kept) :].T  # what the kept ones leave free
    missing = count - len(kept)
    if len(free) < missing:
        return None
    chosen = list(kept)
    if missing:
        chosen += [free[i] for i in _pivots(rows, missing)]
    if np.linalg.svd(basis[chosen], compute_uv=False).min(initial=1.0) < DEAD:
        return None
    for _ in range(_SWAPS if missing else 0):
        moved = np.abs(np.linalg.solve(basis[chosen].T, basis[free].T)).T  # (free, n)
        moved[:, : len(kept)] = 0.0
        j, i = np.unravel_index(_largest(moved.ravel()), moved.shape)
        if moved[j, i] <= 1.0 + _EQUAL:
            break
        chosen[int(i)] = free[int(j)]
    return np.sort(np.array(chosen, dtype=np.intp))


def _pivots(rows: Array, count: int) -> list[int]:
    """Of a QR factorisation of rows^T with column pivoting."""
    left, found = rows.copy(), []
    for _ in range(count):
        sizes = np.linalg.norm(left, axis=1)
        found.append(at := _largest(sizes))
        way = left[at] / max(float(sizes[at]), 1e-300)
        left -= np.outer(left @ way, way)
    return found


def _largest(values: Array) -> int:
    """Index of the largest, of equal ones the first: rounding does not choose."""
    return int(np.argmax(values >= (1.0 - _EQUAL) * values.max()))


def proposals(
    model: pin.Model,
    jacobian: Array,
    followers: Sequence[int] = (),
    among: Sequence[int] | None = None,
    kept: Sequence[int] = (),
) -> list[Choice]:
    """Choices of active joints for a machine at a posture, at most two.

    Actuators come first where their condition is below 100: joints that slide, and those whose
    effort is limited; pins that only hold parts together usually have no limits. Those whose names
    say that nothing drives them are left out if the others are enough. Second comes the
    best-conditioned choice of any joints, or what is best without the joint of the first that the
    others need least.

    Args:
        model: The spanning tree.
        jacobian: (m, nv) of all loop equations.
        followers: Columns of joints that follow others by a coupling, which are taken last.
        among: Columns to choose from; all if not given.
        kept: Columns that are chosen in any case.
    """
    scale = scales(model)
    basis = motions(jacobian, scale, DEAD)
    coordinates = Coordinates(model)
    names = coordinates.names
    columns = range(model.nv) if among is None else among
    free = [i for i in columns if i not in followers]
    effort = np.asarray(model.effortLimit)
    built = slides(model) | (np.isfinite(effort) & (effort > 0))
    actuators = [i for i in free if built[i]]
    if basis.shape[1] == 0:
        return []

    def valued(found: Indices | None) -> Choice | None:
        if found is None:
            return None
        least = float(np.linalg.svd(basis[found], compute_uv=False)[-1])
        return Choice(tuple(names[i] for i in found), 1.0 / least)

    best = valued(choose(basis, free, kept)) or valued(choose(basis, columns, kept))
    if best is None:
        return []
    meant = [i for i in actuators if not _IDLE.search(names[i])]
    driven = valued(choose(basis, meant, kept)) or valued(choose(basis, actuators, kept))
    first = driven if driven is not None and driven.condition < _FAIR else best
    out = [first]
    if first.joints != best.joints:
        return [first, best]
    others = [
        valued(choose(basis, [i for i in free if names[i] != name], kept))
        for name in first.joints
        if names.index(name) not in kept
    ]
    able = [choice for choice in others if choice is not None and choice.condition < _FAIR]
    return out + sorted(able, key=lambda choice: choice.condition)[:1]


def words(choices: Sequence[Choice]) -> str:
    """Choices as an error proposes them."""
    return ", or ".join(str(choice) for choice in choices)
