"""Where the power of a circuit's pumps goes at an instant, as formulas."""

from collections.abc import Sequence

from crane.codegen import Expression, Number
from crane.hydraulics.books import nets_of
from crane.hydraulics.circuit import Circuit, Instant
from crane.hydraulics.sources import TANK

SHAFT, ROD = "shaft", "rod"
STORED = ("stored", "spring")
_ALSO = {"piston": "leak", "cross": "relief"}  # flows that count with others


def powers_of(circuit: Circuit, now: Instant, v: Sequence[Number]) -> dict[str, Number]:
    """Power [W] of every part as `OWNER.WHAT`, see `PowerAccount`.

    With Q the flow from a node of pressure p_1 to one of p_2, and F the force of a cylinder,

        throttles Q (p_1 - p_2),    nodes p_i sum of their Q,    rods F v,

    the tank being a node like others: what the pumps' shafts give is the sum of all others.

    Args:
        circuit: Whose instant it is.
        now: The instant.
        v: (m,) velocities of its joints [m/s], [rad/s].
    """
    found: dict[str, Number] = {}
    p, parts = now.pressures, circuit.hydraulics
    joints = {f"{joint}.{side}": joint for joint in circuit.joints for side in "ab"}

    def add(owner: str, what: str, power: Number) -> None:
        if isinstance(power, Expression) or power != 0:
            name = f"{owner}.{what}"
            found[name] = found.get(name, 0.0) + power

    for name, pump in now.pumps.items():
        add(name, SHAFT, pump.shaft)
        add(name, "friction", pump.heat)
    for flow in now.flows:
        lost = flow.rate * (p[flow.source] - p[flow.target])
        element = parts.elements.get(flow.through)
        if flow.through == "pump":
            if flow.target not in now.pumps:
                add(flow.target, SHAFT, -1.0 * lost)
        elif element and (element.source, element.target) == flow[:2]:
            add(flow.through, "element", lost)
        else:
            owner = joints.get(flow.target) or joints.get(flow.source) or flow.source
            if flow.drop is not None:
                metered = flow.rate * flow.drop
                add(owner, "compensator", lost - metered)
                lost = metered
            add(owner, _ALSO.get(flow.through, flow.through), lost)
    for name, damped in now.damped.items():
        add(name, "damper", damped)
    for name, force, speed in zip(circuit.joints, now.forces, v, strict=True):
        add(name, ROD, force * speed)
    nets = nets_of(now.flows, p)
    for name, power in now.stored.items():
        if name in joints:
            add(joints[name], "stored", power)
        elif name.endswith(".spring"):
            add(name.removesuffix(".spring"), "spring", power)
        else:
            add(name, "stored", power)
        if name in parts.accumulators:
            add(name, "cooling", p[name] * nets[name] - power)
    add(TANK, "stored", p[TANK] * nets[TANK])
    return found
