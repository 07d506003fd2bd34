"""What hangs together in a circuit: who is fed by whom, and which ways lead back to the tank."""

from collections.abc import Iterable

from crane.hydraulics.components import Hydraulics
from crane.hydraulics.supply_and_engine import TANK_NODE, Supply

Edge = tuple[str, str]


def connected_nodes(hydraulics: Hydraulics) -> set[str]:
    """Nodes that a valve or an element is joined to."""
    nodes = {x for valve in hydraulics.valves.values() for x in (valve.supply, valve.return_a,
                                                                 valve.return_b)}  # fmt: skip
    return nodes | {x for part in hydraulics.elements.values() for x in (part.source, part.target)}


def flow_paths(hydraulics: Hydraulics) -> list[Edge]:
    """Between which nodes oil can flow, pumps apart; valves and elements that can open are open.

    Valves lead from the pump into the chambers and from these to where they are drained: what may
    flow back through them feeds and drains nothing.
    """
    paths: list[Edge] = []
    for joint, valve in hydraulics.valves.items():
        cylinder = hydraulics.cylinders[joint]
        a, b = f"{joint}.a", f"{joint}.b"
        paths += [(valve.supply, a), (valve.supply, b), (a, valve.return_a), (b, valve.return_b)]
        if valve.centre > 0:
            paths.append((valve.supply, TANK_NODE))
        if valve.regeneration > 0:
            paths.append((b, a))
        if cylinder.leakage > 0 or cylinder.cross_relief > 0:
            paths += [(a, b), (b, a)]
        for node, leakage in ((a, cylinder.leakage_a), (b, cylinder.leakage_b)):
            if leakage > 0 or cylinder.relief > 0:
                paths.append((node, TANK_NODE))
            if cylinder.refill > 0:
                paths.append((TANK_NODE, node))
    for part in hydraulics.elements.values():
        paths.append((part.source, part.target))
        if part.kind in ("orifice", "leak"):
            paths.append((part.target, part.source))
    for name, supply in hydraulics.pumps.items():
        if supply.relief > 0 or supply.slip > 0:
            paths.append((name, TANK_NODE))
    return paths


def nodes_draining_to_tank(hydraulics: Hydraulics) -> set[str]:
    """Nodes from which oil can get to the tank."""
    return _reachable_nodes(
        [TANK_NODE], [(target, source) for source, target in flow_paths(hydraulics)]
    )


def nodes_fed_by_pumps(hydraulics: Hydraulics) -> set[str]:
    """Nodes that oil can get into from a pump, not only from the tank."""
    return _reachable_nodes(
        hydraulics.pumps, [way for way in flow_paths(hydraulics) if TANK_NODE not in way]
    )


def full_opening_flow(hydraulics: Hydraulics, name: str) -> float:
    """What the wide open valves of a pump take together, of those that keep a flow [m3/s]."""
    supply: Supply = hydraulics.pumps[name]
    total = 0.0
    for valve in hydraulics.valves.values():
        if valve.supply == name:
            pressure_drop = valve.margin or (supply.margin if valve.sharing else 0.0)
            total += max(valve.c1, valve.c4) * pressure_drop**0.5
    return total


def _reachable_nodes(starts: Iterable[str], edges: list[Edge]) -> set[str]:
    reachable = set(starts)
    while further := {target for source, target in edges if source in reachable} - reachable:
        reachable |= further
    return reachable
