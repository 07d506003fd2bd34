"""Equations of a circuit: pressures of its nodes, flows between them, balances and powers."""

from collections.abc import Sequence

from crane.codegen.symbolic import Scalar, SymbolicExpression, dot, maximum
from crane.hydraulics.circuit_elements import MAIN_PUMP, TANK_NODE
from crane.hydraulics.circuit_states import CircuitStates
from crane.hydraulics.flow_equations import (
    Flow,
    FlowBalance,
    accumulator_equations,
    clip,
    element_flow,
    gas_compliance,
    largest_of,
    merged_load_pressures,
    net_inflows_of,
)
from crane.hydraulics.pump_equations import PumpEquations
from crane.hydraulics.valve_cylinder_equations import (
    INTERNAL_FLOWS,
    ChamberValues,
    ValveCylinderEquations,
    spool_equations,
)


class CircuitEquations(CircuitStates):
    """Equations of one circuit; see `CircuitStates` for arguments and attributes."""

    def evaluate(
        self,
        constants: Sequence[Scalar],
        x: Sequence[Scalar],
        v: Sequence[Scalar],
        state: Sequence[Scalar],
        signals: Sequence[Scalar],
        measured_pressures: Sequence[Scalar],
    ) -> "CircuitValues":
        """The circuit at an instant; all arguments are floats or formulas.

        Args:
            constants: Values of `constants`.
            x: (m,) coordinates above the lower limits [m], [rad].
            v: (m,) velocities [m/s], [rad/s].
            state: (state_count,).
            signals: (s,) signals at the spools [V].
            measured_pressures: Pressures of main pump and tank where they are inputs, else empty.
        """
        return CircuitValues(self, constants, x, v, state, signals, measured_pressures)


class CircuitValues:
    """A circuit at an instant; see `CircuitEquations.evaluate` for the arguments.

    Attributes:
        forces: (m,) cylinder forces, F = area_a p_A - area_b p_B, equation (20) [N], [N m].
        circuit_friction: (m,) Coulomb friction that the cylinders add to their joints [N], [N m].
        state_rates: (state_count,) rates of the states.
        spool_positions: (s,) positions u.
        chambers: (m,) pairs A, B.
        supply_pressure: Pressure of the main pump [Pa].
        tank_pressure: Pressure of the tank [Pa].
        pressures: Pressures of all nodes [Pa].
        flows: Flows between the nodes.
        pumps: Pumps with limited flow, by node.
        engine_speed_ratio: Speed of the engine over its set speed.
        stored_power: Power stored in each node, and in the series spring of JOINT as JOINT.spring
            [W].
        damper_power: Power dissipated by the dampers of series springs, by joint [W].
    """

    def __init__(
        self,
        circuit: CircuitStates,
        constants: Sequence[Scalar],
        x: Sequence[Scalar],
        v: Sequence[Scalar],
        state: Sequence[Scalar],
        signals: Sequence[Scalar],
        measured_pressures: Sequence[Scalar],
    ):
        self._circuit, self._constants = circuit, circuit.split_constants(constants)
        self._states = dict(zip(circuit.state_units, state, strict=False))
        common = self._constants.common
        supply, tank = common["pump"], common["tank"]
        if circuit.has_measured_pressures:
            supply, tank = measured_pressures
        self.tank_pressure = tank
        self.pressures: dict[str, Scalar] = {TANK_NODE: tank, MAIN_PUMP: supply}
        self.pressures |= self._constants.unlimited_pressures
        for name in (*circuit.pumps, *self._constants.lines, *self._constants.accumulators):
            self.pressures[name] = common["vapour"] + maximum(
                self._states[f"pressure_{name}"], 0.0
            )
        self.supply_pressure = self.pressures[MAIN_PUMP]
        self.spool_positions: list[Scalar] = []
        self._spool_rates: list[list[Scalar]] = []
        self._cylinders = self._cylinder_equations(x, v, state, signals)
        self.forces = [cylinder.force for cylinder in self._cylinders]
        self.circuit_friction = [cylinder.circuit_friction(tank) for cylinder in self._cylinders]
        self.damper_power = {x.joint: x.damper_power for x in self._cylinders if x.spring_rate}
        self.engine_speed_ratio = self._states.get("engine", 1.0)
        self._balance = FlowBalance(self.pressures)
        self.flows = self._balance.flows
        self.state_rates: list[Scalar] = []
        self.stored_power: dict[str, Scalar] = {}
        self._oil_rate: Scalar = 0.0
        self._heat: Scalar = 0.0
        self._cylinders_by_supply = {
            name: [x for x in self._cylinders if x.valve.supply == name] for name in self.pressures
        }
        openings = {cylinder.joint: cylinder.requested_openings for cylinder in self._cylinders}
        elements, pumps = circuit.hydraulics.elements, circuit.hydraulics.pumps
        # of the pumps whose regulator or valves use them
        loads = {
            name: largest_of([x.sensed_load_pressure(tank) for x in cylinders])
            for name, cylinders in self._cylinders_by_supply.items()
            if any(x.valve.sharing for x in cylinders)
            or (cylinders and name in pumps and pumps[name].control == "load-sensing")
        }
        loads = merged_load_pressures(elements.values(), loads, tank, openings)
        for name, element in elements.items():
            constants_of_element = self._constants.elements[name]
            flow = element_flow(name, element, constants_of_element, self.pressures, openings)
            self._balance.add_flows([flow])
        self.chambers = [
            self._add_cylinder(cylinder, rates, loads)
            for cylinder, rates in zip(self._cylinders, self._spool_rates, strict=True)
        ]
        self.pumps = self._add_pumps(loads)
        for name in (*self.pumps, *self._constants.lines):
            self._add_line(name)
        for name in self._constants.accumulators:
            self._add_accumulator(name)
        if circuit.engine is not None:
            engine = self._constants.engine
            pump_torque = sum((pump.torque for pump in self.pumps.values()), 0.0)
            droop = (1.0 + engine["droop"] - self.engine_speed_ratio) * engine["per_droop"]
            torque = engine["torque"] * clip(droop, 0.0, 1.0) - pump_torque / engine["speed"]
            self.state_rates.append(torque * engine["per_inertia"])
        self.state_rates += [
            self._balance.pumped_flow,
            self._balance.returned_flow,
            self._oil_rate,
            self._balance.pump_power - tank * self._balance.returned_flow,
            self._balance.lost_power + self._heat,
            sum(self.stored_power.values(), 0.0),
        ]  # of `BALANCE_UNITS`

    def _cylinder_equations(
        self,
        x: Sequence[Scalar],
        v: Sequence[Scalar],
        state: Sequence[Scalar],
        signals: Sequence[Scalar],
    ) -> list[ValveCylinderEquations]:
        """Cylinders, with positions and rates of their spools; adds pressures of chambers."""
        cylinders: list[ValveCylinderEquations] = []
        circuit, remaining_signals = self._circuit, iter(signals)
        for i, (cylinder, valve, _) in enumerate(circuit.cylinders_and_valves):
            constants = self._constants.cylinders[i], self._constants.second_spools[i]
            spools = [
                spool_equations(name, spool, part, self._states, next(remaining_signals))
                for part, (name, spool) in zip(constants, valve.spools.items(), strict=False)
            ]
            positions = [u for u, _ in spools]
            self.spool_positions += positions
            self._spool_rates.append([rate for _, rates in spools for rate in rates])
            own_states = slice(circuit.cylinder_state_starts[i], circuit.cylinder_state_ends[i])
            cylinders.append(
                ValveCylinderEquations(
                    self._constants.common, constants[0], cylinder, valve, positions, constants[1],
                    x[i], v[i], state[own_states],
                )
            )  # fmt: skip
            self.pressures |= cylinders[i].pressures_by_node
        return cylinders

    def _add_cylinder(
        self,
        cylinder: ValveCylinderEquations,
        spool_rates: Sequence[Scalar],
        loads: dict[str, Scalar],
    ) -> tuple[ChamberValues, ChamberValues]:
        """Add flows and state rates of a cylinder.

        Returns:
            Its chambers.
        """
        valve, tank, balance = cylinder.valve, self.tank_pressure, self._balance
        supply = self.pressures[valve.supply]
        shortages = [
            x.relative_shortage(supply, tank)
            for x in self._cylinders_by_supply[valve.supply]
            if x.valve.priority and not valve.priority
        ]
        priority_share = clip(1.0 - largest_of(shortages), 0.0, 1.0) if shortages else 1.0
        return_pressures = [self.pressures[valve.return_a], self.pressures[valve.return_b]]
        load = loads.get(valve.supply, tank)
        flows = cylinder.flows(supply, return_pressures, tank, load, priority_share)
        balance.add_flows(flows)
        nodes = list(cylinder.pressures_by_node)
        hose_flows = net_inflows_of((x for x in flows if x.path not in INTERNAL_FLOWS), nodes)
        a, b = (
            cylinder.chamber_values(side, hose_flows[node], balance.net_inflows[node])
            for side, node in enumerate(nodes)
        )
        self.state_rates += [a.chamber_pressure_rates, b.chamber_pressure_rates]
        self.state_rates += [*cylinder.spring_rate, *spool_rates]
        for node, chamber in zip(nodes, (a, b), strict=True):
            self._store(node, chamber.pressure * chamber.net_inflow, chamber.net_inflow)
        if cylinder.spring_rate:
            self._store(f"{cylinder.joint}.spring", cylinder.spring_power, cylinder.spring_flow)
            self._heat = self._heat + cylinder.damper_power
        return a, b

    def _store(self, name: str, power: Scalar, flow: Scalar) -> None:
        """Add power [W] and oil [m3/s] that a node or spring stores."""
        self.stored_power[name], self._oil_rate = power, self._oil_rate + flow

    def _add_pumps(self, loads: dict[str, Scalar]) -> dict[str, PumpEquations]:
        """Add flows of all pumps.

        Returns:
            The pumps with limited flow.
        """
        pumps = {
            name: PumpEquations(
                name,
                pump,
                self._constants.pumps[name],
                self.pressures,
                loads.get(name, self.tank_pressure),
                self._power_limiting_pressure(name),
                self._cylinders_by_supply[name],
                self.engine_speed_ratio,
                self._states.get(f"share_{name}"),
                self._states.get(f"load_{name}"),
            )
            for name, pump in self._circuit.pumps.items()
        }
        for pump in pumps.values():
            self._balance.add_flows(pump.flows)
        for name in self._circuit.hydraulics.pumps:
            if name not in pumps:  # it keeps its pressure at any flow
                self._balance.add_flows(
                    [Flow(TANK_NODE, name, -self._balance.net_inflows[name], "pump")]
                )
        return pumps

    def _power_limiting_pressure(self, name: str) -> Scalar:
        """Pressure that determines the power limit of a pump, see `Supply` [Pa]."""
        pumps = self._circuit.hydraulics.pumps
        names = pumps[name].summed or (name,)
        if len(names) == 1:
            return self.pressures[names[0]]
        # the pressure of a pump without constants is measured
        limited = self._constants.pumps
        powers = [limited[x]["power"] if x in limited else pumps[x].power for x in names]
        return dot(powers, [self.pressures[x] for x in names]) / sum(powers, 0.0)

    def _add_line(self, name: str) -> None:
        """Add the state rates of a line or of a pump with its line."""
        common, net = self._constants.common, self._balance.net_inflows[name]
        is_pump = name in self.pumps
        compliance = (
            self._constants.pumps[name]["line"] if is_pump else self._constants.lines[name]
        )
        if self._circuit.hydraulics.oil.air > 0:
            free_air = common["air"] * compliance / common["oil"]
            compliance = compliance + gas_compliance(common, free_air, self.pressures[name])
        self.state_rates.append(net / compliance)
        self.state_rates += self.pumps[name].state_rates if is_pump else []
        self._store(name, self.pressures[name] * net, net)

    def _add_accumulator(self, name: str) -> None:
        """Add the state rates of an accumulator."""
        p, net = self.pressures[name], self._balance.net_inflows[name]
        rates, cooling_power = accumulator_equations(
            self._constants.accumulators[name], p, net, self._states.get(f"oil_{name}")
        )
        self.state_rates += rates
        self._store(name, p * net - cooling_power, net)
        self._heat = self._heat + cooling_power


SHAFT_POWER, ROD_POWER = "shaft", "rod"
STORED_POWERS = ("stored", "spring")
_MERGED_PATHS = {"piston": "leak", "cross": "relief"}  # flows that are added to others


def component_powers(
    circuit: CircuitEquations, values: CircuitValues, v: Sequence[Scalar]
) -> dict[str, Scalar]:
    """Power [W] of every component as `COMPONENT.KIND`, see `PowerBalance`.

    With Q the flow from a node of pressure p_1 to one of p_2, and F the force of a cylinder, the
    powers are

        throttles Q (p_1 - p_2),    nodes p_i sum of their Q,    rods F v.

    The tank is a node like the others. The power of the shafts is the sum of all other powers.

    Args:
        circuit: The circuit.
        values: Its values at the instant.
        v: (m,) velocities of its joints [m/s], [rad/s].
    """
    powers: dict[str, Scalar] = {}
    p, parts = values.pressures, circuit.hydraulics
    joints = {f"{joint}.{side}": joint for joint in circuit.joints for side in "ab"}

    def add(owner: str, what: str, power: Scalar) -> None:
        if isinstance(power, SymbolicExpression) or power != 0:
            name = f"{owner}.{what}"
            powers[name] = powers.get(name, 0.0) + power

    for name, pump in values.pumps.items():
        add(name, SHAFT_POWER, pump.shaft_power)
        add(name, "friction", pump.lost_power)
    for flow in values.flows:
        lost = flow.rate * (p[flow.source] - p[flow.target])
        element = parts.elements.get(flow.path)
        if flow.path == "pump":
            if flow.target not in values.pumps:
                add(flow.target, SHAFT_POWER, -1.0 * lost)
        elif element and (element.source, element.target) == flow[:2]:
            add(flow.path, "element", lost)
        else:
            owner = joints.get(flow.target) or joints.get(flow.source) or flow.source
            if flow.metering_drop is not None:
                metering_power = flow.rate * flow.metering_drop
                add(owner, "compensator", lost - metering_power)
                lost = metering_power
            add(owner, _MERGED_PATHS.get(flow.path, flow.path), lost)
    for name, damped in values.damper_power.items():
        add(name, "damper", damped)
    for name, force, speed in zip(circuit.joints, values.forces, v, strict=True):
        add(name, ROD_POWER, force * speed)
    net_inflows = net_inflows_of(values.flows, p)
    for name, power in values.stored_power.items():
        if name in joints:
            add(joints[name], "stored", power)
        elif name.endswith(".spring"):
            add(name.removesuffix(".spring"), "spring", power)
        else:
            add(name, "stored", power)
        if name in parts.accumulators:
            add(name, "cooling", p[name] * net_inflows[name] - power)
    add(TANK_NODE, "stored", p[TANK_NODE] * net_inflows[TANK_NODE])
    return powers
