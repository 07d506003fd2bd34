"""How a frame is turned: as coordinates of a task, and as a motion in time."""

from math import factorial
from typing import Protocol

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.trajectory import Trajectory, via_points

ROLL_PITCH_YAW = ("roll", "pitch", "yaw")
INCLINATION = "inclination"
_AXIS_TOLERANCE = 1e-6  # by which a joint's axis may miss an axis of the frame [rad]
_MAX_AXIS_TILT = 0.5  # sine of the angle that the axis may be off the level at home
_SERIES_TERMS = 40  # of the series below, enough for turns up to `_MAX_ROTATION_ANGLE`
_MAX_ROTATION_ANGLE = (
    6.0  # [rad] of an attitude from the first; at a whole turn directions are lost
)
# sin(w)/w, (1 - cos w)/w^2, (w - sin w)/w^3 as series in w^2, highest power first, and slopes
_SERIES = [
    np.array([(-1.0) ** k / factorial(2 * k + i) for k in reversed(range(_SERIES_TERMS))])
    for i in (1, 2, 3)
]
_SERIES_DERIVATIVES = [np.polyder(series) for series in _SERIES]


class AttitudeCoordinates(Protocol):
    """Coordinates of how a frame is turned, R its rotation, seen from the world.

    Attributes:
        names: Of the coordinates.
    """

    names: tuple[str, ...]

    def error(self, target: Array, rotation: Array) -> Array:
        """(k,) [rad] from R (3, 3) to a target, which is a flat array."""

    def rates(self, rotation: Array, angular_velocities: Array) -> Array:
        """(k, n) rates of the coordinates, of angular velocities (3, n) in the world's axes."""

    def accelerations(
        self, rotation: Array, angular_velocity: Array, angular_acceleration: Array
    ) -> Array:
        """(k,) second rates, of angular velocity and acceleration (3,) in the world's axes."""

    def format_target(self, target: Array) -> str:
        """A target as errors say it."""


class RotationCoordinates:
    """The whole attitude: three coordinates, whose rates are the angular velocity.

    The miss is the rotation vector log(R_target R^T), in the world's axes. Targets are R (9,).
    """

    names: tuple[str, ...] = ROLL_PITCH_YAW

    def error(self, target: Array, rotation: Array) -> Array:
        """See `AttitudeCoordinates`."""
        return np.asarray(pin.log3(target.reshape(3, 3) @ rotation.T))

    def rates(self, rotation: Array, angular_velocities: Array) -> Array:
        """See `AttitudeCoordinates`."""
        return angular_velocities

    def accelerations(
        self, rotation: Array, angular_velocity: Array, angular_acceleration: Array
    ) -> Array:
        """See `AttitudeCoordinates`."""
        return angular_acceleration

    def format_target(self, target: Array) -> str:
        """See `AttitudeCoordinates`."""
        angles = pin.rpy.matrixToRpy(target.reshape(3, 3))
        return "roll, pitch, yaw (" + ", ".join(f"{angle:.4g}" for angle in angles) + ") rad"


class InclinationCoordinate:
    """By how much the frame's x axis points above the horizontal, in the plane it turns in.

    With up seen from the frame, u = R^T e_z, l the axis of the frame (y or z) along which the
    joint lies that turns it, and k the other one of the two,

        inclination = atan2(u_x, u_k):

    0 where x is level and k points up, pi/2 where x points up, and on beyond it while x comes
    back over the top; whole turns count the same. So it grows with turns about +z, if l is z, or
    about -y, and where l is level it is what an inclinometer says, asin(u_x), while k points up.
    With w and w' the angular velocity and acceleration seen from the frame, u' = -w x u and
    u'' = -w' x u - w x u',

        inclination' = (u_k u_x' - u_x u_k') / (u_x^2 + u_k^2).

    Args:
        machine: The machine.
        frame: The link.

    Raises:
        InputError: It turns about none of these axes, or about one that is not level at home or
            that drives tilt.
    """

    names: tuple[str, ...] = (INCLINATION,)

    def __init__(self, machine: Machine, frame: str):
        model, data = machine.model, machine.model.createData()
        pin.framesForwardKinematics(model, data, machine.coordinates.configuration(machine.home))
        rotation = data.oMf[machine.frame(frame)].rotation
        parent_joints = {joint.child: joint for joint in machine.tree.joints.values()}
        link, axis = frame, None
        while link in parent_joints and axis is None:
            joint = parent_joints[link]
            if joint.kind == "revolute":
                child_rotation = data.oMf[machine.frame(joint.child)].rotation
                axis = rotation.T @ child_rotation @ np.array(joint.axis)
            link = joint.parent
        axis_candidates = [
            i for i in (1, 2) if axis is not None and 1 - abs(axis[i]) < _AXIS_TOLERANCE**2
        ]
        message_prefix = f"'{frame}' of '{machine.name}' has no inclination: "
        if not axis_candidates:
            raise InputError(
                f"{message_prefix}the joint that turns it is along neither its y axis nor its z "
                f"axis, "
                "give roll, pitch and yaw, or a frame that is so"
            )
        self._rotation_axis, self._k = axis_candidates[0], 3 - axis_candidates[0]
        if abs(rotation[2, self._rotation_axis]) > _MAX_AXIS_TILT:
            raise InputError(
                f"{message_prefix}the joint that turns it is upright at home, not level, give "
                f"roll, "
                "pitch and yaw"
            )
        configuration = machine.coordinates.configuration(machine.home)
        pin.computeJointJacobians(model, data, configuration)
        tree_jacobian = pin.getFrameJacobian(
            model, data, machine.frame(frame), pin.LOCAL_WORLD_ALIGNED
        )
        angular_velocities = (
            tree_jacobian.reshape(6, -1)[3:] @ machine.closure.gamma(machine.home)
        )[:, machine.is_driven]
        axis_tilts = np.cross(angular_velocities, rotation[:, self._rotation_axis], axisa=0)[:, 2]
        if (
            np.abs(axis_tilts) > _MAX_AXIS_TILT * np.linalg.norm(angular_velocities, axis=0)
        ).any():
            raise InputError(
                f"{message_prefix}its drives tilt the joint that turns it, give roll, pitch and "
                f"yaw"
            )

    def value(self, rotation: Array) -> Array:
        """The inclination [rad] within -pi to pi of R (..., 3, 3)."""
        return np.asarray(np.arctan2(rotation[..., 2, 0], rotation[..., 2, self._k]))

    def error(self, target: Array, rotation: Array) -> Array:
        """See `AttitudeCoordinates`."""
        difference = target - self.value(rotation)
        return np.asarray(difference - 2 * np.pi * np.round(difference / (2 * np.pi)))

    def rates(self, rotation: Array, angular_velocities: Array) -> Array:
        """See `AttitudeCoordinates`."""
        u = rotation[2]
        vertical_rates = -np.cross(rotation.T @ angular_velocities, u, axisa=0, axisc=0)
        return np.asarray(self._angle_derivative(u, vertical_rates[0], vertical_rates[self._k]))[
            None
        ]

    def accelerations(
        self, rotation: Array, angular_velocity: Array, angular_acceleration: Array
    ) -> Array:
        """See `AttitudeCoordinates`."""
        u, k, w = rotation[2], self._k, rotation.T @ angular_velocity
        vertical_rate = -np.cross(w, u)
        vertical_acceleration = -np.cross(rotation.T @ angular_acceleration, u) - np.cross(
            w, vertical_rate
        )
        squared_length = u[0] ** 2 + u[k] ** 2
        log_length_rate = (
            2.0 * (u[0] * vertical_rate[0] + u[k] * vertical_rate[k]) / squared_length
        )
        acceleration = self._angle_derivative(
            u, vertical_acceleration[0], vertical_acceleration[k]
        ) - log_length_rate * self._angle_derivative(u, vertical_rate[0], vertical_rate[k])
        return np.array([acceleration])

    def _angle_derivative(self, u: Array, x: Array, k: Array) -> Array:
        return np.asarray((u[self._k] * x - u[0] * k) / (u[0] ** 2 + u[self._k] ** 2))

    def format_target(self, target: Array) -> str:
        """See `AttitudeCoordinates`."""
        return f"an inclination of {target[0]:.4g} rad"


def roll_pitch_yaw(angles: ArrayLike) -> Array:
    """R_z(yaw) R_y(pitch) R_x(roll), as URDF has it.

    Args:
        angles: (3,) or (N, 3) [rad].

    Returns:
        (3, 3) or (N, 3, 3).
    """
    angle_rows = np.asarray(angles, dtype=np.float64)
    if angle_rows.ndim == 1:
        return np.asarray(pin.rpy.rpyToMatrix(angle_rows))
    return np.array([pin.rpy.rpyToMatrix(row) for row in angle_rows]).reshape(-1, 3, 3)


def _cross_product_matrices(v: Array) -> Array:
    """[v] of vectors (N, 3), (N, 3, 3): [v] w = v x w."""
    out = np.zeros((len(v), 3, 3))
    out[:, [2, 0, 1], [1, 2, 0]] = v
    out[:, [1, 2, 0], [2, 0, 1]] = -v
    return out


class AttitudeTrajectory(OneLineRepr):
    """An attitude in time, R = R_0 exp([r]) with r(t) a rotation vector.

    With w^2 = r^T r and the series S_1 = sin(w)/w, S_2 = (1 - cos w)/w^2, S_3 = (w - sin w)/w^3,

        exp([r]) = 1 + S_1 [r] + S_2 [r]^2,    R^T w_world = J r',   J = 1 - S_2 [r] + S_3 [r]^2.

    Args:
        initial_rotation: R_0 (3, 3).
        rotation_vector: r (3,) [rad].

    Attributes:
        duration: [s].
    """

    def __init__(self, initial_rotation: Array, rotation_vector: Trajectory):
        self.duration = rotation_vector.duration
        self._initial_rotation, self._rotation_vector = initial_rotation, rotation_vector

    def __call__(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """R (N, 3, 3), angular velocities and accelerations (N, 3) in the world's axes.

        Args:
            time: () or (N,) [s]; without N for a single one.
        """
        r, rate, second = self._rotation_vector(np.atleast_1d(time))
        square, square_rate = np.einsum("ij,ij->i", r, r), 2.0 * np.einsum("ij,ij->i", r, rate)
        sine_series, cosine_series, cubic_series = (
            np.polyval(series, square)[:, None, None] for series in _SERIES
        )
        series_rate_two, series_rate_three = (
            (np.polyval(slope, square) * square_rate)[:, None, None]
            for slope in _SERIES_DERIVATIVES[1:]
        )
        vector_cross, rate_cross = _cross_product_matrices(r), _cross_product_matrices(rate)
        jacobian = (
            np.eye(3) - cosine_series * vector_cross + cubic_series * vector_cross @ vector_cross
        )
        jacobian_rate = (
            -series_rate_two * vector_cross
            - cosine_series * rate_cross
            + series_rate_three * vector_cross @ vector_cross
            + cubic_series * (vector_cross @ rate_cross + rate_cross @ vector_cross)
        )
        rotation = self._initial_rotation @ (
            np.eye(3) + sine_series * vector_cross + cosine_series * vector_cross @ vector_cross
        )
        velocity = rotation @ jacobian @ rate[..., None]
        acceleration = rotation @ (jacobian @ second[..., None] + jacobian_rate @ rate[..., None])
        result = rotation, velocity[..., 0], acceleration[..., 0]
        return result if np.ndim(time) else (result[0][0], result[1][0], result[2][0])


def via_attitudes(
    time: ArrayLike, angles: ArrayLike, rates: ArrayLike | None = None
) -> AttitudeTrajectory:
    """Turn through given attitudes, from rest to rest.

    The rotation vector from the first attitude, r = log(R_0^T R), runs through those of the
    others with least jerk as in `via_points`. Between two attitudes that is the shortest turn,
    about one axis, at the pace of `point_to_point`.

    Args:
        time: (N,) [s], increasing from 0.
        angles: Roll, pitch and yaw (N, 3) [rad], R = R_z(yaw) R_y(pitch) R_x(roll); NaN where an
            attitude is left open.
        rates: Their rates (N, 3) [rad/s], NaN where they follow; zero at the ends if not given.

    Raises:
        InputError: As `via_points`, or an attitude is nearly a whole turn from the first.
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
            f"(N, 3) roll, "
            "pitch and yaw"
        )
    vectors, vector_rates = np.full_like(given_angles, np.nan), np.full_like(given_angles, np.nan)
    times = np.ravel(time)
    previous_vector, initial_rotation = np.zeros(3), roll_pitch_yaw(np.nan_to_num(given_angles[0]))
    for i in np.flatnonzero(np.isfinite(given_angles).all(axis=1)):
        rotation = roll_pitch_yaw(given_angles[i])
        previous_vector = vectors[i] = _nearest_rotation_vector(
            np.asarray(pin.log3(initial_rotation.T @ rotation)), previous_vector
        )
        if np.linalg.norm(previous_vector) > _MAX_ROTATION_ANGLE:
            raise InputError(
                f"the attitude at {times[i]:g} s is {np.linalg.norm(previous_vector):.3g} rad "
                f"from the "
                f"first one, give at most {_MAX_ROTATION_ANGLE:g}"
            )
        if np.isfinite(given_rates[i]).all():
            angular_velocity = (
                pin.rpy.computeRpyJacobian(given_angles[i], pin.LOCAL_WORLD_ALIGNED)
                @ given_rates[i]
            )
            vector_rates[i] = np.linalg.solve(
                pin.Jexp3(previous_vector), rotation.T @ angular_velocity
            )
    return AttitudeTrajectory(initial_rotation, via_points(time, vectors, vector_rates))


def _nearest_rotation_vector(vector: Array, reference: Array) -> Array:
    """The rotation vector of the same rotation that is nearest to another one."""
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 1e-9 else reference / (np.linalg.norm(reference) or 1.0)
    revolutions = round((float(axis @ reference) - angle) / (2 * np.pi))
    return np.asarray(vector + 2 * np.pi * revolutions * axis)
