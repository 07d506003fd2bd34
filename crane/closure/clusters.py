"""Clusters: joints that loops and couplings tie together, and what hangs on them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from crane.closure.equations import LoopEquations


@dataclass(frozen=True)
class Cluster:
    """Joints none of which moves without others of them moving, or one joint alone.

    The joints form a connected part of the tree; two clusters share no joint, so the clusters form
    a tree themselves.

    Attributes:
        base: The body that carries them.
        joints: Their numbers, parents first; body i is moved by joint i.
    """

    base: int
    joints: tuple[int, ...]

    def own(self, active_joints: Sequence[int]) -> list[int]:
        """Which of the active joints are its own."""
        return [k for k, joint in enumerate(active_joints) if joint in self.joints]


def clusters_of(equations: LoopEquations) -> list[Cluster]:
    """The clusters of a machine, each behind the one that carries it."""
    ties = (np.flatnonzero(row) + 1 for row in (*equations.sign, *equations.factors))
    return clusters(equations.coordinates.parents, (tie.tolist() for tie in ties if len(tie)))


def clusters(parents: Sequence[int], ties: Iterable[Iterable[int]]) -> list[Cluster]:
    """The clusters of a tree, each behind the one that carries it.

    What lies on the way between tied joints belongs to them.

    Args:
        parents: (nb + 1,) parent body of every body; 0 is the world.
        ties: Sets of joints that an equation ties together.
    """
    leader = list(range(len(parents)))

    def led(i: int) -> int:
        while leader[i] != i:
            i = leader[i]
        return i

    for tie in ties:
        first, *rest = _hull(parents, set(tie))
        for joint in rest:
            one, two = sorted((led(first), led(joint)))
            leader[two] = one
    members: dict[int, list[int]] = {}
    for i in range(1, len(parents)):
        members.setdefault(led(i), []).append(i)
    return [Cluster(parents[joints[0]], tuple(joints)) for joints in members.values()]


def _hull(parents: Sequence[int], joints: set[int]) -> list[int]:
    """The joints and those between them."""
    ways = [_way(parents, parents[joint]) for joint in joints]
    common = set(ways[0]).intersection(*ways[1:])
    between = {body for way in ways for body in way if body not in common}
    return sorted(joints | between)


def _way(parents: Sequence[int], body: int) -> list[int]:
    """A body and all that carry it, the world last."""
    way = [body]
    while way[-1]:
        way.append(parents[way[-1]])
    return way
