"""Flow through orifices and elements, compliance of volumes, and the flow balance of nodes.

All functions take floats or formulas.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from typing import NamedTuple

from crane.codegen.symbolic import (
    Scalar,
    SymbolicExpression,
    apply_function,
    copysign,
    maximum,
    minimum,
    where_positive,
)
from crane.hydraulics.circuit_elements import TANK_NODE, CircuitElement

LAMINAR_PRESSURE_DROP = 1.0e4  # pressure drop below which the flow of an orifice is smooth [Pa]
CHECK_VALVE_OPENING = 10.0  # pressure drop over which a check valve opens [Pa]
GAS_PRESSURE = 1.0e5  # reference pressure of volumes of entrapped gas [Pa]
SENSING_OPENING_GAIN = 100.0  # one over the opening from which on the full load is sensed
_EMPTY_SHARE = 1e-3  # share of the precharge or volume within which an accumulator runs empty
_MIN_GAS_SHARE = 0.02  # least share of the gas volume of an accumulator


class Flow(NamedTuple):
    """A flow from one node to another.

    Attributes:
        source: Node that the oil leaves.
        target: Node that the oil enters.
        rate: Flow [m3/s].
        path: Kind of the flow: "inlet", "outlet", "leak", "relief", "refill", "bypass",
            "regeneration", "piston", "cross" (relief), "pump", "slip", or the name of an element.
        metering_drop: Pressure drop at the metering edge; the rest is that of a compensator [Pa].
            None without a compensator.
    """

    source: str
    target: str
    rate: Scalar
    path: str
    metering_drop: Scalar | None = None


def clip(x: Scalar, lower: Scalar, upper: Scalar) -> Scalar:
    """A value limited to an interval."""
    return maximum(minimum(x, upper), lower)


def largest_of(values: Sequence[Scalar]) -> Scalar:
    """The largest of some values."""
    return reduce(maximum, values)


def signed_square_root(drop: Scalar) -> Scalar:
    """Signed square root of a pressure drop, with a finite derivative at zero.

    sign(d) sqrt(|d|) beyond L = `LAMINAR_PRESSURE_DROP`. Within, where the flow becomes laminar,
    the odd cubic that continues it with equal derivative, d / sqrt(L) (5 - (d / L)^2) / 4.
    """
    share = clip(drop, -LAMINAR_PRESSURE_DROP, LAMINAR_PRESSURE_DROP) * (
        1.0 / LAMINAR_PRESSURE_DROP
    )
    cubic = LAMINAR_PRESSURE_DROP**0.5 * share * (1.25 - 0.25 * share * share)
    turbulent = (
        apply_function("sqrt", maximum(apply_function("abs", drop), LAMINAR_PRESSURE_DROP))
        - LAMINAR_PRESSURE_DROP**0.5
    )
    return cubic + copysign(turbulent, drop)


def forward_drop(drop: Scalar) -> Scalar:
    """Pressure drop that drives the flow through a check valve, 0 against it [Pa].

    d beyond B = `CHECK_VALVE_OPENING`; from 0 to B, where the valve opens, the cubic that
    continues it with equal derivatives, d (d / B) (2 - d / B). With a kink at 0, steps would
    be the shorter, and depend on rounding, the stiffer a chamber is that rests at the pressure of
    the tank.
    """
    share = clip(drop * (1.0 / CHECK_VALVE_OPENING), 0.0, 1.0)
    opening = CHECK_VALVE_OPENING * share * share * (2.0 - share)
    return opening + (maximum(drop, CHECK_VALVE_OPENING) - CHECK_VALVE_OPENING)


def series_coefficient(orifice: Scalar, holding: Scalar | None, cushion: Scalar) -> Scalar:
    """Flow coefficient of an orifice, a load-holding valve and a throttle in series.

    The pressure drops (Q / c)^2 add up: 1 / c^2 = 1 / orifice^2 + 1 / holding^2 + cushion.

    Args:
        orifice: Coefficient of the edge of the valve [m3/(s Pa^0.5)].
        holding: Coefficient of the load-holding valve; None without one.
        cushion: 1 / c^2 of the throttle, 0 without one.
    """
    square = orifice * orifice
    if holding is None:
        return orifice / apply_function("sqrt", 1.0 + cushion * square)
    holding_square = holding * holding
    return (
        orifice
        * holding
        / apply_function(
            "sqrt", square + holding_square + cushion * square * holding_square + 1e-40
        )
    )


def directional_flow(
    drop: Scalar, inflow_coefficient: Scalar, outflow_coefficient: Scalar
) -> Scalar:
    """Flow into a chamber with a coefficient for each direction [m3/s]."""
    return where_positive(drop, inflow_coefficient, outflow_coefficient) * signed_square_root(drop)


class FlowBalance:
    """Sums of the flows between nodes.

    Args:
        pressures: Pressures of all nodes [Pa].

    Attributes:
        flows: All flows except for those that are identically 0.
        net_inflows: Inflow less outflow of each node [m3/s].
        pumped_flow: Total flow of the pumps [m3/s].
        returned_flow: Flow into the tank [m3/s].
        pump_power: Power of the pumps, without that of the tank pressure [W].
        lost_power: Power dissipated between the nodes, flow times pressure drop [W].
    """

    def __init__(self, pressures: Mapping[str, Scalar]):
        self._node_pressures = pressures
        self.flows: list[Flow] = []
        self.net_inflows: dict[str, Scalar] = dict.fromkeys(pressures, 0.0)
        self.pumped_flow: Scalar = 0.0
        self.returned_flow: Scalar = 0.0
        self.pump_power: Scalar = 0.0
        self.lost_power: Scalar = 0.0

    def add_flows(self, flows: Iterable[Flow]) -> None:
        """Add flows; those between the same two nodes are summed first."""
        nonzero_flows = [x for x in flows if isinstance(x.rate, SymbolicExpression) or x.rate != 0]
        self.flows += nonzero_flows
        flow_between: dict[tuple[str, str], Scalar] = {}
        for flow in nonzero_flows:
            pair = flow.source, flow.target
            if flow.path == "pump":
                self.pumped_flow = self.pumped_flow + flow.rate
                self.pump_power = self.pump_power + self._node_pressures[flow.target] * flow.rate
                self.net_inflows[flow.target] = self.net_inflows[flow.target] + flow.rate
                continue
            if pair[::-1] in flow_between:
                flow_between[pair[::-1]] = flow_between[pair[::-1]] - flow.rate
            else:
                flow_between[pair] = flow_between.get(pair, 0.0) + flow.rate
        for (source, target), rate in flow_between.items():
            self.net_inflows[source] = self.net_inflows[source] - rate
            self.net_inflows[target] = self.net_inflows[target] + rate
            if target == TANK_NODE:
                self.returned_flow = self.returned_flow + rate
            if source == TANK_NODE and target != TANK_NODE:
                self.returned_flow = self.returned_flow - rate
            self.lost_power = self.lost_power + rate * (
                self._node_pressures[source] - self._node_pressures[target]
            )


def net_inflows_of(flows: Iterable[Flow], nodes: Iterable[str]) -> dict[str, Scalar]:
    """Inflow less outflow of some nodes by some flows [m3/s]."""
    out: dict[str, Scalar] = dict.fromkeys(nodes, 0.0)
    for flow in flows:
        if flow.target in out:
            out[flow.target] = out[flow.target] + flow.rate
        if flow.source in out:
            out[flow.source] = out[flow.source] - flow.rate
    return out


def volume_compliance(
    oil_constants: Mapping[str, Scalar], volume: Scalar, hose: Scalar, gas: Scalar, p: Scalar
) -> Scalar:
    """Compliance of a chamber [m3/Pa].

    V / K = V / B_oil + (V - V_h) / B_steel + V_h / B_hose + compliance of entrapped gas and air.

    Args:
        oil_constants: Constants of the oil.
        volume: V [m3].
        hose: V_h, volume of the hose [m3].
        gas: Volume of entrapped gas at `GAS_PRESSURE` [m3].
        p: Pressure [Pa].
    """
    compliance = volume * oil_constants["oil"] + hose * oil_constants["hose"]
    if _is_nonzero(oil_constants["steel"]):
        compliance = compliance + oil_constants["steel"] * maximum(volume - hose, 0.0)
    if _is_nonzero(oil_constants["air"]):
        gas = gas + oil_constants["air"] * volume
    return compliance + gas_compliance(oil_constants, gas, p) if _is_nonzero(gas) else compliance


def gas_compliance(oil_constants: Mapping[str, Scalar], gas: Scalar, p: Scalar) -> Scalar:
    """Compliance of gas in the oil [m3/Pa].

    V = gas (p0 / p)^(1/n), -dV/dp = gas / (n p0) (p0 / p)^(1 + 1/n).
    """
    power = oil_constants["gas_power"]
    log_pressure_ratio = apply_function("log", maximum(p, 1.0) * (1.0 / GAS_PRESSURE))
    return (
        gas
        * (power - 1.0)
        * (1.0 / GAS_PRESSURE)
        * apply_function("exp", -power * log_pressure_ratio)
    )


def _is_nonzero(constant: Scalar) -> bool:
    """Whether a constant is a formula or a number other than 0."""
    return isinstance(constant, SymbolicExpression) or constant != 0.0


def accumulator_equations(
    constants: Mapping[str, Scalar], p: Scalar, inflow: Scalar, oil: Scalar | None
) -> tuple[list[Scalar], Scalar]:
    """State rates of an accumulator, see `Accumulator`.

    Below the precharge the volume of the gas is constant, and only the oil at the port is
    compressed. The transition extends over `_EMPTY_SHARE` below the precharge, or above the last
    oil. With w the share of the gas that moves, Q = line p' + w Q_g.

    Args:
        constants: Constants of the accumulator.
        p: Pressure [Pa].
        inflow: Q [m3/s].
        oil: Volume of oil, a state where the gas exchanges heat; else None [m3].

    Returns:
        Rates of the states, and the heat flow out of the gas [W].
    """
    line, volume, precharge, n = (
        constants[x] for x in ("line", "volume", "precharge", "exponent")
    )
    opening_share = 1.0 + (p / precharge - 1.0) * (1.0 / _EMPTY_SHARE)
    if oil is None:
        # V_g = volume (p0 / p)^(1/n), -dV/dp = V_g / (n p)
        gas_pressure = maximum(p, precharge)
        log_volume_ratio = apply_function("log", precharge / gas_pressure)
        compliance = volume * apply_function("exp", log_volume_ratio / n) / (n * gas_pressure)
        return [inflow / (line + clip(opening_share, 0.0, 1.0) * compliance)], 0.0
    gas_volume = clip(volume - oil, _MIN_GAS_SHARE * volume, volume)
    cooling = (p - (precharge * volume / gas_volume)) * constants["per_time"]
    moving_share = clip(maximum(opening_share, oil / (_EMPTY_SHARE * volume)), 0.0, 1.0)
    pressure_rate = (n * p * inflow / gas_volume - moving_share * cooling) / (
        moving_share + line * n * p / gas_volume
    )
    return [pressure_rate, inflow - line * pressure_rate], moving_share * gas_volume * cooling / (
        n - 1.0
    )


def element_flow(
    name: str,
    element: CircuitElement,
    constants: Mapping[str, Scalar],
    pressures: Mapping[str, Scalar],
    openings: Mapping[str, Sequence[Scalar]],
) -> Flow:
    """Flow through an element, see `CircuitElement`.

    Args:
        name: Name of the element.
        element: Its description.
        constants: Its constants.
        pressures: Pressures of all nodes [Pa].
        openings: Openings y of the valves in both directions, by joint.
    """
    drop = pressures[element.source] - pressures[element.target]
    if element.kind == "check":
        drop = forward_drop(drop - constants["pressure"])
    elif element.kind == "relief":
        drop = maximum(drop - constants["pressure"], 0.0)
    if element.kind in ("orifice", "check"):
        rate = constants["coefficient"] * signed_square_root(drop)
    else:
        rate = constants["gain"] * drop
    return Flow(element.source, element.target, _element_opening(element, openings) * rate, name)


def _element_opening(element: CircuitElement, openings: Mapping[str, Sequence[Scalar]]) -> Scalar:
    """Opening of an element by valves, 0 to 1; see `element_flow`."""
    if not element.joints:
        return 1.0
    sides = {"both": (0, 1), "out": (0,), "back": (1,)}[element.side]
    return largest_of([openings[joint][side] for joint in element.joints for side in sides])


def merged_load_pressures(
    elements: Iterable[CircuitElement],
    loads: Mapping[str, Scalar],
    tank: Scalar,
    openings: Mapping[str, Sequence[Scalar]],
) -> dict[str, Scalar]:
    """Highest load pressure of each pump, with its sensing lines joined by orifices [Pa].

    Args:
        elements: All elements of the circuit.
        loads: Highest load pressure of the valves of each pump [Pa].
        tank: Pressure of the tank [Pa].
        openings: See `element_flow`.
    """
    out = dict(loads)
    for element in elements:
        pair = element.source, element.target
        if element.kind != "orifice" or not {*pair} <= loads.keys():
            continue
        share = clip(_element_opening(element, openings) * SENSING_OPENING_GAIN, 0.0, 1.0)
        for pump, other_pump in (pair, pair[::-1]):
            out[pump] = maximum(out[pump], tank + share * (loads[other_pump] - tank))
    return out
