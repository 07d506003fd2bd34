"""One valve and its cylinder: flows, pressures, force, equations (20) to (23)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from crane.codegen import Number, maximum
from crane.codegen.scalar import apply, minimum, where_positive
from crane.hydraulics.components import Counterbalance, Cylinder, Spool, Valve
from crane.hydraulics.flow import LAMINAR, Flow, clipped, in_series, root, through
from crane.hydraulics.nodes import PER_SENSED, highest, softness_of
from crane.hydraulics.sources import TANK

INSIDE = ("piston", "cross")  # flows that pass no hose
_PLAY = 500.0  # [1/s], at which a signal takes its play along
_GIVEN_WAY = 0.2  # of its margin, within which a valve of priority stops the others
_SLIGHT = 0.1  # of the hose's volume, the least that a chamber holds
FIELDS = (
    "area_a", "area_b", "hose_a", "hose_b", "gas_a", "gas_b", "leakage", "leakage_a", "leakage_b",
    "relief", "relief_gain", "refill", "cushion", "cushion_resistance", "stiffness", "damping",
    "stroke", "c1", "c2", "c3", "c4", "margin", "neutral", "per_signal", "dead_band", "per_stroke",
    "bandwidth", "spool_damping", "rate", "cross_relief", "rupture_a", "rupture_b", "centre",
    "regeneration", "float_from", "per_float", "float_coefficient", "demand", "hysteresis",
    "seal_friction", "brake", "per_release",
)  # fmt: skip
SPOOL = (
    "neutral", "per_signal", "dead_band", "per_stroke", "bandwidth", "spool_damping", "rate",
    "hysteresis",
)  # fmt: skip
_HOLDING = ("pressure", "pilot_ratio", "per_range", "coefficient")
WIDTH = len(FIELDS) + 2 * len(_HOLDING)


@dataclass
class Chamber:
    """One side of a cylinder at an instant.

    Attributes:
        pressure: [Pa].
        volume: [m3].
        area: [m2], [m3/rad].
        valve: Flow through its hose into it [m3/s].
        net: Flow into it less what its volume grows by [m3/s].
        slope: Rate of the state that stands for its pressure [Pa/s].
    """

    pressure: Number
    volume: Number
    area: Number
    valve: Number
    net: Number
    slope: Number


class DrivenCylinder:
    """One valve and its cylinder or motor at an instant.

    Args:
        common: Numbers of the oil.
        numbers: `row_of` the parts, as floats or traced.
        cylinder: What it is.
        valve: Likewise.
        spools: Position u; those of the spools of A and of B where there are two.
        second: Numbers of the second spool, `SPOOL`.
        x: Coordinate above the lower limit [m], [rad].
        v: Its rate [m/s], [rad/s].
        own: States: those of the pressures in A and B, then the series spring's compression.

    Attributes:
        joint: Whose cylinder it is.
        valve: Its valve.
        pressures: Of A and B [Pa].
        opened: Openings y of the inlets to A and to B: of one spool on its positive and its
            negative side.
        force: Of the cylinder, equation (20) [N], [N m].
        spring_rate: Rate of the series spring's compression, if there is one.
        spring_power: What goes into it [W].
        spring_flow: What both chambers grow by as it gives way [m3/s].
        damped: What its damper turns into heat [W].
    """

    def __init__(
        self,
        common: dict[str, Number],
        numbers: Sequence[Number],
        cylinder: Cylinder,
        valve: Valve,
        spools: Sequence[Number],
        second: Mapping[str, Number],
        x: Number,
        v: Number,
        own: Sequence[Number],
    ):
        self._common, width = common, len(_HOLDING)
        self._cylinder, self.valve, self._own, self._spools = cylinder, valve, own, spools
        self.joint = cylinder.joint
        part = self._part = dict(zip(FIELDS, numbers[: len(FIELDS)], strict=True))
        ends = [len(FIELDS) + side * width for side in range(3)]
        self._holding = [
            dict(zip(_HOLDING, numbers[start:end], strict=True))
            for start, end in zip(ends, ends[1:], strict=False)
        ]
        vapour = common["vapour"]
        pressures = self.pressures = [vapour + maximum(own[side], 0.0) for side in range(2)]
        areas = self._areas = [part["area_a"], part["area_b"]]
        self.force = areas[0] * pressures[0] - areas[1] * pressures[1]
        self.spring_rate: list[Number] = []
        self.spring_power: Number = 0.0
        self.spring_flow: Number = 0.0
        self.damped: Number = 0.0
        if cylinder.stiffness > 0:
            # massless: the spring and its damper carry the cylinder's force
            pressing = part["stiffness"] * own[2]
            squeezed = (self.force - pressing) / part["damping"]
            x, v = x + own[2], v + squeezed
            self.spring_rate = [squeezed]
            self.spring_power = pressing * squeezed
            self.spring_flow = (areas[0] - areas[1]) * squeezed
            self.damped = part["damping"] * squeezed * squeezed
        self._left = [x, part["stroke"] - x]
        self._v = v
        self._laws = [part, second][: len(spools)]
        sides = [
            [
                clipped((side - law["dead_band"]) * law["per_stroke"], 0.0, 1.0)
                for side in (spool, -spool)
            ]
            for spool, law in zip(spools, self._laws, strict=True)
        ]
        self.opened = [sides[0][0], sides[-1][1]]
        self._drained = [sides[0][1], sides[-1][0]]

    @property
    def nodes(self) -> dict[str, Number]:
        """Pressures of its chambers by their nodes' names."""
        return {f"{self.joint}.{side}": p for side, p in zip("ab", self.pressures, strict=True)}

    @property
    def demand(self) -> Number:
        """Share of its pump's flow that a positive control gives for it."""
        return self._part["demand"] * maximum(*self.opened)

    def sensed(self, tank: Number) -> Number:
        """Pressure that its valve reports as its load, the tank's while it is closed [Pa]."""
        shares = [clipped(y * PER_SENSED, 0.0, 1.0) for y in self.opened]
        loads = [share * (p - tank) for share, p in zip(shares, self.pressures, strict=True)]
        return tank + maximum(*loads)

    def missing(self, supply: Number, tank: Number) -> Number:
        """What a pump's pressure is short of for its flow, over what `Valve.priority` allows."""
        share = highest([clipped(y * PER_SENSED, 0.0, 1.0) for y in self.opened])
        needed = self.sensed(tank) + share * self._part["margin"]
        return (needed - supply) / (_GIVEN_WAY * self._part["margin"])

    def centre(self) -> Number:
        """Coefficient of its open centre."""
        size = maximum(self._spools[0], -self._spools[0])
        if (curve := self.valve.curves.get("centre")) is not None:
            return self._part["centre"] * curve.at(size)
        return self._part["centre"] * (1.0 - maximum(*self.opened))

    def flows(
        self, supply: Number, backs: Sequence[Number], load: Number, left: Number
    ) -> list[Flow]:
        """All through its valve and past its piston.

        Args:
            supply: Pressure of what feeds it [Pa].
            backs: Those of what A and B are drained to [Pa].
            load: Highest load of the valves beside it, where it shares its flow [Pa].
            left: Share of its inlet that valves of priority leave.
        """
        part, valve = self._part, self.valve
        nodes = list(self.nodes)
        node_a, node_b = nodes
        one, other = self.pressures
        across = one - other
        found = [Flow(node_a, node_b, part["leakage"] * across, "piston")]
        if self._cylinder.cross_relief > 0:
            for source, target, sign in ((node_a, node_b, 1.0), (node_b, node_a, -1.0)):
                over = maximum(sign * across - part["cross_relief"], 0.0)
                found.append(Flow(source, target, part["relief_gain"] * over, "cross"))
        if valve.regeneration > 0:
            orifice = in_series(part["regeneration"] * self.opened[0], *self._obstacles(1))
            rate = self._held(orifice * root(maximum(-across, 0.0)), 1)
            found.append(Flow(node_b, node_a, rate, "regeneration"))
        floats: Number = 0.0
        if valve.float_from > 0:
            floats = clipped((-self._spools[0] - part["float_from"]) * part["per_float"], 0.0, 1.0)
        for side in range(2):
            p, back, node = self.pressures[side], backs[side], nodes[side]
            to = valve.return_a if side == 0 else valve.return_b
            forwards = 1.0 if side == 0 else -1.0
            inlet = self._edge(("c1", "c4")[side], side, forwards, self.opened[side])
            outlet = self._edge(("c3", "c2")[side], side, -forwards, self._drained[side])
            if valve.float_from > 0:
                outlet = outlet + part["float_coefficient"] * floats
                if side == 1:
                    inlet = inlet * (1.0 - floats)
            fed, drop = self._inflow(supply, inlet, side, load)
            if drop is None:  # else nothing comes back
                fed = -self._held(-fed, side) if self._ruptures(side) else fed
            found.append(Flow(valve.supply, node, left * fed, "inlet", drop))
            drained = -through(back - p, outlet, in_series(outlet, *self._obstacles(side)))
            found.append(Flow(node, to, self._held(drained, side), "outlet"))
        return found

    def around(self, tank: Number) -> list[Flow]:
        """Leaks, relief and suction valves of both chambers."""
        part, found = self._part, []
        for side, name in enumerate("ab"):
            p, node = self.pressures[side], f"{self.joint}.{name}"
            found.append(Flow(node, TANK, part[f"leakage_{name}"] * (p - tank), "leak"))
            if self._cylinder.relief > 0:
                rate = part["relief_gain"] * maximum(p - part["relief"], 0.0)
                found.append(Flow(node, TANK, rate, "relief"))
            if self._cylinder.refill > 0:
                rate = part["refill"] * root(maximum(tank - p, 0.0))
                found.append(Flow(TANK, node, rate, "refill"))
        return found

    def chamber(self, side: int, valve: Number, inflow: Number) -> Chamber:
        """A chamber that gets flows.

        Args:
            side: 0 of A, 1 of B.
            valve: Through its hose [m3/s].
            inflow: In all [m3/s].
        """
        part, p, area = self._part, self.pressures[side], self._areas[side]
        sign = 1.0 if side == 0 else -1.0
        net = inflow - sign * area * self._v
        hose = part["hose_a" if side == 0 else "hose_b"]
        gas = part["gas_a" if side == 0 else "gas_b"]
        volume, half = hose, hose
        if not self._cylinder.motor:
            volume = maximum(hose + area * self._left[side], _SLIGHT * hose)
            half = hose + 0.5 * area * part["stroke"]
        softness = softness_of(self._common, volume, hose, gas, p)
        void = self._common["oil"] * half
        if self.valve.float_from > 0:
            # it runs into voids all the time: over a jump steps get a million times shorter
            filled = clipped(self._own[side] * (1.0 / LAMINAR), 0.0, 1.0)
            slope = net / (void + (softness - void) * filled)
        else:
            slope = net / where_positive(self._own[side], softness, void)
        return Chamber(p, volume, area, valve, net, slope)

    def _edge(self, name: str, side: int, way: float, opened: Number) -> Number:
        """Coefficient of a chamber's edge as far as its spool opens it, `way` 1 or -1."""
        if (curve := self.valve.curves.get(name)) is not None:
            spool = self._spools[-1 if side else 0]
            stroke = clipped(spool if way > 0 else -spool, 0.0, 1.0)
            return self._part[name] * where_positive(stroke, curve.at(stroke), 0.0)
        return self._part[name] * opened

    def grip(self, tank: Number) -> Number:
        """Coulomb friction that seals and brake add to the joint's [N], [N m].

        F_K = mu (max(p_A - p_R, 0) + max(p_B - p_R, 0)) + B (1 - (|u| - d) / e), with mu and B of
        the seals and the brake, its last factor within 0 and 1, d the dead band and e the travel
        that releases it; of two spools the one that goes farther counts.

        Args:
            tank: p_R [Pa].
        """
        part = self._part
        grip: Number = 0.0
        if self._cylinder.seal_friction > 0:
            above = [maximum(p - tank, 0.0) for p in self.pressures]
            grip = grip + part["seal_friction"] * (above[0] + above[1])
        if self._cylinder.brake > 0:
            travel = highest([
                (apply("abs", spool) - law["dead_band"]) * part["per_release"]
                for spool, law in zip(self._spools, self._laws, strict=True)
            ])  # fmt: skip
            grip = grip + part["brake"] * (1.0 - clipped(travel, 0.0, 1.0))
        return grip

    def _inflow(
        self, supply: Number, inlet: Number, side: int, load: Number
    ) -> tuple[Number, Number | None]:
        """From the supply, and the drop at the edge that meters it where another one follows.

        A compensator keeps the pressure drop and lets nothing back.
        """
        p, margin = self.pressures[side], self._part["margin"]
        if self.valve.sharing:
            drop = maximum(supply - maximum(load, p), 0.0)
            return inlet * root(drop), drop
        if self.valve.margin > 0:
            drop = clipped(supply - p, 0.0, margin)
            return inlet * root(drop), drop
        return through(supply - p, inlet, in_series(inlet, *self._obstacles(side))), None

    def _ruptures(self, side: int) -> bool:
        """Whether a chamber has a hose rupture valve."""
        return (self._cylinder.rupture_a, self._cylinder.rupture_b)[side] > 0

    def _held(self, rate: Number, side: int) -> Number:
        """A flow out of a chamber, as far as its hose rupture valve lets it."""
        if not self._ruptures(side):
            return rate
        return minimum(rate, self._part["rupture_a" if side == 0 else "rupture_b"])

    def _obstacles(self, side: int) -> tuple[Number | None, Number]:
        """In the way of the outflow: coefficient of the holding valve, 1 / c^2 of the cushion."""
        holding, p, other = None, self.pressures[side], self.pressures[1 - side]
        valve = self._holding[side]
        if (self._cylinder.counterbalance_a, self._cylinder.counterbalance_b)[side] is not None:
            raised = p + valve["pilot_ratio"] * other - valve["pressure"]
            holding = valve["coefficient"] * clipped(raised * valve["per_range"], 0.0, 1.0)
        cushion: Number = 0.0
        if self._cylinder.cushion > 0:
            near = clipped(1.0 - self._left[side] / self._part["cushion"], 0.0, 1.0)
            cushion = self._part["cushion_resistance"] * near * near
        return holding, cushion


def spool_of(
    name: str,
    spool: Valve | Spool,
    part: Mapping[str, Number],
    own: Mapping[str, Number],
    signal: Number,
) -> tuple[Number, list[Number]]:
    """A spool's position u, and the rates of its states: u'' = w^2 (wanted - u) - 2 d w u'.

    With a play of width h what is wanted follows the signal by z' = rate (|signal - z| - h / 2)
    beyond the play.

    Args:
        name: Of its signal.
        spool: What it is.
        part: Its numbers, `SPOOL` among them.
        own: States by name.
        signal: That reaches it [V].
    """
    rates: list[Number] = []
    wanted = clipped((signal - part["neutral"]) * part["per_signal"], -1.0, 1.0)
    if spool.hysteresis > 0:
        behind = own[f"play_{name}"]
        gap, half = wanted - behind, 0.5 * part["hysteresis"]
        rates.append(_PLAY * (gap - clipped(gap, -1.0 * half, half)))
        wanted = behind
    if not spool.bandwidth > 0:
        return wanted, rates
    u, speed = own[f"spool_{name}"], own[f"spool_rate_{name}"]
    w, moved = part["bandwidth"], speed
    if spool.rate > 0:
        moved = clipped(speed, -1.0 * part["rate"], part["rate"])
    pull = w * (w * (wanted - u) - 2.0 * part["spool_damping"] * speed)
    return u, [*rates, moved, pull]


def row_of(cylinder: Cylinder, valve: Valve, stroke: float) -> list[float]:
    """The numbers of a cylinder, its valve and its stroke, in the order of the formulas."""
    values = {
        **vars(cylinder),
        "cushion_resistance": cylinder.cushion_coefficient**-2,
        "stroke": stroke,
        "c1": valve.c1, "c2": valve.c2, "c3": valve.c3, "c4": valve.c4,
        "margin": valve.margin,
        **dict(zip(SPOOL, spool_row(valve), strict=True)),
        "centre": valve.centre,
        "regeneration": valve.regeneration,
        "float_from": valve.float_from,
        "per_float": 1.0 / (1.0 - valve.float_from),
        "float_coefficient": valve.float_coefficient,
        "demand": valve.demand,
        "per_release": 1.0 / cylinder.brake_release,
    }  # fmt: skip
    holding = [_holding(cylinder.counterbalance_a), _holding(cylinder.counterbalance_b)]
    return [*(float(values[name]) for name in FIELDS), *holding[0], *holding[1]]


def spool_row(spool: Valve | Spool) -> list[float]:
    """The numbers of what moves a spool, in the order of `SPOOL`."""
    return [
        spool.neutral, 1.0 / (spool.full - spool.neutral), spool.dead_band,
        1.0 / (1.0 - spool.dead_band), spool.bandwidth, spool.damping, spool.rate,
        spool.hysteresis,
    ]  # fmt: skip


def _holding(valve: Counterbalance | None) -> list[float]:
    if valve is None:
        return [0.0] * len(_HOLDING)
    return [valve.pressure, valve.pilot_ratio, 1.0 / valve.range, valve.coefficient]
