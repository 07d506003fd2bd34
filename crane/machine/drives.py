"""Who drives what: active joints that a file leaves open, free ones, and drives in surplus."""

import warnings
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.closure.choice import DEAD, Choice, choose, motions, proposals, scales, words
from crane.closure.coordinates import Coordinates
from crane.closure.equations import LoopEquations
from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.description import Drive, MachineSpec
from crane.description.floating import afloat

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
        return tuple(dict.fromkeys((*spec.active, *said_free(spec))))
    followers = {next(iter(coupling.factors)) for coupling in spec.couplings}
    return tuple(name for name in Coordinates(model).names if name not in followers)


def said_free(spec: MachineSpec) -> tuple[str, ...]:
    """Coordinates that the file calls free, and those of bodies that float."""
    floating = (joint for series in afloat(spec).values() for joint in series)
    return tuple(dict.fromkeys((*spec.free, *floating)))


def free_joints(spec: MachineSpec, active: Sequence[str]) -> tuple[str, ...]:
    """Those of the independent coordinates that nothing drives."""
    driven = named_drives(spec)
    free = said_free(spec)
    if not driven:
        return tuple(name for name in active if name in free)
    return tuple(name for name in active if name in free or name not in driven)


def motors(spec: MachineSpec, active: Sequence[str]) -> tuple[Drive, ...]:
    """What the file says that motors act on; every joint that it calls active if not all are."""
    named = spec.active or ()
    if spec.drives or all(name in active for name in named):
        return spec.drives
    return tuple(Drive(name, {name: 1.0}) for name in named if name not in spec.free)


def completed(
    spec: MachineSpec, model: pin.Model, equations: LoopEquations, jacobian: Array
) -> tuple[tuple[str, ...], str] | None:
    """Independent coordinates where the file names too few, too many or none.

    Joints that are named stay as far as they are independent, in their order. What they leave
    open is completed by the joints of the best condition (see `crane.closure.choice`), which are
    free: nothing drives them. Where no joint is named, those are proposed that look driven.

    Args:
        spec: The machine as read.
        model: Its tree.
        equations: Its loops.
        jacobian: (m, nv) of all loop equations at a closed posture.

    Returns:
        Names, and what to say of them; None where there is no such choice.
    """
    basis = motions(jacobian, scales(model), DEAD)
    names = equations.coordinates.names
    followers = [int(i) for i in np.flatnonzero((equations.factors != 0).any(axis=0))]
    driven = spec.active or named_drives(spec)
    undriven = said_free(spec)
    said = tuple(dict.fromkeys((*driven, *undriven)))
    freedom = basis.shape[1]
    undecided = not driven and _OF_ACTIVE & spec.where.keys()
    mistaken = spec.active and len(said) == freedom  # as many as there are, and not independent
    if not freedom or undecided or (mistaken and not spec.drives):
        return None
    if not driven:
        free = [names.index(name) for name in undriven]
        found = proposals(model, jacobian, followers, kept=free)
        if not found:
            return None
        meant = [
            Choice(tuple(x for x in one.joints if x not in undriven), one.condition)
            for one in found
        ]
        text = f"no active joints named, taken as driven: {words(meant)}"
        return found[0].joints, f"{_freedoms(freedom)} and {text}"
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
    count = f"{len(driven)} active joint{'s' * (len(driven) != 1)}"
    if undriven:
        count += f" and {len(undriven)} free"
    head = f"{count} for {_freedoms(freedom)}"
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
