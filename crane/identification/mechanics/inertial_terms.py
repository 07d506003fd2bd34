"""Bodies and rotors: what forces have to accelerate and to carry."""

import numpy as np

from crane.common.samples import Array
from crane.dynamics import Dynamics
from crane.identification.mechanics.model_term import (
    ForceDirection,
    MotionSamples,
    resolve_direction,
)
from crane.machine import Machine

BODY_PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


class InertialTerm:
    """Ten parameters per body about its joint frame's origin, Y_A = gamma^T Y(q, v, a)."""

    def __init__(self, machine: Machine):
        self._dynamics = Dynamics(machine)
        bodies = body_names(machine)
        self.nominal = self._dynamics.parameters[: 10 * len(bodies)]
        self.names = tuple(f"{body}.{key}" for body in bodies for key in BODY_PARAMETERS)
        self.nonnegative = (False,) * len(self.names)  # that a body is possible is more than signs

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        return inertial_regressor(self._dynamics, samples)


def inertial_regressor(dynamics: Dynamics, samples: MotionSamples) -> Array:
    """The bodies' part of `Dynamics.regressor`, (N, n, 10 nb), along a closed motion."""
    found = dynamics.evaluate_closed("regressor", samples.q, samples.v_a, samples.a_a)
    return found.reshape(*samples.v_a.shape, -1)[:, :, : 10 * (dynamics.machine.model.njoints - 1)]


def body_names(machine: Machine) -> tuple[str, ...]:
    """The link that each joint moves, in the order of the joints."""
    model = machine.model
    names = []
    for joint in range(1, model.njoints):
        frames = [f for f in model.frames if f.parentJoint == joint and f.type.name == "BODY"]
        names.append(frames[0].name)
    return tuple(names)


class RotorInertiaTerm:
    """Inertia that moves along a direction s, such as a rotor's behind its gear.

        tau_A = c s'' I,   c = ds/dq_A,   s'' = c^T a_A + dc^T/dt v_A.

    Its nominal value is the `rotor_inertia` of the machine.

    Args:
        machine: The machine.
        direction: A joint's name, active or passive, or a combination of active ones.
    """

    names: tuple[str, ...]
    nonnegative: tuple[bool, ...]

    def __init__(self, machine: Machine, direction: str | ForceDirection):
        self.direction = direction = resolve_direction(machine, direction)
        self._machine = machine
        joint = machine.tree.joints.get(direction.name)
        nominal = 0.0 if joint is None else joint.rotor_inertia
        self.names, self.nominal = (f"{direction.name}.rotor_inertia",), np.array([nominal])
        self.nonnegative = (True,)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        rows = self.direction.jacobian(self._machine, samples)
        rate = np.einsum("ij,ij->i", rows, samples.a_a)
        if self.direction.name not in self._machine.active and not self.direction.factors:
            v = np.einsum("kij,kj->ki", samples.gamma, samples.v_a)
            drift = self._machine.closure.drift(samples.q, v)
            rate = rate + drift[:, self._machine.column(self.direction.name)]
        return (rows * rate[:, None])[:, :, None]
