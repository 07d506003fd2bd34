"""Kinematics of a frame in the active coordinates, with inverse kinematics."""

import numpy as np
from numpy.linalg import norm
from numpy.typing import ArrayLike

from crane.common.errors import ClosureError, InputError, UnreachableTipError
from crane.common.samples import Array, as_sample, as_samples
from crane.motion.attitude import (
    INCLINATION,
    AttitudeCoordinates,
    roll_pitch_yaw,
)
from crane.motion.frame_kinematics import FrameKinematics

# relative to the characteristic length, or to the distance of the target if that is larger
_POSITION_TOLERANCE = 1e-11
_ROUNDING_TOLERANCE = 1e-15
_ORTHOGONALITY_TOLERANCE = 1e-6
_ATTITUDE_STARTS = 40  # start configurations if an attitude is given
_KNOT_STRIDE = 16  # samples of a path per sample that is solved by a search
# share of the strokes between a sample and the curve through these samples
_INTERPOLATION_TOLERANCE = 0.02


class Kinematics(FrameKinematics):
    """Position and attitude of one frame as functions of q_A, and their inverse.

    Position, Jacobian and bias are those of `FrameKinematics`.

    Args:
        machine: The machine.
        frame: Name of a link; default the tip of the machine.

    Raises:
        InputError: The frame is unknown, or the machine has no tip.
    """

    def inverse(
        self,
        position: ArrayLike,
        initial_guess: ArrayLike | None = None,
        attitude: ArrayLike | None = None,
        time: Array | None = None,
    ) -> Array:
        """Active coordinates, within their limits, of a position of the frame.

        An attitude is solved to the same accuracy; 1 rad is weighted as the characteristic length.

        The method is Levenberg-Marquardt on the reduced Jacobian with the limits as bounds, from
        the initial guess or the nearest configurations of a grid. A stack is tracked as a path: if
        its samples are dense, only some of them are searched for, and Newton's method starts from
        the spline through these for all. For a redundant machine each step has minimal norm.

        Args:
            position: (3,) or (N, 3) in the world [m].
            initial_guess: (n,) active coordinates.
            attitude: Attitude of the frame: inclination () or (N,) [rad]; or roll, pitch and yaw
                (3,) or (N, 3) [rad], R_z(yaw) R_y(pitch) R_x(roll); or rotation matrices (3, 3) or
                (N, 3, 3).
            time: (N,) times of the samples for error messages [s].

        Returns:
            q_A, (n,) or (N, n) [m], [rad].

        Raises:
            InputError: Shapes are wrong, values are not finite, or the drives cannot set the
                attitude.
            UnreachableTipError: The position is not reachable, or not in this attitude.
        """
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

    def nearest(self, position: Array, initial_guess: Array, iterations: int = 100) -> Array:
        """Closed configuration (nq,) in which the frame is nearest to a position.

        Args:
            position: (3,) in the world [m], within reach or not.
            initial_guess: (nq,) closed configuration, whose branch is followed.
            iterations: Most iterations; they take long at dead centres.
        """
        return np.asarray(self._levenberg_marquardt(position, initial_guess, None, iterations)[1])

    def _attitude_targets(
        self, attitude: ArrayLike, positions: Array
    ) -> tuple[AttitudeCoordinates, Array]:
        """Attitude coordinates of a given attitude, and its targets as flat arrays."""
        stack_shape, shape = positions.shape[:-1], np.shape(attitude)
        if shape not in (stack_shape, (*stack_shape, 3), (*stack_shape, 3, 3)):
            accepted_shapes = ", ".join(
                str((*stack_shape, *trailing_shape)) for trailing_shape in ((), (3,), (3, 3))
            )
            raise InputError(f"attitude has the shape {shape}, give one of {accepted_shapes}")
        flat_values = as_samples(np.ravel(attitude), np.size(attitude), "attitude")
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

    def _track_path(
        self, targets: Array, start: Array | None, sample_labels: list[str]
    ) -> Array | None:
        """Active coordinates along a dense path (N, 3), or None if they need single searches.

        Every sample is as accurate as by a single search, or None is returned.

        Raises:
            UnreachableTipError: The path is not reachable.
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
                # find the first unreachable sample, unless all are reachable by smaller steps
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
        ).all()
        tolerance = 1e-2 * _POSITION_TOLERANCE * reference_distance
        return best_solution if is_near_curve and smallest_distance.max() <= tolerance else None

    def _reference_distance(self, targets: Array) -> float:
        """Length [m] that distances to targets are relative to."""
        return max(self.machine.closure.characteristic_length, float(np.abs(targets).max()))

    def _error(self, target: Array, q: Array, attitude: AttitudeCoordinates | None) -> Array:
        """Error (3,) or (3 + k,) [m] to a target, attitudes times the characteristic length."""
        if attitude is None:
            return np.asarray(target - self.position_at_configuration(q))
        position, rotation = self._pose(q)
        attitude_error = self._characteristic_length * attitude.error(target[3:], rotation)
        return np.concatenate([target[:3] - position, attitude_error])

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
        if best_solution[0] <= tolerance:
            return np.asarray(best_solution[1][closure.active])
        starts, count = self._start_configurations, 5
        errors = [float(np.sum((tip - target[:3]) ** 2)) for _, tip in starts]
        if attitude is not None:
            count = _ATTITUDE_STARTS
            errors = [float(norm(self._error(target, q, attitude))) for q, _ in starts]
        for i in np.argsort(errors, kind="stable")[:count]:
            solution = self._levenberg_marquardt(target, starts[i][0], attitude)
            best_solution = min(best_solution, solution, key=lambda item: item[0])
            if best_solution[0] <= tolerance:
                return np.asarray(best_solution[1][closure.active])
        q = best_solution[1]
        target_text = ", ".join(f"{value:.4g}" for value in target[:3]) + ") m"
        error = self._error(target, q, attitude)
        distance_text = f"{norm(error[:3]):.3g} m"
        if attitude is not None:
            target_text += f" with {attitude.format_target(target[3:])}"
            distance_text += f" and {norm(error[3:]) / self._characteristic_length:.3g} rad"
        stroke_text = ", ".join(
            f"{name} = {value:.4g}"
            for name, value in zip(self.machine.active, q[closure.active], strict=True)
        )
        raise UnreachableTipError(
            f"'{self.frame}' cannot reach ({target_text}{sample_label}: it stays "
            f"{distance_text} away, nearest at {stroke_text}; choose a point within reach"
        )

    def _levenberg_marquardt(
        self, target: Array, q: Array, attitude: AttitudeCoordinates | None, iterations: int = 100
    ) -> tuple[float, Array]:
        """Distance and configuration at the end of a bounded Levenberg-Marquardt iteration."""
        closure, machine = self.machine.closure, self.machine
        error = self._error(target, q, attitude)
        distance = float(norm(error))
        damping, reference_distance = 1e-6, self._reference_distance(target[:3])
        for _ in range(iterations):
            if distance < _ROUNDING_TOLERANCE * reference_distance:
                break
            q_a = q[closure.active]
            jacobian = self._attitude_jacobian(q, attitude)
            jacobian[3:] *= self._characteristic_length  # as the error
            jacobian *= self._stroke_scales
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
            new_distance = float(norm(error_new))
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
