"""What is asked of the postures of a workspace."""

import numpy as np

from crane.closure.choice import condition
from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces.section import Section

_ON_AXIS = 1e-6  # share of the extent
_ROUNDING = 1e-9  # share of its two products below which a determinant is none


class Probe:
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
        section: Section,
        strokes: list[int],
        extent: float,
    ):
        self.extent = extent
        self.machine, self.kinematics, self.section = machine, kinematics, section
        self.strokes = strokes
        self._scale = machine.closure.equations.scales
        self.scale_of_strokes = self._scale[machine.closure.active][strokes]

    def tips(self, q: Array) -> Array:
        """Positions (N, 3) [m] at postures (N, nq)."""
        return self.kinematics.positions(q)

    def on_axis(self, q: Array) -> bool:
        """Whether the first coordinate is a distance from an axis that the tip is on."""
        u = self.section.coordinates(self.tips(q[None]))[0, 0]
        return self.section.around and bool(u < _ON_AXIS * self.extent)

    def at(self, q: Array, tips: Array) -> tuple[Array, Array]:
        """Conditions (N,) and least singular values (N,) of postures (N, nq) with tips (N, 3).

        The latter are those of d(u, w)/dq_A D_A, in metres per scale of the strokes, the only one
        for a single stroke.
        """
        closure, gamma = self.machine.closure, self.machine.closure.gamma(q)
        slopes = self.slopes(q, tips, gamma)
        values = np.asarray(np.linalg.svd(slopes, compute_uv=False), dtype=np.float64)
        return condition(gamma, self._scale, closure.active), values[:, -1]

    def slopes(self, q: Array, tips: Array, gamma: Array) -> Array:
        """d(u, w)/dq_A D_A of the strokes, (N, 2, d) [m per scale]."""
        jacobian = np.array([self.kinematics.tree_jacobian(posture) for posture in q]) @ gamma
        slopes = self.section.slopes(tips, jacobian)[:, :, self.strokes]
        return np.asarray(slopes * self.scale_of_strokes)

    def determinant(self, pair: tuple[int, int], q: Array) -> Array:
        """Of d(u, w) by two strokes at postures (N, nq), (N,) [m2]."""
        slopes = self.slopes(q, self.tips(q), self.machine.closure.gamma(q))
        both = slopes[:, :, [self.strokes.index(i) for i in pair]]
        one, two = both[:, 0, 0] * both[:, 1, 1], both[:, 0, 1] * both[:, 1, 0]
        size = np.abs(one) + np.abs(two)
        return np.where(np.abs(one - two) < _ROUNDING * size, 0.0, one - two)
