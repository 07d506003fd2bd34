"""Equations of one valve with its cylinder: flows, pressures, force, equations (20) to (23)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from crane.codegen.symbolic import Scalar, apply_function, maximum, minimum, where_positive
from crane.hydraulics.circuit_elements import TANK_NODE
from crane.hydraulics.components import Cylinder, Spool, Valve
from crane.hydraulics.flow_equations import (
    LAMINAR_PRESSURE_DROP,
    SENSING_OPENING_GAIN,
    Flow,
    clip,
    directional_flow,
    forward_drop,
    largest_of,
    series_coefficient,
    signed_square_root,
    volume_compliance,
)

INTERNAL_FLOWS = ("piston", "cross")  # paths of flows that pass no hose
_PLAY_RATE = 500.0  # rate at which the signal moves the play of a spool [1/s]
_PRIORITY_MARGIN_SHARE = 0.2  # share of the margin over which a priority valve stops the others
_MIN_VOLUME_SHARE = 0.1  # least volume of a chamber, as a share of the volume of its hose
CYLINDER_CONSTANTS = (
    "area_a", "area_b", "hose_a", "hose_b", "gas_a", "gas_b", "leakage", "leakage_a", "leakage_b",
    "relief", "relief_gain", "refill", "cushion", "cushion_resistance", "stiffness", "damping",
    "stroke", "c1", "c2", "c3", "c4", "margin", "neutral", "per_signal", "dead_band", "per_stroke",
    "bandwidth", "spool_damping", "rate", "cross_relief", "rupture_a", "rupture_b", "centre",
    "regeneration", "float_from", "per_float", "float_coefficient", "demand", "hysteresis",
    "seal_friction", "brake", "per_release",
)  # fmt: skip


@dataclass
class ChamberValues:
    """A chamber of a cylinder at an instant.

    Attributes:
        pressure: Pressure [Pa].
        volume: Volume [m3].
        hose_flow: Flow through its hose into the chamber [m3/s].
        net_inflow: Inflow less the rate of the volume [m3/s].
        chamber_pressure_rates: Rate of the state of the pressure [Pa/s].
    """

    pressure: Scalar
    volume: Scalar
    hose_flow: Scalar
    net_inflow: Scalar
    chamber_pressure_rates: Scalar


class ValveCylinderEquations:
    """One valve with its cylinder or motor at an instant.

    Chambers are indexed by their side: 0 for A, 1 for B.

    Args:
        oil_constants: Constants of the oil.
        constants: See `cylinder_constants`, floats or formulas.
        cylinder: Description of the cylinder.
        valve: Description of the valve.
        spool_positions: Position u; with two spools, those of the spools of A and B.
        second_spool: Constants of the second spool, see `spool_constants`.
        x: Coordinate above the lower limit [m], [rad].
        v: Velocity [m/s], [rad/s].
        states: States of the pressures in A and B, then the compression of the series spring.

    Attributes:
        joint: Joint of the cylinder.
        valve: Its valve.
        pressures: Pressures in A and B [Pa].
        requested_openings: Openings y of the inlets to A and B that the spools request; of a
            single spool, for positive and negative positions. An underlapped spool in its neutral
            position requests none.
        force: Force of the cylinder, equation (20) [N], [N m].
        spring_rate: Rate of the compression of the series spring; empty without one.
        spring_power: Power stored in the series spring [W].
        spring_flow: Rate of both volumes by the compression of the spring [m3/s].
        damper_power: Power dissipated by the damper of the spring [W].
    """

    def __init__(
        self,
        oil_constants: dict[str, Scalar],
        constants: Mapping[str, Any],
        cylinder: Cylinder,
        valve: Valve,
        spool_positions: Sequence[Scalar],
        second_spool: Mapping[str, Scalar],
        x: Scalar,
        v: Scalar,
        states: Sequence[Scalar],
    ):
        self.joint, self.valve, self._cylinder = cylinder.joint, valve, cylinder
        self._oil_constants, self._states = oil_constants, states
        self._spool_positions = spool_positions
        named = self._constants = constants
        self.pressures = [
            oil_constants["vapour"] + maximum(states[side], 0.0) for side in range(2)
        ]
        self._areas = [named["area_a"], named["area_b"]]
        self.force = self._areas[0] * self.pressures[0] - self._areas[1] * self.pressures[1]
        self.spring_rate: list[Scalar] = []
        self.spring_power: Scalar = 0.0
        self.spring_flow: Scalar = 0.0
        self.damper_power: Scalar = 0.0
        if cylinder.stiffness > 0:
            # without a mass in between, spring and damper carry the force of the cylinder
            spring_force = named["stiffness"] * states[2]
            compression_rate = (self.force - spring_force) / named["damping"]
            x, v = x + states[2], v + compression_rate
            self.spring_rate = [compression_rate]
            self.spring_power = spring_force * compression_rate
            self.spring_flow = (self._areas[0] - self._areas[1]) * compression_rate
            self.damper_power = named["damping"] * compression_rate * compression_rate
        self._clearances = [x, named["stroke"] - x]
        self._velocity = v
        self._spool_constants = [named, second_spool][: len(spool_positions)]
        openings = [
            [
                clip((position - spool["dead_band"]) * spool["per_stroke"], 0.0, 1.0)
                for position in (u, -u)
            ]
            for u, spool in zip(spool_positions, self._spool_constants, strict=True)
        ]
        self._inlet_openings = [openings[0][0], openings[-1][1]]
        self._outlet_openings = [openings[0][1], openings[-1][0]]
        self._is_underlapped = [spool.dead_band < 0 for spool in valve.spools.values()]
        self.requested_openings = [
            clip(position, 0.0, 1.0) if is_underlapped else opening
            for position, opening, is_underlapped in zip(
                (spool_positions[0], -spool_positions[-1]),
                self._inlet_openings,
                (self._is_underlapped[0], self._is_underlapped[-1]),
                strict=True,
            )
        ]

    @property
    def pressures_by_node(self) -> dict[str, Scalar]:
        """Pressures of its chambers by the names of their nodes [Pa]."""
        return {f"{self.joint}.{side}": p for side, p in zip("ab", self.pressures, strict=True)}

    @property
    def pump_demand(self) -> Scalar:
        """Share of the flow of its pump that it requests of a positive control."""
        return self._constants["demand"] * maximum(*self.requested_openings)

    @property
    def _sensing_shares(self) -> list[Scalar]:
        return [clip(y * SENSING_OPENING_GAIN, 0.0, 1.0) for y in self._inlet_openings]

    def sensed_load_pressure(self, tank: Scalar) -> Scalar:
        """Load pressure that its valve reports; the tank pressure while it is closed [Pa]."""
        return tank + maximum(
            *(
                share * (p - tank)
                for share, p in zip(self._sensing_shares, self.pressures, strict=True)
            )
        )

    def relative_shortage(self, supply: Scalar, tank: Scalar) -> Scalar:
        """Missing pressure of the pump, relative to the range of `Valve.priority`."""
        required_pressure = (
            self.sensed_load_pressure(tank)
            + largest_of(self._sensing_shares) * self._constants["margin"]
        )
        return (required_pressure - supply) / (_PRIORITY_MARGIN_SHARE * self._constants["margin"])

    def open_centre_coefficient(self) -> Scalar:
        """Flow coefficient of its open centre [m3/(s Pa^0.5)]."""
        size = maximum(self._spool_positions[0], -self._spool_positions[0])
        if (curve := self.valve.curves.get("centre")) is not None:
            return self._constants["centre"] * curve.evaluate(size)
        return self._constants["centre"] * (1.0 - maximum(*self.requested_openings))

    def flows(
        self,
        supply: Scalar,
        return_pressures: Sequence[Scalar],
        tank: Scalar,
        highest_load: Scalar,
        priority_share: Scalar,
    ) -> list[Flow]:
        """Flows through its valve and past its piston, and leakage, relief and suction flows.

        Args:
            supply: Pressure of the supply [Pa].
            return_pressures: Pressures of the nodes to which A and B are drained [Pa].
            tank: Pressure of the tank [Pa].
            highest_load: Highest load pressure of the valves of the supply [Pa].
            priority_share: Share of the inflow that priority valves leave.
        """
        float_share: Scalar = 0.0
        constants, (node_a, node_b) = self._constants, self.pressures_by_node
        difference = self.pressures[0] - self.pressures[1]
        flows = [Flow(node_a, node_b, constants["leakage"] * difference, "piston")]
        if self._cylinder.cross_relief > 0:
            for source, target, sign in ((node_a, node_b, 1.0), (node_b, node_a, -1.0)):
                excess = maximum(sign * difference - constants["cross_relief"], 0.0)
                flows.append(Flow(source, target, constants["relief_gain"] * excess, "cross"))
        if self.valve.regeneration > 0:
            orifice = series_coefficient(
                constants["regeneration"] * self.requested_openings[0],
                *self._outflow_restrictions(1),
            )
            rate = orifice * signed_square_root(forward_drop(-difference))
            flows.append(Flow(node_b, node_a, self._limit_outflow(rate, 1), "regeneration"))
        if self.valve.float_from > 0:
            excess = -self._spool_positions[0] - self._constants["float_from"]
            float_share = clip(excess * self._constants["per_float"], 0.0, 1.0)
        for side, node in enumerate(self.pressures_by_node):
            p = self.pressures[side]
            sign = 1.0 if side == 0 else -1.0
            inlet = self._edge_coefficient(
                ("c1", "c4")[side], side, sign, self._inlet_openings[side]
            )
            outlet = self._edge_coefficient(
                ("c3", "c2")[side], side, -sign, self._outlet_openings[side]
            )
            if self.valve.float_from > 0:
                outlet = outlet + self._constants["float_coefficient"] * float_share
                if side == 1:
                    inlet = inlet * (1.0 - float_share)
            inflow, drop = self._inlet_flow(supply, inlet, side, highest_load)
            if drop is None and self._has_rupture_valve(side):  # a compensator lets nothing back
                inflow = -self._limit_outflow(-inflow, side)
            flows.append(Flow(self.valve.supply, node, priority_share * inflow, "inlet", drop))
            outflow = -directional_flow(
                return_pressures[side] - p,
                outlet,
                series_coefficient(outlet, *self._outflow_restrictions(side)),
            )
            return_node = (self.valve.return_a, self.valve.return_b)[side]
            flows.append(Flow(node, return_node, self._limit_outflow(outflow, side), "outlet"))
        for side, node in enumerate(self.pressures_by_node):
            p, leakage = self.pressures[side], constants[f"leakage_{'ab'[side]}"]
            flows.append(Flow(node, TANK_NODE, leakage * (p - tank), "leak"))
            if self._cylinder.relief > 0:
                rate = constants["relief_gain"] * maximum(p - constants["relief"], 0.0)
                flows.append(Flow(node, TANK_NODE, rate, "relief"))
            if self._cylinder.refill > 0:
                rate = constants["refill"] * signed_square_root(forward_drop(tank - p))
                flows.append(Flow(TANK_NODE, node, rate, "refill"))
        return flows

    def chamber_values(self, side: int, hose_flow: Scalar, inflow: Scalar) -> ChamberValues:
        """A chamber with given flows.

        Args:
            side: Side of the chamber.
            hose_flow: Flow through its hose [m3/s].
            inflow: Total inflow [m3/s].
        """
        constants, name = self._constants, "ab"[side]
        p, area, state = self.pressures[side], self._areas[side], self._states[side]
        net = inflow - (1.0 if side == 0 else -1.0) * area * self._velocity
        hose, gas = constants[f"hose_{name}"], constants[f"gas_{name}"]
        volume, half_volume = hose, hose
        if not self._cylinder.motor:
            volume = maximum(hose + area * self._clearances[side], _MIN_VOLUME_SHARE * hose)
            half_volume = hose + 0.5 * area * constants["stroke"]
        compliance = volume_compliance(self._oil_constants, volume, hose, gas, p)
        void_compliance = self._oil_constants["oil"] * half_volume
        if self.valve.float_from > 0:
            # a floating chamber often cavitates: a jump would make the steps a million times
            # shorter
            filled_share = clip(state * (1.0 / LAMINAR_PRESSURE_DROP), 0.0, 1.0)
            compliance = void_compliance + (compliance - void_compliance) * filled_share
        else:
            compliance = where_positive(state, compliance, void_compliance)
        return ChamberValues(p, volume, hose_flow, net, net / compliance)

    def circuit_friction(self, tank: Scalar) -> Scalar:
        """Coulomb friction that seals and brake add to that of the joint [N], [N m].

        F_K = mu (max(p_A - p_R, 0) + max(p_B - p_R, 0)) + B (1 - (|u| - d) / r), with mu of the
        seals, B of the brake, d the dead band, 0 of an underlapped spool, and r the travel that
        releases the brake. The last factor is limited to 0 and 1; with two spools, that with the
        larger travel counts.

        Args:
            tank: p_R [Pa].
        """
        constants = self._constants
        friction: Scalar = 0.0
        if self._cylinder.seal_friction > 0:
            gauge_pressures = [maximum(p - tank, 0.0) for p in self.pressures]
            friction = friction + constants["seal_friction"] * (
                gauge_pressures[0] + gauge_pressures[1]
            )
        if self._cylinder.brake > 0:
            travel = largest_of([
                (apply_function("abs", u) - (0.0 if is_underlapped else spool["dead_band"]))
                * constants["per_release"]
                for u, spool, is_underlapped in zip(
                    self._spool_positions, self._spool_constants, self._is_underlapped, strict=True
                )
            ])  # fmt: skip
            friction = friction + constants["brake"] * (1.0 - clip(travel, 0.0, 1.0))
        return friction

    def _edge_coefficient(self, name: str, side: int, sign: float, opening: Scalar) -> Scalar:
        """Flow coefficient of an edge of a chamber that opens for spool positions of a sign."""
        if (curve := self.valve.curves.get(name)) is not None:
            u = self._spool_positions[-1 if side else 0]
            stroke = clip(u if sign > 0 else -u, -1.0 if curve.is_underlapped else 0.0, 1.0)
            if curve.is_underlapped:
                return self._constants[name] * curve.evaluate(stroke)
            return self._constants[name] * where_positive(stroke, curve.evaluate(stroke), 0.0)
        return self._constants[name] * opening

    def _inlet_flow(
        self, supply: Scalar, inlet: Scalar, side: int, highest_load: Scalar
    ) -> tuple[Scalar, Scalar | None]:
        """Flow from the supply, and the drop at the metering edge of a compensated valve."""
        p, margin = self.pressures[side], self._constants["margin"]
        if self.valve.sharing:
            drop = maximum(supply - maximum(highest_load, p), 0.0)
        elif self.valve.margin > 0:
            drop = clip(supply - p, 0.0, margin)
        else:
            return directional_flow(
                supply - p, inlet, series_coefficient(inlet, *self._outflow_restrictions(side))
            ), None
        return inlet * signed_square_root(drop), drop

    def _has_rupture_valve(self, side: int) -> bool:
        return (self._cylinder.rupture_a, self._cylinder.rupture_b)[side] > 0

    def _limit_outflow(self, rate: Scalar, side: int) -> Scalar:
        """Flow out of a chamber, limited by its hose rupture valve."""
        limit = self._constants["rupture_a" if side == 0 else "rupture_b"]
        return minimum(rate, limit) if self._has_rupture_valve(side) else rate

    def _outflow_restrictions(self, side: int) -> tuple[Scalar | None, Scalar]:
        """Coefficient of the load-holding valve, and 1 / c^2 of the cushion."""
        holding, p, other = None, self.pressures[side], self.pressures[1 - side]
        valve = self._constants["counterbalance"][side]
        if (self._cylinder.counterbalance_a, self._cylinder.counterbalance_b)[side] is not None:
            opening_pressure = p + valve["pilot_ratio"] * other - valve["pressure"]
            holding = valve["coefficient"] * clip(opening_pressure * valve["per_range"], 0.0, 1.0)
        cushion: Scalar = 0.0
        if self._cylinder.cushion > 0:
            share = clip(1.0 - self._clearances[side] / self._constants["cushion"], 0.0, 1.0)
            cushion = self._constants["cushion_resistance"] * share * share
        return holding, cushion


def spool_equations(
    name: str,
    spool: Spool,
    constants: Mapping[str, Scalar],
    states: Mapping[str, Scalar],
    signal: Scalar,
) -> tuple[Scalar, list[Scalar]]:
    """Position u of a spool, and the rates of its states: u'' = w^2 (target - u) - 2 d w u'.

    With a play of the width h the target follows the signal by z' = rate (|signal - z| - h / 2)
    outside of the play.

    Args:
        name: Name of its signal.
        spool: Its description.
        constants: Its constants, among them `spool_constants`.
        states: States of the circuit by name.
        signal: Signal at the spool [V].
    """
    rates: list[Scalar] = []
    target = clip((signal - constants["neutral"]) * constants["per_signal"], -1.0, 1.0)
    if spool.hysteresis > 0:
        play_state = states[f"play_{name}"]
        gap, half = target - play_state, 0.5 * constants["hysteresis"]
        rates.append(_PLAY_RATE * (gap - clip(gap, -1.0 * half, half)))
        target = play_state
    if not spool.bandwidth > 0:
        return target, rates
    u, speed = states[f"spool_{name}"], states[f"spool_rate_{name}"]
    w, limited_speed = constants["bandwidth"], speed
    if spool.rate > 0:
        limited_speed = clip(speed, -1.0 * constants["rate"], constants["rate"])
    return u, [
        *rates,
        limited_speed,
        w * (w * (target - u) - 2.0 * constants["spool_damping"] * speed),
    ]


def cylinder_constants(cylinder: Cylinder, valve: Valve, stroke: float) -> dict[str, Any]:
    """`CYLINDER_CONSTANTS` of a cylinder with its valve, and those of counterbalance valves."""
    values = {
        **vars(valve),
        **vars(cylinder),
        "cushion_resistance": cylinder.cushion_coefficient**-2,
        "stroke": stroke,
        **spool_constants(valve),
        "per_float": 1.0 / (1.0 - valve.float_from),
        "per_release": 1.0 / cylinder.brake_release,
    }
    valves = cylinder.counterbalance_a, cylinder.counterbalance_b
    counterbalance = [
        {
            "pressure": x.pressure if x else 0.0,
            "pilot_ratio": x.pilot_ratio if x else 0.0,
            "per_range": 1.0 / x.range if x else 0.0,
            "coefficient": x.coefficient if x else 0.0,
        }
        for x in valves
    ]
    named = {name: float(values[name]) for name in CYLINDER_CONSTANTS}
    return named | {"counterbalance": counterbalance}


def spool_constants(spool: Spool) -> dict[str, Scalar]:
    """Constants of a spool."""
    return {
        "neutral": spool.neutral,
        "per_signal": 1.0 / (spool.full - spool.neutral),
        "dead_band": spool.dead_band,
        "per_stroke": 1.0 / (1.0 - spool.dead_band),
        "bandwidth": spool.bandwidth,
        "spool_damping": spool.damping,
        "rate": spool.rate,
        "hysteresis": spool.hysteresis,
    }
