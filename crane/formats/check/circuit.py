"""What of a hydraulic circuit can be and is hardly meant: its connections, and what pumps give."""

import math
import warnings
from collections.abc import Iterator, Sequence

from crane.common.errors import CraneWarning
from crane.description import MachineSpec
from crane.hydraulics.components import Hydraulics, Valve
from crane.hydraulics.connections import drained, fed, joined, wanted
from crane.hydraulics.load_sensing import driven_swings, least_sensing
from crane.hydraulics.sources import MAIN, TANK

_SHORT = 1.01  # times a pump's flow from which on its valves take more than it has
_HIGH = 0.1  # share of a pump's pressure by which a line may rise over it
_LITRES = 6e4  # per minute in a m3/s


def warn_of_circuit(spec: MachineSpec) -> None:
    """Warn of connections and regulators of a circuit that make no sense."""
    if spec.hydraulics is None:
        return
    for key, text in (*_odd_nodes(spec.hydraulics), *_odd_pumps(spec.hydraulics)):
        place = spec.where.get(key, spec.where.get("hydraulics", spec.path.name))
        warnings.warn(f"{place}: {text}", CraneWarning, stacklevel=2)


def shortage(spec: MachineSpec) -> list[str]:
    """Pumps whose valves take more together than they give, a line each: most machines have some.

    Only valves that keep a flow are counted, those with a margin.
    """
    told = []
    for name, supply in spec.hydraulics.sources.items() if spec.hydraulics else ():
        assert spec.hydraulics is not None
        sum_of = wanted(spec.hydraulics, name)
        if supply.flow > 0 and sum_of > _SHORT * supply.flow:
            told.append(
                f"hydraulics: the valves of '{name}' take {sum_of * _LITRES:.3g} l/min together, "
                f"it gives {supply.flow * _LITRES:.3g} l/min"
            )
    return told


def _odd_nodes(hydraulics: Hydraulics) -> Iterator[tuple[str, str]]:
    together, emptied, filled = joined(hydraulics), drained(hydraulics), fed(hydraulics)
    valves = hydraulics.valves.values()
    returns = {node for x in valves for node in (x.return_a, x.return_b)} & {*hydraulics.lines}
    kinds = {name: "line" for name in hydraulics.lines}
    kinds |= {name: "accumulator" for name in hydraulics.accumulators}
    for name, kind in kinds.items():
        if name not in together or (name in returns and name not in emptied):
            continue  # which has been said
        if name not in filled:
            from_tank = any(
                x.kind == "check" and (x.source, x.target) == (TANK, name)
                for x in hydraulics.elements.values()
            )
            only = "only a check valve from the tank feeds it, " if from_tank else ""
            yield (
                f"{kind} {name}",
                f"no pump feeds the {kind} '{name}', {only}add an element that leads into it",
            )
        elif name not in emptied:
            yield (
                f"{kind} {name}",
                f"what gets into the {kind} '{name}' never leaves it, add an orifice or a relief "
                "valve that leads on to the tank",
            )
    for name in hydraulics.sources:
        if name in together and name not in emptied:
            yield (
                f"supply {name}",
                f"no way leads from '{name}' to the tank, it only fills what it feeds, add a "
                "relief valve, an orifice or a valve of a joint",
            )


def _odd_pumps(hydraulics: Hydraulics) -> Iterator[tuple[str, str]]:
    together = joined(hydraulics)
    for name, supply in hydraulics.sources.items():
        valves = [x for x in hydraulics.valves.values() if x.supply == name]
        key = f"supply {name}"
        if name == MAIN and name not in together:
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
        limited = supply.control != "fixed" and supply.relief > 0
        if limited and supply.relief <= supply.pressure:
            yield (
                key,
                f"relief of '{name}' is {supply.relief:g} Pa, not above its pressure of "
                f"{supply.pressure:g} Pa: what the pump gives flows off there, give a higher one",
            )
        modulus = hydraulics.oil.bulk_modulus
        if valves and (band := driven_swings(supply, modulus)):
            least = math.ceil(100.0 * least_sensing(supply, modulus)) / 100.0
            yield (
                key,
                f"'{name}' follows its loads so closely that it drives those that swing at "
                f"{band[0]:.3g} to {band[1]:.3g} Hz: pressures may ring on, give 'sensing' "
                f"{least:g} or more (damping of the load-sensing line)",
            )
        # what it gives until its displacement is back, in a line that no way leads out of
        rise = supply.flow * supply.response * hydraulics.oil.bulk_modulus / supply.volume
        if rise > _HIGH * supply.pressure and not _relieved(hydraulics, name, valves):
            yield (
                key,
                f"nothing relieves '{name}', which swings back within {supply.response:g} s: once "
                f"its valves close or what they feed stalls, its line rises by up to {rise:.3g} "
                f"Pa over its {supply.pressure:.3g} Pa, give 'relief' [Pa]",
            )


def _relieved(hydraulics: Hydraulics, name: str, valves: Sequence[Valve]) -> bool:
    """Whether a pump's line has a way out beside its closed valves, slip apart: that is slow."""
    ways = [part for part in hydraulics.elements.values() if name in (part.source, part.target)]
    return (
        hydraulics.sources[name].relief > 0
        or any(valve.centre > 0 for valve in valves)
        or any(part.source == name or part.kind in ("orifice", "leak") for part in ways)
    )
