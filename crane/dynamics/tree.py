"""Equations of motion by Pinocchio's algorithms on the spanning tree, projected by gamma."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from crane.dynamics.elements import JointForces
from crane.machine import Machine
from crane.samples import Array, solve


class Motion(NamedTuple):
    """One closed posture in motion.

    Attributes:
        q: (nq,) posture.
        gamma: (nv, n).
        v: (nv,) velocities gamma v_A.
        drift: (nv,) accelerations at a_A = 0.
    """

    q: Array
    gamma: Array
    v: Array
    drift: Array


class TreeDynamics:
    """Any quantity of `QUANTITIES` at a closed posture, with rnea, crba and the tree's regressor.

    Args:
        machine: The machine.
        forces: Its friction and passive forces.
    """

    def __init__(self, machine: Machine, forces: JointForces):
        # a copy, so that parameters stay those of this moment
        self._model = pin.Model(machine.model)
        self._data = self._model.createData()
        self._closure, self._forces = machine.closure, forces

    @property
    def parameters(self) -> Array:
        """See `Dynamics.parameters`."""
        inertias = list(self._model.inertias)[1:]
        return np.concatenate([inertia.toDynamicParameters() for inertia in inertias])

    def at(self, quantity: str, q: Array, v_a: Array, x: Array) -> Array:
        """A quantity of one sample; see `QUANTITIES` for x.

        Args:
            quantity: Its name.
            q: (nq,) closed posture.
            v_a: (n,).
            x: (n,).

        Returns:
            The result, flattened.
        """
        motion = Motion(q, *self._closure.motion(q, v_a))
        gamma, v = motion.gamma, motion.v
        match quantity:
            case "inverse" | "inverse with friction":
                a = gamma @ x + motion.drift
                return self._project(motion, a, quantity.endswith("friction"))
            case "forward" | "forward with friction":
                return self._forward(motion, x, quantity.endswith("friction"))
            case "mass matrix":
                return self._mass(motion).ravel()
            case "bias":
                return self._project(motion, motion.drift, False)
            case "gravity":
                weight = pin.computeGeneralizedGravity(self._model, self._data, q)
                return np.asarray(gamma.T @ weight)
            case "friction":
                return gamma.T @ self._forces.friction(v)
            case "passive":
                return gamma.T @ self._forces.passive(q, v)
            case "energy":
                return self._energy(motion)
            case "rates":
                a_a = self._forward(motion, x, True)
                return np.concatenate([v, a_a, [self._dissipation(motion)]])
            case "observation":
                return np.concatenate([gamma.T @ self._forces.friction(v), self._energy(motion)])
            case "regressor":
                a = gamma @ x + motion.drift
                tree = pin.computeJointTorqueRegressor(self._model, self._data, q, v, a)
                return np.asarray(gamma.T @ tree).ravel()
        raise AssertionError(quantity)

    def _forward(self, motion: Motion, tau_a: Array, friction: bool) -> Array:
        bias = self._project(motion, motion.drift, friction)
        return solve(self._mass(motion), tau_a - bias)

    def _energy(self, motion: Motion) -> Array:
        """Kinetic and potential."""
        kinetic = pin.computeKineticEnergy(self._model, self._data, motion.q, motion.v)
        weight = pin.computePotentialEnergy(self._model, self._data, motion.q)
        return np.array([kinetic, weight + self._forces.potential(motion.q)])

    def _dissipation(self, motion: Motion) -> float:
        """Power that friction, dampers and end stops take out."""
        conservative = self._forces.passive(motion.q, np.zeros_like(motion.v))
        braking = conservative - self._forces.passive(motion.q, motion.v)
        return float(motion.v @ (self._forces.friction(motion.v) + braking))

    def _project(self, motion: Motion, a: Array, friction: bool) -> Array:
        """gamma^T (rnea(q, v, a) - f [+ tau_F])."""
        tau = pin.rnea(self._model, self._data, motion.q, motion.v, a)
        tau = tau - self._forces.passive(motion.q, motion.v)
        if friction:
            tau += self._forces.friction(motion.v)
        return np.asarray(motion.gamma.T @ tau)

    def _mass(self, motion: Motion) -> Array:
        upper = np.triu(pin.crba(self._model, self._data, motion.q))
        mass = upper + np.triu(upper, 1).T
        return np.asarray(motion.gamma.T @ mass @ motion.gamma)
