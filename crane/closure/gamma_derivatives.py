"""Derivatives of gamma by coordinates and time, as symbolic formulas.

A row w of the loop equations satisfies w . (J_2,j - J_1,j) = 0 for the columns J_j = dV/dv_j of
the two bodies that it joins. Differentiated along q_k, and twice along the motion:

    (d_k w) . dJ_j + w . d_k dJ_j = 0,
    w'' . dJ_j + 2 w' . dJ_j' + w . dJ_j'' = 0,    dJ_j = J_2,j - J_1,j.

These are equations for d_k gamma_j and gamma_j'', each with the same matrix as gamma. Coordinates
move joints of their own cluster only (`crane.closure.loop_equations`), so that motions are taken
relative to the body that carries the cluster.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property

from crane.closure.kinematics_formulas import (
    ZERO_VECTOR,
    PositionKinematics,
    SpatialVector,
    Vector,
    add_spatial,
    cross_motion,
    scale_spatial,
    spatial_dot,
    subtract_spatial,
)
from crane.closure.loop_equations import Cluster
from crane.closure.loop_formulas import LoopEquationFormula, LoopFormulas
from crane.codegen.symbolic import Scalar, add_vectors, cross, dot, scale_vector

BodyMotions = dict[int, SpatialVector]  # by body
JointRates = dict[int, Scalar]  # by joint


class GammaDerivatives:
    """Derivatives of gamma at a closed configuration, for holonomic coordinates.

    Args:
        kinematics: Position kinematics.
        loops: Loop formulas at that configuration.
        clusters: All clusters, each after the one that carries it.
        v_a: (n,).

    Attributes:
        own: Coordinates of each cluster.
        twists: By coordinate, columns J_j of the bodies of its cluster.
        partial_derivatives: d gamma_j / d q_k by (k, j), k <= j of one cluster, by joint.
        first: gamma_j' by coordinate, by joint.
    """

    def __init__(
        self,
        kinematics: PositionKinematics,
        loops: LoopFormulas,
        clusters: Sequence[Cluster],
        v_a: Sequence[Scalar],
    ):
        self._kinematics, self._loops, self.clusters = kinematics, loops, clusters
        self._v_a, self._joint_axes = v_a, kinematics.joint_axes
        self.own = [cluster.own_coordinates(loops.active_joints) for cluster in clusters]
        self.twists: dict[int, BodyMotions] = {}
        self.partial_derivatives: dict[tuple[int, int], JointRates] = {}
        self.first: dict[int, JointRates] = {}
        for cluster, coordinates_of_cluster in zip(clusters, self.own, strict=True):
            for j in coordinates_of_cluster:
                gamma = {i: loops.gamma[i][j] for i in cluster.joints}
                self.twists[j] = self.sum_along_cluster(
                    cluster,
                    {i: scale_spatial(gamma[i], self._joint_axes[i]) for i in cluster.joints},
                )
            tied = self._loop_rows(cluster)
            for j in coordinates_of_cluster if tied else ():
                for k in coordinates_of_cluster:
                    if k <= j:
                        self.partial_derivatives[k, j] = self._partial_derivative(
                            cluster, tied, k, j
                        )
            for j in coordinates_of_cluster:
                bent = [
                    (self.partial_derivatives[min(k, j), max(k, j)], v_a[k])
                    for k in coordinates_of_cluster
                    if tied
                ]
                self.first[j] = {
                    i: dot([rates[i] for rates, _ in bent], [v for _, v in bent])
                    for i in cluster.joints
                }

    @cached_property
    def drift(self) -> Vector:
        """(nb + 1,) accelerations of the joints at a_A = 0: gamma' v_A."""
        out: Vector = [0.0] * len(self._joint_axes)
        for j, rates in self.first.items():
            for i, rate in rates.items():
                out[i] = out[i] + rate * self._v_a[j]
        return out

    def second_time_derivatives(
        self, joint_velocities: Sequence[Scalar], joint_accelerations: Sequence[Scalar]
    ) -> dict[int, JointRates]:
        """gamma_j'' by coordinate, by joint.

        Args:
            joint_velocities: (nb + 1,) velocities of the joints.
            joint_accelerations: (nb + 1,) accelerations of the joints.
        """
        n, loops = len(self._v_a), self._loops
        right_sides: list[Vector] = [[0.0] * n for _ in loops.rows]
        for cluster, coordinates in zip(self.clusters, self.own, strict=True):
            loop_rows = self._loop_rows(cluster)
            if not loop_rows:
                continue
            velocity, acceleration = self._relative_motions(
                cluster, joint_velocities, joint_accelerations
            )
            axis_derivatives = self.joint_axis_derivatives(cluster, velocity, acceleration)
            rows = {
                r: _wrench_time_derivatives(loops.rows[r], velocity, acceleration)
                for r in loop_rows
            }
            for j in coordinates:
                rate, known = self.twist_derivatives(
                    cluster, j, axis_derivatives, dict.fromkeys(cluster.joints, 0.0)
                )
                for r, (once, twice) in rows.items():
                    right_sides[r][j] = -1.0 * (
                        _power_between_bodies(twice, self.twists[j], loops.rows[r])
                        + 2.0 * _power_between_bodies(once, rate, loops.rows[r])
                        + _power_between_bodies(loops.rows[r].wrench, known, loops.rows[r])
                        + self._curvature_term(loops.rows[r], j, joint_velocities,
                                               joint_accelerations)
                    )  # fmt: skip
        solution, _ = loops.solve_passive(
            {joint: [0.0] * n for joint in loops.active_joints}, right_sides
        )
        return {
            j: {i: solution[i][j] for i in cluster.joints}
            for cluster, own in zip(self.clusters, self.own, strict=True)
            for j in own
        }

    def _curvature_term(
        self,
        row: LoopEquationFormula,
        coordinate: int,
        joint_velocities: Sequence[Scalar],
        joint_accelerations: Sequence[Scalar],
    ) -> Scalar:
        """Contribution of the higher powers of a coupling: c'' gamma + 2 c' gamma'."""
        total: Scalar = 0.0
        for joint, (curvature, third) in row.curvatures.items():
            v, a = joint_velocities[joint], joint_accelerations[joint]
            rate = self.first[coordinate][joint]
            gamma = self._loops.gamma[joint][coordinate]
            total = total + (third * v * v + curvature * a) * gamma + 2.0 * curvature * v * rate
        return total

    def _relative_motions(
        self,
        cluster: Cluster,
        joint_velocities: Sequence[Scalar],
        joint_accelerations: Sequence[Scalar],
    ) -> tuple[BodyMotions, BodyMotions]:
        """Velocities and accelerations of a cluster's bodies relative to its base."""
        velocity: BodyMotions = {cluster.base: ZERO_VECTOR}
        acceleration: BodyMotions = {cluster.base: ZERO_VECTOR}
        for i in cluster.joints:
            parent, column = self._kinematics.geometry.parents[i], self._joint_axes[i]
            velocity[i] = add_spatial(velocity[parent], scale_spatial(joint_velocities[i], column))
            turned = scale_spatial(joint_velocities[i], cross_motion(velocity[i], column))
            acceleration[i] = add_spatial(
                acceleration[parent], scale_spatial(joint_accelerations[i], column), turned
            )
        return velocity, acceleration

    def joint_axis_derivatives(
        self,
        cluster: Cluster,
        velocities: Mapping[int, SpatialVector],
        accelerations: Mapping[int, SpatialVector],
    ) -> dict[int, tuple[SpatialVector, SpatialVector]]:
        """Derivatives s', s'' of a cluster's joint columns s, from the motions of its bodies."""
        out = {}
        for i in cluster.joints:
            once = cross_motion(velocities[i], self._joint_axes[i])
            out[i] = (
                once,
                add_spatial(
                    cross_motion(accelerations[i], self._joint_axes[i]),
                    cross_motion(velocities[i], once),
                ),
            )
        return out

    def twist_derivatives(
        self,
        cluster: Cluster,
        coordinate: int,
        axis_derivatives: Mapping[int, tuple[SpatialVector, SpatialVector]],
        second_time_derivative: Mapping[int, Scalar],
    ) -> tuple[BodyMotions, BodyMotions]:
        """J_j' and J_j'' of a cluster's bodies, relative to the body that carries it.

        Args:
            cluster: The cluster.
            coordinate: One of its coordinates.
            axis_derivatives: s' and s'' by joint.
            second_time_derivative: gamma_j'' by joint.
        """
        first_derivatives, second_derivatives = {}, {}
        for i in cluster.joints:
            gamma, time_derivatives, (rate, rate_twice) = (
                self._loops.gamma[i][coordinate],
                self.first[coordinate][i],
                axis_derivatives[i],
            )
            first_derivatives[i] = add_spatial(
                scale_spatial(gamma, rate), scale_spatial(time_derivatives, self._joint_axes[i])
            )
            second_derivatives[i] = add_spatial(
                scale_spatial(gamma, rate_twice),
                scale_spatial(2.0 * time_derivatives, rate),
                scale_spatial(second_time_derivative[i], self._joint_axes[i]),
            )
        return self.sum_along_cluster(cluster, first_derivatives), self.sum_along_cluster(
            cluster, second_derivatives
        )

    def sum_along_cluster(
        self, cluster: Cluster, joint_motions: Mapping[int, SpatialVector]
    ) -> BodyMotions:
        """Sums of joint motions along the tree, from the body that carries the cluster."""
        out: BodyMotions = {cluster.base: ZERO_VECTOR}
        for i in cluster.joints:
            out[i] = add_spatial(out[self._kinematics.geometry.parents[i]], joint_motions[i])
        return out

    def _loop_rows(self, cluster: Cluster) -> list[int]:
        return [
            r
            for r, row in enumerate(self._loops.rows)
            if any(joint in cluster.joints for joint in row.jacobian)
        ]

    def _partial_derivative(
        self, cluster: Cluster, loop_rows: Sequence[int], k: int, j: int
    ) -> JointRates:
        """Derivative of gamma_j by q_k, by joint."""
        twist_k = self.twists[k]
        parts = {
            i: scale_spatial(
                self._loops.gamma[i][j], cross_motion(twist_k[i], self._joint_axes[i])
            )
            for i in cluster.joints
        }
        twist_changes = self.sum_along_cluster(cluster, parts)
        right_sides: list[Vector] = [[0.0] for _ in self._loops.rows]
        for r in loop_rows:
            row = self._loops.rows[r]
            one, two = row.bodies
            rate = row.wrench_rate(twist_k.get(one, ZERO_VECTOR), twist_k.get(two, ZERO_VECTOR))
            relative_power = _power_between_bodies(
                row.wrench, twist_changes, row
            ) + _power_between_bodies(rate, self.twists[j], row)
            for joint, (curvature, _) in row.curvatures.items():
                gamma = self._loops.gamma[joint]
                relative_power = relative_power + curvature * gamma[j] * gamma[k]
            right_sides[r] = [-1.0 * relative_power]
        solution, _ = self._loops.solve_passive(
            {joint: [0.0] for joint in self._loops.active_joints}, right_sides
        )
        return {i: solution[i][0] for i in cluster.joints}


def _wrench_time_derivatives(
    row: LoopEquationFormula, velocities: BodyMotions, accelerations: BodyMotions
) -> tuple[SpatialVector, SpatialVector]:
    """First and second time derivative w' and w'' of a row's wrench."""
    one, two = row.bodies
    first, second = velocities.get(one, ZERO_VECTOR), velocities.get(two, ZERO_VECTOR)
    (_, e1), (a2, e2) = accelerations.get(one, ZERO_VECTOR), accelerations.get(two, ZERO_VECTOR)
    axis_rate, arm_rate = row.axis_and_arm_rates(first, second)
    axis = add_vectors(cross(e1, row.axis), cross(first[1], axis_rate))
    arm = add_vectors(cross(e2, row.arm), cross(second[1], arm_rate))
    if row.is_translation:
        arm = add_vectors(arm, a2)
    if row.has_fixed_axis:
        axis = [0.0] * 3
    moment = add_vectors(
        cross(arm, row.axis), scale_vector(2.0, cross(arm_rate, axis_rate)), cross(row.arm, axis)
    )
    return row.wrench_rate(first, second), (axis if row.is_translation else [0.0] * 3, moment)


def _power_between_bodies(
    wrench: SpatialVector, motions: BodyMotions, row: LoopEquationFormula
) -> Scalar:
    """Power of a wrench on the relative motion of the two bodies of a row."""
    one, two = row.bodies
    return spatial_dot(
        wrench, subtract_spatial(motions.get(two, ZERO_VECTOR), motions.get(one, ZERO_VECTOR))
    )
