"""What is said of a home posture that the file does not give, not in enough digits, or wrongly."""

import warnings
from collections.abc import Sequence

import pinocchio as pin

from crane.closure import Closure
from crane.closure.choice import slides
from crane.closure.exactness import CLOSED
from crane.closure.home import Sought
from crane.closure.structure import OpenLoopError
from crane.common.errors import CraneWarning, MechanismError
from crane.common.packages import NEAREST_ASSEMBLY, asked
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.description.findings import flag
from crane.formats.opening import is_simulators
from crane.machine.drives import free_joints
from crane.machine.misfit import misfit

_LISTED = 4


def check_home(spec: MachineSpec, closure: Closure, guess: Array, varied: bool = False) -> None:
    """Refuse a home that is another one than the file says, and warn of one that was sought.

    A home is another one where the link of a joint that the file names is turned by more than 0.5
    rad from what it says, or slid by more than half of the machine's size. Of a machine whose
    numbers were changed it is another one if besides a loop is assembled the other way round: what
    its file says is of the machine as it was. The argument NEAREST_ASSEMBLY accepts it anyway.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
        guess: (nq,) what they were closed from.
        varied: Whether its numbers are others than those of its file.

    Raises:
        MechanismError: It is another one.
    """
    sought = closure.sought
    if sought is not None:
        refused = sought.is_far and (not varied or bool(sought.reversed))
        if refused and not asked(NEAREST_ASSEMBLY):
            text = _another(spec, closure, sought, guess)
            flag(MechanismError(f"{spec.where.get('home', spec.path.name)}: {text}", "home"))
        else:
            warnings.warn(_sought(spec, closure, sought), CraneWarning, stacklevel=3)
    if told := _digits(spec, closure):
        warnings.warn(told, CraneWarning, stacklevel=3)


def with_remedy(
    spec: MachineSpec, model: pin.Model, guess: Array, error: OpenLoopError
) -> OpenLoopError:
    """The error about a loop that does not close, with a number that would let it close.

    Args:
        spec: The machine as read.
        model: Its tree.
        guess: (nq,) home as the file says it.
        error: As it was raised.
    """
    found = misfit(spec, model, guess)
    if found is None or not found.remedies:
        return error
    return OpenLoopError(f"{error}: it would close with {found.listed}", error.about, error.reason)


def _another(spec: MachineSpec, closure: Closure, sought: Sought, guess: Array) -> str:
    joint, off = sought.off_said
    name = closure.equations.coordinates.names[joint]
    far = f"{off * closure.units[joint]:.3g} {'m' if slides(closure.model)[joint] else 'rad'}"
    loops = _list([f"'{loop}'" for loop in sought.reversed])
    over = f", loop {loops} the other way round" if loops else ""
    found = misfit(spec, closure.model, guess)
    why = f"{found}; correct home or the frames" if found else "correct home or the frames"
    own = f"--arg {NEAREST_ASSEMBLY}:=true (arguments={{'{NEAREST_ASSEMBLY}': True}} in Python)"
    keep = "" if is_simulators(spec.path) else "keep it with crane check --write-home, or "
    return (
        f"the loops close only far from the home that is said: {name} is {far} off{over}; {why}; "
        f"if what was found is meant, {keep}take it with {own}"
    )


def _sought(spec: MachineSpec, closure: Closure, sought: Sought) -> str:
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
