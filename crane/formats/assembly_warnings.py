"""Errors and warnings about the home configuration and about other assembly modes of a machine."""

import numpy as np
import pinocchio as pin

from crane.closure.assembly_modes import AssemblyMode, find_alternative_assembly_modes
from crane.closure.closure import Closure
from crane.closure.constraint_structure import OpenLoopError
from crane.closure.constraint_tolerances import CLOSED_TOLERANCE
from crane.closure.home_search import HomeSearchResult, within_limits
from crane.common.errors import MechanismError, warn
from crane.common.package_search import NEAREST_ASSEMBLY, own_argument
from crane.common.samples import Array
from crane.description.findings import report_error
from crane.description.specification import MachineSpec
from crane.formats.robot_files import is_robot_file, is_sdf_file, is_simulator_file
from crane.machine.closure_diagnosis import diagnose_closure
from crane.machine.drive_selection import select_free_joints
from crane.machine.machine import Machine

_MAX_LISTED = 4  # loops and joints in a message


def check_home(
    spec: MachineSpec, closure: Closure, initial_guess: Array, is_modified: bool = False
) -> None:
    """Raise if home differs too much from that of the file, and warn if it was searched.

    Home differs too much if the link of a joint that the file specifies is rotated by more than
    0.5 rad or translated by more than half of the characteristic length. If parameters were
    changed, the file describes the original machine, so a loop must also have changed its assembly
    mode. The load argument NEAREST_ASSEMBLY accepts the home anyway.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
        initial_guess: (nq,) configuration from which they were closed.
        is_modified: Whether parameters differ from those of the file.

    Raises:
        MechanismError: Home differs too much.
    """
    search = closure.home_search
    if search is not None:
        is_rejected = search.is_far and (not is_modified or bool(search.reversed))
        if is_rejected and not own_argument(NEAREST_ASSEMBLY):
            problem = _different_home_text(spec, closure, search, initial_guess)
            report_error(
                MechanismError(
                    f"{spec.source_locations.get('home', spec.path.name)}: {problem}", "home"
                )
            )
        else:
            warn(_home_search_text(spec, closure, search), stacklevel=3)
    if message := _rounding_text(spec, closure):
        warn(message, stacklevel=3)


def add_remedy(
    spec: MachineSpec, model: pin.Model, initial_guess: Array, error: OpenLoopError
) -> OpenLoopError:
    """Return the error about an open loop, with a parameter change that would close it, if any.

    Args:
        spec: The machine as read.
        model: Its tree.
        initial_guess: (nq,) home of the file.
        error: The original error.
    """
    diagnosis = diagnose_closure(spec, model, initial_guess)
    if diagnosis is None or not diagnosis.remedies:
        return error
    return OpenLoopError(
        f"{error}: it would close with {diagnosis.remedies_text}", error.subject, error.reason
    )


def _different_home_text(
    spec: MachineSpec, closure: Closure, search: HomeSearchResult, initial_guess: Array
) -> str:
    joint, deviation = search.specified_deviation
    deviation_text = _coordinate_text(closure, joint, deviation * closure.units[joint], " is")
    loops = _list_names([f"'{loop}'" for loop in search.reversed])
    reversed_loops_text = f", loop {loops} in its other assembly mode" if loops else ""
    diagnosis = diagnose_closure(spec, closure.model, initial_guess)
    cause_text = (
        f"{diagnosis}; correct home or the frames" if diagnosis else "correct home or the frames"
    )
    argument_hint = (
        f"--arg {NEAREST_ASSEMBLY}:=true (arguments={{'{NEAREST_ASSEMBLY}': True}} in Python)"
    )
    write_hint = (
        "" if is_simulator_file(spec.path) else "keep it with crane check --write-home, or "
    )
    return (
        f"the loops close only far from the home of the file: {deviation_text} "
        f"off{reversed_loops_text}; {cause_text}; "
        f"if what was found is meant, {write_hint}take it with {argument_hint}"
    )


def _home_search_text(spec: MachineSpec, closure: Closure, search: HomeSearchResult) -> str:
    names = closure.equations.coordinates.names
    location = spec.source_locations.get("home", spec.path.name)
    deviation_text = _coordinate_text(closure, *search.largest_deviation)
    free = select_free_joints(spec, closure.active_names)
    driven_columns = [i for i in closure.active if names[int(i)] not in free]
    moved_text = _list_names([names[int(i)] for i in driven_columns if i in search.moved_columns])
    movement_text = f"moving {moved_text}, too" if moved_text else "the driven joints held"
    selection_text = (
        f"the nearest of {search.configuration_count} configurations"
        if search.configuration_count > 1
        else "the only configuration"
    )
    command = "convert, then crane check" if is_simulator_file(spec.path) else "check"
    return (
        f"{location}: home was searched for, because from the home of the file {search.reason}; "
        f"{movement_text}, {selection_text} that was found has {deviation_text} "
        f"off: look at it with crane sketch, and keep it with crane {command} --write-home"
    )


def _rounding_text(spec: MachineSpec, closure: Closure) -> str:
    redundancy_gap, equations = closure.structure.redundancy, closure.equations
    if redundancy_gap.largest_gap <= CLOSED_TOLERANCE:
        return ""
    loop = equations.names[equations.loop_of_row[redundancy_gap.largest_row]]
    location = spec.source_locations.get(f"loop {loop}", spec.path.name)
    is_translation = bool(equations.is_translation[redundancy_gap.largest_row])
    unit = "m" if is_translation else "rad"
    largest_gap = redundancy_gap.largest_gap * equations.residual_units[redundancy_gap.largest_row]
    gap = f"{largest_gap:.2g} {unit}"
    share_text = (
        f" ({redundancy_gap.largest_gap:.1g} of the machine's size)" if is_translation else ""
    )
    return (
        f"{location}: loop '{loop}' closes only to file precision: its redundant equations "
        f"stay open by up to {gap}{share_text}, while the others are closed; write axes, angles "
        "and pins with more digits"
    )


def _coordinate_text(closure: Closure, column: int, value: float, verb: str = "") -> str:
    coordinates = closure.equations.coordinates
    unit = "m" if coordinates.is_translation[column] else "rad"
    return f"{coordinates.names[column]}{verb} {value:.3g} {unit}"


def _list_names(names: list[str]) -> str:
    remaining = len(names) - _MAX_LISTED
    return ", ".join(names[:_MAX_LISTED]) + (f" and {remaining} more" if remaining > 0 else "")


_MAX_COORDINATES = 6  # in a message
# starts of the search in one block; they take milliseconds, and up to a second
_QUICK_STARTS, _THOROUGH_STARTS = 6, 100


def warn_about_assembly_modes(
    spec: MachineSpec, closure: Closure, initial_guess: Array, thorough: bool = False
) -> None:
    """Warn of loops that have another assembly mode that the file does not exclude.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
        initial_guess: (nq,) configuration from which they were closed, see `home_initial_guess`.
        thorough: Whether to search long and report all; else the first and the number of others.
    """
    if not len(closure.passive):
        return
    is_from_simulator = is_simulator_file(spec.path)
    names = closure.equations.coordinates.names
    alternatives = find_alternative_assembly_modes(
        closure,
        initial_guess,
        np.flatnonzero([is_from_simulator or name in spec.home for name in names]),
        _THOROUGH_STARTS if thorough else _QUICK_STARTS,
    )
    remainder = ""
    if len(alternatives) > 1 and not thorough:
        remainder = f"; {len(alternatives) - 1} more such: crane check lists them"
        alternatives = alternatives[:1]
    for alternative in alternatives:
        warn(_alternative_text(spec, closure, alternative) + remainder, stacklevel=3)


def warn_about_limits(spec: MachineSpec, closure: Closure) -> None:
    """Warn of passive joints that are outside of their limits at home."""
    coordinates = closure.equations.coordinates
    is_within_limits = within_limits(closure.equations, closure.home)
    for column in closure.passive[~is_within_limits[closure.passive]]:
        name = coordinates.names[int(column)]
        lower, upper = coordinates.lower[column], coordinates.upper[column]
        warn(
            f"{spec.tree.joints[name].source_location}: passive joint '{name}' is at "
            f"{closure.home[column]:.4g} with the loops closed at home, outside of its limits "
            f"{lower:g} to {upper:g}, widen them or correct the home or what is locked"
        )


def alternative_configurations(machine: Machine) -> list[Array]:
    """Return the configurations (nq,) of other assembly modes, as `crane check` reports them."""
    closure = machine.closure
    if not len(closure.passive):
        return []
    specified_columns = (
        np.arange(closure.model.nv)
        if is_simulator_file(machine.path)
        else closure.specified_columns
    )
    return [
        other.q
        for other in find_alternative_assembly_modes(
            closure, closure.initial_guess, specified_columns, _THOROUGH_STARTS
        )
    ]


def _alternative_text(spec: MachineSpec, closure: Closure, alternative: AssemblyMode) -> str:
    more = len(alternative.loops) - _MAX_LISTED
    listed = [f"'{name}'" for name in alternative.loops[:_MAX_LISTED]]
    loops = " and ".join([*listed, *[f"{more} more"] * (more > 0)])
    location = spec.source_locations.get("home") or spec.source_locations.get(
        f"loop {alternative.loops[0]}", spec.path.name
    )
    names = closure.equations.coordinates.names
    deviation_text = _coordinate_text(closure, *alternative.largest_deviation)
    deviation = f"{_coordinate_text(closure, *alternative.home_deviation)} off what it says"
    home_text = "outside of limits" if alternative.home_outside_limits else deviation
    columns = [int(i) for i in alternative.changed_columns]
    if len(columns) > _MAX_COORDINATES:  # with the largest differences
        differences = np.abs(closure.home - alternative.q)[columns]
        columns = [columns[i] for i in np.argsort(-differences, kind="stable")[:_MAX_LISTED]]
    is_urdf = spec.path.suffix in (".urdf", ".xacro")
    pattern = '<joint name="{}" value="{:.4g}"/>' if is_urdf else "{}: {:.4g}"
    home_values, alternative_values = (
        ", ".join(pattern.format(names[i], q[i]) for i in columns)
        for q in (closure.home, alternative.q)
    )
    return (
        f"{location}: loop{'s' * (len(alternative.loops) > 1)} {loops} can be assembled another "
        f"way at home, and the file does not say which is meant; {_home_element_text(spec)} write "
        f"{alternative_values} for the other ({deviation_text} off) or {home_values} to keep this "
        f"one ({home_text})"
    )


def _home_element_text(spec: MachineSpec) -> str:
    if spec.path.suffix.lower() in (".yaml", ".yml"):
        return "under 'home:'"
    if is_sdf_file(spec.path):
        return "in <initial_position> of axes"
    return 'in <group_state name="home">' if is_robot_file(spec.path) else "in the key 'home'"
