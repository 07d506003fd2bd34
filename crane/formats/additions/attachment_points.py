"""Attachment points of a machine, and the distance between two of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array
from crane.description.kinematic_tree import Joint, Vector, to_vector
from crane.machine.machine import Machine

_DIFFERENCE_STEP = 1e-5  # of the fastest coordinate, for central differences


@dataclass(frozen=True)
class AttachmentPoint:
    """A point of a body.

    Attributes:
        link: A link of the body.
        point: (3,) in the link's frame [m].
    """

    link: str
    point: Vector

    def __str__(self) -> str:
        """Return it in the notation that `parse_attachment_point` reads."""
        point = ",".join(f"{value:.6g}" for value in self.point)
        return f"{self.link}:{point}" if any(self.point) else self.link

    def placement(self, machine: Machine, q: Array) -> pin.SE3:
        """Return the pose of the link's frame, moved to the point, in the world."""
        data = machine.model.createData()
        pin.forwardKinematics(machine.model, data, machine.coordinates.configuration(q))
        link_placement = pin.updateFramePlacement(machine.model, data, machine.frame(self.link))
        return link_placement * pin.SE3(np.eye(3), np.array(self.point))


def parse_attachment_point(machine: Machine, text: str) -> AttachmentPoint:
    """Parse LINK or LINK:x,y,z, metres in the link's frame.

    Raises:
        InputError: The link is unknown, or the text is malformed.
    """
    text = str(text)
    link, colon, coordinates = text.rpartition(":")
    if text in machine.tree.links or not colon:
        link, coordinates = text, "0,0,0"
    try:
        point = np.array([float(word) for word in coordinates.split(",")])
    except ValueError:
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(
            f"'{text}' is no point, write LINK or LINK:x,y,z with metres in the link's frame"
        )
    if link not in machine.tree.links:
        raise InputError(
            f"'{link}' is no link of '{machine.name}', {suggest_names(machine.tree.links, link)}"
        )
    return AttachmentPoint(link, to_vector(point))


def joints_between(machine: Machine, first_link: str, second_link: str) -> list[Joint]:
    """Return the movable joints of the tree between two links."""
    parent_joints = {joint.child: joint for joint in machine.tree.joints.values()}
    paths_to_root = []
    for link in (first_link, second_link):
        path = []
        while link in parent_joints:
            path.append(parent_joints[link])
            link = parent_joints[link].parent
        paths_to_root.append(path)
    shared = {joint.name for joint in paths_to_root[0]} & {
        joint.name for joint in paths_to_root[1]
    }
    return [
        joint
        for path in paths_to_root
        for joint in path
        if joint.is_movable and joint.name not in shared
    ]


def vector_between(machine: Machine, points: Sequence[AttachmentPoint], q: Array) -> Array:
    """Return the vector (3,) or (N, 3) from the first point to the second in the world [m].

    Args:
        machine: The machine.
        points: Two attachment points.
        q: (nq,) or (N, nq) configurations.
    """
    if q.ndim == 2:
        return np.array([vector_between(machine, points, one) for one in q])
    first, second = (point.placement(machine, q).translation for point in points)
    return np.asarray(second - first)


def lever_arm(machine: Machine, points: Sequence[AttachmentPoint], q: Array, joint: str) -> float:
    """Return the derivative of the distance of two points by an active joint: the lever arm [m].

    For a prismatic joint it is a ratio. It is computed along gamma at a closed configuration
    (nq,), by central differences.

    Raises:
        ClosureError: The configuration is singular.
    """
    gamma_column = machine.closure.gamma(q)[:, machine.active.index(joint)]
    step = _DIFFERENCE_STEP / float(np.abs(gamma_column).max())
    ahead, back = (
        np.linalg.norm(vector_between(machine, points, q + x * gamma_column))
        for x in (step, -step)
    )
    return float(ahead - back) / (2 * step)
