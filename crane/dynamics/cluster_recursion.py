"""Forward dynamics by recursion over clusters of joints, as traced formulas.

At a reference acceleration of the joints, inverse dynamics tells what wrenches the bodies need;
what the joints accelerate more follows from the forces. From the outermost cluster inwards, what
hangs on a body answers what it accelerates more, A = [a, e], with the wrench

    F = I A + p

whose articulated inertia I and bias p take in that everything beyond gives way; from the world
outwards the accelerations follow. The number of operations grows with the number of bodies
(Featherstone 2008, section 7.3). A cluster that loops tie together gives way as a whole, in one of
two ways which say the same:

- `ProjectedCluster`: by its independent coordinates, through gamma (Jain 2012; Chignoli et al.
2023).
  Exact whatever the masses are.
- `ArticulatedCluster`: joint by joint, with the forces of its loops as unknowns that are found
where the
  cluster hangs. Takes as many operations as it has joints, but every joint must move a mass.

Accelerations are those of the point on the joint's axis that is the origin of its body, in
directions of the trunk.
"""

import numpy as np
import pinocchio as pin

from crane.closure.clusters import Cluster, find_clusters
from crane.closure.spatial_vectors import ZERO_VECTOR, Vector
from crane.dynamics.articulated_cluster import ArticulatedCluster
from crane.dynamics.projected_cluster import ProjectedCluster
from crane.dynamics.recursion_input import (
    ArticulatedInertias,
    RecursionInput,
    add_articulated_inertia,
)
from crane.machine import Machine

RecursionPlan = tuple[tuple[Cluster, bool], ...]
_MAX_MOBILITY_WITHOUT_RECURSION = (
    4  # independent coordinates of a machine up to which its bodies' columns give M_A soonest
)
_MAX_PROJECTED_COORDINATES = (
    6  # those of a cluster up to which `ProjectedCluster` takes fewer operations
)
_LIGHT_INERTIA_RATIO = 1e-6  # of a joint's inertia: what others do not move of it


def plan_recursion(machine: Machine) -> RecursionPlan:
    """How forward dynamics goes through a machine's clusters.

    Returns:
        The clusters, each behind the one that carries it, and whether by the forces of its loops
        (`ArticulatedCluster`); none of a machine of few freedoms.
    """
    if len(machine.active) <= _MAX_MOBILITY_WITHOUT_RECURSION:
        return ()
    active = [int(column) + 1 for column in machine.closure.active]
    light_joints = _light_joints(machine)

    def by_forces(cluster: Cluster) -> bool:
        own, size = len(cluster.own_coordinates(active)), len(cluster.joints)
        if size == 1:
            return True
        # equations, as many as there are other joints, and coordinates take their squares
        return max(size - own, _MAX_PROJECTED_COORDINATES) < own and not light_joints & set(
            cluster.joints
        )

    return tuple(
        (cluster, by_forces(cluster)) for cluster in find_clusters(machine.closure.equations)
    )


def _light_joints(machine: Machine) -> set[int]:
    """Joints that move next to no mass of their own, once those beyond them give way.

    Recursion joint by joint divides by what is left of the inertia.
    """
    model = machine.model
    data = machine.closure.equations.data  # large, and there already
    mass = pin.crba(model, data, machine.coordinates.configuration(machine.home))
    pin.cholesky.decompose(model, data)
    return set((np.flatnonzero(~(_LIGHT_INERTIA_RATIO * np.diag(mass) < data.D)) + 1).tolist())


def joint_accelerations(recursion: RecursionInput, plan: RecursionPlan) -> Vector:
    """Accelerations (nb + 1,) of all joints.

    Args:
        recursion: The machine.
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
    for articulated_cluster in reversed(articulated_clusters):
        for i, rate in articulated_cluster.joint_accelerations(bodies):
            parent = recursion.kinematics.geometry.parents[i]
            out[i], bodies[i] = out[i] + rate, recursion.body_acceleration(i, bodies[parent], rate)
    return out
