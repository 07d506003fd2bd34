"""The mass matrix of the active joints from composite bodies, as traced formulas.

A joint's unit acceleration moves all that hangs on it as one body, of inertia C; the wrench C s,
carried towards the world, meets the joints that carry it (Featherstone 2008, section 6.2). Columns
of one cluster are combined by gamma before they leave it, so M_A takes as many operations as it
has entries.
"""

from collections.abc import Sequence

from crane.closure.clusters import Cluster
from crane.closure.traced import Bodies, Loops
from crane.codegen.scalar import Number, dot
from crane.dynamics.inertia import Inertia, Pair, Vector, by, carried, paired, plus
from crane.dynamics.moving import NONE


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
        self._posture, self._gamma, self._rotors = posture, loops.gamma, rotors
        n, self._parents = len(loops.active_joints), posture.geometry.parents
        self._inertias = [Inertia.rigid(*body) for body in masses]
        for i in range(len(masses), 0, -1):
            if parent := self._parents[i]:
                here = self._inertias[i - 1].carried(posture.arms[i])
                self._inertias[parent - 1] = self._inertias[parent - 1] + here
        self.mass: list[Vector] = [[0.0] * n for _ in range(n)]
        self._own = {
            i: [k for k, joint in enumerate(loops.active_joints) if joint in cluster.joints]
            for cluster in clusters
            for i in cluster.joints
        }
        for cluster in clusters:
            self._add(cluster)

    def _add(self, cluster: Cluster) -> None:
        """The columns of one cluster."""
        own = self._own[cluster.joints[0]]
        tree: dict[int, dict[int, Number]] = {i: {} for i in cluster.joints}
        leaving: list[Pair] = [NONE] * len(own)
        for j in cluster.joints:
            wrench = self._inertias[j - 1].of(self._posture.axes(j))
            body = j
            while body != cluster.base:
                tree[body][j] = tree[j][body] = self._met(body, wrench)
                wrench, body = carried(wrench, self._posture.arms[body]), self._parents[body]
            tree[j][j] = tree[j][j] + self._rotors[j]
            leaving = [
                plus(old, by(self._gamma[j][k], wrench))
                for old, k in zip(leaving, own, strict=True)
            ]
        for k, wrench in zip(own, leaving, strict=True):
            moved = {
                i: dot([*row.values()], [self._gamma[j][k] for j in row])
                for i, row in tree.items()
            }
            self._enter(k, moved, own)
            self._enter(k, self._carry(cluster.base, wrench), ())

    def _carry(self, body: int, wrench: Pair) -> dict[int, Number]:
        """What a wrench on a body does along the joints that carry it."""
        met: dict[int, Number] = {}
        while body:
            met[body] = self._met(body, wrench)
            wrench, body = carried(wrench, self._posture.arms[body]), self._parents[body]
        return met

    def _met(self, body: int, wrench: Pair) -> Number:
        return paired(self._posture.axes(body), wrench)

    def _enter(self, k: int, along: dict[int, Number], own: Sequence[int]) -> None:
        """Add forces along joints to column k; those of the same cluster are all there."""
        for i, force in along.items():
            for j in self._own[i]:
                if own and j > k:
                    continue  # by symmetry
                entry = self.mass[j][k] + self._gamma[i][j] * force
                self.mass[j][k] = self.mass[k][j] = entry
