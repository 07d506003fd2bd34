"""Constants and states of a circuit, and its initial state."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from crane.codegen import Scalar
from crane.codegen.symbolic import maximum, minimum
from crane.hydraulics.circuit_elements import MAIN_PUMP
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.hydraulics.valve_cylinder_equations import (
    cylinder_constants,
    spool_constants,
)

_PRESSURE_ACCURACY, _OIL_VOLUME_ACCURACY = 1.0, 5e-13  # required accuracy [Pa], [m3]
# Integrals that balance: pumped = returned + stored + volume swept by the joints, and
# pump_work = work of the cylinders + hydraulic_loss + oil_energy. Stored oil and energy include
# those by the compression of series springs.
BALANCE_UNITS = {
    "oil_pumped": "m3", "oil_returned": "m3", "oil_stored": "m3",
    "pump_work": "J", "hydraulic_loss": "J", "oil_energy": "J",
}  # fmt: skip

ConstantsByName = dict[str, Scalar]
StateDefinition = tuple[str, str, float]
"""Name, unit and required accuracy of a state."""


class CircuitConstants(NamedTuple):
    """Constants of a circuit by component, floats or formulas.

    Attributes:
        common: Oil, and pressures of main pump and tank.
        cylinders: Per cylinder with its valve, see `cylinder_constants`.
        second_spools: Per cylinder; empty without a second spool.
        pumps: Of the limited pumps, by node.
        unlimited_pressures: Pressures of the other further pumps, by node.
        engine: Of the engine; empty without one.
        lines: Compliance per line.
        accumulators: By node.
        elements: By name.
    """

    common: ConstantsByName
    cylinders: list[dict[str, Any]]
    second_spools: list[ConstantsByName]
    pumps: dict[str, ConstantsByName]
    unlimited_pressures: ConstantsByName
    engine: ConstantsByName
    lines: ConstantsByName
    accumulators: dict[str, ConstantsByName]
    elements: dict[str, ConstantsByName]


class CircuitStates:
    """Constants and states of a circuit.

    States per cylinder: pressures in A and B, compression of the series spring if there is one,
    and per spool the position of its play, its position and its rate, if it has them. Then per
    limited pump the pressure of its line, the displacement and the sensed load, if these take
    time; per line its pressure; per accumulator its pressure, and its oil if the gas exchanges
    heat; the speed of the engine relative to its set speed; then the integrals `BALANCE_UNITS`.

    The state of a pressure is p - p_vapour where it is positive. A negative state means that the
    chamber has a void of the size of the state times a constant compliance [m3/Pa]: the pressure
    cannot fall below p_vapour, and rises again when the void is filled.

    Args:
        hydraulics: The circuit.
        strokes: (m,) distance between the limits of each joint [m], [rad].
        has_measured_pressures: Whether the pressures of main pump and tank are inputs.

    Attributes:
        joints: Driven joints, in order.
        spools: (s,) names of the signals of the spools, see `Hydraulics.spools`.
        constants: Constants of the circuit, in the order of `split_constants`.
        stiff_state_count: Number of states that need an implicit method; the others are integrals.
        state_count: Number of all states.
        state_units: Names and units of the stiff states; pressures relative to vapour pressure.
        cylinder_state_starts: (m,) index of the first state of each cylinder, its pressure in A.
        cylinder_state_ends: (m,) index behind the last state of each cylinder.
        scales: (state_count,) required accuracy of the states.
        pumps: Pumps with limited flow, by node.
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
        self.cylinders_and_valves = [
            (cylinder, valve, 0.0 if cylinder.motor else stroke)
            for cylinder, valve, stroke in zip(
                hydraulics.cylinders.values(), hydraulics.valves.values(), strokes, strict=True
            )
        ]
        self.engine = hydraulics.engine if self.pumps else None
        self._constants_by_component = list(self._compute_constants())
        numbers: list[float] = []
        _map_numbers(self._constants_by_component, numbers.append)
        self.constants = np.array(numbers)
        cylinder_states = [
            list(self._cylinder_states(*item)) for item in self.cylinders_and_valves
        ]
        self.cylinder_state_ends = np.cumsum([len(x) for x in cylinder_states]).tolist()
        self.cylinder_state_starts = [
            end - len(x) for end, x in zip(self.cylinder_state_ends, cylinder_states, strict=True)
        ]
        states = [x for group in cylinder_states for x in group] + list(self._supply_states())
        self.state_units = {name: unit for name, unit, _ in states}
        self.stiff_state_count = len(states)
        self.state_count = len(states) + len(BALANCE_UNITS)
        self.scales = np.array([x for *_, x in states] + [np.inf] * len(BALANCE_UNITS))

    def _pressure_state(self, name: str, volume: float) -> StateDefinition:
        volume_accuracy = self.hydraulics.oil.bulk_modulus * _OIL_VOLUME_ACCURACY / volume
        return f"pressure_{name}", "Pa", max(_PRESSURE_ACCURACY, volume_accuracy)

    def _cylinder_states(
        self, cylinder: Cylinder, valve: Valve, stroke: float
    ) -> Iterator[StateDefinition]:
        joint = cylinder.joint
        yield self._pressure_state(f"{joint}_a", cylinder.hose_a + 0.5 * cylinder.area_a * stroke)
        yield self._pressure_state(f"{joint}_b", cylinder.hose_b + 0.5 * cylinder.area_b * stroke)
        if cylinder.stiffness > 0:
            yield f"spring_{joint}", "m", 1e-10
        for name, spool in valve.spools.items():
            if spool.hysteresis > 0:
                yield f"play_{name}", "", 1e-7
            if spool.bandwidth > 0:
                yield f"spool_{name}", "", 1e-7
                yield f"spool_rate_{name}", "1/s", 1e-5

    def _supply_states(self) -> Iterator[StateDefinition]:
        for name, pump in self.pumps.items():
            yield self._pressure_state(name, pump.volume)
            if pump.response > 0:
                yield f"share_{name}", "", 1e-7
            if pump.sensing_time > 0:
                yield f"load_{name}", "Pa", _PRESSURE_ACCURACY
        for name, line in self.hydraulics.lines.items():
            yield self._pressure_state(name, line.volume)
        for name, item in self.hydraulics.accumulators.items():
            yield self._pressure_state(name, item.volume)
            if item.time_constant > 0:
                yield f"oil_{name}", "m3", 1e-9 * item.volume
        if self.engine is not None:
            yield "engine", "", 1e-7

    def _compute_constants(self) -> CircuitConstants:
        oil, supply, engine = self.hydraulics.oil, self.hydraulics.supply, self.engine
        relative_droop = engine.speed_droop / engine.speed if engine else 0.0
        return CircuitConstants(
            common={
                "oil": 1.0 / oil.bulk_modulus,
                "hose": _inverse(oil.hose_modulus),
                "steel": _inverse(oil.steel_modulus),
                "vapour": oil.vapour_pressure,
                "gas_power": 1.0 + 1.0 / oil.gas_exponent,
                "air": oil.air,
                "pump": supply.pressure,
                "tank": supply.tank,
            },
            cylinders=[cylinder_constants(*item) for item in self.cylinders_and_valves],
            second_spools=[
                spool_constants(valve.spool_b) if valve.spool_b else {}
                for _, valve, _ in self.cylinders_and_valves
            ],
            pumps={
                name: {
                    "pressure": pump.pressure,
                    "flow": pump.flow,
                    "per_droop": 1.0 / pump.droop,
                    "line": pump.volume / oil.bulk_modulus,
                    "margin": pump.margin,
                    "standby": pump.standby,
                    "signal": pump.signal,
                    "throttle": pump.throttle,
                    "least": pump.least,
                    "per_response": _inverse(pump.response),
                    "per_sensing": _inverse(pump.sensing_time),
                    "power": pump.power,
                    "relief": pump.relief,
                    "relief_gain": pump.relief_gain,
                    "slip": pump.slip,
                    "friction": pump.friction,
                    "drag": pump.drag,
                }
                for name, pump in self.pumps.items()
            },
            unlimited_pressures={
                name: pump.pressure
                for name, pump in self.hydraulics.supplies.items()
                if name not in self.pumps
            },
            engine={
                "speed": engine.speed,
                "torque": engine.torque,
                "per_droop": 1.0 / relative_droop,
                "droop": relative_droop,
                "per_inertia": 1.0 / (engine.inertia * engine.speed),
            }
            if engine
            else {},
            lines={
                name: line.volume / oil.bulk_modulus
                for name, line in self.hydraulics.lines.items()
            },
            accumulators={
                name: {
                    "line": gas.line / oil.bulk_modulus,
                    "volume": gas.volume,
                    "precharge": gas.precharge,
                    "exponent": gas.exponent,
                    "per_time": _inverse(gas.time_constant),
                }
                for name, gas in self.hydraulics.accumulators.items()
            },
            elements={
                name: {"coefficient": x.coefficient, "gain": x.gain, "pressure": x.pressure}
                for name, x in self.hydraulics.elements.items()
            },
        )

    @property
    def constant_names(self) -> list[str]:
        """Names of `constants`: COMPONENT_VALUE."""
        joints, found = list(self.hydraulics.cylinders), list[str]()
        for field, tree in zip(
            CircuitConstants._fields, self._constants_by_component, strict=True
        ):
            if not isinstance(tree, list):
                found += _names_in(tree, field)
                continue
            side = "_second" if field == "second_spools" else ""
            for joint, values in zip(joints, tree, strict=True):
                found += _names_in(values, joint + side)
        return found

    def split_constants(self, constants: Sequence[Scalar]) -> CircuitConstants:
        """Constants by component.

        Args:
            constants: Values of `constants`, floats or formulas.
        """
        remaining = iter(constants)
        by_component = _map_numbers(self._constants_by_component, lambda _: next(remaining))
        return CircuitConstants(*by_component)

    def initial_state(
        self,
        forces: Sequence[Scalar],
        pressures: dict[str, tuple[float, float]],
        signals: Sequence[Scalar],
        tank: float,
    ) -> list[Scalar]:
        """State (state_count,) at rest.

        Args:
            forces: (m,) forces that hold the machine [N], [N m]. The loaded chamber of each
                cylinder also bears the tank pressure in the other chamber.
            pressures: Known pressures in A and B [Pa] by joint.
            signals: (s,) signals of the spools [V], which have reached their positions.
            tank: Pressure of the tank [Pa].
        """
        vapour = self.hydraulics.oil.vapour_pressure
        values: dict[str, Scalar] = {}
        for (cylinder, _, _), force in zip(self.cylinders_and_valves, forces, strict=True):
            joint, area_a, area_b = cylinder.joint, cylinder.area_a, cylinder.area_b
            carried_force = force - tank * (area_a - area_b)
            a: Scalar = tank + maximum(carried_force, 0.0) / area_a
            b: Scalar = tank + maximum(-carried_force, 0.0) / area_b
            a, b = pressures.get(joint, (a, b))
            values[f"pressure_{joint}_a"] = maximum(a - vapour, 0.0)
            values[f"pressure_{joint}_b"] = maximum(b - vapour, 0.0)
            if cylinder.stiffness > 0:
                values[f"spring_{joint}"] = (area_a * a - area_b * b) / cylinder.stiffness
        for signal, (name, spool) in zip(signals, self.hydraulics.spools.items(), strict=True):
            u = (signal - spool.neutral) / (spool.full - spool.neutral)
            values[f"play_{name}"] = values[f"spool_{name}"] = maximum(minimum(u, 1.0), -1.0)
        for name, pump in self.pumps.items():
            values[f"pressure_{name}"] = pump.idle_pressure(tank) - vapour
            values[f"share_{name}"], values[f"load_{name}"] = pump.least, tank
        for name, line in self.hydraulics.lines.items():
            values[f"pressure_{name}"] = (line.pressure or tank) - vapour
        for name, item in self.hydraulics.accumulators.items():
            p = item.pressure or item.precharge
            values[f"pressure_{name}"] = p - vapour
            values[f"oil_{name}"] = item.volume * (1.0 - item.precharge / max(p, item.precharge))
        if self.engine is not None:
            values["engine"] = 1.0 + self.engine.speed_droop / self.engine.speed
        balances = [0.0] * len(BALANCE_UNITS)
        return [*(values.get(name, 0.0) for name in self.state_units), *balances]


def _inverse(value: float) -> float:
    """One over a value, 0 for 0."""
    return 1.0 / value if value else 0.0


def _map_numbers(tree: Any, function: Callable[[Any], Any]) -> Any:
    """A tree of dictionaries and lists, with a function of each of its numbers."""
    if isinstance(tree, dict):
        return {name: _map_numbers(x, function) for name, x in tree.items()}
    if isinstance(tree, list):
        return [_map_numbers(x, function) for x in tree]
    return function(tree)


def _names_in(tree: Any, path: str) -> list[str]:
    """Names of the numbers of a tree of dictionaries and lists."""
    if not isinstance(tree, dict | list):
        return [path]
    pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
    return [name for key, value in pairs for name in _names_in(value, f"{path}_{key}")]
