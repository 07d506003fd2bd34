"""Forward dynamics by recursion over clusters of joints, as traced formulas.

At a reference acceleration of the joints, inverse dynamics tells what wrenches the bodies need;
what the joints accelerate more follows from the forces. From the outermost cluster inwards, what
hangs on a body answers what it accelerates more, A = [a, e], with the wrench

    F = I A + p

whose articulated inertia I and bias p take in that everything beyond gives way; from the world
outwards the accelerations follow. The number of operations grows with the number of bodies
(Featherstone 2008, section 7.3). A cluster that loops tie together gives way as a whole, in one of
two ways which say the same:

- `Projected`: by its independent coordinates, through gamma (Jain 2012; Chignoli et al. 2023).
  Exact whatever the masses are.
- `Multiplied`: joint by joint, with the forces of its loops as unknowns that are found where the
  cluster hangs. Takes as many operations as it has joints, but every joint must move a mass.

Accelerations are those of the point on the joint's axis that is the origin of its body, in
directions of the trunk.
"""

import numpy as np
import pinocchio as pin

from crane.closure.clusters import Cluster, clusters_of
from crane.closure.screws import NONE, Vector
from crane.dynamics.moving import Hung, Moving, hang
from crane.dynamics.multiplied import Multiplied
from crane.dynamics.projected import Projected
from crane.machine import Machine

Plan = tuple[tuple[Cluster, bool], ...]
_FEW = 4  # independent coordinates of a machine up to which its bodies' columns give M_A soonest
_TIED = 6  # those of a cluster up to which `Projected` takes fewer operations
_LIGHT = 1e-6  # of a joint's inertia: what others do not move of it


def planned(machine: Machine) -> Plan:
    """How forward dynamics goes through a machine's clusters.

    Returns:
        The clusters, each behind the one that carries it, and whether by the forces of its loops
        (`Multiplied`); none of a machine of few freedoms.
    """
    if len(machine.active) <= _FEW:
        return ()
    active = [int(column) + 1 for column in machine.closure.active]
    light = _light(machine)

    def by_forces(cluster: Cluster) -> bool:
        own, size = len(cluster.own(active)), len(cluster.joints)
        if size == 1:
            return True
        # equations, as many as there are other joints, and coordinates take their squares
        return max(size - own, _TIED) < own and not light & set(cluster.joints)

    return tuple(
        (cluster, by_forces(cluster)) for cluster in clusters_of(machine.closure.equations)
    )


def _light(machine: Machine) -> set[int]:
    """Joints that move next to no mass of their own, once those beyond them give way.

    Recursion joint by joint divides by what is left of the inertia.
    """
    model = machine.model
    data = machine.closure.equations.data  # large, and there already
    mass = pin.crba(model, data, machine.coordinates.configuration(machine.home))
    pin.cholesky.decompose(model, data)
    return set((np.flatnonzero(~(_LIGHT * np.diag(mass) < data.D)) + 1).tolist())


def accelerations(moving: Moving, plan: Plan) -> Vector:
    """Accelerations (nb + 1,) of all joints.

    Args:
        moving: The machine.
        plan: See `planned`.
    """
    hung: Hung = {}
    answers: list[Projected | Multiplied] = []
    for cluster, by_forces in reversed(plan):
        answer = (Multiplied if by_forces else Projected)(moving, cluster, hung)
        answers.append(answer)
        hang(hung, cluster.base, answer.inertia, answer.bias)
    out = list(moving.reference)
    bodies = [NONE] * len(out)
    for answer in reversed(answers):
        for i, rate in answer.rates(bodies):
            parent = moving.posture.geometry.parents[i]
            out[i], bodies[i] = out[i] + rate, moving.moved(i, bodies[parent], rate)
    return out
