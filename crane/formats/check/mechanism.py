"""Whether the parts make a machine: every loop that does not close or does nothing."""

import warnings

import numpy as np
import pinocchio as pin

from crane.closure import Closure
from crane.closure.equations import LoopEquations
from crane.closure.exactness import least_squares_step
from crane.closure.home import within
from crane.closure.structure import OpenLoopError
from crane.common.errors import CraneWarning, MechanismError
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.description.findings import Findings, flag
from crane.formats.ambiguity import warn_of_assemblies
from crane.formats.check.strokes import warn_of_strokes, warn_of_tasks
from crane.formats.home import check_home, with_remedy
from crane.machine.assemble import assemble, closed, home_guess
from crane.machine.between import check_elements
from crane.machine.masses import check_masses, with_computable_inertias

_OPEN = 1e-6  # [rad], [machine's size] from which on a loop is said to be open


def check_mechanism(spec: MachineSpec, found: Findings) -> Closure | None:
    """Assemble and close a machine, and note what is wrong with it.

    Loops that lock nothing are left out once noted, so that the rest is checked, too.

    Args:
        spec: The machine as read.
        found: What has been noted so far.

    Returns:
        The closure, None where there is none.
    """
    model = assemble(spec)
    guess = home_guess(spec, model)
    if not found.usable:
        return None
    loops = list(spec.loops)
    while True:
        try:
            closure = closed(spec, model, guess, loops)
            break
        except MechanismError as refused:
            error = refused
        idle = [loop for loop in loops if error.about == f"loop {loop.name}"]
        if "locks nothing" not in str(error) or not idle:
            _note_with_gaps(spec, model, guess, error)
            return None
        flag(error)
        loops.remove(idle[0])
    spec, model = with_computable_inertias(spec, model, closure)
    check_masses(spec, model, closure)
    check_elements(spec, closure)
    _warn_of_limits(spec, closure)
    check_home(spec, closure, guess)
    warn_of_assemblies(spec, closure, guess, thorough=True)
    if found.usable:
        warn_of_tasks(spec, closure)
        warn_of_strokes(spec, closure)
    return closure


def _note_with_gaps(
    spec: MachineSpec, model: pin.Model, guess: Array, error: MechanismError
) -> None:
    """Note an error; where loops stay open, how far each does."""
    gaps = {}
    if isinstance(error, OpenLoopError):
        gaps, error = _gaps(spec, model, guess), with_remedy(spec, model, guess, error)
    apart = gaps.pop(error.about, "")
    flag(MechanismError(f"{error}{f' (it is {apart})' if apart else ''}", error.about))
    for about, gap in gaps.items():
        what = f"loop '{about.removeprefix('loop ')}' stays open, too: it is {gap}"
        flag(MechanismError(f"{spec.where.get(about, spec.path.name)}: {what}", about))


def _gaps(spec: MachineSpec, model: pin.Model, guess: Array) -> dict[str, str]:
    """How far apart and askew the frames of open loops are, as near as they come to closing."""
    equations = LoopEquations(model, spec.loops, spec.couplings)
    active = [equations.coordinates.column(name) for name in spec.active or ()]
    every = np.arange(model.nv)
    phi = np.zeros(0)
    for free in (every, np.setdiff1d(every, active)):
        q = guess.copy()
        for _ in range(200):
            phi, jacobian = equations.scaled(q)
            q[free] += least_squares_step(jacobian[:, free], phi) * equations.units[free]
        phi, _ = equations.scaled(q)
        if np.abs(phi).max() > _OPEN:
            break
    found = {}
    for index, loop in enumerate(equations.loops):
        rows = equations.loop_of_row == index
        length = float(np.linalg.norm(phi[rows & equations.is_translation]))
        # rows of rotations are cosines of angles that are right ones when closed
        sine = min(1.0, float(np.linalg.norm(phi[rows & ~equations.is_translation])))
        if max(length, sine) > _OPEN:
            askew = f"{np.degrees(np.arcsin(sine)):.3g} deg askew"
            found[f"loop {loop.name}"] = f"{_length(length * equations.size)} apart and {askew}"
    return found


def _length(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 1 else f"{1e3 * metres:.3g} mm"


def _warn_of_limits(spec: MachineSpec, closure: Closure) -> None:
    """Warn of passive joints that are outside of their limits at home."""
    coordinates = closure.equations.coordinates
    kept = within(closure.equations, closure.home)
    for column in closure.passive:
        name = coordinates.names[int(column)]
        lower, upper = coordinates.lower[column], coordinates.upper[column]
        q = closure.home[column]
        if not kept[column]:
            place = spec.tree.joints[name].where
            warnings.warn(
                f"{place}: passive joint '{name}' is at {q:.4g} with the loops closed at home, "
                f"outside of its limits {lower:g} to {upper:g}, widen them or correct the home",
                CraneWarning,
                stacklevel=2,
            )
