"""Passive forces whose size is estimated: gas springs, and forces of a known shape."""

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array
from crane.dynamics.joint_forces import JointForces
from crane.identification.mechanics.friction_terms import ForceShape
from crane.identification.mechanics.model_term import (
    ForceDirection,
    MotionSamples,
    resolve_direction,
)
from crane.machine import Machine


class GasSpringTerm:
    """A factor on the force of a gas spring, whose nominal value is 1.

    Args:
        machine: The machine.
        joint: That the gas spring acts on, or its own name.
    """

    names: tuple[str, ...]
    nonnegative: tuple[bool, ...]

    def __init__(self, machine: Machine, joint: str):
        springs = [spring for spring in machine.gas_springs if spring.joint == joint]
        if not springs:
            names = [spring.joint for spring in machine.gas_springs]
            raise InputError(f"joint '{joint}' has no gas spring, {suggest_names(names, joint)}")
        self._joint_forces = JointForces(machine.replace(gas_springs=tuple(springs)))
        self.names, self.nominal, self.nonnegative = (f"{joint}.gas_scale",), np.ones(1), (True,)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        return -np.einsum("kij,ki->kj", samples.gamma, self._joint_forces.gas_forces(samples.q))[
            :, :, None
        ]


class ForceElementTerm:
    """A passive force of known shape along a joint or distance times an unknown factor.

    Args:
        machine: The machine.
        direction: A joint's name, active or passive, or a combination or distance.
        shape: Coordinate (N,) [m], [rad] -> force in the positive direction per factor.
        name: Of the factor.
        nominal: Its value.
    """

    names: tuple[str, ...]
    nonnegative: tuple[bool, ...]

    def __init__(
        self,
        machine: Machine,
        direction: str | ForceDirection,
        shape: ForceShape,
        name: str,
        nominal: float = 0.0,
    ):
        self._machine, self._shape = machine, shape
        self._direction = resolve_direction(machine, direction)
        self.names, self.nominal = (f"{self._direction.name}.{name}",), np.array([nominal])
        self.nonnegative = (False,)

    def columns(self, samples: MotionSamples) -> Array:
        """See `ModelTerm`."""
        force = self._shape(self._direction.coordinate(self._machine, samples))
        return -(self._direction.jacobian(self._machine, samples) * force[:, None])[:, :, None]
