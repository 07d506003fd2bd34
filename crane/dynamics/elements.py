"""Forces along single joints: friction, springs, dampers, constant forces, end stops."""

import numpy as np

from crane.machine import Machine
from crane.samples import Array


class JointForces:
    """Friction and passive forces of all joints of a machine, in tree coordinates.

    Args:
        machine: The machine whose `friction`, `forces` and `end_stops` act.
    """

    def __init__(self, machine: Machine):
        size = machine.model.nv
        self._coulomb, self._coulomb_offset = np.zeros(size), np.zeros(size)
        self._viscous, self._viscous_offset = np.zeros(size), np.zeros(size)
        self._smoothing = np.ones(size)
        for joint, friction in machine.friction.items():
            i = machine.column(joint)
            self._coulomb[i], self._coulomb_offset[i] = friction.coulomb, friction.coulomb_offset
            self._viscous[i], self._viscous_offset[i] = friction.viscous, friction.viscous_offset
            self._smoothing[i] = friction.smoothing
        self._jump = self._smoothing == 0
        self._smoothing[self._jump] = 1.0
        # springs of one joint add up: k (q - rest) summed is K q - sum(k rest)
        self._stiffness, self._damping = np.zeros(size), np.zeros(size)
        self._constant, self._slack_energy = np.zeros(size), 0.0
        for element in machine.forces:
            i = machine.column(element.joint)
            self._stiffness[i] += element.stiffness
            self._damping[i] += element.damping
            self._constant[i] += element.force + element.stiffness * element.rest
            self._slack_energy += 0.5 * element.stiffness * element.rest**2
        stops = [(machine.column(stop.joint), stop) for stop in machine.end_stops]
        self._stopped = np.array([i for i, _ in stops], dtype=np.intp)
        self._stop_stiffness = np.array([stop.stiffness for _, stop in stops])
        self._stop_damping = np.array([stop.damping for _, stop in stops])
        self._lower = machine.model.lowerPositionLimit[self._stopped]
        self._upper = machine.model.upperPositionLimit[self._stopped]

    def friction(self, v: Array) -> Array:
        """Drive force that friction consumes at every joint.

        tau_F = F_C s + D_C + F_V v + D_V v s with s = tanh(v / smoothing): equation (5) of the
        reduced-scale forwarder paper with the sign that brakes.

        Args:
            v: (nv,) [m/s], [rad/s].

        Returns:
            (nv,) [N], [N m].
        """
        sign = np.where(self._jump, np.sign(v), np.tanh(v / self._smoothing))
        return (
            self._coulomb * sign
            + self._coulomb_offset
            + (self._viscous + self._viscous_offset * sign) * v
        )

    def passive(self, q: Array, v: Array) -> Array:
        """Force of springs, dampers, constant forces and end stops on every joint.

        f = force - stiffness (q - rest) - damping v, and at end stops, d beyond the limit,
        f = -+ stiffness d max(0, 1 + damping d') (Hunt and Crossley, 1975).

        Args:
            q: (nq,) [m], [rad].
            v: (nv,) [m/s], [rad/s].

        Returns:
            (nv,) [N], [N m].
        """
        force = self._constant - self._stiffness * q - self._damping * v
        if len(self._stopped):
            at, speed = q[self._stopped], v[self._stopped]
            over, under = np.maximum(0.0, at - self._upper), np.maximum(0.0, self._lower - at)
            damping = self._stop_damping
            force[self._stopped] += self._stop_stiffness * (
                under * np.maximum(0.0, 1 - damping * speed)
                - over * np.maximum(0.0, 1 + damping * speed)
            )
        return force

    def potential(self, q: Array) -> float:
        """Energy stored in springs, constant forces and end stops [J].

        Args:
            q: (nq,) [m], [rad].
        """
        energy = 0.5 * self._stiffness @ q**2 - self._constant @ q + self._slack_energy
        if len(self._stopped):
            at = q[self._stopped]
            depth = np.maximum(0.0, np.maximum(at - self._upper, self._lower - at))
            energy += 0.5 * self._stop_stiffness @ depth**2
        return float(energy)
