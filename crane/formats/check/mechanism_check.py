"""Check that the loops of a machine close, at home, in its tasks and over its strokes."""

import warnings
from collections.abc import Iterator, Mapping

import numpy as np
import pinocchio as pin

from crane.closure import Closure
from crane.closure.constraint_structure import OpenLoopError
from crane.closure.constraint_tolerances import least_squares_step
from crane.closure.home_search import within_limits
from crane.closure.loop_equations import LoopEquations
from crane.common.errors import ClosureError, CraneWarning, MechanismError
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.description.findings import Findings, report_error
from crane.description.specification import TIP_COORDINATES
from crane.formats.assembly_warnings import add_remedy, check_home, warn_about_assembly_modes
from crane.machine.frame_element_checks import check_frame_elements
from crane.machine.machine_assembly import assemble_tree, build_closure, home_initial_guess
from crane.machine.mass_checks import check_masses, replace_infeasible_inertias

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


_SAMPLES, _WORK = 150, 6000  # of the strokes' box, and samples times joints at most
_FAILED = 20  # of these that end it: each takes a hundred times as long as one that closes
_LONG = 100.0  # characteristic lengths of the machine, of a stroke that is told as millimetres
_TOLD = 0.01  # share of the box that does not close
_SLACK = 1e-6  # of a limit [rad], [machine's size], as runs have it


def warn_of_tasks(spec: MachineSpec, closure: Closure) -> None:
    """Warn of points of tasks that are beyond limits of active joints, or do not close.

    Points are via points, starts, and the positions that phases of levers end at. Those of the tip
    are only held against the length of all links in line.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
    """
    coordinates, active = closure.equations.coordinates, closure.active
    names = closure.active_names
    slack = _SLACK * closure.units
    place, reach = spec.source_locations.get("tasks", spec.path.name), _reach(spec)
    for name, task in spec.tasks.items():
        for via in task.via if task.space == "tip" else ():
            away = float(np.linalg.norm([via.point.get(axis, 0.0) for axis in TIP_COORDINATES]))
            if away > reach:
                _warn(
                    f"{place}: task '{name}' has its tip {away:.4g} m from the root at t = "
                    f"{via.time:g} s, and all links in line are {reach:.4g} m long, choose a "
                    "point within reach"
                )
                break
        for what, point in _points(spec, name):
            q_a = closure.home[active].copy()
            for joint in point.keys() & set(names):
                column = coordinates.column(joint)
                lower, upper = coordinates.lower[column], coordinates.upper[column]
                value = q_a[names.index(joint)] = point[joint]
                if not lower - slack[column] <= value <= upper + slack[column]:
                    unit = "m" if coordinates.is_translation[column] else "rad"
                    _warn(
                        f"{place}: task '{name}' has '{joint}' at {value:g} {unit} {what}, beyond "
                        f"its limits {lower:g} to {upper:g} {unit}, choose a position within them"
                    )
                    break
            else:
                try:
                    closure.solve(q_a)
                except ClosureError as error:
                    _warn(f"{place}: task '{name}' {what}: {error}; choose another position")


def warn_of_strokes(spec: MachineSpec, closure: Closure) -> None:
    """Warn where loops do not close in a part of the box that the limits of slides make.

    Those are the active slides in loops; all other active joints stay at home.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
    """
    coordinates, active = closure.equations.coordinates, closure.active
    lower, upper = coordinates.lower[active], coordinates.upper[active]
    moved = coordinates.is_translation[active] & (
        upper - lower < _LONG * closure.characteristic_length
    )
    moved &= (closure.equations.sign[:, active] != 0).any(axis=0)
    if not moved.any():
        return
    failed: list[tuple[float, str]] = []
    shares = _shares(int(moved.sum()), max(1, min(_SAMPLES, _WORK // len(closure.home))))
    span = (upper - lower)[moved]
    home = closure.home[active]
    tried = 0
    for share in shares:
        tried += 1
        q_a = home.copy()
        q_a[moved] = lower[moved] + share * span
        try:
            closure.solve(q_a)
        except ClosureError as error:
            away = np.abs((q_a - home)[moved] / np.where(span > 0, span, 1.0)).max()
            failed.append((float(away), str(error)))
            if len(failed) == _FAILED:
                break
    part = len(failed) / tried
    if part >= _TOLD:
        names = ", ".join(x for x, yes in zip(closure.active_names, moved, strict=True) if yes)
        _warn(
            f"{spec.source_locations.get('active', spec.path.name)}: {100 * part:.0f} % of the "
            f"strokes "
            f"within the limits of {names} lie beyond dead centres, the nearest "
            f"of those tried: "
            f"{min(failed)[1]}; narrow the limits, or see that the lengths are right"
        )


def _reach(spec: MachineSpec) -> float:
    """Length of all links from the root to the tip in line, of slides at their longest [m]."""
    above = {joint.child: joint for joint in spec.tree.joints.values()}
    link, length = spec.tip, 0.0
    while link in above:
        joint = above[link]
        length += float(np.linalg.norm(joint.xyz))
        if joint.kind == "prismatic":
            length += max(abs(joint.limits.lower), abs(joint.limits.upper))
        elif joint.kind not in ("fixed", "revolute", "continuous"):
            return np.inf
        link = joint.parent
    return length


def _points(spec: MachineSpec, name: str) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Positions of active joints that a task comes to, in words and by joint."""
    task = spec.tasks[name]
    if task.start:
        yield "at its start", task.start
    if task.via and task.space == "active":
        known: dict[str, float] = {}
        for via in task.via:
            known |= via.point
            yield f"at t = {via.time:g} s", dict(known)
    now = dict(task.start)
    for phase in task.phases:
        now |= phase.until
        yield f"at the end of phase '{phase.name}'", dict(now)


def _shares(count: int, samples: int) -> Array:
    """(samples, count) points of the unit box, a low-discrepancy sequence.

    Multiples of the powers of 1 / phi, phi^(k + 1) = phi + 1 for k unknowns (Roberts 2018).
    """
    phi = 2.0
    for _ in range(40):
        phi = (1 + phi) ** (1 / (count + 1))
    steps = phi ** -np.arange(1.0, count + 1)
    return np.remainder(0.5 + np.outer(np.arange(1, samples + 1), steps), 1.0)


def _warn(text: str) -> None:
    warnings.warn(text, CraneWarning, stacklevel=3)
