"""A cluster of joints that gives way joint by joint, its loops by forces; see `recursion`."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from crane.closure.clusters import Cluster
from crane.closure.spatial_vectors import (
    ZERO_VECTOR,
    SpatialVector,
    Vector,
    add_spatial,
    scale_spatial,
    shift_motion,
    shift_wrench,
    spatial_dot,
)
from crane.codegen.matrix_factorization import LdltFactorization
from crane.codegen.symbolic import Scalar, dot
from crane.dynamics.recursion_input import (
    ArticulatedInertias,
    RecursionInput,
    add_articulated_inertia,
)
from crane.dynamics.spatial_inertia import forward_substitute


class ArticulatedCluster:
    """A cluster that gives way joint by joint, its loops by their forces.

    A joint with the axis s, and for the force of every loop equation a further right side, whose
    force along the joint is the equation's slope J:

        D = s^T I s,  U = I s,  u = tau - s^T p,  u_r = J_r - s^T P_r
        I' = I - U U^T / D,  p' = p + U u / D,  P_r' = P_r + U u_r / D

    At the base the equations J a = -b of all joints give the forces l:

        L l = -b - sum u_r u / D + P^T A,  L = sum u_r u_r^T / D
        I = I' + P L^-1 P^T,  p = p' + P L^-1 (-b - sum u_r u / D)

    Args:
        recursion: The machine.
        cluster: Which.
        articulated: What hangs on its bodies.

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
                    _sum_scalars(
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
            - _sum_scalars(x.constraint_forces[r] * x.net_force * x.inverse for x in steps)
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
        """A joint, and what it hands to the body that carries it."""
        recursion, axis = self._recursion, self._recursion.kinematics.body_motion_axes(i)
        parent, arm = recursion.kinematics.geometry.parents[i], recursion.kinematics.offsets[i]
        inertia, wrench = recursion.articulated_inertia(i, articulated)
        column = inertia.apply_to(axis)
        inverse = 1.0 / (spatial_dot(axis, column) + recursion.rotor_inertias[i])
        net_force = recursion.remaining_force(i) - spatial_dot(axis, wrench)
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
        """What the joints accelerate more, by joint, from what the body that carries them does.

        Args:
            body_accelerations: What all bodies accelerate more than with the reference, those of
                the cluster as they become known.
        """
        base = body_accelerations[self._cluster.base]
        columns = self._constraint_wrenches[self._cluster.base]
        right = [
            x + spatial_dot(p, base) for x, p in zip(self._constraint_bias, columns, strict=True)
        ]
        forces = self._factorization.solve(right)
        for i in self._cluster.joints:
            step = self._joint_steps[i]
            parent = body_accelerations[self._recursion.kinematics.geometry.parents[i]]
            total_force = step.net_force + dot(step.constraint_forces, forces)
            carrier = shift_motion(parent, self._recursion.kinematics.offsets[i])
            yield i, (total_force - spatial_dot(step.column, carrier)) * step.inverse


@dataclass(frozen=True)
class _ArticulatedJoint:
    """A joint of a cluster; see `ArticulatedCluster`.

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


def _sum_scalars(numbers: Iterable[Scalar]) -> Scalar:
    total: Scalar = 0.0
    for number in numbers:
        total = total + number
    return total
