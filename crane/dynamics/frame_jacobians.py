"""Poses, Jacobians and distances of frames of the tree, with Pinocchio."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.common.threads import ThreadLocal
from crane.machine.machine import Machine


def frame_placement(machine: Machine, link: str) -> tuple[int, pin.SE3]:
    """Pinocchio's joint that moves a link's frame, and the placement of the frame in it."""
    frame = machine.model.frames[machine.frame(link)]
    return int(frame.parentJoint), frame.placement.copy()


class FrameJacobians:
    """Poses and Jacobians of links at one configuration at a time.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine):
        self._machine, self._model = machine, pin.Model(machine.model)
        self._workspace = ThreadLocal(self._model.createData)

    @property
    def _data(self) -> pin.Data:
        return self._workspace.value

    def set_configuration(self, q: Array) -> None:
        """Evaluate at a configuration (nq,), in this thread."""
        pin.computeJointJacobians(
            self._model, self._data, self._machine.coordinates.configuration(q)
        )

    def frame_origins(self, q: Array, links: Sequence[str]) -> Array:
        """Origins (N, k, 3) of k links' frames in the world, at configurations (N, nq) [m]."""
        placements = [frame_placement(self._machine, link) for link in links]
        joints = [joint for joint, _ in placements]
        local_origins = np.array([placement.translation for _, placement in placements]).reshape(
            -1, 3
        )
        rotations, origins = (
            np.empty((len(q), len(placements), 3, 3)),
            np.empty((len(q), len(placements), 3)),
        )
        configuration = self._machine.coordinates.configuration
        for i, one in enumerate(q):
            pin.forwardKinematics(self._model, self._data, configuration(one))
            for k, joint in enumerate(joints):
                placed = self._data.oMi[joint]
                rotations[i, k], origins[i, k] = placed.rotation, placed.translation
        return np.asarray(origins + np.einsum("ikab,kb->ika", rotations, local_origins))

    def frame_pose(self, link: str) -> pin.SE3:
        """Pose of a link's frame in the world."""
        joint, placement = frame_placement(self._machine, link)
        return self._data.oMi[joint] * placement

    def jacobian(self, link: str) -> Array:
        """(6, nv) Jacobian of a frame's origin and angular velocity, in the world's axes."""
        joint, placement = frame_placement(self._machine, link)
        if not joint:
            return np.zeros((6, self._model.nv))
        return point_jacobian(self._model, self._data, joint, placement.translation)


def point_jacobian(model: pin.Model, data: pin.Data, joint: int, point: Array) -> Array:
    """Jacobian (6, nv) of a point of a body, from the joint Jacobians in `data`.

    Args:
        model: The tree.
        data: Its data.
        joint: Pinocchio's joint that moves the body.
        point: (3,) the point in the joint's frame [m].

    Returns:
        Rows of the point's velocity and the body's angular velocity, in the world's axes.
    """
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    # a vector if the model has a single joint
    columns: Array = pin.getJointJacobian(model, data, joint, world).reshape(6, -1).copy()
    columns[:3] -= pin.skew(data.oMi[joint].rotation @ point) @ columns[3:]
    return columns


FramePair = tuple[str, str]  # names of links
MIN_LENGTH = 1e-150  # [m] below which a distance has no direction: the square must not underflow


class FrameDistances:
    """Distances l = |p_2 - p_1| of pairs of frames, and their derivatives.

    l' = u . (p_2' - p_1') with u = (p_2 - p_1) / l, so that a force F along l acts on the joints
    with F dl/dv. Where the frames coincide there is no direction: u is taken as zero.

    `DynamicsFormulas` of `crane.dynamics.dynamics_formulas` has the same as formulas, with
    wrenches; each checks the other.

    Args:
        machine: The machine.
        pairs: Names of two links each.

    Attributes:
        pairs: Names of two links each.
        end_points: For each pair Pinocchio's joints that move the frames, 0 for the world, and the
            origins of the frames in the joints' frames (3,) [m].
    """

    def __init__(self, machine: Machine, pairs: Sequence[FramePair]):
        self.pairs, self._coordinates = tuple(pairs), machine.coordinates
        placements = [[frame_placement(machine, link) for link in pair] for pair in self.pairs]
        self.end_points = [
            [(joint, placement.translation) for joint, placement in pair] for pair in placements
        ]
        if self.pairs:
            self._model = pin.Model(machine.model)
            self._workspace = ThreadLocal(self._model.createData)

    def evaluate(self, q: Array) -> tuple[Array, Array]:
        """Lengths and their derivatives.

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
            pin.computeJointJacobians(
                self._model, self._workspace.value, self._coordinates.configuration(q[i])
            )
            for k, (one, two) in enumerate(self.end_points):
                (p1, j1), (p2, j2) = self._point(*one), self._point(*two)
                vector = p2 - p1
                lengths[(*i, k)] = length = float(np.linalg.norm(vector))
                jacobians[(*i, k)] = vector / max(length, MIN_LENGTH) @ (j2 - j1)
        return lengths, jacobians

    def _point(self, joint: int, local_point: Array) -> tuple[Array, Array]:
        """A point of a body in the world (3,), and its Jacobian (3, nv)."""
        if not joint:
            return local_point, np.zeros((3, self._model.nv))
        data = self._workspace.value
        point: Array = data.oMi[joint].act(local_point)
        return point, point_jacobian(self._model, data, joint, local_point)[:3]
