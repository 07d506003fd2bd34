"""The equations of motion in the active coordinates."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.dynamics.elements import JointForces
from crane.errors import InputError, known
from crane.machine import Machine
from crane.samples import Array, as_samples, per_sample, solve

FORMULATIONS = ("exact",)


class Motion(NamedTuple):
    """One closed posture in motion.

    Attributes:
        q: (nq,) posture.
        v_a: (n,) active velocities.
        gamma: (nv, n).
        v: (nv,) velocities gamma v_A.
        drift: (nv,) accelerations at a_A = 0.
    """

    q: Array
    v_a: Array
    gamma: Array
    v: Array
    drift: Array


class Dynamics:
    """Dynamics of a machine in its active coordinates, without multipliers.

    The tree's dynamics projected by gamma (Park, Choi, Ploen 1999), equations (4) and (6) of the
    reduced-scale forwarder paper:

        tau_A = gamma^T (rnea(q, v, a) - f(q, v)) [+ gamma^T tau_F(v)]
              = M_A(q_A) a_A + bias(q_A, v_A) [+ friction(q_A, v_A)],

    with f the passive forces and tau_F the friction of all joints. Friction is left out unless
    asked for; passive forces belong to the machine and are always in. Every method takes single
    samples (n,) or stacks (N, n) and returns the same kind. Not safe to share between threads.

    Args:
        machine: The machine; its payload and parameters are those at this moment.
        formulation: "exact".

    Raises:
        InputError: Unknown formulation.
    """

    def __init__(self, machine: Machine, formulation: str = "exact"):
        if formulation not in FORMULATIONS:
            raise InputError(
                f"formulation '{formulation}' is unknown, {known(FORMULATIONS, formulation)}"
            )
        self.machine = machine
        self.forces = JointForces(machine)
        self._model = machine.model
        self._data = machine.model.createData()
        self._closure = machine.closure

    @property
    def parameters(self) -> Array:
        """(10 nb,) inertial parameters of the bodies, in the order of the tree's joints.

        Ten per body about its joint frame's origin: m, m c_x, m c_y, m c_z, I_xx, I_xy, I_yy,
        I_xz, I_yz, I_zz [kg, kg m, kg m2].
        """
        return np.concatenate(
            [inertia.toDynamicParameters() for inertia in list(self._model.inertias)[1:]]
        )

    def inverse(
        self, q_a: ArrayLike, v_a: ArrayLike, a_a: ArrayLike, friction: bool = False
    ) -> Array:
        """Active forces of a motion: tau_A = gamma^T (rnea(q, v, a) - f) [+ friction].

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            a_a: The same shape [m/s2], [rad/s2].
            friction: Whether the drives also overcome friction.

        Returns:
            tau_A, (n,) or (N, n) [N], [N m].
        """

        def one(q: Array, v_a: Array, a_a: Array) -> Array:
            motion = self.motion(q, v_a)
            return motion.gamma.T @ self._tree_force(
                motion, motion.gamma @ a_a + motion.drift, friction
            )

        return per_sample(one, *self._arguments(q_a, v_a=v_a, a_a=a_a))

    def forward(
        self, q_a: ArrayLike, v_a: ArrayLike, tau_a: ArrayLike, friction: bool = False
    ) -> Array:
        """Accelerations under active forces: M_A a_A = tau_A - bias [- friction].

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            tau_a: The same shape [N], [N m].
            friction: Whether friction brakes.

        Returns:
            a_A, (n,) or (N, n) [m/s2], [rad/s2].
        """

        def one(q: Array, v_a: Array, tau_a: Array) -> Array:
            return self.accelerate(self.motion(q, v_a), tau_a, friction)

        return per_sample(one, *self._arguments(q_a, v_a=v_a, tau_a=tau_a))

    def motion(self, q: Array, v_a: Array) -> Motion:
        """What gamma makes of active velocities.

        Args:
            q: (nq,) closed posture.
            v_a: (n,) [m/s], [rad/s].
        """
        gamma, v, drift = self._closure.motion(q, v_a)
        return Motion(q, v_a, gamma, v, drift)

    def accelerate(self, motion: Motion, tau_a: Array, friction: bool = False) -> Array:
        """`forward` of one sample whose posture is closed already.

        Args:
            motion: Posture and velocities.
            tau_a: (n,) [N], [N m].
            friction: Whether friction brakes.

        Returns:
            a_A (n,) [m/s2], [rad/s2].
        """
        bias = motion.gamma.T @ self._tree_force(motion, motion.drift, friction)
        mass = self._mass(motion.q, motion.gamma)
        return solve(mass, tau_a - bias)

    def energy_at(self, q: Array, v: Array) -> tuple[float, float]:
        """`energy` of one posture (nq,) with velocities (nv,) of the tree."""
        kinetic = pin.computeKineticEnergy(self._model, self._data, q, v)
        weight = pin.computePotentialEnergy(self._model, self._data, q)
        return kinetic, weight + self.forces.potential(q)

    def dissipation(self, motion: Motion) -> float:
        """Power that friction, dampers and end stops take out [W]."""
        velocity = motion.v
        conservative = self.forces.passive(motion.q, np.zeros_like(velocity))
        braking = conservative - self.forces.passive(motion.q, velocity)
        return float(velocity @ (self.forces.friction(velocity) + braking))

    def mass_matrix(self, q_a: ArrayLike) -> Array:
        """M_A = gamma^T M gamma.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (n, n) or (N, n, n) [kg], [kg m], [kg m2].
        """
        return per_sample(lambda q: self._mass(q, self._closure.gamma(q)), *self._arguments(q_a))

    def bias(self, q_a: ArrayLike, v_a: ArrayLike) -> Array:
        """Active forces at zero acceleration: gamma^T (rnea(q, v, drift) - f).

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].

        Returns:
            (n,) or (N, n) [N], [N m].
        """

        def one(q: Array, v_a: Array) -> Array:
            motion = self.motion(q, v_a)
            return motion.gamma.T @ self._tree_force(motion, motion.drift, False)

        return per_sample(one, *self._arguments(q_a, v_a=v_a))

    def gravity(self, q_a: ArrayLike) -> Array:
        """Active forces that hold the weight alone: gamma^T g(q), without passive forces.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (n,) or (N, n) [N], [N m].
        """

        def one(q: Array) -> Array:
            weight = pin.computeGeneralizedGravity(self._model, self._data, q)
            return self._closure.gamma(q).T @ weight

        return per_sample(one, *self._arguments(q_a))

    def friction(self, q_a: ArrayLike, v_a: ArrayLike) -> Array:
        """Active forces that friction of all joints consumes: gamma^T tau_F(gamma v_A).

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].

        Returns:
            (n,) or (N, n) [N], [N m].
        """

        def one(q: Array, v_a: Array) -> Array:
            gamma = self._closure.gamma(q)
            return gamma.T @ self.forces.friction(gamma @ v_a)

        return per_sample(one, *self._arguments(q_a, v_a=v_a))

    def passive(self, q_a: ArrayLike, v_a: ArrayLike) -> Array:
        """What passive forces do at the active joints: gamma^T f(q, gamma v_A).

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].

        Returns:
            (n,) or (N, n) [N], [N m].
        """

        def one(q: Array, v_a: Array) -> Array:
            gamma = self._closure.gamma(q)
            return gamma.T @ self.forces.passive(q, gamma @ v_a)

        return per_sample(one, *self._arguments(q_a, v_a=v_a))

    def energy(self, q_a: ArrayLike, v_a: ArrayLike) -> tuple[Array, Array]:
        """Kinetic and potential energy; the potential includes springs and constant forces.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].

        Returns:
            Two arrays, () or (N,) [J].
        """

        def one(q: Array, v_a: Array) -> Array:
            return np.array(self.energy_at(q, self._closure.gamma(q) @ v_a))

        both = per_sample(one, *self._arguments(q_a, v_a=v_a))
        return both[..., 0], both[..., 1]

    def regressor(self, q_a: ArrayLike, v_a: ArrayLike, a_a: ArrayLike) -> Array:
        """Y_A = gamma^T Y(q, v, a): inverse = Y_A parameters - passive.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            a_a: The same shape [m/s2], [rad/s2].

        Returns:
            (n, 10 nb) or (N, n, 10 nb), columns in the order of `parameters`.
        """

        def one(q: Array, v_a: Array, a_a: Array) -> Array:
            motion = self.motion(q, v_a)
            a = motion.gamma @ a_a + motion.drift
            tree = pin.computeJointTorqueRegressor(self._model, self._data, q, motion.v, a)
            return motion.gamma.T @ tree

        return per_sample(one, *self._arguments(q_a, v_a=v_a, a_a=a_a))

    def _arguments(self, q_a: ArrayLike, **others: ArrayLike) -> tuple[Array, ...]:
        """Checked samples, the active coordinates replaced by closed postures."""
        names = self.machine.active
        checked = [as_samples(other, len(names), what, names) for what, other in others.items()]
        return (self._closure.solve(q_a), *checked)

    def _tree_force(self, motion: Motion, a: Array, friction: bool) -> Array:
        """rnea(q, v, a) - f [+ tau_F] of the tree, (nv,)."""
        tau = pin.rnea(self._model, self._data, motion.q, motion.v, a)
        tau = tau - self.forces.passive(motion.q, motion.v)
        return tau + self.forces.friction(motion.v) if friction else tau

    def _mass(self, q: Array, gamma: Array) -> Array:
        upper = np.triu(pin.crba(self._model, self._data, q))
        mass = upper + np.triu(upper, 1).T
        out: Array = gamma.T @ mass @ gamma
        return out
