"""Analytic derivatives of inverse and forward dynamics through closed loops, as symbolic formulas.

Coordinate q_j of the machine moves every body b with a twist J_b,j = dV_b/dv_j. For any holonomic
mechanism, d_j J_k - d_k J_j = J_j x J_k, so that derivatives of twists and accelerations are time
derivatives of these columns,

    d_j V = J_j' + J_j x V,    d_j A = J_j'' + J_j' x V + J_j x A,

and those of the wrench f = I A + V x* I V = I A + B V of a body are

    d f / d v_j = 2 I J_j' + 2 B J_j,
    d f / d q_j = J_j x* f + I J_j'' + 2 B J_j',
    2 B [u, t] = [2 t x p, 2 (tr(K) t - K t)],    p = sum m r',    K = sum m r' r^T,

with sums over the points r of the body (Singh, Russell, Wensing 2022, equations (39) to (46), have
the same for open trees, with other signs and names). The columns include the derivatives of gamma
(`crane.closure.gamma_derivatives`). Joints of one cluster (`crane.closure.loop_equations`) move
with its own coordinates only: sums over bodies are taken by cluster, with all bodies beyond as one
inertia.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property

from crane.closure.gamma_derivatives import BodyMotions, GammaDerivatives
from crane.closure.kinematics_formulas import (
    SpatialVector,
    Vector,
    add_spatial,
    cross_wrench,
    scale_spatial,
    spatial_dot,
)
from crane.codegen.differentiation import directional_derivative
from crane.codegen.symbolic import (
    Scalar,
    SymbolicExpression,
    add_vectors,
    dot,
    dot_products,
    scale_vector,
    subtract_vectors,
    sum_scalars,
    transpose,
)  # fmt: skip
from crane.dynamics.dynamics_formulas import DynamicsFormulas
from crane.dynamics.spatial_inertia import MassMoments, Matrix


class DynamicsDerivatives:
    """Derivatives of inverse and forward dynamics at a configuration and velocity.

    For holonomic coordinates, without floating bases, in the exact formulation.

    Args:
        formulas: Dynamics formulas.
        gamma_derivatives: Derivatives of gamma.
        friction: Whether friction is included.
    """

    def __init__(
        self, formulas: DynamicsFormulas, gamma_derivatives: GammaDerivatives, friction: bool
    ):
        self._formulas, self._gamma_derivatives, self._friction = (
            formulas,
            gamma_derivatives,
            friction,
        )
        self._joint_axes = formulas.kinematics.joint_axes
        self._parents, self._n = formulas.kinematics.geometry.parents, len(formulas.v_a)
        self._cluster_of_joint = {
            i: c for c, x in enumerate(gamma_derivatives.clusters) for i in x.joints
        }

    @cached_property
    def _body_velocities(self) -> list[SpatialVector]:
        return self._formulas.body_motions([0.0] * len(self._parents))[0]

    @cached_property
    def _body_moments(self) -> dict[int, MassMoments]:
        bodies = enumerate(self._formulas.body_inertias, start=1)
        return {i: MassMoments.rigid_body(*body, self._body_velocities[i]) for i, body in bodies}

    @cached_property
    def _lumped_moments(self) -> dict[int, MassMoments]:
        """Mass moments of every body with all bodies beyond it in other clusters."""
        lumped, subtree = dict(self._body_moments), dict(self._body_moments)
        for i in range(len(lumped), 0, -1):
            parent = self._parents[i]
            if parent:
                subtree[parent] = subtree[parent] + subtree[i]
            if parent and self._cluster_of_joint[parent] != self._cluster_of_joint[i]:
                lumped[parent] = lumped[parent] + subtree[i]
        return lumped

    def _accumulate_wrenches(
        self, cluster_index: int, wrenches: dict[int, SpatialVector]
    ) -> dict[int, SpatialVector]:
        """Sums of wrenches over each body of a cluster and those beyond it, and at its base."""
        out = dict(wrenches)
        for i in reversed(self._gamma_derivatives.clusters[cluster_index].joints):
            parent = self._parents[i]
            out[parent] = add_spatial(out[parent], out[i]) if parent in out else out[i]
        return out

    @cached_property
    def _unit_acceleration_wrenches(self) -> dict[int, dict[int, SpatialVector]]:
        """By coordinate, accumulated wrenches I J_j of its cluster."""
        return {
            j: self._accumulate_wrenches(
                c,
                {
                    i: self._lumped_moments[i].inertial_wrench(
                        self._gamma_derivatives.twists[j][i]
                    )
                    for i in cluster.joints
                },
            )
            for c, cluster in enumerate(self._gamma_derivatives.clusters)
            for j in self._gamma_derivatives.own[c]
        }

    @cached_property
    def mass_matrix(self) -> Matrix:
        """M_A (n, n) = d tau_A / d a_A."""
        out: Matrix = [[0.0] * self._n for _ in range(self._n)]
        gamma, rotors, twists = (
            self._formulas.gamma,
            self._formulas.rotor_inertias,
            self._gamma_derivatives.twists,
        )
        for c, cluster in enumerate(self._gamma_derivatives.clusters):
            own = self._gamma_derivatives.own[c]
            for j in own:
                wrenches = self._unit_acceleration_wrenches[j]
                for k in [k for k in own if k <= j]:
                    out[k][j] = out[j][k] = sum_scalars(
                        gamma[i][k]
                        * (spatial_dot(self._joint_axes[i], wrenches[i]) + rotors[i] * gamma[i][j])
                        for i in cluster.joints
                    )
                for k, body in self._carrying_coordinates(c):
                    out[k][j] = out[j][k] = spatial_dot(twists[k][body], wrenches[cluster.base])
        return out

    def _carrying_coordinates(self, cluster_index: int) -> list[tuple[int, int]]:
        """The coordinates that move the base of a cluster, with the body through which they do."""
        out, body = [], self._gamma_derivatives.clusters[cluster_index].base
        while body:
            carrying_cluster = self._cluster_of_joint[body]
            out += [(k, body) for k in self._gamma_derivatives.own[carrying_cluster]]
            body = self._gamma_derivatives.clusters[carrying_cluster].base
        return out

    def inverse_dynamics_derivatives(self, a_a: Sequence[Scalar]) -> tuple[Matrix, Matrix]:
        """Derivatives (n, n) of tau_A by q_A and v_A at an acceleration a_A (n,)."""
        formulas, gamma_derivatives, size = (
            self._formulas,
            self._gamma_derivatives,
            len(self._parents),
        )
        rates = [0.0, *(dot(formulas.gamma[i], a_a) + formulas.drift[i] for i in range(1, size))]
        second = gamma_derivatives.second_time_derivatives(formulas.joint_velocities, rates)
        motions = tuple(dict(enumerate(x)) for x in formulas.body_motions(rates))
        subtree_wrenches, forces = (
            self._subtree_wrenches(rates),
            formulas.passive_and_friction_forces(self._friction),
        )
        # forces of drives at all joints
        required_joint_forces = subtract_vectors(
            self._inertial_joint_forces(subtree_wrenches, rates), forces
        )
        by_q: Matrix = [[0.0] * self._n for _ in range(self._n)]
        by_v: Matrix = [[0.0] * self._n for _ in range(self._n)]
        twist_derivatives: dict[int, tuple[BodyMotions, BodyMotions]] = {}
        for c, cluster in enumerate(gamma_derivatives.clusters):
            axis_derivatives = gamma_derivatives.joint_axis_derivatives(cluster, *motions)
            for j in gamma_derivatives.own[c]:
                twist_derivatives[j] = gamma_derivatives.twist_derivatives(
                    cluster, j, axis_derivatives, second[j]
                )
                self._add_coordinate(
                    c, j, twist_derivatives, second[j], subtree_wrenches, required_joint_forces,
                    by_q, by_v,
                )  # fmt: skip
                force_derivatives = self._joint_force_derivatives(c, j, forces)
                for k in range(self._n):
                    column = [formulas.gamma[i][k] for i in range(1, size)]
                    by_q[k][j] = by_q[k][j] - dot(column, force_derivatives[0][1:])
                    by_v[k][j] = by_v[k][j] - dot(column, force_derivatives[1][1:])
        return by_q, by_v

    def _subtree_wrenches(self, joint_accelerations: Sequence[Scalar]) -> dict[int, SpatialVector]:
        """By joint, the wrench that accelerates all bodies beyond it."""
        _, accelerations = self._formulas.body_motions(joint_accelerations)
        subtree: dict[int, SpatialVector] = {}
        for i in range(len(accelerations) - 1, 0, -1):
            moments = self._body_moments[i]
            wrench = add_spatial(
                moments.inertial_wrench(accelerations[i]),
                moments.velocity_wrench(self._body_velocities[i][1]),
            )
            subtree[i] = add_spatial(subtree[i], wrench) if i in subtree else wrench
            if parent := self._parents[i]:
                subtree[parent] = (
                    add_spatial(subtree[parent], subtree[i]) if parent in subtree else subtree[i]
                )
        return subtree

    def _inertial_joint_forces(
        self, subtree_wrenches: Mapping[int, SpatialVector], joint_accelerations: Sequence[Scalar]
    ) -> Vector:
        """Forces along the joints (nb + 1,) that accelerate bodies and rotors."""
        out: Vector = [0.0] * len(joint_accelerations)
        for i, wrench in subtree_wrenches.items():
            out[i] = (
                spatial_dot(self._joint_axes[i], wrench)
                + self._formulas.rotor_inertias[i] * joint_accelerations[i]
            )
        return out

    def _add_coordinate(
        self,
        cluster_index: int,
        j: int,
        twist_derivatives: Mapping[int, tuple[BodyMotions, BodyMotions]],
        second_time_derivative: Mapping[int, Scalar],
        subtree_wrenches: Mapping[int, SpatialVector],
        required_joint_forces: Vector,
        by_q: Matrix,
        by_v: Matrix,
    ) -> None:
        """Add the derivatives by coordinate j of a cluster, and those by the ones that carry it.

        Args:
            cluster_index: The cluster.
            j: One of its coordinates.
            twist_derivatives: J_k' and J_k'' of the coordinates up to j.
            second_time_derivative: gamma_j'' by joint.
            subtree_wrenches: By joint, the wrench that accelerates all bodies beyond it.
            required_joint_forces: (nb + 1,) forces of drives at all joints.
            by_q: (n, n) derivatives of tau_A by q_A.
            by_v: (n, n) derivatives of tau_A by v_A.
        """
        formulas, gamma_derivatives = self._formulas, self._gamma_derivatives
        gamma, cluster = formulas.gamma, gamma_derivatives.clusters[cluster_index]
        rate, twice = twist_derivatives[j]
        wrenches_by_q: dict[int, SpatialVector] = {}
        half_wrenches_by_v: dict[int, SpatialVector] = {}
        wrench_shifts: dict[int, SpatialVector] = {}  # of the wrench that rotates with a joint
        transposed_product: Vector = [0.0] * 3  # B^T J_j of all bodies
        for i in cluster.joints:
            moments, twist = self._lumped_moments[i], gamma_derivatives.twists[j][i]
            wrenches_by_q[i] = add_spatial(
                moments.inertial_wrench(twice[i]),
                moments.velocity_wrench(scale_vector(2.0, rate[i][1])),
            )
            half_wrenches_by_v[i] = add_spatial(
                moments.inertial_wrench(rate[i]), moments.velocity_wrench(twist[1])
            )
            wrench_shifts[i] = scale_spatial(
                gamma[i][j], cross_wrench(self._joint_axes[i], subtree_wrenches[i])
            )
            transposed_product = add_vectors(
                transposed_product, moments.transposed_velocity_product(twist)
            )
        wrenches_by_q = self._accumulate_wrenches(cluster_index, wrenches_by_q)
        half_wrenches_by_v = self._accumulate_wrenches(cluster_index, half_wrenches_by_v)
        forces_by_q, half_forces_by_v = (
            [
                spatial_dot(self._joint_axes[i], wrenches[i])
                + formulas.rotor_inertias[i] * gamma_rates[i]
                for i in cluster.joints
            ]
            for wrenches, gamma_rates in (
                (wrenches_by_q, second_time_derivative),
                (half_wrenches_by_v, gamma_derivatives.first[j]),
            )
        )
        base_wrench = add_spatial(wrenches_by_q[cluster.base], *wrench_shifts.values())
        for k in gamma_derivatives.own[cluster_index]:
            row = [gamma[i][k] for i in cluster.joints]
            bent = gamma_derivatives.partial_derivatives.get((min(k, j), max(k, j)), {})
            by_q[k][j] = dot(row, forces_by_q)
            by_q[k][j] = by_q[k][j] + dot(
                [required_joint_forces[i] for i in bent], list(bent.values())
            )
            for i in cluster.joints:
                by_q[k][j] = by_q[k][j] + spatial_dot(
                    gamma_derivatives.twists[k][i], wrench_shifts[i]
                )
            by_v[k][j] = 2.0 * dot(row, half_forces_by_v)
        wrench = self._unit_acceleration_wrenches[j][cluster.base]
        for k, body in self._carrying_coordinates(cluster_index):
            twist = gamma_derivatives.twists[k][body]
            rate_k, twice_k = (motions[body] for motions in twist_derivatives[k])
            by_q[k][j] = by_q[k][j] + spatial_dot(twist, base_wrench)
            by_v[k][j] = by_v[k][j] + 2.0 * spatial_dot(twist, half_wrenches_by_v[cluster.base])
            by_q[j][k] = (
                by_q[j][k]
                + spatial_dot(twice_k, wrench)
                + 2.0 * dot(transposed_product, rate_k[1])
            )
            back = spatial_dot(rate_k, wrench) + dot(transposed_product, twist[1])
            by_v[j][k] = by_v[j][k] + 2.0 * back

    def forward_dynamics_derivatives(self, tau: Sequence[Scalar]) -> tuple[Matrix, Matrix, Matrix]:
        """Derivatives (n, n) of a_A by q_A, v_A and tau_A.

        With M_A a_A + h = tau_A, d a_A = M_A^-1 (d tau_A - d inverse at a_A).
        """
        formulas = self._formulas
        mass = formulas.factorize_mass_matrix(self.mass_matrix)
        right = add_vectors(
            tau, formulas.project(formulas.passive_and_friction_forces(self._friction))
        )
        bias = formulas.project(
            self._inertial_joint_forces(self._subtree_wrenches(formulas.drift), formulas.drift)
        )
        by_q, by_v = self.inverse_dynamics_derivatives(mass.solve(subtract_vectors(right, bias)))
        inverse = mass.inverse_matrix
        back = [scale_vector(-1.0, row) for row in inverse]
        columns = transpose([[*q, *v] for q, v in zip(by_q, by_v, strict=True)])
        rows = [dot_products(row, columns) for row in back]
        return [row[: self._n] for row in rows], [row[self._n :] for row in rows], inverse

    def _joint_force_derivatives(
        self, cluster_index: int, coordinate: int, forces: Vector
    ) -> tuple[Vector, Vector]:
        """Derivatives of forces along the joints by q_j and by v_j, (nb + 1,) each."""
        formulas, joints = self._formulas, self._gamma_derivatives.clusters[cluster_index].joints
        at = {i: formulas.q[i - 1] for i in joints}
        rates = {
            i: rate
            for i in joints
            if isinstance(rate := formulas.joint_velocities[i], SymbolicExpression)
        }
        by_q = {
            x.index: formulas.gamma[i][coordinate]
            for i, x in at.items()
            if isinstance(x, SymbolicExpression)
        }
        by_q |= {
            rate.index: self._gamma_derivatives.first[coordinate][i] for i, rate in rates.items()
        }
        by_v = {rate.index: formulas.gamma[i][coordinate] for i, rate in rates.items()}
        return directional_derivative(forces, by_q), directional_derivative(forces, by_v)
