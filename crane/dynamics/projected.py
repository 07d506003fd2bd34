"""A cluster of joints that gives way by its independent coordinates; see `recursion`."""

from collections.abc import Iterator, Sequence

from crane.closure.clusters import Cluster
from crane.closure.screws import Pair, by, carried, paired, plus
from crane.codegen.factors import Positive
from crane.codegen.scalar import Number, dot
from crane.dynamics.composite import Columns
from crane.dynamics.inertia import Inertia, halved
from crane.dynamics.moving import Hung, Moving, hang


class Projected:
    """A cluster that gives way by its independent coordinates.

    With W_b the motion of body b per unit of these,

        D = sum W_b^T I_b W_b,  U = sum I_b W_b,  u = tau - sum W_b^T p_b
        I = sum I_b - U D^-1 U^T,  p = sum p_b + U D^-1 u

    all referred to the origin of the body that the cluster hangs on. The sums are those of
    composite bodies, whose wrenches gamma projects.

    Args:
        moving: The machine.
        cluster: Which.
        hung: What hangs on its bodies.

    Attributes:
        inertia: I.
        bias: p.
    """

    def __init__(self, moving: Moving, cluster: Cluster, hung: Hung):
        self._cluster, loops, posture = cluster, moving.loops, moving.posture
        own = cluster.own(loops.active_joints)
        self._gamma = {i: [loops.gamma[i][k] for k in own] for i in cluster.joints}
        inside = {i: hung[i] for i in cluster.joints if i in hung}
        inertias: dict[int, Inertia] = {}
        self._pull: list[Number] = [0.0] * len(own)
        for i in reversed(cluster.joints):
            inertia, wrench = moving.all_on(i, inside)
            inertias[i], arm = inertia, posture.arms[i]
            force = moving.force(i) - paired(posture.axes(i), wrench)
            self._pull = [
                old + factor * force
                for old, factor in zip(self._pull, self._gamma[i], strict=True)
            ]
            hang(inside, posture.geometry.parents[i], inertia.carried(arm), carried(wrench, arm))
        columns = Columns(posture, cluster, self._gamma, inertias, moving.rotors)
        self._factors, self._wrenches = Positive(columns.mass), columns.wrenches
        inertia, bias = inside[cluster.base]
        self.inertia = inertia.less(halved(self._factors, self._wrenches), self._factors.inverse)
        found = self._factors.solve(self._pull)
        self.bias = plus(bias, *(by(x, u) for x, u in zip(found, self._wrenches, strict=True)))

    def rates(self, bodies: Sequence[Pair]) -> Iterator[tuple[int, Number]]:
        """What the joints accelerate more, by joint, from what the body that carries them does.

        Args:
            bodies: What all bodies accelerate more than with the reference.
        """
        base = bodies[self._cluster.base]
        right = [
            pull - paired(wrench, base)
            for pull, wrench in zip(self._pull, self._wrenches, strict=True)
        ]
        x = self._factors.solve(right)
        for i, row in self._gamma.items():
            yield i, dot(row, x)
