"""What a reader does to a machine beside its levers: the tip is pulled, targets are moved."""

from typing import Any

import numpy as np

from crane.common.errors import CraneError
from crane.control.valve_drive import ValveDrive
from crane.dynamics.dynamics import Dynamics
from crane.export.instance_program import InstanceProgram
from crane.motion.kinematics import Kinematics

_PULL_FREQUENCY = 3.0  # of the mass that is felt at the tip, on the spring [Hz]
_PULL_DAMPING = 0.5  # ratio
_LARGEST_PULL = 0.3  # of the weight of all moving bodies
_GRAVITY = 9.81  # [m/s2], where weights are compared
_CROSSING_TIME = 4.0  # in which a target of an unknown velocity crosses its range [s]
_LARGEST_RANGE = 2.0 * np.pi  # [rad], of a joint without limits


def pull_data(program: InstanceProgram) -> dict[str, Any] | None:
    """Spring [N/m] and damper [N s/m] between tip and hand, and the largest force [N].

    None without a tip that moves.

    The mass m at the tip is felt in the mean over all directions, 1/m = tr(J M_A^-1 J^T) / 3.
    """
    machine = program.machine
    if machine.tip is None:
        return None
    home = machine.home[machine.closure.active]
    try:
        jacobian = Kinematics(machine).jacobian(home)
        mass = Dynamics(machine, backend="pinocchio").mass_matrix(home)
        inverse_mass = float(np.trace(jacobian @ np.linalg.pinv(mass) @ jacobian.T)) / 3.0
    except CraneError:  # at a dead centre, say
        return None
    if not inverse_mass > 0.0:
        return None
    speed = 2.0 * np.pi * _PULL_FREQUENCY
    weight = _GRAVITY * sum(x.mass for x in list(machine.model.inertias)[1:])
    return {
        "stiffness": speed**2 / inverse_mass,
        "damping": 2.0 * _PULL_DAMPING * speed / inverse_mass,
        "largest": _LARGEST_PULL * weight,
    }


def target_data(program: InstanceProgram) -> list[dict[str, Any]]:
    """Targets of a controller by driven joint; none where the inputs are forces or signals.

    Each has the elements of the instance that its coordinate, velocity and acceleration go to, its
    range, and its largest velocity.
    """
    machine, control, names = program.machine, program.control, program.names
    spools = {}
    if isinstance(control, ValveDrive):
        spools = {name: x.joint for name, x in control.circuit.hydraulics.spools.items()}
    limits = machine.model.velocityLimit
    found = []
    for joint in machine.driven_joints:
        inputs = [joint, *(name for name, x in spools.items() if x == joint and name != joint)]
        kinds = [f"reference_{kind}" for kind in ("", "velocity_", "acceleration_")]
        indices = [[names.index(kind + x) for x in inputs if kind + x in names] for kind in kinds]
        if not indices[0]:
            continue
        active, column = machine.active.index(joint), int(machine.column(joint))
        low, high = float(machine.lower[active]), float(machine.upper[active])
        span = high - low if np.isfinite(high - low) else _LARGEST_RANGE
        rate = float(limits[column]) if len(limits) == machine.model.nv else np.inf
        found.append({
            "name": joint, "joint": joint, "active": active, "column": column, "inputs": indices,
            "low": max(low, -1e9), "high": min(high, 1e9),
            "rate": min(span / _CROSSING_TIME, rate if rate > 0.0 else np.inf),
        })  # fmt: skip
    return found
