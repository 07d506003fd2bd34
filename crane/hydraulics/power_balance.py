"""Power balance of a circuit: power of each component at an instant, as formulas."""

from collections.abc import Sequence

from crane.codegen import Scalar, SymbolicExpression
from crane.hydraulics.circuit_elements import TANK_NODE
from crane.hydraulics.circuit_equations import CircuitEquations, CircuitValues
from crane.hydraulics.flow_equations import net_inflows_of

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
