"""From a description to a machine."""

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from crane.common.errors import DescriptionError, InputError
from crane.description import changed, locked
from crane.description.sources import WITH, find
from crane.formats.ambiguity import warn_of_assemblies
from crane.formats.machine_file.read import read
from crane.machine.assemble import assemble, closed, home_guess
from crane.machine.machine import Machine, fixed


def load(
    name: str | Path,
    changes: Mapping[str, float] | None = None,
    lock: Mapping[str, float] | None = None,
) -> Machine:
    """Load a machine, perhaps with some of its numbers changed, or joints locked.

    Args:
        name: A bundled machine's name, a robot of example-robot-data by its file's name, or the
            path of a machine file (.yaml) or URDF (.urdf, with `<loop>` elements if it has loops).
        changes: New values by the names of `crane.description.parameters`, such as
            {"link3_G.x": 0.1, "link7.mass": 0.25, "payload.mass": 0.1}; SI units.
        lock: Coordinates [m], [rad] of joints to be fixed, by name.

    Returns:
        The machine, its home posture closed.

    Raises:
        DescriptionError: A file is wrong; the message has file and line.
        MechanismError: The parts do not make a machine that can be driven.
        InputError: A change of a parameter that is not there, or to what cannot be.
    """
    spec = read(name)
    if changes:
        spec = changed(spec, changes)
    if lock:
        spec = locked(spec, lock)
    model = assemble(spec)
    guess = home_guess(spec, model)
    closure = closed(spec, model, guess)
    warn_of_assemblies(spec, closure, guess)
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    return Machine(
        name=spec.name,
        source=spec.source,
        path=spec.path,
        chains=spec.chains,
        tree=spec.tree,
        model=model,
        closure=closure,
        active=closure.active_names,
        lower=fixed(lower[closure.active]),
        upper=fixed(upper[closure.active]),
        friction=MappingProxyType(dict(spec.friction)),
        forces=spec.forces,
        gas_springs=spec.gas_springs,
        end_stops=spec.end_stops,
        tip=spec.tip,
        tasks=MappingProxyType(dict(spec.tasks)),
        control=MappingProxyType(dict(spec.control)),
        hydraulics=spec.hydraulics,
        changes=MappingProxyType({name: float(value) for name, value in (changes or {}).items()}),
        motors=spec.motors,
        locks=MappingProxyType({name: float(value) for name, value in (lock or {}).items()}),
    )


def recalled(call: str) -> Machine:
    """Load a machine by what `Machine.call` says of it.

    Raises:
        InputError: It says nothing that can be understood; otherwise as `load`.
    """
    try:
        find(call)
    except DescriptionError:
        if WITH not in call:
            raise
    else:
        return load(call)  # a path may hold anything
    name, _, text = call.partition(WITH)
    try:
        given = json.loads(text)
        numbers = [
            {key: float(value) for key, value in given.pop(kind, {}).items()}
            for kind in ("changes", "lock")
        ]
    except (ValueError, TypeError, AttributeError, RecursionError):
        given = {"": None}
    if given:
        example = '{"changes": {"payload.mass": 200}, "lock": {"slew": 0}}'
        raise InputError(f"'{call}' names no machine, write NAME{WITH}{example}")
    return load(name, *numbers)
