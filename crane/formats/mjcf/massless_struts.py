"""Struts and slider-cranks without mass in a machine, which MJCF has as tendons and actuators."""

from dataclasses import dataclass

import numpy as np

from crane.description.specification import LoopSpec
from crane.machine.machine import Machine

_KINDS = {  # kinds of the three joints, from the base on, and whether they are of a slider-crank
    ("revolute", "revolute", "prismatic"): False,
    ("prismatic", "revolute", "revolute"): True,
}


@dataclass(frozen=True)
class MasslessStrut:
    """Three joints in series without mass that a spherical loop closes.

    Attributes:
        joint: Name of its prismatic joint.
        joints: Pinocchio's indices of its joints.
        base: Link that carries it, whose frame is that of its first joint.
        loop: The loop.
        rod_length: Length of the rod of a slider-crank [m]; 0 of a strut of variable length.
    """

    joint: str
    joints: tuple[int, ...]
    base: str
    loop: LoopSpec
    rod_length: float


def find_massless_struts(machine: Machine) -> dict[str, MasslessStrut]:
    """Return the struts and slider-cranks of a machine by their prismatic joints.

    They are as `crane.formats.mjcf.actuator_cylinders` makes them: the axes of their revolute
    joints meet on the line of the prismatic joint, and nothing else hangs on them.
    """
    found = (_strut_of_loop(machine, loop) for loop in machine.closure.equations.loops)
    return {strut.joint: strut for strut in found if strut is not None}


def _strut_of_loop(machine: Machine, loop: LoopSpec) -> MasslessStrut | None:
    model, tree = machine.model, machine.tree
    frame = model.frames[machine.frame(loop.predecessor)]
    joints: list[int] = [int(frame.parentJoint)]
    while joints[0] and len(joints) < 3:
        joints.insert(0, int(model.parents[joints[0]]))
    parts = [tree.joints[model.names[i]] for i in joints if model.names[i] in tree.joints]
    kinds = tuple(part.kind for part in parts)
    if loop.type != "spherical" or kinds not in _KINDS:
        return None
    is_crank = _KINDS[kinds]
    other_children = [i for i in range(1, model.njoints)
                      if model.parents[i] in joints and i not in joints]  # fmt: skip
    has_mass = any(model.inertias[i].mass for i in joints)
    rod = np.array(frame.placement.translation)
    is_apart = any(model.jointPlacements[i].translation.any() for i in joints[1:])
    first = parts[0]
    is_turned = is_crank and (any(first.rpy) or tuple(first.axis) != (0.0, 0.0, 1.0))
    if other_children or has_mass or is_apart or is_turned or any(first.xyz):
        return None
    if rod.any() != is_crank:
        return None
    return MasslessStrut(
        parts[0 if is_crank else 2].name,
        tuple(joints),
        first.parent,
        loop,
        float(np.linalg.norm(rod)),
    )
