"""Whether the parts make a machine: every loop that does not close or does nothing."""

import warnings

import numpy as np
import pinocchio as pin

from crane.closure import Closure
from crane.closure.constraint_structure import OpenLoopError
from crane.closure.constraint_tolerances import least_squares_step
from crane.closure.home_search import within_limits
from crane.closure.loop_equations import LoopEquations
from crane.common.errors import CraneWarning, MechanismError
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.description.findings import Findings, report_error
from crane.formats.assembly_warnings import warn_about_assembly_modes
from crane.formats.check.strokes import warn_of_strokes, warn_of_tasks
from crane.formats.home_warnings import add_remedy, check_home
from crane.machine.machine_assembly import assemble_tree, build_closure, home_initial_guess
from crane.machine.machine_checks import (
    check_frame_elements,
    check_masses,
    replace_infeasible_inertias,
)

_OPEN_TOLERANCE = 1e-6  # [rad], [machine's size] from which on a loop is said to be open


def check_mechanism(spec: MachineSpec, findings: Findings) -> Closure | None:
    """Assemble and close a machine, and note what is wrong with it.

    Loops that lock nothing are left out once noted, so that the rest is checked, too.

    Args:
        spec: The machine as read.
        findings: What has been noted so far.

    Returns:
        The closure, None where there is none.
    """
    model = assemble_tree(spec)
    initial_guess = home_initial_guess(spec, model)
    if not findings.can_be_assembled:
        return None
    loops = list(spec.loops)
    while True:
        try:
            closure = build_closure(spec, model, initial_guess, loops)
            break
        except MechanismError as refused:
            error = refused
        idle_loops = [loop for loop in loops if error.subject == f"loop {loop.name}"]
        if "locks nothing" not in str(error) or not idle_loops:
            _report_with_gaps(spec, model, initial_guess, error)
            return None
        report_error(error)
        loops.remove(idle_loops[0])
    spec, model = replace_infeasible_inertias(spec, model, closure)
    check_masses(spec, model, closure)
    check_frame_elements(spec, closure)
    _warn_about_limits(spec, closure)
    check_home(spec, closure, initial_guess)
    warn_about_assembly_modes(spec, closure, initial_guess, thorough=True)
    if findings.can_be_assembled:
        warn_of_tasks(spec, closure)
        warn_of_strokes(spec, closure)
    return closure


def _report_with_gaps(
    spec: MachineSpec, model: pin.Model, initial_guess: Array, error: MechanismError
) -> None:
    """Note an error; where loops stay open, how far each does."""
    gaps = {}
    if isinstance(error, OpenLoopError):
        gaps, error = (
            _loop_gaps(spec, model, initial_guess),
            add_remedy(spec, model, initial_guess, error),
        )
    own_gap = gaps.pop(error.subject, "")
    report_error(
        MechanismError(f"{error}{f' (it is {own_gap})' if own_gap else ''}", error.subject)
    )
    for subject, gap in gaps.items():
        problem = f"loop '{subject.removeprefix('loop ')}' stays open, too: it is {gap}"
        report_error(
            MechanismError(
                f"{spec.source_locations.get(subject, spec.path.name)}: {problem}", subject
            )
        )


def _loop_gaps(spec: MachineSpec, model: pin.Model, initial_guess: Array) -> dict[str, str]:
    """How far apart and askew the frames of open loops are, as near as they come to closing."""
    equations = LoopEquations(model, spec.loops, spec.couplings)
    active = [equations.coordinates.column(name) for name in spec.active or ()]
    all_columns = np.arange(model.nv)
    phi = np.zeros(0)
    for movable in (all_columns, np.setdiff1d(all_columns, active)):
        q = initial_guess.copy()
        for _ in range(200):
            phi, jacobian = equations.evaluate_scaled(q)
            q[movable] += (
                least_squares_step(jacobian[:, movable], phi) * equations.coordinate_units[movable]
            )
        phi, _ = equations.evaluate_scaled(q)
        if np.abs(phi).max() > _OPEN_TOLERANCE:
            break
    gap_texts = {}
    for index, loop in enumerate(equations.loops):
        rows = equations.loop_of_row == index
        length = float(np.linalg.norm(phi[rows & equations.is_translation]))
        # rows of rotations are cosines of angles that are right ones when closed
        sine = min(1.0, float(np.linalg.norm(phi[rows & ~equations.is_translation])))
        if max(length, sine) > _OPEN_TOLERANCE:
            angle_text = f"{np.degrees(np.arcsin(sine)):.3g} deg askew"
            gap_texts[f"loop {loop.name}"] = (
                f"{_format_length(length * equations.characteristic_length)} apart and "
                f"{angle_text}"
            )
    return gap_texts


def _format_length(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 1 else f"{1e3 * metres:.3g} mm"


def _warn_about_limits(spec: MachineSpec, closure: Closure) -> None:
    """Warn of passive joints that are outside of their limits at home."""
    coordinates = closure.equations.coordinates
    is_within_limits = within_limits(closure.equations, closure.home)
    for column in closure.passive:
        name = coordinates.names[int(column)]
        lower, upper = coordinates.lower[column], coordinates.upper[column]
        q = closure.home[column]
        if not is_within_limits[column]:
            location = spec.tree.joints[name].source_location
            warnings.warn(
                f"{location}: passive joint '{name}' is at {q:.4g} with the loops closed at home, "
                f"outside of its limits {lower:g} to {upper:g}, widen them or correct the home",
                CraneWarning,
                stacklevel=2,
            )
