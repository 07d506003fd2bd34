"""How a frame is turned: as coordinates of a task, and as a motion in time."""

from math import factorial
from typing import Protocol

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.common.shown import Brief
from crane.machine import Machine
from crane.motion.curves import Trajectory, via_points

ANGLES = ("roll", "pitch", "yaw")
INCLINATION = "inclination"
_ALONG = 1e-6  # by which a joint's axis may miss an axis of the frame [rad]
_LEVEL = 0.5  # sine of the angle that the axis may be off the level at home
_TERMS = 40  # of the series below, enough for turns up to `_FARTHEST`
_FARTHEST = 6.0  # [rad] of an attitude from the first; at a whole turn directions are lost
# sin(w)/w, (1 - cos w)/w^2, (w - sin w)/w^3 as series in w^2, highest power first, and slopes
_SERIES = [
    np.array([(-1.0) ** k / factorial(2 * k + i) for k in reversed(range(_TERMS))])
    for i in (1, 2, 3)
]
_SLOPES = [np.polyder(series) for series in _SERIES]


class Attitude(Protocol):
    """Coordinates of how a frame is turned, R its rotation, seen from the world.

    Attributes:
        names: Of the coordinates.
    """

    names: tuple[str, ...]

    def miss(self, target: Array, rotation: Array) -> Array:
        """(k,) [rad] from R (3, 3) to a target, which is a flat array."""

    def rows(self, rotation: Array, turning: Array) -> Array:
        """(k, n) rates of the coordinates, of angular velocities (3, n) in the world's axes."""

    def bend(self, rotation: Array, rate: Array, second: Array) -> Array:
        """(k,) second rates, of angular velocity and acceleration (3,) in the world's axes."""

    def words(self, target: Array) -> str:
        """A target as errors say it."""


class Rotation:
    """The whole attitude: three coordinates, whose rates are the angular velocity.

    The miss is the rotation vector log(R_target R^T), in the world's axes. Targets are R (9,).
    """

    names: tuple[str, ...] = ANGLES

    def miss(self, target: Array, rotation: Array) -> Array:
        """See `Attitude`."""
        return np.asarray(pin.log3(target.reshape(3, 3) @ rotation.T))

    def rows(self, rotation: Array, turning: Array) -> Array:
        """See `Attitude`."""
        return turning

    def bend(self, rotation: Array, rate: Array, second: Array) -> Array:
        """See `Attitude`."""
        return second

    def words(self, target: Array) -> str:
        """See `Attitude`."""
        angles = pin.rpy.matrixToRpy(target.reshape(3, 3))
        return "roll, pitch, yaw (" + ", ".join(f"{angle:.4g}" for angle in angles) + ") rad"


class Inclination:
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
        above = {joint.child: joint for joint in machine.tree.joints.values()}
        link, axis = frame, None
        while link in above and axis is None:
            joint = above[link]
            if joint.kind == "revolute":
                placed = data.oMf[machine.frame(joint.child)].rotation
                axis = rotation.T @ placed @ np.array(joint.axis)
            link = joint.parent
        across = [i for i in (1, 2) if axis is not None and 1 - abs(axis[i]) < _ALONG**2]
        refused = f"'{frame}' of '{machine.name}' has no inclination: "
        if not across:
            raise InputError(
                f"{refused}the joint that turns it is along neither its y axis nor its z axis, "
                "give roll, pitch and yaw, or a frame that is so"
            )
        self._across, self._k = across[0], 3 - across[0]
        if abs(rotation[2, self._across]) > _LEVEL:
            raise InputError(
                f"{refused}the joint that turns it is upright at home, not level, give roll, "
                "pitch and yaw"
            )
        at = machine.coordinates.configuration(machine.home)
        pin.computeJointJacobians(model, data, at)
        tree = pin.getFrameJacobian(model, data, machine.frame(frame), pin.LOCAL_WORLD_ALIGNED)
        turns = (tree.reshape(6, -1)[3:] @ machine.closure.gamma(machine.home))[:, machine.driven]
        tilts = np.cross(turns, rotation[:, self._across], axisa=0)[:, 2]
        if (np.abs(tilts) > _LEVEL * np.linalg.norm(turns, axis=0)).any():
            raise InputError(
                f"{refused}its drives tilt the joint that turns it, give roll, pitch and yaw"
            )

    def value(self, rotation: Array) -> Array:
        """The inclination [rad] within -pi to pi of R (..., 3, 3)."""
        return np.asarray(np.arctan2(rotation[..., 2, 0], rotation[..., 2, self._k]))

    def miss(self, target: Array, rotation: Array) -> Array:
        """See `Attitude`."""
        off = target - self.value(rotation)
        return np.asarray(off - 2 * np.pi * np.round(off / (2 * np.pi)))

    def rows(self, rotation: Array, turning: Array) -> Array:
        """See `Attitude`."""
        u = rotation[2]
        rates = -np.cross(rotation.T @ turning, u, axisa=0, axisc=0)
        return np.asarray(self._around(u, rates[0], rates[self._k]))[None]

    def bend(self, rotation: Array, rate: Array, second: Array) -> Array:
        """See `Attitude`."""
        u, k, w = rotation[2], self._k, rotation.T @ rate
        first = -np.cross(w, u)
        more = -np.cross(rotation.T @ second, u) - np.cross(w, first)
        length = u[0] ** 2 + u[k] ** 2
        grows = 2.0 * (u[0] * first[0] + u[k] * first[k]) / length
        turn = self._around(u, more[0], more[k]) - grows * self._around(u, first[0], first[k])
        return np.array([turn])

    def _around(self, u: Array, x: Array, k: Array) -> Array:
        return np.asarray((u[self._k] * x - u[0] * k) / (u[0] ** 2 + u[self._k] ** 2))

    def words(self, target: Array) -> str:
        """See `Attitude`."""
        return f"an inclination of {target[0]:.4g} rad"


def roll_pitch_yaw(angles: ArrayLike) -> Array:
    """R_z(yaw) R_y(pitch) R_x(roll), as URDF has it.

    Args:
        angles: (3,) or (N, 3) [rad].

    Returns:
        (3, 3) or (N, 3, 3).
    """
    rows = np.asarray(angles, dtype=np.float64)
    if rows.ndim == 1:
        return np.asarray(pin.rpy.rpyToMatrix(rows))
    return np.array([pin.rpy.rpyToMatrix(row) for row in rows]).reshape(-1, 3, 3)


def _crossing(v: Array) -> Array:
    """[v] of vectors (N, 3), (N, 3, 3): [v] w = v x w."""
    out = np.zeros((len(v), 3, 3))
    out[:, [2, 0, 1], [1, 2, 0]] = v
    out[:, [1, 2, 0], [2, 0, 1]] = -v
    return out


class Turning(Brief):
    """An attitude in time, R = R_0 exp([r]) with r(t) a rotation vector.

    With w^2 = r^T r and the series S_1 = sin(w)/w, S_2 = (1 - cos w)/w^2, S_3 = (w - sin w)/w^3,

        exp([r]) = 1 + S_1 [r] + S_2 [r]^2,    R^T w_world = J r',   J = 1 - S_2 [r] + S_3 [r]^2.

    Args:
        first: R_0 (3, 3).
        vector: r (3,) [rad].

    Attributes:
        duration: [s].
    """

    def __init__(self, first: Array, vector: Trajectory):
        self.duration = vector.duration
        self._first, self._vector = first, vector

    def __call__(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """R (N, 3, 3), angular velocities and accelerations (N, 3) in the world's axes.

        Args:
            time: () or (N,) [s]; without N for a single one.
        """
        r, rate, second = self._vector(np.atleast_1d(time))
        square, grows = np.einsum("ij,ij->i", r, r), 2.0 * np.einsum("ij,ij->i", r, rate)
        one, two, three = (np.polyval(series, square)[:, None, None] for series in _SERIES)
        slope_two, slope_three = (
            (np.polyval(slope, square) * grows)[:, None, None] for slope in _SLOPES[1:]
        )
        x, y = _crossing(r), _crossing(rate)
        jacobian = np.eye(3) - two * x + three * x @ x
        change = -slope_two * x - two * y + slope_three * x @ x + three * (x @ y + y @ x)
        rotation = self._first @ (np.eye(3) + one * x + two * x @ x)
        velocity = rotation @ jacobian @ rate[..., None]
        acceleration = rotation @ (jacobian @ second[..., None] + change @ rate[..., None])
        found = rotation, velocity[..., 0], acceleration[..., 0]
        return found if np.ndim(time) else (found[0][0], found[1][0], found[2][0])


def via_attitudes(time: ArrayLike, angles: ArrayLike, rates: ArrayLike | None = None) -> Turning:
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
    given = np.asarray(angles, dtype=np.float64)
    wanted = np.full_like(given, np.nan) if rates is None else np.asarray(rates, dtype=np.float64)
    if given.ndim != 2 or given.shape[1:] != (3,) or wanted.shape != given.shape:
        raise InputError(
            f"attitudes have the shape {given.shape} and rates {wanted.shape}, give (N, 3) roll, "
            "pitch and yaw"
        )
    vectors, moves = np.full_like(given, np.nan), np.full_like(given, np.nan)
    times = np.ravel(time)
    before, first = np.zeros(3), roll_pitch_yaw(np.nan_to_num(given[0]))
    for i in np.flatnonzero(np.isfinite(given).all(axis=1)):
        turned = roll_pitch_yaw(given[i])
        before = vectors[i] = _nearest(np.asarray(pin.log3(first.T @ turned)), before)
        if np.linalg.norm(before) > _FARTHEST:
            raise InputError(
                f"the attitude at {times[i]:g} s is {np.linalg.norm(before):.3g} rad from the "
                f"first one, give at most {_FARTHEST:g}"
            )
        if np.isfinite(wanted[i]).all():
            world = pin.rpy.computeRpyJacobian(given[i], pin.LOCAL_WORLD_ALIGNED) @ wanted[i]
            moves[i] = np.linalg.solve(pin.Jexp3(before), turned.T @ world)
    return Turning(first, via_points(time, vectors, moves))


def _nearest(vector: Array, before: Array) -> Array:
    """The rotation vector of the same rotation that is nearest to another one."""
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 1e-9 else before / (np.linalg.norm(before) or 1.0)
    turns = round((float(axis @ before) - angle) / (2 * np.pi))
    return np.asarray(vector + 2 * np.pi * turns * axis)
