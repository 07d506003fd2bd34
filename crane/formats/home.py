"""Warnings about a home posture that the file does not give, or not in enough digits."""

import warnings
from collections.abc import Sequence

from crane.closure import Closure
from crane.closure.choice import slides
from crane.closure.exactness import CLOSED
from crane.common.errors import CraneWarning
from crane.description import MachineSpec
from crane.formats.opening import is_simulators
from crane.machine.drives import free_joints

_LISTED = 4


def warn_of_home(spec: MachineSpec, closure: Closure) -> None:
    """Warn where home was sought, and where loops close only to the digits of the file.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
    """
    for told in (_sought(spec, closure), _digits(spec, closure)):
        if told:
            warnings.warn(told, CraneWarning, stacklevel=3)


def _sought(spec: MachineSpec, closure: Closure) -> str:
    sought = closure.sought
    if sought is None:
        return ""
    names = closure.equations.coordinates.names
    place = spec.where.get("home", spec.path.name)
    joint, off = sought.farthest
    unit = "m" if slides(closure.model)[joint] else "rad"
    free = free_joints(spec, closure.active_names)
    held = [i for i in closure.active if names[int(i)] not in free]
    moved = _list([names[int(i)] for i in held if i in sought.moved])
    how = f"moving {moved}, too" if moved else "the driven joints held"
    chosen = f"the nearest of {sought.count} postures" if sought.count > 1 else "the only posture"
    keep = "convert, then crane check" if is_simulators(spec.path) else "check"
    return (
        f"{place}: home was sought, because from what the file says of it {sought.reason}; "
        f"{how}, {chosen} that was found has {names[joint]} {off:.3g} {unit} off: look at it with "
        f"crane sketch, and keep it with crane {keep} --write-home"
    )


def _digits(spec: MachineSpec, closure: Closure) -> str:
    surplus, equations = closure.structure.surplus, closure.equations
    if surplus.gap <= CLOSED:
        return ""
    loop = equations.names[equations.loop_of_row[surplus.row]]
    place = spec.where.get(f"loop {loop}", spec.path.name)
    length = bool(equations.is_translation[surplus.row])
    gap = f"{surplus.gap * equations.row_units[surplus.row]:.2g} {'m' if length else 'rad'}"
    share = f" ({surplus.gap:.1g} of the machine's size)" if length else ""
    return (
        f"{place}: loop '{loop}' closes but for digits: its surplus equations stay open by up to "
        f"{gap}{share}, while the others are closed; write axes, angles and pins with more digits"
    )


def _list(names: Sequence[str]) -> str:
    more = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {more} more" if more > 0 else "")
