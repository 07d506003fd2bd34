"""What a user wrote, read and checked, before anything is assembled."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from crane.common.errors import InputError
from crane.common.samples import as_number
from crane.description.estimation_settings import EstimationSettings
from crane.description.external_forces import ExternalForce, Wrench
from crane.description.kinematic_tree import Joint, Tree, Vector
from crane.description.sensors import Sensor
from crane.description.task_phases import Phase
from crane.hydraulics.hydraulic_circuit import Hydraulics


def _check_numbers(element: object, label: str, *nonnegative_fields: str) -> None:
    """Raise for numbers that are not finite, or negative where that has no meaning."""
    for name, value in vars(element).items():
        if name in ("joint", "between"):
            continue
        number = as_number(value, f"{name} of {label}", "")
        if name in nonnegative_fields and number < 0:
            raise InputError(f"{name} of {label} is {number:g}, it must not be negative")


def element_name(element: "AnyForceElement") -> str:
    """What errors call an element."""
    if element.between is None:
        return f"{element.kind} of '{element.joint}'"
    return f"{element.kind} between {' and '.join(map(repr, element.between))}"


def _check_frames(element: "AnyForceElement") -> None:
    """Raise for an element that acts on nothing, or between one frame and itself."""
    if element.between is None and not element.joint:
        raise InputError(f"a {element.kind} acts on nothing, give it a joint or two frames")
    if element.between is not None and not len(element.between) == len(set(element.between)) == 2:
        raise InputError(f"the {element_name(element)} needs two frames, give two")


@dataclass(frozen=True)
class Chain:
    """One open sub-chain: a URDF whose root link is fixed to a frame of an earlier chain.

    Attributes:
        name: The sub-chain's name.
        urdf: Its file.
        parent: Frame it hangs from; None for the first chain, which stands on the world.
        source_location: Where it was written, for errors.
        joints: Its moving joints.
    """

    name: str
    urdf: Path
    parent: str | None
    source_location: str
    joints: tuple[str, ...]

    @property
    def attachment_name(self) -> str:
        """Name of the fixed joint between its parent frame and its root link."""
        return f"{self.name}_attachment"

    def attachment_joint(self, root: str) -> Joint:
        """That joint, for a root link."""
        return Joint(self.attachment_name, "fixed", str(self.parent), root, self.source_location)


@dataclass(frozen=True)
class LoopSpec:
    """A joint that closes a loop between two frames of the spanning tree.

    Attributes:
        name: The loop's name.
        type: One of the keys of `LOOP_TYPES`.
        predecessor: First frame.
        successor: Second frame.
        axis: Unit vector in both frames: the direction the joint leaves free (normal of a
            planar joint).
        source_location: Where it was written, for errors.
    """

    name: str
    type: str
    predecessor: str
    successor: str
    axis: Vector
    source_location: str


@dataclass(frozen=True)
class Coupling:
    """A linear constraint of joints, sum factor q = offset: a gear, a joint that mimics another.

    Attributes:
        name: Its name.
        factors: By joint, the first that of the joint which follows.
        offset: [rad], [m].
        source_location: Where it was written, for errors.
    """

    name: str
    factors: Mapping[str, float]
    offset: float
    source_location: str


@dataclass(frozen=True)
class Drive:
    """What a motor or cylinder acts along: its length, L = sum factor q.

    A force u along L is the force factor u at each of its joints.

    Attributes:
        name: Its name.
        factors: By joint; the one joint of a motor with factor 1.
    """

    name: str
    factors: Mapping[str, float]


def source_locations(loops: Iterable[LoopSpec], couplings: Iterable[Coupling]) -> dict[str, str]:
    """Where loops and couplings were written, as errors about them look it up."""
    elements: list[LoopSpec | Coupling] = [*loops, *couplings]
    return {f"loop {item.name}": item.source_location for item in elements}


def unit_vector(xyz: Sequence[float]) -> Vector | None:
    """The direction of three numbers; None if they are not three, or all zero."""
    largest = max(abs(value) for value in xyz)
    if len(xyz) != 3 or largest == 0:
        return None
    length = math.hypot(*(value / largest for value in xyz))
    x, y, z = (value / largest / length for value in xyz)
    return x, y, z


# Locked directions of a loop joint whose axis is local z: three translations, three rotations.
AXISLESS_TYPES = ("fixed", "floating", "spherical")  # types of joints and loops that use none
LOOP_TYPES: Mapping[str, tuple[int, int, int, int, int, int]] = {
    "fixed": (1, 1, 1, 1, 1, 1),
    "revolute": (1, 1, 1, 1, 1, 0),
    "prismatic": (1, 1, 0, 1, 1, 1),
    "cylindrical": (1, 1, 0, 1, 1, 0),
    "spherical": (1, 1, 1, 0, 0, 0),
    "planar": (0, 0, 1, 1, 1, 0),
}


@dataclass(frozen=True)
class Friction:
    """Friction of one tree joint, asymmetric Coulomb and viscous.

    tau = (coulomb + stiction e^-(v / stribeck)^2) sign(v) + coulomb_offset
          + viscous v + viscous_offset |v|,

    the joint's drive force that the friction consumes. At rest it is what keeps the joint there,
    anything from coulomb_offset - (coulomb + stiction) to coulomb_offset + (coulomb + stiction).
    With a smoothing it is a function of v instead, sign(v) = tanh(v / smoothing), and what should
    rest creeps. Without stiction this is equation (5) of the reduced-scale forwarder paper with
    the sign that brakes.

    Attributes:
        coulomb: [N] or [N m].
        coulomb_offset: Difference between the two directions [N] or [N m].
        viscous: [N s/m] or [N m s/rad].
        viscous_offset: Difference between the two directions [N s/m] or [N m s/rad].
        smoothing: Velocity over which the sign changes [m/s] or [rad/s]; 0: it jumps, and sticks.
        stiction: By how much friction at rest exceeds Coulomb friction [N] or [N m].
        stribeck: Velocity over which stiction vanishes [m/s] or [rad/s].
    """

    coulomb: float = 0.0
    coulomb_offset: float = 0.0
    viscous: float = 0.0
    viscous_offset: float = 0.0
    smoothing: float = 0.0
    stiction: float = 0.0
    stribeck: float = 1e-2

    def __post_init__(self) -> None:
        _check_numbers(self, "friction", "coulomb", "viscous", "smoothing", "stiction", "stribeck")
        if self.stribeck == 0:
            raise InputError("stribeck of friction is 0, give the velocity where stiction ends")

    @property
    def breakaway_force(self) -> float:
        """How much friction at rest can differ from `coulomb_offset` [N] or [N m]."""
        return self.coulomb + self.stiction

    @property
    def is_driving(self) -> bool:
        """Whether it drives the joint in one direction: an offset is larger than its mean."""
        return abs(self.coulomb_offset) > self.coulomb or abs(self.viscous_offset) > self.viscous

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
        _check_numbers(self, label, "stiffness", "damping")

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
        _check_numbers(self, label, "pressure", "volume", "exponent")
        for name in ("area", "volume", "exponent"):
            if getattr(self, name) == 0:
                raise InputError(f"{name} of {label} is 0, give one")

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
        label = element_name(self)
        _check_numbers(self, label, "length", "stiffness", "damping")
        for name in ("length", "stiffness"):
            if getattr(self, name) == 0:
                raise InputError(f"{name} of {label} is 0, give one")

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
        _check_numbers(self, f"end stop of '{self.joint}'", "stiffness", "damping")


@dataclass(frozen=True)
class PIGains:
    """Gains of one joint's PI controller, equation (7) of the reduced-scale forwarder paper.

    Attributes:
        kp: [N/m] or [N m/rad].
        ki: [N/(m s)] or [N m/(rad s)].
    """

    kp: float
    ki: float

    def __post_init__(self) -> None:
        _check_numbers(self, "PI gains", "kp", "ki")


@dataclass(frozen=True)
class ViaPoint:
    """A point that a task passes.

    Attributes:
        time: [s].
        point: What is given of its coordinates [m], [rad].
        rates: What is given of their rates there [m/s], [rad/s].
    """

    time: float
    point: Mapping[str, float]
    rates: Mapping[str, float] = field(default_factory=dict)


DEFAULT_RAMP_TIME = 0.3  # [s] in which a hand moves a lever from neutral to its end
TIP_COORDINATES = ("x", "y", "z")  # coordinates of tasks of the tip
ATTITUDE_COORDINATES = (
    ("inclination",),
    ("roll", "pitch", "yaw"),
)  # and of how its frame is turned


@dataclass(frozen=True)
class Task:
    """A named motion: of the tip or of active joints, by polynomials or via points, or levers.

    Attributes:
        name: The task's name.
        description: One line on what it is.
        duration: [s]; at most, where phases end by positions.
        space: "tip" (coordinates x, y, z of the world), "active" (the active joints), or
            "joystick" (levers of valves).
        coefficients: Per coordinate the polynomial in time [s], lowest power first [m], [rad].
        via: Points in the place of polynomials.
        levers: Per joint, or JOINT_b of a second spool, a polygon of time [s] and lever, -1 to 1.
        loads: What acts from outside while it is done, beside what always does.
        start: Active coordinates where levers begin [m], [rad]; at home where not given.
        phases: Of levers that are held until positions, in the place of polygons.
        ramp: How long a hand takes from neutral to a full lever there [s].
    """

    name: str
    description: str
    duration: float
    space: str
    coefficients: Mapping[str, tuple[float, ...]]
    levers: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    loads: tuple[Wrench, ...] = ()
    via: tuple[ViaPoint, ...] = ()
    start: Mapping[str, float] = field(default_factory=dict)
    phases: tuple[Phase, ...] = ()
    ramp: float = DEFAULT_RAMP_TIME

    @property
    def coordinates(self) -> tuple[str, ...]:
        """What polynomials or via points are of."""
        return tuple(self.via[0].point if self.via else self.coefficients)


@dataclass(frozen=True)
class PayloadSpec:
    """What a machine may carry at its tip.

    Attributes:
        chain: Where it hangs, and its file.
        tree: Its links and joints, and the joint that fixes it.
    """

    chain: Chain
    tree: Tree


@dataclass(frozen=True)
class MachineSpec:
    """A machine as described by its file; see docs/machine_file.md for the keys."""

    name: str
    source: str
    path: Path
    chains: tuple[Chain, ...]
    tree: Tree  # all chains hung onto each other
    loops: tuple[LoopSpec, ...] = ()
    active: tuple[str, ...] | None = None  # None: every joint of the tree; (): not named
    home: Mapping[str, float] = field(default_factory=dict)
    friction: Mapping[str, Friction] = field(default_factory=dict)
    forces: tuple[ForceElement, ...] = ()
    gas_springs: tuple[GasSpring, ...] = ()
    end_stops: tuple[EndStop, ...] = ()
    tip: str | None = None
    tasks: Mapping[str, Task] = field(default_factory=dict)
    control: Mapping[str, PIGains] = field(default_factory=dict)
    hydraulics: Hydraulics | None = None
    couplings: tuple[Coupling, ...] = ()
    source_locations: Mapping[str, str] = field(default_factory=dict)  # section -> "file:line"
    payload: PayloadSpec | None = None  # what payload.mass hangs on the tip; None: a point mass
    free: tuple[str, ...] = ()  # independent coordinates that nothing drives
    drives: tuple[Drive, ...] = ()  # what the format says motors act on; (): the active joints
    ropes: tuple[Rope, ...] = ()
    sensors: Mapping[str, Sensor] = field(default_factory=dict)  # by quantity
    estimation: EstimationSettings = EstimationSettings()
    external_forces: tuple[ExternalForce, ...] = ()  # forces from outside
    supports: tuple[str, ...] = ()  # links that it stands on
    pin_capacities: Mapping[str, float] = field(
        default_factory=dict
    )  # by joint or loop, most force [N]

    @property
    def force_elements(self) -> tuple[AnyForceElement, ...]:
        """Its force elements, gas springs and ropes, along joints and between frames."""
        return (*self.forces, *self.gas_springs, *self.ropes)
