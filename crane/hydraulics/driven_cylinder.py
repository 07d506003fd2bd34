"""One valve and its cylinder: flows, pressures, force, equations (20) to (23)."""

from collections.abc import Sequence
from dataclasses import dataclass

from crane.codegen import Number, maximum
from crane.codegen.scalar import apply, where_positive
from crane.hydraulics.components import Counterbalance, Cylinder, Valve
from crane.hydraulics.flow import clipped, in_series, root, through

GAS_PRESSURE = 1.0e5  # at which volumes of entrapped gas are given [Pa]
_SLIGHT = 0.1  # of the hose's volume, the least that a chamber holds
FIELDS = (
    "area_a", "area_b", "hose_a", "hose_b", "gas_a", "gas_b", "leakage", "leakage_a", "leakage_b",
    "relief", "relief_gain", "refill", "cushion", "cushion_resistance", "stiffness", "damping",
    "stroke", "c1", "c2", "c3", "c4", "margin", "neutral", "per_signal", "dead_band", "per_stroke",
    "bandwidth", "spool_damping", "rate", "seal_friction", "brake", "per_release",
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


class DrivenCylinder:
    """One valve and its cylinder at an instant.

    Args:
        common: Numbers of oil and supply.
        numbers: `row_of` the parts, as floats or traced.
        supply: Pressure [Pa].
        tank: Pressure [Pa].
        spool: Position u.
        x: Coordinate above the lower limit [m], [rad].
        v: Its rate [m/s], [rad/s].
        own: States: those of the pressures in A and B, then the series spring's compression.
        compliant: Whether there is such a spring.

    Attributes:
        force: Of the cylinder, equation (20) [N], [N m].
        grip: Coulomb friction that seals and brake add to the joint's [N], [N m]; see `_grip`.
        chambers: A and B.
        drawn: Flow from the supply [m3/s].
        returned: Flow to the tank [m3/s].
        lost: Power that throttles, leaks and the series damper turn into heat [W].
        spring_rate: Rate of the series spring's compression, if there is one.
        spring_power: What goes into it [W].
        spring_flow: What both chambers grow by as it gives way [m3/s].
    """

    def __init__(
        self,
        common: dict[str, Number],
        numbers: Sequence[Number],
        supply: Number,
        tank: Number,
        spool: Number,
        x: Number,
        v: Number,
        own: Sequence[Number],
        compliant: bool,
    ):
        self._common, width = common, len(_HOLDING)
        part = self._part = dict(zip(FIELDS, numbers[: len(FIELDS)], strict=True))
        ends = [len(FIELDS) + side * width for side in range(3)]
        self._holding = [
            dict(zip(_HOLDING, numbers[start:end], strict=True))
            for start, end in zip(ends, ends[1:], strict=False)
        ]
        vapour = common["vapour"]
        pressures = [vapour + maximum(own[side], 0.0) for side in range(2)]
        areas = [part["area_a"], part["area_b"]]
        self.force = areas[0] * pressures[0] - areas[1] * pressures[1]
        self.grip = self._grip(pressures, tank, spool)
        self.spring_rate: list[Number] = []
        self.spring_power: Number = 0.0
        self.spring_flow: Number = 0.0
        damped: Number = 0.0
        if compliant:
            # massless: the spring and its damper carry the cylinder's force
            pressing = part["stiffness"] * own[2]
            squeezed = (self.force - pressing) / part["damping"]
            x, v = x + own[2], v + squeezed
            self.spring_rate = [squeezed]
            self.spring_power = pressing * squeezed
            self.spring_flow = (areas[0] - areas[1]) * squeezed
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

    def _grip(self, pressures: Sequence[Number], tank: Number, spool: Number) -> Number:
        """F_K = mu (max(p_A - p_R, 0) + max(p_B - p_R, 0)) + B (1 - (|u| - d) / e) [N], [N m].

        With mu and B of the seals and the brake, its last factor within 0 and 1, d the dead band
        and e the travel that releases it.
        """
        part = self._part
        grip: Number = 0.0
        if part["seal_friction"] != 0.0:
            above = [maximum(p - tank, 0.0) for p in pressures]
            grip = grip + part["seal_friction"] * (above[0] + above[1])
        if part["brake"] != 0.0:
            travel = (apply("abs", spool) - part["dead_band"]) * part["per_release"]
            grip = grip + part["brake"] * (1.0 - clipped(travel, 0.0, 1.0))
        return grip

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


def row_of(cylinder: Cylinder, valve: Valve, stroke: float) -> list[float]:
    """The numbers of a cylinder, its valve and its stroke, in the order of the formulas."""
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
        "per_release": 1.0 / cylinder.brake_release,
    }  # fmt: skip
    holding = [_holding(cylinder.counterbalance_a), _holding(cylinder.counterbalance_b)]
    return [*(float(values[name]) for name in FIELDS), *holding[0], *holding[1]]


def _holding(valve: Counterbalance | None) -> list[float]:
    if valve is None:
        return [0.0] * len(_HOLDING)
    return [valve.pressure, valve.pilot_ratio, 1.0 / valve.range, valve.coefficient]
