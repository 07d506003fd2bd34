"""Positions, loop equations and gamma as traced formulas of one machine."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from crane.closure.constraint_structure import ConstraintStructure, Indices
from crane.closure.constraint_tolerances import CLOSED_TOLERANCE
from crane.closure.loop_equations import LoopEquations, aligned_axes, rotation_with_z_axis
from crane.closure.rotation_vector_formulas import rotation_matrix
from crane.closure.spatial_vectors import SpatialVector, Vector, spatial_dot, subtract_spatial
from crane.codegen.symbolic import (
    Scalar,
    Tape,
    add_vectors,
    apply_function,
    cross,
    dot,
    matmul,
    matvec,
    max_abs,
    maximum,
    scale_vector,
    solve_linear_system,
    subtract_vectors,
    transpose,
)  # fmt: skip
from crane.common.samples import Array
from crane.description import LOOP_TYPES

_RIGHT_ANGLE_ROUNDING = 1e-15  # of a rotation by a right angle


@dataclass(frozen=True, eq=False)
class TreeGeometry:
    """What the formulas of a machine's positions depend on.

    Body i (1 to nb) is moved by joint i, which turns about or slides along the body's own z;
    body 0 is the world. A free-flyer is six bodies in a row on the world, at the place of the last
    one, which alone has mass: its velocities are along and about the axes of that body.

    Attributes:
        parents: (nb + 1,) parent bodies.
        is_revolute: (nb + 1,) whether the joint turns.
        floating_bases: First body of each free-flyer.
        body_rotations: (nb + 1, 3, 3) from the body's directions here to those of Pinocchio's
            joint.
        constants: (12 (nb + frames) + 1,) rotation and origin of every joint frame in its parent
            body, then of every loop frame in its body; one over the machine's size.
        frame_bodies: Body of each loop frame, predecessor and successor of each loop in turn.
    """

    parents: tuple[int, ...]
    is_revolute: tuple[bool, ...]
    floating_bases: tuple[int, ...]
    body_rotations: Array
    constants: Array
    frame_bodies: tuple[int, ...]

    @property
    def reference_body(self) -> int:
        """The body in whose frame formulas are shortest: the one that carries all others, if any.

        Seen from there its own joint moves nothing but the world, and what lies in a plane of it
        stays in that plane.
        """
        if self.parents.count(0) != 2 or 0 in self.frame_bodies:
            return 0
        return 6 if self.floating_bases else 1

    @property
    def floating_bodies(self) -> frozenset[int]:
        """All bodies of free-flyers."""
        return frozenset(i + k for i in self.floating_bases for k in range(6))

    @property
    def massless_bodies(self) -> frozenset[int]:
        """Those of them that are none."""
        return frozenset(i + k for i in self.floating_bases for k in range(5))


def tree_geometry(equations: LoopEquations) -> TreeGeometry:
    """Read the geometry off an assembled model."""
    model, coordinates = equations.model, equations.coordinates
    parents, rotations = coordinates.parents, [pin.SE3.Identity()]
    revolute = [False, *(not slides for slides in coordinates.is_translation)]
    body_of_joint = coordinates.body_of_joint
    placements = []
    for i in range(1, model.njoints):
        joint = model.joints[i]
        placement = rotations[body_of_joint[model.parents[i]]].inverse() * model.jointPlacements[i]
        if joint.nv == 6:
            placements += [placement, *[pin.SE3.Identity()] * 5]
            rotations += [pin.SE3.Identity()] * 6
            continue
        data = joint.createData()
        joint.calc(data, np.zeros(model.nq))
        column = np.asarray(data.S).ravel()
        axis = column[3:] if revolute[body_of_joint[i]] else column[:3]
        rotation = pin.SE3(
            np.eye(3) if axis[2] == 1 else rotation_with_z_axis(axis.tolist()), np.zeros(3)
        )
        placements.append(placement * rotation)
        rotations.append(rotation)
    frames = equations.frames
    placements += [rotations[body_of_joint[body]].inverse() * place for body, place in frames]
    numbers = [
        np.concatenate([_round_to_right_angles(p.rotation).ravel(), p.translation])
        for p in placements
    ]
    return TreeGeometry(
        parents,
        tuple(revolute),
        tuple(column + 1 for column in coordinates.floating_base_columns),
        np.array([turn.rotation for turn in rotations]),
        np.concatenate([*numbers, [1.0 / equations.characteristic_length]]),
        tuple(body_of_joint[body] for body, _ in frames),
    )


def _round_to_right_angles(rotation: Array) -> Array:
    """Exact zeros and ones, so that they are folded."""
    rounded = np.round(rotation)
    return np.where(np.abs(rotation - rounded) < _RIGHT_ANGLE_ROUNDING, rounded, rotation)


class FormulaConstants:
    """Numbers of a machine: 0, 1 and -1 become part of the formulas, the others stay arguments.

    Args:
        tape: Where they are read.
        argument: Which argument holds them.
        values: Their values while tracing.
    """

    def __init__(self, tape: Tape, argument: int, values: Array):
        self._tape, self._argument, self._values = tape, argument, values

    def __getitem__(self, index: int) -> Scalar:
        value = float(self._values[index])
        return value if value in (0.0, 1.0, -1.0) else self._tape.load(self._argument, index)

    def vector(self, start: int, count: int = 3) -> Vector:
        """Consecutive numbers."""
        return [self[start + i] for i in range(count)]

    def placement(self, index: int) -> tuple[list[Vector], Vector]:
        """Rotation (3, 3) and origin (3,) number `index` of a geometry."""
        start = 12 * index
        return [self.vector(start + 3 * row) for row in range(3)], self.vector(start + 9)


def folding_pattern(values: Array) -> bytes:
    """What of a machine's numbers is part of its formulas."""
    return np.where(np.isin(values, (0.0, 1.0, -1.0)), values, 2.0).tobytes()


class PositionKinematics:
    """Bodies and loops at traced coordinates, seen from the geometry's trunk.

    Args:
        geometry: The machine's geometry.
        constants: Its numbers.
        q: (nb,).

    Attributes:
        q: (nb,).
        rotation: Of every body, (3, 3).
        origin: Of every body, (3,).
        joint_axes: Of every joint, its spatial column at the trunk's origin: linear, angular.
        offsets: Of every body, its origin seen from its parent's; not of those on the world.
    """

    def __init__(self, geometry: TreeGeometry, constants: FormulaConstants, q: Sequence[Scalar]):
        self.geometry, self._constants, self.q = geometry, constants, list(q)
        identity: list[Vector] = [[float(r == c) for c in range(3)] for r in range(3)]
        self.rotation: list[list[Vector]] = [identity]
        self.origin: list[Vector] = [[0.0] * 3]
        self.offsets: list[Vector] = [[0.0] * 3]
        self.joint_axes: list[tuple[Vector, Vector]] = [([0.0] * 3, [0.0] * 3)]
        for i, parent in enumerate(geometry.parents[1:], start=1):
            arm: Vector = [0.0] * 3
            if i in geometry.floating_bodies - set(geometry.floating_bases):
                rotation, origin = self.rotation[parent], self.origin[parent]
            else:
                is_floating = i in geometry.floating_bases
                rotation, arm = (
                    self._floating_base_placement(i)
                    if is_floating
                    else self._joint_placement(i, q[i - 1])
                )
                origin = add_vectors(self.origin[parent], arm)
                if geometry.reference_body and parent == 0:
                    inverse_rotation = transpose(rotation)
                    self.rotation[0], self.origin[0] = (
                        inverse_rotation,
                        scale_vector(-1.0, matvec(inverse_rotation, origin)),
                    )
                    rotation, origin = identity, [0.0] * 3
            self.offsets.append(scale_vector(float(parent > 0), arm))
            self.rotation.append(rotation)
            self.origin.append(origin)
            axis = self.joint_axis(i)
            self.joint_axes.append(
                (cross(origin, axis), axis) if geometry.is_revolute[i] else (axis, [0.0] * 3)
            )

    @property
    def inverse_characteristic_length(self) -> Scalar:
        """One over the machine's size."""
        return self._constants[len(self.geometry.constants) - 1]

    def joint_axis(self, i: int) -> Vector:
        """Along or about which joint i moves."""
        flyers = self.geometry.floating_bases
        axis_index = (
            2
            if i not in self.geometry.floating_bodies
            else (i - max(j for j in flyers if j <= i)) % 3
        )
        return [row[axis_index] for row in self.rotation[i]]

    def body_motion_axes(self, i: int) -> tuple[Vector, Vector]:
        """How origin and directions of body i move per unit of its joint: linear, angular."""
        along: Vector = self.joint_axis(i)
        still: Vector = [0.0] * 3
        return (still, along) if self.geometry.is_revolute[i] else (along, still)

    def _floating_base_placement(self, i: int) -> tuple[list[Vector], Vector]:
        """Rotation and origin of a free-flyer, from its place and rotation vector."""
        turn, place = self._constants.placement(i - 1)
        position, vector = self.q[i - 1 : i + 2], self.q[i + 2 : i + 5]
        # the world is at its origin, and turned if the trunk flies
        return matmul(turn, rotation_matrix(vector)), add_vectors(place, matvec(turn, position))

    def _joint_placement(self, i: int, q: Scalar) -> tuple[list[Vector], Vector]:
        """Rotation of body i and its origin from its parent's, whose rotation is known."""
        parent = self.geometry.parents[i]
        turn, place = self._constants.placement(i - 1)
        rotation = matmul(self.rotation[parent], turn)
        arm = matvec(self.rotation[parent], place)
        if self.geometry.is_revolute[i]:
            c, s = apply_function("cos", q), apply_function("sin", q)
            return [[c * x + s * y, c * y - s * x, z] for x, y, z in rotation], arm
        return rotation, add_vectors(arm, scale_vector(q, [row[2] for row in rotation]))

    def loop_frame(self, index: int) -> tuple[list[Vector], Vector]:
        """Axes (columns of a rotation) and origin of a loop frame."""
        body = self.geometry.frame_bodies[index]
        rotation, origin = self._constants.placement(len(self.geometry.parents) - 1 + index)
        axes = matmul(self.rotation[body], rotation)
        return axes, add_vectors(self.origin[body], matvec(self.rotation[body], origin))


@dataclass(frozen=True)
class LoopEquationFormula:
    """One traced loop equation; see `LoopEquations`.

    Attributes:
        bodies: On which the two frames are.
        is_translation: Whether it is about a length.
        has_fixed_axis: Whether its axis may as well stand still: the two origins stay together.
        axis: Of the first frame.
        arm: Axis or origin of the second.
        wrench: That is measured by phi.
        phi: Zero where it holds.
        jacobian: dphi/dq by joint.
    """

    bodies: tuple[int, int]
    is_translation: bool
    has_fixed_axis: bool
    axis: Vector
    arm: Vector
    wrench: SpatialVector
    phi: Scalar
    jacobian: dict[int, Scalar]

    def axis_and_arm_rates(
        self, first_motion: SpatialVector, second_motion: SpatialVector
    ) -> tuple[Vector, Vector]:
        """Of axis and arm, whose bodies move so."""
        axis: Vector = [0.0] * 3 if self.has_fixed_axis else cross(first_motion[1], self.axis)
        arm = cross(second_motion[1], self.arm)
        return axis, add_vectors(arm, second_motion[0]) if self.is_translation else arm

    def wrench_rate(
        self, first_motion: SpatialVector, second_motion: SpatialVector
    ) -> SpatialVector:
        """Of the wrench."""
        axis, arm = self.axis_and_arm_rates(first_motion, second_motion)
        moment = add_vectors(cross(arm, self.axis), cross(self.arm, axis))
        return (axis if self.is_translation else [0.0] * 3), moment


def _coupling_formula(factors: Array, offset: float, q: Sequence[Scalar]) -> LoopEquationFormula:
    """A coupling of joints, whose slopes are constant: nothing bends it."""
    zero: Vector = [0.0] * 3
    jacobian: dict[int, Scalar] = {i + 1: float(x) for i, x in enumerate(factors) if x}
    phi = dot([float(x) for x in factors], q) - float(offset)
    return LoopEquationFormula((0, 0), False, False, zero, zero, (zero, zero), phi, jacobian)


def largest_scaled_value(
    values: Sequence[Scalar], is_length: Sequence[bool], inverse_length: Scalar
) -> Scalar:
    """The largest absolute value in rad and shares of the machine's size.

    Args:
        values: Angles and lengths.
        is_length: Which are lengths.
        inverse_length: One over the machine's size.
    """
    angles = [value for value, is_long in zip(values, is_length, strict=True) if not is_long]
    lengths = [value for value, is_long in zip(values, is_length, strict=True) if is_long]
    most = max_abs(angles)
    return maximum(most, inverse_length * max_abs(lengths)) if lengths else most


class LoopFormulas:
    """The independent loop equations at a traced posture.

    `alignments` are cosines that are 1 where the loops' axes are not opposed.

    Args:
        equations: All equations of the machine.
        structure: Which of them count.
        active: Columns of the active joints.
        passive: Columns of the others.
        kinematics: The posture.
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
            return _coupling_formula(
                equations.coupling_factors[coupling],
                equations.coupling_offsets[coupling],
                kinematics.q,
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
                derivative = dot(wrench[0], linear) + dot(wrench[1], angular)
                jacobian[column + 1] = float(sign) * derivative
        bodies = kinematics.geometry.frame_bodies
        locks_all_translations = all(LOOP_TYPES[equations.loops[one // 2].type][:3])
        has_fixed_axis = (
            is_translation
            and locks_all_translations
            and self._structure.redundancy.tolerance <= CLOSED_TOLERANCE
        )
        pair = bodies[one], bodies[one + 1]
        return LoopEquationFormula(
            pair, is_translation, has_fixed_axis, axis, arm, wrench, phi, jacobian
        )

    def solve_passive(
        self, active_rows: dict[int, Vector], right_sides: Sequence[Vector]
    ) -> tuple[dict[int, Vector], list[Scalar]]:
        """Solve J x = right for the passive joints, block after block.

        Args:
            active_rows: Rows of x of the active joints, by joint.
            right_sides: Right sides, by row.

        Returns:
            Rows of x of all joints, and the determinants of the blocks.
        """
        x = dict(active_rows)
        determinants = []
        for rows, columns in self._structure.blocks:
            joints = [self.passive_joints[c] for c in columns]
            matrix = [[self.rows[r].jacobian.get(joint, 0.0) for joint in joints] for r in rows]
            # the order of the blocks knows which slopes vanish everywhere
            before = {joint: row for joint, row in x.items() if joint not in joints}
            sides = [self._right_side(r, before, right_sides[r]) for r in rows]
            found, determinant = solve_linear_system(matrix, sides)
            determinants.append(determinant)
            x |= dict(zip(joints, found, strict=True))
        return x, determinants

    def _right_side(self, row: int, known: dict[int, Vector], side: Vector) -> Vector:
        """Right side of a row without what the joints in x have to do with it."""
        for joint, slope in self.rows[row].jacobian.items():
            if joint in known:
                side = subtract_vectors(side, scale_vector(slope, known[joint]))
        return side

    @cached_property
    def _gamma_and_determinants(self) -> tuple[dict[int, Vector], list[Scalar]]:
        n = len(self.active_joints)
        known: dict[int, Vector] = {
            joint: [float(i == k) for k in range(n)] for i, joint in enumerate(self.active_joints)
        }
        return self.solve_passive(known, [[0.0] * n for _ in self.rows])

    @property
    def gamma(self) -> dict[int, Vector]:
        """Rows of gamma (n,) by joint."""
        return self._gamma_and_determinants[0]

    @property
    def determinants(self) -> list[Scalar]:
        """Of the blocks, in their order."""
        return self._gamma_and_determinants[1]

    @cached_property
    def newton_step(self) -> dict[int, Scalar]:
        """Newton's step of the passive joints, by joint."""
        held: dict[int, Vector] = {joint: [0.0] for joint in self.active_joints}
        x, _ = self.solve_passive(held, [[-row.phi] for row in self.rows])
        return {joint: x[joint][0] for joint in self.passive_joints}

    @property
    def largest_residual(self) -> Scalar:
        """The largest absolute phi of the independent equations, in shares of the size."""
        return self._largest_scaled_residual(self.rows, self._structure.independent_rows)

    @property
    def largest_redundant_residual(self) -> Scalar:
        """The largest absolute phi of the redundant equations, likewise."""
        return self._largest_scaled_residual(self._redundant_rows, self._structure.redundant_rows)

    def _largest_scaled_residual(
        self, rows: Sequence[LoopEquationFormula], indices: Indices
    ) -> Scalar:
        long = self._is_translation[indices].tolist()
        return largest_scaled_value(
            [row.phi for row in rows], long, self._kinematics.inverse_characteristic_length
        )


class VelocityKinematics:
    """Bodies in motion at a traced posture.

    Args:
        kinematics: Bodies.
        loops: Loops at that posture.
        joint_velocities: (nb + 1,) joint velocities, 0 for the world.
        gravity: (3,) in the trunk's directions; the world accelerates with -gravity, so that
            weights need no terms of their own.
        carriers: (nb + 1,) the body whose motion each body shares, its parent or 0.

    Attributes:
        velocities: Of every body, linear at the trunk's origin, angular.
        bias_accelerations: The same at zero joint acceleration.
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
        self.velocities: list[tuple[Vector, Vector]] = [([0.0] * 3, [0.0] * 3)]
        self.bias_accelerations: list[tuple[Vector, Vector]] = [([-g for g in gravity], [0.0] * 3)]
        for i in range(1, len(kinematics.joint_axes)):
            parent = carriers[i]
            linear, angular = (
                scale_vector(joint_velocities[i], part) for part in kinematics.joint_axes[i]
            )
            v, w = self.velocities[parent]
            a, e = self.bias_accelerations[parent]
            if (
                i not in kinematics.geometry.floating_bodies
            ):  # whose columns turn with the last of its bodies
                a = add_vectors(a, cross(w, linear), cross(v, angular))
                e = add_vectors(e, cross(w, angular))
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
        return turned + spatial_dot(
            row.wrench,
            subtract_spatial(self.bias_accelerations[two], self.bias_accelerations[one]),
        )
