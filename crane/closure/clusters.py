"""Clusters: joints that loops and couplings tie together."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from crane.closure.loop_equations import LoopEquations


@dataclass(frozen=True)
class Cluster:
    """Joints that only move together, or a single joint.

    The joints form a connected part of the tree. No joint is in two clusters, so that the clusters
    form a tree as well.

    Attributes:
        base: The body that carries the cluster.
        joints: Indices of the joints, parents first; joint i moves body i.
    """

    base: int
    joints: tuple[int, ...]

    def own_coordinates(self, active_joints: Sequence[int]) -> list[int]:
        """Indices k of the active joints that belong to the cluster."""
        return [k for k, joint in enumerate(active_joints) if joint in self.joints]


def find_clusters(equations: LoopEquations) -> list[Cluster]:
    """The clusters of a machine, each after the one that carries it."""
    coupled_joints = (
        np.flatnonzero(row) + 1 for row in (*equations.sign, *equations.coupling_factors)
    )
    return group_into_clusters(
        equations.coordinates.parents, (tie.tolist() for tie in coupled_joints if len(tie))
    )


def group_into_clusters(
    parents: Sequence[int], coupled_joints: Iterable[Iterable[int]]
) -> list[Cluster]:
    """The clusters of a tree, each after the one that carries it.

    Joints on the path between tied joints belong to the cluster as well.

    Args:
        parents: (nb + 1,) parent body of every body; 0 is the world.
        coupled_joints: Sets of joints that one equation ties together.
    """
    representative = list(range(len(parents)))

    def root_of(i: int) -> int:
        while representative[i] != i:
            i = representative[i]
        return i

    for tie in coupled_joints:
        first, *rest = _joints_between(parents, set(tie))
        for joint in rest:
            one, two = sorted((root_of(first), root_of(joint)))
            representative[two] = one
    members: dict[int, list[int]] = {}
    for i in range(1, len(parents)):
        members.setdefault(root_of(i), []).append(i)
    return [Cluster(parents[joints[0]], tuple(joints)) for joints in members.values()]


def _joints_between(parents: Sequence[int], joints: set[int]) -> list[int]:
    """Some joints and all joints on the paths between them."""
    paths = [_path_to_world(parents, parents[joint]) for joint in joints]
    common = set(paths[0]).intersection(*paths[1:])
    return sorted(joints | {body for way in paths for body in way if body not in common})


def _path_to_world(parents: Sequence[int], body: int) -> list[int]:
    """A body and all bodies that carry it, up to the world."""
    path = [body]
    while path[-1]:
        path.append(parents[path[-1]])
    return path
