"""Forward dynamics by recursion over clusters of joints, as symbolic formulas.

Inverse dynamics at a reference acceleration gives the wrenches that the bodies need; accelerations
relative to the reference follow from the remaining forces. From the outermost cluster inwards, the
bodies that a body carries react to its relative acceleration A = [a, e] with the wrench

    F = I A + p

with the articulated inertia I and the bias p; from the world outwards the accelerations follow.
The number of operations is proportional to the number of bodies (Featherstone 2008, section 7.3).
A cluster is reduced in one of two equivalent ways:

- `ProjectedCluster`: by its independent coordinates, through gamma (Jain 2012; Chignoli et al.
  2023). Exact for all masses.
- `ArticulatedCluster`: joint by joint, with the forces of its loops as unknowns that are solved
  for at its base. Takes operations in proportion to its joints, but every joint must move a mass.

Accelerations are those of the origin of each body, in the axes of the reference body.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.closure.kinematics_formulas import (
    ZERO_VECTOR,
    PositionKinematics,
    SpatialVector,
    Vector,
    add_spatial,
    scale_spatial,
    shift_motion,
    shift_wrench,
    spatial_dot,
)
from crane.closure.loop_equations import Cluster, find_clusters
from crane.closure.loop_formulas import LoopFormulas, VelocityKinematics
from crane.codegen.symbolic import Scalar, dot, sum_scalars
from crane.codegen.symbolic_linear_algebra import LdltFactorization, invert_pivot
from crane.dynamics.spatial_inertia import ClusterMassColumns, SpatialInertia, forward_substitute
from crane.machine.machine import Machine

ArticulatedInertia = tuple[
    SpatialInertia, SpatialVector
]  # an inertia, and the wrench that it asks for at rest
ArticulatedInertias = dict[
    int, ArticulatedInertia
]  # what hangs on bodies, by their number, at their origin


@dataclass(frozen=True)
class RecursionInput:
    """Input of the recursion: a state, and accelerations relative to `reference_accelerations`.

    Attributes:
        kinematics: Position kinematics.
        loops: Loop formulas.
        velocity_kinematics: Velocities, for the loops' second derivatives.
        reference_accelerations: (nb + 1,) accelerations of the joints that `reference_wrenches`
            belong to: the drift where clusters are projected, else 0.
        body_inertias: For every body mass, lever from its origin to the COM, inertia about the
            COM.
        reference_wrenches: For every body, wrench about its COM at the reference, weight included.
        rotor_inertias: (nb + 1,) rotor inertias of the joints.
        joint_forces: (nb + 1,) forces along the joints, those of the drives included.
        least_inertias: (nb + 1,) inertia of each joint that counts as none.
        held_joints: Joints of held coordinates, which do not accelerate.
    """

    kinematics: PositionKinematics
    loops: LoopFormulas
    velocity_kinematics: VelocityKinematics
    reference_accelerations: Vector
    body_inertias: Sequence[tuple[Scalar, Vector, list[Vector]]]
    reference_wrenches: Sequence[SpatialVector]
    rotor_inertias: Vector
    joint_forces: Vector
    least_inertias: Vector
    held_joints: frozenset[int]

    def articulated_inertia(self, i: int, articulated: ArticulatedInertias) -> ArticulatedInertia:
        """Inertia and wrench of a body with those that it carries, at its origin."""
        mass, lever, tensor = self.body_inertias[i - 1]
        inertia = SpatialInertia.rigid_body(mass, lever, tensor)
        wrench = shift_wrench(self.reference_wrenches[i - 1], lever)
        if i not in articulated:
            return inertia, wrench
        return inertia + articulated[i][0], add_spatial(wrench, articulated[i][1])


def add_articulated_inertia(
    articulated: ArticulatedInertias, body: int, inertia: SpatialInertia, bias: SpatialVector
) -> None:
    """Add an articulated inertia to those that a body carries."""
    if body in articulated:
        inertia, bias = articulated[body][0] + inertia, add_spatial(articulated[body][1], bias)
    articulated[body] = inertia, bias


class ArticulatedCluster:
    """A cluster in the recursion that is reduced joint by joint, with the forces of its loops.

    For a joint with the axis s, and with one further right-hand side per loop equation, whose
    force along the joint is the equation's derivative J:

        D = s^T I s,  U = I s,  u = tau - s^T p,  u_r = J_r - s^T P_r
        I' = I - U U^T / D,  p' = p + U u / D,  P_r' = P_r + U u_r / D

    At the base the equations J a = -b of all joints determine the constraint forces l:

        L l = -b - sum u_r u / D + P^T A,  L = sum u_r u_r^T / D
        I = I' + P L^-1 P^T,  p = p' + P L^-1 (-b - sum u_r u / D)

    Args:
        recursion: State of the machine.
        cluster: The cluster.
        articulated: Articulated inertias that its bodies carry.

    Attributes:
        inertia: I.
        bias: p.
    """

    def __init__(
        self, recursion: RecursionInput, cluster: Cluster, articulated: ArticulatedInertias
    ):
        self._recursion, self._cluster = recursion, cluster
        joints = set(cluster.joints)
        self._loop_rows = [row for row in recursion.loops.rows if joints & row.jacobian.keys()]
        self._joint_steps: dict[int, _ArticulatedJoint] = {}
        self._constraint_wrenches = {
            i: [ZERO_VECTOR] * len(self._loop_rows) for i in (cluster.base, *cluster.joints)
        }
        articulated_inside = {i: articulated[i] for i in cluster.joints if i in articulated}
        for i in reversed(cluster.joints):
            self._articulate_joint(i, articulated_inside)
        inertia, bias = articulated_inside[cluster.base]
        steps = self._joint_steps.values()
        count = range(len(self._loop_rows))
        self._factorization = LdltFactorization(
            [
                [
                    sum_scalars(
                        step.constraint_forces[r] * step.constraint_forces[c] * step.inverse
                        for step in steps
                    )
                    for c in count
                ]
                for r in count
            ]
        )
        self._constraint_bias = [
            -recursion.velocity_kinematics.acceleration_bias(row)
            - sum_scalars(x.constraint_forces[r] * x.net_force * x.inverse for x in steps)
            for r, row in enumerate(self._loop_rows)
        ]
        columns = self._constraint_wrenches[cluster.base]
        negative_inverse = [-1.0 * x for x in self._factorization.inverse_diagonal]
        self.inertia = inertia.subtract_columns(
            forward_substitute(self._factorization, columns), negative_inverse
        )
        found = self._factorization.solve(self._constraint_bias)
        self.bias = add_spatial(
            bias, *(scale_spatial(x, p) for x, p in zip(found, columns, strict=True))
        )

    def _articulate_joint(self, i: int, articulated: ArticulatedInertias) -> None:
        """Reduce one joint and add the result to the body that carries it."""
        recursion, axis = self._recursion, self._recursion.kinematics.body_motion_axes(i)
        parent, arm = recursion.kinematics.geometry.parents[i], recursion.kinematics.offsets[i]
        inertia, wrench = recursion.articulated_inertia(i, articulated)
        column = inertia.apply_to(axis)
        pivot = spatial_dot(axis, column) + recursion.rotor_inertias[i]
        is_held = i in recursion.held_joints
        inverse = 0.0 if is_held else invert_pivot(pivot, recursion.least_inertias[i])
        rotor_force = recursion.rotor_inertias[i] * recursion.reference_accelerations[i]
        net_force = recursion.joint_forces[i] - rotor_force - spatial_dot(axis, wrench)
        constraint_forces = [
            row.jacobian.get(i, 0.0) - spatial_dot(axis, force)
            for row, force in zip(self._loop_rows, self._constraint_wrenches[i], strict=True)
        ]
        self._joint_steps[i] = _ArticulatedJoint(column, inverse, net_force, constraint_forces)
        transmitted_wrench = add_spatial(wrench, scale_spatial(net_force * inverse, column))
        add_articulated_inertia(
            articulated,
            parent,
            inertia.subtract_columns([column], [inverse]).shift_origin(arm),
            shift_wrench(transmitted_wrench, arm),
        )
        self._constraint_wrenches[parent] = [
            add_spatial(
                old, shift_wrench(add_spatial(force, scale_spatial(side * inverse, column)), arm)
            )
            for old, force, side in zip(
                self._constraint_wrenches[parent],
                self._constraint_wrenches[i],
                constraint_forces,
                strict=True,
            )
        ]

    def joint_accelerations(
        self, body_accelerations: Sequence[SpatialVector]
    ) -> Iterator[tuple[int, Scalar]]:
        """Accelerations of the joints relative to the reference, by joint.

        Args:
            body_accelerations: Accelerations of all bodies relative to the reference; those of the
                cluster's bodies are appended by the caller.
        """
        base = body_accelerations[self._cluster.base]
        columns = self._constraint_wrenches[self._cluster.base]
        right = [
            x + spatial_dot(p, base) for x, p in zip(self._constraint_bias, columns, strict=True)
        ]
        forces = self._factorization.solve(right)
        for i in self._cluster.joints:
            step = self._joint_steps[i]
            total_force = step.net_force + dot(step.constraint_forces, forces)
            carrier = shift_motion(
                body_accelerations[self._recursion.kinematics.geometry.parents[i]],
                self._recursion.kinematics.offsets[i],
            )
            yield i, (total_force - spatial_dot(step.column, carrier)) * step.inverse


@dataclass(frozen=True)
class _ArticulatedJoint:
    """A reduced joint of a cluster; see `ArticulatedCluster`.

    Attributes:
        column: U.
        inverse: 1 / D.
        net_force: u.
        constraint_forces: u_r, by loop equation.
    """

    column: SpatialVector
    inverse: Scalar
    net_force: Scalar
    constraint_forces: Vector


class ProjectedCluster:
    """A cluster in the recursion that is reduced by its independent coordinates.

    With W_b the motion of body b per unit of these coordinates,

        D = sum W_b^T I_b W_b,  U = sum I_b W_b,  u = tau - sum W_b^T p_b
        I = sum I_b - U D^-1 U^T,  p = sum p_b + U D^-1 u

    all referred to the origin of the body that carries the cluster. The sums are those of
    composite bodies, whose wrenches gamma projects.

    Args:
        recursion: State of the machine.
        cluster: The cluster.
        articulated: Articulated inertias that its bodies carry.

    Attributes:
        inertia: I.
        bias: p.
    """

    def __init__(
        self, recursion: RecursionInput, cluster: Cluster, articulated: ArticulatedInertias
    ):
        self._cluster, loops, kinematics = cluster, recursion.loops, recursion.kinematics
        coordinates = cluster.own_coordinates(loops.active_joints)
        self._gamma = {i: [loops.gamma[i][k] for k in coordinates] for i in cluster.joints}
        articulated_inside = {i: articulated[i] for i in cluster.joints if i in articulated}
        inertias: dict[int, SpatialInertia] = {}
        self._net_forces: list[Scalar] = [0.0] * len(coordinates)
        for i in reversed(cluster.joints):
            inertia, wrench = recursion.articulated_inertia(i, articulated_inside)
            inertias[i], arm = inertia, kinematics.offsets[i]
            rotor_force = recursion.rotor_inertias[i] * recursion.reference_accelerations[i]
            force = recursion.joint_forces[i] - rotor_force
            force = force - spatial_dot(kinematics.body_motion_axes(i), wrench)
            self._net_forces = [
                old + factor * force
                for old, factor in zip(self._net_forces, self._gamma[i], strict=True)
            ]
            add_articulated_inertia(
                articulated_inside,
                kinematics.geometry.parents[i],
                inertia.shift_origin(arm),
                shift_wrench(wrench, arm),
            )
        columns = ClusterMassColumns(
            kinematics, cluster, self._gamma, inertias, recursion.rotor_inertias
        )
        joints = [loops.active_joints[k] for k in coordinates]
        self._factorization = LdltFactorization(
            columns.mass_block,
            [recursion.least_inertias[joint] for joint in joints],
            [k for k, joint in enumerate(joints) if joint in recursion.held_joints],
        )
        self._wrenches = columns.base_wrenches
        inertia, bias = articulated_inside[cluster.base]
        self.inertia = inertia.subtract_columns(
            forward_substitute(self._factorization, self._wrenches),
            self._factorization.inverse_diagonal,
        )
        found = self._factorization.solve(self._net_forces)
        self.bias = add_spatial(
            bias, *(scale_spatial(x, u) for x, u in zip(found, self._wrenches, strict=True))
        )

    def joint_accelerations(
        self, body_accelerations: Sequence[SpatialVector]
    ) -> Iterator[tuple[int, Scalar]]:
        """Accelerations of the joints relative to the reference, by joint.

        Args:
            body_accelerations: Accelerations of the bodies relative to the reference.
        """
        base = body_accelerations[self._cluster.base]
        right = [
            pull - spatial_dot(wrench, base)
            for pull, wrench in zip(self._net_forces, self._wrenches, strict=True)
        ]
        x = self._factorization.solve(right)
        for i, row in self._gamma.items():
            yield i, dot(row, x)


RecursionPlan = tuple[tuple[Cluster, bool], ...]
# degrees of freedom up to which M_A from body Jacobians takes fewer operations
_MAX_MOBILITY_WITHOUT_RECURSION = 4
# coordinates of a cluster up to which `ProjectedCluster` takes fewer operations
_MAX_PROJECTED_COORDINATES = 6
_LIGHT_INERTIA_RATIO = 1e-6  # articulated over composite inertia of a light joint


def plan_recursion(machine: Machine) -> RecursionPlan:
    """Select how the recursion reduces each cluster of a machine.

    Returns:
        The clusters, each after the one that carries it, and whether it is reduced by constraint
        forces (`ArticulatedCluster`); empty for machines with few degrees of freedom.
    """
    if len(machine.active) <= _MAX_MOBILITY_WITHOUT_RECURSION:
        return ()
    active = [int(column) + 1 for column in machine.closure.active]
    # joints with next to no articulated inertia of their own, by which their recursion divides
    data = machine.closure.equations.data  # reused because creating data is expensive
    mass = pin.crba(machine.model, data, machine.coordinates.configuration(machine.home))
    pin.cholesky.decompose(machine.model, data)
    is_light = ~(_LIGHT_INERTIA_RATIO * np.diag(mass) < data.D)

    def by_forces(cluster: Cluster) -> bool:
        own, size = len(cluster.own_coordinates(active)), len(cluster.joints)
        if size == 1:
            return True
        # cost grows with the square of the number of equations or coordinates
        is_long = max(size - own, _MAX_PROJECTED_COORDINATES) < own
        return is_long and not any(is_light[joint - 1] for joint in cluster.joints)

    return tuple(
        (cluster, by_forces(cluster)) for cluster in find_clusters(machine.closure.equations)
    )


def joint_accelerations(recursion: RecursionInput, plan: RecursionPlan) -> Vector:
    """Accelerations (nb + 1,) of all joints.

    Args:
        recursion: State and reference accelerations of the machine.
        plan: See `plan_recursion`.
    """
    articulated: ArticulatedInertias = {}
    articulated_clusters: list[ProjectedCluster | ArticulatedCluster] = []
    for cluster, by_forces in reversed(plan):
        articulated_cluster = (ArticulatedCluster if by_forces else ProjectedCluster)(
            recursion, cluster, articulated
        )
        articulated_clusters.append(articulated_cluster)
        add_articulated_inertia(
            articulated, cluster.base, articulated_cluster.inertia, articulated_cluster.bias
        )
    out = list(recursion.reference_accelerations)
    bodies = [ZERO_VECTOR] * len(out)
    kinematics = recursion.kinematics
    for articulated_cluster in reversed(articulated_clusters):
        for i, rate in articulated_cluster.joint_accelerations(bodies):
            out[i] = out[i] + rate
            bodies[i] = add_spatial(
                shift_motion(bodies[kinematics.geometry.parents[i]], kinematics.offsets[i]),
                scale_spatial(rate, kinematics.body_motion_axes(i)),
            )
    return out
