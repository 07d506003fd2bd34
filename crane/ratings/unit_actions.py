"""What acts on a frame: a unit of a load, or of a force in a direction."""

from dataclasses import dataclass

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.dynamics.statics import StaticQuantities
from crane.machine import Machine
from crane.motion.workspaces.workspace_section import WorkspaceSection, up_direction


@dataclass(frozen=True)
class FixedUnitAction:
    """A unit e that does not depend on the posture, but turns with the slewing joint.

    Attributes:
        direction: (3,) e where the slewing joint is at home, in the world: a direction [1] of a
            force [N]; gravity [m/s2] of a load [kg].
        up: (3,) about which it slews.
        is_weight: Whether it is one, which leans with the ground.
    """

    direction: Array
    up: Array
    is_weight: bool = False

    def unit_vectors(self, statics: StaticQuantities, angles: Array) -> Array:
        """What acts per magnitude (N, 3), with the machine slewed by angles (N,) from home."""
        return rotate_about_axis(
            np.broadcast_to(self.direction, statics.tip_positions.shape), self.up, angles
        )

    def unit_derivatives(
        self, statics: StaticQuantities, derivatives: StaticQuantities, angles: Array
    ) -> Array:
        """Its derivatives (N, 3), with those of the machine."""
        return np.zeros_like(statics.tip_positions)


@dataclass(frozen=True)
class PathUnitAction:
    """The unit force along the frame's path as one stroke moves alone, or across it.

        e = sign u / |u|,   u = dp/dq_i;   across: e = sign n x u / |u|,

    with n across the section. Where the stroke turns the frame about a pin, u is the tangent of
    the circle about it.

    Attributes:
        stroke: Among the active joints.
        sign: 1 or -1.
        up: (3,) about which it slews.
        section_normal: (3,) n where the slewing joint is at home; none along the path.
    """

    stroke: int
    sign: float
    up: Array
    section_normal: Array | None = None
    is_weight = False

    def unit_vectors(self, statics: StaticQuantities, angles: Array) -> Array:
        """See `FixedUnitAction`; not a number where the frame does not move."""
        tangent = statics.tip_jacobian[:, :, self.stroke]
        with np.errstate(invalid="ignore", divide="ignore"):
            return self._signed_direction(
                tangent / np.linalg.norm(tangent, axis=1, keepdims=True), angles
            )

    def unit_derivatives(
        self, statics: StaticQuantities, derivatives: StaticQuantities, angles: Array
    ) -> Array:
        """See `FixedUnitAction`."""
        tangent, tangent_derivative = (
            statics.tip_jacobian[:, :, self.stroke],
            derivatives.tip_jacobian[:, :, self.stroke],
        )
        length = np.linalg.norm(tangent, axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            tangent = tangent / length
            return self._signed_direction(
                (
                    tangent_derivative
                    - (tangent * tangent_derivative).sum(1, keepdims=True) * tangent
                )
                / length,
                angles,
            )

    def _signed_direction(self, direction: Array, angles: Array) -> Array:
        if self.section_normal is not None:
            normal = rotate_about_axis(
                np.broadcast_to(self.section_normal, direction.shape), self.up, angles
            )
            direction = np.cross(normal, direction)
        return self.sign * direction


UnitAction = FixedUnitAction | PathUnitAction


def gravity_action(machine: Machine) -> FixedUnitAction:
    """A load: what acts per kilogram is gravity.

    Raises:
        InputError: There is none.
    """
    gravity = np.array(machine.model.gravity.linear)
    if not gravity.any():
        raise InputError(f"'{machine.name}' has no gravity, a load has no weight there")
    return FixedUnitAction(gravity, up_direction(machine), is_weight=True)


def rotate_about_axis(vectors: Array, axis: Array, angles: Array) -> Array:
    """Vectors (N, 3) turned by angles (N,) about a unit vector."""
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    axial_part = (vectors @ axis)[:, None] * axis
    return np.asarray(
        axial_part + cosine * (vectors - axial_part) + sine * np.cross(axis, vectors)
    )


def slew_angles(
    machine: Machine, frame: str, section: WorkspaceSection, slew_coordinates: Array
) -> Array:
    """Angles (N,) about the vertical from home, of values of the slewing joint; 0 without one."""
    if section.slewing_joint is None:
        return np.zeros(len(slew_coordinates))
    frames, column = FrameJacobians(machine), machine.closure.active[section.slewing_joint]
    frames.set_configuration(machine.home)
    rotation_sign = np.sign(frames.jacobian(frame)[3:, column] @ up_direction(machine))
    return np.asarray(rotation_sign * (slew_coordinates - machine.home[column]))
