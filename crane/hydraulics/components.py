"""The hydraulic circuit of a machine as its file describes it."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields

from crane.common.errors import InputError
from crane.common.magnitudes import meant
from crane.common.samples import as_number

HOLDING = ("counterbalance_a", "counterbalance_b")  # valves of a cylinder that hold its load
_NOT_NUMBERS = ("joint", *HOLDING)
_LEAST = 1e-50  # of what must be positive: one over its square is still a number


class PartError(InputError):
    """A number of a part of the circuit that cannot be.

    Args:
        key: Its name.
        message: See `CraneError`.
    """

    def __init__(self, key: str, message: str):
        super().__init__(message)
        self.key = key


def number_names(kind: type) -> list[str]:
    """Names of the numbers of a kind of part."""
    return [entry.name for entry in fields(kind) if entry.name not in _NOT_NUMBERS]


def check_numbers(item: object, what: str) -> None:
    """Raise for numbers of a part that are not finite, negative, or zero where that cannot be.

    What a field allows is in its metadata: "above" (0) or "signed"; anything else is at least 0.
    """
    for entry in fields(item):  # type: ignore[arg-type]
        value = getattr(item, entry.name)
        if not isinstance(value, int | float):
            continue
        number = as_number(value, f"{entry.name} of {what}", "")
        positive = bool(entry.metadata.get("positive"))
        if entry.metadata.get("signed") or number >= (_LEAST if positive else 0.0):
            continue
        wanted = "must be positive" if positive else "must not be < 0"
        if number > 0:
            wanted = f"must be at least {_LEAST:g}"
        raise PartError(entry.name, f"{entry.name} of {what} is {number:g}, it {wanted}")


def positive() -> float:
    """A field without a default that must be above 0."""
    return field(metadata={"positive": True})


def above(default: float) -> float:
    """A field with a default that must be above 0."""
    return field(default=default, metadata={"positive": True})


def signed(default: float) -> float:
    """A field with a default, of either sign."""
    return field(default=default, metadata={"signed": True})


@dataclass(frozen=True)
class Oil:
    """What fills the circuit.

    Attributes:
        bulk_modulus: Of the oil [Pa].
        hose_modulus: Of a hose's volume, pressure per relative widening [Pa]; 0 for rigid hoses.
        steel_modulus: The same of the cylinders' walls [Pa]; 0 for rigid ones.
        vapour_pressure: Below which no chamber falls [Pa].
        gas_exponent: Of the polytropic change of entrapped gas.
    """

    bulk_modulus: float = above(1.65e9)
    hose_modulus: float = 0.0
    steel_modulus: float = 0.0
    vapour_pressure: float = 1.0e3
    gas_exponent: float = above(1.4)

    def __post_init__(self) -> None:
        check_numbers(self, "the oil")


@dataclass(frozen=True)
class Supply:
    """Pump and tank.

    Attributes:
        pressure: That the pump keeps [Pa].
        tank: Pressure of the return line [Pa].
        flow: The most that the pump delivers [m3/s]; 0 for as much as is asked for.
        droop: By how much the pressure falls from no flow to all of it [Pa].
        volume: Of the line between pump and valves [m3].
    """

    pressure: float
    tank: float = 1.0e5
    flow: float = 0.0
    droop: float = above(2.0e5)
    volume: float = above(2.0e-3)

    def __post_init__(self) -> None:
        check_numbers(self, "the supply")
        if self.pressure <= self.tank:
            raise PartError(
                "pressure",
                f"pressure of the supply is {self.pressure:g} Pa, not above the tank's "
                f"{self.tank:g} Pa, so that nothing would flow"
                + (
                    meant("pressure", self.pressure)
                    or ", give a little more for a pump that rests"
                ),
            )


@dataclass(frozen=True)
class Counterbalance:
    """A load-holding valve at one chamber: free inflow, outflow only when piloted open.

    Opening = (p + pilot_ratio p_other - pressure) / range, from 0 to 1.

    Attributes:
        pressure: At which the chamber's own pressure begins to open it [Pa].
        pilot_ratio: How much more the other chamber's pressure counts.
        range: From begin to full opening [Pa].
        coefficient: Flow per root of pressure, fully open [m3/(s Pa^0.5)].
    """

    pressure: float = positive()
    pilot_ratio: float = positive()
    range: float = positive()
    coefficient: float = positive()

    def __post_init__(self) -> None:
        check_numbers(self, "the counterbalance valve")


@dataclass(frozen=True)
class Cylinder:
    """A double-acting cylinder, or a rotary drive with volumes per angle, along one joint.

    Chamber A drives the joint in its positive direction. With x the joint's coordinate above its
    lower limit and s the distance between the limits, V_A = hose_a + area_a x and
    V_B = hose_b + area_b (s - x), as in equation (23) of the electro-hydraulic forwarder paper.

    Attributes:
        joint: The active joint.
        area_a: Of chamber A [m2], or volume per angle [m3/rad].
        area_b: Of chamber B.
        hose_a: Volume of hoses and fittings at chamber A, V_hA [m3].
        hose_b: At chamber B, V_hB [m3].
        gas_a: Volume that gas entrapped in chamber A has at 1e5 Pa [m3].
        gas_b: In chamber B.
        leakage: Past the piston, flow per pressure [m3/(s Pa)].
        leakage_a: From chamber A to the tank, through the closed spool [m3/(s Pa)].
        leakage_b: From chamber B.
        relief: Pressure at which a chamber is relieved to the tank [Pa]; 0 for no relief valves.
        relief_gain: Their flow per pressure above it [m3/(s Pa)].
        refill: Coefficient of check valves that let oil from the tank into a chamber below its
            pressure [m3/(s Pa^0.5)]; 0 for none.
        cushion: Distance from either end where the outflow is throttled [m] or [rad]; 0 for no
            cushioning.
        cushion_coefficient: Of the throttle at the very end [m3/(s Pa^0.5)].
        stiffness: Of a spring in series with the cylinder, for boom and mountings [N/m] or
            [N m/rad]; 0 for none.
        damping: Of a damper beside that spring [N s/m] or [N m s/rad].
        seal_friction: By how much the pressures of both chambers raise the joint's Coulomb
            friction [N/Pa] or [N m/Pa], see `DrivenCylinder.grip`.
        brake: What a spring-applied brake holds while the spool is within its dead band [N] or
            [N m]; 0 for none.
        brake_release: Spool travel beyond the dead band over which it lets go.
        counterbalance_a: Load-holding valve at chamber A.
        counterbalance_b: At chamber B.
    """

    joint: str
    area_a: float = positive()
    area_b: float = positive()
    hose_a: float = positive()
    hose_b: float = positive()
    gas_a: float = 0.0
    gas_b: float = 0.0
    leakage: float = 0.0
    leakage_a: float = 0.0
    leakage_b: float = 0.0
    relief: float = 0.0
    relief_gain: float = above(1.0e-9)
    refill: float = 0.0
    cushion: float = 0.0
    cushion_coefficient: float = above(1.0e-7)
    stiffness: float = 0.0
    damping: float = above(1.0e5)
    seal_friction: float = 0.0
    brake: float = 0.0
    brake_release: float = above(0.05)
    counterbalance_a: Counterbalance | None = None
    counterbalance_b: Counterbalance | None = None

    def __post_init__(self) -> None:
        check_numbers(self, f"the cylinder of '{self.joint}'")

    @property
    def grips(self) -> bool:
        """Whether it adds to the joint's Coulomb friction."""
        return self.seal_friction > 0 or self.brake > 0


@dataclass(frozen=True)
class Valve:
    """A proportional directional valve of one cylinder.

    The signal U [V] asks for the spool position u = (U - neutral) / (full - neutral), from -1 to
    1; the spool follows. Its opening is y = sign(u) (|u| - dead_band) / (1 - dead_band) outside of
    the dead band. Flows through the open edges are equations (21), (22) of the electro-hydraulic
    forwarder paper,

        y > 0:  Q_A = c1 y sqrt(p_S - p_A),  Q_B = -c2 y sqrt(p_B - p_R),
        y < 0:  Q_A = c3 y sqrt(p_A - p_R),  Q_B = -c4 y sqrt(p_S - p_B).

    With a margin the inlets c1, c4 are pressure compensated: the pressure drop is at most that
    margin, so the flow is c1 y sqrt(margin) until the supply no longer suffices; nothing flows
    back into the supply.

    Attributes:
        joint: Its cylinder's joint.
        c1: Coefficient of the edge from the supply to A [m3/(s Pa^0.5)].
        c2: From B to the tank.
        c3: From A to the tank.
        c4: From the supply to B.
        margin: Pressure drop that the compensator keeps [Pa]; 0 without compensation.
        neutral: Signal of the middle position [V].
        full: Signal of u = 1 [V].
        dead_band: Share of the spool's stroke without flow.
        bandwidth: Natural frequency of the spool [rad/s]; 0 for a spool without inertia.
        damping: Its damping ratio.
        rate: The fastest it moves, in strokes (of u from 0 to 1) per second; 0 for no limit.
    """

    joint: str
    c1: float = positive()
    c2: float = positive()
    c3: float = positive()
    c4: float = positive()
    margin: float = 0.0
    neutral: float = signed(0.0)
    full: float = signed(1.0)
    dead_band: float = 0.0
    bandwidth: float = 0.0
    damping: float = above(1.0)
    rate: float = 0.0

    def __post_init__(self) -> None:
        what = f"the valve of '{self.joint}'"
        check_numbers(self, what)
        if self.full == self.neutral:
            text = f"full and neutral of {what} are both {self.full:g}, give two"
            raise PartError("full", text)
        if self.dead_band >= 1:
            text = f"dead_band of {what} is {self.dead_band:g}, it must be below 1"
            if self.dead_band < 100:
                text += f": looks like percent, write {self.dead_band / 100:g}"
            raise PartError("dead_band", text)
        if self.rate and not self.bandwidth:
            raise PartError("rate", f"{what} has a rate but no bandwidth, give both")

    def opening(self, u: float) -> float:
        """Opening y of a spool position u."""
        size = min(max((abs(u) - self.dead_band) / (1.0 - self.dead_band), 0.0), 1.0)
        return math.copysign(size, u)


@dataclass(frozen=True)
class PDGains:
    """Gains of one valve's PD controller, equation (37) of the electro-hydraulic forwarder paper.

    Attributes:
        kp: Spool position per error [1/m] or [1/rad].
        kd: Spool position per error of the velocity [s/m] or [s/rad].
    """

    kp: float
    kd: float

    def __post_init__(self) -> None:
        check_numbers(self, "PD gains")


@dataclass(frozen=True)
class Hydraulics:
    """A machine's hydraulic circuit: one supply, and a valve and a cylinder per joint.

    Pressures count from a vacuum. Forces are those of equation (20) of the electro-hydraulic
    forwarder paper, F = area_a p_A - area_b p_B.

    Attributes:
        supply: Pump and tank.
        oil: What fills it.
        cylinders: By joint, in the order of the active joints.
        valves: By joint, in the same order.
        control: Gains of the valves' controllers, by joint; of all or of none.
    """

    supply: Supply
    oil: Oil
    cylinders: Mapping[str, Cylinder]
    valves: Mapping[str, Valve]
    control: Mapping[str, PDGains] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_tank(self.supply, self.oil)
        for cylinder in self.cylinders.values():
            check_relief(self.supply, cylinder)

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints that it drives."""
        return tuple(self.cylinders)

    @property
    def gripped(self) -> tuple[str, ...]:
        """The joints whose Coulomb friction it adds to."""
        return tuple(joint for joint, cylinder in self.cylinders.items() if cylinder.grips)

    def only(self, joints: Iterable[str]) -> "Hydraulics | None":
        """The circuit of some joints, in their order; None if it drives none of them."""
        kept = [joint for joint in joints if joint in self.cylinders]
        if not kept:
            return None
        return Hydraulics(
            self.supply,
            self.oil,
            {joint: self.cylinders[joint] for joint in kept},
            {joint: self.valves[joint] for joint in kept},
            {joint: self.control[joint] for joint in kept if self.control},
        )


def check_tank(supply: Supply, oil: Oil) -> None:
    """Raise where the oil boils in the tank.

    Raises:
        PartError: Of the tank's pressure.
    """
    if supply.tank <= oil.vapour_pressure:
        hint = ": pressures count from a vacuum, write 1e5 for an open tank"
        raise PartError(
            "tank",
            f"pressure of the tank is {supply.tank:g} Pa, the oil boils at "
            f"{oil.vapour_pressure:g} Pa{meant('tank', supply.tank) or hint}",
        )


def check_relief(supply: Supply, cylinder: Cylinder) -> None:
    """Raise where a relief valve would never close.

    Raises:
        PartError: Of the relief pressure.
    """
    if 0 < cylinder.relief <= supply.tank:
        raise PartError(
            "relief",
            f"relief of the cylinder of '{cylinder.joint}' is {cylinder.relief:g} Pa, not above "
            f"the tank's {supply.tank:g} Pa, so that it would never close"
            f"{meant('relief', cylinder.relief) or ', give a higher one'}",
        )
