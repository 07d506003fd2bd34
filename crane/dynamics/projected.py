"""A cluster of joints that gives way by its independent coordinates; see `recursion`."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from crane.closure.clusters import Cluster
from crane.codegen.factors import Positive
from crane.codegen.scalar import Number, add, dot, scale
from crane.dynamics.inertia import Inertia, Pair, by, halved, paired, plus, shifted
from crane.dynamics.moving import NONE, Hung, Moving


class Projected:
    """A cluster that gives way by its independent coordinates.

    With W_b the motion of body b per unit of these,

        D = sum W_b^T I_b W_b,  U = sum I_b W_b,  u = tau - sum W_b^T p_b
        I = sum I_b - U D^-1 U^T,  p = sum p_b + U D^-1 u

    all referred to the origin of the body that the cluster hangs on.

    Args:
        moving: The machine.
        cluster: Which.
        hung: What hangs on its bodies.

    Attributes:
        inertia: I.
        bias: p.
    """

    def __init__(self, moving: Moving, cluster: Cluster, hung: Hung):
        self._moving, self._cluster = moving, cluster
        loops = moving.loops
        own = [k for k, joint in enumerate(loops.active_joints) if joint in cluster.joints]
        self._gamma = {i: [loops.gamma[i][k] for k in own] for i in cluster.joints}
        links = list(self._links(hung))
        answers = [[link.inertia.of(way) for way in link.ways] for link in links]
        columns = [plus(NONE, *(answer[k] for answer in answers)) for k in range(len(own))]
        self._factors = Positive(
            [[self._mass(links, answers, k, j) for j in range(k + 1)] for k in range(len(own))]
        )
        pull = [self._pull(links, k) for k in range(len(own))]
        self._columns, self._pulls = columns, pull
        inertia = functools.reduce(Inertia.__add__, (link.inertia for link in links))
        self.inertia = inertia.less(halved(self._factors, columns), self._factors.inverse)
        given = [by(x, u) for x, u in zip(self._factors.solve(pull), columns, strict=True)]
        self.bias = plus(*(link.wrench for link in links), *given)

    def _links(self, hung: Hung) -> Iterator["_Link"]:
        """The bodies as seen from the cluster's base."""
        moving, base = self._moving, self._cluster.base
        still = [NONE] * len(next(iter(self._gamma.values())))
        arms, ways = {base: NONE[0]}, {base: still}
        for i, factors in self._gamma.items():
            parent = moving.posture.geometry.parents[i]
            arms[i] = add(arms[parent], moving.posture.arms[i])
            axis = shifted(moving.axis(i), scale(-1.0, arms[i]))
            ways[i] = [
                plus(way, by(x, axis)) for way, x in zip(ways[parent], factors, strict=True)
            ]
            yield _Link(ways[i], *moving.all_on(i, arms[i], hung))

    def _mass(
        self, links: "Sequence[_Link]", answers: Sequence[Sequence[Pair]], k: int, j: int
    ) -> Number:
        """An entry of D."""
        total: Number = 0.0
        for link, answer in zip(links, answers, strict=True):
            total = total + paired(answer[j], link.ways[k])
        for i, row in self._gamma.items():
            total = total + self._moving.rotors[i] * row[k] * row[j]
        return total

    def _pull(self, links: "Sequence[_Link]", k: int) -> Number:
        """An entry of u."""
        total: Number = 0.0
        for i, row in self._gamma.items():
            total = total + self._moving.force(i) * row[k]
        for link in links:
            total = total - paired(link.wrench, link.ways[k])
        return total

    def rates(self, bodies: Sequence[Pair]) -> Iterator[tuple[int, Number]]:
        """What the joints accelerate more, by joint, from what the body that carries them does.

        Args:
            bodies: What all bodies accelerate more than with the reference.
        """
        base = bodies[self._cluster.base]
        right = [
            pull - paired(column, base)
            for pull, column in zip(self._pulls, self._columns, strict=True)
        ]
        x = self._factors.solve(right)
        for i, row in self._gamma.items():
            yield i, dot(row, x)


@dataclass(frozen=True)
class _Link:
    """A body of a cluster, referred to the cluster's base; see `Projected`.

    Attributes:
        ways: W_b, by column.
        inertia: I_b.
        wrench: p_b.
    """

    ways: list[Pair]
    inertia: Inertia
    wrench: Pair
