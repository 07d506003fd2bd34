"""A circuit as formulas: nodes with pressures, what flows between them, and what balances."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from crane.codegen import Number, maximum
from crane.common.samples import Array
from crane.hydraulics.books import Books, nets_of
from crane.hydraulics.components import Hydraulics
from crane.hydraulics.driven_cylinder import (
    FIELDS,
    INSIDE,
    SPOOL,
    WIDTH,
    Chamber,
    DrivenCylinder,
    row_of,
    spool_of,
    spool_row,
)
from crane.hydraulics.elements import Accumulator
from crane.hydraulics.flow import Flow, clipped
from crane.hydraulics.nodes import bubbles, flow_of, gas_of, highest, joined
from crane.hydraulics.pump import Pump
from crane.hydraulics.sources import MAIN, TANK, Engine, Supply

_PRESSURE, _OIL = 1.0, 5e-13  # accuracy that matters [Pa], [m3]
# Integrals that balance: pumped = returned + stored + volume that the joints sweep, and
# pump_work = work of the cylinders + hydraulic_loss + oil_energy. What series springs give way is
# stored, too.
BALANCES = {
    "oil_pumped": "m3", "oil_returned": "m3", "oil_stored": "m3",
    "pump_work": "J", "hydraulic_loss": "J", "oil_energy": "J",
}  # fmt: skip
_COMMON = ("oil", "hose", "steel", "vapour", "gas_power", "air", "pump", "tank")
_PUMP = (
    "pressure", "flow", "per_droop", "line", "margin", "standby", "signal", "throttle", "least",
    "per_response", "per_sensing", "power", "relief", "relief_gain", "slip", "friction", "drag",
)  # fmt: skip
_ENGINE = ("speed", "torque", "per_droop", "droop", "per_inertia")
_ACCUMULATOR = ("line", "volume", "precharge", "exponent", "per_time")
_ELEMENT = ("coefficient", "gain", "pressure")


@dataclass
class Instant:
    """The circuit at an instant.

    Attributes:
        forces: (m,) of the cylinders, F = area_a p_A - area_b p_B, equation (20) [N], [N m].
        grips: (m,) Coulomb friction that they add to that of their joints [N], [N m].
        rates: (k,) of the states.
        spools: (s,) positions u.
        chambers: (m,) pairs A, B.
        supply: Pressure [Pa].
        tank: Pressure [Pa].
        pressures: Of all nodes [Pa].
        flows: All between nodes.
        pumps: By node.
        speed: Of the engine over its set speed.
        stored: Power that goes into each node, and into the series spring of JOINT as JOINT.spring
            [W].
        damped: What dampers of series springs turn into heat, by joint [W].
    """

    forces: list[Number]
    grips: list[Number]
    rates: list[Number]
    spools: list[Number]
    chambers: list[tuple[Chamber, Chamber]]
    supply: Number
    tank: Number
    pressures: dict[str, Number]
    flows: list[Flow]
    pumps: dict[str, Pump]
    speed: Number
    stored: dict[str, Number]
    damped: dict[str, Number]


class Circuit:
    """The formulas of one circuit: nodes with pressures, and what flows between them.

    States per cylinder: those of the pressures in A and B, the compression of the series spring
    if there is one, per spool the signal behind its play, position and rate if these are;
    then per pump that of its line's pressure if its flow is limited, of its displacement and of
    the load that it senses if these take time; per line and accumulator that of its pressure, and
    the oil in it if heat leaves its gas; the engine's speed; then `BALANCES`.

    The state of a pressure is p - p_vapour where that is positive. Below zero the chamber holds
    vapour at p_vapour, of the volume that the state's size times a constant compressibility says:
    the pressure cannot fall below that of vapour, and comes back when the void is filled.

    Args:
        hydraulics: The circuit.
        strokes: (m,) distance between the limits of each joint [m], [rad].
        measured: Whether pressures of (the first) pump and tank are given from outside.

    Attributes:
        joints: Those driven, in order.
        spools: (s,) names of the valves' signals, see `Hydraulics.spools`.
        numbers: Of the circuit, as the formulas read them.
        stiff: Number of states that need an implicit method; the others are integrals.
        size: Number of all states.
        states: Names and units of the stiff ones, pressures counting from that of vapour.
        starts: (m,) where the states of each cylinder begin, with the pressures of A and B.
        scales: (size,) accuracy that matters in each state.
        pumps: Those whose flow is limited, by node.
        ends: (m,) where the states of each cylinder end.
    """

    def __init__(self, hydraulics: Hydraulics, strokes: Sequence[float], measured: bool = False):
        self.hydraulics, self.joints = hydraulics, hydraulics.joints
        self.spools = tuple(hydraulics.spools)
        self.measured = measured
        self.pumps = {
            name: pump
            for name, pump in hydraulics.sources.items()
            if pump.flow > 0 and not (measured and name == MAIN)
        }
        self._ample = {x: y for x, y in hydraulics.supplies.items() if x not in self.pumps}
        self._parts = [
            (cylinder, valve, 0.0 if cylinder.motor else stroke)
            for cylinder, valve, stroke in zip(
                hydraulics.cylinders.values(), hydraulics.valves.values(), strokes, strict=True
            )
        ]
        self._engine = hydraulics.engine if self.pumps else None
        rows = [
            self._common(),
            *(row_of(*part) for part in self._parts),
            *(spool_row(valve.spool_b) for _, valve, _ in self._parts if valve.spool_b),
            *(self._pump_row(pump) for pump in self.pumps.values()),
            *([pump.pressure] for pump in self._ample.values()),
            *([self._engine_row(self._engine)] if self._engine else []),
            *([line.volume / hydraulics.oil.bulk_modulus] for line in hydraulics.lines.values()),
            *(self._gas_row(item) for item in hydraulics.accumulators.values()),
            *([x.coefficient, x.gain, x.pressure] for x in hydraulics.elements.values()),
        ]
        self.numbers = np.array([x for row in rows for x in row])
        self.states: dict[str, str] = {}
        scales: list[float] = []
        modulus = hydraulics.oil.bulk_modulus

        def add(name: str, unit: str, scale: float) -> None:
            self.states[name] = unit
            scales.append(scale)

        def pressure(name: str, volume: float) -> None:
            add(f"pressure_{name}", "Pa", max(_PRESSURE, modulus * _OIL / volume))

        self.starts: list[int] = []
        for cylinder, valve, stroke in self._parts:
            joint = cylinder.joint
            self.starts.append(len(scales))
            pressure(f"{joint}_a", cylinder.hose_a + 0.5 * cylinder.area_a * stroke)
            pressure(f"{joint}_b", cylinder.hose_b + 0.5 * cylinder.area_b * stroke)
            if cylinder.stiffness > 0:
                add(f"spring_{joint}", "m", 1e-10)
            for name, spool in valve.spools.items():
                if spool.hysteresis > 0:
                    add(f"play_{name}", "", 1e-7)
                if spool.bandwidth > 0:
                    add(f"spool_{name}", "", 1e-7)
                    add(f"spool_rate_{name}", "1/s", 1e-5)
        self.ends = [*self.starts[1:], len(scales)]
        for name, pump in self.pumps.items():
            pressure(name, pump.volume)
            if pump.response > 0:
                add(f"share_{name}", "", 1e-7)
            if pump.sensing_time > 0:
                add(f"load_{name}", "Pa", _PRESSURE)
        for name, line in hydraulics.lines.items():
            pressure(name, line.volume)
        for name, item in hydraulics.accumulators.items():
            pressure(name, item.volume)
            if item.time_constant > 0:
                add(f"oil_{name}", "m3", 1e-9 * item.volume)
        if self._engine is not None:
            add("engine", "", 1e-7)
        self.stiff = len(scales)
        self.size = self.stiff + len(BALANCES)
        self.scales = np.array(scales + [np.inf] * len(BALANCES))
        self._place = {name: i for i, name in enumerate(self.states)}

    def _common(self) -> list[float]:
        oil, supply = self.hydraulics.oil, self.hydraulics.supply
        return [
            1.0 / oil.bulk_modulus,
            1.0 / oil.hose_modulus if oil.hose_modulus else 0.0,
            1.0 / oil.steel_modulus if oil.steel_modulus else 0.0,
            oil.vapour_pressure,
            1.0 + 1.0 / oil.gas_exponent,
            oil.air,
            supply.pressure,
            supply.tank,
        ]

    def _pump_row(self, pump: Supply) -> list[float]:
        modulus = self.hydraulics.oil.bulk_modulus
        return [
            pump.pressure, pump.flow, 1.0 / pump.droop, pump.volume / modulus,
            pump.margin, pump.standby, pump.signal, pump.throttle,
            pump.least, 1.0 / pump.response if pump.response else 0.0,
            1.0 / pump.sensing_time if pump.sensing_time else 0.0, pump.power, pump.relief,
            pump.relief_gain, pump.slip, pump.friction, pump.drag,
        ]  # fmt: skip

    def _engine_row(self, engine: Engine) -> list[float]:
        over = engine.speed_droop / engine.speed
        return [
            engine.speed, engine.torque, 1.0 / over, over, 1.0 / (engine.inertia * engine.speed),
        ]  # fmt: skip

    def _gas_row(self, item: Accumulator) -> list[float]:
        per_time = 1.0 / item.time_constant if item.time_constant else 0.0
        line = item.line / self.hydraulics.oil.bulk_modulus
        return [line, item.volume, item.precharge, item.exponent, per_time]

    def start(
        self,
        x: Array,
        forces: Array,
        pressures: dict[str, tuple[float, float]],
        signals: Array,
        tank: float,
    ) -> Array:
        """States (size,) at rest.

        Args:
            x: (m,) coordinates above the lower limits.
            forces: (m,) that hold the machine [N], [N m]: of each cylinder, the chamber that
                carries it bears the tank's pressure on the other side, too.
            pressures: Those of A and B [Pa] where they are known, by joint.
            signals: (s,) of the spools [V], to which these have come.
            tank: Pressure of the tank [Pa].
        """
        state = np.zeros(self.size)
        least, vapour = tank, self.hydraulics.oil.vapour_pressure
        for i, (cylinder, _, _) in enumerate(self._parts):
            held = forces[i] - least * (cylinder.area_a - cylinder.area_b)
            a = least + max(held, 0.0) / cylinder.area_a
            b = least + max(-held, 0.0) / cylinder.area_b
            a, b = pressures.get(cylinder.joint, (a, b))
            at = self.starts[i]
            state[at : at + 2] = max(a - vapour, 0.0), max(b - vapour, 0.0)
            if cylinder.stiffness > 0:
                force = cylinder.area_a * a - cylinder.area_b * b
                state[at + 2] = force / cylinder.stiffness
        for signal, (joint, spool) in zip(signals, self.hydraulics.spools.items(), strict=True):
            u = (signal - spool.neutral) / (spool.full - spool.neutral)
            for name in (f"play_{joint}", f"spool_{joint}"):
                if name in self._place:
                    state[self._place[name]] = np.clip(u, -1.0, 1.0)
        for name, pump in self.pumps.items():
            state[self._place[f"pressure_{name}"]] = pump.rest(tank) - vapour
            if pump.response > 0:
                state[self._place[f"share_{name}"]] = pump.least
            if pump.sensing_time > 0:
                state[self._place[f"load_{name}"]] = tank
        for name, line in self.hydraulics.lines.items():
            state[self._place[f"pressure_{name}"]] = (line.pressure or tank) - vapour
        for name, item in self.hydraulics.accumulators.items():
            p = item.pressure or item.precharge
            state[self._place[f"pressure_{name}"]] = p - vapour
            if item.time_constant > 0:
                oil = item.volume * (1.0 - item.precharge / max(p, item.precharge))
                state[self._place[f"oil_{name}"]] = oil
        if self._engine is not None:
            state[self._place["engine"]] = 1.0 + self._engine.speed_droop / self._engine.speed
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
            signals: (s,) that reach the spools [V].
            given: Pressures of supply and tank where they are measured, else nothing.
        """
        taken = iter(numbers)

        def row(names: Sequence[str]) -> dict[str, Number]:
            return {name: next(taken) for name in names}

        common = row(_COMMON)
        rows = [list(islice(taken, WIDTH)) for _ in self._parts]
        second = [row(SPOOL) if valve.spool_b else {} for _, valve, _ in self._parts]
        pump_rows = {name: row(_PUMP) for name in self.pumps}
        ample = {name: next(taken) for name in self._ample}
        engine = row(_ENGINE) if self._engine is not None else {}
        lines = {name: next(taken) for name in self.hydraulics.lines}
        gases = {name: row(_ACCUMULATOR) for name in self.hydraulics.accumulators}
        others = {name: row(_ELEMENT) for name in self.hydraulics.elements}
        own = {name: state[i] for i, name in enumerate(self.states)}
        supply, tank = common["pump"], common["tank"]
        if self.measured:
            supply, tank = given
        pressures: dict[str, Number] = {TANK: tank, MAIN: supply}
        pressures |= ample
        for name in (*self.pumps, *lines, *gases):
            pressures[name] = common["vapour"] + maximum(own[f"pressure_{name}"], 0.0)
        functions: list[DrivenCylinder] = []
        spools: list[Number] = []
        moved: list[list[Number]] = []
        reaching = iter(signals)
        for i, (cylinder, valve, _) in enumerate(self._parts):
            parts = dict(zip(FIELDS, rows[i], strict=False)), second[i]
            both = [
                spool_of(name, spool, part, own, next(reaching))
                for part, (name, spool) in zip(parts, valve.spools.items(), strict=False)
            ]
            here = [u for u, _ in both]
            spools += here
            moved.append([x for _, rate in both for x in rate])
            mine = state[self.starts[i] : self.ends[i]]
            functions.append(
                DrivenCylinder(common, rows[i], cylinder, valve, here, second[i], x[i], v[i], mine)
            )
            pressures |= functions[i].nodes
        fed = {name: [one for one in functions if one.valve.supply == name] for name in pressures}
        loads = {
            name: highest([one.sensed(tank) for one in functions])
            for name, functions in fed.items()
            if functions and self._senses(name, functions)
        }
        opened = {one.joint: one.opened for one in functions}
        loads = joined(self.hydraulics.elements.values(), loads, tank, opened)
        books = Books(pressures)
        for name, element in self.hydraulics.elements.items():
            books.enter([flow_of(name, element, others[name], pressures, opened)])
        rates: list[Number] = []
        stored: dict[str, Number] = {}
        oil: Number = 0.0
        heat: Number = 0.0
        chambers: list[tuple[Chamber, Chamber]] = []
        for one, rate in zip(functions, moved, strict=True):
            backs = [pressures[one.valve.return_a], pressures[one.valve.return_b]]
            load = loads.get(one.valve.supply, tank)
            supplied = pressures[one.valve.supply]
            left = self._left(one, fed[one.valve.supply], supplied, tank)
            through = one.flows(supplied, backs, load, left)
            through += one.around(tank)
            books.enter(through)
            hoses = nets_of((x for x in through if x.through not in INSIDE), one.nodes)
            pair = [
                one.chamber(side, hoses[node], books.nets[node])
                for side, node in enumerate(one.nodes)
            ]
            chambers.append((pair[0], pair[1]))
            rates += [*(side.slope for side in pair), *one.spring_rate, *rate]
            for node, side in zip(one.nodes, pair, strict=True):
                stored[node] = side.pressure * side.net
                oil = oil + side.net
            if one.spring_rate:
                stored[f"{one.joint}.spring"] = one.spring_power
                oil, heat = oil + one.spring_flow, heat + one.damped
        speed: Number = own["engine"] if self._engine is not None else 1.0
        pumps = {
            name: Pump(
                name, pump, pump_rows[name], pressures, loads.get(name, tank),
                self._limiting(name, pressures, pump_rows), fed[name], speed,
                own.get(f"share_{name}"), own.get(f"load_{name}"),
            )
            for name, pump in self.pumps.items()
        }  # fmt: skip
        for pump in pumps.values():
            books.enter(pump.flows)
        for name in self.hydraulics.sources:
            if name not in pumps:  # that keeps its pressure whatever is drawn
                books.enter([Flow(TANK, name, -books.nets[name], "pump")])
        for name in (*pumps, *lines):
            soft, net = pump_rows[name]["line"] if name in pumps else lines[name], books.nets[name]
            if self.hydraulics.oil.air > 0:
                free = common["air"] * soft / common["oil"]
                soft = soft + bubbles(common, free, pressures[name])
            rates += [net / soft, *(pumps[name].rates if name in pumps else ())]
            stored[name], oil = pressures[name] * net, oil + net
        for name, gas in gases.items():
            net = books.nets[name]
            slopes, cooled = gas_of(gas, pressures[name], net, own.get(f"oil_{name}"))
            rates += slopes
            stored[name], oil = pressures[name] * net - cooled, oil + net
            heat = heat + cooled
        if self._engine is not None:
            turned: Number = 0.0
            for pump in pumps.values():
                turned = turned + pump.torque
            share = clipped((1.0 + engine["droop"] - speed) * engine["per_droop"], 0.0, 1.0)
            left = engine["torque"] * share - turned / engine["speed"]
            rates.append(left * engine["per_inertia"])
        kept: Number = 0.0
        for power in stored.values():
            kept = kept + power
        work = books.work - tank * books.returned
        rates += [books.pumped, books.returned, oil, work, books.lost + heat, kept]
        return Instant(
            [one.force for one in functions], [one.grip(tank) for one in functions], rates,
            spools, chambers, pressures[MAIN], tank,
            pressures, books.flows, pumps, speed, stored,
            {one.joint: one.damped for one in functions if one.spring_rate},
        )  # fmt: skip

    def _senses(self, name: str, functions: Sequence[DrivenCylinder]) -> bool:
        """Whether somebody asks for the highest load of a pump's valves."""
        pump = self.hydraulics.sources.get(name)
        return any(one.valve.sharing for one in functions) or (
            pump is not None and pump.control == "load-sensing"
        )

    def _left(
        self, one: DrivenCylinder, beside: Sequence[DrivenCylinder], supply: Number, tank: Number
    ) -> Number:
        """Share of its flow that valves of priority leave to a valve; see `Valve`."""
        first = [x.missing(supply, tank) for x in beside if x.valve.priority]
        if not first or one.valve.priority:
            return 1.0
        return clipped(1.0 - highest(first), 0.0, 1.0)

    def _limiting(
        self, name: str, pressures: dict[str, Number], rows: dict[str, dict[str, Number]]
    ) -> Number:
        """Pressure that a pump's power is divided by, see `Supply` [Pa]."""
        names = self.pumps[name].summed
        if len(names) < 2:
            return pressures[names[0] if names else name]
        total: Number = 0.0
        weighted: Number = 0.0
        for other in names:
            power: Number = self.hydraulics.sources[other].power
            if other in rows:  # else its pressure is measured
                power = rows[other]["power"]
            total = total + power
            weighted = weighted + power * pressures[other]
        return weighted / total
