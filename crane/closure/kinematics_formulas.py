"""Geometry, position kinematics and constants of one machine as symbolic formulas.

With spatial vectors, pairs of a linear and an angular part, and rotation vectors that are regular
at zero, see `crane.description.rotation_vectors`.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import pinocchio as pin

from crane.closure.loop_equations import (
    LoopEquations,
    rotation_with_z_axis,
    supporting_bodies,
)
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
    subtract_vectors,
    transpose,
    where_positive,
)
from crane.codegen.symbolic_linear_algebra import solve_linear_system
from crane.common.samples import Array

Vector = list[Scalar]
SpatialVector = tuple[
    Vector, Vector
]  # motion [v, w] of a point and a body, wrench [f, n] about a point
ZERO_VECTOR: SpatialVector = ([0.0] * 3, [0.0] * 3)


def spatial_dot(first: SpatialVector, second: SpatialVector) -> Scalar:
    """Power of a wrench on a motion."""
    return dot(first[0], second[0]) + dot(first[1], second[1])


def add_spatial(*vectors: SpatialVector) -> SpatialVector:
    """Sum of spatial vectors."""
    return add_vectors(*(pair[0] for pair in vectors)), add_vectors(*(pair[1] for pair in vectors))


def subtract_spatial(first: SpatialVector, second: SpatialVector) -> SpatialVector:
    """Difference of spatial vectors."""
    return subtract_vectors(first[0], second[0]), subtract_vectors(first[1], second[1])


def scale_spatial(factor: Scalar, vector: SpatialVector) -> SpatialVector:
    """A factor times a spatial vector."""
    return scale_vector(factor, vector[0]), scale_vector(factor, vector[1])


def shift_motion(motion: SpatialVector, arm: Vector) -> SpatialVector:
    """The motion of the point at `arm` from the reference point of a motion."""
    linear, angular = motion
    return add_vectors(linear, cross(angular, arm)), angular


def shift_wrench(wrench: SpatialVector, arm: Vector) -> SpatialVector:
    """A wrench at the point at `arm` from a reference point, referred to that reference point."""
    force, moment = wrench
    return force, add_vectors(moment, cross(arm, force))


def cross_motion(motion: SpatialVector, other: SpatialVector) -> SpatialVector:
    """V x S: rate of a motion S that is fixed to a body with velocity V."""
    (v, w), (u, t) = motion, other
    return add_vectors(cross(w, u), cross(v, t)), cross(w, t)


def cross_wrench(motion: SpatialVector, wrench: SpatialVector) -> SpatialVector:
    """V x* F: rate of a wrench F that is fixed to a body with velocity V."""
    (v, w), (force, moment) = motion, wrench
    return cross(w, force), add_vectors(cross(w, moment), cross(v, force))


# added under a square root: far below rounding, but its root is not zero
_NORM_REGULARIZATION = 1e-300


def rotation_matrix(vector: Sequence[Scalar]) -> list[list[Scalar]]:
    """R = 1 + (sin t / t) r x + (1/2) (sin(t/2) / (t/2))^2 (r x)^2, t = |r| (Rodrigues)."""
    length = _regularized_norm(vector)
    half = 0.5 * length
    first = apply_function("sin", length) / length
    ratio = apply_function("sin", half) / half
    second = 0.5 * ratio * ratio
    columns = []
    for k in range(3):
        unit = [float(i == k) for i in range(3)]
        turned = cross(vector, unit)
        columns.append(
            add_vectors(
                unit, scale_vector(first, turned), scale_vector(second, cross(vector, turned))
            )
        )
    return [list(row) for row in zip(*columns, strict=True)]


def rotation_vector_derivative(
    vector: Sequence[Scalar], angular_velocity: Sequence[Scalar]
) -> list[Scalar]:
    """Derivative r' = (1 + r x / 2 + c (r x)^2) w of a rotation vector, w in the body's axes.

    With c t^2 = 1 - (t/2) cot(t/2), t = |r|.
    """
    length = _regularized_norm(vector)
    half = 0.5 * length
    share = 1.0 - half * apply_function("cos", half) / apply_function("sin", half)
    unit = scale_vector(1.0 / length, vector)
    turned = cross(unit, angular_velocity)
    return add_vectors(
        angular_velocity, scale_vector(half, turned), scale_vector(share, cross(unit, turned))
    )


def coordinate_rates(
    geometry: "TreeGeometry", q: Sequence[Scalar], joint_velocities: Sequence[Scalar]
) -> list[Scalar]:
    """Derivatives (nb,) of coordinates (nb,) along joint velocities (nb,).

    They differ for ball joints and floating bases, see `crane.description.rotation_vectors`.
    """
    out = list(joint_velocities)
    for i in geometry.floating_bases:
        rotation = rotation_matrix(q[i + 2 : i + 5])
        out[i - 1 : i + 2] = matvec(rotation, out[i - 1 : i + 2])
    for i in geometry.rotation_bodies:
        part = slice(i - 1, i + 2)
        out[part] = rotation_vector_derivative(q[part], out[part])
    return out


def adjust_motion(
    geometry: "TreeGeometry",
    q: Sequence[Scalar],
    motion: Sequence[Scalar],
    columns: Sequence[Sequence[Scalar]],
    steps: Mapping[int, Scalar],
) -> list[Scalar]:
    """Add columns of gamma to a motion of the joints so that coordinates change as required.

    Active coordinates that are parts of rotation vectors change by more than the motions of their
    own joints.

    Args:
        geometry: Geometry of the machine.
        q: (nb,).
        motion: (nb,).
        columns: (k, nb) columns of gamma.
        steps: Changes of k coordinates, by joint.
    """
    steps_of_motion = coordinate_rates(geometry, q, motion)
    rates = [coordinate_rates(geometry, q, column) for column in columns]
    factors, _ = solve_linear_system(
        [[rate[joint - 1] for rate in rates] for joint in steps],
        [[step - steps_of_motion[joint - 1]] for joint, step in steps.items()],
    )
    additions = (scale_vector(x, column) for (x,), column in zip(factors, columns, strict=True))
    return add_vectors(motion, *additions)


def wrap_rotation_vector(vector: Sequence[Scalar]) -> list[Scalar]:
    """The same rotation with a vector of length pi or less, from one shorter than 2 pi."""
    length = _regularized_norm(vector)
    return scale_vector(
        where_positive(length - math.pi, 1.0 - 2.0 * math.pi / length, 1.0), vector
    )


def _regularized_norm(vector: Sequence[Scalar]) -> Scalar:
    return apply_function("sqrt", dot(vector, vector) + _NORM_REGULARIZATION)


_RIGHT_ANGLE_ROUNDING = 1e-15  # rounding of a rotation by a right angle


@dataclass(frozen=True, eq=False)
class TreeGeometry:
    """The geometry of a machine, which its kinematics formulas depend on.

    Joint i (1 to nb) moves body i and turns about or slides along the body's z axis; body 0 is the
    world. A ball joint is a series of three bodies, a floating base one of six on the world, all
    at the position of the last one, which alone has mass: the velocities are along and about the
    axes of that body.

    Attributes:
        parents: (nb + 1,) parent bodies.
        is_revolute: (nb + 1,) whether the joint is revolute.
        floating_bases: First body of each floating base.
        rotation_bodies: First of the three bodies of each rotation vector.
        body_rotations: (nb + 1, 3, 3) from the axes of the body here to those of Pinocchio's
            joint.
        constants: (12 (nb + frames) + 1,) rotation and origin of every joint frame in its parent
            body, then of every loop frame in its body; one over the characteristic length.
        frame_bodies: Body of each loop frame, predecessor and successor of each loop in turn.
    """

    parents: tuple[int, ...]
    is_revolute: tuple[bool, ...]
    floating_bases: tuple[int, ...]
    rotation_bodies: tuple[int, ...]
    body_rotations: Array
    constants: Array
    frame_bodies: tuple[int, ...]

    @property
    def reference_body(self) -> int:
        """The body in whose frame formulas are shortest: the one that carries all others, if any.

        In its frame the joint of this body moves nothing but the world, and planes that contain it
        stay fixed.
        """
        if self.parents.count(0) != 2 or 0 in self.frame_bodies:
            return 0
        return len(self.series_of_body.get(1, (1,)))

    @cached_property
    def series_of_body(self) -> dict[int, tuple[int, ...]]:
        """The bodies of the series of each body of a ball joint or floating base."""
        series = [tuple(range(i, i + 3)) for i in self.rotation_bodies]
        series += [tuple(range(i, i + 6)) for i in self.floating_bases]  # instead of their last 3
        return {i: bodies for bodies in series for i in bodies}

    @property
    def massless_bodies(self) -> frozenset[int]:
        """Bodies of ball joints and floating bases without mass."""
        return frozenset(i for i, series in self.series_of_body.items() if i != series[-1])

    def supporting_bodies(self, body: int) -> list[int]:
        """A body and the bodies that carry it, except the world."""
        return supporting_bodies(self.parents, body)

    def partly_active_joints(self, active_joints: Collection[int]) -> list[int]:
        """Active joints of rotation vectors of which only some are active."""
        vectors = [{body, body + 1, body + 2} for body in self.rotation_bodies]
        parts = [sorted(vector.intersection(active_joints)) for vector in vectors]
        return [joint for part in parts if len(part) < 3 for joint in part]


@lru_cache(maxsize=8)
def tree_geometry(equations: LoopEquations) -> TreeGeometry:
    """The geometry of an assembled model."""
    model, coordinates = equations.model, equations.coordinates
    parents, rotations = coordinates.parents, [pin.SE3.Identity()]
    revolute = [False, *(not slides for slides in coordinates.is_translation)]
    body_of_joint = coordinates.body_of_joint
    placements = []
    for i in range(1, model.njoints):
        joint = model.joints[i]
        placement = rotations[body_of_joint[model.parents[i]]].inverse() * model.jointPlacements[i]
        if joint.nv > 1:
            placements += [placement, *[pin.SE3.Identity()] * (joint.nv - 1)]
            rotations += [pin.SE3.Identity()] * joint.nv
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
        tuple(column + 1 for column in coordinates.rotation_columns),
        np.array([turn.rotation for turn in rotations]),
        np.concatenate([*numbers, [1.0 / equations.characteristic_length]]),
        tuple(body_of_joint[body] for body, _ in frames),
    )


def _round_to_right_angles(rotation: Array) -> Array:
    """Rotations by right angles with exact zeros and ones, which fold into the formulas."""
    rounded = np.round(rotation)
    return np.where(np.abs(rotation - rounded) < _RIGHT_ANGLE_ROUNDING, rounded, rotation)


class FormulaConstants:
    """Constants of a machine: 0, 1 and -1 are folded into the formulas, others stay arguments.

    Args:
        tape: Tape to trace on.
        argument: Index of the argument that holds them.
        values: Their values while tracing.
    """

    def __init__(self, tape: Tape, argument: int, values: Array):
        self._tape, self._argument, self._values = tape, argument, values

    def __getitem__(self, index: int) -> Scalar:
        value = float(self._values[index])
        return value if value in (0.0, 1.0, -1.0) else self._tape.load(self._argument, index)

    def vector(self, start: int, count: int = 3) -> Vector:
        """Consecutive constants."""
        return [self[start + i] for i in range(count)]

    def placement(self, index: int) -> tuple[list[Vector], Vector]:
        """Rotation (3, 3) and origin (3,) of frame `index` of a geometry."""
        start = 12 * index
        return [self.vector(start + 3 * row) for row in range(3)], self.vector(start + 9)


def folding_pattern(values: Array) -> bytes:
    """The pattern of constants that are folded into formulas."""
    return np.where(np.isin(values, (0.0, 1.0, -1.0)), values, 2.0).tobytes()


class PositionKinematics:
    """Symbolic placements of bodies and loop frames, in the frame of the reference body.

    Args:
        geometry: Geometry of the machine.
        constants: Its constants.
        q: (nb,).

    Attributes:
        q: (nb,).
        rotation: Rotation (3, 3) of every body.
        origin: Origin (3,) of every body.
        joint_axes: Spatial column of every joint at the reference origin: linear, angular.
        offsets: Origin of every body relative to its parent's; zero for bodies on the world.
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
            if i != geometry.series_of_body.get(i, (i,))[0]:
                rotation, origin = self.rotation[parent], self.origin[parent]
            else:
                rotation, arm = self._joint_placement(i)
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
        """One over the characteristic length."""
        return self._constants[len(self.geometry.constants) - 1]

    def joint_axis(self, i: int) -> Vector:
        """Axis of joint i."""
        series = self.geometry.series_of_body.get(i)
        axis_index = 2 if series is None else (i - series[0]) % 3
        return [row[axis_index] for row in self.rotation[i]]

    def body_motion_axes(self, i: int) -> tuple[Vector, Vector]:
        """Motion of the origin and axes of body i per unit of its joint: linear, angular."""
        along: Vector = self.joint_axis(i)
        still: Vector = [0.0] * 3
        return (still, along) if self.geometry.is_revolute[i] else (along, still)

    def _joint_placement(self, i: int) -> tuple[list[Vector], Vector]:
        """Rotation of body i, and its origin relative to its parent's."""
        parent, q = self.geometry.parents[i], self.q[i - 1]
        turn, place = self._constants.placement(i - 1)
        if i in self.geometry.floating_bases:
            position, vector = self.q[i - 1 : i + 2], self.q[i + 2 : i + 5]
            # the world is at the origin, and rotated if the reference body floats
            return (
                matmul(turn, rotation_matrix(vector)),
                add_vectors(place, matvec(turn, position)),
            )
        rotation = matmul(self.rotation[parent], turn)
        arm = matvec(self.rotation[parent], place)
        if i in self.geometry.rotation_bodies:
            return matmul(rotation, rotation_matrix(self.q[i - 1 : i + 2])), arm
        if self.geometry.is_revolute[i]:
            c, s = apply_function("cos", q), apply_function("sin", q)
            return [[c * x + s * y, c * y - s * x, z] for x, y, z in rotation], arm
        return rotation, add_vectors(arm, scale_vector(q, [row[2] for row in rotation]))

    def loop_frame(self, index: int) -> tuple[list[Vector], Vector]:
        """Axes (columns of a rotation) and origin of a loop frame."""
        body = self.geometry.frame_bodies[index]
        rotation, origin = self._constants.placement(len(self.geometry.parents) - 1 + index)
        return matmul(self.rotation[body], rotation), add_vectors(
            self.origin[body], matvec(self.rotation[body], origin)
        )


def largest_scaled_value(
    values: Sequence[Scalar], is_length: Sequence[bool], inverse_length: Scalar
) -> Scalar:
    """The largest absolute value, in rad and characteristic lengths.

    Args:
        values: Angles and lengths.
        is_length: Which of them are lengths.
        inverse_length: One over the characteristic length.
    """
    lengths = [value for value, is_long in zip(values, is_length, strict=True) if is_long]
    most = max_abs(x for x, is_long in zip(values, is_length, strict=True) if not is_long)
    return maximum(most, inverse_length * max_abs(lengths)) if lengths else most
