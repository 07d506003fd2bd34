"""Constants and states of a circuit, and its initial state."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np

from crane.codegen import Scalar
from crane.common.samples import Array
from crane.hydraulics.circuit_elements import MAIN_PUMP
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.hydraulics.valve_cylinder_equations import (
    CYLINDER_CONSTANT_COUNT,
    SPOOL_CONSTANTS,
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
_COMMON_CONSTANTS = ("oil", "hose", "steel", "vapour", "gas_power", "air", "pump", "tank")
_PUMP_CONSTANTS = (
    "pressure", "flow", "per_droop", "line", "margin", "standby", "signal", "throttle", "least",
    "per_response", "per_sensing", "power", "relief", "relief_gain", "slip", "friction", "drag",
)  # fmt: skip
_ENGINE_CONSTANTS = ("speed", "torque", "per_droop", "droop", "per_inertia")
_ACCUMULATOR_CONSTANTS = ("line", "volume", "precharge", "exponent", "per_time")
_ELEMENT_CONSTANTS = ("coefficient", "gain", "pressure")

ConstantsByName = dict[str, Scalar]
StateDefinition = tuple[str, str, float]
"""Name, unit and required accuracy of a state."""


class CircuitConstants(NamedTuple):
    """Constants of a circuit by component, floats or formulas.

    Attributes:
        common: Oil, and pressures of main pump and tank.
        cylinders: Per cylinder, see `cylinder_constants`.
        second_spools: Per cylinder; empty without a second spool.
        pumps: Of the limited pumps, by node.
        unlimited_pressures: Pressures of the other further pumps, by node.
        engine: Of the engine; empty without one.
        lines: Compliance per line.
        accumulators: By node.
        elements: By name.
    """

    common: ConstantsByName
    cylinders: list[list[Scalar]]
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
    chamber has a vapour volume of the size of the state times a constant compressibility: the
    pressure cannot fall below p_vapour, and rises again when the void is filled.

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
        self._unlimited_pumps = {
            name: pump for name, pump in hydraulics.supplies.items() if name not in self.pumps
        }
        self.cylinders_and_valves = [
            (cylinder, valve, 0.0 if cylinder.motor else stroke)
            for cylinder, valve, stroke in zip(
                hydraulics.cylinders.values(), hydraulics.valves.values(), strokes, strict=True
            )
        ]
        self.engine = hydraulics.engine if self.pumps else None
        self.constants = np.array([x for row in self._constant_rows() for x in row])
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

    def _constant_rows(self) -> Iterator[Sequence[float]]:
        """Constants by component, in the order of `CircuitConstants`."""
        oil, supply = self.hydraulics.oil, self.hydraulics.supply
        yield (
            1.0 / oil.bulk_modulus, _inverse(oil.hose_modulus), _inverse(oil.steel_modulus),
            oil.vapour_pressure, 1.0 + 1.0 / oil.gas_exponent, oil.air, supply.pressure,
            supply.tank,
        )  # fmt: skip
        for item in self.cylinders_and_valves:
            yield cylinder_constants(*item)
        for _, valve, _ in self.cylinders_and_valves:
            yield spool_constants(valve.spool_b) if valve.spool_b else ()
        for pump in self.pumps.values():
            yield (
                pump.pressure, pump.flow, 1.0 / pump.droop, pump.volume / oil.bulk_modulus,
                pump.margin, pump.standby, pump.signal, pump.throttle, pump.least,
                _inverse(pump.response), _inverse(pump.sensing_time), pump.power, pump.relief,
                pump.relief_gain, pump.slip, pump.friction, pump.drag,
            )  # fmt: skip
        yield [pump.pressure for pump in self._unlimited_pumps.values()]
        if (engine := self.engine) is not None:
            relative_droop, inertia = (
                engine.speed_droop / engine.speed,
                engine.inertia * engine.speed,
            )
            yield engine.speed, engine.torque, 1.0 / relative_droop, relative_droop, 1.0 / inertia
        yield [line.volume / oil.bulk_modulus for line in self.hydraulics.lines.values()]
        for gas in self.hydraulics.accumulators.values():
            line, per_time = gas.line / oil.bulk_modulus, _inverse(gas.time_constant)
            yield line, gas.volume, gas.precharge, gas.exponent, per_time
        for element in self.hydraulics.elements.values():
            yield element.coefficient, element.gain, element.pressure

    def split_constants(self, constants: Sequence[Scalar]) -> CircuitConstants:
        """Constants by component.

        Args:
            constants: Values of `constants`, floats or formulas.
        """
        remaining = iter(constants)

        def take(names: Sequence[str] | Mapping[str, object]) -> ConstantsByName:
            return {name: next(remaining) for name in names}

        hydraulics = self.hydraulics
        return CircuitConstants(
            common=take(_COMMON_CONSTANTS),
            cylinders=[
                list(islice(remaining, CYLINDER_CONSTANT_COUNT)) for _ in self.cylinders_and_valves
            ],
            second_spools=[
                take(SPOOL_CONSTANTS if valve.spool_b else ())
                for _, valve, _ in self.cylinders_and_valves
            ],
            pumps={name: take(_PUMP_CONSTANTS) for name in self.pumps},
            unlimited_pressures=take(self._unlimited_pumps),
            engine=take(_ENGINE_CONSTANTS if self.engine is not None else ()),
            lines=take(hydraulics.lines),
            accumulators={name: take(_ACCUMULATOR_CONSTANTS) for name in hydraulics.accumulators},
            elements={name: take(_ELEMENT_CONSTANTS) for name in hydraulics.elements},
        )

    def initial_state(
        self,
        forces: Array,
        pressures: dict[str, tuple[float, float]],
        signals: Array,
        tank: float,
    ) -> Array:
        """State (state_count,) at rest.

        Args:
            forces: (m,) forces that hold the machine [N], [N m]. The loaded chamber of each
                cylinder also bears the tank pressure in the other chamber.
            pressures: Known pressures in A and B [Pa] by joint.
            signals: (s,) signals of the spools [V], which have reached their positions.
            tank: Pressure of the tank [Pa].
        """
        vapour = self.hydraulics.oil.vapour_pressure
        values: dict[str, float] = {}
        for (cylinder, _, _), force in zip(self.cylinders_and_valves, forces, strict=True):
            joint, area_a, area_b = cylinder.joint, cylinder.area_a, cylinder.area_b
            carried_force = force - tank * (area_a - area_b)
            a = tank + max(carried_force, 0.0) / area_a
            b = tank + max(-carried_force, 0.0) / area_b
            a, b = pressures.get(joint, (a, b))
            values[f"pressure_{joint}_a"] = max(a - vapour, 0.0)
            values[f"pressure_{joint}_b"] = max(b - vapour, 0.0)
            if cylinder.stiffness > 0:
                values[f"spring_{joint}"] = (area_a * a - area_b * b) / cylinder.stiffness
        for signal, (name, spool) in zip(signals, self.hydraulics.spools.items(), strict=True):
            u = (signal - spool.neutral) / (spool.full - spool.neutral)
            values[f"play_{name}"] = values[f"spool_{name}"] = np.clip(u, -1.0, 1.0)
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
        return np.array(
            [values.get(name, 0.0) for name in self.state_units] + [0.0] * len(BALANCE_UNITS)
        )


def _inverse(value: float) -> float:
    """One over a value, 0 for 0."""
    return 1.0 / value if value else 0.0
