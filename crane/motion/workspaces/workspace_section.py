"""The plane that a workspace is drawn in."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.machine import Machine

_FLATNESS_TOLERANCE = 1e-7  # share of the extent that counts as none


@dataclass(frozen=True, eq=False, repr=False)
class WorkspaceSection(OneLineRepr):
    """Two coordinates (u, w) of the tip.

    Of a machine whose slewing joint stands upright on the ground: distance from the slewing axis
    and height; the distance has a sign where the tip stays in a plane through the axis, and
    counts forward from there. Of a tip that stays in any other plane: along two directions of the
    plane. Of any other tip: distance from the vertical through the origin, and height.

    Attributes:
        coordinate_names: Of both coordinates.
        first_direction: (3,) direction of u, where it is along one.
        second_direction: (3,) direction of w.
        origin: (3,) a point with u = w = 0 [m].
        is_radial: Whether u is a distance from the line through the origin along w.
        slewing_joint: Index of the slewing joint among the active ones, None where there is none.
    """

    coordinate_names: tuple[str, str]
    first_direction: Array
    second_direction: Array
    origin: Array
    is_radial: bool
    slewing_joint: int | None

    def coordinates(self, points: Array) -> Array:
        """(u, w) (N, 2) [m] of points (N, 3) in the world."""
        offset = points - self.origin
        height = offset @ self.second_direction
        if not self.is_radial:
            return np.column_stack([offset @ self.first_direction, height])
        radial_offset = offset - height[:, None] * self.second_direction
        return np.column_stack([np.linalg.norm(radial_offset, axis=1), height])

    def section_jacobian(self, points: Array, jacobian: Array) -> Array:
        """d(u, w) (N, 2, n) of points (N, 3) whose own derivatives are (N, 3, n)."""
        offset = points - self.origin
        first_directions = np.broadcast_to(self.first_direction, points.shape)
        if self.is_radial:
            radial_offset = (
                offset - (offset @ self.second_direction)[:, None] * self.second_direction
            )
            length = np.linalg.norm(radial_offset, axis=1, keepdims=True)
            first_directions = radial_offset / np.where(length > 0, length, 1.0)
        second_directions = np.broadcast_to(self.second_direction, points.shape)
        return np.einsum("kia,ian->ikn", np.array([first_directions, second_directions]), jacobian)


def up_direction(machine: Machine) -> Array:
    """(3,) unit vector against gravity; z where there is none."""
    gravity = np.asarray(machine.model.gravity.linear)
    length = float(np.linalg.norm(gravity))
    return -gravity / length if length > 0 else np.array([0.0, 0.0, 1.0])


def find_slewing_joint(machine: Machine, frame: str) -> tuple[int, Array] | None:
    """The driven joint that slews all that carries the frame, and a point on its axis.

    It stands on the ground, turns about the vertical, and moves no passive joint.
    """
    model, up = machine.model, up_direction(machine)
    gamma = machine.closure.gamma(machine.home)
    supporting_joints = list(model.supports[model.frames[machine.frame(frame)].parentJoint])
    data = model.createData()
    configuration = machine.coordinates.configuration(machine.home)
    jacobian = pin.computeJointJacobians(model, data, configuration).reshape(6, -1)
    for i, name in enumerate(machine.active):
        column = machine.column(name)
        if not model.existJointName(name):  # one of those of a body that floats
            continue
        joint = model.getJointId(name)
        axis = jacobian[3:, column]
        if (
            machine.is_driven[i]
            and model.parents[joint] == 0
            and joint in supporting_joints
            and machine.unit(name) == "rad"
            and not np.abs(gamma[machine.closure.passive, i]).any()
            and abs(axis @ up) > 1 - 1e-9
        ):
            return i, np.array(data.oMi[joint].translation)
    return None


def workspace_section(
    machine: Machine, frame: str, tip_positions: Array, home_position: Array
) -> WorkspaceSection:
    """The section to draw tips (N, 3) in, all at one angle of the slewing joint, if there is one.

    Args:
        machine: The machine.
        frame: What the tips are.
        tip_positions: Drawn from the whole reach.
        home_position: (3,) the tip at home.
    """
    up, slewing_joint = up_direction(machine), find_slewing_joint(machine, frame)
    offsets = tip_positions - tip_positions.mean(axis=0)
    _, extents, directions = np.linalg.svd(offsets, full_matrices=False)
    flatness_threshold = _FLATNESS_TOLERANCE * max(
        float(extents[0]), 1e-9 * machine.closure.characteristic_length
    )
    normal = directions[2]
    if extents[1] <= flatness_threshold:  # a line: any plane through it, upright if it can be
        normal = np.cross(directions[0], up)
        if np.linalg.norm(normal) < 1e-6:
            normal = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        normal = normal / np.linalg.norm(normal)
    is_flat = len(tip_positions) < 3 or extents[2] <= flatness_threshold
    zero = np.zeros(3)
    if slewing_joint is not None:
        index, axis_point = slewing_joint
        axis_point = axis_point - (axis_point @ up) * up  # heights are those of the world
        is_upright = (
            abs(normal @ up) < _FLATNESS_TOLERANCE
            and abs((home_position - axis_point) @ normal) <= 10 * flatness_threshold
        )
        if is_flat and is_upright:
            forward = np.cross(normal, up)
            forward *= np.sign((home_position - axis_point) @ forward) or 1.0
            return WorkspaceSection(("radius", "height"), forward, up, axis_point, False, index)
        return WorkspaceSection(("radius", "height"), zero, up, axis_point, True, index)
    if not is_flat:
        return WorkspaceSection(("radius", "height"), zero, up, zero, True, None)
    if abs(normal @ up) > 1 - 1e-9:
        first_direction = np.eye(3)[(int(np.argmax(np.abs(up))) + 1) % 3]
        second_direction = np.cross(up, first_direction)
    else:
        second_direction = up - (up @ normal) * normal
        second_direction = second_direction / np.linalg.norm(second_direction)
        first_direction = np.cross(normal, second_direction)
        first_direction *= np.sign(first_direction[np.argmax(np.abs(first_direction))])
    return WorkspaceSection(
        (_axis_name(first_direction, "along"), _axis_name(second_direction, "height")),
        first_direction,
        second_direction,
        zero,
        False,
        None,
    )


def _axis_name(direction: Array, default: str) -> str:
    """x, y or z where a direction is one of them."""
    for name, axis in zip("xyz", np.eye(3), strict=True):
        if direction @ axis > 1 - 1e-9:
            return name
    return default
