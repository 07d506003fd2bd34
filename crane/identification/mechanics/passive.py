"""Passive forces whose size is estimated: gas springs, and forces of a known shape."""

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import Array
from crane.dynamics.joint_forces import JointForces
from crane.identification.mechanics.friction import Shape
from crane.identification.mechanics.term import Direction, Samples, direction_of
from crane.machine import Machine


class GasScale:
    """A factor on the force of a gas spring, whose nominal value is 1.

    Args:
        machine: The machine.
        joint: That the gas spring acts on, or its own name.
    """

    names: tuple[str, ...]
    signs: tuple[bool, ...]

    def __init__(self, machine: Machine, joint: str):
        springs = [spring for spring in machine.gas_springs if spring.joint == joint]
        if not springs:
            names = [spring.joint for spring in machine.gas_springs]
            raise InputError(f"joint '{joint}' has no gas spring, {known(names, joint)}")
        self._forces = JointForces(machine.replace(gas_springs=tuple(springs)))
        self.names, self.nominal, self.signs = (f"{joint}.gas_scale",), np.ones(1), (True,)

    def columns(self, at: Samples) -> Array:
        """See `Term`."""
        return -np.einsum("kij,ki->kj", at.gamma, self._forces.gas(at.q))[:, :, None]


class SpringForce:
    """A passive force of known shape along a joint or distance times an unknown factor.

    Args:
        machine: The machine.
        direction: A joint's name, active or passive, or a combination or distance.
        shape: Coordinate (N,) [m], [rad] -> force in the positive direction per factor.
        name: Of the factor.
        nominal: Its value.
    """

    names: tuple[str, ...]
    signs: tuple[bool, ...]

    def __init__(
        self,
        machine: Machine,
        direction: str | Direction,
        shape: Shape,
        name: str,
        nominal: float = 0.0,
    ):
        self._machine, self._shape = machine, shape
        self._direction = direction_of(machine, direction)
        self.names, self.nominal = (f"{self._direction.name}.{name}",), np.array([nominal])
        self.signs = (False,)

    def columns(self, at: Samples) -> Array:
        """See `Term`."""
        force = self._shape(self._direction.coordinate(self._machine, at))
        return -(self._direction.rows(self._machine, at) * force[:, None])[:, :, None]
