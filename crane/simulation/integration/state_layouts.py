"""What a simulation integrates and what it observes, part by part."""

from crane.codegen import Layout
from crane.control import Controller, ValveDrive
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics.external_forces import state_count
from crane.dynamics.joint_forces import find_stick_slip_columns
from crane.machine import Machine


def state_layout(machine: Machine, controller_state_count: int) -> Layout:
    """What is integrated: q (nv), v_a (n), shear, the controller's own, work, lost [J].

    Shear are the states of forces from outside: how far tyres have given way along the ground.
    Work is that of the active forces, then of each force from outside.
    """
    n, work_count = len(machine.active), 1 + len(machine.external_forces)
    contact_state_count = state_count(machine.external_forces)
    return Layout(
        q=machine.model.nv,
        v_a=n,
        shear=contact_state_count,
        own=controller_state_count,
        work=work_count,
        lost=1,
    )


def output_layout(machine: Machine, control: Controller) -> Layout:
    """What is observed.

    tau (n), friction (n), kinetic, potential [J], friction of joints at rest that stick, wrench
    and channels of each force from outside, accelerations of all joints where the machine has
    supports to carry what they take, channels of circuits.
    """
    n, rest = len(machine.active), len(find_stick_slip_columns(machine))
    channels = len(control.channels) if isinstance(control, ValveDrive) else 0
    external_force_outputs = sum(
        len(WRENCH_COMPONENTS) + len(force.channels) for force in machine.external_forces
    )
    return Layout(
        tau=n, friction=n, kinetic=1, potential=1, rest=rest, outside=external_force_outputs,
        a=machine.model.nv if machine.supports else 0, channels=channels,
    )  # fmt: skip


def row_layout(machine: Machine, control: Controller, controller_state_count: int) -> Layout:
    """Both, as they are recorded at an instant."""
    return Layout(
        **state_layout(machine, controller_state_count).parts,
        **output_layout(machine, control).parts,
    )
