"""Who drives what: active joints that a file leaves open, free ones, and drives in surplus."""

import warnings
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.closure.choice import DEAD, choose, motions, proposals, scales, words
from crane.closure.equations import LoopEquations
from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.description import Drive, MachineSpec

_OF_ACTIVE = {"tasks", "control", "hydraulics"}  # sections that only active joints can have


def named_drives(spec: MachineSpec) -> tuple[str, ...]:
    """Joints that the file says are driven, each once, in its order."""
    named = [joint for drive in spec.drives for joint in drive.factors] or list(spec.active or ())
    return tuple(dict.fromkeys(named))


def active_joints(spec: MachineSpec, model: pin.Model) -> tuple[str, ...]:
    """The independent coordinates as far as the file names them: driven ones, then free ones.

    An open chain that names none has all of them, but those that follow others by a coupling.
    """
    if spec.active is not None:
        return tuple(dict.fromkeys((*spec.active, *spec.free)))
    followers = {next(iter(coupling.factors)) for coupling in spec.couplings}
    return tuple(name for name in model.names[1:] if name not in followers)


def free_joints(spec: MachineSpec, active: Sequence[str]) -> tuple[str, ...]:
    """Those of the independent coordinates that nothing drives."""
    driven = named_drives(spec)
    if not driven:
        return tuple(name for name in active if name in spec.free)
    return tuple(name for name in active if name in spec.free or name not in driven)


def motors(spec: MachineSpec, active: Sequence[str]) -> tuple[Drive, ...]:
    """What the file says that motors act on; every joint that it calls active if not all are."""
    named = spec.active or ()
    if spec.drives or all(name in active for name in named):
        return spec.drives
    return tuple(Drive(name, {name: 1.0}) for name in named if name not in spec.free)


def completed(
    spec: MachineSpec, model: pin.Model, equations: LoopEquations, posture: Array
) -> tuple[tuple[str, ...], str] | None:
    """Independent coordinates where the file names too few, too many or none.

    Joints that are named stay as far as they are independent, in their order. What they leave
    open is completed by the joints of the best condition (see `crane.closure.choice`), which are
    free: nothing drives them. Where no joint is named, those are proposed that look driven.

    Args:
        spec: The machine as read.
        model: Its tree.
        equations: Its loops.
        posture: (nq,) closed posture.

    Returns:
        Names, and what to say of them; None where there is no such choice.
    """
    jacobian = equations.evaluate(posture)[1]
    basis = motions(jacobian, scales(model), DEAD)
    names = list(model.names)[1:]
    followers = [int(i) for i in np.flatnonzero((equations.factors != 0).any(axis=0))]
    driven = spec.active or named_drives(spec)
    said = tuple(dict.fromkeys((*driven, *spec.free)))
    freedom = basis.shape[1]
    undecided = not driven and _OF_ACTIVE & spec.where.keys()
    mistaken = spec.active and len(said) == freedom  # as many as there are, and not independent
    if not freedom or undecided or (mistaken and not spec.drives):
        return None
    if not driven:
        free = [names.index(name) for name in spec.free]
        found = proposals(model, jacobian, followers, kept=free)
        if not found:
            return None
        return found[0].joints, (
            f"{_freedoms(freedom)} and no active joints named, taken as driven: {words(found)}"
        )
    kept = _independent(basis, [names.index(name) for name in said])
    surplus = [name for name in said if names.index(name) not in kept]
    others = [i for i in range(len(names)) if i not in followers]
    chosen = choose(basis, others, kept)
    if chosen is None:
        chosen = choose(basis, range(len(names)), kept)
    if chosen is None:
        return None
    added = [names[int(i)] for i in chosen if int(i) not in kept]
    told = []
    if surplus:
        told.append(
            f"{', '.join(surplus)} share{'s' * (len(surplus) == 1)} the load with the others"
        )
    if added:
        told.append(f"nothing drives {', '.join(added)}, free but for friction, springs and stops")
    head = f"{len(said)} active joint{'s' * (len(said) != 1)} for {_freedoms(freedom)}"
    return (*(names[i] for i in kept), *added), f"{head}: {'; '.join(told)}"


def _independent(basis: Array, columns: Sequence[int]) -> list[int]:
    """The columns that are independent of those before them, at most as many as freedoms."""
    kept: list[int] = []
    for column in columns:
        values = np.linalg.svd(basis[[*kept, column]], compute_uv=False)
        if len(kept) < basis.shape[1] and values.min() > DEAD:
            kept.append(column)
    return kept


def _freedoms(count: int) -> str:
    return f"{count} degree{'s' * (count != 1)} of freedom"


def warn_of_completion(spec: MachineSpec, text: str) -> None:
    """Say which coordinates were chosen."""
    where = spec.where.get("active", spec.path.name)
    warnings.warn(f"{where}: {text}; name them as active and free", CraneWarning, stacklevel=4)
