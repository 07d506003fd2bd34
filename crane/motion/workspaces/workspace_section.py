"""The plane of a workspace, and the kinematics of the tip in it."""

from dataclasses import dataclass

import numpy as np

from crane.closure.active_joint_selection import condition_number
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics

_FLATNESS_TOLERANCE = 1e-7  # relative to the extent
_AXIS_TOLERANCE = 1e-6  # distance from the axis, relative to the extent
_DETERMINANT_TOLERANCE = 1e-9  # determinant relative to its two products that counts as zero


@dataclass(frozen=True, eq=False, repr=False)
class WorkspaceSection(OneLineRepr):
    """Section: two coordinates (u, w) of the tip.

    For a machine with a vertical slewing joint on the ground: distance from the slewing axis, and
    height; the distance is signed, positive forwards, if the tip moves in a plane through the
    axis. For a tip that moves in another plane: two directions of the plane. For any other tip:
    distance from the vertical through the origin, and height.

    Attributes:
        coordinate_names: Names of both coordinates.
        first_direction: (3,) direction of u, zero if u is a distance.
        second_direction: (3,) direction of w.
        origin: (3,) point with u = w = 0 [m].
        is_radial: Whether u is a distance from the line through the origin along w.
        slewing_joint: Index of the slewing joint among the active ones, None if there is none.
        slewing_sign: 1 if it slews about the upward direction, -1 about the downward one.
    """

    coordinate_names: tuple[str, str]
    first_direction: Array
    second_direction: Array
    origin: Array
    is_radial: bool
    slewing_joint: int | None
    slewing_sign: float = 1.0

    def coordinates(self, points: Array) -> Array:
        """Coordinates (u, w) (N, 2) [m] of points (N, 3) in the world."""
        offset = points - self.origin
        height = offset @ self.second_direction
        if not self.is_radial:
            return np.column_stack([offset @ self.first_direction, height])
        radial_offset = offset - height[:, None] * self.second_direction
        return np.column_stack([np.linalg.norm(radial_offset, axis=1), height])

    def section_jacobian(self, points: Array, jacobian: Array) -> Array:
        """Derivatives (N, 2, n) of (u, w) of points (N, 3) with the Jacobians (N, 3, n)."""
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


def find_slewing_joint(machine: Machine, frame: str) -> tuple[int, Array, float] | None:
    """Slewing joint of a frame: its index, a point on its axis, its sign about up; or None.

    It is a driven joint on the ground with a vertical axis, and moves no passive joint.
    """
    model, up = machine.model, machine.up_direction
    gamma = machine.closure.gamma(machine.home)
    frames = FrameJacobians(machine)
    frames.set_configuration(machine.home)
    upward_rates = up @ frames.jacobian(frame)[3:]
    for i, name in enumerate(machine.active):
        if not model.existJointName(name):  # a coordinate of a floating base
            continue
        upward_rate = upward_rates[machine.column(name)]  # 0 if it does not carry the frame
        if (
            machine.is_driven[i]
            and model.parents[model.getJointId(name)] == 0
            and machine.unit(name) == "rad"
            and not np.abs(gamma[machine.closure.passive, i]).any()
            and abs(upward_rate) > 1 - 1e-9
        ):
            axis_point = frames.frame_pose(machine.tree.joints[name].child).translation
            return i, axis_point, float(np.sign(upward_rate))
    return None


def workspace_section(
    machine: Machine, frame: str, tip_positions: Array, home_position: Array
) -> WorkspaceSection:
    """Section of tip positions (N, 3), all at one angle of the slewing joint if there is one.

    Args:
        machine: The machine.
        frame: Name of the frame.
        tip_positions: (N, 3) positions over the whole reach [m].
        home_position: (3,) position at home [m].
    """
    up, slewing_joint = machine.up_direction, find_slewing_joint(machine, frame)
    _, extents, directions = np.linalg.svd(
        tip_positions - tip_positions.mean(axis=0), full_matrices=False
    )
    flatness_threshold = _FLATNESS_TOLERANCE * max(
        float(extents[0]), 1e-9 * machine.closure.characteristic_length
    )
    normal = directions[2]
    if extents[1] <= flatness_threshold:  # a line: any plane through it, vertical if possible
        normal = np.cross(directions[0], up)
        if np.linalg.norm(normal) < 1e-6:
            normal = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        normal = normal / np.linalg.norm(normal)
    is_flat = len(tip_positions) < 3 or extents[2] <= flatness_threshold
    if slewing_joint is not None:
        index, axis_point, sign = slewing_joint
        axis_point = axis_point - (axis_point @ up) * up  # heights are those of the world
        is_upright = abs(normal @ up) < _FLATNESS_TOLERANCE
        is_central = abs((home_position - axis_point) @ normal) <= 10 * flatness_threshold
        is_radial, forward = not (is_flat and is_upright and is_central), np.zeros(3)
        if not is_radial:
            forward = np.cross(normal, up)
            forward *= np.sign((home_position - axis_point) @ forward) or 1.0
        return WorkspaceSection(
            ("radius", "height"), forward, up, axis_point, is_radial, index, sign
        )
    if not is_flat:
        zero = np.zeros(3)
        return WorkspaceSection(("radius", "height"), zero, up, zero, True, None)
    if abs(normal @ up) > 1 - 1e-9:
        first_direction = np.eye(3)[(int(np.argmax(np.abs(up))) + 1) % 3]
        second_direction = np.cross(up, first_direction)
    else:
        second_direction = up - (up @ normal) * normal
        second_direction = second_direction / np.linalg.norm(second_direction)
        first_direction = np.cross(normal, second_direction)
        first_direction *= np.sign(first_direction[np.argmax(np.abs(first_direction))])
    directions = np.array([first_direction, second_direction])
    names = ["along", "height"]
    for i, axis in np.argwhere(directions > 1 - 1e-9):
        names[i] = "xyz"[axis]
    return WorkspaceSection(
        (names[0], names[1]), first_direction, second_direction, np.zeros(3), False, None
    )


class WorkspaceKinematics:
    """Tip positions, their derivatives by the strokes, and conditions, in a section.

    Args:
        machine: The machine.
        kinematics: Kinematics of the frame.
        section: Section of the workspace.
        strokes: Indices of the strokes among the active joints.
        extent: Extent of the section [m].
    """

    def __init__(
        self,
        machine: Machine,
        kinematics: Kinematics,
        section: WorkspaceSection,
        strokes: list[int],
        extent: float,
    ):
        self.extent = extent
        self.machine, self.kinematics, self.section = machine, kinematics, section
        self.strokes, self.tip_positions = strokes, kinematics.positions_at_configurations
        self._coordinate_scales = machine.closure.equations.motion_scales
        self.stroke_scales = self._coordinate_scales[machine.closure.active][strokes]

    def is_on_axis(self, q: Array) -> bool:
        """Whether the first coordinate is a distance from an axis that the tip is on."""
        u = self.section.coordinates(self.tip_positions(q[None]))[0, 0]
        return self.section.is_radial and bool(u < _AXIS_TOLERANCE * self.extent)

    def condition_measures(self, q: Array, tips: Array) -> tuple[Array, Array]:
        """Condition numbers (N,) and least singular values (N,) at configurations (N, nq).

        The least singular value is that of d(u, w)/dq_A D_A, in metres per scale of the strokes,
        for tip positions (N, 3).
        """
        closure, gamma = self.machine.closure, self.machine.closure.gamma(q)
        jacobian = self.scaled_tip_jacobian(q, tips, gamma)
        least_singular_values = np.linalg.svd(jacobian, compute_uv=False)[:, -1]
        condition = condition_number(gamma, self._coordinate_scales, closure.active)
        return condition, np.asarray(least_singular_values, dtype=np.float64)

    def scaled_tip_jacobian(self, q: Array, tips: Array, gamma: Array) -> Array:
        """Scaled Jacobian d(u, w)/dq_A D_A (N, 2, d) of the strokes [m per scale]."""
        jacobian = np.array([self.kinematics.tree_jacobian(x) for x in q]) @ gamma
        return np.asarray(
            self.section.section_jacobian(tips, jacobian)[:, :, self.strokes] * self.stroke_scales
        )

    def tip_determinant(self, stroke_pair: tuple[int, int], q: Array) -> Array:
        """Determinant (N,) [m2] of the scaled Jacobian by two strokes at q (N, nq)."""
        jacobian = self.scaled_tip_jacobian(
            q, self.tip_positions(q), self.machine.closure.gamma(q)
        )
        pair_jacobian = jacobian[:, :, [self.strokes.index(i) for i in stroke_pair]]
        first_product = pair_jacobian[:, 0, 0] * pair_jacobian[:, 1, 1]
        second_product = pair_jacobian[:, 0, 1] * pair_jacobian[:, 1, 0]
        determinant = first_product - second_product
        size = np.abs(first_product) + np.abs(second_product)
        return np.where(np.abs(determinant) < _DETERMINANT_TOLERANCE * size, 0.0, determinant)
