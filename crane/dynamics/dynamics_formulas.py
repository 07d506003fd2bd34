"""Dynamics as symbolic formulas: one forward sweep over the bodies (Kane's equations).

`DynamicsFormulas.accelerations_with_stick_slip` computes accelerations with joints held by
stiction, and the margin whose sign change is a stick-slip transition. Which joints slip, rest or
are held is decided in `crane.simulation.integration.stick_slip_modes`.
"""

import itertools
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

from crane.closure.kinematics_formulas import (
    Vector,
)
from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    apply_function,
    cross,
    dot,
    matmul,
    matvec,
    minimum,
    scale_vector,
    subtract_vectors,
    transpose,
    where_positive,
)
from crane.codegen.symbolic_linear_algebra import LdltFactorization, Matrix
from crane.dynamics.cluster_recursion import (
    RecursionInput,
    joint_accelerations,
)
from crane.dynamics.inertial_force_formulas import InertialForceFormulas
from crane.dynamics.joint_force_formulas import breakaway_force, friction_sign
from crane.dynamics.joint_forces import REST_ACCELERATION, REST_VELOCITY, SLIP_INDEX

# degrees of freedom up to which factorizing M_A takes fewer operations than recursion
_MAX_MOBILITY_FACTORIZED = 7


@dataclass(frozen=True)
class StickSlipAccelerations:
    """Accelerations under forces with stick-slip friction.

    Attributes:
        a_a: (n,) accelerations.
        friction_at_rest: (k,) friction of the stick-slip joints at rest, 0 for those that slip.
        active_friction: gamma^T tau_F (n,).
        transition_margin: Smallest distance from a stick-slip transition: for a held joint the
            remaining fraction of its breakaway force, for a slipping joint its velocity divided by
            a velocity of the machine. Negative beyond a transition.
    """

    a_a: Vector
    friction_at_rest: Vector
    active_friction: Vector
    transition_margin: Scalar


class DynamicsFormulas(InertialForceFormulas):
    """Symbolic dynamics at a closed configuration.

    Args:
        kinematics: Position kinematics.
        loops: Loop formulas at that configuration.
        constants: See `dynamics_constants`.
        q: (nb,).
        v_a: (n,).
        formula_structure: What else the formulas depend on.
        use_modes: Whether stick-slip joints follow `JointForces.set_stick_slip_modes` instead of
            their velocities.
        drift: (nb + 1,), if it is known already.

    Attributes:
        kinematics: Position kinematics.
        loops: Loop formulas.
        q: (nb,).
        v_a: (n,).
        rotor_inertias: (nb + 1,) rotor inertias, 0 for the world.
        gamma: Rows of gamma by joint.
        joint_velocities: (nb + 1,) joint velocities, 0 for the world.
        drift: (nb + 1,) accelerations of the joints at a_A = 0.
        circuit_friction: (g,) circuit friction in the constants.
    """

    def with_circuit_friction(self, circuit_friction: Sequence[Scalar]) -> "DynamicsFormulas":
        """The same with the circuit friction (g,) added to the Coulomb friction of its joints."""
        if not self.formula_structure.circuit_friction_columns:
            return self
        out = copy(self)
        for name in (
            "_joint_law_values",
            "_passive_joint_forces",
        ):  # cached values that depend on friction
            out.__dict__.pop(name, None)
        out._joint_laws = list(self._joint_laws)
        for i, more in zip(
            self.formula_structure.circuit_friction_columns, circuit_friction, strict=True
        ):
            out._joint_laws[i] = [self._joint_laws[i][0] + more, *self._joint_laws[i][1:]]
        return out

    @property
    def static_quantities(self) -> list[Scalar]:
        """The values that statics depends on, see `crane.dynamics.statics.StaticsEvaluator`.

        First moment s = sum m c of all masses and ds/dq_A, mass, gamma^T f (at rest where v_A is
        0); tip and dtip/dq_A if there is one; in the world. With mass m_j and first moment s_j of
        all bodies beyond joint j,

            ds/dq_k = sum_j gamma_jk (m_j l_j + a_j x s_j),

        with l_j, a_j its column, linear at the reference origin and angular.
        """
        kinematics, parents = self.kinematics, self.kinematics.geometry.parents
        carried: list[tuple[Scalar, Vector]] = [(0.0, [0.0] * 3)]
        carried += [(mass, scale_vector(mass, centre)) for mass, centre, _ in self.body_inertias]
        for i in range(self._body_count - 1, 0, -1):
            mass, first_moment = carried[parents[i]]
            carried[parents[i]] = (mass + carried[i][0], add_vectors(first_moment, carried[i][1]))
        mass, first_moment = carried[0]
        first_moment = self._rotate_to_world(
            subtract_vectors(first_moment, scale_vector(mass, kinematics.origin[0]))
        )
        jacobian: list[Vector] = [[0.0] * 3 for _ in range(self._mobility)]
        for i in range(1, self._body_count):
            linear, angular = kinematics.joint_axes[i]
            derivative = add_vectors(
                scale_vector(carried[i][0], linear), cross(angular, carried[i][1])
            )
            jacobian = [
                add_vectors(x, scale_vector(f, derivative))
                for x, f in zip(jacobian, self.gamma[i], strict=True)
            ]
        out = [
            *add_vectors(first_moment, self._fixed_inertia[1:]),
            *itertools.chain(*zip(*map(self._rotate_to_world, jacobian), strict=True)),
        ]
        out += [mass + self._fixed_inertia[0], *self.passive_force]
        body = self.formula_structure.tip_body
        if body is None:
            return out
        point = add_vectors(
            kinematics.origin[body], matvec(kinematics.rotation[body], self._tip_point)
        )
        jacobian = [[0.0] * 3 for _ in range(self._mobility)]
        for i in sorted(kinematics.geometry.supporting_bodies(body)):
            linear, angular = kinematics.joint_axes[i]
            derivative = add_vectors(linear, cross(angular, point))
            jacobian = [
                add_vectors(x, scale_vector(f, derivative))
                for x, f in zip(jacobian, self.gamma[i], strict=True)
            ]
        out += self._rotate_to_world(subtract_vectors(point, kinematics.origin[0]))
        return [*out, *itertools.chain(*zip(*map(self._rotate_to_world, jacobian), strict=True))]

    def _rotate_to_world(self, vector: Vector) -> Vector:
        """A vector in the world's axes."""
        return matvec(transpose(self.kinematics.rotation[0]), vector)

    @property
    def active_motion_factors(self) -> Vector:
        """(n,) 0 for active joints that are held exactly at rest, else 1."""
        out: Vector = [self._moving_factor] * self._mobility
        is_held = {i: self._joint_laws[i][SLIP_INDEX + 1] for i in self._stick_slip_columns}
        for k, joint in enumerate(self.loops.active_joints):
            if joint - 1 in is_held:
                out[k] = self._moving_factor * (1.0 - is_held[joint - 1])
        return out

    @property
    def passive_force(self) -> Vector:
        """gamma^T f."""
        return self.project(self._passive_joint_forces)

    @property
    def friction_force(self) -> Vector:
        """gamma^T tau_F."""
        return self.project(self._joint_friction)

    def inverse_dynamics(self, a_a: Sequence[Scalar], friction: bool) -> Vector:
        """M_A a_A + bias - passive [+ friction]; friction at rest opposes the acceleration."""
        joint_velocities = [
            0.0,
            *(dot(row, a_a) + self.drift[i] for i, row in sorted(self.gamma.items())),
        ]
        joint_forces = subtract_vectors(
            self._inertial_joint_forces(joint_velocities),
            self.passive_and_friction_forces(friction),
        )
        for i in self._stick_slip_columns if friction else ():
            law, rate = self._joint_laws[i], joint_velocities[i + 1]
            sign = friction_sign(law, self.joint_velocities[i + 1], True, self._use_modes)
            negative_sign = where_positive(-REST_ACCELERATION - rate, -1.0, 0.0)
            breakaway = breakaway_force(law) * (
                where_positive(rate - REST_ACCELERATION, 1.0, negative_sign) - sign
            )
            joint_forces[i + 1] = joint_forces[i + 1] + where_positive(
                1.0 - apply_function("abs", sign), breakaway, 0.0
            )
        return self.project(joint_forces)

    def forward_dynamics(self, tau: Sequence[Scalar], friction: bool) -> Vector:
        """M_A^-1 (tau - bias + passive [- friction])."""
        if self.formula_structure.recursion_plan and self._mobility > _MAX_MOBILITY_FACTORIZED:
            return self._recursive_forward_dynamics(tau, friction)
        right = add_vectors(tau, self.project(self.passive_and_friction_forces(friction)))
        return self.factorize_mass_matrix().solve(subtract_vectors(right, self.inertial_bias))

    def factorize_mass_matrix(self, mass: Matrix | None = None) -> LdltFactorization:
        """Factorization of M_A without held coordinates; NaN where it is singular.

        Args:
            mass: M_A if it is known.
        """
        least = [self._least_inertias[joint] for joint in self.loops.active_joints]
        held = self.formula_structure.held
        return LdltFactorization(self.mass_matrix if mass is None else mass, least, held)

    def stick_slip_equations(self, tau: Sequence[Scalar]) -> Vector:
        """Inputs of the stiction problem: M_A (n^2), rows of gamma (k n), drift (k), net (n).

        The rows are those of the stick-slip joints; net is tau minus bias and friction. Held
        coordinates have the rows and columns of the unit matrix in M_A, and no net force.
        """
        rows = [entry for i in self._stick_slip_columns for entry in self.gamma[i + 1]]
        drift = [self.drift[i + 1] for i in self._stick_slip_columns]
        held, n = self.formula_structure.held, self._mobility
        masses = (
            float(i == k) if {i, k} & set(held) else self.mass_matrix[i][k]
            for i in range(n)
            for k in range(n)
        )
        net = [0.0 if i in held else x for i, x in enumerate(self._net_force(tau))]
        return [*masses, *rows, *drift, *net]

    def _net_force(self, tau: Sequence[Scalar]) -> Vector:
        """Active forces minus bias and friction."""
        return subtract_vectors(
            add_vectors(tau, self.project(self.passive_and_friction_forces(True))),
            self.inertial_bias,
        )

    @property
    def stick_slip_rows(self) -> list[tuple[Scalar, Vector]]:
        """For each stick-slip joint, whether it is held, and its row of gamma."""
        return [
            (self._joint_laws[i][SLIP_INDEX + 1], self.gamma[i + 1])
            for i in self._stick_slip_columns
        ]

    @property
    def breakaway_forces(self) -> Vector:
        """(k,) largest friction of the stick-slip joints at rest, relative to its offset."""
        return [breakaway_force(self._joint_laws[i]) for i in self._stick_slip_columns]

    def accelerations_with_stick_slip(
        self, tau: Sequence[Scalar], with_joints_at_rest: bool
    ) -> StickSlipAccelerations:
        """Accelerations under active forces, with joints held by stiction.

        Held joints do not accelerate, Gamma a_A + d = 0 with their rows Gamma of gamma and their
        drift d; r are the friction forces that this takes besides the friction offset:

            M_A a_A = f - Gamma^T r,    Gamma M_A^-1 Gamma^T r = Gamma M_A^-1 f + d.

        Args:
            tau: (n,).
            with_joints_at_rest: Whether any joint is at rest.
        """
        laws = [self._joint_laws[i] for i in self._stick_slip_columns]
        slip_signs, is_held, inverse_velocities = (
            [law[SLIP_INDEX + k] for law in laws] for k in range(3)
        )
        limits = self.breakaway_forces
        velocities = [self.joint_velocities[i + 1] for i in self._stick_slip_columns]
        slip_velocities = [
            s * v * p for s, v, p in zip(slip_signs, velocities, inverse_velocities, strict=True)
        ]
        if not with_joints_at_rest:
            return StickSlipAccelerations(
                self.forward_dynamics(tau, True),
                [0.0] * len(laws),
                self.friction_force,
                minimum(1.0, *slip_velocities),
            )
        rows = [self.gamma[i + 1] for i in self._stick_slip_columns]
        right = self._net_force(tau)
        mass = self.factorize_mass_matrix()
        holding_forces = self._holding_forces(mass, right, is_held)
        holding_active_forces: Vector = [0.0] * self._mobility
        for r, row in zip(holding_forces, rows, strict=True):
            holding_active_forces = add_vectors(holding_active_forces, scale_vector(r, row))
        a_a = mass.solve(subtract_vectors(right, holding_active_forces))
        a_a = [a * free for a, free in zip(a_a, self.active_motion_factors, strict=True)]
        remaining_limit = [
            1.0 - apply_function("abs", r) / limit
            for r, limit in zip(holding_forces, limits, strict=True)
        ]
        margins = [
            where_positive(w - 0.5, one, other)
            for w, one, other in zip(is_held, remaining_limit, slip_velocities, strict=True)
        ]
        any_held = 1.0 - minimum(1.0, *[1.0 - w for w in is_held])  # whether any is held
        # of held joints, or a share of the limit, or all of it besides held joints
        at_rest = [
            where_positive(
                1.0 - apply_function("abs", s),
                law[1] + limit * s + r,
                where_positive(
                    any_held * REST_VELOCITY - apply_function("abs", v) * p,
                    law[1] + limit * s,
                    0.0,
                ),
            )
            for s, law, limit, r, v, p in zip(
                slip_signs,
                laws,
                limits,
                holding_forces,
                velocities,
                inverse_velocities,
                strict=True,
            )
        ]
        return StickSlipAccelerations(
            a_a,
            at_rest,
            add_vectors(self.friction_force, holding_active_forces),
            minimum(1.0, *margins),
        )

    def _holding_forces(
        self, mass: LdltFactorization, net_force: Vector, is_held: Sequence[Scalar]
    ) -> Vector:
        """Friction forces r (k,) of held joints, 0 of the others."""
        columns = self._stick_slip_columns
        rows = [self.gamma[i + 1] for i in columns]
        half = [
            scale_vector(w, mass.forward_substitute(row))
            for w, row in zip(is_held, rows, strict=True)
        ]
        weighted = [
            [x * d for x, d in zip(row, mass.inverse_diagonal, strict=True)] for row in half
        ]
        half_right = mass.forward_substitute(net_force)
        matrix = [[dot(one, other) for other in half] for one in weighted]
        required: Vector = []
        for k, (i, w) in enumerate(zip(columns, is_held, strict=True)):
            matrix[k][k] = matrix[k][k] + (1.0 - w)
            required.append(dot(weighted[k], half_right) + w * self.drift[i + 1])
        return LdltFactorization(matrix).solve(required)

    def _recursive_forward_dynamics(self, tau: Sequence[Scalar], friction: bool) -> Vector:
        """Forward dynamics without M_A."""
        forces = list(self.passive_and_friction_forces(friction))
        for joint, force in zip(self.loops.active_joints, tau, strict=True):
            forces[joint] = forces[joint] + force
        projected_joints = {
            i
            for cluster, by_forces in self.formula_structure.recursion_plan
            if by_forces
            for i in cluster.joints
        }
        reference_accelerations = [
            0.0 if i in projected_joints else x for i, x in enumerate(self.drift)
        ]
        recursion = RecursionInput(
            self.kinematics,
            self.loops,
            self._tree_velocities,
            reference_accelerations,
            self._body_inertias,
            self.body_wrenches(reference_accelerations),
            self.rotor_inertias,
            forces,
            self._least_inertias,
            frozenset(self.loops.active_joints[k] for k in self.formula_structure.held),
        )
        rates = joint_accelerations(recursion, self.formula_structure.recursion_plan)
        return [rates[joint] for joint in self.loops.active_joints]

    def regressor(self, a_a: Sequence[Scalar]) -> list[Vector]:
        """Y_A (n, 10 nb + nr), columns in the order of `Dynamics.parameters`."""
        velocity, acceleration = (
            self._carrier_velocities.velocities,
            self._carrier_velocities.bias_accelerations,
        )
        out: list[Vector] = [[] for _ in range(self._mobility)]
        for i in sorted(
            set(range(1, self._body_count)) - self.kinematics.geometry.massless_bodies
        ):
            axes = matmul(
                self.kinematics.rotation[i], self.kinematics.geometry.body_rotations[i].T.tolist()
            )  # columns: axes of the joint
            local = list(zip(*axes, strict=True))  # rows: reference body to joint
            origin = self.kinematics.origin[i]
            v, w = velocity[i]
            a, e = acceleration[i]
            for k in range(self._mobility + 1):
                factor: Scalar = a_a[k] if k < self._mobility else 1.0
                a = add_vectors(a, scale_vector(factor, self._body_jacobians[i][k][0]))
                e = add_vectors(e, scale_vector(factor, self._body_jacobians[i][k][1]))
            at = add_vectors(a, cross(e, origin), cross(w, add_vectors(v, cross(w, origin))))
            w, e, at = matvec(local, w), matvec(local, e), matvec(local, at)
            for k in range(self._mobility):
                linear, angular = self._body_jacobians[i][k]
                out[k] += _body_regressor_row(
                    matvec(local, add_vectors(linear, cross(angular, origin))),
                    matvec(local, angular),
                    w,
                    e,
                    at,
                )
        for i, row in sorted(self.gamma.items()):
            if self.rotor_inertias[i] != 0.0:
                rate = dot(row, a_a) + self.drift[i]
                for k in range(self._mobility):
                    out[k].append(row[k] * rate)
        return out


def _body_regressor_row(u: Vector, r: Vector, w: Vector, e: Vector, a: Vector) -> Vector:
    """Ten entries u . f + r . t per unit of each inertial parameter, all in the body's frame."""
    # mass times COM: f = e x c + w x (w x c), t = c x a
    first = add_vectors(cross(u, e), cross(w, cross(w, u)), cross(a, r))
    # inertia: t = I e + w x (I w), so r . t = r . I e + (r x w) . I w
    s = cross(r, w)

    def entry(j: int, k: int) -> Scalar:
        if j == k:
            return r[j] * e[j] + s[j] * w[j]
        return r[j] * e[k] + r[k] * e[j] + s[j] * w[k] + s[k] * w[j]

    return [
        dot(u, a),
        *first,
        *(entry(j, k) for j, k in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))),
    ]
