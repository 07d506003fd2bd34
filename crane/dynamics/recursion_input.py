"""Machines whose joints accelerate with a reference and something more; see `recursion`."""

from collections.abc import Sequence
from dataclasses import dataclass

from crane.closure.kinematics_formulas import LoopFormulas, PositionKinematics, VelocityKinematics
from crane.closure.spatial_vectors import (
    SpatialVector,
    Vector,
    add_spatial,
    scale_spatial,
    shift_motion,
    shift_wrench,
)
from crane.codegen.symbolic import Scalar
from crane.dynamics.spatial_inertia import SpatialInertia

ArticulatedInertia = tuple[
    SpatialInertia, SpatialVector
]  # an inertia, and the wrench that it asks for at rest
ArticulatedInertias = dict[
    int, ArticulatedInertia
]  # what hangs on bodies, by their number, at their origin


@dataclass(frozen=True)
class RecursionInput:
    """Input of the recursion: a state, and accelerations relative to `reference_accelerations`.

    Attributes:
        kinematics: Its bodies.
        loops: Its loops.
        velocity_kinematics: Velocities, for the loops' second derivatives.
        reference_accelerations: (nb + 1,) accelerations of the joints that `reference_wrenches`
            belong to: what the loops ask for at a_A = 0 where clusters are projected, else 0.
        body_inertias: Of every body mass, lever from its origin to the COM, inertia about the COM.
        reference_wrenches: Of every body, about its COM, what it takes to accelerate it so, weight
            included.
        rotor_inertias: (nb + 1,) rotor inertias of the joints.
        joint_forces: (nb + 1,) forces along the joints, those of the drives included.
    """

    kinematics: PositionKinematics
    loops: LoopFormulas
    velocity_kinematics: VelocityKinematics
    reference_accelerations: Vector
    body_inertias: Sequence[tuple[Scalar, Vector, list[Vector]]]
    reference_wrenches: Sequence[SpatialVector]
    rotor_inertias: Vector
    joint_forces: Vector

    def remaining_force(self, i: int) -> Scalar:
        """What is left along a joint for more than the reference."""
        return self.joint_forces[i] - self.rotor_inertias[i] * self.reference_accelerations[i]

    def articulated_inertia(self, i: int, articulated: ArticulatedInertias) -> ArticulatedInertia:
        """A body and what hangs on it, at its origin."""
        mass, lever, tensor = self.body_inertias[i - 1]
        inertia = SpatialInertia.rigid_body(mass, lever, tensor)
        wrench = shift_wrench(self.reference_wrenches[i - 1], lever)
        if i not in articulated:
            return inertia, wrench
        return inertia + articulated[i][0], add_spatial(wrench, articulated[i][1])

    def body_acceleration(
        self, i: int, parent_acceleration: SpatialVector, joint_acceleration: Scalar
    ) -> SpatialVector:
        """What a body accelerates more, from what its parent does."""
        return add_spatial(
            shift_motion(parent_acceleration, self.kinematics.offsets[i]),
            scale_spatial(joint_acceleration, self.kinematics.body_motion_axes(i)),
        )


def add_articulated_inertia(
    articulated: ArticulatedInertias, body: int, inertia: SpatialInertia, bias: SpatialVector
) -> None:
    """Let something hang on a body."""
    if body in articulated:
        inertia, bias = articulated[body][0] + inertia, add_spatial(articulated[body][1], bias)
    articulated[body] = inertia, bias
