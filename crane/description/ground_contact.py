"""The ground under a machine, and contact forces on points and wheels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crane.codegen.symbolic import (
    Scalar,
    add_vectors,
    apply_function,
    cross,
    dot,
    maximum,
    scale_vector,
    subtract_vectors,
    where_positive,
)
from crane.common.errors import InputError
from crane.common.samples import as_number
from crane.description.external_forces import ExternalForce, FrameMotion
from crane.description.force_elements import as_nonnegative_number

DEFAULT_STIFFNESS, DEFAULT_DAMPING, DEFAULT_FRICTION, DEFAULT_SMOOTHING = 1e7, 1.0, 0.6, 1e-2
_RELAXATION_TIME = 1e-3  # [s]
_MIN_LENGTH = 1e-12  # [m] for the norm of zero


@dataclass(frozen=True)
class Ground:
    """A plane, or a surface whose height varies along x and is constant along y.

    Attributes:
        height: z of a plane at x = y = 0 [m]; of one along z, its distance from the origin along
            the normal.
        normal: (3,) of a plane, upwards, or across z for a machine drawn in x and y.
        profile: Points (x, z) [m] by increasing x, linear in between and level outside; none for a
            plane.
    """

    height: float = 0.0
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    profile: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        normal = np.array(self.normal, dtype=np.float64)
        is_vector = normal.shape == (3,) and bool(np.isfinite(normal).all())
        if not (is_vector and normal.any() and normal[2] >= 0):
            raise InputError(
                f"the ground's normal is {self.normal}, give one upwards, z not below 0"
            )
        if self.profile:
            points = np.array(self.profile, dtype=np.float64)
            if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
                raise InputError("the ground's profile is no list of [x, z], give numbers")
            if (np.diff(points[:, 0]) <= 0).any():
                raise InputError("the ground's profile goes back, give its points by rising x")
            if self.height or normal[:2].any():
                raise InputError("the ground has a profile and a plane, give one of the two")

    def distance_and_normal(self, position: Sequence[Scalar]) -> tuple[Scalar, list[Scalar]]:
        """Return the height [m] of a position (3,) along the normal, and the normal."""
        if not self.profile:
            length = float(np.linalg.norm(self.normal))
            normal: list[Scalar] = [x / length for x in self.normal]
            origin = [0.0, 0.0, self.height]
            if not self.normal[2]:
                origin = [x / length * self.height for x in self.normal]
            return dot(normal, subtract_vectors(position, origin)), normal
        x, z = np.array(self.profile, dtype=np.float64).T
        slopes = np.concatenate([[0.0], np.diff(z) / np.diff(x), [0.0]])
        height: Scalar = float(z[0])
        slope: Scalar = 0.0
        for break_x, slope_change in zip(x.tolist(), np.diff(slopes).tolist(), strict=True):
            distance_beyond = position[0] - break_x
            height = height + slope_change * maximum(distance_beyond, 0.0)
            slope = slope + where_positive(distance_beyond, slope_change, 0.0)
        normal_z = 1.0 / apply_function("sqrt", slope * slope + 1.0)
        return (position[2] - height) * normal_z, [-1.0 * slope * normal_z, 0.0, normal_z]

    def tangents(self, normal: list[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        """Return two directions along the ground, the first in the plane of x and z."""
        first: list[Scalar] = [1.0, 0.0, 0.0]
        if self.profile or np.any(self.normal[::2]):  # the normal is not along y
            square = normal[0] * normal[0] + normal[2] * normal[2]
            normalization = 1.0 / apply_function("sqrt", square)
            first = [normalization * normal[2], 0.0, -1.0 * normalization * normal[0]]
        return first, cross(normal, first)


class Contact(ExternalForce):
    """Contact of a point of a body, or of a wheel or ball around it, with the ground.

    With d the depth and n the normal, v_t the tangential velocity at the contact point,

        N = stiffness d max(0, 1 + damping d'),    F = N (n - friction v_t / sqrt(v_t^2 + s^2)),

    unilateral and compliant as an end stop (Hunt and Crossley, 1975), with isotropic Coulomb
    friction, smoothed over the velocity s: on a slope the contact creeps at s tan(slope) /
    sqrt(friction^2 - tan(slope)^2). With a lateral stiffness k, as of a tyre, it does not creep.
    Its lateral deflection s is then a state, and friction is

        F_t = -min(1, friction N / |k s + c s'|) (k s + c s'),
        s' = v_t - max(0, 1 - friction N / (k |s|)) s / tau,    tau = 1 ms,

    an elastic and then viscoplastic element with the limit of Coulomb (the reset integrator of
    Haessig and Friedland, 1991, without its jump).

    Args:
        frame: The link whose origin is the point, or the centre of the wheel.
        ground: The ground.
        stiffness: Of ground and body [N/m].
        damping: [s/m].
        friction: Coefficient.
        smoothing: s [m/s].
        radius: Of the wheel or ball [m].
        lateral_stiffness: k along the ground, in all directions [N/m]; 0 for none.
        lateral_damping: c [N s/m].
        area: Area of the foot that the point represents [m2], 0 for none; its ground pressure is
            recorded.
        name: See `ExternalForce`.

    Raises:
        InputError: A value is not finite or too small.
    """

    def __init__(
        self,
        frame: str,
        ground: Ground | None = None,
        stiffness: float = DEFAULT_STIFFNESS,
        damping: float = DEFAULT_DAMPING,
        friction: float = DEFAULT_FRICTION,
        smoothing: float = DEFAULT_SMOOTHING,
        radius: float = 0.0,
        area: float = 0.0,
        lateral_stiffness: float = 0.0,
        lateral_damping: float = 0.0,
        name: str = "",
    ):
        super().__init__(frame, name)
        self.ground = Ground() if ground is None else ground
        label = f"of the contact at '{frame}'"
        self.stiffness = as_number(stiffness, f"the stiffness {label}", "N/m", greater_than=0)
        self.smoothing = as_number(smoothing, f"the smoothing {label}", "m/s", greater_than=0)
        numbers = [
            as_nonnegative_number(value, f"the {key} {label}", unit)
            for key, unit, value in (
                ("damping", "s/m", damping), ("friction", "", friction),
                ("radius", "m", radius), ("area", "m2", area),
                ("lateral stiffness", "N/m", lateral_stiffness),
                ("lateral damping", "N s/m", lateral_damping),
            )
        ]  # fmt: skip
        self.damping, self.friction, self.radius, self.area = numbers[:4]
        self.lateral_stiffness, self.lateral_damping = numbers[4:]
        if self.lateral_damping and not self.lateral_stiffness:
            raise InputError(f"the lateral damping {label} has no lateral stiffness, give both")

    def event_distances(self, motion: FrameMotion) -> list[Scalar]:
        """See `ExternalForce`: the gap."""
        return [self.ground.distance_and_normal(motion.position)[0] - self.radius]

    @property
    def channels(self) -> list[tuple[str, str]]:
        """See `ExternalForce`: N, and N over the area."""
        return [
            (f"support_{self.name}", "N"),
            *([(f"pressure_{self.name}", "Pa")] if self.area else []),
        ]

    def outputs(self, motion: FrameMotion) -> Sequence[Scalar]:
        """See `ExternalForce`."""
        normal_force = self._normal_force_and_sliding(motion)[0]
        return [normal_force, normal_force / self.area] if self.area else [normal_force]

    def _normal_force_and_sliding(
        self, motion: FrameMotion
    ) -> tuple[Scalar, list[Scalar], list[Scalar], list[Scalar]]:
        """Return N, the normal, the contact point from the frame, and its sliding velocity."""
        height, normal = self.ground.distance_and_normal(motion.position)
        arm = scale_vector(-1.0 * height, normal)
        velocity = add_vectors(motion.velocity, cross(motion.angular_velocity, arm))
        normal_velocity = dot(normal, velocity)
        depth = maximum(self.radius - height, 0.0)
        normal_force = self.stiffness * depth * maximum(1.0 - self.damping * normal_velocity, 0.0)
        return (
            normal_force,
            normal,
            arm,
            subtract_vectors(velocity, scale_vector(normal_velocity, normal)),
        )

    def wrench(self, motion: FrameMotion) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ExternalForce`."""
        normal_force, normal, arm, sliding_velocity = self._normal_force_and_sliding(motion)
        speed = apply_function("sqrt", dot(sliding_velocity, sliding_velocity) + self.smoothing**2)
        force = scale_vector(
            normal_force,
            subtract_vectors(normal, scale_vector(self.friction / speed, sliding_velocity)),
        )
        if self.lateral_stiffness:
            force = add_vectors(
                scale_vector(normal_force, normal),
                self._lateral_friction(motion, normal_force, normal, sliding_velocity)[0],
            )
        return force, cross(arm, force)

    @property
    def state_count(self) -> int:
        """See `ExternalForce`: the deflections s along two directions of the ground."""
        return 2 if self.lateral_stiffness else 0

    def state_rates(self, motion: FrameMotion) -> Sequence[Scalar]:
        """See `ExternalForce`."""
        if not self.lateral_stiffness:
            return ()
        normal_force, normal, _, sliding_velocity = self._normal_force_and_sliding(motion)
        return self._lateral_friction(motion, normal_force, normal, sliding_velocity)[1]

    def _lateral_friction(
        self,
        motion: FrameMotion,
        normal_force: Scalar,
        normal: list[Scalar],
        sliding_velocity: list[Scalar],
    ) -> tuple[list[Scalar], list[Scalar]]:
        """Return F_t (3,) and s' (2,)."""
        axes = self.ground.tangents(normal)
        s, max_friction = list(motion.states), self.friction * normal_force
        excess_share = maximum(
            1.0 - max_friction / (self.lateral_stiffness * _smoothed_norm(s, _MIN_LENGTH)), 0.0
        )
        is_touching = where_positive(normal_force, 1.0, 0.0)
        rates = [
            is_touching * dot(sliding_velocity, axis) - excess_share * x / _RELAXATION_TIME
            for axis, x in zip(axes, s, strict=True)
        ]
        elastic_force = add_vectors(
            scale_vector(self.lateral_stiffness, s), scale_vector(self.lateral_damping, rates)
        )
        friction_share = max_friction / maximum(
            _smoothed_norm(elastic_force, _MIN_LENGTH * self.lateral_stiffness), max_friction
        )
        total = add_vectors(
            scale_vector(elastic_force[0], axes[0]), scale_vector(elastic_force[1], axes[1])
        )
        return scale_vector(-1.0 * friction_share, total), rates


def _smoothed_norm(vector: list[Scalar], min_length: float) -> Scalar:
    return apply_function("sqrt", dot(vector, vector) + min_length**2)
