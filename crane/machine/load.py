"""From a description to a machine."""

import copy
import shlex
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.closure import Closure
from crane.description import MachineSpec, changed, inertia_problem, locked, read
from crane.description.sources import find
from crane.errors import DescriptionError, InputError, MechanismError
from crane.machine.machine import Machine, fixed
from crane.samples import Array

_NO_LIMIT = 1e9  # stands for infinity in the text handed to Pinocchio


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
    model = _assemble(spec)
    followers = {next(iter(coupling.factors)) for coupling in spec.couplings}
    active = spec.active or tuple(name for name in model.names[1:] if name not in followers)
    try:
        closure = Closure(
            model, spec.loops, active, _home_guess(spec, model, active), spec.couplings
        )
    except MechanismError as error:
        where = spec.where.get(error.about, spec.path.name)
        raise MechanismError(f"{where}: {error}", error.about) from None
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    return Machine(
        name=spec.name,
        source=spec.source,
        path=spec.path,
        chains=spec.chains,
        model=model,
        closure=closure,
        active=active,
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
        if not ("--set" in call or "--lock" in call):
            raise
    else:
        return load(call)  # a path may hold anything
    try:
        name, *words = shlex.split(call)
        numbers: dict[str, dict[str, float]] = {"--set": {}, "--lock": {}}
        for option, word in zip(words[::2], words[1::2], strict=True):
            key, _, value = word.rpartition("=")
            numbers[option][key] = float(value)
    except (ValueError, KeyError):
        raise InputError(
            f"'{call}' names no machine, write NAME --set PARAMETER=VALUE --lock JOINT=VALUE"
        ) from None
    return load(name, numbers["--set"], numbers["--lock"])


def _home_guess(spec: MachineSpec, model: pin.Model, active: tuple[str, ...]) -> Array:
    """(nq,) coordinates under `home`, of other joints zero or the limit nearest to it."""
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    guess = np.clip(np.zeros(model.nq), lower, upper)
    for joint, value in spec.home.items():
        column = model.joints[model.getJointId(joint)].idx_q
        if joint in active and not lower[column] <= value <= upper[column]:
            raise DescriptionError(
                f"{spec.where[f'home {joint}']}: home of '{joint}' is {value:g}, outside of its "
                f"limits {lower[column]:g} to {upper[column]:g}, choose one within them"
            )
        guess[column] = value
    return guess


def _assemble(spec: MachineSpec) -> pin.Model:
    """Pinocchio's model of the merged chains.

    One text for all chains, because Pinocchio then adds the joints depth-first: joints appended
    chain by chain make its crba wrong without a word.
    """
    robot = copy.deepcopy(spec.tree)
    for joint in robot.iter("joint"):
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")  # Pinocchio's continuous joint has two coordinates
        if joint.get("type") != "fixed":
            limit = joint.find("limit")
            if limit is None:
                limit = etree.SubElement(joint, "limit")
            for key, sign in (("lower", "-"), ("upper", ""), ("effort", ""), ("velocity", "")):
                limit.set(key, limit.get(key, f"{sign}{_NO_LIMIT}"))
    model = pin.buildModelFromXML(etree.tostring(robot).decode())
    for limits in (
        model.lowerPositionLimit, model.upperPositionLimit, model.effortLimit, model.velocityLimit,
    ):  # fmt: skip
        endless = np.abs(limits) >= _NO_LIMIT
        limits[endless] = np.copysign(np.inf, limits[endless])
    model.name = spec.name
    between = {link.get("name") for link in robot.iter("link") if link.get("between")}
    moved = {joint.get("name"): joint.find("child").get("link") for joint in robot.iter("joint")}
    for index in range(1, model.njoints):
        name = model.names[index]
        inertia = model.inertias[index]
        link = moved[name]
        where = spec.where[f"link {link}"]
        if link in between:
            continue
        if not inertia.mass > 0:
            raise DescriptionError(
                f"{where}: joint '{name}' moves link '{link}', which has no mass, give it an "
                "<inertial>"
            )
        if problem := inertia_problem(inertia.mass, inertia.inertia):
            raise DescriptionError(
                f"{where}: link '{link}' with what is fixed to it has {problem}"
            )
    return model
