"""One valve and its cylinder: flows, pressures, force, equations (20) to (23)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from crane.codegen import Scalar, maximum
from crane.codegen.symbolic import apply_function, minimum, where_positive
from crane.hydraulics.components import CounterbalanceValve, Cylinder, Spool, Valve
from crane.hydraulics.node_equations import SENSING_OPENING_GAIN, largest_of, volume_compliance
from crane.hydraulics.orifice_flow import (
    LAMINAR_PRESSURE_DROP,
    Flow,
    clip,
    directional_flow,
    series_coefficient,
    signed_square_root,
)
from crane.hydraulics.supply_and_engine import TANK_NODE

INTERNAL_FLOWS = ("piston", "cross")  # flows that pass no hose
_PLAY_RATE = 500.0  # [1/s], at which a signal takes its play along
_PRIORITY_MARGIN_SHARE = 0.2  # of its margin, within which a valve of priority stops the others
_MIN_VOLUME_SHARE = 0.1  # of the hose's volume, the least that a chamber holds
CYLINDER_CONSTANTS = (
    "area_a", "area_b", "hose_a", "hose_b", "gas_a", "gas_b", "leakage", "leakage_a", "leakage_b",
    "relief", "relief_gain", "refill", "cushion", "cushion_resistance", "stiffness", "damping",
    "stroke", "c1", "c2", "c3", "c4", "margin", "neutral", "per_signal", "dead_band", "per_stroke",
    "bandwidth", "spool_damping", "rate", "cross_relief", "rupture_a", "rupture_b", "centre",
    "regeneration", "float_from", "per_float", "float_coefficient", "demand", "hysteresis",
    "seal_friction", "brake", "per_release",
)  # fmt: skip
SPOOL_CONSTANTS = (
    "neutral", "per_signal", "dead_band", "per_stroke", "bandwidth", "spool_damping", "rate",
    "hysteresis",
)  # fmt: skip
_COUNTERBALANCE_CONSTANTS = ("pressure", "pilot_ratio", "per_range", "coefficient")
CYLINDER_CONSTANT_COUNT = len(CYLINDER_CONSTANTS) + 2 * len(_COUNTERBALANCE_CONSTANTS)


@dataclass
class ChamberValues:
    """One side of a cylinder at an instant.

    Attributes:
        pressure: [Pa].
        volume: [m3].
        area: [m2], [m3/rad].
        hose_flow: Flow through its hose into it [m3/s].
        net_inflow: Flow into it less what its volume grows by [m3/s].
        pressure_state_rate: Rate of the state that stands for its pressure [Pa/s].
    """

    pressure: Scalar
    volume: Scalar
    area: Scalar
    hose_flow: Scalar
    net_inflow: Scalar
    pressure_state_rate: Scalar


class ValveCylinderEquations:
    """One valve and its cylinder or motor at an instant.

    Args:
        oil_constants: Numbers of the oil.
        constants: `cylinder_constants` the parts, as floats or traced.
        cylinder: What it is.
        valve: Likewise.
        spool_positions: Position u; those of the spools of A and of B where there are two.
        second_spool: Numbers of the second spool, `SPOOL_CONSTANTS`.
        x: Coordinate above the lower limit [m], [rad].
        v: Its rate [m/s], [rad/s].
        states: States: those of the pressures in A and B, then the series spring's compression.

    Attributes:
        joint: Whose cylinder it is.
        valve: Its valve.
        pressures: Of A and B [Pa].
        inlet_openings: Openings y of the inlets to A and to B: of one spool on its positive and
            its negative side.
        force: Of the cylinder, equation (20) [N], [N m].
        spring_rate: Rate of the series spring's compression, if there is one.
        spring_power: What goes into it [W].
        spring_flow: What both chambers grow by as it gives way [m3/s].
        damper_power: What its damper turns into heat [W].
    """

    def __init__(
        self,
        oil_constants: dict[str, Scalar],
        constants: Sequence[Scalar],
        cylinder: Cylinder,
        valve: Valve,
        spool_positions: Sequence[Scalar],
        second_spool: Mapping[str, Scalar],
        x: Scalar,
        v: Scalar,
        states: Sequence[Scalar],
    ):
        self._oil_constants, width = oil_constants, len(_COUNTERBALANCE_CONSTANTS)
        self._cylinder, self.valve, self._states, self._spool_positions = (
            cylinder,
            valve,
            states,
            spool_positions,
        )
        self.joint = cylinder.joint
        named_constants = self._constants = dict(
            zip(CYLINDER_CONSTANTS, constants[: len(CYLINDER_CONSTANTS)], strict=True)
        )
        ends = [len(CYLINDER_CONSTANTS) + side * width for side in range(3)]
        self._counterbalance_constants = [
            dict(zip(_COUNTERBALANCE_CONSTANTS, constants[start:end], strict=True))
            for start, end in zip(ends, ends[1:], strict=False)
        ]
        vapour = oil_constants["vapour"]
        pressures = self.pressures = [vapour + maximum(states[side], 0.0) for side in range(2)]
        areas = self._areas = [named_constants["area_a"], named_constants["area_b"]]
        self.force = areas[0] * pressures[0] - areas[1] * pressures[1]
        self.spring_rate: list[Scalar] = []
        self.spring_power: Scalar = 0.0
        self.spring_flow: Scalar = 0.0
        self.damper_power: Scalar = 0.0
        if cylinder.stiffness > 0:
            # massless: the spring and its damper carry the cylinder's force
            spring_force = named_constants["stiffness"] * states[2]
            compression_rate = (self.force - spring_force) / named_constants["damping"]
            x, v = x + states[2], v + compression_rate
            self.spring_rate = [compression_rate]
            self.spring_power = spring_force * compression_rate
            self.spring_flow = (areas[0] - areas[1]) * compression_rate
            self.damper_power = named_constants["damping"] * compression_rate * compression_rate
        self._clearances = [x, named_constants["stroke"] - x]
        self._velocity = v
        self._spool_constants = [named_constants, second_spool][: len(spool_positions)]
        sides = [
            [
                clip((side - law["dead_band"]) * law["per_stroke"], 0.0, 1.0)
                for side in (spool, -spool)
            ]
            for spool, law in zip(spool_positions, self._spool_constants, strict=True)
        ]
        self.inlet_openings = [sides[0][0], sides[-1][1]]
        self._outlet_openings = [sides[0][1], sides[-1][0]]

    @property
    def pressures_by_node(self) -> dict[str, Scalar]:
        """Pressures of its chambers by their nodes' names."""
        return {f"{self.joint}.{side}": p for side, p in zip("ab", self.pressures, strict=True)}

    @property
    def pump_demand(self) -> Scalar:
        """Share of its pump's flow that a positive control gives for it."""
        return self._constants["demand"] * maximum(*self.inlet_openings)

    def sensed_load_pressure(self, tank: Scalar) -> Scalar:
        """Pressure that its valve reports as its load, the tank's while it is closed [Pa]."""
        shares = [clip(y * SENSING_OPENING_GAIN, 0.0, 1.0) for y in self.inlet_openings]
        loads = [share * (p - tank) for share, p in zip(shares, self.pressures, strict=True)]
        return tank + maximum(*loads)

    def relative_shortage(self, supply: Scalar, tank: Scalar) -> Scalar:
        """What a pump's pressure is short of for its flow, over what `Valve.priority` allows."""
        share = largest_of([clip(y * SENSING_OPENING_GAIN, 0.0, 1.0) for y in self.inlet_openings])
        required_pressure = self.sensed_load_pressure(tank) + share * self._constants["margin"]
        return (required_pressure - supply) / (_PRIORITY_MARGIN_SHARE * self._constants["margin"])

    def open_centre_coefficient(self) -> Scalar:
        """Coefficient of its open centre."""
        size = maximum(self._spool_positions[0], -self._spool_positions[0])
        if (curve := self.valve.curves.get("centre")) is not None:
            return self._constants["centre"] * curve.evaluate(size)
        return self._constants["centre"] * (1.0 - maximum(*self.inlet_openings))

    def flows(
        self,
        supply: Scalar,
        return_pressures: Sequence[Scalar],
        highest_load: Scalar,
        priority_share: Scalar,
    ) -> list[Flow]:
        """All through its valve and past its piston.

        Args:
            supply: Pressure of what feeds it [Pa].
            return_pressures: Those of what A and B are drained to [Pa].
            highest_load: Highest load of the valves beside it, where it shares its flow [Pa].
            priority_share: Share of its inlet that valves of priority leave.
        """
        part, valve = self._constants, self.valve
        nodes = list(self.pressures_by_node)
        node_a, node_b = nodes
        pressure_a, pressure_b = self.pressures
        pressure_difference = pressure_a - pressure_b
        all_flows = [Flow(node_a, node_b, part["leakage"] * pressure_difference, "piston")]
        if self._cylinder.cross_relief > 0:
            for source, target, sign in ((node_a, node_b, 1.0), (node_b, node_a, -1.0)):
                over = maximum(sign * pressure_difference - part["cross_relief"], 0.0)
                all_flows.append(Flow(source, target, part["relief_gain"] * over, "cross"))
        if valve.regeneration > 0:
            orifice = series_coefficient(
                part["regeneration"] * self.inlet_openings[0], *self._outflow_restrictions(1)
            )
            rate = self._limit_outflow(
                orifice * signed_square_root(maximum(-pressure_difference, 0.0)), 1
            )
            all_flows.append(Flow(node_b, node_a, rate, "regeneration"))
        float_share: Scalar = 0.0
        if valve.float_from > 0:
            float_share = clip(
                (-self._spool_positions[0] - part["float_from"]) * part["per_float"], 0.0, 1.0
            )
        for side in range(2):
            p, return_pressure, node = self.pressures[side], return_pressures[side], nodes[side]
            return_node = valve.return_a if side == 0 else valve.return_b
            direction = 1.0 if side == 0 else -1.0
            inlet = self._edge_coefficient(
                ("c1", "c4")[side], side, direction, self.inlet_openings[side]
            )
            outlet = self._edge_coefficient(
                ("c3", "c2")[side], side, -direction, self._outlet_openings[side]
            )
            if valve.float_from > 0:
                outlet = outlet + part["float_coefficient"] * float_share
                if side == 1:
                    inlet = inlet * (1.0 - float_share)
            inflow, drop = self._inlet_flow(supply, inlet, side, highest_load)
            if drop is None:  # else nothing comes back
                inflow = (
                    -self._limit_outflow(-inflow, side)
                    if self._has_rupture_valve(side)
                    else inflow
                )
            all_flows.append(Flow(valve.supply, node, priority_share * inflow, "inlet", drop))
            outflow = -directional_flow(
                return_pressure - p,
                outlet,
                series_coefficient(outlet, *self._outflow_restrictions(side)),
            )
            all_flows.append(Flow(node, return_node, self._limit_outflow(outflow, side), "outlet"))
        return all_flows

    def leak_and_relief_flows(self, tank: Scalar) -> list[Flow]:
        """Leaks, relief and suction valves of both chambers."""
        part, all_flows = self._constants, []
        for side, name in enumerate("ab"):
            p, node = self.pressures[side], f"{self.joint}.{name}"
            all_flows.append(Flow(node, TANK_NODE, part[f"leakage_{name}"] * (p - tank), "leak"))
            if self._cylinder.relief > 0:
                rate = part["relief_gain"] * maximum(p - part["relief"], 0.0)
                all_flows.append(Flow(node, TANK_NODE, rate, "relief"))
            if self._cylinder.refill > 0:
                rate = part["refill"] * signed_square_root(maximum(tank - p, 0.0))
                all_flows.append(Flow(TANK_NODE, node, rate, "refill"))
        return all_flows

    def chamber_values(self, side: int, hose_flow: Scalar, inflow: Scalar) -> ChamberValues:
        """A chamber that gets flows.

        Args:
            side: 0 of A, 1 of B.
            hose_flow: Through its hose [m3/s].
            inflow: In all [m3/s].
        """
        part, p, area = self._constants, self.pressures[side], self._areas[side]
        sign = 1.0 if side == 0 else -1.0
        net = inflow - sign * area * self._velocity
        hose = part["hose_a" if side == 0 else "hose_b"]
        gas = part["gas_a" if side == 0 else "gas_b"]
        volume, half_volume = hose, hose
        if not self._cylinder.motor:
            volume = maximum(hose + area * self._clearances[side], _MIN_VOLUME_SHARE * hose)
            half_volume = hose + 0.5 * area * part["stroke"]
        compliance = volume_compliance(self._oil_constants, volume, hose, gas, p)
        void_compliance = self._oil_constants["oil"] * half_volume
        if self.valve.float_from > 0:
            # it runs into voids all the time: over a jump steps get a million times shorter
            filled_share = clip(self._states[side] * (1.0 / LAMINAR_PRESSURE_DROP), 0.0, 1.0)
            pressure_state_rate = net / (
                void_compliance + (compliance - void_compliance) * filled_share
            )
        else:
            pressure_state_rate = net / where_positive(
                self._states[side], compliance, void_compliance
            )
        return ChamberValues(p, volume, area, hose_flow, net, pressure_state_rate)

    def _edge_coefficient(self, name: str, side: int, direction: float, opening: Scalar) -> Scalar:
        """Coefficient of a chamber's edge as far as its spool opens it, `direction` 1 or -1."""
        if (curve := self.valve.curves.get(name)) is not None:
            spool = self._spool_positions[-1 if side else 0]
            stroke = clip(spool if direction > 0 else -spool, 0.0, 1.0)
            return self._constants[name] * where_positive(stroke, curve.evaluate(stroke), 0.0)
        return self._constants[name] * opening

    def circuit_friction(self, tank: Scalar) -> Scalar:
        """Coulomb friction that seals and brake add to the joint's [N], [N m].

        F_K = mu (max(p_A - p_R, 0) + max(p_B - p_R, 0)) + B (1 - (|u| - d) / e), with mu and B of
        the seals and the brake, its last factor within 0 and 1, d the dead band and e the travel
        that releases it; of two spools the one that goes farther counts.

        Args:
            tank: p_R [Pa].
        """
        part = self._constants
        grip: Scalar = 0.0
        if self._cylinder.seal_friction > 0:
            gauge_pressures = [maximum(p - tank, 0.0) for p in self.pressures]
            grip = grip + part["seal_friction"] * (gauge_pressures[0] + gauge_pressures[1])
        if self._cylinder.brake > 0:
            travel = largest_of([
                (apply_function("abs", spool) - law["dead_band"]) * part["per_release"]
                for spool, law in zip(self._spool_positions, self._spool_constants, strict=True)
            ])  # fmt: skip
            grip = grip + part["brake"] * (1.0 - clip(travel, 0.0, 1.0))
        return grip

    def _inlet_flow(
        self, supply: Scalar, inlet: Scalar, side: int, highest_load: Scalar
    ) -> tuple[Scalar, Scalar | None]:
        """From the supply, and the drop at the edge that meters it where another one follows.

        A compensator keeps the pressure drop and lets nothing back.
        """
        p, margin = self.pressures[side], self._constants["margin"]
        if self.valve.sharing:
            drop = maximum(supply - maximum(highest_load, p), 0.0)
            return inlet * signed_square_root(drop), drop
        if self.valve.margin > 0:
            drop = clip(supply - p, 0.0, margin)
            return inlet * signed_square_root(drop), drop
        return directional_flow(
            supply - p, inlet, series_coefficient(inlet, *self._outflow_restrictions(side))
        ), None

    def _has_rupture_valve(self, side: int) -> bool:
        """Whether a chamber has a hose rupture valve."""
        return (self._cylinder.rupture_a, self._cylinder.rupture_b)[side] > 0

    def _limit_outflow(self, rate: Scalar, side: int) -> Scalar:
        """A flow out of a chamber, as far as its hose rupture valve lets it."""
        if not self._has_rupture_valve(side):
            return rate
        return minimum(rate, self._constants["rupture_a" if side == 0 else "rupture_b"])

    def _outflow_restrictions(self, side: int) -> tuple[Scalar | None, Scalar]:
        """In the way of the outflow: coefficient of the holding valve, 1 / c^2 of the cushion."""
        holding, p, other = None, self.pressures[side], self.pressures[1 - side]
        valve = self._counterbalance_constants[side]
        if (self._cylinder.counterbalance_a, self._cylinder.counterbalance_b)[side] is not None:
            opening_pressure = p + valve["pilot_ratio"] * other - valve["pressure"]
            holding = valve["coefficient"] * clip(opening_pressure * valve["per_range"], 0.0, 1.0)
        cushion: Scalar = 0.0
        if self._cylinder.cushion > 0:
            cushion_share = clip(
                1.0 - self._clearances[side] / self._constants["cushion"], 0.0, 1.0
            )
            cushion = self._constants["cushion_resistance"] * cushion_share * cushion_share
        return holding, cushion


def spool_equations(
    name: str,
    spool: Valve | Spool,
    constants: Mapping[str, Scalar],
    states: Mapping[str, Scalar],
    signal: Scalar,
) -> tuple[Scalar, list[Scalar]]:
    """A spool's position u, and the rates of its states: u'' = w^2 (wanted - u) - 2 d w u'.

    With a play of width h what is wanted follows the signal by z' = rate (|signal - z| - h / 2)
    beyond the play.

    Args:
        name: Of its signal.
        spool: What it is.
        constants: Its numbers, `SPOOL_CONSTANTS` among them.
        states: States by name.
        signal: That reaches it [V].
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
    acceleration = w * (w * (target - u) - 2.0 * constants["spool_damping"] * speed)
    return u, [*rates, limited_speed, acceleration]


def cylinder_constants(cylinder: Cylinder, valve: Valve, stroke: float) -> list[float]:
    """The numbers of a cylinder, its valve and its stroke, in the order of the formulas."""
    values = {
        **vars(cylinder),
        "cushion_resistance": cylinder.cushion_coefficient**-2,
        "stroke": stroke,
        "c1": valve.c1, "c2": valve.c2, "c3": valve.c3, "c4": valve.c4,
        "margin": valve.margin,
        **dict(zip(SPOOL_CONSTANTS, spool_constants(valve), strict=True)),
        "centre": valve.centre,
        "regeneration": valve.regeneration,
        "float_from": valve.float_from,
        "per_float": 1.0 / (1.0 - valve.float_from),
        "float_coefficient": valve.float_coefficient,
        "demand": valve.demand,
        "per_release": 1.0 / cylinder.brake_release,
    }  # fmt: skip
    holding = [
        _counterbalance_row(cylinder.counterbalance_a),
        _counterbalance_row(cylinder.counterbalance_b),
    ]
    return [*(float(values[name]) for name in CYLINDER_CONSTANTS), *holding[0], *holding[1]]


def spool_constants(spool: Valve | Spool) -> list[float]:
    """The numbers of what moves a spool, in the order of `SPOOL_CONSTANTS`."""
    return [
        spool.neutral, 1.0 / (spool.full - spool.neutral), spool.dead_band,
        1.0 / (1.0 - spool.dead_band), spool.bandwidth, spool.damping, spool.rate,
        spool.hysteresis,
    ]  # fmt: skip


def _counterbalance_row(valve: CounterbalanceValve | None) -> list[float]:
    if valve is None:
        return [0.0] * len(_COUNTERBALANCE_CONSTANTS)
    return [valve.pressure, valve.pilot_ratio, 1.0 / valve.range, valve.coefficient]
