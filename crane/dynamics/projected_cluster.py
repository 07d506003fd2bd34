"""A cluster of joints that gives way by its independent coordinates; see `recursion`."""

from collections.abc import Iterator, Sequence

from crane.closure.clusters import Cluster
from crane.closure.spatial_vectors import (
    SpatialVector,
    add_spatial,
    scale_spatial,
    shift_wrench,
    spatial_dot,
)
from crane.codegen.matrix_factorization import LdltFactorization
from crane.codegen.symbolic import Scalar, dot
from crane.dynamics.composite_mass_matrix import ClusterMassColumns
from crane.dynamics.recursion_input import (
    ArticulatedInertias,
    RecursionInput,
    add_articulated_inertia,
)
from crane.dynamics.spatial_inertia import SpatialInertia, forward_substitute


class ProjectedCluster:
    """A cluster that gives way by its independent coordinates.

    With W_b the motion of body b per unit of these,

        D = sum W_b^T I_b W_b,  U = sum I_b W_b,  u = tau - sum W_b^T p_b
        I = sum I_b - U D^-1 U^T,  p = sum p_b + U D^-1 u

    all referred to the origin of the body that the cluster hangs on. The sums are those of
    composite bodies, whose wrenches gamma projects.

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
        self._cluster, loops, posture = cluster, recursion.loops, recursion.kinematics
        coordinates = cluster.own_coordinates(loops.active_joints)
        self._gamma = {i: [loops.gamma[i][k] for k in coordinates] for i in cluster.joints}
        articulated_inside = {i: articulated[i] for i in cluster.joints if i in articulated}
        inertias: dict[int, SpatialInertia] = {}
        self._net_forces: list[Scalar] = [0.0] * len(coordinates)
        for i in reversed(cluster.joints):
            inertia, wrench = recursion.articulated_inertia(i, articulated_inside)
            inertias[i], arm = inertia, posture.offsets[i]
            force = recursion.remaining_force(i) - spatial_dot(posture.body_motion_axes(i), wrench)
            self._net_forces = [
                old + factor * force
                for old, factor in zip(self._net_forces, self._gamma[i], strict=True)
            ]
            add_articulated_inertia(
                articulated_inside,
                posture.geometry.parents[i],
                inertia.shift_origin(arm),
                shift_wrench(wrench, arm),
            )
        columns = ClusterMassColumns(
            posture, cluster, self._gamma, inertias, recursion.rotor_inertias
        )
        self._factorization, self._wrenches = (
            LdltFactorization(columns.mass_block),
            columns.base_wrenches,
        )
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
        """What the joints accelerate more, by joint, from what the body that carries them does.

        Args:
            body_accelerations: What all bodies accelerate more than with the reference.
        """
        base = body_accelerations[self._cluster.base]
        right = [
            pull - spatial_dot(wrench, base)
            for pull, wrench in zip(self._net_forces, self._wrenches, strict=True)
        ]
        x = self._factorization.solve(right)
        for i, row in self._gamma.items():
            yield i, dot(row, x)
