"""Check that the loops of a machine close, at home, in its tasks and over its strokes."""

from collections.abc import Iterator, Mapping

import numpy as np
import pinocchio as pin

from crane.closure.closure import Closure
from crane.closure.constraint_structure import OpenLoopError
from crane.closure.constraint_tolerances import least_squares_step
from crane.closure.loop_equations import LoopEquations
from crane.closure.multi_start_search import low_discrepancy_steps
from crane.common.errors import ClosureError, MechanismError, warn
from crane.common.samples import Array
from crane.description.findings import Findings, report_error
from crane.description.kinematic_tree import path_to_root
from crane.description.specification import TIP_COORDINATES, MachineSpec, Task
from crane.formats.assembly_warnings import (
    add_remedy,
    check_home,
    warn_about_assembly_modes,
    warn_about_limits,
)
from crane.machine.machine_assembly import assemble_tree, build_closure, home_initial_guess
from crane.machine.machine_checks import (
    check_frame_elements,
    check_masses,
    replace_infeasible_inertias,
)

_OPEN_TOLERANCE = 1e-6  # [rad], [characteristic length]


def check_mechanism(spec: MachineSpec, findings: Findings) -> Closure | None:
    """Assemble and close a machine, and record errors and warnings.

    Loops without effect are left out once recorded, so that the rest is checked, too.

    Args:
        spec: The machine as read.
        findings: Errors recorded so far.

    Returns:
        The closure, None if the machine cannot be closed.
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
    warn_about_limits(spec, closure)
    check_home(spec, closure, initial_guess)
    warn_about_assembly_modes(spec, closure, initial_guess, thorough=True)
    if findings.can_be_assembled:
        check_tasks(spec, closure)
        check_strokes(spec, closure)
    return closure


def _report_with_gaps(
    spec: MachineSpec, model: pin.Model, initial_guess: Array, error: MechanismError
) -> None:
    text, gaps = str(error), {}
    if isinstance(error, OpenLoopError):
        gaps = _loop_gaps(spec, model, initial_guess)
        text = str(add_remedy(spec, model, initial_guess, error))
        if own_gap := gaps.pop(error.subject, ""):  # instead of the largest residual
            residual_text = error.reason.rpartition("' ")[2]
            text = text.replace(f"it {residual_text}", f"its smallest gap is {own_gap}")
    report_error(MechanismError(text, error.subject))
    for subject, gap in gaps.items():
        location = spec.source_locations.get(subject, spec.path.name)
        name = subject.removeprefix("loop ")
        problem = f"loop '{name}' stays open, too: its smallest gap is {gap}"
        report_error(MechanismError(f"{location}: {problem}", subject))


def _loop_gaps(spec: MachineSpec, model: pin.Model, initial_guess: Array) -> dict[str, str]:
    """Return the position and angle gaps of open loops at the least-squares configuration."""
    equations = LoopEquations(model, spec.loops, spec.couplings)
    active = [equations.coordinates.column(name) for name in spec.active or ()]
    all_columns = np.arange(model.nv)
    phi = np.zeros(0)
    for movable in (all_columns, np.setdiff1d(all_columns, active)):
        q = initial_guess.copy()
        for _ in range(200):
            phi, jacobian = equations.evaluate_scaled(q)
            q = equations.displace(q, movable, least_squares_step(jacobian[:, movable], phi))
        phi, _ = equations.evaluate_scaled(q)
        if np.abs(phi).max() > _OPEN_TOLERANCE:
            break
    gap_texts = {}
    for index, loop in enumerate(equations.loops):
        rows = equations.loop_of_row == index
        length = float(np.linalg.norm(phi[rows & equations.is_translation]))
        # rows of rotations are cosines of angles that are right ones when closed
        sine = min(1.0, float(np.linalg.norm(phi[rows & ~equations.is_translation])))
        metres = length * equations.characteristic_length
        length_text = f"{metres:.3g} m" if metres >= 1 else f"{1e3 * metres:.3g} mm"
        angle_text = f"{np.degrees(np.arcsin(sine)):.3g} deg"
        parts = ((length, length_text), (sine, angle_text))
        if open_parts := [text for gap, text in parts if gap > _OPEN_TOLERANCE]:
            gap_texts[f"loop {loop.name}"] = " and ".join(open_parts)
    return gap_texts


_MAX_SAMPLES, _MAX_SAMPLED_JOINTS = 150, 6000  # of the strokes; samples times joints
_MAX_FAILURES = 20  # a failing sample takes a hundred times as long as one that closes
_MAX_STROKE = 100.0  # [characteristic length]; a longer one is probably in millimetres
_MIN_FAILED_SHARE = 0.01  # of the samples, for a warning
_LIMIT_TOLERANCE = 1e-6  # [rad], [characteristic length], as in simulations


def check_tasks(spec: MachineSpec, closure: Closure) -> None:
    """Warn of points of tasks that are outside of limits or where loops do not close.

    Points are via points, starts, and the end positions of phases. Points of the tip are only
    compared with the total length of the links.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
    """
    location, reach = spec.source_locations.get("tasks", spec.path.name), _reach(spec)
    for name, task in spec.tasks.items():
        for via in task.via if task.space == "tip" else ():
            distance = float(np.linalg.norm([via.point.get(x, 0.0) for x in TIP_COORDINATES]))
            if distance > reach:
                warn(
                    f"{location}: task '{name}' has its tip {distance:.4g} m from the root at t = "
                    f"{via.time:g} s, and all links in line are {reach:.4g} m long, choose a "
                    "point within reach"
                )
                break
        for instant, positions in _task_positions(task):
            if problem := _position_problem(closure, instant, positions):
                warn(f"{location}: task '{name}' {problem}")


def _position_problem(closure: Closure, instant: str, positions: Mapping[str, float]) -> str:
    """Describe the first position outside of limits, or why the loops do not close, else ""."""
    coordinates, names = closure.equations.coordinates, closure.active_names
    tolerance = _LIMIT_TOLERANCE * closure.units
    q_a = closure.home[closure.active].copy()
    for joint in positions.keys() & set(names):
        column = coordinates.column(joint)
        lower, upper = coordinates.lower[column], coordinates.upper[column]
        value = q_a[names.index(joint)] = positions[joint]
        if not lower - tolerance[column] <= value <= upper + tolerance[column]:
            unit = "m" if coordinates.is_translation[column] else "rad"
            return (
                f"has '{joint}' at {value:g} {unit} {instant}, beyond its limits {lower:g} to "
                f"{upper:g} {unit}, choose a position within them"
            )
    try:
        closure.solve(q_a)
    except ClosureError as error:
        return f"{instant}: {error}; choose another position"
    return ""


def check_strokes(spec: MachineSpec, closure: Closure) -> None:
    """Warn of loops that do not close in a part of the box spanned by the strokes.

    The box has the active prismatic joints in loops as axes; all other active joints are at home.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
    """
    coordinates, active = closure.equations.coordinates, closure.active
    lower, upper = coordinates.lower[active], coordinates.upper[active]
    is_moved = coordinates.is_translation[active] & (
        upper - lower < _MAX_STROKE * closure.characteristic_length
    )
    is_moved &= (closure.equations.sign[:, active] != 0).any(axis=0)
    if not is_moved.any():
        return
    failures: list[tuple[float, str]] = []
    sample_count = max(1, min(_MAX_SAMPLES, _MAX_SAMPLED_JOINTS // len(closure.home)))
    span, home = (upper - lower)[is_moved], closure.home[active]
    steps, tried_count = low_discrepancy_steps(len(span)), 0
    while tried_count < sample_count and len(failures) < _MAX_FAILURES:
        tried_count += 1
        q_a = home.copy()
        q_a[is_moved] = lower[is_moved] + np.remainder(0.5 + tried_count * steps, 1.0) * span
        try:
            closure.solve(q_a)
        except ClosureError as error:
            distances = np.abs((q_a - home)[is_moved] / np.where(span > 0, span, 1.0))
            failures.append((float(distances.max()), str(error)))
    failed_share = len(failures) / tried_count
    if failed_share >= _MIN_FAILED_SHARE:
        names = ", ".join(np.array(closure.active_names)[is_moved])
        warn(
            f"{spec.source_locations.get('active', spec.path.name)}: {100 * failed_share:.0f} % "
            f"of the strokes within the limits of {names} lie beyond dead centres, the nearest "
            f"of those tried: {min(failures)[1]}; narrow the limits, or see that the lengths are "
            "right"
        )


def _reach(spec: MachineSpec) -> float:
    """Return the length [m] of all links from the root to the tip in line, slides extended."""
    length = 0.0
    for joint in path_to_root(spec.tree.parent_joints, spec.tip or ""):
        length += float(np.linalg.norm(joint.xyz))
        if joint.kind == "prismatic":
            length += max(abs(joint.limits.lower), abs(joint.limits.upper))
    return length


def _task_positions(task: Task) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Yield positions of active joints that a task reaches, with the instant in words."""
    if task.start:
        yield "at its start", task.start
    positions: dict[str, float] = {}
    for via in task.via if task.space == "active" else ():
        positions |= via.point
        yield f"at t = {via.time:g} s", dict(positions)
    positions = dict(task.start)
    for phase in task.phases:
        positions |= phase.until
        yield f"at the end of phase '{phase.name}'", dict(positions)
