"""Warnings about connections and supplies of a hydraulic circuit that are probably unintended."""

import math
import warnings
from collections.abc import Iterator, Sequence

from crane.common.errors import CraneWarning
from crane.description.specification import MachineSpec
from crane.hydraulics.circuit_elements import MAIN_PUMP, TANK_NODE
from crane.hydraulics.components import Valve
from crane.hydraulics.hydraulic_circuit import (
    Hydraulics,
    connected_nodes,
    full_opening_flow,
    nodes_draining_to_tank,
    nodes_fed_by_pumps,
)
from crane.hydraulics.pump_equations import least_sensing_ratio, unstable_frequency_range

_MAX_DEMAND_RATIO = 1.01  # of the flow of its valves to the flow of a pump
_MAX_PRESSURE_RISE = 0.1  # of a line, relative to the pressure of its pump
_LITRES_PER_MINUTE = 6e4  # in 1 m3/s


def warn_about_circuit(spec: MachineSpec) -> None:
    """Warn of implausible connections and pump controls of a circuit."""
    if spec.hydraulics is None:
        return
    for key, text in (*_node_problems(spec.hydraulics), *_pump_problems(spec.hydraulics)):
        location = spec.source_locations.get(
            key, spec.source_locations.get("hydraulics", spec.path.name)
        )
        warnings.warn(f"{location}: {text}", CraneWarning, stacklevel=2)


def flow_shortages(spec: MachineSpec) -> list[str]:
    """Return a line for each pump whose valves take more flow together than it delivers.

    Only valves that control a flow count, those with a margin. Most machines have such pumps.
    """
    messages = []
    for name, supply in spec.hydraulics.pumps.items() if spec.hydraulics else ():
        assert spec.hydraulics is not None
        demand = full_opening_flow(spec.hydraulics, name)
        if supply.flow > 0 and demand > _MAX_DEMAND_RATIO * supply.flow:
            messages.append(
                f"hydraulics: the valves of '{name}' take {demand * _LITRES_PER_MINUTE:.3g} "
                f"l/min together, it gives {supply.flow * _LITRES_PER_MINUTE:.3g} l/min"
            )
    return messages


def _node_problems(hydraulics: Hydraulics) -> Iterator[tuple[str, str]]:
    connected, drained_nodes, fed_nodes = (
        connected_nodes(hydraulics),
        nodes_draining_to_tank(hydraulics),
        nodes_fed_by_pumps(hydraulics),
    )
    valves = hydraulics.valves.values()
    return_nodes = {node for x in valves for node in (x.return_a, x.return_b)} & {
        *hydraulics.lines
    }
    kinds = {name: "line" for name in hydraulics.lines}
    kinds |= {name: "accumulator" for name in hydraulics.accumulators}
    for name, kind in kinds.items():
        if name not in connected or (name in return_nodes and name not in drained_nodes):
            continue  # has an error already
        if name not in fed_nodes:
            is_fed_from_tank = any(
                x.kind == "check" and (x.source, x.target) == (TANK_NODE, name)
                for x in hydraulics.elements.values()
            )
            check_valve_text = (
                "only a check valve from the tank feeds it, " if is_fed_from_tank else ""
            )
            yield (
                f"{kind} {name}",
                f"no pump feeds the {kind} '{name}', {check_valve_text}add an element that "
                f"leads into it",
            )
        elif name not in drained_nodes:
            yield (
                f"{kind} {name}",
                f"what gets into the {kind} '{name}' never leaves it, add an orifice or a relief "
                "valve that leads on to the tank",
            )
    for name in hydraulics.pumps:
        if name in connected and name not in drained_nodes:
            yield (
                f"supply {name}",
                f"no way leads from '{name}' to the tank, it only fills what it feeds, add a "
                "relief valve, an orifice or a valve of a joint",
            )


def _pump_problems(hydraulics: Hydraulics) -> Iterator[tuple[str, str]]:
    connected = connected_nodes(hydraulics)
    for name, supply in hydraulics.pumps.items():
        valves = [x for x in hydraulics.valves.values() if x.supply == name]
        key = f"supply {name}"
        if name == MAIN_PUMP and name not in connected:
            yield key, f"nothing is joined to '{name}', let it feed a valve: the others need none"
        if supply.control == "load-sensing" and not valves:
            yield (
                key,
                f"'{name}' senses the load of its valves and has none, so that it stays at its "
                "standby, let it feed a valve or choose another control",
            )
        if supply.control == "positive" and not valves:
            yield (
                key,
                f"'{name}' gives what its valves ask for and has none, so that it gives nothing, "
                "let it feed a valve or choose another control",
            )
        if supply.control == "negative" and not any(x.centre > 0 for x in valves):
            yield (
                key,
                f"'{name}' senses the flow through open centres and no valve of it has one, so "
                "that it always gives all, add 'centre' to its valves or choose another control",
            )
        has_controlled_pressure = supply.control != "fixed" and supply.relief > 0
        if has_controlled_pressure and supply.relief <= supply.pressure:
            yield (
                key,
                f"relief of '{name}' is {supply.relief:g} Pa, not above its pressure of "
                f"{supply.pressure:g} Pa: what the pump gives flows off there, give a higher one",
            )
        modulus = hydraulics.oil.bulk_modulus
        if valves and (unstable_band := unstable_frequency_range(supply, modulus)):
            min_damping = math.ceil(100.0 * least_sensing_ratio(supply, modulus)) / 100.0
            yield (
                key,
                f"'{name}' follows its loads so closely that it drives those that swing at "
                f"{unstable_band[0]:.3g} to {unstable_band[1]:.3g} Hz: pressures may ring on, "
                f"give 'sensing' {min_damping:g} or more (damping of the load-sensing line)",
            )
        # volume that it delivers into a closed line until its displacement is reduced
        pressure_rise = supply.flow * supply.response * hydraulics.oil.bulk_modulus / supply.volume
        if pressure_rise > _MAX_PRESSURE_RISE * supply.pressure and not _is_relieved(
            hydraulics, name, valves
        ):
            yield (
                key,
                f"nothing relieves '{name}', which swings back within {supply.response:g} s: "
                "once its valves close or what they feed stalls, its line rises by up to "
                f"{pressure_rise:.3g} Pa over its {supply.pressure:.3g} Pa, give 'relief' [Pa]",
            )


def _is_relieved(hydraulics: Hydraulics, name: str, valves: Sequence[Valve]) -> bool:
    """Whether a pump's line has an outlet other than closed valves and its slow slip."""
    adjacent_elements = [
        part for part in hydraulics.elements.values() if name in (part.source, part.target)
    ]
    return (
        hydraulics.pumps[name].relief > 0
        or any(valve.centre > 0 for valve in valves)
        or any(
            part.source == name or part.kind in ("orifice", "leak") for part in adjacent_elements
        )
    )
