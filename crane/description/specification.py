"""What a user wrote, read and checked, before anything is assembled."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from crane.common.errors import suggest_names
from crane.common.unit_conversions import KeyPath, WrittenNumber
from crane.description.estimation_settings import EstimationSettings as EstimationSettings
from crane.description.external_forces import ExternalForce, Wrench
from crane.description.force_elements import (
    AnyForceElement,
    EndStop,
    ForceElement,
    Friction,
    GasSpring,
    Rope,
    check_numbers,
)
from crane.description.kinematic_tree import Joint, Tree, Vector
from crane.description.sensors import Sensor
from crane.hydraulics.hydraulic_circuit import Hydraulics


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
    """A constraint of joints: a gear, a joint that mimics another, a cam.

        sum factor q + sum (a q^2 + b q^3 + c q^4) = offset

    Attributes:
        name: Its name.
        factors: By joint, the first that of the joint which follows.
        offset: [rad], [m].
        source_location: Where it was written, for errors.
        powers: Coefficients (a, b, c) of the higher powers by joint; none for a linear constraint.
    """

    name: str
    factors: Mapping[str, float]
    offset: float
    source_location: str
    powers: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that it binds."""
        return tuple(dict.fromkeys((*self.factors, *self.powers)))

    def without_joints(self, values: Mapping[str, float]) -> "Coupling":
        """Return what it asks of its other joints with some at coordinates."""
        offset = self.offset
        for joint, value in values.items():
            offset -= self.factors.get(joint, 0.0) * value
            for power, coefficient in enumerate(self.powers.get(joint, ()), start=2):
                offset -= coefficient * value**power
        factors = {joint: x for joint, x in self.factors.items() if joint not in values}
        powers = {joint: x for joint, x in self.powers.items() if joint not in values}
        return replace(self, factors=factors, powers=powers, offset=offset)


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
class PIGains:
    """Gains of one joint's PI controller, equation (7) of the reduced-scale forwarder paper.

    Attributes:
        kp: [N/m] or [N m/rad].
        ki: [N/(m s)] or [N m/(rad s)].
    """

    kp: float
    ki: float

    def __post_init__(self) -> None:
        check_numbers(self, "PI gains", "kp", "ki")


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


@dataclass(frozen=True)
class Phase:
    """Levers that are held until joints reach positions.

    Attributes:
        name: Name in messages about a phase that does not end.
        levers: By joint, -1 to 1, relative to the valve's flow.
        until: By joint the position [m], [rad] at which its lever returns to neutral. The phase
            ends when all joints have reached their positions.
        within: Largest duration [s].
    """

    name: str
    levers: Mapping[str, float]
    until: Mapping[str, float]
    within: float

    def without_joints(self, joints: Iterable[str]) -> "Phase":
        """Return the phase without some joints."""
        removed = set(joints)
        levers, until = (
            {joint: x for joint, x in part.items() if joint not in removed}
            for part in (self.levers, self.until)
        )
        return Phase(self.name, levers, until, self.within)

    def find_problems(
        self,
        valves: Sequence[str],
        limits: Mapping[str, tuple[float, float]],
        start_positions: Mapping[str, float],
    ) -> Iterator[tuple[str, str, str]]:
        """Yield the errors of a phase.

        Args:
            valves: Joints that have a valve.
            limits: Lower and upper limit by joint, as far as known.
            start_positions: Position before the phase by joint, as far as known.

        Yields:
            Key of the error ("levers", "until" or "within"), joint, message.
        """
        if not self.levers:
            yield "levers", "", f"phase '{self.name}' moves no lever, give it one"
        if not self.within > 0:
            text = f"phase '{self.name}' may take {self.within:g} s, give it a time above 0"
            yield "within", "", text
        for joint, lever in self.levers.items():
            label = f"the lever of '{joint}' in phase '{self.name}'"
            if joint not in valves:
                yield "levers", joint, f"no valve for '{joint}', {suggest_names(valves, joint)}"
                continue
            if not 0 < abs(lever) <= 1:
                yield "levers", joint, f"{label} is {lever:g}, give it -1 to 1 and not 0"
                continue
            if joint not in self.until:
                yield (
                    "levers",
                    joint,
                    f"{label} has no position that it is held until, add it under 'until'",
                )
        for joint, position in self.until.items():
            label = f"phase '{self.name}' waits for '{joint}' at {position:g}"
            lower, upper = limits.get(joint, (position, position))
            start = start_positions.get(joint, position)
            if joint not in self.levers:
                yield (
                    "until",
                    joint,
                    f"phase '{self.name}' moves no lever of '{joint}' and waits for it, "
                    f"{suggest_names(self.levers, joint)}",
                )
                continue
            if not lower <= position <= upper:
                yield "until", joint, f"{label}, beyond its limits {lower:g} to {upper:g}"
                continue
            if self.levers[joint] * (position - start) < 0:
                yield (
                    "until",
                    joint,
                    f"{label}, away from which its lever moves it from {start:g}: turn it",
                )


DEFAULT_RAMP_TIME = 0.3  # [s] in which a hand moves a lever from neutral to its end
TIP_COORDINATES = ("x", "y", "z")  # coordinates of tasks of the tip
# and of how its frame is turned
ATTITUDE_COORDINATES = ("inclination",), ("roll", "pitch", "yaw")


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


STANDARD_GRAVITY = (0.0, 0.0, -9.81)  # [m/s2]


@dataclass(frozen=True, eq=False, repr=False)
class MachineParts:
    """What the description of a machine and the assembled machine have in common.

    `crane.machine.machine.Machine` has the meaning of each part.
    """

    name: str
    source: str
    path: Path
    chains: tuple[Chain, ...]
    tree: Tree
    friction: Mapping[str, Friction] = field(default_factory=dict)
    forces: tuple[ForceElement, ...] = ()
    gas_springs: tuple[GasSpring, ...] = ()
    ropes: tuple[Rope, ...] = ()
    end_stops: tuple[EndStop, ...] = ()
    tip: str | None = None
    tasks: Mapping[str, Task] = field(default_factory=dict)
    control: Mapping[str, PIGains] = field(default_factory=dict)
    hydraulics: Hydraulics | None = None
    free: tuple[str, ...] = ()
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    estimation: EstimationSettings = EstimationSettings()
    external_forces: tuple[ExternalForce, ...] = ()
    supports: tuple[str, ...] = ()
    start: str = ""  # "equilibrium", "home"; "": at rest where something would fall
    pin_capacities: Mapping[str, float] = field(default_factory=dict)
    written_numbers: Mapping[KeyPath, WrittenNumber] = field(default_factory=dict)

    @property
    def force_elements(self) -> tuple[AnyForceElement, ...]:
        """Force elements, gas springs and ropes, along joints and between frames."""
        return (*self.forces, *self.gas_springs, *self.ropes)


@dataclass(frozen=True, kw_only=True)
class MachineSpec(MachineParts):
    """A machine as described by its file; see docs/machine_file.md for the keys."""

    loops: tuple[LoopSpec, ...] = ()
    active: tuple[str, ...] | None = None  # None: every joint of the tree; (): not named
    home: Mapping[str, float] = field(default_factory=dict)
    couplings: tuple[Coupling, ...] = ()
    source_locations: Mapping[str, str] = field(default_factory=dict)  # section -> "file:line"
    payload: PayloadSpec | None = None  # what payload.mass hangs on the tip; None: a point mass
    drives: tuple[Drive, ...] = ()  # what the format says motors act on; (): the active joints
    gravity: tuple[float, ...] = STANDARD_GRAVITY  # (3,) [m/s2]
    is_complete: bool = True  # whether all elements have unique names, so that none is missing
