"""Forward kinematics of a frame in the active coordinates: position, Jacobian and bias."""

import math
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.codegen import FormulaTooLongError
from crane.common.errors import ClosureError, InputError, suggest_names
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
from crane.motion.compiled_frame import CompiledFrame, CompiledPoint

# of the characteristic length per stroke, that counts as motion of the frame
_RANK_TOLERANCE = 1e-6
_MAX_GRID_SIZE = 243  # start configurations
ATTITUDE_NAMES = (INCLINATION, "rotation")


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
        # free joints do not move
        coordinate_units = machine.closure.units[machine.closure.active]
        self._stroke_scales = (
            np.where(np.isfinite(stroke_lengths), stroke_lengths, coordinate_units)
            * machine.is_driven
        )
        self._characteristic_length = machine.closure.characteristic_length
        self._attitudes: dict[str, AttitudeCoordinates] = {}
        self._thread_local_data = ThreadLocal(self._model.createData)

    def _one_line(self) -> str:
        """Frame and machine."""
        return f"{type(self).__name__} of '{self.frame}' of '{self.machine.name}'"

    def position(self, q_a: ArrayLike) -> Array:
        """Position of the frame in the world.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3,) or (N, 3) [m].
        """
        return self._stacked_positions(self.machine.closure.solve(q_a))

    def positions_at_configurations(self, q: ArrayLike) -> Array:
        """Position in the world at closed configurations.

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
        """Position (3,) [m] at one configuration (nq,)."""
        pin.forwardKinematics(self._model, self._data, self.machine.coordinates.configuration(q))
        placement = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(placement.translation)

    def rotation(self, q_a: ArrayLike) -> Array:
        """Rotation matrix of the frame in the world.

        Args:
            q_a: (n,) or (N, n) [m], [rad].

        Returns:
            (3, 3) or (N, 3, 3).
        """
        configurations = self.machine.closure.solve(q_a)
        return apply_per_sample(lambda one: self._pose(one)[1], configurations)

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
        if attitude is not None:
            attitude_coordinates = self._attitude_coordinates(attitude)
            return apply_per_sample(
                lambda one: self._attitude_jacobian(one, attitude_coordinates), q
            )
        if q.ndim == 2 and self._compiled_frame is not None:
            return self._compiled_frame.evaluate(q)[:, 3:-3].reshape(len(q), 3, -1)
        return apply_per_sample(self._reduced_jacobian, q)

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

    def _attitude_coordinates(self, name: str) -> AttitudeCoordinates:
        """Attitude coordinates by name, which the drives can set independently of the position.

        Raises:
            InputError: The name is unknown, or the drives cannot set them.
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
                    f"'{self.frame}': they move it in {position_rank} directions and rotate it "
                    f"in {total_rank - position_rank} further ones"
                )
            self._attitudes[name] = coordinates
        return self._attitudes[name]

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
        configuration = self.machine.coordinates.configuration(q)
        jacobian: Array = pin.computeFrameJacobian(
            self._model, self._data, configuration, self._frame, pin.LOCAL_WORLD_ALIGNED
        )
        return jacobian.reshape(6, -1)  # Pinocchio returns a vector for a single joint

    def _reduced_jacobian(self, q: Array) -> Array:
        return self.tree_jacobian(q) @ self.machine.closure.gamma(q)

    def _attitude_jacobian(self, q: Array, attitude: AttitudeCoordinates) -> Array:
        """Reduced Jacobian (3 + k, n) of position and attitude."""
        jacobian = self._spatial_tree_jacobian(q) @ self.machine.closure.gamma(q)
        return np.vstack([jacobian[:3], attitude.rates(self._pose(q)[1], jacobian[3:])])

    def _pose(self, q: Array) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) at one configuration (nq,)."""
        pin.forwardKinematics(self._model, self._data, self.machine.coordinates.configuration(q))
        placement = pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(placement.translation), np.array(placement.rotation)

    @cached_property
    def _sample_configurations(self) -> list[Array]:
        """Some of the start configurations (nq,)."""
        return [
            q
            for q, _ in self._start_configurations[:: max(1, len(self._start_configurations) // 6)]
        ]

    @cached_property
    def _start_configurations(self) -> list[tuple[Array, Array]]:
        """Start configurations (q, position) over the whole range of the strokes."""
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
        else:  # for many joints a random subset
            cells = np.random.default_rng(0).integers(shape, size=(_MAX_GRID_SIZE, len(shape)))
        for cell in cells:
            q_a = np.array([axis[i] for axis, i in zip(stroke_values, cell, strict=True)])
            try:
                q = machine.closure.solve(q_a)
            except ClosureError:
                continue
            configurations.append((q, self.position_at_configuration(q)))
        return configurations
