"""Distances between frames, along which springs and ropes act like joints, by Pinocchio."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.common.threads import PerThread
from crane.dynamics.frames import point_jacobian
from crane.machine import Machine

Pair = tuple[str, str]  # names of links
LEAST = 1e-150  # [m] under which a direction fades: the least length whose square is a number


class Lengths:
    """Distances l = |p_2 - p_1| of pairs of frames, and how the joints change them.

    l' = u . (p_2' - p_1') with u = (p_2 - p_1) / l, so a force F along l acts on the joints with
    F dl/dv. Where the frames meet there is no direction: u is taken as zero, and so is what acts
    along it.

    The same stands as formulas in `Sweep._lengths` of `crane.dynamics.traced`, where it goes by
    wrenches; each is what checks the other.

    Args:
        machine: The machine.
        pairs: Two links each.

    Attributes:
        pairs: The same.
        ends: For each pair the joints (of Pinocchio's model) that move the frames, 0 for the
            world, and where the frames' origins are in those joints' frames (3,) [m].
    """

    def __init__(self, machine: Machine, pairs: Sequence[Pair]):
        self.pairs, self._coordinates = tuple(pairs), machine.coordinates
        frames = machine.model.frames
        self.ends = [
            [
                (int(frames[i].parentJoint), frames[i].placement.translation.copy())
                for i in map(machine.frame, pair)
            ]
            for pair in self.pairs
        ]
        if self.pairs:
            self._model = pin.Model(machine.model)
            self._memory = PerThread(self._model.createData)

    def at(self, q: Array) -> tuple[Array, Array]:
        """Lengths and their slopes.

        Args:
            q: (nv,) or (N, nv) [m], [rad].

        Returns:
            l (m,) or (N, m) [m], and dl/dv (m, nv) or (N, m, nv).
        """
        count = len(self.pairs)
        lengths = np.empty((*q.shape[:-1], count))
        slopes = np.zeros((*q.shape[:-1], count, q.shape[-1]))
        if not count:
            return lengths, slopes
        for i in np.ndindex(q.shape[:-1]):
            configuration = self._coordinates.configuration(q[i])
            pin.computeJointJacobians(self._model, self._memory.own, configuration)
            for k, (one, two) in enumerate(self.ends):
                (p1, j1), (p2, j2) = self._point(*one), self._point(*two)
                way = p2 - p1
                lengths[(*i, k)] = length = float(np.linalg.norm(way))
                slopes[(*i, k)] = way / max(length, LEAST) @ (j2 - j1)
        return lengths, slopes

    def _point(self, joint: int, place: Array) -> tuple[Array, Array]:
        """A point of a body in the world (3,), and its velocities by the joints' (3, nv)."""
        if not joint:
            return place, np.zeros((3, self._model.nv))
        data = self._memory.own
        point: Array = data.oMi[joint].act(place)
        return point, point_jacobian(self._model, data, joint, place)[:3]
