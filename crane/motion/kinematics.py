"""The tip (or any other frame) as a function of the active coordinates, and back."""

import math
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.closure.kinematics_formulas import FormulaConstants, PositionKinematics, folding_pattern
from crane.closure.loop_formulas import LoopFormulas, VelocityKinematics
from crane.codegen import FormulaTooLongError, Program, Scalar, Tape
from crane.codegen.symbolic import add_vectors, cross, dot, matvec, scale_vector, subtract_vectors
from crane.common.errors import ClosureError, InputError, UnreachableTipError, suggest_names
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, apply_per_sample, as_sample, as_samples
from crane.common.threads import ThreadLocal
from crane.machine import Machine
from crane.motion.attitude import (
    INCLINATION,
    AttitudeCoordinates,
    InclinationCoordinate,
    RotationCoordinates,
    roll_pitch_yaw,
)

# in shares of the machine's size, or of the distance of what is sought if that is farther
_POSITION_TOLERANCE = 1e-11
_ROUNDING_TOLERANCE = 1e-15
_RANK_TOLERANCE = 1e-6  # of the machine's size, by which a stroke moves the frame
_ORTHOGONALITY_TOLERANCE = 1e-6
_MAX_GRID_SIZE = 243  # postures all over the strokes
_ATTITUDE_STARTS = 40  # postures to start from, where an attitude is sought
_KNOT_STRIDE = 16  # samples of a path between those that are searched for one by one
_BLOCK_SAMPLES = 1000  # samples of a stack at once
_INTERPOLATION_TOLERANCE = (
    0.02  # share of the strokes by which a sample may miss the curve through those
)


ATTITUDE_NAMES = (INCLINATION, "rotation")


def norm(vector: Array) -> float:
    """Its length."""
    return float(np.linalg.norm(vector))


class Kinematics(OneLineRepr):
    """Position of one frame as a function of q_A.

        x = p(f(q_A)),    x' = J gamma v_A,    x'' = J gamma a_A + bias.

    Where an attitude is asked for, its coordinates come after those of the position: the
    "inclination" of the frame, or its whole "rotation", whose rates are the angular velocity; see
    `crane.motion.attitude`.

    Args:
        machine: The machine.
        frame: A link; the machine's tip if not given.

    Raises:
        InputError: Unknown frame, or the machine has no tip.
    """

    def __init__(self, machine: Machine, frame: str | None = None):
        if frame is None:
            if machine.tip is None:
                raise InputError(
                    f"machine '{machine.name}' has no tip, name a frame: a link here, or as 'tip' "
                    "in the machine file"
                )
            frame = machine.tip
        self.machine, self.frame = machine, frame
        self._model = machine.model
        self._frame = machine.frame(frame)
        stroke_lengths = machine.upper - machine.lower
        # free joints stay where they are
        coordinate_units = machine.closure.units[machine.closure.active]
        self._stroke_scales = (
            np.where(np.isfinite(stroke_lengths), stroke_lengths, coordinate_units)
            * machine.is_driven
        )
        self._characteristic_length = machine.closure.characteristic_length
        self._attitudes: dict[str, AttitudeCoordinates] = {}
        self._thread_local_data = ThreadLocal(self._model.createData)

    def _one_line(self) -> str:
        """What moves, of what."""
        return f"Kinematics of '{self.frame}' of '{self.machine.name}'"

    def position(self, q_a: ArrayLike) -> Array:
        """Position in the world.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3,) or (N, 3) [m].
        """
        return self._stacked_positions(self.machine.closure.solve(q_a))

    def positions_at_configurations(self, q: ArrayLike) -> Array:
        """Position in the world at postures that are closed already.

        Args:
            q: (nq,) or (N, nq) [m], [rad].

        Returns:
            (3,) or (N, 3) [m].
        """
        return self._stacked_positions(as_samples(q, self._model.nv, "q", self.machine.joints))

    def _stacked_positions(self, q: Array) -> Array:
        if q.ndim == 2 and self._compiled_point is not None:
            return self._compiled_point.evaluate(q)
        return apply_per_sample(self.position_at_configuration, q)

    def position_at_configuration(self, q: Array) -> Array:
        """Position (3,) [m] of one posture (nq,)."""
        pin.forwardKinematics(self._model, self._data, self.machine.coordinates.configuration(q))
        placement = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(placement.translation)

    def rotation(self, q_a: ArrayLike) -> Array:
        """Rotation matrix of the frame, seen from the world.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3, 3) or (N, 3, 3).
        """
        configurations = self.machine.closure.solve(q_a)
        return apply_per_sample(lambda one: self._pose(one)[1], configurations)

    def inclination(self, q_a: ArrayLike) -> Array:
        """By how much the frame's x axis points above the horizontal, in the plane it turns in.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            () or (N,) [rad], within -pi to pi.

        Raises:
            InputError: The frame has none, see `crane.motion.attitude.InclinationCoordinate`.
        """
        return InclinationCoordinate(self.machine, self.frame).value(self.rotation(q_a))

    def jacobian(self, q_a: ArrayLike, attitude: str | None = None) -> Array:
        """Reduced Jacobian dx/dq_A = J gamma.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            attitude: Whose rates come after those of the position; see the class.

        Returns:
            (3, n) or (N, 3, n); with the k coordinates of an attitude 3 + k in place of 3.
        """
        q = self.machine.closure.solve(q_a)
        if attitude is not None:
            attitude_coordinates = self._attitude_coordinates(attitude)
            return apply_per_sample(
                lambda one: self._attitude_jacobian(one, attitude_coordinates), q
            )
        if q.ndim == 2 and self._compiled_frame is not None:
            return self._compiled_frame.evaluate(q)[:, 3:-3].reshape(len(q), 3, -1)
        return apply_per_sample(self._reduced_jacobian, q)

    def bias(self, q_a: ArrayLike, v_a: ArrayLike, attitude: str | None = None) -> Array:
        """Acceleration of the frame at a_A = 0.

        Args:
            q_a: (n,) or (N, n) [m], [rad].
            v_a: The same shape [m/s], [rad/s].
            attitude: Whose second rates come after those of the position; see the class.

        Returns:
            (3,) or (N, 3) [m/s2]; with the k coordinates of an attitude 3 + k in place of 3.
        """
        names = self.machine.active
        attitude_coordinates = None if attitude is None else self._attitude_coordinates(attitude)

        def sample_bias(q: Array, v_a: Array) -> Array:
            v = self.machine.closure.gamma(q) @ v_a
            drift = self.machine.closure.drift(q, v)
            pinocchio_configuration = self.machine.coordinates.configuration(q)
            pin.forwardKinematics(self._model, self._data, pinocchio_configuration, v, drift)
            axes = pin.LOCAL_WORLD_ALIGNED
            second = pin.getFrameClassicalAcceleration(self._model, self._data, self._frame, axes)
            if attitude_coordinates is None:
                return np.array(second.linear)
            rate = pin.getFrameVelocity(self._model, self._data, self._frame, axes)
            rotation = pin.updateFramePlacement(self._model, self._data, self._frame).rotation
            bend = attitude_coordinates.accelerations(rotation, rate.angular, second.angular)
            return np.concatenate([second.linear, bend])

        v_a = as_samples(v_a, len(names), "v_a", names)
        q = self.machine.closure.solve(q_a)
        is_matching_stack = q.ndim == 2 and q.shape[:1] == v_a.shape[:-1]
        if is_matching_stack and attitude_coordinates is None and self._compiled_frame is not None:
            return self._compiled_frame.evaluate(q, v_a)[:, -3:]
        return apply_per_sample(sample_bias, q, v_a)

    def inverse(
        self,
        position: ArrayLike,
        initial_guess: ArrayLike | None = None,
        attitude: ArrayLike | None = None,
    ) -> Array:
        """Active coordinates within their limits that put the frame at a position.

        With an attitude, which is met as exactly: a radian counts as much as the machine's size.

        Levenberg-Marquardt on the reduced Jacobian with the limits as bounds, from the guess or
        the nearest of a grid of postures. A stack is tracked like a path: where its samples are
        near each other, some of them, and Newton's method from the curve through these for all.
        Where there are more active joints than directions, each step of the descent is the
        shortest.

        Args:
            position: (3,) or (N, 3) in the world [m].
            initial_guess: (n,) active coordinates to start from.
            attitude: Of the frame, inclination () or (N,) [rad] or roll, pitch and yaw (3,) or
                (N, 3) [rad] (R_z(yaw) R_y(pitch) R_x(roll), as URDF has it) or rotation matrices
                (3, 3) or (N, 3, 3).

        Returns:
            q_A, (n,) or (N, n) [m], [rad].

        Raises:
            InputError: Wrong shape or not finite, or the machine has no drives for the attitude.
            UnreachableTipError: The position is out of reach, or cannot be had in this attitude.
        """
        return self.inverse_along_path(position, initial_guess, attitude)

    def inverse_along_path(
        self,
        position: ArrayLike,
        initial_guess: ArrayLike | None = None,
        attitude: ArrayLike | None = None,
        time: Array | None = None,
    ) -> Array:
        """`inverse`, whose errors tell the time of a sample (N,) [s] as well."""
        targets = as_samples(position, 3, "position", ("x", "y", "z"))
        attitude_coordinates = None
        if attitude is not None:
            attitude_coordinates, attitude_targets = self._attitude_targets(attitude, targets)
            targets = np.concatenate([targets, attitude_targets], axis=-1)
        start = None
        if initial_guess is not None:
            names = self.machine.active
            start = self.machine.check_limits(
                as_sample(initial_guess, len(names), "guess", names), "guess"
            )
        if targets.ndim == 1:
            return self._solve_inverse(targets, start, "", attitude_coordinates)
        if len(targets) == 0:
            raise InputError("position is an empty stack, give at least one sample")
        sample_labels = [
            f" (sample {i})" if time is None else f" at t = {time[i]:.4g} s (sample {i})"
            for i in range(len(targets))
        ]
        if (
            attitude_coordinates is None
            and (tracked := self._track_path(targets, start, sample_labels)) is not None
        ):
            return tracked
        out = np.empty((len(targets), len(self.machine.active)))
        for i, target in enumerate(targets):
            start = out[i] = self._solve_inverse(
                target, start, sample_labels[i], attitude_coordinates
            )
        return out

    def _attitude_targets(
        self, attitude: ArrayLike, positions: Array
    ) -> tuple[AttitudeCoordinates, Array]:
        """What an attitude is one of, and flat targets of it beside positions."""
        values = np.asarray(attitude)
        stack_shape, shape = positions.shape[:-1], np.shape(attitude)
        if shape not in (stack_shape, (*stack_shape, 3), (*stack_shape, 3, 3)):
            accepted_shapes = ", ".join(
                str((*stack_shape, *trailing_shape)) for trailing_shape in ((), (3,), (3, 3))
            )
            raise InputError(f"attitude has the shape {shape}, give one of {accepted_shapes}")
        flat_values = as_samples(values.ravel(), values.size, "attitude")
        if shape == stack_shape:
            return self._attitude_coordinates(INCLINATION), flat_values.reshape(*stack_shape, 1)
        rotations = flat_values.reshape(shape)
        if shape[-2:] != (3, 3) or shape == (*stack_shape, 3):
            rotations = roll_pitch_yaw(rotations)
        elif (
            np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max()
            > _ORTHOGONALITY_TOLERANCE
        ):
            raise InputError("attitude is no rotation matrix, give one")
        return self._attitude_coordinates("rotation"), rotations.reshape(*stack_shape, 9)

    def _attitude_coordinates(self, name: str) -> AttitudeCoordinates:
        """Coordinates of the attitude, which the machine can choose beside its position.

        Raises:
            InputError: It cannot.
        """
        if name not in ATTITUDE_NAMES:
            raise InputError(
                f"attitude '{name}' is unknown, {suggest_names(ATTITUDE_NAMES, name)}"
            )
        if name not in self._attitudes:
            machine = self.machine
            coordinates: AttitudeCoordinates
            coordinates = (
                RotationCoordinates()
                if name == "rotation"
                else InclinationCoordinate(machine, self.frame)
            )
            jacobians = [
                self._attitude_jacobian(q, coordinates) * self._stroke_scales
                for q in self._sample_configurations
            ]
            position_rank, total_rank = (
                max(
                    int(
                        np.linalg.matrix_rank(
                            row, tol=_RANK_TOLERANCE * self._characteristic_length
                        )
                    )
                    for row in jacobian_list
                )
                for jacobian_list in ([row[:3] for row in jacobians], jacobians)
            )
            if total_rank < position_rank + len(coordinates.names):
                raise InputError(
                    f"'{machine.name}' has too few drives for {', '.join(coordinates.names)} of "
                    f"'{self.frame}': they move it in {position_rank} directions, and turn it in "
                    f"{total_rank - position_rank} beside"
                )
            self._attitudes[name] = coordinates
        return self._attitudes[name]

    @property
    def _data(self) -> pin.Data:
        return self._thread_local_data.value

    @cached_property
    def _compiled_frame(self) -> "_CompiledFrame | None":
        """Machine code for stacks; None where the machine is too large for it."""
        try:
            return _CompiledFrame(self.machine, self._frame)
        except FormulaTooLongError:
            return None

    @cached_property
    def _compiled_point(self) -> "_CompiledPoint | None":
        """The same of the position alone."""
        try:
            return _CompiledPoint(self.machine, self._frame)
        except FormulaTooLongError:
            return None

    def _track_path(
        self, targets: Array, start: Array | None, sample_labels: list[str]
    ) -> Array | None:
        """Strokes along a dense path (N, 3), or None where that takes a closer look.

        Every sample is as exact as those searched for one by one, or None is returned.

        Raises:
            UnreachableTipError: The path leaves the reach.
        """
        machine, n = self.machine, len(self.machine.active)
        if n > targets.shape[1] or len(targets) < 4 * _KNOT_STRIDE or self._compiled_frame is None:
            return None
        knots = np.unique(np.r_[0 : len(targets) : _KNOT_STRIDE, len(targets) - 1])
        knot_solutions = np.empty((len(knots), n))
        for i, knot in enumerate(knots):
            try:
                start = knot_solutions[i] = self._solve_inverse(targets[knot], start, "", None)
            except UnreachableTipError:
                # say which sample is the first one, or see that it can be reached after all
                for k in range(knots[max(i - 1, 0)], knot + 1):
                    start = self._solve_inverse(targets[k], start, sample_labels[k], None)
                return None
        from scipy.interpolate import make_interp_spline  # slow to import

        try:
            curve = make_interp_spline(knots, knot_solutions)(np.arange(len(targets)))
            q_a = curve = np.clip(curve, machine.lower, machine.upper)
            best_solution, smallest_distance = q_a, np.full(len(targets), np.inf)
            reference_distance = self._reference_distance(targets)
            for _ in range(10):
                rows = self._compiled_frame.evaluate(machine.closure.solve(q_a))
                error = targets - rows[:, :3]
                distance = np.linalg.norm(error, axis=1)
                is_closer = distance < smallest_distance
                best_solution = np.where(is_closer[:, None], q_a, best_solution)
                smallest_distance = np.minimum(distance, smallest_distance)
                if not (is_closer & (distance > _ROUNDING_TOLERANCE * reference_distance)).any():
                    break
                step = np.linalg.pinv(rows[:, 3:-3].reshape(-1, 3, n)) @ error[:, :, None]
                q_a = np.clip(q_a + step[:, :, 0], machine.lower, machine.upper)
        except (ClosureError, np.linalg.LinAlgError):
            return None
        is_near_curve = (
            np.abs(best_solution - curve) <= _INTERPOLATION_TOLERANCE * self._stroke_scales
        )
        tolerance = 1e-2 * _POSITION_TOLERANCE * reference_distance
        return (
            best_solution if is_near_curve.all() and smallest_distance.max() <= tolerance else None
        )

    def _reference_distance(self, targets: Array) -> float:
        """What distances to targets compare with [m]."""
        return max(self.machine.closure.characteristic_length, float(np.abs(targets).max()))

    def tree_jacobian(self, q: Array) -> Array:
        """Jacobian dx/dq (3, nv) of the spanning tree at one posture (nq,)."""
        return self._spatial_tree_jacobian(q)[:3]

    def _spatial_tree_jacobian(self, q: Array) -> Array:
        """The same, and the angular one below it (6, nv)."""
        configuration = self.machine.coordinates.configuration(q)
        jacobian: Array = pin.computeFrameJacobian(
            self._model, self._data, configuration, self._frame, pin.LOCAL_WORLD_ALIGNED
        )
        return jacobian.reshape(6, -1)  # of a single joint it comes as a vector

    def _reduced_jacobian(self, q: Array) -> Array:
        jacobian: Array = self.tree_jacobian(q) @ self.machine.closure.gamma(q)
        return jacobian

    def _attitude_jacobian(self, q: Array, attitude: AttitudeCoordinates) -> Array:
        """The reduced Jacobian (3 + k, n) with an attitude."""
        jacobian = self._spatial_tree_jacobian(q) @ self.machine.closure.gamma(q)
        return np.vstack([jacobian[:3], attitude.rates(self._pose(q)[1], jacobian[3:])])

    def _pose(self, q: Array) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) at one posture (nq,)."""
        pin.forwardKinematics(self._model, self._data, self.machine.coordinates.configuration(q))
        placement = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(placement.translation), np.array(placement.rotation)

    def _error_jacobian(self, q: Array, attitude: AttitudeCoordinates | None) -> Array:
        """How what is missed changes: of attitudes in lengths, a radian the machine's size."""
        if attitude is None:
            return self._reduced_jacobian(q)
        jacobian = self._attitude_jacobian(q, attitude)
        jacobian[3:] *= self._characteristic_length
        return jacobian

    def _error(self, target: Array, q: Array, attitude: AttitudeCoordinates | None) -> Array:
        """From a posture to a target (3,), and of attitudes likewise."""
        if attitude is None:
            return np.asarray(target - self.position_at_configuration(q))
        position, rotation = self._pose(q)
        attitude_error = self._characteristic_length * attitude.error(target[3:], rotation)
        return np.concatenate([target[:3] - position, attitude_error])

    @cached_property
    def _sample_configurations(self) -> list[Array]:
        """A few postures (nq,) all over the strokes."""
        return [
            q
            for q, _ in self._start_configurations[:: max(1, len(self._start_configurations) // 6)]
        ]

    @cached_property
    def _start_configurations(self) -> list[tuple[Array, Array]]:
        """Postures (q, tip) all over the strokes to start from."""
        machine = self.machine
        home = machine.home[machine.closure.active]
        stroke_values = [
            (
                low + span * np.array([0.2, 0.5, 0.8])
                if driven and np.isfinite(span)
                else [home_value]
            )
            for low, span, home_value, driven in zip(
                machine.lower, machine.upper - machine.lower, home, machine.is_driven, strict=True
            )
        ]
        configurations = [(np.array(machine.home), self.position_at_configuration(machine.home))]
        shape = tuple(len(axis) for axis in stroke_values)
        if math.prod(shape) <= _MAX_GRID_SIZE:
            cells = np.stack(np.unravel_index(np.arange(math.prod(shape)), shape), axis=1)
        else:  # of many joints some, wherever
            cells = np.random.default_rng(0).integers(shape, size=(_MAX_GRID_SIZE, len(shape)))
        for cell in cells:
            q_a = np.array([axis[i] for axis, i in zip(stroke_values, cell, strict=True)])
            try:
                q = machine.closure.solve(q_a)
            except ClosureError:
                continue
            configurations.append((q, self.position_at_configuration(q)))
        return configurations

    def _solve_inverse(
        self,
        target: Array,
        start: Array | None,
        sample_label: str,
        attitude: AttitudeCoordinates | None,
    ) -> Array:
        closure = self.machine.closure
        best_solution = (np.inf, self.machine.home)
        if start is not None:
            best_solution = self._levenberg_marquardt(target, closure.solve(start), attitude)
        tolerance = _POSITION_TOLERANCE * self._reference_distance(target[:3])
        if best_solution[0] > tolerance:
            if attitude is None:
                errors = [
                    float(np.sum((tip - target) ** 2)) for _, tip in self._start_configurations
                ]
            else:
                errors = [
                    norm(self._error(target, q, attitude)) for q, _ in self._start_configurations
                ]
            for i in np.argsort(errors, kind="stable")[
                : 5 if attitude is None else _ATTITUDE_STARTS
            ]:
                solution = self._levenberg_marquardt(
                    target, self._start_configurations[i][0], attitude
                )
                best_solution = min(best_solution, solution, key=lambda item: item[0])
                if best_solution[0] <= tolerance:
                    break
        distance, q = best_solution
        q_a: Array = q[closure.active]
        if distance > tolerance:
            target_text = ", ".join(f"{value:.4g}" for value in target[:3]) + ") m"
            error = self._error(target, q, attitude)
            distance_text = f"{norm(error[:3]):.3g} m"
            if attitude is not None:
                target_text += f" with {attitude.format_target(target[3:])}"
                distance_text += f" and {norm(error[3:]) / self._characteristic_length:.3g} rad"
            stroke_text = ", ".join(
                f"{name} = {value:.4g}"
                for name, value in zip(self.machine.active, q_a, strict=True)
            )
            raise UnreachableTipError(
                f"'{self.frame}' cannot reach ({target_text}{sample_label}: it stays "
                f"{distance_text} away, "
                f"nearest at {stroke_text}; choose a point within reach"
            )
        return q_a

    def _levenberg_marquardt(
        self, target: Array, q: Array, attitude: AttitudeCoordinates | None
    ) -> tuple[float, Array]:
        """Bounded Levenberg-Marquardt; the distance reached and the posture."""
        closure, machine = self.machine.closure, self.machine
        error = self._error(target, q, attitude)
        distance = norm(error)
        damping, reference_distance = 1e-6, self._reference_distance(target[:3])
        for _ in range(100):
            if distance < _ROUNDING_TOLERANCE * reference_distance:
                break
            q_a = q[closure.active]
            jacobian = self._error_jacobian(q, attitude) * self._stroke_scales
            gradient = jacobian.T @ error
            is_at_limit = ((q_a <= machine.lower) & (gradient < 0)) | (
                (q_a >= machine.upper) & (gradient > 0)
            )
            free = np.flatnonzero(~is_at_limit)
            gram = jacobian[:, free].T @ jacobian[:, free]
            weight = damping * max(float(np.trace(gram)), 1e-300)
            scaled_step = np.zeros(len(q_a))
            scaled_step[free] = np.linalg.solve(gram + weight * np.eye(len(free)), gradient[free])
            trial = np.clip(q_a + self._stroke_scales * scaled_step, machine.lower, machine.upper)
            try:
                q_new = closure.solve(trial, initial_guess=q)
            except ClosureError:
                damping = max(10 * damping, 1e-4)
                continue
            error_new = self._error(target, q_new, attitude)
            new_distance = norm(error_new)
            if new_distance < distance:
                is_stalled = new_distance > 0.999 * distance and damping < 1e-9
                q, error, distance = q_new, error_new, new_distance
                damping = max(damping / 10, 1e-15)
                if is_stalled:
                    break
            else:
                if distance < 100 * _ROUNDING_TOLERANCE * reference_distance or damping > 1e6:
                    break
                damping = max(10 * damping, 1e-9)
        return distance, q


class _CompiledPoint:
    """Position of a frame as machine code.

    Args:
        machine: The machine.
        frame: Pinocchio's index of the frame.

    Raises:
        TooLongError: It would take too long to compile.
    """

    def __init__(self, machine: Machine, frame: int):
        compiled_closure = self._compiled_closure = machine.closure.compiled_closure
        model_frame = machine.model.frames[frame]
        self._body = machine.coordinates.body_of_joint[model_frame.parentJoint]
        self._frame_offset = (
            compiled_closure.geometry.body_rotations[self._body].T
            @ model_frame.placement.translation
        )
        self._nq, self._n = machine.model.nv, len(machine.active)
        key = (type(self), self._body, folding_pattern(self._frame_offset))
        if key not in compiled_closure.programs:
            cache_name = ("frame", type(self).__name__, *key[1:])
            compiled_closure.programs[key] = compiled_closure.cached_program(
                cache_name, self._build_program
            )
        self._program = compiled_closure.programs[key]

    def evaluate(self, q: Array, v_a: Array | None = None) -> Array:
        """Rows of `_output_expressions` at postures (N, nq), velocities (N, n)."""
        v_a = np.zeros((len(q), self._n)) if v_a is None else v_a
        out = np.empty((len(q), self._program.formula_outputs("formula").size))
        constants = self._compiled_closure.geometry.constants, self._frame_offset
        for i in range(0, len(q), _BLOCK_SAMPLES):  # what has to be copied stays in the cache
            blocks = (np.ascontiguousarray(x[i : i + _BLOCK_SAMPLES]) for x in (q, v_a, out))
            self._program.call("rows", min(_BLOCK_SAMPLES, len(q) - i), *constants, *blocks)
        return out

    def _output_expressions(self, tape: Tape) -> list[Scalar]:
        """What a row holds: x (3)."""
        bodies, _, point = self._trace_point(tape)
        return self._rotate_to_world(bodies, subtract_vectors(point, bodies.origin[0]))

    def _trace_point(self, tape: Tape) -> tuple[PositionKinematics, LoopFormulas, list[Scalar]]:
        """Bodies, loops and the frame's place, seen from the trunk."""
        _, bodies, loops = self._compiled_closure.trace_kinematics(tape, 0, 2)
        frame_offset = FormulaConstants(tape, 1, self._frame_offset).vector(0)
        point = add_vectors(
            bodies.origin[self._body], matvec(bodies.rotation[self._body], frame_offset)
        )
        return bodies, loops, point

    def _rotate_to_world(self, bodies: PositionKinematics, vector: list[Scalar]) -> list[Scalar]:
        """A vector seen from the trunk, in the world's directions."""
        return matvec([list(axis) for axis in zip(*bodies.rotation[0], strict=True)], vector)

    def _build_program(self, program: Program) -> None:
        nq, n = self._nq, self._n
        size = program.add_formula("formula", 4, self._output_expressions(Tape())).size
        arrays = ("geometry", "place", "q", "v", "out")
        with program.add_routine("rows", counts=("count",), arrays=arrays) as r:
            with r.loop(r.count) as i:
                rows = r.q.row_pointer(i, nq), r.v.row_pointer(i, n), r.out.row_pointer(i, size)
                r.call("formula", r.geometry, r.place, *rows)
            r.return_value(r.count)


class _CompiledFrame(_CompiledPoint):
    """Position, reduced Jacobian and bias of a frame as machine code."""

    def _output_expressions(self, tape: Tape) -> list[Scalar]:
        """What a row holds: x (3), J gamma (3 n), bias (3)."""
        n, body = self._n, self._body
        bodies, loops, point = self._trace_point(tape)
        v_a, parents = tape.load_vector(3, 0, n), bodies.geometry.parents
        joint_rates: list[Scalar] = [0.0]
        joint_rates += [dot(loops.gamma[i], v_a) for i in range(1, len(parents))]
        motion = VelocityKinematics(bodies, loops, joint_rates, [0.0] * 3, parents)
        columns: list[list[Scalar]] = [[0.0] * 3 for _ in range(n)]
        (v, w), (a, e) = motion.velocities[body], motion.bias_accelerations[body]
        i = body
        while i > 0:  # what the joints that carry it do to the point
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
