"""The plane that a workspace is drawn in."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.common.shown import Brief
from crane.machine import Machine

_FLAT = 1e-7  # share of the extent that counts as none


@dataclass(frozen=True, eq=False, repr=False)
class Section(Brief):
    """Two coordinates (u, w) of the tip.

    Of a machine whose slewing joint stands upright on the ground: distance from the slewing axis
    and height; the distance has a sign where the tip stays in a plane through the axis, and
    counts forward from there. Of a tip that stays in any other plane: along two directions of the
    plane. Of any other tip: distance from the vertical through the origin, and height.

    Attributes:
        names: Of both coordinates.
        first: (3,) direction of u, where it is along one.
        second: (3,) direction of w.
        origin: (3,) a point with u = w = 0 [m].
        around: Whether u is a distance from the line through the origin along w.
        slew: Index of the slewing joint among the active ones, None where there is none.
    """

    names: tuple[str, str]
    first: Array
    second: Array
    origin: Array
    around: bool
    slew: int | None

    def coordinates(self, points: Array) -> Array:
        """(u, w) (N, 2) [m] of points (N, 3) in the world."""
        away = points - self.origin
        height = away @ self.second
        if not self.around:
            return np.column_stack([away @ self.first, height])
        across = away - height[:, None] * self.second
        return np.column_stack([np.linalg.norm(across, axis=1), height])

    def slopes(self, points: Array, jacobian: Array) -> Array:
        """d(u, w) (N, 2, n) of points (N, 3) whose own derivatives are (N, 3, n)."""
        away = points - self.origin
        first = np.broadcast_to(self.first, points.shape)
        if self.around:
            across = away - (away @ self.second)[:, None] * self.second
            length = np.linalg.norm(across, axis=1, keepdims=True)
            first = across / np.where(length > 0, length, 1.0)
        second = np.broadcast_to(self.second, points.shape)
        return np.einsum("kia,ian->ikn", np.array([first, second]), jacobian)


def upwards(machine: Machine) -> Array:
    """(3,) unit vector against gravity; z where there is none."""
    gravity = np.asarray(machine.model.gravity.linear)
    length = float(np.linalg.norm(gravity))
    return -gravity / length if length > 0 else np.array([0.0, 0.0, 1.0])


def slewing(machine: Machine, frame: str) -> tuple[int, Array] | None:
    """The driven joint that slews all that carries the frame, and a point on its axis.

    It stands on the ground, turns about the vertical, and moves no passive joint.
    """
    model, up = machine.model, upwards(machine)
    gamma = machine.closure.gamma(machine.home)
    carrying = list(model.supports[model.frames[machine.frame(frame)].parentJoint])
    data = model.createData()
    at = machine.coordinates.configuration(machine.home)
    jacobian = pin.computeJointJacobians(model, data, at).reshape(6, -1)
    for i, name in enumerate(machine.active):
        column = machine.column(name)
        if not model.existJointName(name):  # one of those of a body that floats
            continue
        joint = model.getJointId(name)
        axis = jacobian[3:, column]
        if (
            machine.driven[i]
            and model.parents[joint] == 0
            and joint in carrying
            and machine.unit(name) == "rad"
            and not np.abs(gamma[machine.closure.passive, i]).any()
            and abs(axis @ up) > 1 - 1e-9
        ):
            return i, np.array(data.oMi[joint].translation)
    return None


def section_of(machine: Machine, frame: str, tips: Array, home: Array) -> Section:
    """The section to draw tips (N, 3) in, all at one angle of the slewing joint, if there is one.

    Args:
        machine: The machine.
        frame: What the tips are.
        tips: Drawn from the whole reach.
        home: (3,) the tip at home.
    """
    up, slew = upwards(machine), slewing(machine, frame)
    away = tips - tips.mean(axis=0)
    _, extents, directions = np.linalg.svd(away, full_matrices=False)
    small = _FLAT * max(float(extents[0]), 1e-9 * machine.closure.size)
    normal = directions[2]
    if extents[1] <= small:  # a line: any plane through it, upright if it can be
        normal = np.cross(directions[0], up)
        if np.linalg.norm(normal) < 1e-6:
            normal = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        normal = normal / np.linalg.norm(normal)
    flat = len(tips) < 3 or extents[2] <= small
    zero = np.zeros(3)
    if slew is not None:
        index, foot = slew
        foot = foot - (foot @ up) * up  # heights are those of the world
        upright = abs(normal @ up) < _FLAT and abs((home - foot) @ normal) <= 10 * small
        if flat and upright:
            forward = np.cross(normal, up)
            forward *= np.sign((home - foot) @ forward) or 1.0
            return Section(("radius", "height"), forward, up, foot, False, index)
        return Section(("radius", "height"), zero, up, foot, True, index)
    if not flat:
        return Section(("radius", "height"), zero, up, zero, True, None)
    if abs(normal @ up) > 1 - 1e-9:
        first = np.eye(3)[(int(np.argmax(np.abs(up))) + 1) % 3]
        second = np.cross(up, first)
    else:
        second = up - (up @ normal) * normal
        second = second / np.linalg.norm(second)
        first = np.cross(normal, second)
        first *= np.sign(first[np.argmax(np.abs(first))])
    return Section(
        (_name(first, "along"), _name(second, "height")), first, second, zero, False, None
    )


def _name(direction: Array, otherwise: str) -> str:
    """x, y or z where a direction is one of them."""
    for name, axis in zip("xyz", np.eye(3), strict=True):
        if direction @ axis > 1 - 1e-9:
            return name
    return otherwise
