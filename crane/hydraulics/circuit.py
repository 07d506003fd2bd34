"""Pressures, flows and forces of a circuit as formulas, equations (20) to (23)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crane.description import Counterbalance, Cylinder, Hydraulics, Valve
from crane.hydraulics.flow import clipped, in_series, root, through
from crane.samples import Array
from crane.straight import Number, maximum
from crane.straight.scalar import apply, where_positive

GAS_PRESSURE = 1.0e5  # at which volumes of entrapped gas are given [Pa]
# Integrals that balance: pumped = returned + stored + volume swept, and pump_work = work of the
# cylinders + hydraulic_loss + oil_energy.
BALANCES = {
    "oil_pumped": "m3", "oil_returned": "m3", "oil_stored": "m3",
    "pump_work": "J", "hydraulic_loss": "J", "oil_energy": "J",
}  # fmt: skip
_SLIGHT = 0.1  # of the hose's volume, the least that a chamber holds
_FIELDS = (
    "area_a", "area_b", "hose_a", "hose_b", "gas_a", "gas_b", "leakage", "leakage_a", "leakage_b",
    "relief", "relief_gain", "refill", "cushion", "cushion_resistance", "stiffness", "damping",
    "stroke", "c1", "c2", "c3", "c4", "margin", "neutral", "per_signal", "dead_band", "per_stroke",
    "bandwidth", "spool_damping", "rate",
)  # fmt: skip
_HOLDING = ("pressure", "pilot_ratio", "per_range", "coefficient")
_WIDTH = len(_FIELDS) + 2 * len(_HOLDING)
_COMMON = (
    "oil", "hose", "steel", "vapour", "gas_power", "pump", "tank", "pump_flow", "per_droop",
    "line",
)  # fmt: skip


@dataclass
class Chamber:
    """One side of a cylinder at an instant.

    Attributes:
        pressure: [Pa].
        volume: [m3].
        area: [m2], [m3/rad].
        valve: Flow through the valve into it [m3/s].
        net: Flow into it less what its volume grows by [m3/s].
        slope: Rate of the state that stands for its pressure [Pa/s].
    """

    pressure: Number
    volume: Number
    area: Number
    valve: Number
    net: Number
    slope: Number


@dataclass
class Instant:
    """The circuit at an instant.

    Attributes:
        forces: (m,) of the cylinders, F = area_a p_A - area_b p_B, equation (20) [N], [N m].
        rates: (k,) of the states.
        spools: (m,) positions u.
        chambers: (m,) pairs A, B.
        supply: Pressure [Pa].
        tank: Pressure [Pa].
    """

    forces: list[Number]
    rates: list[Number]
    spools: list[Number]
    chambers: list[tuple[Chamber, Chamber]]
    supply: Number
    tank: Number


class Circuit:
    """The formulas of one circuit.

    States per cylinder: those of the pressures in A and B, the compression of the series spring
    if there is one, position and rate of the spool if it has inertia; then that of the supply's
    pressure if the pump's flow is limited; then `BALANCES`.

    The state of a pressure is p - p_vapour where that is positive. Below zero the chamber holds
    vapour at p_vapour, of the volume that the state's size times a constant compressibility says:
    the pressure cannot fall below that of vapour, and comes back when the void is filled.

    Args:
        hydraulics: The circuit.
        strokes: (m,) distance between the limits of each joint [m], [rad].
        measured: Whether pressures of pump and tank are given from outside.

    Attributes:
        joints: Those driven, in order.
        numbers: Of the circuit, as the formulas read them.
        stiff: Number of states that need an implicit method; the others are integrals.
        size: Number of all states.
        form: What the formulas depend on beside the zeros and ones of the numbers.
        starts: (m,) where the states of each cylinder begin, with the pressures of A and B.
        scales: (size,) accuracy that matters in each state.
    """

    def __init__(self, hydraulics: Hydraulics, strokes: Sequence[float], measured: bool = False):
        self.hydraulics, self.joints = hydraulics, hydraulics.joints
        self.measured = measured
        self._limited = hydraulics.supply.flow > 0 and not measured
        parts = list(
            zip(hydraulics.cylinders.values(), hydraulics.valves.values(), strokes, strict=True)
        )
        rows = [_row(cylinder, valve, stroke) for cylinder, valve, stroke in parts]
        self._strokes = np.array(strokes, dtype=np.float64)
        self.numbers = np.array([*self._common(), *(x for row in rows for x in row)])
        self._compliant = [cylinder.stiffness > 0 for cylinder, _, _ in parts]
        self._sluggish = [valve.bandwidth > 0 for _, valve, _ in parts]
        lengths = [
            2 + compliant + 2 * sluggish
            for compliant, sluggish in zip(self._compliant, self._sluggish, strict=True)
        ]
        self._offsets = [sum(lengths[:i]) for i in range(len(lengths) + 1)]
        self.starts = self._offsets[:-1]
        self.form = (tuple(self._compliant), tuple(self._sluggish), self._limited, measured)
        self.stiff = self._offsets[-1] + self._limited
        self.size = self.stiff + len(BALANCES)
        scales: list[float] = []
        for compliant, sluggish in zip(self._compliant, self._sluggish, strict=True):
            scales += [1.0, 1.0] + [1e-10] * compliant + [1e-7, 1e-5] * sluggish
        self.scales = np.array(scales + [1.0] * self._limited + [np.inf] * len(BALANCES))

    def _common(self) -> list[float]:
        oil, supply = self.hydraulics.oil, self.hydraulics.supply
        return [
            1.0 / oil.bulk_modulus,
            1.0 / oil.hose_modulus if oil.hose_modulus else 0.0,
            1.0 / oil.steel_modulus if oil.steel_modulus else 0.0,
            oil.vapour_pressure,
            1.0 + 1.0 / oil.gas_exponent,
            supply.pressure,
            supply.tank,
            supply.flow if self._limited else 0.0,
            1.0 / supply.droop,
            supply.volume / oil.bulk_modulus,
        ]

    def start(
        self,
        x: Array,
        forces: Array,
        pressures: dict[str, tuple[float, float]],
        signals: Array,
        supply: float,
    ) -> Array:
        """States (size,) at rest.

        Args:
            x: (m,) coordinates above the lower limits.
            forces: (m,) that hold the machine [N], [N m]: of each cylinder, the chamber that
                carries it bears the tank's pressure on the other side, too.
            pressures: Those of A and B [Pa] where they are known, by joint.
            signals: (m,) of the valves [V], to which the spools have come.
            supply: Pressure of the supply line [Pa].
        """
        state = np.zeros(self.size)
        least, vapour = self.hydraulics.supply.tank, self.hydraulics.oil.vapour_pressure
        for i, (cylinder, valve) in enumerate(
            zip(self.hydraulics.cylinders.values(), self.hydraulics.valves.values(), strict=True)
        ):
            held = forces[i] - least * (cylinder.area_a - cylinder.area_b)
            a = least + max(held, 0.0) / cylinder.area_a
            b = least + max(-held, 0.0) / cylinder.area_b
            a, b = pressures.get(cylinder.joint, (a, b))
            at = self._offsets[i]
            state[at : at + 2] = a - vapour, b - vapour
            if self._compliant[i]:
                force = cylinder.area_a * a - cylinder.area_b * b
                state[at + 2] = force / cylinder.stiffness
            if self._sluggish[i]:
                u = (signals[i] - valve.neutral) / (valve.full - valve.neutral)
                state[self._offsets[i + 1] - 2] = np.clip(u, -1.0, 1.0)
        if self._limited:
            state[self.stiff - 1] = supply - vapour
        return state

    def at(
        self,
        numbers: Sequence[Number],
        x: Sequence[Number],
        v: Sequence[Number],
        state: Sequence[Number],
        signals: Sequence[Number],
        given: Sequence[Number],
    ) -> Instant:
        """The circuit at an instant.

        Args:
            numbers: `numbers`, as floats or traced.
            x: (m,) coordinates above the lower limits [m], [rad].
            v: (m,) velocities [m/s], [rad/s].
            state: (size,).
            signals: (m,) of the valves [V].
            given: Pressures of supply and tank where they are measured, else nothing.
        """
        common = dict(zip(_COMMON, numbers[: len(_COMMON)], strict=True))
        supply, tank = common["pump"], common["tank"]
        if self.measured:
            supply, tank = given
        elif self._limited:
            supply = common["vapour"] + maximum(state[self.stiff - 1], 0.0)
        forces: list[Number] = []
        rates: list[Number] = []
        spools: list[Number] = []
        chambers: list[tuple[Chamber, Chamber]] = []
        drawn: Number = 0.0
        returned: Number = 0.0
        stored: Number = 0.0
        lost: Number = 0.0
        kept: Number = 0.0
        for i in range(len(self.joints)):
            start = len(_COMMON) + _WIDTH * i
            part = dict(zip(_FIELDS, numbers[start : start + len(_FIELDS)], strict=True))
            own = state[self._offsets[i] : self._offsets[i + 1]]
            spool, spool_rates = self._spool(i, part, own, signals[i])
            function = _Function(common, part, numbers[start + len(_FIELDS) : start + _WIDTH])
            function.evaluate(supply, tank, spool, x[i], v[i], own, self._compliant[i])
            spools.append(spool)
            forces.append(function.force)
            chambers.append(function.chambers)
            rates += [*(side.slope for side in function.chambers), *function.spring_rate]
            rates += spool_rates
            drawn, returned = drawn + function.drawn, returned + function.returned
            lost = lost + function.lost
            for side in function.chambers:
                stored, kept = stored + side.net, kept + side.pressure * side.net
            kept = kept + function.spring_power
        pumped = drawn
        if self._limited:
            pumped = common["pump_flow"] * clipped(
                (common["pump"] - supply) * common["per_droop"], 0.0, 1.0
            )
            net = pumped - drawn
            rates.append(net / common["line"])
            stored, kept = stored + net, kept + supply * net
        work = supply * pumped - tank * returned
        rates += [pumped, returned, stored, work, lost, kept]
        return Instant(forces, rates, spools, chambers, supply, tank)

    def _spool(
        self, i: int, part: dict[str, Number], own: Sequence[Number], signal: Number
    ) -> tuple[Number, list[Number]]:
        """Position u and the rates of its states: u'' = w^2 (wanted - u) - 2 d w u'."""
        wanted = clipped((signal - part["neutral"]) * part["per_signal"], -1.0, 1.0)
        if not self._sluggish[i]:
            return wanted, []
        spool, speed = own[-2:]
        w = part["bandwidth"]
        rate = part["rate"]
        moved = speed
        if rate != 0.0:
            moved = clipped(speed, -rate, rate)
        pull = w * (w * (wanted - spool) - 2.0 * part["spool_damping"] * speed)
        return spool, [moved, pull]


class _Function:
    """One valve and its cylinder."""

    def __init__(
        self, common: dict[str, Number], part: dict[str, Number], holding: Sequence[Number]
    ):
        self._common, self._part = common, part
        width = len(_HOLDING)
        self._holding = [
            dict(zip(_HOLDING, holding[side * width : (side + 1) * width], strict=True))
            for side in range(2)
        ]

    def evaluate(
        self,
        supply: Number,
        tank: Number,
        spool: Number,
        x: Number,
        v: Number,
        own: Sequence[Number],
        compliant: bool,
    ) -> None:
        """Flows, net flows and rates; see the attributes set here."""
        common, part = self._common, self._part
        vapour = common["vapour"]
        pressures = [vapour + maximum(own[side], 0.0) for side in range(2)]
        areas = [part["area_a"], part["area_b"]]
        self.force = areas[0] * pressures[0] - areas[1] * pressures[1]
        self.spring_rate: list[Number] = []
        self.spring_power: Number = 0.0
        damped: Number = 0.0
        if compliant:
            # massless: the spring and its damper carry the cylinder's force
            pressing = part["stiffness"] * own[2]
            squeezed = (self.force - pressing) / part["damping"]
            x, v = x + own[2], v + squeezed
            self.spring_rate = [squeezed]
            self.spring_power = pressing * squeezed
            damped = part["damping"] * squeezed * squeezed
        open_positive = clipped((spool - part["dead_band"]) * part["per_stroke"], 0.0, 1.0)
        open_negative = clipped((-spool - part["dead_band"]) * part["per_stroke"], 0.0, 1.0)
        past = part["leakage"] * (pressures[0] - pressures[1])
        self.drawn: Number = 0.0
        self.returned: Number = 0.0
        self.lost = past * (pressures[0] - pressures[1]) + damped
        sides: list[Chamber] = []
        for side, name in enumerate("ab"):
            p, other, area = pressures[side], pressures[1 - side], areas[side]
            left = x if side == 0 else part["stroke"] - x
            inlet = part["c1"] * open_positive if side == 0 else part["c4"] * open_negative
            outlet = part["c3"] * open_negative if side == 0 else part["c2"] * open_positive
            fed = self._inflow(supply - p, inlet, side, p, other, left)
            drained = -through(
                tank - p, outlet, in_series(outlet, *self._obstacles(side, p, other, left))
            )
            drained = drained + part[f"leakage_{name}"] * (p - tank)
            if part["relief"] != 0.0:
                drained = drained + part["relief_gain"] * maximum(p - part["relief"], 0.0)
            if part["refill"] != 0.0:
                drained = drained - part["refill"] * root(maximum(tank - p, 0.0))
            self.drawn, self.returned = self.drawn + fed, self.returned + drained
            self.lost = self.lost + fed * (supply - p) + drained * (p - tank)
            sign = 1.0 if side == 0 else -1.0
            net = fed - drained - sign * past - sign * area * v
            hose = part[f"hose_{name}"]
            volume = maximum(hose + area * left, _SLIGHT * hose)
            softness = self._softness(volume, hose, part[f"gas_{name}"], p)
            middle = common["oil"] * (hose + 0.5 * area * part["stroke"])
            slope = net / where_positive(own[side], softness, middle)
            sides.append(Chamber(p, volume, area, fed - drained, net, slope))
        self.chambers = (sides[0], sides[1])

    def _inflow(
        self, drop: Number, inlet: Number, side: int, p: Number, other: Number, left: Number
    ) -> Number:
        """From the supply; a compensator keeps the pressure drop and lets nothing back."""
        margin = self._part["margin"]
        if margin != 0.0:
            return inlet * root(clipped(drop, 0.0, margin))
        back = in_series(inlet, *self._obstacles(side, p, other, left))
        return through(drop, inlet, back)

    def _obstacles(
        self, side: int, p: Number, other: Number, left: Number
    ) -> tuple[Number | None, Number]:
        """In the way of the outflow: coefficient of the holding valve, 1 / c^2 of the cushion."""
        holding = None
        valve = self._holding[side]
        if valve["coefficient"] != 0.0:
            raised = p + valve["pilot_ratio"] * other - valve["pressure"]
            holding = valve["coefficient"] * clipped(raised * valve["per_range"], 0.0, 1.0)
        cushion: Number = 0.0
        if self._part["cushion"] != 0.0:
            near = clipped(1.0 - left / self._part["cushion"], 0.0, 1.0)
            cushion = self._part["cushion_resistance"] * near * near
        return holding, cushion

    def _softness(self, volume: Number, hose: Number, gas: Number, p: Number) -> Number:
        """Volume per pressure, V / K = V / B_oil + (V - V_h) / B_steel + V_h / B_hose + gas's."""
        common = self._common
        soft = volume * common["oil"] + hose * common["hose"]
        if common["steel"] != 0.0:
            soft = soft + common["steel"] * maximum(volume - hose, 0.0)
        if gas != 0.0:
            # V = gas (p0 / p)^(1/n), -dV/dp = gas / (n p0) (p0 / p)^(1 + 1/n)
            power = common["gas_power"]
            thin = apply("log", maximum(p, 1.0) * (1.0 / GAS_PRESSURE))
            soft = soft + gas * (power - 1.0) * (1.0 / GAS_PRESSURE) * apply("exp", -power * thin)
        return soft


def _row(cylinder: Cylinder, valve: Valve, stroke: float) -> list[float]:
    values = {
        **vars(cylinder),
        "cushion_resistance": cylinder.cushion_coefficient**-2,
        "stroke": stroke,
        "c1": valve.c1, "c2": valve.c2, "c3": valve.c3, "c4": valve.c4,
        "margin": valve.margin,
        "neutral": valve.neutral,
        "per_signal": 1.0 / (valve.full - valve.neutral),
        "dead_band": valve.dead_band,
        "per_stroke": 1.0 / (1.0 - valve.dead_band),
        "bandwidth": valve.bandwidth,
        "spool_damping": valve.damping,
        "rate": valve.rate,
    }  # fmt: skip
    holding = [_holding(cylinder.counterbalance_a), _holding(cylinder.counterbalance_b)]
    return [*(float(values[name]) for name in _FIELDS), *holding[0], *holding[1]]


def _holding(valve: Counterbalance | None) -> list[float]:
    if valve is None:
        return [0.0] * len(_HOLDING)
    return [valve.pressure, valve.pilot_ratio, 1.0 / valve.range, valve.coefficient]
