"""Coordinates of the spanning tree, and their conversion to Pinocchio's configurations."""

from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from crane.common.errors import InputError, suggest_names
from crane.common.samples import Array

Indices = NDArray[np.intp]

FREE_FLYER, BALL = "JointModelFreeFlyer", "JointModelSpherical"


class Coordinates:
    """Names, limits and kinds of the coordinates (nv,), converted to and from Pinocchio's (nq,).

    Both are the same except for the rotations of ball joints and floating bases: rotation vectors
    here, quaternions in Pinocchio; see `crane.description.rotation_vectors`.

    Args:
        model: The tree. The coordinates of a ball joint B are named B_rx, B_ry, B_rz; those of a
            floating base B_x, B_y, B_z, B_rx, B_ry, B_rz.

    Attributes:
        names: (nv,) in the order of Pinocchio's velocities.
        joints: (nv,) index of Pinocchio's joint of each coordinate.
        floating_base_columns: First column of each floating base.
        rotation_columns: First column of each rotation vector.
        is_translation: (nv,) whether a coordinate is a length.
        is_rotation_vector: (nv,) whether a coordinate is a component of a rotation vector.
        parents: (nv + 1,) parent bodies, where coordinate i moves body i + 1; the coordinates of a
            ball joint or floating base are a series; 0 is the world.
        body_of_joint: Body of each joint of Pinocchio's model in this numbering.
    """

    def __init__(self, model: pin.Model):
        self.model = model
        self.names: tuple[str, ...] = ()
        self.floating_base_columns: tuple[int, ...] = ()
        self.rotation_columns: tuple[int, ...] = ()
        joint_of_coordinate: list[int] = []
        configuration_indices: list[int] = []  # in Pinocchio's q; of quaternions the vector part
        kinds: list[str] = []  # "slide" and "turn" of single joints, "x" to "rz" of others
        for i in range(1, model.njoints):
            joint, name = model.joints[i], model.names[i]
            if joint.shortname() == FREE_FLYER:
                self.floating_base_columns += (joint.idx_v,)
            if joint.shortname() in (FREE_FLYER, BALL):
                self.rotation_columns += (joint.idx_v + joint.nv - 3,)
                parts = ["x", "y", "z", "rx", "ry", "rz"][-joint.nv :]
                self.names += tuple(f"{name}_{part}" for part in parts)
            else:
                parts = ["slide" if joint.shortname().startswith("JointModelP") else "turn"]
                self.names += (name,)
            kinds += parts
            joint_of_coordinate += [i] * joint.nv
            configuration_indices += range(joint.idx_q, joint.idx_q + joint.nv)
        self.is_translation = np.isin(kinds, ("slide", "x", "y", "z"))
        self.is_rotation_vector = np.isin(kinds, ("rx", "ry", "rz"))
        self._is_composite = ~np.isin(kinds, ("slide", "turn"))
        self.joints = np.array(joint_of_coordinate, dtype=np.intp)
        last = {0: 0} | {joint: i + 1 for i, joint in enumerate(joint_of_coordinate)}
        self.body_of_joint: tuple[int, ...] = tuple(last[joint] for joint in range(model.njoints))
        self.parents: tuple[int, ...] = (0,) + tuple(
            i if i and joint_of_coordinate[i - 1] == joint else last[model.parents[joint]]
            for i, joint in enumerate(joint_of_coordinate)
        )
        self._configuration_indices = np.array(configuration_indices, dtype=np.intp)
        self._columns_by_name = {name: i for i, name in enumerate(self.names)}

    def column(self, name: str) -> int:
        """Index of a coordinate.

        Raises:
            InputError: Unknown name.
        """
        if name not in self._columns_by_name:
            raise InputError(f"joint '{name}' is unknown, {suggest_names(self.names, name)}")
        return self._columns_by_name[name]

    @cached_property
    def lower(self) -> Array:
        """(nv,) lower limits [m], [rad]."""
        return self._coordinate_limits(self.model.lowerPositionLimit, -np.inf)

    @cached_property
    def upper(self) -> Array:
        """(nv,) upper limits [m], [rad]."""
        return self._coordinate_limits(self.model.upperPositionLimit, np.inf)

    @cached_property
    def characteristic_length(self) -> float:
        """Characteristic length of a machine [m]: the largest distance between adjacent joints.

        Where all joints coincide: the largest distance of a link from its joint, else the largest
        limit of a prismatic joint, else 1 m.
        """
        joints = (place.translation for place in list(self.model.jointPlacements)[1:])
        for places in (joints, (frame.placement.translation for frame in self.model.frames)):
            if distance := float(np.abs(list(places)).max(initial=0.0)):
                return distance
        limits = np.abs(np.stack([self.lower, self.upper]))[:, self.is_translation]
        return float(limits[np.isfinite(limits)].max(initial=0.0)) or 1.0

    @cached_property
    def units(self) -> Array:
        """(nv,) units that make coordinates comparable: 1 rad, and the characteristic length."""
        return np.where(self.is_translation, self.characteristic_length, 1.0)

    @cached_property
    def motion_scales(self) -> Array:
        """(nv,) comparable displacements of the joints.

        The range of a joint, at most 1 rad or the characteristic length; that bound for joints
        without limits.
        """
        ranges = self.upper - self.lower
        return np.where(ranges > 0, np.minimum(ranges, self.units), self.units)

    def format_values(self, columns: Indices, values: Array) -> str:
        """Values of some coordinates as text, "lift = 0.5, tilt = 0.1"."""
        return ", ".join(
            f"{self.names[int(i)]} = {value:.6g}" for i, value in zip(columns, values, strict=True)
        )

    def configuration(self, q: Array) -> Array:
        """Pinocchio's configuration (nq,) or (N, nq) from coordinates (nv,) or (N, nv)."""
        if not self.rotation_columns:
            return q
        out = np.zeros((*q.shape[:-1], self.model.nq))
        out[..., self._configuration_indices] = q
        for column in self.rotation_columns:
            at = self._configuration_indices[column]
            r = q[..., column : column + 3]
            half = 0.5 * np.linalg.norm(r, axis=-1, keepdims=True)
            out[..., at : at + 3] = 0.5 * np.sinc(half / np.pi) * r
            out[..., at + 3 : at + 4] = np.cos(half)
        return out

    def rate_matrix(self, q: Array) -> Array:
        """N (nv, nv) at coordinates (nv,): time derivatives q' = N v of the coordinates.

        The identity but for floating bases, p' = R V_lin, and rotation vectors,
        r' = (1 + r x / 2 + c (r x)^2) w.
        """
        out = np.eye(len(q))
        for column in self.floating_base_columns:
            out[column : column + 3, column : column + 3] = pin.exp3(q[column + 3 : column + 6])
        for column in self.rotation_columns:
            rotation = slice(column, column + 3)
            r = q[rotation]
            half = 0.5 * float(np.linalg.norm(r))
            # series in t^2 where the closed form suffers from cancellation
            c = (
                (1 - half / np.tan(half)) / (4 * half * half)
                if half > 1e-3
                else 1 / 12 + half**2 / 180
            )
            turned = pin.skew(r)
            out[rotation, rotation] += 0.5 * turned + c * turned @ turned
        return out

    def coordinate_derivatives(self, q: Array, v: Array) -> Array:
        """Time derivatives q' = N v (nv,) of the coordinates (nv,) at velocities (nv,)."""
        return self.rate_matrix(q) @ v if self.rotation_columns else v

    def wrap_rotations(self, q: Array, columns: Indices | None = None) -> Array:
        """The same configuration (nv,) with rotation vectors of length pi or less.

        Args:
            q: (nv,).
            columns: Columns that may change; all by default.
        """
        return self.unwrap_rotations(q, np.zeros(len(q)), columns)

    def scaled_distances(self, first: Array, second: Array) -> Array:
        """(nv,) distances of two configurations by coordinate, full revolutions ignored."""
        off = (first - second) / self.units
        turned = np.remainder(off + np.pi, 2 * np.pi) - np.pi
        return np.abs(np.where(self.is_translation, off, turned))

    def within_limits(self, q: Array, tolerance: float) -> NDArray[np.bool_]:
        """(nv,) whether coordinates are within their limits, up to a scaled tolerance."""
        slack = tolerance * self.units
        inside: NDArray[np.bool_] = (q >= self.lower - slack) & (q <= self.upper + slack)
        return inside

    def cardan_angles(self, q: Array) -> tuple[Array, Array]:
        """Coordinates (nv,) with Cardan angles R = R_x R_y R_z in place of rotation vectors.

        Returns:
            The coordinates, and the matrix (nv, nv) of their time derivatives by the velocities,
            which is singular where the second angle is 90 degrees.
        """
        out, rates = q.copy(), np.eye(len(q))
        for column in self.rotation_columns:
            rotation = slice(column, column + 3)
            out[rotation] = angles = cardan_angles(pin.exp3(q[rotation]))
            # roll, pitch and yaw of the inverse rotation are the same angles, negative
            inverse_rates = pin.rpy.computeRpyJacobian(-np.array(angles), pin.WORLD)
            rates[rotation, rotation] = np.linalg.pinv(inverse_rates)
        return out, rates

    def has_partial_rotations(self, columns: Indices) -> bool:
        """Whether columns contain a part of a rotation vector, but not all of it."""
        return any(
            0 < np.isin(range(column, column + 3), columns).sum() < 3
            for column in self.rotation_columns
        )

    def unwrap_rotations(self, q: Array, nearby: Array, columns: Indices | None = None) -> Array:
        """The same configuration (nv,) with the rotation vectors nearest to those of another.

        Args:
            q: (nv,).
            nearby: (nv,).
            columns: Columns that may change; all by default.
        """
        out = q.copy()
        for column in self.rotation_columns:
            if columns is not None and not np.isin(range(column, column + 3), columns).all():
                continue
            r, other = out[column : column + 3], nearby[column : column + 3]
            length = float(np.linalg.norm(r))
            axis = r if length else other
            axis = axis / max(float(np.linalg.norm(axis)), 1e-300)
            r += axis * 2 * np.pi * np.round((axis @ other - length) / (2 * np.pi))
        return out

    def _coordinate_limits(self, joint_limits: Array, unlimited: float) -> Array:
        limits = np.asarray(joint_limits, dtype=np.float64)[self._configuration_indices]
        return np.where(self._is_composite, unlimited, limits)


def cardan_angles(rotation: Array) -> tuple[float, float, float]:
    """Angles a, b, c with rotation = R_x(a) R_y(b) R_z(c), of any rotation matrix (3, 3)."""
    first, second, third = (-pin.rpy.matrixToRpy(rotation.T)).tolist()
    return first, second, third
