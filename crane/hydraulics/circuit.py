"""A circuit as formulas: cylinders with their valves, spools, supply, and what balances."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crane.codegen import Number, maximum
from crane.common.samples import Array
from crane.hydraulics.components import Hydraulics
from crane.hydraulics.driven_cylinder import FIELDS, WIDTH, Chamber, DrivenCylinder, row_of
from crane.hydraulics.flow import clipped

_PRESSURE, _OIL = 1.0, 5e-13  # accuracy that matters [Pa], [m3]
# Integrals that balance: pumped = returned + stored + volume that the joints sweep, and
# pump_work = work of the cylinders + hydraulic_loss + oil_energy. What series springs give way is
# stored, too.
BALANCES = {
    "oil_pumped": "m3", "oil_returned": "m3", "oil_stored": "m3",
    "pump_work": "J", "hydraulic_loss": "J", "oil_energy": "J",
}  # fmt: skip
_COMMON = (
    "oil", "hose", "steel", "vapour", "gas_power", "pump", "tank", "pump_flow", "per_droop",
    "line",
)  # fmt: skip


@dataclass
class Instant:
    """The circuit at an instant.

    Attributes:
        forces: (m,) of the cylinders, F = area_a p_A - area_b p_B, equation (20) [N], [N m].
        grips: (m,) Coulomb friction that they add to that of their joints [N], [N m].
        rates: (k,) of the states.
        spools: (m,) positions u.
        chambers: (m,) pairs A, B.
        supply: Pressure [Pa].
        tank: Pressure [Pa].
    """

    forces: list[Number]
    grips: list[Number]
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
        states: Names and units of the stiff ones, pressures counting from that of vapour.
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
        rows = [row_of(cylinder, valve, stroke) for cylinder, valve, stroke in parts]
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
        self.stiff = self._offsets[-1] + self._limited
        self.size = self.stiff + len(BALANCES)
        modulus = hydraulics.oil.bulk_modulus
        scales: list[float] = []
        for i, (cylinder, _, stroke) in enumerate(parts):
            halves = (
                cylinder.hose_a + 0.5 * cylinder.area_a * stroke,
                cylinder.hose_b + 0.5 * cylinder.area_b * stroke,
            )
            scales += [max(_PRESSURE, modulus * _OIL / volume) for volume in halves]
            scales += [1e-10] * self._compliant[i] + [1e-7, 1e-5] * self._sluggish[i]
        line = [max(_PRESSURE, modulus * _OIL / hydraulics.supply.volume)] * self._limited
        self.states = self._named()
        self.scales = np.array(scales + line + [np.inf] * len(BALANCES))

    def _named(self) -> dict[str, str]:
        states: dict[str, str] = {}
        for joint, compliant, sluggish in zip(
            self.joints, self._compliant, self._sluggish, strict=True
        ):
            states |= {f"pressure_{joint}_{side}": "Pa" for side in "ab"}
            states |= {f"spring_{joint}": "m"} if compliant else {}
            states |= {f"spool_{joint}": "", f"spool_rate_{joint}": "1/s"} if sluggish else {}
        return states | ({"pressure_supply": "Pa"} if self._limited else {})

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
        tank: float,
    ) -> Array:
        """States (size,) at rest.

        Args:
            x: (m,) coordinates above the lower limits.
            forces: (m,) that hold the machine [N], [N m]: of each cylinder, the chamber that
                carries it bears the tank's pressure on the other side, too.
            pressures: Those of A and B [Pa] where they are known, by joint.
            signals: (m,) of the valves [V], to which the spools have come.
            supply: Pressure of the supply line [Pa].
            tank: Of the tank's [Pa].
        """
        state = np.zeros(self.size)
        least, vapour = tank, self.hydraulics.oil.vapour_pressure
        for i, (cylinder, valve) in enumerate(
            zip(self.hydraulics.cylinders.values(), self.hydraulics.valves.values(), strict=True)
        ):
            held = forces[i] - least * (cylinder.area_a - cylinder.area_b)
            a = least + max(held, 0.0) / cylinder.area_a
            b = least + max(-held, 0.0) / cylinder.area_b
            a, b = pressures.get(cylinder.joint, (a, b))
            at = self._offsets[i]
            state[at : at + 2] = max(a - vapour, 0.0), max(b - vapour, 0.0)
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
        grips: list[Number] = []
        rates: list[Number] = []
        spools: list[Number] = []
        chambers: list[tuple[Chamber, Chamber]] = []
        drawn: Number = 0.0
        returned: Number = 0.0
        stored: Number = 0.0
        lost: Number = 0.0
        kept: Number = 0.0
        for i in range(len(self.joints)):
            start = len(_COMMON) + WIDTH * i
            row = numbers[start : start + WIDTH]
            own = state[self._offsets[i] : self._offsets[i + 1]]
            part = dict(zip(FIELDS, row, strict=False))
            spool, spool_rates = self._spool(i, part, own, signals[i])
            function = DrivenCylinder(
                common, row, supply, tank, spool, x[i], v[i], own, self._compliant[i]
            )
            spools.append(spool)
            forces.append(function.force)
            grips.append(function.grip)
            chambers.append(function.chambers)
            rates += [*(side.slope for side in function.chambers), *function.spring_rate]
            rates += spool_rates
            drawn, returned = drawn + function.drawn, returned + function.returned
            lost = lost + function.lost
            for side in function.chambers:
                stored, kept = stored + side.net, kept + side.pressure * side.net
            stored, kept = stored + function.spring_flow, kept + function.spring_power
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
        return Instant(forces, grips, rates, spools, chambers, supply, tank)

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
