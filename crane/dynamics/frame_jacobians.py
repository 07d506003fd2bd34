"""How frames of the tree move with its joints, by Pinocchio."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.common.threads import ThreadLocal
from crane.machine import Machine


class FrameJacobians:
    """Jacobians of links, posture by posture.

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
        """Take up a posture (nq,), in this thread."""
        configuration = self._machine.coordinates.configuration(q)
        pin.computeJointJacobians(self._model, self._data, configuration)

    def frame_origins(self, q: Array, links: Sequence[str]) -> Array:
        """(N, k, 3) of the origins of k links' frames in the world, at postures (N, nq) [m]."""
        placements = [self._frame_placement(link) for link in links]
        joints = [joint for joint, _ in placements]
        local_origins = np.array([placement.translation for _, placement in placements]).reshape(
            -1, 3
        )
        rotations, origins = (
            np.empty((len(q), len(placements), 3, 3)),
            np.empty((len(q), len(placements), 3)),
        )
        configuration = self._machine.coordinates.configuration
        for i, posture in enumerate(q):
            pin.forwardKinematics(self._model, self._data, configuration(posture))
            for k, joint in enumerate(joints):
                placed = self._data.oMi[joint]
                rotations[i, k], origins[i, k] = placed.rotation, placed.translation
        return np.asarray(origins + np.einsum("ikab,kb->ika", rotations, local_origins))

    def frame_pose(self, link: str) -> pin.SE3:
        """Of a link's frame in the world, at the posture."""
        joint, placement = self._frame_placement(link)
        return self._data.oMi[joint] * placement

    def jacobian(self, link: str) -> Array:
        """(6, nv) velocity of a frame's origin and angular velocity, in the world's axes."""
        joint, placement = self._frame_placement(link)
        if not joint:
            return np.zeros((6, self._model.nv))
        return point_jacobian(self._model, self._data, joint, placement.translation)

    def _frame_placement(self, link: str) -> tuple[int, pin.SE3]:
        frame = self._model.frames[self._machine.frame(link)]
        return int(frame.parentJoint), frame.placement


def point_jacobian(model: pin.Model, data: pin.Data, joint: int, point: Array) -> Array:
    """(6, nv) of a point of a body, which the joints' Jacobians of `data` are computed for.

    Args:
        model: The tree.
        data: Its data.
        joint: Pinocchio's, that moves the body.
        point: (3,) of the point in its frame [m].

    Returns:
        Of the point's velocity and the body's angular velocity, in the world's axes.
    """
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    # of a single joint it is a vector
    columns: Array = pin.getJointJacobian(model, data, joint, world).reshape(6, -1).copy()
    columns[:3] -= pin.skew(data.oMi[joint].rotation @ point) @ columns[3:]
    return columns
