"""Cylinders, directional valves, spools and counterbalance valves of a circuit."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from crane.codegen import Scalar
from crane.common.errors import InputError
from crane.hydraulics.circuit_elements import (
    MAIN_PUMP,
    TANK_NODE,
    check_conditions,
    check_parameters,
    positive_field,
    signed_field,
)
from crane.hydraulics.flow_equations import clip

# keys of the load-holding valves of a cylinder
COUNTERBALANCE_KEYS = ("counterbalance_a", "counterbalance_b")


@dataclass(frozen=True)
class OpeningCurve:
    """Share of a flow coefficient over the spool stroke: linear between points.

    Before the first and behind the last point the curve is constant. The stroke is that in the
    direction in which the edge opens; an edge with points below 0 is open around the middle.

    Attributes:
        points: Pairs of strokes, increasing from -1 or more to 1, and shares, at least 0.
    """

    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if len(self.points) < 2:
            raise InputError("a curve has two points at least, give pairs [u, value]")
        strokes = [u for u, _ in self.points]
        if strokes[0] < -1 or strokes[-1] > 1:
            raise InputError(
                f"a curve goes over the share of the spool's stroke, up to 1, this one from "
                f"{strokes[0]:g} to {strokes[-1]:g}"
            )
        if any(after <= before for before, after in itertools.pairwise(strokes)):
            raise InputError("strokes of a curve do not increase, sort its points")
        if not all(0 <= share < float("inf") for _, share in self.points):
            raise InputError("values of a curve are negative or no finite numbers, correct them")
        if not any(share for _, share in self.points):
            raise InputError("all values of a curve are 0, leave it out")

    @property
    def is_underlapped(self) -> bool:
        """Whether the edge is open around the middle."""
        return self.points[0][0] < 0

    def evaluate(self, u: Scalar) -> Scalar:
        """Share at the stroke u, a float or a formula."""
        share: Scalar = self.points[0][1]
        for (u0, share0), (u1, share1) in itertools.pairwise(self.points):
            share = share + ((share1 - share0) / (u1 - u0)) * (clip(u, u0, u1) - u0)
        return share


@dataclass(frozen=True)
class CounterbalanceValve:
    """A load-holding valve at one chamber: inflow is free, outflow needs a pilot pressure.

    Opening = (p + pilot_ratio p_other - pressure) / range, from 0 to 1.

    Attributes:
        pressure: Pressure of the chamber at which the valve begins to open [Pa].
        pilot_ratio: Weight of the pressure in the other chamber.
        range: Pressure difference from closed to fully open [Pa].
        coefficient: Flow coefficient of the open valve [m3/(s Pa^0.5)].
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

    Chamber A drives the joint in its positive direction. With x the coordinate of the joint above
    its lower limit and s the distance between the limits, V_A = hose_a + area_a x and
    V_B = hose_b + area_b (s - x), as in equation (23) of the electro-hydraulic forwarder paper.

    Attributes:
        joint: The active joint.
        area_a: Area of chamber A [m2], or volume per angle [m3/rad]; the sum of all parallel
            cylinders.
        area_b: The same of chamber B.
        hose_a: Volume of hoses and fittings at chamber A, V_hA [m3].
        hose_b: Volume of hoses and fittings at chamber B, V_hB [m3].
        gas_a: Volume at 1e5 Pa of the gas entrapped in chamber A [m3].
        gas_b: The same of chamber B.
        leakage: Leakage past the piston, flow per pressure [m3/(s Pa)].
        leakage_a: Leakage from chamber A to the tank, through the closed spool [m3/(s Pa)].
        leakage_b: The same from chamber B.
        relief: Pressure at which a chamber is relieved to the tank [Pa]; 0 for no relief valves.
        relief_gain: Flow of the relief valves per pressure above `relief` [m3/(s Pa)].
        refill: Coefficient of check valves from the tank into the chambers [m3/(s Pa^0.5)]; 0 for
            none.
        cushion: Distance from either end within which the outflow is throttled [m] or [rad]; 0
            for no cushioning.
        cushion_coefficient: Coefficient of the throttle at the end [m3/(s Pa^0.5)].
        stiffness: Stiffness of a spring in series with the cylinder, for boom and mountings [N/m]
            or [N m/rad]; 0 for none.
        damping: Damping parallel to that spring [N s/m] or [N m s/rad].
        seal_friction: Coulomb friction of the joint per pressure in the chambers [N/Pa] or
            [N m/Pa], see `ValveCylinderEquations.circuit_friction`.
        brake: Holding force of a spring-applied brake while the spool is within its dead band [N]
            or [N m]; 0 for none.
        brake_release: Spool travel beyond the dead band over which the brake releases.
        counterbalance_a: Load-holding valve at chamber A.
        counterbalance_b: Load-holding valve at chamber B.
        cross_relief: Pressure difference at which a chamber is relieved into the other one by
            `relief_gain` [Pa]; 0 for no such valves.
        rupture_a: Largest flow out of chamber A, set by its hose rupture valve [m3/s]; 0 for none.
        rupture_b: The same of chamber B.
        motor: Whether it is a motor: its volumes do not depend on the angle, and the joint needs
            no limits.
        tube: Outer diameter of the tube [m], used for buckling; 0 if unknown.
        count: Number of parallel cylinders.
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
    relief_gain: float = positive_field(1.0e-9)
    refill: float = 0.0
    cushion: float = 0.0
    cushion_coefficient: float = positive_field(1.0e-7)
    stiffness: float = 0.0
    damping: float = positive_field(1.0e5)
    seal_friction: float = 0.0
    brake: float = 0.0
    brake_release: float = positive_field(0.05)
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
        check_conditions(
            (
                not isinstance(self.count, int) or self.count < 1,
                "count",
                f"count of {label} is {self.count}, give a whole number",
            )
        )
        check_conditions(
            (
                0 < self.tube <= self.bore,
                "tube",
                f"tube of {label} is {self.tube:g} m, it must be more than the bore of "
                f"{self.bore:.4g} m",
            )
        )

    @property
    def bore(self) -> float:
        """Diameter of the piston of one cylinder, along a prismatic joint [m]."""
        return math.sqrt(4 / math.pi * max(self.area_a, self.area_b) / self.count)

    @property
    def rod(self) -> float:
        """Diameter of the rod of one cylinder [m]; 0 for equal areas."""
        return math.sqrt(4 / math.pi * abs(self.area_a - self.area_b) / self.count)

    @property
    def adds_friction(self) -> bool:
        """Whether seals or brake add to the Coulomb friction of the joint."""
        return self.seal_friction > 0 or self.brake > 0


@dataclass(frozen=True)
class Spool:
    """A spool of a valve: the second one, which controls chamber B, or the `Valve` itself.

    Attributes:
        joint: Joint of the cylinder.
        neutral: Signal of the middle position [V].
        full: Signal of u = 1 [V], at which a second spool drains chamber B.
        dead_band: Share of the spool stroke without flow; negative: an underlap, the share over
            which inlet and outlet of a chamber are both open, on either side of the middle.
        bandwidth: Natural frequency of the spool [rad/s]; 0 for a spool without inertia.
        damping: Damping ratio of the spool.
        rate: Largest speed of the spool, in strokes per second; 0 for no limit.
        hysteresis: Width of the play between signal and spool, as a share of the stroke.
        delay: Dead time of the electric stage [s].
    """

    joint: str
    neutral: float = signed_field(0.0)
    full: float = signed_field(1.0)
    dead_band: float = signed_field(0.0)
    bandwidth: float = 0.0
    damping: float = positive_field(1.0)
    rate: float = 0.0
    hysteresis: float = 0.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        self._check(f"the second spool of '{self.joint}'")

    def _check(self, label: str) -> None:
        check_parameters(self, label)
        dead_band = self.dead_band
        is_percent = 1 <= abs(dead_band) < 100
        hint = f": looks like percent, write {dead_band / 100:g}" if is_percent else ""
        check_conditions(
            (
                self.hysteresis >= 0.5,
                "hysteresis",
                f"hysteresis of {label} is {self.hysteresis:g}, give a share of the stroke, "
                "below 0.5",
            ),
            (
                self.full == self.neutral,
                "full",
                f"full and neutral of {label} are both {self.full:g}, give two",
            ),
            (
                abs(dead_band) >= 1,
                "dead_band",
                f"dead_band of {label} is {dead_band:g}, it must be "
                f"{'below 1' if dead_band > 0 else 'above -1'}{hint}",
            ),
            (
                self.rate > 0 and not self.bandwidth,
                "rate",
                f"{label} has a rate but no bandwidth, give both",
            ),
        )

    @property
    def overlap(self) -> float:
        """The dead band that a signal has to pass; 0 of a spool with underlap."""
        return max(self.dead_band, 0.0)


@dataclass(frozen=True, kw_only=True)
class Valve(Spool):
    """A proportional directional valve of one cylinder.

    The signal U [V] sets the target u = (U - neutral) / (full - neutral), from -1 to 1, that the
    spool position follows. Outside of the dead band d the opening is
    y = sign(u) (|u| - d) / (1 - d). Each edge has its own opening, (u - d) / (1 - d) of c1 and c2,
    (-u - d) / (1 - d) of c3 and c4, within 0 and 1: with an underlap, d < 0, all four are open by
    -d / (1 - d) in the middle, and oil flows from the supply to the tank. With a dead time the
    spool follows the signal of the time t - delay, and before that the first signal. The flows
    through the edges are equations (21) and (22) of the electro-hydraulic forwarder paper,

        y > 0:  Q_A = c1 y sqrt(p_S - p_A),  Q_B = -c2 y sqrt(p_B - p_R),
        y < 0:  Q_A = c3 y sqrt(p_A - p_R),  Q_B = -c4 y sqrt(p_S - p_B).

    With a second spool, the first one controls chamber A, Q_A(y), and the second one chamber B,
    Q_B(y_b), by separate signals: the outflow is then metered independently of the inflow, and
    both chambers can be connected to the pump (regeneration) or to the tank (floating).

    With a margin, the inlets c1, c4 are pressure compensated: the pressure drop is at most the
    margin, so the flow is c1 y sqrt(margin) as long as the pressure of the supply suffices, and no
    oil flows back into the supply. With `sharing`, the compensator is behind the inlet and raises
    the pressure there to the highest load of the valves of this supply, p_LS: the flow is
    c1 y sqrt(p_S - p_LS), which decreases by the same share in all such valves where the pump is
    at its limit.

    Edges may have curves: c1 is then the coefficient at full opening, and c1 curve(|u|) replaces
    c1 y. The open centre passes the flow of the pump while the spool is neutral; the open centres
    of a supply are in series. Beyond `float_from` of the negative stroke both chambers are
    connected to the tank and the inlet closes. Regeneration leads the outflow of B into A for
    y > 0.

    Attributes:
        joint: Joint of the cylinder; this and the parameters of the spool are those of `Spool`.
        c1: Coefficient of the edge from the supply to A [m3/(s Pa^0.5)].
        c2: From B to the tank.
        c3: From A to the tank.
        c4: From the supply to B.
        margin: Pressure drop that the compensator keeps [Pa]; 0 without compensation.
        centre: Coefficient of the open centre in neutral [m3/(s Pa^0.5)]; 0 for a closed centre.
        regeneration: Coefficient of the check valve from B to A [m3/(s Pa^0.5)]; 0 for none.
        float_from: |u| beyond which the negative position floats; 0 for none.
        float_coefficient: Coefficient from each chamber to the tank while floating
            [m3/(s Pa^0.5)].
        demand: Share of the flow of the pump that the fully open valve requests of a positive
            control.
        sharing: Whether the compensator is behind the inlet.
        priority: Whether the valve is served first: the other valves of the pump receive the share
            1 - (load + margin - p_S) / (0.2 margin) of their flows, within 0 and 1, as behind a
            priority valve.
        supply: Name of the pump that feeds the valve.
        return_a: Node to which chamber A is drained.
        return_b: Node to which chamber B is drained.
        curves: Share of the coefficient over |u|, by "c1" to "c4" and "centre".
        spool_b: Second spool, of chamber B; None for a valve with one spool.
    """

    c1: float = positive_field()
    c2: float = positive_field()
    c3: float = positive_field()
    c4: float = positive_field()
    margin: float = 0.0
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
        self._check(label)
        check_conditions(
            (
                self.priority and not self.margin,
                "priority",
                f"{label} has priority and no margin to keep, give it one",
            ),
            (
                self.sharing and self.margin > 0,
                "margin",
                f"{label} shares its flow, leave 'margin' to the pump",
            ),
            (
                (self.float_from > 0) != (self.float_coefficient > 0) or self.float_from >= 1,
                "float_from",
                f"{label} floats from {self.float_from:g} with the coefficient "
                f"{self.float_coefficient:g}, give both, from below 1",
            ),
            *(
                (
                    self.spool_b is not None and getattr(self, key) > 0,
                    key,
                    f"{label} has two spools and '{key}', which goes with one, remove it",
                )
                for key in ("centre", "regeneration", "float_from")
            ),
        )

    @property
    def is_underlapped(self) -> bool:
        """Whether edges are open around the middle."""
        curves = any(curve.is_underlapped for curve in self.curves.values())
        return curves or any(spool.dead_band < 0 for spool in self.spools.values())

    @property
    def spools(self) -> dict[str, Spool]:
        """Its spools by the names of their signals."""
        return {self.joint: self} | ({f"{self.joint}_b": self.spool_b} if self.spool_b else {})

    def opening(self, u: float) -> float:
        """Opening y at a spool position u, of the edges that it opens."""
        return math.copysign(
            min(max((abs(u) - self.dead_band) / (1.0 - self.dead_band), 0.0), 1.0), u
        )
