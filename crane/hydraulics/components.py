"""The hydraulic circuit of a machine as its file describes it."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from crane.common.errors import suggest_names
from crane.common.plausible_ranges import suggested_units_text
from crane.hydraulics.circuit_elements import Accumulator, CircuitElement, CircuitLine
from crane.hydraulics.opening_curve import OpeningCurve
from crane.hydraulics.parameter_checks import (
    CircuitPathError,
    ComponentParameterError,
    check_parameters,
    positive_field,
    positive_field_with_default,
    signed_field,
)
from crane.hydraulics.supply_and_engine import (
    MAIN_PUMP,
    TANK_NODE,
    Engine,
    Supply,
    check_pump_pressures,
    check_summed_pumps,
)

COUNTERBALANCE_KEYS = (
    "counterbalance_a",
    "counterbalance_b",
)  # valves of a cylinder that hold its load


@dataclass(frozen=True)
class Oil:
    """What fills the circuit.

    Attributes:
        bulk_modulus: Of the oil [Pa].
        hose_modulus: Of a hose's volume, pressure per relative widening [Pa]; 0 for rigid hoses.
        steel_modulus: The same of the cylinders' walls [Pa]; 0 for rigid ones.
        vapour_pressure: Below which no chamber falls [Pa].
        gas_exponent: Of the polytropic change of entrapped gas.
        air: Share of a volume that free air in the oil has at 1e5 Pa.
    """

    bulk_modulus: float = positive_field_with_default(1.65e9)
    hose_modulus: float = 0.0
    steel_modulus: float = 0.0
    vapour_pressure: float = 1.0e3
    gas_exponent: float = positive_field_with_default(1.4)
    air: float = 0.0

    def __post_init__(self) -> None:
        check_parameters(self, "the oil")


@dataclass(frozen=True)
class CounterbalanceValve:
    """A load-holding valve at one chamber: free inflow, outflow only when piloted open.

    Opening = (p + pilot_ratio p_other - pressure) / range, from 0 to 1.

    Attributes:
        pressure: At which the chamber's own pressure begins to open it [Pa].
        pilot_ratio: How much more the other chamber's pressure counts.
        range: From begin to full opening [Pa].
        coefficient: Flow per root of pressure, fully open [m3/(s Pa^0.5)].
    """

    pressure: float = positive_field()
    pilot_ratio: float = positive_field()
    range: float = positive_field()
    coefficient: float = positive_field()

    def __post_init__(self) -> None:
        check_parameters(self, "the counterbalance valve")


@dataclass(frozen=True)
class Cylinder:
    """A double-acting cylinder, or a rotary drive with volumes per angle, along one joint.

    Chamber A drives the joint in its positive direction. With x the joint's coordinate above its
    lower limit and s the distance between the limits, V_A = hose_a + area_a x and
    V_B = hose_b + area_b (s - x), as in equation (23) of the electro-hydraulic forwarder paper.

    Attributes:
        joint: The active joint.
        area_a: Of chamber A [m2], or volume per angle [m3/rad]; of all cylinders side by side.
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
            friction [N/Pa] or [N m/Pa], see `ValveCylinderEquations.circuit_friction`.
        brake: What a spring-applied brake holds while the spool is within its dead band [N] or
            [N m]; 0 for none.
        brake_release: Spool travel beyond the dead band over which it lets go.
        counterbalance_a: Load-holding valve at chamber A.
        counterbalance_b: At chamber B.
        cross_relief: Pressure of one chamber over the other at which the one is relieved into it
            [Pa], by `relief_gain`; 0 for no such valves.
        rupture_a: Flow out of chamber A at which its hose rupture valve holds [m3/s]; 0 for none.
        rupture_b: Of chamber B.
        motor: Whether it is a motor: its volumes do not change with the angle, and the joint needs
            no limits.
        tube: Outer diameter of the tube [m]; 0 where it is not known. It counts for buckling.
        count: How many cylinders side by side the areas are of.
    """

    joint: str
    area_a: float = positive_field()
    area_b: float = positive_field()
    hose_a: float = positive_field()
    hose_b: float = positive_field()
    gas_a: float = 0.0
    gas_b: float = 0.0
    leakage: float = 0.0
    leakage_a: float = 0.0
    leakage_b: float = 0.0
    relief: float = 0.0
    relief_gain: float = positive_field_with_default(1.0e-9)
    refill: float = 0.0
    cushion: float = 0.0
    cushion_coefficient: float = positive_field_with_default(1.0e-7)
    stiffness: float = 0.0
    damping: float = positive_field_with_default(1.0e5)
    seal_friction: float = 0.0
    brake: float = 0.0
    brake_release: float = positive_field_with_default(0.05)
    counterbalance_a: CounterbalanceValve | None = None
    counterbalance_b: CounterbalanceValve | None = None
    cross_relief: float = 0.0
    rupture_a: float = 0.0
    rupture_b: float = 0.0
    motor: bool = False
    tube: float = 0.0
    count: int = 1

    def __post_init__(self) -> None:
        label = f"the cylinder of '{self.joint}'"
        check_parameters(self, label)
        if not isinstance(self.count, int) or self.count < 1:
            raise ComponentParameterError(
                "count", f"count of {label} is {self.count}, give a whole number"
            )
        if self.tube and not self.tube > self.bore:
            raise ComponentParameterError(
                "tube",
                f"tube of {label} is {self.tube:g} m, it must be more than the bore of "
                f"{self.bore:.4g} m",
            )

    @property
    def bore(self) -> float:
        """Diameter of the piston of one of them, along a slide [m]."""
        return math.sqrt(4 / math.pi * max(self.area_a, self.area_b) / self.count)

    @property
    def rod(self) -> float:
        """Diameter of the rod of one of them; 0 where the areas are the same [m]."""
        return math.sqrt(4 / math.pi * abs(self.area_a - self.area_b) / self.count)

    @property
    def adds_friction(self) -> bool:
        """Whether it adds to the joint's Coulomb friction."""
        return self.seal_friction > 0 or self.brake > 0


@dataclass(frozen=True)
class Spool:
    """What moves a second spool of a valve, that of chamber B: numbers as of `Valve`.

    Attributes:
        joint: Its cylinder's joint.
        neutral: Signal of the middle position [V].
        full: Signal of u = 1, which drains chamber B [V].
        dead_band: Share of the spool's stroke without flow.
        bandwidth: Natural frequency of the spool [rad/s]; 0 for a spool without inertia.
        damping: Its damping ratio.
        rate: The fastest it moves, in strokes per second; 0 for no limit.
        hysteresis: Width of the play between signal and spool, as a share of the stroke.
        delay: Dead time of its electric stage [s].
    """

    joint: str
    neutral: float = signed_field(0.0)
    full: float = signed_field(1.0)
    dead_band: float = 0.0
    bandwidth: float = 0.0
    damping: float = positive_field_with_default(1.0)
    rate: float = 0.0
    hysteresis: float = 0.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        label = f"the second spool of '{self.joint}'"
        check_parameters(self, label)
        _check_spool(self, label)


@dataclass(frozen=True)
class Valve:
    """A proportional directional valve of one cylinder.

    The signal U [V] asks for the spool position u = (U - neutral) / (full - neutral), from -1 to
    1; the spool follows. Its opening is y = sign(u) (|u| - dead_band) / (1 - dead_band) outside of
    the dead band. After a dead time it follows the signal of t - delay, at first the first one.
    Flows through the open edges are equations (21), (22) of the electro-hydraulic forwarder
    paper,

        y > 0:  Q_A = c1 y sqrt(p_S - p_A),  Q_B = -c2 y sqrt(p_B - p_R),
        y < 0:  Q_A = c3 y sqrt(p_A - p_R),  Q_B = -c4 y sqrt(p_S - p_B).

    With a second spool the first one has chamber A alone, Q_A(y), and the second chamber B,
    Q_B(y_b), each with a signal of its own: an outflow is metered apart from the inflow then, both
    chambers can be joined to the pump (which regenerates) or to the tank (where it floats).

    With a margin the inlets c1, c4 are pressure compensated: the pressure drop is at most that
    margin, so the flow is c1 y sqrt(margin) until the supply no longer suffices; nothing flows
    back into the supply. With `sharing` the compensator stands behind the inlet and takes the
    pressure there to that of the highest load of the supply's valves, p_LS: the flow is
    c1 y sqrt(p_S - p_LS), which falls by one share in all such valves when the pump has no more.

    Edges may have curves: c1 is the coefficient of the wide open edge then, and c1 curve(|u|)
    stands for c1 y. An open centre lets the pump's flow pass while the spool rests; those of a
    supply's valves are in series. Beyond `float_from` of the negative stroke both chambers are
    joined to the tank and the inlet closes. Regeneration leads what leaves B into A while y > 0.

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
        hysteresis: Width of the play between signal and spool, as a share of the stroke.
        delay: Dead time of the electric stage [s].
        centre: Coefficient of the open centre at rest [m3/(s Pa^0.5)]; 0 for a closed one.
        regeneration: Coefficient of the check valve from B to A [m3/(s Pa^0.5)]; 0 for none.
        float_from: |u| beyond which a negative spool floats; 0 for none.
        float_coefficient: Of either way to the tank then [m3/(s Pa^0.5)].
        demand: Share of the pump's flow that the wide open valve asks of a positive control.
        sharing: Whether the compensator stands behind the inlet.
        priority: Whether it is served first: the pump's other valves get the share
            1 - (load + margin - p_S) / (0.2 margin) of their flows, within 0 and 1, as behind a
            priority valve.
        supply: Name of the pump that feeds it.
        return_a: Node that chamber A is drained to.
        return_b: Chamber B.
        curves: By "c1" to "c4" and "centre", share of the coefficient over |u|.
        spool_b: That of chamber B, where each chamber has one.
    """

    joint: str
    c1: float = positive_field()
    c2: float = positive_field()
    c3: float = positive_field()
    c4: float = positive_field()
    margin: float = 0.0
    neutral: float = signed_field(0.0)
    full: float = signed_field(1.0)
    dead_band: float = 0.0
    bandwidth: float = 0.0
    damping: float = positive_field_with_default(1.0)
    rate: float = 0.0
    hysteresis: float = 0.0
    delay: float = 0.0
    centre: float = 0.0
    regeneration: float = 0.0
    float_from: float = 0.0
    float_coefficient: float = 0.0
    demand: float = 1.0
    sharing: bool = False
    priority: bool = False
    supply: str = MAIN_PUMP
    return_a: str = TANK_NODE
    return_b: str = TANK_NODE
    curves: Mapping[str, OpeningCurve] = field(default_factory=dict)
    spool_b: Spool | None = None

    def __post_init__(self) -> None:
        label = f"the valve of '{self.joint}'"
        check_parameters(self, label)
        if self.priority and not self.margin:
            raise ComponentParameterError(
                "priority", f"{label} has priority and no margin to keep, give it one"
            )
        if self.sharing and self.margin:
            raise ComponentParameterError(
                "margin", f"{label} shares its flow, leave 'margin' to the pump"
            )
        if (self.float_from > 0) != (self.float_coefficient > 0) or self.float_from >= 1:
            raise ComponentParameterError(
                "float_from",
                f"{label} floats from {self.float_from:g} with the coefficient "
                f"{self.float_coefficient:g}, give both, from below 1",
            )
        _check_spool(self, label)
        for key in ("centre", "regeneration", "float_from") if self.spool_b else ():
            if getattr(self, key):
                raise ComponentParameterError(
                    key, f"{label} has two spools and '{key}', which goes with one, remove it"
                )

    @property
    def spools(self) -> "dict[str, Valve | Spool]":
        """What moves its spools, by the names of their signals."""
        main_spool: dict[str, Valve | Spool] = {self.joint: self}
        return main_spool | ({f"{self.joint}_b": self.spool_b} if self.spool_b else {})

    def opening(self, u: float) -> float:
        """Opening y of a spool position u."""
        size = min(max((abs(u) - self.dead_band) / (1.0 - self.dead_band), 0.0), 1.0)
        return math.copysign(size, u)


def _check_spool(spool: Spool | Valve, label: str) -> None:
    """Raise for what no spool can have.

    Raises:
        PartError: Of the number.
    """
    if spool.hysteresis >= 0.5:
        raise ComponentParameterError(
            "hysteresis",
            f"hysteresis of {label} is {spool.hysteresis:g}, give a "
            "share of the stroke, below 0.5",
        )
    if spool.full == spool.neutral:
        text = f"full and neutral of {label} are both {spool.full:g}, give two"
        raise ComponentParameterError("full", text)
    if spool.dead_band >= 1:
        text = f"dead_band of {label} is {spool.dead_band:g}, it must be below 1"
        if spool.dead_band < 100:
            text += f": looks like percent, write {spool.dead_band / 100:g}"
        raise ComponentParameterError("dead_band", text)
    if spool.rate and not spool.bandwidth:
        raise ComponentParameterError("rate", f"{label} has a rate but no bandwidth, give both")


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
        check_parameters(self, "PD gains")


@dataclass(frozen=True)
class Hydraulics:
    """A machine's hydraulic circuit: pumps, and a valve and a cylinder or motor per joint.

    Pressures count from a vacuum. Forces are those of equation (20) of the electro-hydraulic
    forwarder paper, F = area_a p_A - area_b p_B.

    Attributes:
        supply: Pump and tank.
        oil: What fills it.
        cylinders: By joint, in the order of the active joints.
        valves: By joint, in the same order.
        control: Gains of the valves' controllers, by joint; of all or of none.
        supplies: Further pumps, by their nodes' names.
        engine: That turns all pumps; they have constant speed without.
        lines: Further nodes by name.
        accumulators: Likewise.
        elements: Between nodes, by name.
    """

    supply: Supply
    oil: Oil
    cylinders: Mapping[str, Cylinder]
    valves: Mapping[str, Valve]
    control: Mapping[str, PDGains] = field(default_factory=dict)
    supplies: Mapping[str, Supply] = field(default_factory=dict)
    engine: Engine | None = None
    lines: Mapping[str, CircuitLine] = field(default_factory=dict)
    accumulators: Mapping[str, Accumulator] = field(default_factory=dict)
    elements: Mapping[str, CircuitElement] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_tank_pressure(self.supply, self.oil)
        for cylinder in self.cylinders.values():
            check_relief_pressure(self.supply, cylinder)
        check_pump_pressures(self.pumps)
        check_summed_pumps(self.pumps)
        nodes, chambers = self.node_names, self._chamber_nodes
        channels = [name.replace(".", "_") for name in nodes]  # as pressures are recorded
        for field_name, own in self._named_nodes.items():
            for name in own:
                if channels.count(name) > 1:
                    raise CircuitPathError(
                        (field_name, name), f"two nodes are called '{name}', give them names"
                    )
        for joint, valve in self.valves.items():
            path, label = ("valves", joint), f"valve of '{joint}'"
            if valve.supply not in self.pumps:
                raise CircuitPathError(
                    (*path, "supply"),
                    f"{label} is fed by '{valve.supply}', "
                    f"{suggest_names(self.pumps, valve.supply)}",
                )
            if valve.spool_b and f"{joint}_b" in self.valves:
                raise CircuitPathError(
                    (*path, "spool_b"),
                    f"the second spool of '{joint}' is called as the joint '{joint}_b', give that "
                    "another name",
                )
            for key in ("return_a", "return_b"):
                return_node = getattr(valve, key)
                _check_node(
                    [x for x in nodes if x not in chambers], label, return_node, (*path, key)
                )
        for name, element in self.elements.items():
            path, label = ("elements", name), f"element '{name}'"
            _check_node(nodes, label, element.source, (*path, "from"))
            _check_node(nodes, label, element.target, (*path, "to"))
            for joint in element.joints:
                if joint not in self.valves:
                    raise CircuitPathError(
                        (*path, "joints"),
                        f"{label} is opened by '{joint}', {suggest_names(self.valves, joint)}",
                    )

    @property
    def pumps(self) -> dict[str, Supply]:
        """All pumps by their nodes' names."""
        return {MAIN_PUMP: self.supply, **self.supplies}

    @property
    def node_names(self) -> list[str]:
        """Names of all nodes: tank, pumps, lines, accumulators, chambers JOINT.a and JOINT.b."""
        own = [*self.pumps, *self.lines, *self.accumulators]
        return [TANK_NODE, *own, *self._chamber_nodes]

    @property
    def _chamber_nodes(self) -> list[str]:
        return [f"{joint}.{side}" for joint in self.cylinders for side in "ab"]

    @property
    def _named_nodes(self) -> dict[str, Iterable[str]]:
        """Nodes that are named freely, by the field that they are in."""
        return {name: getattr(self, name) for name in ("supplies", "lines", "accumulators")}

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints that it drives."""
        return tuple(self.cylinders)

    @property
    def spools(self) -> dict[str, Valve | Spool]:
        """What moves each spool, by the name of its signal: JOINT, and JOINT_b of a second one."""
        return {name: x for valve in self.valves.values() for name, x in valve.spools.items()}

    @property
    def circuit_friction_joints(self) -> tuple[str, ...]:
        """The joints whose Coulomb friction it adds to."""
        return tuple(joint for joint, cylinder in self.cylinders.items() if cylinder.adds_friction)

    def select_joints(self, joints: Iterable[str]) -> "Hydraulics | None":
        """The circuit of some joints, in their order; None if it drives none of them.

        Elements at chambers that are gone go, too, and lines that nothing leads to any more.
        """
        kept = [joint for joint in joints if joint in self.cylinders]
        if not kept:
            return None
        removed_nodes = {
            f"{joint}.{side}" for joint in self.cylinders if joint not in kept for side in "ab"
        }
        valves = {joint: self.valves[joint] for joint in kept}
        elements = {
            name: replace(x, joints=tuple(joint for joint in x.joints if joint in kept))
            for name, x in self.elements.items()
            if not removed_nodes & {x.source, x.target}
            and (not x.joints or any(joint in kept for joint in x.joints))
        }
        connected_nodes = _connected_nodes(elements.values(), valves.values())
        return replace(
            self,
            cylinders={joint: self.cylinders[joint] for joint in kept},
            valves=valves,
            control={joint: self.control[joint] for joint in kept if self.control},
            elements=elements,
            lines={name: x for name, x in self.lines.items() if name in connected_nodes},
            accumulators={
                name: x for name, x in self.accumulators.items() if name in connected_nodes
            },
        )


def _check_node(nodes: list[str], label: str, name: str, path: tuple[str, ...]) -> None:
    if name not in nodes:
        raise CircuitPathError(path, f"{label} leads to '{name}', {suggest_names(nodes, name)}")


def _connected_nodes(elements: Iterable[CircuitElement], valves: Iterable[Valve]) -> set[str]:
    """Nodes that elements and returns of valves lead to."""
    connected = {x for item in elements for x in (item.source, item.target)}
    return connected | {x for valve in valves for x in (valve.return_a, valve.return_b)}


def check_tank_pressure(supply: Supply, oil: Oil) -> None:
    """Raise where the oil boils in the tank.

    Raises:
        PartError: Of the tank's pressure.
    """
    if supply.tank <= oil.vapour_pressure:
        hint = ": pressures count from a vacuum, write 1e5 for an open tank"
        raise ComponentParameterError(
            "tank",
            f"pressure of the tank is {supply.tank:g} Pa, the oil boils at "
            f"{oil.vapour_pressure:g} Pa{suggested_units_text('tank', supply.tank) or hint}",
        )


def check_relief_pressure(supply: Supply, cylinder: Cylinder) -> None:
    """Raise where a relief valve would never close.

    Raises:
        PartError: Of the relief pressure.
    """
    if 0 < cylinder.relief <= supply.tank:
        raise ComponentParameterError(
            "relief",
            f"relief of the cylinder of '{cylinder.joint}' is {cylinder.relief:g} Pa, not above "
            f"the tank's {supply.tank:g} Pa, so that it would never close"
            f"{suggested_units_text('relief', cylinder.relief) or ', give a higher one'}",
        )
