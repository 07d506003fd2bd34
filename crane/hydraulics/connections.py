"""What hangs together in a circuit: who is fed by whom, and which ways lead back to the tank."""

from collections.abc import Iterable

from crane.hydraulics.components import Hydraulics
from crane.hydraulics.sources import TANK, Supply

Way = tuple[str, str]


def joined(hydraulics: Hydraulics) -> set[str]:
    """Nodes that a valve or an element is joined to."""
    found = {x for valve in hydraulics.valves.values() for x in (valve.supply, valve.return_a,
                                                                 valve.return_b)}  # fmt: skip
    return found | {x for part in hydraulics.elements.values() for x in (part.source, part.target)}


def ways(hydraulics: Hydraulics) -> list[Way]:
    """Between which nodes oil can flow, pumps apart; valves and elements that can open are open.

    Valves lead from the pump into the chambers and from these to where they are drained: what may
    flow back through them feeds and drains nothing.
    """
    found: list[Way] = []
    for joint, valve in hydraulics.valves.items():
        cylinder = hydraulics.cylinders[joint]
        a, b = f"{joint}.a", f"{joint}.b"
        found += [(valve.supply, a), (valve.supply, b), (a, valve.return_a), (b, valve.return_b)]
        if valve.centre > 0:
            found.append((valve.supply, TANK))
        if valve.regeneration > 0:
            found.append((b, a))
        if cylinder.leakage > 0 or cylinder.cross_relief > 0:
            found += [(a, b), (b, a)]
        for node, leakage in ((a, cylinder.leakage_a), (b, cylinder.leakage_b)):
            if leakage > 0 or cylinder.relief > 0:
                found.append((node, TANK))
            if cylinder.refill > 0:
                found.append((TANK, node))
    for part in hydraulics.elements.values():
        found.append((part.source, part.target))
        if part.kind in ("orifice", "leak"):
            found.append((part.target, part.source))
    for name, supply in hydraulics.sources.items():
        if supply.relief > 0 or supply.slip > 0:
            found.append((name, TANK))
    return found


def drained(hydraulics: Hydraulics) -> set[str]:
    """Nodes from which oil can get to the tank."""
    return _reached([TANK], [(target, source) for source, target in ways(hydraulics)])


def fed(hydraulics: Hydraulics) -> set[str]:
    """Nodes that oil can get into from a pump, not only from the tank."""
    return _reached(hydraulics.sources, [way for way in ways(hydraulics) if TANK not in way])


def wanted(hydraulics: Hydraulics, name: str) -> float:
    """What the wide open valves of a pump take together, of those that keep a flow [m3/s]."""
    supply: Supply = hydraulics.sources[name]
    total = 0.0
    for valve in hydraulics.valves.values():
        if valve.supply == name:
            kept = valve.margin or (supply.margin if valve.sharing else 0.0)
            total += max(valve.c1, valve.c4) * kept**0.5
    return total


def _reached(starts: Iterable[str], edges: list[Way]) -> set[str]:
    found = set(starts)
    while more := {target for source, target in edges if source in found} - found:
        found |= more
    return found
