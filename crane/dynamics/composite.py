"""Inertias of composite bodies, combined by gamma within clusters of joints, as traced formulas.

A joint's unit acceleration moves all that hangs on it as one body, of inertia C; the wrench C s,
carried towards the world, meets the joints that carry it (Featherstone 2008, section 6.2). Columns
of one cluster are combined by gamma before they leave it, so M_A takes as many operations as it
has entries.
"""

from collections.abc import Iterator, Mapping, Sequence

from crane.closure.clusters import Cluster
from crane.closure.screws import NONE, Pair, Vector, by, carried, paired, plus
from crane.closure.traced import Bodies, Loops
from crane.codegen.scalar import Number, dot
from crane.dynamics.inertia import Inertia


class Columns:
    """What unit accelerations of a cluster's independent coordinates ask for.

    Args:
        posture: The machine's bodies.
        cluster: Which.
        gamma: (n,) of the cluster's own coordinates, by joint.
        inertias: Of all that hangs on each joint, at the origin of its body.
        rotors: (nb + 1,) rotor inertias.

    Attributes:
        mass: (n, n) what they take themselves.
        wrenches: By coordinate, what they take of the body that carries the cluster, at its
            origin.
    """

    def __init__(
        self,
        posture: Bodies,
        cluster: Cluster,
        gamma: Mapping[int, Vector],
        inertias: Mapping[int, Inertia],
        rotors: Vector,
    ):
        count = range(len(gamma[cluster.joints[0]]))
        tree: dict[int, dict[int, Number]] = {i: {} for i in cluster.joints}
        self.wrenches = [NONE for _ in count]
        for j in cluster.joints:
            wrench = inertias[j].of(posture.axes(j))
            for i, met, beyond in carriers(posture, j, wrench, cluster.base):
                tree[i][j] = tree[j][i] = met
                wrench = beyond
            tree[j][j] = tree[j][j] + rotors[j]
            self.wrenches = [plus(self.wrenches[k], by(gamma[j][k], wrench)) for k in count]
        moved = {
            i: [dot([*row.values()], [gamma[j][k] for j in row]) for k in count]
            for i, row in tree.items()
        }
        self.mass: list[Vector] = [[0.0] * len(count) for _ in count]
        for k in count:
            column = [row[k] for row in moved.values()]
            for j in range(k + 1):
                entry = dot([row[j] for row in gamma.values()], column)
                self.mass[j][k] = self.mass[k][j] = entry


def carriers(
    posture: Bodies, body: int, wrench: Pair, base: int
) -> Iterator[tuple[int, Number, Pair]]:
    """The joints that carry a wrench on a body, with its force along each.

    Yields:
        Each joint, the force, and the wrench at the origin of the body before.
    """
    while body != base:
        met = paired(posture.axes(body), wrench)
        wrench = carried(wrench, posture.arms[body])
        yield body, met, wrench
        body = posture.geometry.parents[body]


class Composite:
    """M_A = gamma^T M gamma.

    Args:
        posture: The machine's bodies.
        loops: Its loops.
        masses: Of every body mass, lever from its origin to the COM, inertia about the COM.
        rotors: (nb + 1,) rotor inertias of the joints.
        clusters: Of its joints.

    Attributes:
        mass: (n, n).
    """

    def __init__(
        self,
        posture: Bodies,
        loops: Loops,
        masses: Sequence[tuple[Number, Vector, list[Vector]]],
        rotors: Vector,
        clusters: Sequence[Cluster],
    ):
        n, parents = len(loops.active_joints), posture.geometry.parents
        inertias = {i: Inertia.rigid(*body) for i, body in enumerate(masses, start=1)}
        for i in range(len(masses), 0, -1):
            if parents[i]:
                inertias[parents[i]] = inertias[parents[i]] + inertias[i].carried(posture.arms[i])
        self.mass: list[Vector] = [[0.0] * n for _ in range(n)]
        own = {i: cluster.own(loops.active_joints) for cluster in clusters for i in cluster.joints}
        for cluster in clusters:
            here = own[cluster.joints[0]]
            gamma = {i: [loops.gamma[i][k] for k in here] for i in cluster.joints}
            columns = Columns(posture, cluster, gamma, inertias, rotors)
            for row, k in zip(columns.mass, here, strict=True):
                for entry, j in zip(row, here, strict=True):
                    self.mass[k][j] = entry
            for k, wrench in zip(here, columns.wrenches, strict=True):
                for i, met, _ in carriers(posture, cluster.base, wrench, 0):
                    for j in own[i]:
                        entry = self.mass[j][k] + loops.gamma[i][j] * met
                        self.mass[j][k] = self.mass[k][j] = entry
