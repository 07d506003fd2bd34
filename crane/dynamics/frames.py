"""How frames of the tree move with its joints, by Pinocchio."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.common.threads import PerThread
from crane.machine import Machine


class FrameJacobians:
    """Jacobians of links, posture by posture.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine):
        self._machine, self._model = machine, pin.Model(machine.model)
        self._memory = PerThread(self._model.createData)

    @property
    def _data(self) -> pin.Data:
        return self._memory.own

    def place(self, q: Array) -> None:
        """Take up a posture (nq,), in this thread."""
        configuration = self._machine.coordinates.configuration(q)
        pin.computeJointJacobians(self._model, self._data, configuration)

    def places(self, q: Array, links: Sequence[str]) -> Array:
        """(N, k, 3) of the origins of k links' frames in the world, at postures (N, nq) [m]."""
        held = [self._held(link) for link in links]
        joints = [joint for joint, _ in held]
        arms = np.array([placement.translation for _, placement in held]).reshape(-1, 3)
        turned, origins = np.empty((len(q), len(held), 3, 3)), np.empty((len(q), len(held), 3))
        configuration = self._machine.coordinates.configuration
        for i, posture in enumerate(q):
            pin.forwardKinematics(self._model, self._data, configuration(posture))
            for k, joint in enumerate(joints):
                placed = self._data.oMi[joint]
                turned[i, k], origins[i, k] = placed.rotation, placed.translation
        return np.asarray(origins + np.einsum("ikab,kb->ika", turned, arms))

    def pose(self, link: str) -> pin.SE3:
        """Of a link's frame in the world, at the posture."""
        joint, placement = self._held(link)
        return self._data.oMi[joint] * placement

    def of(self, link: str) -> Array:
        """(6, nv) velocity of a frame's origin and angular velocity, in the world's axes."""
        joint, placement = self._held(link)
        if not joint:
            return np.zeros((6, self._model.nv))
        return point_jacobian(self._model, self._data, joint, placement.translation)

    def _held(self, link: str) -> tuple[int, pin.SE3]:
        frame = self._model.frames[self._machine.frame(link)]
        return int(frame.parentJoint), frame.placement


def point_jacobian(model: pin.Model, data: pin.Data, joint: int, place: Array) -> Array:
    """(6, nv) of a point of a body, which the joints' Jacobians of `data` are computed for.

    Args:
        model: The tree.
        data: Its data.
        joint: Pinocchio's, that moves the body.
        place: (3,) of the point in its frame [m].

    Returns:
        Of the point's velocity and the body's angular velocity, in the world's axes.
    """
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    # of a single joint it is a vector
    columns: Array = pin.getJointJacobian(model, data, joint, world).reshape(6, -1).copy()
    columns[:3] -= pin.skew(data.oMi[joint].rotation @ place) @ columns[3:]
    return columns
