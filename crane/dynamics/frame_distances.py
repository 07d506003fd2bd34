"""Distances between frames, along which springs and ropes act like joints, by Pinocchio."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.common.threads import ThreadLocal
from crane.dynamics.frame_jacobians import point_jacobian
from crane.machine import Machine

FramePair = tuple[str, str]  # names of links
MIN_LENGTH = 1e-150  # [m] under which a direction fades: the least length whose square is a number


class FrameDistances:
    """Distances l = |p_2 - p_1| of pairs of frames, and how the joints change them.

    l' = u . (p_2' - p_1') with u = (p_2 - p_1) / l, so a force F along l acts on the joints with
    F dl/dv. Where the frames meet there is no direction: u is taken as zero, and so is what acts
    along it.

    The same stands as formulas in `DynamicsFormulas._lengths` of
    `crane.dynamics.dynamics_formulas`, where it goes by wrenches; each is what checks the other.

    Args:
        machine: The machine.
        pairs: Two links each.

    Attributes:
        pairs: The same.
        end_points: For each pair the joints (of Pinocchio's model) that move the frames, 0 for the
            world, and where the frames' origins are in those joints' frames (3,) [m].
    """

    def __init__(self, machine: Machine, pairs: Sequence[FramePair]):
        self.pairs, self._coordinates = tuple(pairs), machine.coordinates
        frames = machine.model.frames
        self.end_points = [
            [
                (int(frames[i].parentJoint), frames[i].placement.translation.copy())
                for i in map(machine.frame, pair)
            ]
            for pair in self.pairs
        ]
        if self.pairs:
            self._model = pin.Model(machine.model)
            self._workspace = ThreadLocal(self._model.createData)

    def evaluate(self, q: Array) -> tuple[Array, Array]:
        """Lengths and their slopes.

        Args:
            q: (nv,) or (N, nv) [m], [rad].

        Returns:
            l (m,) or (N, m) [m], and dl/dv (m, nv) or (N, m, nv).
        """
        count = len(self.pairs)
        lengths = np.empty((*q.shape[:-1], count))
        jacobians = np.zeros((*q.shape[:-1], count, q.shape[-1]))
        if not count:
            return lengths, jacobians
        for i in np.ndindex(q.shape[:-1]):
            configuration = self._coordinates.configuration(q[i])
            pin.computeJointJacobians(self._model, self._workspace.value, configuration)
            for k, (one, two) in enumerate(self.end_points):
                (p1, j1), (p2, j2) = self._point(*one), self._point(*two)
                vector = p2 - p1
                lengths[(*i, k)] = length = float(np.linalg.norm(vector))
                jacobians[(*i, k)] = vector / max(length, MIN_LENGTH) @ (j2 - j1)
        return lengths, jacobians

    def _point(self, joint: int, local_point: Array) -> tuple[Array, Array]:
        """A point of a body in the world (3,), and its velocities by the joints' (3, nv)."""
        if not joint:
            return local_point, np.zeros((3, self._model.nv))
        data = self._workspace.value
        point: Array = data.oMi[joint].act(local_point)
        return point, point_jacobian(self._model, data, joint, local_point)[:3]
