"""Warnings about machines whose files do not tell how to assemble them."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from crane.closure import Closure
from crane.closure.active_joint_selection import translational_coordinates
from crane.closure.assembly_modes import AssemblyMode, find_alternative_assembly_modes
from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.formats.robot_files import is_robot_file, is_sdf_file, is_simulator_file
from crane.machine import Machine

_MAX_LISTED, _MAX_COORDINATES = 4, 6  # loops and coordinates in a line
_QUICK_STARTS, _THOROUGH_STARTS = (
    6,
    100,
)  # starts of the search in one block: milliseconds, up to a second


def warn_about_assembly_modes(
    spec: MachineSpec, closure: Closure, initial_guess: Array, thorough: bool = False
) -> None:
    """Warn of loops that are assembled one way though the file may mean another.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
        initial_guess: (nq,) what they were closed from, see `home_initial_guess`.
        thorough: Whether to search long, and to tell all; else the first and how many there are.
    """
    if not len(closure.passive):
        return
    is_from_simulator = is_simulator_file(spec.path)
    names = closure.equations.coordinates.names
    specified_columns = [
        i for i, name in enumerate(names) if is_from_simulator or name in spec.home
    ]
    max_starts = _THOROUGH_STARTS if thorough else _QUICK_STARTS
    alternatives = find_alternative_assembly_modes(
        closure, initial_guess, np.array(specified_columns, dtype=np.intp), max_starts
    )
    remainder = ""
    if len(alternatives) > 1 and not thorough:
        remainder = f"; {len(alternatives) - 1} more such: crane check tells them"
        alternatives = alternatives[:1]
    for alternative in alternatives:
        warnings.warn(
            _alternative_text(spec, closure, alternative) + remainder, CraneWarning, stacklevel=3
        )


def alternative_configurations(machine: Machine) -> list[Array]:
    """Other postures (nq,) that its file does not rule out, as `crane check` tells them."""
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
    loops = " and ".join(f"'{name}'" for name in alternative.loops[:_MAX_LISTED])
    if more := len(alternative.loops) - _MAX_LISTED:
        loops += f" and {more} more" if more > 0 else ""
    location = spec.source_locations.get("home") or spec.source_locations.get(
        f"loop {alternative.loops[0]}", spec.path.name
    )
    names = closure.equations.coordinates.names
    is_translation = translational_coordinates(closure.model)

    def deviation_text(at: tuple[int, float]) -> str:
        return f"{names[at[0]]} {at[1]:.3g} {'m' if is_translation[at[0]] else 'rad'} off"

    home_text = (
        "outside of limits"
        if alternative.home_outside_limits
        else deviation_text(alternative.home_deviation)
    )
    columns = [int(i) for i in alternative.changed_columns]
    if len(columns) > _MAX_COORDINATES:  # those that tell the assemblies apart best
        differences = np.abs(closure.home - alternative.q)[columns]
        columns = [columns[i] for i in np.argsort(-differences, kind="stable")[:_MAX_LISTED]]
    home_values, alternative_values = (
        _coordinates_text(spec, [names[i] for i in columns], q[columns])
        for q in (closure.home, alternative.q)
    )
    return (
        f"{location}: loop{'s' * (len(alternative.loops) > 1)} {loops} can be assembled another "
        f"way at "
        f"home, and the file does not say which is meant; {_home_element_text(spec)} write "
        f"{alternative_values} for the "
        f"other ({deviation_text(alternative.largest_deviation)}) or {home_values} to keep this "
        f"one ({home_text} what it says)"
    ).replace("limits what it says", "limits")


def _home_element_text(spec: MachineSpec) -> str:
    """Where a file says how its machine is at home."""
    if _is_yaml_file(spec.path):
        return "under 'home:'"
    if is_sdf_file(spec.path):
        return "in <initial_position> of axes"
    return 'in <group_state name="home">' if is_robot_file(spec.path) else "in the key 'home'"


def _is_yaml_file(path: Path) -> bool:
    return path.suffix.lower() in (".yaml", ".yml")


def _coordinates_text(spec: MachineSpec, names: Sequence[str], values: Array) -> str:
    """Coordinates as a file has them."""
    pattern = (
        '<joint name="{}" value="{:.4g}"/>'
        if spec.path.suffix in (".urdf", ".xacro")
        else "{}: {:.4g}"
    )
    return ", ".join(
        pattern.format(name, value) for name, value in zip(names, values, strict=True)
    )
