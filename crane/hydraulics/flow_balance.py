"""Who gave how much oil to whom, and what of its power is lost on the way."""

from collections.abc import Iterable, Mapping

from crane.codegen import Scalar, SymbolicExpression
from crane.hydraulics.orifice_flow import Flow
from crane.hydraulics.supply_and_engine import TANK_NODE


class FlowBalance:
    """Flows as they are entered, and their sums.

    Args:
        pressures: Of all nodes [Pa].

    Attributes:
        flows: All that were entered, without those that are 0 whatever happens.
        net_inflows: What flows into each node less what leaves it [m3/s].
        pumped_flow: Through all pumps [m3/s].
        returned_flow: Into the tank [m3/s].
        pump_power: Of the pumps on what they give, the tank's pressure apart [W].
        lost_power: Between the nodes, rate times pressure drop [W].
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
        """Enter some, those between two nodes as one."""
        nonzero_flows = [x for x in flows if isinstance(x.rate, SymbolicExpression) or x.rate != 0]
        self.flows += nonzero_flows
        flow_between: dict[tuple[str, str], Scalar] = {}
        for flow in nonzero_flows:
            pair = flow.source, flow.target
            if flow.path == "pump":
                self.pumped_flow = self.pumped_flow + flow.rate
                self.pump_power = self.pump_power + self._node_pressures[flow.target] * flow.rate
                self.net_inflows[flow.target] = self.net_inflows[flow.target] + flow.rate
            elif pair[::-1] in flow_between:
                flow_between[pair[::-1]] = flow_between[pair[::-1]] - flow.rate
            else:
                flow_between[pair] = flow_between.get(pair, 0.0) + flow.rate
        for (source, target), rate in flow_between.items():
            self.net_inflows[source] = self.net_inflows[source] - rate
            self.net_inflows[target] = self.net_inflows[target] + rate
            if target == TANK_NODE:
                self.returned_flow = self.returned_flow + rate
            elif source == TANK_NODE:
                self.returned_flow = self.returned_flow - rate
            drop = self._node_pressures[source] - self._node_pressures[target]
            self.lost_power = self.lost_power + rate * drop


def net_inflows_of(flows: Iterable[Flow], nodes: Iterable[str]) -> dict[str, Scalar]:
    """What of some flows gets into nodes less what leaves them [m3/s]."""
    out: dict[str, Scalar] = dict.fromkeys(nodes, 0.0)
    for flow in flows:
        if flow.target in out:
            out[flow.target] = out[flow.target] + flow.rate
        if flow.source in out:
            out[flow.source] = out[flow.source] - flow.rate
    return out
