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
        frames = [self._machine.frame(link) for link in links]
        out = np.empty((len(q), len(frames), 3))
        for i, at in enumerate(self._machine.coordinates.configuration(q)):
            pin.forwardKinematics(self._model, self._data, at)
            for k, frame in enumerate(frames):
                out[i, k] = pin.updateFramePlacement(self._model, self._data, frame).translation
        return out

    def frame_pose(self, link: str) -> pin.SE3:
        """Pose of a link's frame in the world."""
        frame = self._machine.frame(link)
        return pin.updateFramePlacement(self._model, self._data, frame).copy()

    def jacobian(self, link: str) -> Array:
        """(6, nv) Jacobian of a frame's origin and angular velocity, in the world's axes."""
        return frame_jacobian(self._model, self._data, self._machine.frame(link))


def frame_jacobian(model: pin.Model, data: pin.Data, frame: int) -> Array:
    """Jacobian (6, nv) of a frame, from the joint Jacobians in `data`.

    Args:
        model: The tree.
        data: Its data.
        frame: Index of the frame.

    Returns:
        Rows of the velocity of its origin and of its angular velocity, in the world's axes.
    """
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    # a vector if the model has a single joint
    return np.asarray(pin.getFrameJacobian(model, data, frame, world).reshape(6, -1))


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
        self.pairs = tuple(pairs)
        placements = [[frame_placement(machine, link) for link in pair] for pair in self.pairs]
        self.end_points = [
            [(joint, placement.translation) for joint, placement in pair] for pair in placements
        ]
        if self.pairs:
            self._jacobians = FrameJacobians(machine)

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
        frames = self._jacobians
        for i in np.ndindex(q.shape[:-1]):
            frames.set_configuration(q[i])
            for k, (one, two) in enumerate(self.pairs):
                vector = frames.frame_pose(two).translation - frames.frame_pose(one).translation
                lengths[(*i, k)] = length = float(np.linalg.norm(vector))
                rates = frames.jacobian(two)[:3] - frames.jacobian(one)[:3]
                jacobians[(*i, k)] = vector / max(length, MIN_LENGTH) @ rates
        return lengths, jacobians
