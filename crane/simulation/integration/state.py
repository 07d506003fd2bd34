"""What a simulation integrates and what it observes, part by part."""

from crane.codegen import Layout
from crane.control import Controller, ValveDrive
from crane.description.external import PARTS
from crane.dynamics.external import states_of
from crane.dynamics.joint_forces import sticking
from crane.machine import Machine


def state_layout(machine: Machine, own: int) -> Layout:
    """What is integrated: q (nv), v_a (n), shear, the controller's own, work, lost [J].

    Shear are the states of forces from outside: how far tyres have given way along the ground.
    Work is that of the active forces, then of each force from outside.
    """
    n, works = len(machine.active), 1 + len(machine.external)
    shear = states_of(machine.external)
    return Layout(q=machine.model.nv, v_a=n, shear=shear, own=own, work=works, lost=1)


def seen_layout(machine: Machine, control: Controller) -> Layout:
    """What is observed.

    tau (n), friction (n), kinetic, potential [J], friction of joints at rest that stick, wrench
    and channels of each force from outside, accelerations of all joints where the machine has
    supports to carry what they take, channels of circuits.
    """
    n, rest = len(machine.active), len(sticking(machine))
    channels = len(control.channels) if isinstance(control, ValveDrive) else 0
    outside = sum(len(PARTS) + len(force.channels) for force in machine.external)
    return Layout(
        tau=n, friction=n, kinetic=1, potential=1, rest=rest, outside=outside,
        a=machine.model.nv if machine.supports else 0, channels=channels,
    )  # fmt: skip


def row_layout(machine: Machine, control: Controller, own: int) -> Layout:
    """Both, as they are recorded at an instant."""
    return Layout(**state_layout(machine, own).parts, **seen_layout(machine, control).parts)
