"""Inertias of composite bodies, combined by gamma within clusters of joints, as traced formulas.

A joint's unit acceleration moves all that hangs on it as one body, of inertia C; the wrench C s,
carried towards the world, meets the joints that carry it (Featherstone 2008, section 6.2). Columns
of one cluster are combined by gamma before they leave it, so M_A takes as many operations as it
has entries.
"""

from collections.abc import Iterator, Mapping, Sequence

from crane.closure.clusters import Cluster
from crane.closure.kinematics_formulas import LoopFormulas, PositionKinematics
from crane.closure.spatial_vectors import (
    ZERO_VECTOR,
    SpatialVector,
    Vector,
    add_spatial,
    scale_spatial,
    shift_wrench,
    spatial_dot,
)
from crane.codegen.symbolic import Scalar, dot
from crane.dynamics.spatial_inertia import SpatialInertia


class ClusterMassColumns:
    """What unit accelerations of a cluster's independent coordinates ask for.

    Args:
        kinematics: The machine's bodies.
        cluster: Which.
        gamma: (n,) of the cluster's own coordinates, by joint.
        composite_inertias: Of all that hangs on each joint, at the origin of its body.
        rotor_inertias: (nb + 1,) rotor inertias.

    Attributes:
        mass_block: (n, n) what they take themselves.
        base_wrenches: By coordinate, what they take of the body that carries the cluster, at its
            origin.
    """

    def __init__(
        self,
        kinematics: PositionKinematics,
        cluster: Cluster,
        gamma: Mapping[int, Vector],
        composite_inertias: Mapping[int, SpatialInertia],
        rotor_inertias: Vector,
    ):
        count = range(len(gamma[cluster.joints[0]]))
        tree: dict[int, dict[int, Scalar]] = {i: {} for i in cluster.joints}
        self.base_wrenches = [ZERO_VECTOR for _ in count]
        for j in cluster.joints:
            wrench = composite_inertias[j].apply_to(kinematics.body_motion_axes(j))
            for i, met, beyond in propagate_wrench(kinematics, j, wrench, cluster.base):
                tree[i][j] = tree[j][i] = met
                wrench = beyond
            tree[j][j] = tree[j][j] + rotor_inertias[j]
            self.base_wrenches = [
                add_spatial(self.base_wrenches[k], scale_spatial(gamma[j][k], wrench))
                for k in count
            ]
        moved = {
            i: [dot([*row.values()], [gamma[j][k] for j in row]) for k in count]
            for i, row in tree.items()
        }
        self.mass_block: list[Vector] = [[0.0] * len(count) for _ in count]
        for k in count:
            column = [row[k] for row in moved.values()]
            for j in range(k + 1):
                entry = dot([row[j] for row in gamma.values()], column)
                self.mass_block[j][k] = self.mass_block[k][j] = entry


def propagate_wrench(
    kinematics: PositionKinematics, body: int, wrench: SpatialVector, base: int
) -> Iterator[tuple[int, Scalar, SpatialVector]]:
    """The joints that carry a wrench on a body, with its force along each.

    Yields:
        Each joint, the force, and the wrench at the origin of the body before.
    """
    while body != base:
        joint_force = spatial_dot(kinematics.body_motion_axes(body), wrench)
        wrench = shift_wrench(wrench, kinematics.offsets[body])
        yield body, joint_force, wrench
        body = kinematics.geometry.parents[body]


class CompositeMassMatrix:
    """M_A = gamma^T M gamma.

    Args:
        kinematics: The machine's bodies.
        loops: Its loops.
        body_inertias: Of every body mass, lever from its origin to the COM, inertia about the COM.
        rotor_inertias: (nb + 1,) rotor inertias of the joints.
        clusters: Of its joints.

    Attributes:
        mass_matrix: (n, n).
    """

    def __init__(
        self,
        kinematics: PositionKinematics,
        loops: LoopFormulas,
        body_inertias: Sequence[tuple[Scalar, Vector, list[Vector]]],
        rotor_inertias: Vector,
        clusters: Sequence[Cluster],
    ):
        n, parents = len(loops.active_joints), kinematics.geometry.parents
        inertias = {
            i: SpatialInertia.rigid_body(*body) for i, body in enumerate(body_inertias, start=1)
        }
        for i in range(len(body_inertias), 0, -1):
            if parents[i]:
                inertias[parents[i]] = inertias[parents[i]] + inertias[i].shift_origin(
                    kinematics.offsets[i]
                )
        self.mass_matrix: list[Vector] = [[0.0] * n for _ in range(n)]
        coordinates_of_joint = {
            i: cluster.own_coordinates(loops.active_joints)
            for cluster in clusters
            for i in cluster.joints
        }
        for cluster in clusters:
            coordinates = coordinates_of_joint[cluster.joints[0]]
            gamma = {i: [loops.gamma[i][k] for k in coordinates] for i in cluster.joints}
            columns = ClusterMassColumns(kinematics, cluster, gamma, inertias, rotor_inertias)
            for row, k in zip(columns.mass_block, coordinates, strict=True):
                for entry, j in zip(row, coordinates, strict=True):
                    self.mass_matrix[k][j] = entry
            for k, wrench in zip(coordinates, columns.base_wrenches, strict=True):
                for i, met, _ in propagate_wrench(kinematics, cluster.base, wrench, 0):
                    for j in coordinates_of_joint[i]:
                        entry = self.mass_matrix[j][k] + loops.gamma[i][j] * met
                        self.mass_matrix[j][k] = self.mass_matrix[k][j] = entry
