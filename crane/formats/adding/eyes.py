"""Points of a machine between which something is put, and how far apart they are."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.common.errors import InputError, known
from crane.common.samples import Array
from crane.description.rigid import vector
from crane.description.tree import Joint, Vector
from crane.machine import Machine

_NEAR = 1e-5  # of the fastest coordinate, over which distances are differentiated


@dataclass(frozen=True)
class Eye:
    """A point of a body.

    Attributes:
        link: A link of the body.
        point: (3,) in the link's frame [m].
    """

    link: str
    point: Vector

    def __str__(self) -> str:
        """As it is written."""
        point = ",".join(f"{value:.6g}" for value in self.point)
        return f"{self.link}:{point}" if any(self.point) else self.link

    def place(self, machine: Machine, q: Array) -> pin.SE3:
        """Of the link's frame, moved to the point, in the world."""
        data = machine.model.createData()
        pin.forwardKinematics(machine.model, data, machine.coordinates.configuration(q))
        frame = pin.updateFramePlacement(machine.model, data, machine.frame(self.link))
        return frame * pin.SE3(np.eye(3), np.array(self.point))


def eye_of(machine: Machine, text: str) -> Eye:
    """An eye as it is written: LINK, or LINK:x,y,z with metres in the link's frame.

    Raises:
        InputError: There is no such link, or that is no point.
    """
    text = str(text)
    link, colon, numbers = text.rpartition(":")
    if text in machine.tree.links or not colon:
        link, numbers = text, "0,0,0"
    try:
        point = np.array([float(word) for word in numbers.split(",")])
    except ValueError:
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(
            f"'{text}' is no point, write LINK or LINK:x,y,z with metres in the link's frame"
        )
    if link not in machine.tree.links:
        raise InputError(
            f"'{link}' is no link of '{machine.name}', {known(machine.tree.links, link)}"
        )
    return Eye(link, vector(point))


def path_between(machine: Machine, one: str, two: str) -> list[Joint]:
    """The moving joints of the tree between two links."""
    above = {joint.child: joint for joint in machine.tree.joints.values()}
    ways = []
    for link in (one, two):
        way = []
        while link in above:
            way.append(above[link])
            link = above[link].parent
        ways.append(way)
    shared = {joint.name for joint in ways[0]} & {joint.name for joint in ways[1]}
    return [joint for way in ways for joint in way if joint.moves and joint.name not in shared]


def apart(machine: Machine, eyes: Sequence[Eye], q: Array) -> Array:
    """(3,) or (N, 3) from the first eye to the second in the world [m].

    Args:
        machine: Whose they are.
        eyes: Two of them.
        q: (nq,) or (N, nq) postures.
    """
    if q.ndim == 2:
        return np.array([apart(machine, eyes, one) for one in q])
    one, two = (eye.place(machine, q).translation for eye in eyes)
    return np.asarray(two - one)


def lever(machine: Machine, eyes: Sequence[Eye], q: Array, joint: str) -> float:
    """Change of the distance of two eyes with an active joint: the lever arm [m], or a ratio.

    The derivative along gamma at a closed posture (nq,), by central differences.

    Raises:
        ClosureError: The joint does not tell the posture there.
    """
    way = machine.closure.gamma(q)[:, machine.active.index(joint)]
    step = _NEAR / float(np.abs(way).max())
    ahead, back = (np.linalg.norm(apart(machine, eyes, q + x * way)) for x in (step, -step))
    return float(ahead - back) / (2 * step)
