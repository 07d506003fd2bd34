"""Rotations of ball joints and floating bases in recordings: quaternions, body rates, angles."""

import numpy as np
import pinocchio as pin

from crane.common.errors import RecordingError
from crane.common.samples import Array
from crane.description.kinematic_tree import ROTATIONS
from crane.description.sensors import VELOCITY_SUFFIX
from crane.recordings.timeseries import TIME, Table

_SUFFIXES = ("_qw", "_qx", "_qy", "_qz")
_MAX_LENGTH_ERROR = 1e-2  # of a unit quaternion, as by rounding to few digits


def convert_quaternions(table: Table) -> Table:
    """Return a table with rotation vectors in place of quaternions.

    The columns NAME_qw, NAME_qx, NAME_qy, NAME_qz of the rotation of a ball joint or floating base
    NAME become NAME_rx, NAME_ry, NAME_rz [rad], with the angular velocities NAME_rx_velocity to
    NAME_rz_velocity [rad/s] about the axes of the child if there are none.

    Raises:
        RecordingError: A quaternion is no unit quaternion, or there is a rotation vector as well.
    """
    columns = list(table.units)
    stems = [x.removesuffix("_qw") for x in columns if x.endswith("_qw")]
    stems = [stem for stem in stems if all(stem + suffix in table.units for suffix in _SUFFIXES)]
    if not stems:
        return table
    from scipy.spatial.transform import Rotation  # slow to import

    units, values = dict(table.units), dict(zip(columns, table.values.T, strict=True))
    for stem in stems:
        quaternions = np.column_stack([values.pop(stem + suffix) for suffix in _SUFFIXES])
        for suffix in _SUFFIXES:
            del units[stem + suffix]
        length = np.linalg.norm(quaternions, axis=1)
        if not (wrong := np.abs(length - 1.0)).max(initial=0.0) < _MAX_LENGTH_ERROR:
            sample = int(wrong.argmax())
            raise RecordingError(
                f"'{stem}_qw' to '{stem}_qz' have the length {length[sample]:.3g} at sample "
                f"{sample}, give unit quaternions"
            )
        vectors = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_rotvec()
        names = [f"{stem}_{part}" for part, _, _ in ROTATIONS]
        if known := [name for name in names if name in units]:
            raise RecordingError(f"'{stem}_qw' and '{known[0]}' are both there, leave one out")
        units |= dict.fromkeys(names, "rad")
        values |= dict(zip(names, vectors.T, strict=True))
        rates = [name + VELOCITY_SUFFIX for name in names]
        if TIME in values and not any(rate in units for rate in rates):
            units |= dict.fromkeys(rates, "rad/s")
            values |= dict(zip(rates, body_rates(vectors, values[TIME]).T, strict=True))
    return Table(units, np.column_stack([values[name] for name in units]), table.notes)


def body_rates(vectors: Array, time: Array) -> Array:
    """Angular velocities (N, 3) [rad/s] about the axes of the child of rotation vectors (N, 3).

    By central differences of rotations, one-sided at the ends; zero if time does not increase.
    """
    if len(time) < 2 or not (np.diff(time) > 0).all():
        return np.zeros_like(vectors)
    from scipy.spatial.transform import Rotation  # slow to import

    indices = np.arange(len(time))
    before, after = np.maximum(indices - 1, 0), np.minimum(indices + 1, len(time) - 1)
    rotations = Rotation.from_rotvec(vectors)
    # half of the step back and half of it forward, both seen from the sample
    back = (rotations[before].inv() * rotations).as_rotvec()
    forward = (rotations.inv() * rotations[after]).as_rotvec()
    return (back + forward) / (time[after] - time[before])[:, None]


def continuous_rotations(vectors: Array) -> Array:
    """Return rotation vectors (N, 3) [rad] of the same rotations that change continuously.

    They may be longer than pi.
    """
    out, turn = vectors.copy(), 2 * np.pi
    for i in range(1, len(out)):
        length = float(np.linalg.norm(out[i]))
        axis = out[i] / length if length else out[i - 1] / max(np.linalg.norm(out[i - 1]), 1e-300)
        out[i] += axis * turn * np.round((axis @ out[i - 1] - length) / turn)
    return out


def body_motion(vectors: Array, rates: Array, accelerations: Array) -> tuple[Array, Array]:
    """Return angular velocities and accelerations (N, 3) about the axes of the child.

    w = J(r) r', w' = J(r) r'' + (dJ/dt) r' with the right Jacobian J of the exponential map.

    Args:
        vectors: (N, 3) rotation vectors r [rad], continuous.
        rates: (N, 3) their derivatives r' [rad/s].
        accelerations: (N, 3) r'' [rad/s2].
    """
    velocity, acceleration, step = np.empty_like(rates), np.empty_like(rates), 1e-5
    for i, (r, rate, second) in enumerate(zip(vectors, rates, accelerations, strict=True)):
        jacobian = pin.Jexp3(r)
        change = (pin.Jexp3(r + step * rate) - pin.Jexp3(r - step * rate)) / (2 * step)
        velocity[i], acceleration[i] = jacobian @ rate, jacobian @ second + change @ rate
    return velocity, acceleration
