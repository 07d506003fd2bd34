"""Equations of motion by Pinocchio's algorithms on the spanning tree, projected by gamma."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from crane.common.errors import SingularMassMatrixError
from crane.common.samples import Array, solve_linear
from crane.common.threads import ThreadLocal
from crane.dynamics.frame_jacobians import frame_jacobian
from crane.dynamics.joint_forces import REST_VELOCITY, JointForces
from crane.machine.machine import Machine
from crane.machine.massless_motions import (
    MIN_INERTIA_SHARE,
    describe_massless_motion,
    hold_coordinates,
    is_definite,
)


class ClosedState(NamedTuple):
    """A closed configuration with velocities.

    Attributes:
        q: (nv,) configuration.
        gamma: (nv, n).
        v: (nv,) velocities gamma v_A.
        drift: (nv,) accelerations at a_A = 0.
    """

    q: Array
    gamma: Array
    v: Array
    drift: Array


class _Subtree:
    """Bodies that move together, on a base at rest.

    Args:
        tree: The machine's tree.
        bodies: Their indices, a parent before its children.

    Attributes:
        bodies: Their indices.
        velocity_columns: Columns of their joints in v.
        configuration_indices: Indices of their joints in Pinocchio's q.
        base_body: The body of the tree that they stand on.
        model: Model of these bodies; its gravity is set in the axes of the base.
        data: Its data.
    """

    def __init__(self, tree: pin.Model, bodies: Sequence[int]):
        self.bodies = np.array(bodies)
        joints = [tree.joints[body] for body in bodies]
        self.velocity_columns = np.concatenate(
            [np.arange(x.idx_v, x.idx_v + x.nv) for x in joints]
        )
        self.configuration_indices = np.concatenate(
            [np.arange(x.idx_q, x.idx_q + x.nq) for x in joints]
        )
        self.base_body = tree.parents[bodies[0]]
        self.model, place = pin.Model(), {self.base_body: 0}
        for body in bodies:
            place[body] = self.model.addJoint(
                place[tree.parents[body]],
                tree.joints[body],
                tree.jointPlacements[body],
                tree.names[body],
            )
            self.model.appendBodyToJoint(place[body], tree.inertias[body], pin.SE3.Identity())
        self.data = self.model.createData()


class PinocchioDynamics:
    """Quantities of `QUANTITIES` at a closed configuration, by Pinocchio's algorithms.

    Args:
        machine: The machine.
        forces: Its friction and passive forces.
        motion_parents: See `crane.dynamics.formula_structure`.
    """

    def __init__(self, machine: Machine, forces: JointForces, motion_parents: Sequence[int]):
        # a copy, which later changes of the machine's model do not affect
        self._model = pin.Model(machine.model)
        # added here: Pinocchio's kinetic energy ignores the armature of some joints
        self._armature = np.array(self._model.armature)
        self._rotor_columns = np.flatnonzero(self._armature)
        self._closure, self._joint_forces = machine.closure, forces
        self._coordinates, self._carrier_bodies = machine.coordinates, motion_parents
        self._held, self._tree = machine.held, machine.tree
        self._least_inertias = machine.least_inertias
        self._tip = None if machine.tip is None else machine.frame(machine.tip)

    @cached_property
    def _workspace(self) -> ThreadLocal[tuple[pin.Data, list[_Subtree]]]:
        """Data of the tree, and the subtrees of bodies that carry each other, a parent first."""
        model, joints = self._model, [0, *self._coordinates.joints.tolist()]
        groups: dict[int, list[int]] = {}
        root_of = {0: 0}
        for body in range(1, model.njoints):
            carrier = joints[self._carrier_bodies[model.joints[body].idx_v + 1]]
            root_of[body] = root_of[carrier] or body
            groups.setdefault(root_of[body], []).append(body)
        return ThreadLocal(
            lambda: (model.createData(), [_Subtree(model, bodies) for bodies in groups.values()])
        )

    @property
    def inertial_parameters(self) -> Array:
        """See `Dynamics.parameters`."""
        bodies = [inertia.toDynamicParameters() for inertia in list(self._model.inertias)[1:]]
        return np.concatenate([*bodies, self._armature[self._rotor_columns]])

    def evaluate(self, quantity: str, q: Array, v_a: Array, x: Array) -> Array:
        """A quantity of one sample; see `QUANTITIES` for x.

        Args:
            quantity: Its name.
            q: (nq,) closed configuration.
            v_a: (n,).
            x: (n,).

        Returns:
            The result, flattened.
        """
        state = ClosedState(q, *self._closure.gamma_velocity_drift(q, v_a))
        gamma, v = state.gamma, state.v
        match quantity:
            case "inverse" | "inverse with friction":
                a = gamma @ x + state.drift
                friction = quantity.endswith("friction")
                return self._inverse_dynamics(state, a, friction) + gamma.T @ (
                    self._joint_forces.breakaway_forces(v, a) if friction else np.zeros_like(v)
                )
            case "forward" | "forward with friction":
                friction = quantity.endswith("friction")
                bias = self._inverse_dynamics(state, state.drift, friction)
                return self._solve_mass_matrix(state, x - bias)
            case "mass matrix":
                return self._mass_matrix(state).ravel()
            case "bias":
                return self._inverse_dynamics(state, state.drift, False)
            case "gravity":
                return gamma.T @ self._tree_inverse_dynamics(q, np.zeros_like(v), np.zeros_like(v))
            case "friction":
                return gamma.T @ self._joint_forces.friction_forces(v)
            case "passive":
                return gamma.T @ self._joint_forces.passive_forces(q, v)
            case "energy":
                return self._kinetic_and_potential_energy(state)
            case "rates":
                a_a, _, margin, _ = self._accelerations_with_stick_slip(state, x)
                forces = self._joint_forces
                # of dampers and end stops
                braking = forces.passive_forces(q, np.zeros_like(v)) - forces.passive_forces(q, v)
                dissipated_power = v @ (forces.friction_forces(v, use_modes=True) + braking)
                rates = self._coordinates.coordinate_derivatives(q, v)
                return np.concatenate([rates, a_a, [dissipated_power, margin]])
            case "observation":
                _, joint_friction, _, holding_forces = self._accelerations_with_stick_slip(
                    state, x
                )
                stick_slip, (slip_sign, is_held, inverse_velocity) = (
                    list(self._joint_forces.stick_slip_columns),
                    self._joint_forces.stick_slip_modes,
                )
                is_at_rest = (np.abs(slip_sign) < 1) | (
                    is_held.any() & (np.abs(v[stick_slip]) * inverse_velocity < REST_VELOCITY)
                )
                friction_at_rest = np.where(
                    is_at_rest,
                    self._joint_forces.friction_at_rest(slip_sign) + holding_forces,
                    0.0,
                )
                return np.concatenate(
                    [
                        gamma.T @ joint_friction,
                        self._kinetic_and_potential_energy(state),
                        friction_at_rest,
                    ]
                )
            case "resting":
                stick_slip = list(self._joint_forces.stick_slip_columns)
                joint_friction = gamma.T @ self._joint_forces.friction_forces(v, use_modes=True)
                net = x - self._inverse_dynamics(state, state.drift, False) - joint_friction
                mass = hold_coordinates(self._mass_matrix(state), self._held)
                net[list(self._held)] = 0.0
                parts = mass, gamma[stick_slip], state.drift[stick_slip], net
                return np.concatenate([np.ravel(part) for part in parts])
            case "statics":
                return self._static_quantities(state)
            case "regressor":
                return (gamma.T @ self._tree_regressor(q, v, gamma @ x + state.drift)).ravel()
        raise AssertionError(quantity)

    def _static_quantities(self, state: ClosedState) -> Array:
        """See `DynamicsFormulas.static_quantities`."""
        q, gamma = state.q, state.gamma
        model, (data, _) = self._model, self._workspace.value
        jacobian = pin.jacobianCenterOfMass(model, data, self._coordinates.configuration(q), False)
        still, moving = model.inertias[0], data.mass[0]
        out = [
            moving * data.com[0] + still.mass * still.lever,
            moving * jacobian @ gamma,
            [moving + still.mass],
        ]
        out.append(gamma.T @ self._joint_forces.passive_forces(q, state.v))
        if self._tip is not None:
            pin.computeJointJacobians(model, data, self._coordinates.configuration(q))
            out.append(pin.updateFramePlacement(model, data, self._tip).translation)
            out.append(frame_jacobian(model, data, self._tip)[:3] @ gamma)
        return np.concatenate([np.ravel(part) for part in out])

    def _accelerations_with_stick_slip(
        self, state: ClosedState, tau_a: Array
    ) -> tuple[Array, Array, float, Array]:
        """a_A, friction of all joints, transition margin, forces of held joints.

        See `DynamicsFormulas.accelerations_with_stick_slip`.
        """
        forces, stick_slip = self._joint_forces, list(self._joint_forces.stick_slip_columns)
        slip_sign, is_held, inverse_velocity = forces.stick_slip_modes
        joint_friction = forces.friction_forces(state.v, use_modes=True)
        bias = self._inverse_dynamics(state, state.drift, False) + state.gamma.T @ joint_friction
        a_a = self._solve_mass_matrix(state, tau_a - bias)
        margins, holding_forces = (
            slip_sign * state.v[stick_slip] * inverse_velocity,
            np.zeros(len(stick_slip)),
        )
        held_indices = np.flatnonzero(is_held)
        if len(held_indices):
            rows = state.gamma[stick_slip][held_indices]
            unit_accelerations = np.array([self._solve_mass_matrix(state, row) for row in rows])
            constraint_forces = np.linalg.solve(
                rows @ unit_accelerations.T, rows @ a_a + state.drift[stick_slip][held_indices]
            )
            a_a = (a_a - constraint_forces @ unit_accelerations) * forces.moving_factor
            holding_forces[held_indices] = constraint_forces
            joint_friction[stick_slip] += holding_forces
            margins[held_indices] = (
                1.0 - np.abs(constraint_forces) / forces.breakaway[held_indices]
            )
        return a_a, joint_friction, float(min([1.0, *margins])), holding_forces

    def _solve_mass_matrix(self, state: ClosedState, forces: Array) -> Array:
        """M_A^-1 of net forces; held coordinates do not accelerate.

        Raises:
            MechanismError: M_A is singular.
        """
        mass = hold_coordinates(self._mass_matrix(state), self._held)
        error = self._singularity_error(state, mass)
        if error is not None:
            raise error
        held = np.isin(np.arange(len(mass)), self._held)
        return solve_linear(mass, np.where(held, 0.0, forces))

    def singular_mass_error(
        self, q: Array, sample: str = "", margin: float = 1.0
    ) -> SingularMassMatrixError | None:
        """The error of forward dynamics at a closed configuration (nq,); None if M_A is regular.

        Args:
            q: (nq,).
            sample: Name of the sample in the error.
            margin: Factor on the inertia that counts as none.
        """
        zero = np.zeros(self._closure.degrees_of_freedom)
        state = ClosedState(q, *self._closure.gamma_velocity_drift(q, zero))
        mass = hold_coordinates(self._mass_matrix(state), self._held)
        return self._singularity_error(state, mass, sample, margin)

    def _singularity_error(
        self, state: ClosedState, mass: Array, sample: str = "", margin: float = 1.0
    ) -> SingularMassMatrixError | None:
        """The error where M_A, without held coordinates, is singular as in `LdltFactorization`."""
        active = self._closure.active
        least = margin * (self._least_inertias[active] + MIN_INERTIA_SHARE * np.diag(mass))
        moving = np.delete(np.arange(len(mass)), self._held)
        if is_definite(mass[np.ix_(moving, moving)], least[moving]):
            return None
        place = self._coordinates.format_values(active, state.q[active])
        motion = describe_massless_motion(
            self._model, self._closure, self._tree, state.q, state.gamma, mass
        )
        return SingularMassMatrixError(f"the mass matrix is singular at {place}{sample}, {motion}")

    def _kinetic_and_potential_energy(self, state: ClosedState) -> Array:
        configuration = self._coordinates.configuration(state.q)
        data, subtrees = self._workspace.value
        kinetic = 0.5 * float(self._armature @ state.v**2)
        for part in subtrees:
            at, v = configuration[part.configuration_indices], state.v[part.velocity_columns]
            kinetic += pin.computeKineticEnergy(part.model, part.data, at, v)
        return np.array(
            [
                kinetic,
                pin.computePotentialEnergy(self._model, data, configuration)
                + self._joint_forces.potential_energy(state.q),
            ]
        )

    def _inverse_dynamics(self, state: ClosedState, a: Array, friction: bool) -> Array:
        """gamma^T (rnea(q, v, a) - f [+ tau_F])."""
        tau = self._tree_inverse_dynamics(state.q, state.v, a) - self._joint_forces.passive_forces(
            state.q, state.v
        )
        if friction:
            tau += self._joint_forces.friction_forces(state.v)
        return np.asarray(state.gamma.T @ tau)

    def _mass_matrix(self, state: ClosedState) -> Array:
        configuration = self._coordinates.configuration(state.q)
        total = state.gamma.T @ (self._armature[:, None] * state.gamma)
        for part in self._workspace.value[1]:
            upper = np.triu(
                pin.crba(part.model, part.data, configuration[part.configuration_indices])
            )
            gamma = state.gamma[part.velocity_columns]
            total += gamma.T @ (upper + np.triu(upper, 1).T) @ gamma
        return total

    def _tree_inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Forces along the joints (nv,), by subtree."""
        tau = np.empty_like(v)
        for part, at in self._subtree_configurations(q):
            c = part.velocity_columns
            tau[c] = pin.rnea(part.model, part.data, at, v[c], a[c])
        return tau + self._armature * a

    def _tree_regressor(self, q: Array, v: Array, a: Array) -> Array:
        """Regressor of the tree (nv, 10 nb + nr), by subtree; one column per rotor."""
        size = 10 * (self._model.njoints - 1)
        out = np.zeros((len(v), size + len(self._rotor_columns)))
        out[self._rotor_columns, size + np.arange(len(self._rotor_columns))] = a[
            self._rotor_columns
        ]
        for part, at in self._subtree_configurations(q):
            c = part.velocity_columns
            block = pin.computeJointTorqueRegressor(part.model, part.data, at, v[c], a[c])
            out[np.ix_(c, (10 * (part.bodies[:, None] - 1) + np.arange(10)).ravel())] = block
        return out

    def _subtree_configurations(self, q: Array) -> Iterator[tuple[_Subtree, Array]]:
        """The subtrees and their configurations, with gravity in the axes of their bases."""
        configuration, (data, subtrees) = self._coordinates.configuration(q), self._workspace.value
        pin.forwardKinematics(self._model, data, configuration)
        for part in subtrees:
            part.model.gravity.linear = (
                data.oMi[part.base_body].rotation.T @ self._model.gravity.linear
            )
            yield part, configuration[part.configuration_indices]
