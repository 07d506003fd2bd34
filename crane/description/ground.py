"""The ground under a machine, and what presses and rubs on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crane.codegen.scalar import (
    Number,
    add,
    apply,
    cross,
    dot,
    maximum,
    scale,
    subtract,
    where_positive,
)
from crane.common.errors import InputError
from crane.common.samples import as_number
from crane.description.external import ExternalForce, Here

STIFFNESS, DAMPING, FRICTION, SMOOTHING = 1e7, 1.0, 0.6, 1e-2
_RELAXATION = 1e-3  # [s]
_LEAST = 1e-12  # [m] that is no way


@dataclass(frozen=True)
class Ground:
    """A plane, or a surface whose height changes along x and is the same along y.

    Attributes:
        height: z where x = y = 0 of a plane [m].
        normal: (3,) of a plane, upwards.
        profile: Points (x, z) in the order of x [m], straight between and level beyond; none of a
            plane.
    """

    height: float = 0.0
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    profile: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        normal = np.array(self.normal, dtype=np.float64)
        if normal.shape != (3,) or not np.isfinite(normal).all() or not normal[2] > 0:
            raise InputError(f"the ground's normal is {self.normal}, give one upwards, z above 0")
        if self.profile:
            points = np.array(self.profile, dtype=np.float64)
            if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
                raise InputError("the ground's profile is no list of [x, z], give numbers")
            if (np.diff(points[:, 0]) <= 0).any():
                raise InputError("the ground's profile goes back, give its points by rising x")
            if self.height or normal[:2].any():
                raise InputError("the ground has a profile and a plane, give one of the two")

    def over(self, place: Sequence[Number]) -> tuple[Number, list[Number]]:
        """How far a place (3,) is above it along its normal [m], and that (3,)."""
        if not self.profile:
            length = float(np.linalg.norm(self.normal))
            normal: list[Number] = [x / length for x in self.normal]
            return dot(normal, subtract(place, [0.0, 0.0, self.height])), normal
        x, z = np.array(self.profile, dtype=np.float64).T
        slopes = np.concatenate([[0.0], np.diff(z) / np.diff(x), [0.0]])
        height: Number = float(z[0])
        slope: Number = 0.0
        for at, turn in zip(x.tolist(), np.diff(slopes).tolist(), strict=True):
            beyond = place[0] - at
            height = height + turn * maximum(beyond, 0.0)
            slope = slope + where_positive(beyond, turn, 0.0)
        up = 1.0 / apply("sqrt", slope * slope + 1.0)
        return (place[2] - height) * up, [-1.0 * slope * up, 0.0, up]


class Contact(ExternalForce):
    """A point of a body, or a wheel or ball around it, on the ground.

    With d the depth and n the normal, v_t the velocity along the ground where it touches,

        N = stiffness d max(0, 1 + damping d'),    F = N (n - friction v_t / sqrt(v_t^2 + s^2)),

    unilateral and compliant as an end stop (Hunt and Crossley, 1975), with Coulomb friction in
    both directions, smoothed over the velocity s: what rests on a slope creeps, at s tan(slope) /
    sqrt(friction^2 - tan(slope)^2). What gives way along the ground with a lateral stiffness k, as
    a tyre does, stands still there. How far it has given way, s, is its state, and friction is

        F_t = -min(1, friction N / |k s + c s'|) (k s + c s'),
        s' = v_t - max(0, 1 - friction N / (k |s|)) s / tau,    tau = 1 ms,

    an elastic and then viscoplastic element with the limit of Coulomb (the reset integrator of
    Haessig and Friedland, 1991, without its jump).

    Args:
        frame: The link whose origin the point, or the centre of the wheel, is.
        ground: What it stands on.
        stiffness: Of ground and body [N/m].
        damping: [s/m].
        friction: Coefficient.
        smoothing: s [m/s].
        radius: Of the wheel or ball [m].
        lateral_stiffness: k along the ground, in all directions [N/m]; 0 of none.
        lateral_damping: c [N s/m].
        area: Of the foot that the point stands for [m2], 0 of none; what it presses with on the
            ground is recorded.
        name: See `ExternalForce`.

    Raises:
        InputError: A number that is none, or too small.
    """

    def __init__(
        self,
        frame: str,
        ground: Ground | None = None,
        stiffness: float = STIFFNESS,
        damping: float = DAMPING,
        friction: float = FRICTION,
        smoothing: float = SMOOTHING,
        radius: float = 0.0,
        area: float = 0.0,
        lateral_stiffness: float = 0.0,
        lateral_damping: float = 0.0,
        name: str = "",
    ):
        super().__init__(frame, name)
        self.ground = Ground() if ground is None else ground
        what = f"of the contact at '{frame}'"
        self.stiffness = as_number(stiffness, f"the stiffness {what}", "N/m", above=0)
        self.smoothing = as_number(smoothing, f"the smoothing {what}", "m/s", above=0)
        numbers = []
        for key, unit, value in (
            ("damping", "s/m", damping), ("friction", "", friction),
            ("radius", "m", radius), ("area", "m2", area),
            ("lateral stiffness", "N/m", lateral_stiffness),
            ("lateral damping", "N s/m", lateral_damping),
        ):  # fmt: skip
            numbers.append(as_number(value, f"the {key} {what}", unit))
            if numbers[-1] < 0:
                raise InputError(f"the {key} {what} is {value:g}, it must not be negative")
        self.damping, self.friction, self.radius, self.area = numbers[:4]
        self.lateral_stiffness, self.lateral_damping = numbers[4:]
        if self.lateral_damping and not self.lateral_stiffness:
            raise InputError(f"the lateral damping {what} has no lateral stiffness, give both")

    def edges(self, here: Here) -> list[Number]:
        """See `ExternalForce`: the gap."""
        return [self.ground.over(here.place)[0] - self.radius]

    @property
    def channels(self) -> list[tuple[str, str]]:
        """See `ExternalForce`: N, and over the area."""
        pressure = [(f"pressure_{self.name}", "Pa")] if self.area else []
        return [(f"support_{self.name}", "N"), *pressure]

    def look(self, here: Here) -> Sequence[Number]:
        """See `ExternalForce`."""
        pressed = self._pressed(here)[0]
        return [pressed, pressed / self.area] if self.area else [pressed]

    def _pressed(self, here: Here) -> tuple[Number, list[Number], list[Number], list[Number]]:
        """N, the normal, where the ground is touched from the frame, and how fast that slides."""
        above, normal = self.ground.over(here.place)
        arm = scale(-1.0 * above, normal)
        velocity = add(here.velocity, cross(here.spin, arm))
        rising = dot(normal, velocity)
        depth = maximum(self.radius - above, 0.0)
        pressed = self.stiffness * depth * maximum(1.0 - self.damping * rising, 0.0)
        return pressed, normal, arm, subtract(velocity, scale(rising, normal))

    def wrench(self, here: Here) -> tuple[Sequence[Number], Sequence[Number]]:
        """See `ExternalForce`."""
        pressed, normal, arm, along = self._pressed(here)
        speed = apply("sqrt", dot(along, along) + self.smoothing**2)
        force = scale(pressed, subtract(normal, scale(self.friction / speed, along)))
        if self.lateral_stiffness:
            force = add(scale(pressed, normal), self._held(here, pressed, normal, along)[0])
        return force, cross(arm, force)

    @property
    def states(self) -> int:
        """See `ExternalForce`: s along the ground's two directions."""
        return 2 if self.lateral_stiffness else 0

    def rates(self, here: Here) -> Sequence[Number]:
        """See `ExternalForce`."""
        if not self.lateral_stiffness:
            return ()
        pressed, normal, _, along = self._pressed(here)
        return self._held(here, pressed, normal, along)[1]

    def _held(
        self, here: Here, pressed: Number, normal: list[Number], along: list[Number]
    ) -> tuple[list[Number], list[Number]]:
        """F_t (3,) and s' (2,)."""
        level = 1.0 / apply("sqrt", normal[0] * normal[0] + normal[2] * normal[2])
        first: list[Number] = [level * normal[2], 0.0, -1.0 * level * normal[0]]
        axes = first, cross(normal, first)
        s, most = list(here.states), self.friction * pressed
        beyond = maximum(1.0 - most / (self.lateral_stiffness * _size(s, _LEAST)), 0.0)
        touching = where_positive(pressed, 1.0, 0.0)
        rates = [
            touching * dot(along, axis) - beyond * x / _RELAXATION
            for axis, x in zip(axes, s, strict=True)
        ]
        pull = add(scale(self.lateral_stiffness, s), scale(self.lateral_damping, rates))
        share = most / maximum(_size(pull, _LEAST * self.lateral_stiffness), most)
        total = add(scale(pull[0], axes[0]), scale(pull[1], axes[1]))
        return scale(-1.0 * share, total), rates


def _size(vector: list[Number], least: float) -> Number:
    return apply("sqrt", dot(vector, vector) + least**2)
