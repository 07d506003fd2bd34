"""Selection of active and free joints, and of redundant drives, from a description."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.closure.active_joint_selection import (
    DEAD_CENTRE_TOLERANCE,
    ActiveJointSelection,
    null_space_basis,
    propose_active_joints,
    select_columns,
)
from crane.closure.coordinates import Coordinates
from crane.closure.loop_equations import LoopEquations
from crane.common.one_line_repr import format_count
from crane.common.samples import Array
from crane.description.rotation_vectors import floating_series
from crane.description.specification import Drive, MachineSpec

_SECTIONS_OF_ACTIVE_JOINTS = {
    "tasks",
    "control",
    "hydraulics",
}  # sections that only active joints may have


def specified_driven_joints(spec: MachineSpec) -> tuple[str, ...]:
    """Joints that the file specifies as driven, each once, in its order."""
    return tuple(
        dict.fromkeys(
            [joint for drive in spec.drives for joint in drive.factors] or list(spec.active or ())
        )
    )


def specified_active_joints(spec: MachineSpec, model: pin.Model) -> tuple[str, ...]:
    """Active joints that the file names: driven ones, then free ones.

    For an open chain without names, all coordinates except those that follow others by a coupling.
    """
    if spec.active is not None:
        return tuple(dict.fromkeys((*spec.active, *specified_free_joints(spec))))
    followers = {next(iter(coupling.factors)) for coupling in spec.couplings}
    return tuple(name for name in Coordinates(model).names if name not in followers)


def specified_free_joints(spec: MachineSpec) -> tuple[str, ...]:
    """Coordinates that the file names as free, and those of floating bases."""
    return tuple(
        dict.fromkeys(
            (*spec.free, *(joint for series in floating_series(spec).values() for joint in series))
        )
    )


def select_free_joints(
    spec: MachineSpec, active: Sequence[str], held: Sequence[str] = ()
) -> tuple[str, ...]:
    """Those of the active joints that no drive moves.

    Args:
        spec: The machine.
        active: Its active joints.
        held: Those of them that are held for idle motions, see `Machine.held`.
    """
    driven = specified_driven_joints(spec)
    free = (*specified_free_joints(spec), *held)
    if not driven:
        return tuple(name for name in active if name in free)
    return tuple(name for name in active if name in free or name not in driven)


def select_motors(spec: MachineSpec, active: Sequence[str]) -> tuple[Drive, ...]:
    """The drives of the file; one per named joint where not all named joints are active."""
    named = spec.active or ()
    if spec.drives or all(name in active for name in named):
        return spec.drives
    return tuple(Drive(name, {name: 1.0}) for name in named if name not in spec.free)


def complete_active_joints(
    spec: MachineSpec, equations: LoopEquations, jacobian: Array
) -> tuple[tuple[str, ...], str] | None:
    """Active joints where the file names too few, too many or none.

    Named joints are kept as far as they are independent, in their order. Missing ones are added
    with the best condition number (see `crane.closure.active_joint_selection`) as free joints. If
    no joint is named, joints that look driven are proposed.

    Args:
        spec: The machine as read.
        equations: Its loop equations.
        jacobian: (m, nv) of all loop equations at a closed configuration.

    Returns:
        Names, and a text about the completion; None if there is no selection.
    """
    basis = null_space_basis(jacobian, equations.motion_scales, DEAD_CENTRE_TOLERANCE)
    names = equations.coordinates.names
    is_coupled = equations.is_coupled.any(axis=0)
    driven = spec.active or specified_driven_joints(spec)
    undriven = specified_free_joints(spec)
    specified = tuple(dict.fromkeys((*driven, *undriven)))
    mobility = basis.shape[1]
    is_undecided = not driven and _SECTIONS_OF_ACTIVE_JOINTS & spec.source_locations.keys()
    is_dependent = (
        spec.active and len(specified) == mobility
    )  # the right number, but not independent
    if not mobility or is_undecided or (is_dependent and not spec.drives):
        return None
    mobility_text = format_count(mobility, "degree of freedom", "degrees of freedom")
    if not driven:
        found = propose_active_joints(
            equations, jacobian, required=[names.index(name) for name in undriven]
        )
        if not found:
            return None
        driven_selections = ", or ".join(
            str(
                ActiveJointSelection(
                    tuple(x for x in one.joints if x not in undriven), one.condition_number
                )
            )
            for one in found
        )
        text = f"no active joints named, taken as driven: {driven_selections}"
        return found[0].joints, f"{mobility_text} and {text}"
    independent = _independent_columns(basis, [names.index(name) for name in specified])
    redundant = [name for name in specified if names.index(name) not in independent]
    chosen = select_columns(basis, np.flatnonzero(~is_coupled).tolist(), independent)
    if chosen is None:
        chosen = select_columns(basis, range(len(names)), independent)
    if chosen is None:
        return None
    added = [names[int(i)] for i in chosen if int(i) not in independent]
    remarks = []
    if redundant:
        remarks.append(
            f"{', '.join(redundant)} share{'s' * (len(redundant) == 1)} the load with the others"
        )
    if added:
        remarks.append(
            f"nothing drives {', '.join(added)}, free but for friction, springs and stops"
        )
    count = format_count(len(driven), "active joint")
    if undriven:
        count += f" and {len(undriven)} free"
    return (
        (*(names[i] for i in independent), *added),
        f"{count} for {mobility_text}: {'; '.join(remarks)}",
    )


def _independent_columns(basis: Array, columns: Sequence[int]) -> list[int]:
    """Columns that are independent of those before them, at most one per degree of freedom."""
    independent: list[int] = []
    for column in columns:
        values = np.linalg.svd(basis[[*independent, column]], compute_uv=False)
        if len(independent) < basis.shape[1] and values.min() > DEAD_CENTRE_TOLERANCE:
            independent.append(column)
    return independent
