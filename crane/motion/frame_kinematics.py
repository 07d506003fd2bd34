"""Forward kinematics of a frame in the active coordinates: position, Jacobian and bias.

In Python with Pinocchio, and compiled.
"""

import math
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.closure.kinematics_formulas import FormulaConstants, PositionKinematics, folding_pattern
from crane.closure.loop_formulas import LoopFormulas, VelocityKinematics
from crane.codegen import FormulaTooLongError, Program, Scalar, Tape
from crane.codegen.symbolic import add_vectors, cross, dot, matvec, scale_vector, subtract_vectors
from crane.common.errors import ClosureError, InputError, check_name
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, apply_per_sample, as_samples
from crane.common.threads import ThreadLocal
from crane.machine.machine import Machine
from crane.motion.attitude import (
    INCLINATION,
    AttitudeCoordinates,
    InclinationCoordinate,
    RotationCoordinates,
)

# of the characteristic length per stroke, that counts as motion of the frame
_RANK_TOLERANCE = 1e-6
_MAX_GRID_SIZE = 243  # start configurations
_BLOCK_SAMPLES = 1000  # samples of a stack at once
ATTITUDE_NAMES = (INCLINATION, "rotation")


class CompiledPoint:
    """Position of a frame, compiled.

    Args:
        machine: The machine.
        frame: Index of the frame in the Pinocchio model.

    Attributes:
        frame_offset: (3,) origin of the frame in its body, the second argument of the formulas.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """

    def __init__(self, machine: Machine, frame: int):
        compiled_closure = self._compiled_closure = machine.closure.compiled_closure
        model_frame = machine.model.frames[frame]
        self._body = machine.coordinates.body_of_joint[model_frame.parentJoint]
        self.frame_offset = (
            compiled_closure.geometry.body_rotations[self._body].T
            @ model_frame.placement.translation
        )
        self._nq, self._n = machine.model.nv, len(machine.active)
        name = ("frame", type(self).__name__, self._body, folding_pattern(self.frame_offset))
        if name not in compiled_closure.programs:
            compiled_closure.programs[name] = compiled_closure.cached_program(
                name, self._build_program
            )
        self._program = compiled_closure.programs[name]

    def evaluate(self, q: Array, v_a: Array | None = None) -> Array:
        """Rows of `_output_expressions` for configurations (N, nq) and velocities (N, n)."""
        v_a = np.zeros((len(q), self._n)) if v_a is None else v_a
        out = np.empty((len(q), self._program.formula_outputs("formula").size))
        constants = self._compiled_closure.geometry.constants, self.frame_offset
        for i in range(
            0, len(q), _BLOCK_SAMPLES
        ):  # copies of this size stay in the processor's cache
            blocks = (np.ascontiguousarray(x[i : i + _BLOCK_SAMPLES]) for x in (q, v_a, out))
            self._program.call("rows", min(_BLOCK_SAMPLES, len(q) - i), *constants, *blocks)
        return out

    def _output_expressions(self, tape: Tape) -> list[Scalar]:
        """Expressions of an output row: x (3)."""
        bodies, _, point = self._trace_point(tape)
        return self._rotate_to_world(bodies, subtract_vectors(point, bodies.origin[0]))

    def _trace_point(self, tape: Tape) -> tuple[PositionKinematics, LoopFormulas, list[Scalar]]:
        """Bodies, loops, and the position of the frame in the reference body."""
        _, bodies, loops = self._compiled_closure.trace_kinematics(tape, 0, 2)
        frame_offset = FormulaConstants(tape, 1, self.frame_offset).vector(0)
        point = add_vectors(
            bodies.origin[self._body], matvec(bodies.rotation[self._body], frame_offset)
        )
        return bodies, loops, point

    def _rotate_to_world(self, bodies: PositionKinematics, vector: list[Scalar]) -> list[Scalar]:
        """Components in the world frame of a vector of the reference body."""
        return matvec([list(axis) for axis in zip(*bodies.rotation[0], strict=True)], vector)

    def new_program(self) -> Program:
        """Its functions, not compiled, for other targets."""
        program = Program()
        self._build_program(program)
        return program

    def _build_program(self, program: Program) -> None:
        nq, n = self._nq, self._n
        size = program.add_formula("formula", 4, self._output_expressions(Tape())).size
        row_lengths = {"geometry": None, "place": None, "q": nq, "v": n, "out": size}
        program.add_formula_loop("rows", "formula", row_lengths)


class CompiledFrame(CompiledPoint):
    """Position, reduced Jacobian and bias of a frame, compiled."""

    def _output_expressions(self, tape: Tape) -> list[Scalar]:
        """Expressions of an output row: x (3), J gamma (3 n), bias (3)."""
        n, body = self._n, self._body
        bodies, loops, point = self._trace_point(tape)
        v_a, parents = tape.load_vector(3, 0, n), bodies.geometry.parents
        joint_rates: list[Scalar] = [0.0]
        joint_rates += [dot(loops.gamma[i], v_a) for i in range(1, len(parents))]
        motion = VelocityKinematics(bodies, loops, joint_rates, [0.0] * 3, parents)
        columns: list[list[Scalar]] = [[0.0] * 3 for _ in range(n)]
        (v, w), (a, e) = motion.velocities[body], motion.bias_accelerations[body]
        i = body
        while i > 0:  # motion of the point by each joint that carries it
            linear, angular = bodies.joint_axes[i]
            point_velocity = add_vectors(linear, cross(angular, point))
            columns = [
                add_vectors(column, scale_vector(factor, point_velocity))
                for column, factor in zip(columns, loops.gamma[i], strict=True)
            ]
            a = add_vectors(a, scale_vector(motion.drift[i], linear))
            e = add_vectors(e, scale_vector(motion.drift[i], angular))
            i = parents[i]
        acceleration = add_vectors(a, cross(e, point), cross(w, add_vectors(v, cross(w, point))))
        jacobian = [self._rotate_to_world(bodies, column) for column in columns]
        outputs = self._rotate_to_world(bodies, subtract_vectors(point, bodies.origin[0]))
        outputs += [column[row] for row in range(3) for column in jacobian]
        return [*outputs, *self._rotate_to_world(bodies, acceleration)]


class FrameKinematics(OneLineRepr):
    """Position and attitude of one frame as functions of q_A.

        x = p(f(q_A)),    x' = J gamma v_A,    x'' = J gamma a_A + bias.

    If an attitude is given, its coordinates follow those of the position: the "inclination" of the
    frame, or its complete "rotation", whose rates are the angular velocity; see
    `crane.motion.attitude`.

    Args:
        machine: The machine.
        frame: Name of a link; default the tip of the machine.

    Raises:
        InputError: The frame is unknown, or the machine has no tip.
    """

    def __init__(self, machine: Machine, frame: str | None = None):
        frame = machine.tip if frame is None else frame
        if frame is None:
            raise InputError(
                f"machine '{machine.name}' has no tip, name a frame: a link here, or as 'tip' "
                "in the machine file"
            )
        self.machine, self.frame = machine, frame
        self._model, self._frame = machine.model, machine.frame(frame)
        stroke_lengths = machine.upper - machine.lower
        units = machine.closure.units[machine.closure.active]
        scales = np.where(np.isfinite(stroke_lengths), stroke_lengths, units)
        self._stroke_scales = scales * machine.is_driven  # free joints do not move
        self._characteristic_length = machine.closure.characteristic_length
        self._attitudes: dict[str, AttitudeCoordinates] = {}
        self._thread_local_data = ThreadLocal(self._model.createData)

    def _one_line(self) -> str:
        return f"{type(self).__name__} of '{self.frame}' of '{self.machine.name}'"

    def position(self, q_a: ArrayLike) -> Array:
        """Position of the frame in the world.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3,) or (N, 3) [m].
        """
        return self.positions_at_configurations(self.machine.closure.solve(q_a))

    def positions_at_configurations(self, q: ArrayLike) -> Array:
        """Position in the world at closed configurations.

        Args:
            q: (nq,) or (N, nq) [m], [rad].

        Returns:
            (3,) or (N, 3) [m].
        """
        samples = as_samples(q, self._model.nv, "q", self.machine.joints)
        if samples.ndim == 2 and self._compiled_point is not None:
            return self._compiled_point.evaluate(samples)
        return apply_per_sample(self.position_at_configuration, samples)

    def position_at_configuration(self, q: Array) -> Array:
        """Position (3,) [m] at one configuration (nq,)."""
        return self._pose(q)[0]

    def rotation(self, q_a: ArrayLike) -> Array:
        """Rotation matrix of the frame in the world.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3, 3) or (N, 3, 3).
        """
        return apply_per_sample(lambda q: self._pose(q)[1], self.machine.closure.solve(q_a))

    def inclination(self, q_a: ArrayLike) -> Array:
        """Inclination of the frame: elevation of its x axis above the horizontal.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            () or (N,) [rad], from -pi to pi.

        Raises:
            InputError: It is not defined, see `crane.motion.attitude.InclinationCoordinate`.
        """
        return InclinationCoordinate(self.machine, self.frame).value(self.rotation(q_a))

    def jacobian(self, q_a: ArrayLike, attitude: str | None = None) -> Array:
        """Reduced Jacobian dx/dq_A = J gamma.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            attitude: "inclination" or "rotation", whose rates follow those of the position.

        Returns:
            (3, n) or (N, 3, n); 3 + k in place of 3 with the k coordinates of an attitude.
        """
        q = self.machine.closure.solve(q_a)
        coordinates = None if attitude is None else self._attitude_coordinates(attitude)
        if coordinates is None and q.ndim == 2 and self._compiled_frame is not None:
            return self._compiled_frame.evaluate(q)[:, 3:-3].reshape(len(q), 3, -1)
        return apply_per_sample(lambda one: self._attitude_jacobian(one, coordinates), q)

    def bias(self, q_a: ArrayLike, v_a: ArrayLike, attitude: str | None = None) -> Array:
        """Acceleration of the frame for a_A = 0.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            attitude: "inclination" or "rotation", whose accelerations follow those of the
                position.

        Returns:
            (3,) or (N, 3) [m/s2]; 3 + k in place of 3 with the k coordinates of an attitude.
        """
        attitude_coordinates = None if attitude is None else self._attitude_coordinates(attitude)

        def sample_bias(q: Array, v_a: Array) -> Array:
            v = self.machine.closure.gamma(q) @ v_a
            drift = self.machine.closure.drift(q, v)
            pin.forwardKinematics(
                self._model, self._data, self.machine.coordinates.configuration(q), v, drift
            )
            frame = self._model, self._data, self._frame
            second = pin.getFrameClassicalAcceleration(*frame, pin.LOCAL_WORLD_ALIGNED)
            if attitude_coordinates is None:
                return np.array(second.linear)
            rate = pin.getFrameVelocity(*frame, pin.LOCAL_WORLD_ALIGNED)
            rotation = pin.updateFramePlacement(*frame).rotation
            bend = attitude_coordinates.accelerations(rotation, rate.angular, second.angular)
            return np.concatenate([second.linear, bend])

        v_a = as_samples(v_a, len(self.machine.active), "v_a", self.machine.active)
        q = self.machine.closure.solve(q_a)
        is_matching_stack = q.ndim == 2 and q.shape[:1] == v_a.shape[:-1]
        if is_matching_stack and attitude_coordinates is None and self._compiled_frame is not None:
            return self._compiled_frame.evaluate(q, v_a)[:, -3:]
        return apply_per_sample(sample_bias, q, v_a)

    def _attitude_coordinates(self, name: str) -> AttitudeCoordinates:
        """Attitude coordinates by name, which the drives can set independently of the position.

        Raises:
            InputError: The name is unknown, or the drives cannot set them.
        """
        check_name(name, ATTITUDE_NAMES, f"attitude '{name}' is unknown")
        if name in self._attitudes:
            return self._attitudes[name]
        coordinates: AttitudeCoordinates = RotationCoordinates()
        if name == INCLINATION:
            coordinates = InclinationCoordinate(self.machine, self.frame)
        starts = self._start_configurations
        jacobians = np.array(
            [
                self._attitude_jacobian(q, coordinates) * self._stroke_scales
                for q, _ in starts[:: max(1, len(starts) // 6)]
            ]
        )
        position_rank, total_rank = (
            int(np.linalg.matrix_rank(x, tol=_RANK_TOLERANCE * self._characteristic_length).max())
            for x in (jacobians[:, :3], jacobians)
        )
        if total_rank < position_rank + len(coordinates.names):
            raise InputError(
                f"'{self.machine.name}' has too few drives for {', '.join(coordinates.names)} of "
                f"'{self.frame}': they move it in {position_rank} directions and rotate it "
                f"in {total_rank - position_rank} further ones"
            )
        self._attitudes[name] = coordinates
        return coordinates

    @property
    def _data(self) -> pin.Data:
        return self._thread_local_data.value

    @cached_property
    def _compiled_frame(self) -> "CompiledFrame | None":
        """Compiled position, Jacobian and bias; None if the formulas are too long."""
        try:
            return CompiledFrame(self.machine, self._frame)
        except FormulaTooLongError:
            return None

    @cached_property
    def _compiled_point(self) -> "CompiledPoint | None":
        """Compiled position; None if the formulas are too long."""
        try:
            return CompiledPoint(self.machine, self._frame)
        except FormulaTooLongError:
            return None

    def tree_jacobian(self, q: Array) -> Array:
        """Jacobian dx/dq (3, nv) of the spanning tree at one configuration (nq,)."""
        return self._spatial_tree_jacobian(q)[:3]

    def _spatial_tree_jacobian(self, q: Array) -> Array:
        """Linear and angular Jacobian (6, nv) of the spanning tree."""
        jacobian: Array = pin.computeFrameJacobian(
            self._model,
            self._data,
            self.machine.coordinates.configuration(q),
            self._frame,
            pin.LOCAL_WORLD_ALIGNED,
        )
        return jacobian.reshape(6, -1)  # Pinocchio returns a vector for a single joint

    def _attitude_jacobian(self, q: Array, attitude: AttitudeCoordinates | None) -> Array:
        """Reduced Jacobian (3, n) of the position, or (3 + k, n) of position and attitude."""
        if attitude is None:
            return self.tree_jacobian(q) @ self.machine.closure.gamma(q)
        jacobian = self._spatial_tree_jacobian(q) @ self.machine.closure.gamma(q)
        return np.vstack([jacobian[:3], attitude.rates(self._pose(q)[1], jacobian[3:])])

    def _pose(self, q: Array) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) at one configuration (nq,)."""
        pin.forwardKinematics(self._model, self._data, self.machine.coordinates.configuration(q))
        placement = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(placement.translation), np.array(placement.rotation)

    @cached_property
    def _start_configurations(self) -> list[tuple[Array, Array]]:
        """Start configurations (q, position) over the whole range of the strokes."""
        machine = self.machine
        stroke_values = [[value] for value in machine.home[machine.closure.active]]
        spans = machine.upper - machine.lower
        for i in np.flatnonzero(machine.is_driven & np.isfinite(spans)):
            stroke_values[i] = list(machine.lower[i] + spans[i] * np.array([0.2, 0.5, 0.8]))
        configurations = [(np.array(machine.home), self.position_at_configuration(machine.home))]
        shape = tuple(len(axis) for axis in stroke_values)
        if math.prod(shape) <= _MAX_GRID_SIZE:
            cells = np.stack(np.unravel_index(np.arange(math.prod(shape)), shape), axis=1)
        else:  # for many joints a random subset
            cells = np.random.default_rng(0).integers(shape, size=(_MAX_GRID_SIZE, len(shape)))
        for cell in cells:
            try:
                q = machine.closure.solve(
                    np.array([axis[i] for axis, i in zip(stroke_values, cell, strict=True)])
                )
            except ClosureError:
                continue
            configurations.append((q, self.position_at_configuration(q)))
        return configurations
