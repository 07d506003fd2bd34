"""Warnings about machines whose files do not tell how to assemble them."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from crane.closure import Closure
from crane.closure.assemblies import Assembly, ambiguities
from crane.closure.choice import slides
from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.description import MachineSpec
from crane.formats.opening import is_robot, is_sdf, is_simulators
from crane.machine import Machine

_LISTED, _WRITTEN = 4, 6  # loops and coordinates in a line
_QUICK, _THOROUGH = 6, 100  # starts of the search in one block: milliseconds, up to a second


def warn_of_assemblies(
    spec: MachineSpec, closure: Closure, guess: Array, thorough: bool = False
) -> None:
    """Warn of loops that are assembled one way though the file may mean another.

    Args:
        spec: The machine as read.
        closure: Its loops, closed at home.
        guess: (nq,) what they were closed from, see `home_guess`.
        thorough: Whether to search long, and to tell all; else the first and how many there are.
    """
    if not len(closure.passive):
        return
    drawn = is_simulators(spec.path)
    names = closure.equations.coordinates.names
    named = [i for i, name in enumerate(names) if drawn or name in spec.home]
    most = _THOROUGH if thorough else _QUICK
    found = ambiguities(closure, guess, np.array(named, dtype=np.intp), most)
    more = ""
    if len(found) > 1 and not thorough:
        more = f"; {len(found) - 1} more such: crane check tells them"
        found = found[:1]
    for other in found:
        warnings.warn(_told(spec, closure, other) + more, CraneWarning, stacklevel=3)


def near_assemblies(machine: Machine) -> list[Array]:
    """Other postures (nq,) that its file does not rule out, as `crane check` tells them."""
    closure = machine.closure
    if not len(closure.passive):
        return []
    said = np.arange(closure.model.nv) if is_simulators(machine.path) else closure.said
    return [other.q for other in ambiguities(closure, closure.guess, said, _THOROUGH)]


def _told(spec: MachineSpec, closure: Closure, other: Assembly) -> str:
    loops = " and ".join(f"'{name}'" for name in other.loops[:_LISTED])
    if more := len(other.loops) - _LISTED:
        loops += f" and {more} more" if more > 0 else ""
    place = spec.where.get("home") or spec.where.get(f"loop {other.loops[0]}", spec.path.name)
    names = closure.equations.coordinates.names
    sliding = slides(closure.model)

    def off(at: tuple[int, float]) -> str:
        return f"{names[at[0]]} {at[1]:.3g} {'m' if sliding[at[0]] else 'rad'} off"

    kept = "outside of limits" if other.outside else off(other.home_off)
    columns = [int(i) for i in other.columns]
    if len(columns) > _WRITTEN:  # those that tell the assemblies apart best
        apart = np.abs(closure.home - other.q)[columns]
        columns = [columns[i] for i in np.argsort(-apart, kind="stable")[:_LISTED]]
    now, then = (
        _values(spec, [names[i] for i in columns], q[columns]) for q in (closure.home, other.q)
    )
    return (
        f"{place}: loop{'s' * (len(other.loops) > 1)} {loops} can be assembled another way at "
        f"home, and the file does not say which is meant; {_where(spec)} write {then} for the "
        f"other ({off(other.off)}) or {now} to keep this one ({kept} what it says)"
    ).replace("limits what it says", "limits")


def _where(spec: MachineSpec) -> str:
    """Where a file says how its machine is at home."""
    if _in_yaml(spec.path):
        return "under 'home:'"
    if is_sdf(spec.path):
        return "in <initial_position> of axes"
    return 'in <group_state name="home">' if is_robot(spec.path) else "in the key 'home'"


def _in_yaml(path: Path) -> bool:
    return path.suffix.lower() in (".yaml", ".yml")


def _values(spec: MachineSpec, names: Sequence[str], values: Array) -> str:
    """Coordinates as a file has them."""
    pattern = (
        '<joint name="{}" value="{:.4g}"/>'
        if spec.path.suffix in (".urdf", ".xacro")
        else "{}: {:.4g}"
    )
    return ", ".join(
        pattern.format(name, value) for name, value in zip(names, values, strict=True)
    )
