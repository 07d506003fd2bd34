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
    sqrt(friction^2 - tan(slope)^2).

    Args:
        frame: The link whose origin the point, or the centre of the wheel, is.
        ground: What it stands on.
        stiffness: Of ground and body [N/m].
        damping: [s/m].
        friction: Coefficient.
        smoothing: s [m/s].
        radius: Of the wheel or ball [m].
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
        ):  # fmt: skip
            numbers.append(as_number(value, f"the {key} {what}", unit))
            if numbers[-1] < 0:
                raise InputError(f"the {key} {what} is {value:g}, it must not be negative")
        self.damping, self.friction, self.radius, self.area = numbers

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
        return force, cross(arm, force)
