"""The plant of a virtual rig: the model with random parameters and stiction."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.common.errors import InputError
from crane.common.samples import as_number
from crane.description import Friction, MachineSpec, parameters
from crane.formats import read_machine_spec
from crane.machine import Machine

_STRIBECK = {"rad": 1e-2, "m": 1e-3}  # [rad/s], [m/s] where stiction ends; A


@dataclass(frozen=True)
class Tolerances:
    """Half-widths of the uniform distributions that the plant's parameters come from.

    What is zero in the model, by symmetry or by the choice of a frame, stays zero. The defaults
    are those of a 3D-printed rig of 0.4 m; A.

    Attributes:
        mass: Of every body's mass, relative.
        inertia: Of every body's tensor about its centre of mass over its mass, relative: one
            factor per body, so that the tensor stays that of a possible body.
        com: Of the coordinates of centres of mass [m].
        pins: Of the coordinates of joints and frames on their links [m], those along the plane
            of the revolute loops, which could not close otherwise.
        friction: Of every coefficient of friction, relative.
        stiction: By how much friction at rest exceeds the plant's Coulomb friction, relative to
            it; not drawn.
    """

    mass: float = 0.05
    inertia: float = 0.10
    com: float = 1e-3
    pins: float = 1e-4
    friction: float = 0.20
    stiction: float = 0.20

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= as_number(value, f"the tolerance '{name}'", "") < 1:
                raise InputError(f"the tolerance '{name}' is {value:g}, give 0 or more, below 1")


def drawn(
    machine: Machine, tolerances: Tolerances, random: np.random.Generator
) -> dict[str, float]:
    """Changes that make a plant of a machine, by the names of `crane.description.parameters`."""
    spec = read_machine_spec(machine.load_name)
    printed = parameters(spec)
    nominal = {**printed, **machine.parameter_changes}
    changes = dict(machine.parameter_changes)

    def move(name: str, by: float) -> None:
        if nominal.get(name):  # no number of a file: where a chain is attached
            changes[name] = nominal[name] + by * random.uniform(-1, 1)

    for link in spec.tree.links:
        if f"{link}.mass" not in nominal:
            continue
        mass = 1 + tolerances.mass * random.uniform(-1, 1)
        shape = 1 + tolerances.inertia * random.uniform(-1, 1)
        changes[f"{link}.mass"] = mass * nominal[f"{link}.mass"]
        for name in (name for name in nominal if name.startswith(f"{link}.inertia.")):
            changes[name] = mass * shape * nominal[name]
        for axis in "xyz":
            move(f"{link}.com.{axis}", tolerances.com)
    for link, axis in _pins(machine, spec):
        move(f"{link}.{axis}", tolerances.pins)
    for joint in machine.joints:
        friction = _stuck(machine, joint, tolerances, random)
        for field, value in vars(friction).items():
            changes[f"friction.{joint}.{field}"] = value
    return {name: value for name, value in changes.items() if value != printed[name]}


def _stuck(
    machine: Machine, joint: str, tolerances: Tolerances, random: np.random.Generator
) -> Friction:
    """Drawn friction of the plant at a joint, with stiction where there is Coulomb friction."""
    law = machine.friction.get(joint, Friction())
    coefficients = {
        name: getattr(law, name) * (1 + tolerances.friction * random.uniform(-1, 1))
        for name in ("coulomb", "coulomb_offset", "viscous", "viscous_offset")
    }
    law = dataclasses.replace(law, **coefficients)
    if not (tolerances.stiction and law.coulomb):
        return law
    stiction, stribeck = tolerances.stiction * law.coulomb, _STRIBECK[machine.unit(joint)]
    return dataclasses.replace(law, stiction=stiction, stribeck=stribeck)


def _pins(machine: Machine, spec: MachineSpec) -> list[tuple[str, str]]:
    """Links and axes along which their joints' places on the parents may be off.

    Loops of a plane close only if the pins stay in it; a machine of other loops, or of loops in
    several planes, keeps its pins.
    """
    data = machine.model.createData()
    pin.framesForwardKinematics(machine.model, data, machine.home)
    loops = machine.closure.equations.loops
    normals = [data.oMf[machine.frame(loop.predecessor)].rotation @ loop.axis for loop in loops]
    if any(loop.type != "revolute" for loop in loops) or any(
        np.linalg.norm(np.cross(normal, normals[0])) > 1e-9 for normal in normals
    ):
        return []
    out = []
    for joint in spec.tree.joints.values():
        turn = data.oMf[machine.frame(joint.parent)].rotation
        across = turn.T @ normals[0] if normals else np.zeros(3)
        along = [axis for axis, part in zip("xyz", across, strict=True) if abs(part) < 1e-9]
        out += [(joint.child, axis) for axis in along]
    return out
