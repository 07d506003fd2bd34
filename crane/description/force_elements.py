"""Force elements of a machine: friction, springs, gas springs, ropes and end stops."""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

from crane.common.errors import InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import as_number


def as_nonnegative_number(value: object, label: str, unit: str) -> float:
    """A number that is not negative, see `crane.common.samples.as_number`."""
    number = as_number(value, label, unit)
    if number < 0:
        shown = " ".join(f"{label} is {number:g} {unit}".split())
        raise InputError(f"{shown}, it must not be negative")
    return number


def check_numbers(
    element: object, label: str, *nonnegative_fields: str, nonzero_fields: tuple[str, ...] = ()
) -> None:
    """Raise for numbers that are not finite, or negative or zero where that has no meaning."""
    for name, value in vars(element).items():
        if name in ("joint", "between"):
            continue
        check = as_nonnegative_number if name in nonnegative_fields else as_number
        if check(value, f"{name} of {label}", "") == 0 and name in nonzero_fields:
            raise InputError(f"{name} of {label} is 0, give one")


def element_name(element: "AnyForceElement") -> str:
    """What errors call an element."""
    if element.between is None:
        return f"{element.kind} of '{element.joint}'"
    return f"{element.kind} between {' and '.join(map(repr, element.between))}"


def _check_frames(element: "AnyForceElement") -> None:
    if element.between is None and not element.joint:
        raise InputError(f"a {element.kind} acts on nothing, give it a joint or two frames")
    if element.between is not None and not len(element.between) == len(set(element.between)) == 2:
        raise InputError(f"the {element_name(element)} needs two frames, give two")


@dataclass(frozen=True, repr=False)
class Friction(OneLineRepr):
    """Friction of one tree joint, asymmetric Coulomb and viscous.

        tau = (coulomb + stiction e^-(v / stribeck)^2 + stiction_2 e^-(v / stribeck_2)^2
        + memory e^-(w / memory_speed)) sign(v) + presliding z + coulomb_offset
        + viscous v + viscous_offset |v| + root sign(v) |v|^(1/2)

    is the joint's drive force that the friction consumes. It depends on the history of the motion
    by Dahl's deflection z of the contacts, dz = (1 - sign(v) z) dq / presliding_length, and by the
    speed that the contact remembers, memory_time w' = |v| - w. At steady speeds z is sign(v) and w
    is |v|: so a simulation takes them, and `Dynamics.inverse` with the step of a motion takes its
    history. At rest friction is what keeps the joint there, at most `breakaway_force` from
    coulomb_offset.
    With a smoothing it is a function of v instead, sign(v) = tanh(v / smoothing), and what should
    rest creeps. Without stiction this is equation (5) of the reduced-scale forwarder paper with
    the sign that brakes.

    Attributes:
        coulomb: [N] or [N m].
        coulomb_offset: Difference between the two directions [N] or [N m].
        viscous: [N s/m] or [N m s/rad].
        viscous_offset: Difference between the two directions [N s/m] or [N m s/rad].
        smoothing: Velocity over which the sign changes [m/s] or [rad/s]; 0: it jumps, and sticks.
        stiction: By how much friction at rest exceeds Coulomb friction [N] or [N m]; negative
            where friction rises from rest.
        stribeck: Velocity over which stiction vanishes [m/s] or [rad/s].
        stiction_2, stribeck_2: The same over another velocity.
        root: Mixed lubrication [N (s/m)^(1/2)] or [N m (s/rad)^(1/2)]; as of a velocity of 1e-8.
        presliding: Coulomb friction that builds up over a distance [N] or [N m].
        presliding_length: That distance [m] or [rad].
        memory: By how much friction after a rest exceeds that before it [N] or [N m].
        memory_time: Time constant of the memory [s].
        memory_speed: Speed over which the memory fades [m/s] or [rad/s].
    """

    coulomb: float = 0.0
    coulomb_offset: float = 0.0
    viscous: float = 0.0
    viscous_offset: float = 0.0
    smoothing: float = 0.0
    stiction: float = 0.0
    stribeck: float = 1e-2
    stiction_2: float = 0.0
    stribeck_2: float = 1e-2
    root: float = 0.0
    presliding: float = 0.0
    presliding_length: float = 1e-4
    memory: float = 0.0
    memory_time: float = 0.1
    memory_speed: float = 1e-2

    def _one_line(self) -> str:
        """The values that are not the defaults."""
        given = [
            f"{x.name}={value:g}"
            for x in dataclasses.fields(self)
            if (value := getattr(self, x.name)) != x.default
        ]
        return f"Friction({', '.join(given)})"

    def __post_init__(self) -> None:
        scales = ("stribeck", "stribeck_2", "presliding_length", "memory_time", "memory_speed")
        check_numbers(
            self, "friction", "coulomb", "viscous", "smoothing", "presliding", *scales,
            nonzero_fields=scales,
        )  # fmt: skip
        if self.breakaway_force < 0:
            raise InputError(
                f"friction at rest is {self.breakaway_force:g}, the sum of coulomb, presliding, "
                "stiction and memory must not be negative"
            )

    @property
    def breakaway_force(self) -> float:
        """How much friction at rest can differ from `coulomb_offset` [N] or [N m]."""
        return self.sliding_force + self.stiction + self.stiction_2 + self.memory

    @property
    def sliding_force(self) -> float:
        """Coulomb friction that is built up [N] or [N m]."""
        return self.coulomb + self.presliding

    @property
    def has_history(self) -> bool:
        """Whether it depends on the history of the motion."""
        return bool(self.presliding or self.memory)

    @property
    def driving_kind(self) -> str:
        """Kind whose offset is larger than its mean, which drives the joint one way, else ""."""
        if abs(self.coulomb_offset) > self.sliding_force:
            return "coulomb"
        return "viscous" if abs(self.viscous_offset) > self.viscous else ""

    @property
    def is_driving(self) -> bool:
        """Whether it drives the joint in one direction: an offset is larger than its mean."""
        return bool(self.driving_kind)

    @property
    def has_stick_slip(self) -> bool:
        """Whether it holds a joint at rest."""
        return self.smoothing == 0 and self.breakaway_force > 0


@dataclass(frozen=True)
class ForceElement:
    """A passive force along one tree joint, or along the distance of two frames.

    f = force - stiffness (q - rest) - damping q'

    with q the joint's coordinate, or the distance of the frames' origins: what is positive
    pushes them apart.

    Attributes:
        joint: The joint it acts on, active or passive; none with `between`.
        stiffness: [N/m] or [N m/rad].
        rest: Coordinate at which the spring is slack [m] or [rad].
        damping: [N s/m] or [N m s/rad].
        force: Constant force in the positive direction [N] or [N m].
        between: Two links, on two bodies or on one and the world.
    """

    joint: str = ""
    stiffness: float = 0.0
    rest: float = 0.0
    damping: float = 0.0
    force: float = 0.0
    between: tuple[str, str] | None = None
    kind: ClassVar[str] = "force element"

    def __post_init__(self) -> None:
        _check_frames(self)
        label = element_name(self)
        if self.joint and self.between:
            raise InputError(f"{label} is on '{self.joint}', too, keep one of the two")
        check_numbers(self, label, "stiffness", "damping")

    @property
    def requires_direction(self) -> bool:
        """Whether it asks for a direction where its frames meet: it pushes there, or damps."""
        return bool(self.damping or self.force + self.stiffness * self.rest)


@dataclass(frozen=True)
class GasSpring:
    """Enclosed gas that acts along one tree joint, or along the distance of two frames.

    f = area pressure (V0 / V)^exponent,    V = V0 + area (q - rest)

    with q the joint's coordinate, or the distance of the frames' origins: a counterbalance, an
    accumulator, a gas strut.

    Attributes:
        joint: The joint it acts on, active or passive; with `between` a name of its own.
        area: Of the piston, positive where the gas drives the joint in its positive direction
            [m2], or [m3/rad].
        pressure: At `rest` [Pa], above the outside's.
        volume: V0, at `rest` [m3].
        rest: Coordinate they belong to [m] or [rad].
        exponent: Of the polytropic change; 1 at constant temperature, 1.4 without heat flow.
        between: Two links, on two bodies or on one and the world.
    """

    joint: str
    area: float
    pressure: float
    volume: float
    rest: float = 0.0
    exponent: float = 1.0
    between: tuple[str, str] | None = None
    kind: ClassVar[str] = "gas spring"

    def __post_init__(self) -> None:
        _check_frames(self)
        label = element_name(self)
        nonzero_fields = "area", "volume", "exponent"
        check_numbers(self, label, "pressure", *nonzero_fields[1:], nonzero_fields=nonzero_fields)

    @property
    def requires_direction(self) -> bool:
        """Whether it asks for a direction where its frames meet."""
        return self.pressure != 0


@dataclass(frozen=True)
class Rope:
    """A rope or chain between two frames: it pulls where it is taut, and does nothing else.

    f = stiffness d max(0, 1 + damping d') towards each other, d = distance - length > 0

    as an end stop does at the distance `length`. So it never pushes, whatever its damping, and
    its force does not jump where it gets taut.

    Attributes:
        between: Two links, on two bodies or on one and the world.
        length: Up to which it is slack [m].
        stiffness: [N/m].
        damping: [s/m].
    """

    between: tuple[str, str]
    length: float
    stiffness: float
    damping: float = 0.0
    kind: ClassVar[str] = "rope"
    joint: ClassVar[str] = ""

    def __post_init__(self) -> None:
        _check_frames(self)
        nonzero_fields = "length", "stiffness"
        check_numbers(
            self, element_name(self), "damping", *nonzero_fields, nonzero_fields=nonzero_fields
        )

    @property
    def requires_direction(self) -> bool:
        """Whether it asks for a direction where its frames meet: it is slack there."""
        return False


AnyForceElement = ForceElement | GasSpring | Rope  # what may act between two frames


@dataclass(frozen=True)
class EndStop:
    """Elastic stops at both limits of a joint, after Hunt and Crossley.

    f = stiffness d max(0, 1 + damping d') towards the inside, d > 0 the depth beyond the limit.

    Attributes:
        joint: The joint, with finite limits in its URDF.
        stiffness: [N/m] or [N m/rad].
        damping: [s/m] or [s/rad].
    """

    joint: str
    stiffness: float
    damping: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(self, f"end stop of '{self.joint}'", "stiffness", "damping")
