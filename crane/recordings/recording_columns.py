"""Columns of a recording: which joints they belong to, and checks of their values."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import RecordingError, suggest_names
from crane.common.samples import Array
from crane.description.sensors import FORCE_SUFFIX, FORCE_UNITS, VELOCITY_SUFFIX, VELOCITY_UNITS

_MAX_LISTED = 40  # names in a message


def time_derivative(x: Array, time: Array) -> Array:
    """Central differences (N,) of x (N,); zero if time does not increase."""
    if len(x) < 2 or not (np.diff(time) > 0).all():
        return np.zeros_like(x)
    return np.asarray(np.gradient(x, time))


def check_finite(columns: Mapping[str, Array]) -> None:
    """Check that columns (N,) contain finite numbers.

    Raises:
        RecordingError: A column does not.
    """
    for name, values in columns.items():
        if not np.isfinite(values).all():
            sample = int(np.argmin(np.isfinite(values)))
            raise RecordingError(
                f"'{name}' is {values[sample]} at sample {sample}, give finite numbers"
            )


def checked_array(
    what: str, value: ArrayLike, shape: tuple[int, ...], copy: bool, names: Sequence[str] = ()
) -> Array:
    """Convert to a float64 array of a shape, copied to contiguous memory if `copy` is set."""
    try:
        order: Literal["C", "K"] = "C" if copy or len(shape) == 1 else "K"
        array = np.array(value, dtype=np.float64, order=order, copy=copy or None)
    except (TypeError, ValueError):
        raise RecordingError(f"{what} is not an array of numbers, give {shape}") from None
    if array.shape != shape:
        columns = f", a column each for {quoted_list(names)}" if names else ""
        raise RecordingError(f"{what} has the shape {array.shape}, give {shape}{columns}")
    return array


def quoted_list(names: Iterable[str]) -> str:
    """List of quoted names for a message, with at most 40 of them."""
    names = list(names)
    more = [f"{len(names) - _MAX_LISTED} more"] if len(names) > _MAX_LISTED else []
    return ", ".join([f"'{name}'" for name in names[:_MAX_LISTED]] + more) or "none"


def free_force_message(joint: str, tau: Array) -> str:
    """Message about a force (N,) of a free joint that is not zero."""
    sample = int(np.argmax(tau != 0))
    return (
        f"'{joint}' is free and has the force {tau[sample]:.3g} at sample {sample}: leave the "
        "force out, or name the joint as active"
    )


def find_active_joints(names: Sequence[str], free: Sequence[str] = ()) -> tuple[str, ...]:
    """Active joints among columns: those with a force column, and free joints.

    Raises:
        RecordingError: A joint has velocity and force, but no coordinate.
    """
    available = set(names)
    for stem in (x.removesuffix(FORCE_SUFFIX) for x in names if x.endswith(FORCE_SUFFIX)):
        if stem not in available and stem + VELOCITY_SUFFIX in available:
            raise RecordingError(
                f"column '{stem}' is missing beside '{stem}{VELOCITY_SUFFIX}', "
                f"'{stem}{FORCE_SUFFIX}', add it, or rename those if '{stem}' is not an active "
                "joint"
            )
    for x in free:
        if x not in available:
            raise RecordingError(
                f"column '{x}' of a free joint is missing, {suggest_names(names, x)}"
            )
    return tuple(x for x in names if x + FORCE_SUFFIX in available or x in free)


def matching_units(joint: str, units: Mapping[str, str]) -> list[str]:
    """Units of a joint that match the units of its velocity and force columns."""
    return [
        unit
        for unit, rate in VELOCITY_UNITS.items()
        if units.get(joint + VELOCITY_SUFFIX, rate) == rate
        and units.get(joint + FORCE_SUFFIX, FORCE_UNITS[unit]) == FORCE_UNITS[unit]
    ]


def require_active_joints(names: Sequence[str], free: Sequence[str]) -> tuple[str, ...]:
    """`find_active_joints`, of which there must be one.

    Raises:
        RecordingError: There is no active joint.
    """
    joints = find_active_joints(names, free)
    if not joints:
        raise RecordingError(
            f"no active joint among the columns {quoted_list(names)}, give for each joint "
            f"its displacement, force and perhaps velocity, as in q1, q1{FORCE_SUFFIX}, "
            f"q1{VELOCITY_SUFFIX}"
        )
    return joints
