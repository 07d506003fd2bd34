"""Loop equations, gamma and velocity kinematics of one machine as symbolic formulas."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from crane.closure.constraint_structure import ConstraintStructure
from crane.closure.constraint_tolerances import CLOSED_TOLERANCE
from crane.closure.coordinates import Indices
from crane.closure.kinematics_formulas import (
    PositionKinematics,
    SpatialVector,
    Vector,
    adjust_motion,
    coordinate_rates,
    largest_scaled_value,
    spatial_dot,
    subtract_spatial,
)
from crane.closure.loop_equations import LoopEquations, aligned_axes
from crane.codegen.symbolic import Scalar, add_vectors, cross, dot, scale_vector, subtract_vectors
from crane.codegen.symbolic_linear_algebra import solve_linear_system
from crane.description.specification import LOOP_TYPES


@dataclass(frozen=True)
class LoopEquationFormula:
    """One symbolic loop equation; see `LoopEquations`.

    Attributes:
        bodies: Bodies of the two frames.
        is_translation: Whether the equation is a length.
        has_fixed_axis: Whether the axis rate may be left out, because the origins coincide.
        axis: Axis of the first frame.
        arm: Axis or origin of the second frame.
        wrench: Wrench w of the row, phi' = w . (V_2 - V_1).
        phi: Residual.
        jacobian: dphi/dq by joint.
        curvatures: Second and third derivatives of phi by the coordinates of joints, of a coupling
            with higher powers.
    """

    bodies: tuple[int, int]
    is_translation: bool
    has_fixed_axis: bool
    axis: Vector
    arm: Vector
    wrench: SpatialVector
    phi: Scalar
    jacobian: dict[int, Scalar]
    curvatures: Mapping[int, tuple[Scalar, Scalar]] = field(default_factory=dict)

    def axis_and_arm_rates(
        self, first_motion: SpatialVector, second_motion: SpatialVector
    ) -> tuple[Vector, Vector]:
        """Time derivatives of axis and arm, from the motions of the two bodies."""
        axis: Vector = [0.0] * 3 if self.has_fixed_axis else cross(first_motion[1], self.axis)
        arm = cross(second_motion[1], self.arm)
        return axis, add_vectors(arm, second_motion[0]) if self.is_translation else arm

    def wrench_rate(
        self, first_motion: SpatialVector, second_motion: SpatialVector
    ) -> SpatialVector:
        """Time derivative of the wrench."""
        axis, arm = self.axis_and_arm_rates(first_motion, second_motion)
        return (axis if self.is_translation else [0.0] * 3), add_vectors(
            cross(arm, self.axis), cross(self.arm, axis)
        )


class LoopFormulas:
    """The symbolic independent loop equations at one configuration.

    `alignments` are cosines that are 1 where the axes of the loop frames are not opposed.

    Args:
        equations: All equations of the machine.
        structure: Independent equations.
        active: Columns of the active joints.
        passive: Columns of the other joints.
        kinematics: Position kinematics.
    """

    def __init__(
        self,
        equations: LoopEquations,
        structure: ConstraintStructure,
        active: Indices,
        passive: Indices,
        kinematics: PositionKinematics,
    ):
        self._structure, self._kinematics = structure, kinematics
        self._is_translation = equations.is_translation
        self.active_joints = [int(column) + 1 for column in active]
        self.passive_joints = [int(column) + 1 for column in passive]
        self._frames = [
            kinematics.loop_frame(i) for i in range(len(kinematics.geometry.frame_bodies))
        ]
        self.rows = [
            self._equation_formula(equations, int(row), kinematics)
            for row in structure.independent_rows
        ]
        self.alignments = [
            dot([line[k] for line in one[0]], [line[k] for line in two[0]])
            for loop, one, two in zip(
                equations.loops, self._frames[::2], self._frames[1::2], strict=True
            )
            for k in aligned_axes(loop.type)
        ]
        self._redundant_rows = [
            self._equation_formula(equations, int(row), kinematics)
            for row in structure.redundant_rows
        ]

    def _equation_formula(
        self, equations: LoopEquations, row: int, kinematics: PositionKinematics
    ) -> LoopEquationFormula:
        coupling = int(equations.loop_of_row[row]) - len(equations.loops)
        if coupling >= 0:
            factors = [float(x) for x in equations.coupling_factors[coupling]]
            derivatives: dict[int, Scalar] = {i: x for i, x in enumerate(factors, start=1) if x}
            phi = dot(factors, kinematics.q) - float(equations.coupling_offsets[coupling])
            curvatures: dict[int, tuple[Scalar, Scalar]] = {}
            powers = equations.coupling_powers[:, coupling]
            for column in np.flatnonzero(powers.any(axis=0)).tolist():
                a, b, c = powers[:, column].tolist()
                x, joint = kinematics.q[column], column + 1
                phi = phi + x * x * (a + x * (b + x * c))
                slope = x * (2 * a + x * (3 * b + x * (4 * c)))
                derivatives[joint] = derivatives.get(joint, 0.0) + slope
                curvatures[joint] = 2 * a + x * (6 * b + x * (12 * c)), 6 * b + x * (24 * c)
            zero: Vector = [0.0] * 3
            return LoopEquationFormula(
                (0, 0), False, False, zero, zero, (zero, zero), phi, derivatives, curvatures
            )
        one = 2 * int(equations.loop_of_row[row])
        (axes1, origin1), (axes2, origin2) = self._frames[one], self._frames[one + 1]
        axis = [line[equations.axis_of_frame1[row]] for line in axes1]
        is_translation = bool(equations.is_translation[row])
        if is_translation:
            arm = origin2
            wrench, phi = (axis, cross(arm, axis)), dot(axis, subtract_vectors(origin2, origin1))
        else:
            arm = [line[equations.axis_of_frame2[row]] for line in axes2]
            wrench, phi = ([0.0] * 3, cross(arm, axis)), dot(axis, arm)
        jacobian = {}
        for column, sign in enumerate(equations.sign[one // 2]):
            if sign:
                linear, angular = kinematics.joint_axes[column + 1]
                jacobian[column + 1] = float(sign) * (
                    dot(wrench[0], linear) + dot(wrench[1], angular)
                )
        bodies = kinematics.geometry.frame_bodies
        locks_all_translations = all(LOOP_TYPES[equations.loops[one // 2].type][:3])
        has_fixed_axis = (
            is_translation
            and locks_all_translations
            and self._structure.redundancy.tolerance <= CLOSED_TOLERANCE
        )
        return LoopEquationFormula(
            (bodies[one], bodies[one + 1]),
            is_translation,
            has_fixed_axis,
            axis,
            arm,
            wrench,
            phi,
            jacobian,
        )

    def solve_passive(
        self, active_rows: dict[int, Vector], right_sides: Sequence[Vector]
    ) -> tuple[dict[int, Vector], list[Scalar]]:
        """Solve J x = right_sides for the passive joints, block by block.

        Args:
            active_rows: Rows of x of the active joints, by joint.
            right_sides: Right-hand sides, by row.

        Returns:
            Rows of x of all joints, and the determinants of the blocks.
        """
        x = dict(active_rows)
        determinants = []
        for rows, columns in self._structure.blocks:
            joints = [self.passive_joints[c] for c in columns]
            matrix = [[self.rows[r].jacobian.get(joint, 0.0) for joint in joints] for r in rows]
            # the block order accounts for derivatives that vanish everywhere
            before = {joint: row for joint, row in x.items() if joint not in joints}
            found, determinant = solve_linear_system(
                matrix, [self._right_side(r, before, right_sides[r]) for r in rows]
            )
            determinants.append(determinant)
            x |= dict(zip(joints, found, strict=True))
        return x, determinants

    def _right_side(self, row: int, known: dict[int, Vector], side: Vector) -> Vector:
        """Right-hand side of a row minus the contributions of known joints."""
        for joint, derivative in self.rows[row].jacobian.items():
            if joint in known:
                side = subtract_vectors(side, scale_vector(derivative, known[joint]))
        return side

    @cached_property
    def gamma_and_determinants(self) -> tuple[dict[int, Vector], list[Scalar]]:
        """Rows of gamma (n,) by joint, and determinants of the blocks in their order."""
        n = len(self.active_joints)
        known: dict[int, Vector] = {
            joint: [float(i == k) for k in range(n)] for i, joint in enumerate(self.active_joints)
        }
        return self.solve_passive(known, [[0.0] * n for _ in self.rows])

    @property
    def gamma(self) -> dict[int, Vector]:
        """Rows of gamma (n,) by joint."""
        return self.gamma_and_determinants[0]

    def newton_step(self, holds_coordinates: bool) -> dict[int, Scalar]:
        """Newton step of the coordinates of the passive joints, by joint.

        Args:
            holds_coordinates: See `coordinate_changes`.
        """
        return self.coordinate_changes([row.phi for row in self.rows], holds_coordinates)

    def coordinate_changes(
        self, gaps: Sequence[Scalar], holds_coordinates: bool = True
    ) -> dict[int, Scalar]:
        """Changes of the coordinates of the passive joints that close gaps, to first order.

        Args:
            gaps: Residuals by row.
            holds_coordinates: Whether active coordinates that are parts of a rotation vector stay
                constant; else the active joints do not move, but these coordinates may change.
        """
        x, _ = self.solve_passive(
            {joint: [0.0] for joint in self.active_joints}, [[-gap] for gap in gaps]
        )
        held = self._kinematics.geometry.partly_active_joints(self.active_joints)
        if held and holds_coordinates:
            geometry, q, joints = self._kinematics.geometry, self._kinematics.q, sorted(x)
            motion = adjust_motion(
                geometry,
                q,
                [x[i][0] for i in joints],
                [[self.gamma[i][self.active_joints.index(k)] for i in joints] for k in held],
                dict.fromkeys(held, 0.0),
            )
            x = {i: [value] for i, value in zip(joints, motion, strict=True)}
        steps = self.coordinate_steps({joint: row[0] for joint, row in x.items()})
        moved = self.passive_joints if holds_coordinates else [*self.passive_joints, *held]
        return {joint: steps[joint] for joint in moved}

    def coordinate_steps(self, motion: dict[int, Scalar]) -> dict[int, Scalar]:
        """Steps of the coordinates along a small motion of the joints, by joint."""
        geometry, q = self._kinematics.geometry, self._kinematics.q
        rates = coordinate_rates(geometry, q, [motion[i] for i in range(1, len(q) + 1)])
        return dict(enumerate(rates, start=1))

    def largest_residual(self, redundant: bool = False) -> Scalar:
        """The largest absolute scaled residual of the independent or redundant equations."""
        rows, indices = self.rows, self._structure.independent_rows
        if redundant:
            rows, indices = self._redundant_rows, self._structure.redundant_rows
        return largest_scaled_value(
            [row.phi for row in rows],
            self._is_translation[indices].tolist(),
            self._kinematics.inverse_characteristic_length,
        )


class VelocityKinematics:
    """Symbolic velocities and bias accelerations of the bodies.

    Args:
        kinematics: Position kinematics.
        loops: Loop formulas.
        joint_velocities: (nb + 1,) joint velocities, 0 for the world.
        gravity: (3,) in the axes of the reference body; the world accelerates with -gravity, so
            that weights need no terms of their own.
        carriers: (nb + 1,) the body whose motion each body shares, its parent or 0.

    Attributes:
        velocities: Velocity of every body, linear at the reference origin, angular.
        bias_accelerations: Accelerations at zero joint acceleration.
    """

    def __init__(
        self,
        kinematics: PositionKinematics,
        loops: LoopFormulas,
        joint_velocities: Sequence[Scalar],
        gravity: Sequence[Scalar],
        carriers: Sequence[int],
    ):
        self._kinematics, self._loops = kinematics, loops
        self._joint_velocities = joint_velocities
        series_of_body = kinematics.geometry.series_of_body
        self.velocities: list[tuple[Vector, Vector]] = [([0.0] * 3, [0.0] * 3)]
        self.bias_accelerations: list[tuple[Vector, Vector]] = [([-g for g in gravity], [0.0] * 3)]
        for i in range(1, len(kinematics.joint_axes)):
            parent = carriers[i]
            linear, angular = (
                scale_vector(joint_velocities[i], part) for part in kinematics.joint_axes[i]
            )
            v, w = self.velocities[parent]
            a, e = self.bias_accelerations[parent]
            # the axes of a series turn with its last body: products of its own rates cancel
            axis_v, axis_w = self.velocities[carriers[series_of_body.get(i, (i,))[0]]]
            a = add_vectors(a, cross(axis_w, linear), cross(axis_v, angular))
            e = add_vectors(e, cross(axis_w, angular))
            self.bias_accelerations.append((a, e))
            self.velocities.append((add_vectors(v, linear), add_vectors(w, angular)))

    @cached_property
    def drift(self) -> Vector:
        """(nb + 1,) accelerations of the joints at a_A = 0."""
        held: dict[int, Vector] = {joint: [0.0] for joint in self._loops.active_joints}
        x, _ = self._loops.solve_passive(
            held, [[-self.acceleration_bias(row)] for row in self._loops.rows]
        )
        return [0.0] + [x[i][0] for i in range(1, len(self._kinematics.joint_axes))]

    def acceleration_bias(self, row: LoopEquationFormula) -> Scalar:
        """Second derivative of phi at zero joint acceleration, see `LoopEquations`."""
        one, two = row.bodies
        first, second = self.velocities[one], self.velocities[two]
        turned = spatial_dot(row.wrench_rate(first, second), subtract_spatial(second, first))
        for joint, (curvature, _) in row.curvatures.items():
            rate = self._joint_velocities[joint]
            turned = turned + curvature * rate * rate
        return turned + spatial_dot(
            row.wrench,
            subtract_spatial(self.bias_accelerations[two], self.bias_accelerations[one]),
        )
