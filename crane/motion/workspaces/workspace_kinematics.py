"""What is asked of the postures of a workspace."""

import numpy as np

from crane.closure.active_joint_selection import condition_number
from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces.workspace_section import WorkspaceSection

_AXIS_TOLERANCE = 1e-6  # share of the extent
_DETERMINANT_TOLERANCE = 1e-9  # share of its two products below which a determinant is none


class WorkspaceKinematics:
    """The tip of a machine, its slopes by the strokes, and the condition of the drive.

    Args:
        machine: The machine.
        kinematics: Of the frame.
        section: What its places are.
        strokes: Indices of the strokes among the active joints.
        extent: Of the section [m].
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
        self.strokes = strokes
        self._coordinate_scales = machine.closure.equations.motion_scales
        self.stroke_scales = self._coordinate_scales[machine.closure.active][strokes]

    def tip_positions(self, q: Array) -> Array:
        """Positions (N, 3) [m] at postures (N, nq)."""
        return self.kinematics.positions_at_configurations(q)

    def is_on_axis(self, q: Array) -> bool:
        """Whether the first coordinate is a distance from an axis that the tip is on."""
        u = self.section.coordinates(self.tip_positions(q[None]))[0, 0]
        return self.section.is_radial and bool(u < _AXIS_TOLERANCE * self.extent)

    def condition_measures(self, q: Array, tips: Array) -> tuple[Array, Array]:
        """Conditions (N,) and least singular values (N,) of postures (N, nq) with tips (N, 3).

        The latter are those of d(u, w)/dq_A D_A, in metres per scale of the strokes, the only one
        for a single stroke.
        """
        closure, gamma = self.machine.closure, self.machine.closure.gamma(q)
        jacobian = self.scaled_tip_jacobian(q, tips, gamma)
        singular_values = np.asarray(np.linalg.svd(jacobian, compute_uv=False), dtype=np.float64)
        return condition_number(gamma, self._coordinate_scales, closure.active), singular_values[
            :, -1
        ]

    def scaled_tip_jacobian(self, q: Array, tips: Array, gamma: Array) -> Array:
        """d(u, w)/dq_A D_A of the strokes, (N, 2, d) [m per scale]."""
        jacobian = (
            np.array([self.kinematics.tree_jacobian(configuration) for configuration in q]) @ gamma
        )
        slopes = self.section.section_jacobian(tips, jacobian)[:, :, self.strokes]
        return np.asarray(slopes * self.stroke_scales)

    def tip_determinant(self, stroke_pair: tuple[int, int], q: Array) -> Array:
        """Of d(u, w) by two strokes at postures (N, nq), (N,) [m2]."""
        jacobian = self.scaled_tip_jacobian(
            q, self.tip_positions(q), self.machine.closure.gamma(q)
        )
        pair_jacobian = jacobian[:, :, [self.strokes.index(i) for i in stroke_pair]]
        first_product, second_product = (
            pair_jacobian[:, 0, 0] * pair_jacobian[:, 1, 1],
            pair_jacobian[:, 0, 1] * pair_jacobian[:, 1, 0],
        )
        size = np.abs(first_product) + np.abs(second_product)
        return np.where(
            np.abs(first_product - second_product) < _DETERMINANT_TOLERANCE * size,
            0.0,
            first_product - second_product,
        )
