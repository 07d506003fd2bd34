"""Attitude coordinates of a frame, and attitude trajectories through given angles."""

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.machine.machine import Machine
from crane.motion.trajectory import AttitudeTrajectory, via_points

INCLINATION = "inclination"
_AXIS_TOLERANCE = 1e-6  # between the axis of a joint and an axis of the frame [rad]
_MAX_AXIS_TILT = 0.5  # sine of the angle between the axis and the horizontal at home
_MAX_ROTATION_ANGLE = 6.0  # [rad] from the first attitude; the rotation vector is singular at 2 pi


class RotationCoordinates:
    """The complete rotation: three coordinates, whose rates are the angular velocity.

    The error is the rotation vector log(R_target R^T) in the world frame. Targets are R (9,).
    """

    names: tuple[str, ...] = ("roll", "pitch", "yaw")

    def error(self, target: Array, rotation: Array) -> Array:
        """Error (k,) [rad] from R (3, 3) to a target, which is a flat array."""
        return np.asarray(pin.log3(target.reshape(3, 3) @ rotation.T))

    def rates(self, rotation: Array, angular_velocities: Array) -> Array:
        """Rates (k, n) of the coordinates for angular velocities (3, n) in the world frame."""
        return angular_velocities

    def accelerations(
        self, rotation: Array, angular_velocity: Array, angular_acceleration: Array
    ) -> Array:
        """Second derivatives (k,) for angular velocity and acceleration (3,) in the world."""
        return angular_acceleration

    def format_target(self, target: Array) -> str:
        """Text of a target for error messages."""
        angles = pin.rpy.matrixToRpy(target.reshape(3, 3))
        return "roll, pitch, yaw (" + ", ".join(f"{angle:.4g}" for angle in angles) + ") rad"


class InclinationCoordinate:
    """Inclination of a frame: elevation of its x axis in its plane of motion.

    With the direction e against gravity (z without gravity), u = R^T e, l the axis of the frame (y
    or z) that is parallel to the axis of the joint that rotates it, and k the other of the two,

        inclination = atan2(u_x, u_k):

    It is 0 where x is horizontal and k points up, pi/2 where x points up, and larger beyond that;
    revolutions of 2 pi are equivalent. It increases with rotations about +z if l is z, else about
    -y. Where l is horizontal and k points up, it is the reading of an inclinometer, asin(u_x).
    With the angular velocity w and acceleration w' in the frame, u' = -w x u and u'' = -w' x u - w
    x u',

        inclination' = (u_k u_x' - u_x u_k') / (u_x^2 + u_k^2).

    Args:
        machine: The machine.
        frame: The link.

    Raises:
        InputError: The frame rotates about neither axis, or about one that is not horizontal at
            home or that other drives tilt.
    """

    names: tuple[str, ...] = (INCLINATION,)

    def __init__(self, machine: Machine, frame: str):
        frames = FrameJacobians(machine)
        frames.set_configuration(machine.home)
        rotation = frames.frame_pose(frame).rotation
        parent_joints = {joint.child: joint for joint in machine.tree.joints.values()}
        link, axis = frame, None
        while link in parent_joints and axis is None:
            joint = parent_joints[link]
            if joint.kind == "revolute":
                axis = rotation.T @ frames.frame_pose(joint.child).rotation @ np.array(joint.axis)
            link = joint.parent
        axis_candidates = [
            i for i in (1, 2) if axis is not None and 1 - abs(axis[i]) < _AXIS_TOLERANCE**2
        ]
        message_prefix = f"'{frame}' of '{machine.name}' has no inclination: "
        if not axis_candidates:
            raise InputError(
                f"{message_prefix}the joint that turns it is along neither its y axis nor its z "
                "axis, give roll, pitch and yaw, or a frame that is so"
            )
        self._k, self._up = 3 - axis_candidates[0], machine.up_direction
        rotation_axis = rotation[:, axis_candidates[0]]
        if abs(rotation_axis @ self._up) > _MAX_AXIS_TILT:
            raise InputError(
                f"{message_prefix}the joint that turns it is upright at home, not level, give "
                "roll, pitch and yaw"
            )
        gamma = machine.closure.gamma(machine.home)[:, machine.is_driven]
        angular_velocities = frames.jacobian(frame)[3:] @ gamma
        axis_tilts = np.cross(angular_velocities, rotation_axis, axisa=0) @ self._up
        speeds = np.linalg.norm(angular_velocities, axis=0)
        if (np.abs(axis_tilts) > _MAX_AXIS_TILT * speeds).any():
            raise InputError(
                f"{message_prefix}its drives tilt the joint that turns it, give roll, pitch and "
                f"yaw"
            )

    def value(self, rotation: Array) -> Array:
        """Inclination [rad], from -pi to pi, of rotations R (..., 3, 3)."""
        u = self._up @ rotation
        return np.asarray(np.arctan2(u[..., 0], u[..., self._k]))

    def error(self, target: Array, rotation: Array) -> Array:
        """See `RotationCoordinates`."""
        difference = target - self.value(rotation)
        return np.asarray(difference - 2 * np.pi * np.round(difference / (2 * np.pi)))

    def rates(self, rotation: Array, angular_velocities: Array) -> Array:
        """See `RotationCoordinates`."""
        u = self._up @ rotation
        vertical_rates = -np.cross(rotation.T @ angular_velocities, u, axisa=0, axisc=0)
        return self._angle_derivative(u, vertical_rates)[None]

    def accelerations(
        self, rotation: Array, angular_velocity: Array, angular_acceleration: Array
    ) -> Array:
        """See `RotationCoordinates`."""
        u, k, w = self._up @ rotation, self._k, rotation.T @ angular_velocity
        vertical_rate = -np.cross(w, u)
        vertical_acceleration = -np.cross(rotation.T @ angular_acceleration, u) - np.cross(
            w, vertical_rate
        )
        squared_length = u[0] ** 2 + u[k] ** 2
        log_length_rate = (
            2.0 * (u[0] * vertical_rate[0] + u[k] * vertical_rate[k]) / squared_length
        )
        acceleration = self._angle_derivative(u, vertical_acceleration)
        rate = self._angle_derivative(u, vertical_rate)
        return np.array([acceleration - log_length_rate * rate])

    def _angle_derivative(self, u: Array, u_rate: Array) -> Array:
        k = self._k
        return np.asarray((u[k] * u_rate[0] - u[0] * u_rate[k]) / (u[0] ** 2 + u[k] ** 2))

    def format_target(self, target: Array) -> str:
        """See `RotationCoordinates`."""
        return f"an inclination of {target[0]:.4g} rad"


AttitudeCoordinates = RotationCoordinates | InclinationCoordinate


def roll_pitch_yaw(angles: ArrayLike) -> Array:
    """Rotation matrices R_z(yaw) R_y(pitch) R_x(roll), the convention of URDF.

    Args:
        angles: (3,) or (N, 3) [rad].

    Returns:
        (3, 3) or (N, 3, 3).
    """
    angle_rows = np.asarray(angles, dtype=np.float64)
    if angle_rows.ndim == 1:
        return np.asarray(pin.rpy.rpyToMatrix(angle_rows))
    return np.array([pin.rpy.rpyToMatrix(row) for row in angle_rows]).reshape(-1, 3, 3)


def via_attitudes(
    time: ArrayLike, angles: ArrayLike, rates: ArrayLike | None = None
) -> AttitudeTrajectory:
    """Attitude trajectory through given attitudes, from rest to rest.

    The rotation vector from the first attitude, r = log(R_0^T R), passes the rotation vectors of
    the others with least jerk, as in `via_points`. Between two attitudes it is the shortest
    rotation about one axis, timed as in `point_to_point`.

    Args:
        time: (N,) [s], increasing from 0.
        angles: Roll, pitch and yaw (N, 3) [rad], R = R_z(yaw) R_y(pitch) R_x(roll); NaN where no
            attitude is prescribed.
        rates: Rates of the angles (N, 3) [rad/s], NaN where they are free; default zero at the
            ends.

    Raises:
        InputError: As for `via_points`, or an attitude is nearly a revolution from the first.
    """
    given_angles = np.asarray(angles, dtype=np.float64)
    given_rates = (
        np.full_like(given_angles, np.nan)
        if rates is None
        else np.asarray(rates, dtype=np.float64)
    )
    if (
        given_angles.ndim != 2
        or given_angles.shape[1:] != (3,)
        or given_rates.shape != given_angles.shape
    ):
        raise InputError(
            f"attitudes have the shape {given_angles.shape} and rates {given_rates.shape}, give "
            "(N, 3) roll, pitch and yaw"
        )
    vectors, vector_rates = np.full_like(given_angles, np.nan), np.full_like(given_angles, np.nan)
    previous_vector, initial_rotation = np.zeros(3), roll_pitch_yaw(np.nan_to_num(given_angles[0]))
    for i in np.flatnonzero(np.isfinite(given_angles).all(axis=1)):
        rotation = roll_pitch_yaw(given_angles[i])
        vector = np.asarray(pin.log3(initial_rotation.T @ rotation))
        angle = float(np.linalg.norm(vector))
        previous_angle = float(np.linalg.norm(previous_vector))
        axis = vector / angle if angle > 1e-9 else previous_vector / (previous_angle or 1.0)
        # the equivalent vector that is nearest to the previous one
        revolutions = round((float(axis @ previous_vector) - angle) / (2 * np.pi))
        previous_vector = vectors[i] = vector + 2 * np.pi * revolutions * axis
        if np.linalg.norm(previous_vector) > _MAX_ROTATION_ANGLE:
            raise InputError(
                f"the attitude at {np.ravel(time)[i]:g} s is "
                f"{np.linalg.norm(previous_vector):.3g} rad from the first one, give at most "
                f"{_MAX_ROTATION_ANGLE:g}"
            )
        if np.isfinite(given_rates[i]).all():
            rate_jacobian = pin.rpy.computeRpyJacobian(given_angles[i], pin.LOCAL_WORLD_ALIGNED)
            vector_rates[i] = np.linalg.solve(
                pin.Jexp3(previous_vector), rotation.T @ (rate_jacobian @ given_rates[i])
            )
    return AttitudeTrajectory(initial_rotation, via_points(time, vectors, vector_rates))
