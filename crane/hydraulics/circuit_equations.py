"""A circuit as formulas: nodes with pressures, what flows between them, and what balances."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from crane.codegen import Scalar, maximum
from crane.common.samples import Array
from crane.hydraulics.circuit_elements import Accumulator
from crane.hydraulics.components import Hydraulics
from crane.hydraulics.flow_balance import FlowBalance, net_inflows_of
from crane.hydraulics.node_equations import (
    accumulator_equations,
    element_flow,
    gas_compliance,
    largest_of,
    merged_load_pressures,
)
from crane.hydraulics.orifice_flow import Flow, clip
from crane.hydraulics.pump_equations import PumpEquations
from crane.hydraulics.supply_and_engine import MAIN_PUMP, TANK_NODE, Engine, Supply
from crane.hydraulics.valve_cylinder_equations import (
    CYLINDER_CONSTANT_COUNT,
    CYLINDER_CONSTANTS,
    INTERNAL_FLOWS,
    SPOOL_CONSTANTS,
    ChamberValues,
    ValveCylinderEquations,
    cylinder_constants,
    spool_constants,
    spool_equations,
)

_PRESSURE_ACCURACY, _OIL_VOLUME_ACCURACY = 1.0, 5e-13  # accuracy that matters [Pa], [m3]
# Integrals that balance: pumped = returned + stored + volume that the joints sweep, and
# pump_work = work of the cylinders + hydraulic_loss + oil_energy. What series springs give way is
# stored, too.
BALANCE_UNITS = {
    "oil_pumped": "m3", "oil_returned": "m3", "oil_stored": "m3",
    "pump_work": "J", "hydraulic_loss": "J", "oil_energy": "J",
}  # fmt: skip
_COMMON_CONSTANTS = ("oil", "hose", "steel", "vapour", "gas_power", "air", "pump", "tank")
_PUMP_CONSTANTS = (
    "pressure", "flow", "per_droop", "line", "margin", "standby", "signal", "throttle", "least",
    "per_response", "per_sensing", "power", "relief", "relief_gain", "slip", "friction", "drag",
)  # fmt: skip
_ENGINE_CONSTANTS = ("speed", "torque", "per_droop", "droop", "per_inertia")
_ACCUMULATOR_CONSTANTS = ("line", "volume", "precharge", "exponent", "per_time")
_ELEMENT_CONSTANTS = ("coefficient", "gain", "pressure")


@dataclass
class CircuitValues:
    """The circuit at an instant.

    Attributes:
        forces: (m,) of the cylinders, F = area_a p_A - area_b p_B, equation (20) [N], [N m].
        circuit_friction: (m,) Coulomb friction that they add to that of their joints [N], [N m].
        state_rates: (k,) of the states.
        spool_positions: (s,) positions u.
        chambers: (m,) pairs A, B.
        supply_pressure: Pressure [Pa].
        tank_pressure: Pressure [Pa].
        pressures: Of all nodes [Pa].
        flows: All between nodes.
        pumps: By node.
        engine_speed_ratio: Of the engine over its set speed.
        stored_power: Power that goes into each node, and into the series spring of JOINT as
            JOINT.spring [W].
        damper_power: What dampers of series springs turn into heat, by joint [W].
    """

    forces: list[Scalar]
    circuit_friction: list[Scalar]
    state_rates: list[Scalar]
    spool_positions: list[Scalar]
    chambers: list[tuple[ChamberValues, ChamberValues]]
    supply_pressure: Scalar
    tank_pressure: Scalar
    pressures: dict[str, Scalar]
    flows: list[Flow]
    pumps: dict[str, PumpEquations]
    engine_speed_ratio: Scalar
    stored_power: dict[str, Scalar]
    damper_power: dict[str, Scalar]


class CircuitEquations:
    """The formulas of one circuit: nodes with pressures, and what flows between them.

    States per cylinder: those of the pressures in A and B, the compression of the series spring
    if there is one, per spool the signal behind its play, position and rate if these are;
    then per pump that of its line's pressure if its flow is limited, of its displacement and of
    the load that it senses if these take time; per line and accumulator that of its pressure, and
    the oil in it if heat leaves its gas; the engine's speed; then `BALANCE_UNITS`.

    The state of a pressure is p - p_vapour where that is positive. Below zero the chamber holds
    vapour at p_vapour, of the volume that the state's size times a constant compressibility says:
    the pressure cannot fall below that of vapour, and comes back when the void is filled.

    Args:
        hydraulics: The circuit.
        strokes: (m,) distance between the limits of each joint [m], [rad].
        has_measured_pressures: Whether pressures of (the first) pump and tank are given from
            outside.

    Attributes:
        joints: Those driven, in order.
        spool_names: (s,) names of the valves' signals, see `Hydraulics.spool_names`.
        constants: Of the circuit, as the formulas read them.
        stiff_state_count: Number of states that need an implicit method; the others are integrals.
        state_count: Number of all states.
        state_units: Names and units of the stiff ones, pressures counting from that of vapour.
        cylinder_state_starts: (m,) where the states of each cylinder begin, with the pressures of
            A and B.
        scales: (size,) accuracy that matters in each state.
        limited_pumps: Those whose flow is limited, by node.
        cylinder_state_ends: (m,) where the states of each cylinder end.
    """

    def __init__(
        self,
        hydraulics: Hydraulics,
        strokes: Sequence[float],
        has_measured_pressures: bool = False,
    ):
        self.hydraulics, self.joints = hydraulics, hydraulics.joints
        self.spools = tuple(hydraulics.spools)
        self.has_measured_pressures = has_measured_pressures
        self.pumps = {
            name: pump
            for name, pump in hydraulics.pumps.items()
            if pump.flow > 0 and not (has_measured_pressures and name == MAIN_PUMP)
        }
        self._unlimited_pumps = {
            x: y for x, y in hydraulics.supplies.items() if x not in self.pumps
        }
        self._cylinders_and_valves = [
            (cylinder, valve, 0.0 if cylinder.motor else stroke)
            for cylinder, valve, stroke in zip(
                hydraulics.cylinders.values(), hydraulics.valves.values(), strokes, strict=True
            )
        ]
        self._engine = hydraulics.engine if self.pumps else None
        rows = [
            self._common_constants(),
            *(cylinder_constants(*part) for part in self._cylinders_and_valves),
            *(
                spool_constants(valve.spool_b)
                for _, valve, _ in self._cylinders_and_valves
                if valve.spool_b
            ),
            *(self._pump_constants(pump) for pump in self.pumps.values()),
            *([pump.pressure] for pump in self._unlimited_pumps.values()),
            *([self._engine_constants(self._engine)] if self._engine else []),
            *([line.volume / hydraulics.oil.bulk_modulus] for line in hydraulics.lines.values()),
            *(self._accumulator_constants(item) for item in hydraulics.accumulators.values()),
            *([x.coefficient, x.gain, x.pressure] for x in hydraulics.elements.values()),
        ]
        self.constants = np.array([x for row in rows for x in row])
        self.state_units: dict[str, str] = {}
        scales: list[float] = []
        modulus = hydraulics.oil.bulk_modulus

        def add(name: str, unit: str, scale: float) -> None:
            self.state_units[name] = unit
            scales.append(scale)

        def pressure(name: str, volume: float) -> None:
            add(
                f"pressure_{name}",
                "Pa",
                max(_PRESSURE_ACCURACY, modulus * _OIL_VOLUME_ACCURACY / volume),
            )

        self.cylinder_state_starts: list[int] = []
        for cylinder, valve, stroke in self._cylinders_and_valves:
            joint = cylinder.joint
            self.cylinder_state_starts.append(len(scales))
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
        self.cylinder_state_ends = [*self.cylinder_state_starts[1:], len(scales)]
        for name, pump in self.pumps.items():
            pressure(name, pump.volume)
            if pump.response > 0:
                add(f"share_{name}", "", 1e-7)
            if pump.sensing_time > 0:
                add(f"load_{name}", "Pa", _PRESSURE_ACCURACY)
        for name, line in hydraulics.lines.items():
            pressure(name, line.volume)
        for name, item in hydraulics.accumulators.items():
            pressure(name, item.volume)
            if item.time_constant > 0:
                add(f"oil_{name}", "m3", 1e-9 * item.volume)
        if self._engine is not None:
            add("engine", "", 1e-7)
        self.stiff_state_count = len(scales)
        self.state_count = self.stiff_state_count + len(BALANCE_UNITS)
        self.scales = np.array(scales + [np.inf] * len(BALANCE_UNITS))
        self._state_indices = {name: i for i, name in enumerate(self.state_units)}

    def _common_constants(self) -> list[float]:
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

    def _pump_constants(self, pump: Supply) -> list[float]:
        modulus = self.hydraulics.oil.bulk_modulus
        return [
            pump.pressure, pump.flow, 1.0 / pump.droop, pump.volume / modulus,
            pump.margin, pump.standby, pump.signal, pump.throttle,
            pump.least, 1.0 / pump.response if pump.response else 0.0,
            1.0 / pump.sensing_time if pump.sensing_time else 0.0, pump.power, pump.relief,
            pump.relief_gain, pump.slip, pump.friction, pump.drag,
        ]  # fmt: skip

    def _engine_constants(self, engine: Engine) -> list[float]:
        relative_droop = engine.speed_droop / engine.speed
        return [
            engine.speed,
            engine.torque,
            1.0 / relative_droop,
            relative_droop,
            1.0 / (engine.inertia * engine.speed),
        ]

    def _accumulator_constants(self, accumulator: Accumulator) -> list[float]:
        per_time = 1.0 / accumulator.time_constant if accumulator.time_constant else 0.0
        line = accumulator.line / self.hydraulics.oil.bulk_modulus
        return [line, accumulator.volume, accumulator.precharge, accumulator.exponent, per_time]

    def initial_state(
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
        state = np.zeros(self.state_count)
        tank_pressure, vapour = tank, self.hydraulics.oil.vapour_pressure
        for i, (cylinder, _, _) in enumerate(self._cylinders_and_valves):
            carried_force = forces[i] - tank_pressure * (cylinder.area_a - cylinder.area_b)
            a = tank_pressure + max(carried_force, 0.0) / cylinder.area_a
            b = tank_pressure + max(-carried_force, 0.0) / cylinder.area_b
            a, b = pressures.get(cylinder.joint, (a, b))
            first = self.cylinder_state_starts[i]
            state[first : first + 2] = max(a - vapour, 0.0), max(b - vapour, 0.0)
            if cylinder.stiffness > 0:
                force = cylinder.area_a * a - cylinder.area_b * b
                state[first + 2] = force / cylinder.stiffness
        for signal, (joint, spool) in zip(signals, self.hydraulics.spools.items(), strict=True):
            u = (signal - spool.neutral) / (spool.full - spool.neutral)
            for name in (f"play_{joint}", f"spool_{joint}"):
                if name in self._state_indices:
                    state[self._state_indices[name]] = np.clip(u, -1.0, 1.0)
        for name, pump in self.pumps.items():
            state[self._state_indices[f"pressure_{name}"]] = pump.idle_pressure(tank) - vapour
            if pump.response > 0:
                state[self._state_indices[f"share_{name}"]] = pump.least
            if pump.sensing_time > 0:
                state[self._state_indices[f"load_{name}"]] = tank
        for name, line in self.hydraulics.lines.items():
            state[self._state_indices[f"pressure_{name}"]] = (line.pressure or tank) - vapour
        for name, item in self.hydraulics.accumulators.items():
            p = item.pressure or item.precharge
            state[self._state_indices[f"pressure_{name}"]] = p - vapour
            if item.time_constant > 0:
                oil = item.volume * (1.0 - item.precharge / max(p, item.precharge))
                state[self._state_indices[f"oil_{name}"]] = oil
        if self._engine is not None:
            state[self._state_indices["engine"]] = (
                1.0 + self._engine.speed_droop / self._engine.speed
            )
        return state

    def evaluate(
        self,
        constants: Sequence[Scalar],
        x: Sequence[Scalar],
        v: Sequence[Scalar],
        state: Sequence[Scalar],
        signals: Sequence[Scalar],
        measured_pressures: Sequence[Scalar],
    ) -> CircuitValues:
        """The circuit at an instant.

        Args:
            constants: `constants`, as floats or traced.
            x: (m,) coordinates above the lower limits [m], [rad].
            v: (m,) velocities [m/s], [rad/s].
            state: (size,).
            signals: (s,) that reach the spools [V].
            measured_pressures: Pressures of supply and tank where they are measured, else nothing.
        """
        remaining_constants = iter(constants)

        def row(names: Sequence[str]) -> dict[str, Scalar]:
            return {name: next(remaining_constants) for name in names}

        common = row(_COMMON_CONSTANTS)
        rows = [
            list(islice(remaining_constants, CYLINDER_CONSTANT_COUNT))
            for _ in self._cylinders_and_valves
        ]
        second_spools = [
            row(SPOOL_CONSTANTS) if valve.spool_b else {}
            for _, valve, _ in self._cylinders_and_valves
        ]
        pump_rows = {name: row(_PUMP_CONSTANTS) for name in self.pumps}
        unlimited_pressures = {name: next(remaining_constants) for name in self._unlimited_pumps}
        engine = row(_ENGINE_CONSTANTS) if self._engine is not None else {}
        lines = {name: next(remaining_constants) for name in self.hydraulics.lines}
        accumulators = {name: row(_ACCUMULATOR_CONSTANTS) for name in self.hydraulics.accumulators}
        element_constants = {name: row(_ELEMENT_CONSTANTS) for name in self.hydraulics.elements}
        states = {name: state[i] for i, name in enumerate(self.state_units)}
        supply, tank = common["pump"], common["tank"]
        if self.has_measured_pressures:
            supply, tank = measured_pressures
        pressures: dict[str, Scalar] = {TANK_NODE: tank, MAIN_PUMP: supply}
        pressures |= unlimited_pressures
        for name in (*self.pumps, *lines, *accumulators):
            pressures[name] = common["vapour"] + maximum(states[f"pressure_{name}"], 0.0)
        cylinders: list[ValveCylinderEquations] = []
        spool_names: list[Scalar] = []
        spool_rates: list[list[Scalar]] = []
        remaining_signals = iter(signals)
        for i, (cylinder, valve, _) in enumerate(self._cylinders_and_valves):
            parts = dict(zip(CYLINDER_CONSTANTS, rows[i], strict=False)), second_spools[i]
            positions_and_rates = [
                spool_equations(name, spool, part, states, next(remaining_signals))
                for part, (name, spool) in zip(parts, valve.spools.items(), strict=False)
            ]
            positions = [u for u, _ in positions_and_rates]
            spool_names += positions
            spool_rates.append([x for _, rate in positions_and_rates for x in rate])
            cylinder_states = state[self.cylinder_state_starts[i] : self.cylinder_state_ends[i]]
            cylinders.append(
                ValveCylinderEquations(
                    common,
                    rows[i],
                    cylinder,
                    valve,
                    positions,
                    second_spools[i],
                    x[i],
                    v[i],
                    cylinder_states,
                )
            )
            pressures |= cylinders[i].pressures_by_node
        cylinders_by_supply = {
            name: [one for one in cylinders if one.valve.supply == name] for name in pressures
        }
        loads = {
            name: largest_of([one.sensed_load_pressure(tank) for one in functions])
            for name, functions in cylinders_by_supply.items()
            if functions and self._needs_load_pressure(name, functions)
        }
        openings = {one.joint: one.inlet_openings for one in cylinders}
        loads = merged_load_pressures(self.hydraulics.elements.values(), loads, tank, openings)
        balance = FlowBalance(pressures)
        for name, element in self.hydraulics.elements.items():
            balance.add_flows(
                [element_flow(name, element, element_constants[name], pressures, openings)]
            )
        state_rates: list[Scalar] = []
        stored_power: dict[str, Scalar] = {}
        oil: Scalar = 0.0
        heat: Scalar = 0.0
        chambers: list[tuple[ChamberValues, ChamberValues]] = []
        for equations, rate in zip(cylinders, spool_rates, strict=True):
            return_pressures = [
                pressures[equations.valve.return_a],
                pressures[equations.valve.return_b],
            ]
            load = loads.get(equations.valve.supply, tank)
            supply_pressure = pressures[equations.valve.supply]
            priority_share = self._priority_share(
                equations, cylinders_by_supply[equations.valve.supply], supply_pressure, tank
            )
            cylinder_flows = equations.flows(
                supply_pressure, return_pressures, load, priority_share
            )
            cylinder_flows += equations.leak_and_relief_flows(tank)
            balance.add_flows(cylinder_flows)
            hose_flows = net_inflows_of(
                (x for x in cylinder_flows if x.path not in INTERNAL_FLOWS),
                equations.pressures_by_node,
            )
            pair = [
                equations.chamber_values(side, hose_flows[node], balance.net_inflows[node])
                for side, node in enumerate(equations.pressures_by_node)
            ]
            chambers.append((pair[0], pair[1]))
            state_rates += [
                *(side.pressure_state_rate for side in pair),
                *equations.spring_rate,
                *rate,
            ]
            for node, side in zip(equations.pressures_by_node, pair, strict=True):
                stored_power[node] = side.pressure * side.net_inflow
                oil = oil + side.net_inflow
            if equations.spring_rate:
                stored_power[f"{equations.joint}.spring"] = equations.spring_power
                oil, heat = oil + equations.spring_flow, heat + equations.damper_power
        speed: Scalar = states["engine"] if self._engine is not None else 1.0
        limited_pumps = {
            name: PumpEquations(
                name,
                pump,
                pump_rows[name],
                pressures,
                loads.get(name, tank),
                self._power_limiting_pressure(name, pressures, pump_rows),
                cylinders_by_supply[name],
                speed,
                states.get(f"share_{name}"),
                states.get(f"load_{name}"),
            )
            for name, pump in self.pumps.items()
        }
        for pump in limited_pumps.values():
            balance.add_flows(pump.flows)
        for name in self.hydraulics.pumps:
            if name not in limited_pumps:  # that keeps its pressure whatever is drawn
                balance.add_flows([Flow(TANK_NODE, name, -balance.net_inflows[name], "pump")])
        for name in (*limited_pumps, *lines):
            compliance, net = (
                pump_rows[name]["line"] if name in limited_pumps else lines[name],
                balance.net_inflows[name],
            )
            if self.hydraulics.oil.air > 0:
                free = common["air"] * compliance / common["oil"]
                compliance = compliance + gas_compliance(common, free, pressures[name])
            state_rates += [
                net / compliance,
                *(limited_pumps[name].state_rates if name in limited_pumps else ()),
            ]
            stored_power[name], oil = pressures[name] * net, oil + net
        for name, gas in accumulators.items():
            net = balance.net_inflows[name]
            slopes, cooling_power = accumulator_equations(
                gas, pressures[name], net, states.get(f"oil_{name}")
            )
            state_rates += slopes
            stored_power[name], oil = pressures[name] * net - cooling_power, oil + net
            heat = heat + cooling_power
        if self._engine is not None:
            pump_torque: Scalar = 0.0
            for pump in limited_pumps.values():
                pump_torque = pump_torque + pump.torque
            share = clip((1.0 + engine["droop"] - speed) * engine["per_droop"], 0.0, 1.0)
            priority_share = engine["torque"] * share - pump_torque / engine["speed"]
            state_rates.append(priority_share * engine["per_inertia"])
        total_stored_power: Scalar = 0.0
        for power in stored_power.values():
            total_stored_power = total_stored_power + power
        net_pump_power = balance.pump_power - tank * balance.returned_flow
        state_rates += [
            balance.pumped_flow,
            balance.returned_flow,
            oil,
            net_pump_power,
            balance.lost_power + heat,
            total_stored_power,
        ]
        return CircuitValues(
            [one.force for one in cylinders],
            [one.circuit_friction(tank) for one in cylinders],
            state_rates,
            spool_names,
            chambers,
            pressures[MAIN_PUMP],
            tank,
            pressures,
            balance.flows,
            limited_pumps,
            speed,
            stored_power,
            {one.joint: one.damper_power for one in cylinders if one.spring_rate},
        )

    def _needs_load_pressure(self, name: str, cylinders: Sequence[ValveCylinderEquations]) -> bool:
        """Whether somebody asks for the highest load of a pump's valves."""
        pump = self.hydraulics.pumps.get(name)
        return any(one.valve.sharing for one in cylinders) or (
            pump is not None and pump.control == "load-sensing"
        )

    def _priority_share(
        self,
        equations: ValveCylinderEquations,
        cylinders: Sequence[ValveCylinderEquations],
        supply: Scalar,
        tank: Scalar,
    ) -> Scalar:
        """Share of its flow that valves of priority leave to a valve; see `Valve`."""
        shortages = [x.relative_shortage(supply, tank) for x in cylinders if x.valve.priority]
        if not shortages or equations.valve.priority:
            return 1.0
        return clip(1.0 - largest_of(shortages), 0.0, 1.0)

    def _power_limiting_pressure(
        self, name: str, pressures: dict[str, Scalar], pump_constants: dict[str, dict[str, Scalar]]
    ) -> Scalar:
        """Pressure that a pump's power is divided by, see `Supply` [Pa]."""
        names = self.pumps[name].summed
        if len(names) < 2:
            return pressures[names[0] if names else name]
        total: Scalar = 0.0
        weighted: Scalar = 0.0
        for other in names:
            power: Scalar = self.hydraulics.pumps[other].power
            if other in pump_constants:  # else its pressure is measured
                power = pump_constants[other]["power"]
            total = total + power
            weighted = weighted + power * pressures[other]
        return weighted / total
