"""Who gave how much oil to whom, and what of its power is lost on the way."""

from collections.abc import Iterable, Mapping

from crane.codegen import Expression, Number
from crane.hydraulics.flow import Flow
from crane.hydraulics.sources import TANK


class Books:
    """Flows as they are entered, and their sums.

    Args:
        pressures: Of all nodes [Pa].

    Attributes:
        flows: All that were entered, without those that are 0 whatever happens.
        nets: What flows into each node less what leaves it [m3/s].
        pumped: Through all pumps [m3/s].
        returned: Into the tank [m3/s].
        work: Of the pumps on what they give, the tank's pressure apart [W].
        lost: Between the nodes, rate times pressure drop [W].
    """

    def __init__(self, pressures: Mapping[str, Number]):
        self._pressures = pressures
        self.flows: list[Flow] = []
        self.nets: dict[str, Number] = dict.fromkeys(pressures, 0.0)
        self.pumped: Number = 0.0
        self.returned: Number = 0.0
        self.work: Number = 0.0
        self.lost: Number = 0.0

    def enter(self, flows: Iterable[Flow]) -> None:
        """Enter some, those between two nodes as one."""
        given = [x for x in flows if isinstance(x.rate, Expression) or x.rate != 0]
        self.flows += given
        between: dict[tuple[str, str], Number] = {}
        for flow in given:
            pair = flow.source, flow.target
            if flow.through == "pump":
                self.pumped = self.pumped + flow.rate
                self.work = self.work + self._pressures[flow.target] * flow.rate
                self.nets[flow.target] = self.nets[flow.target] + flow.rate
            elif pair[::-1] in between:
                between[pair[::-1]] = between[pair[::-1]] - flow.rate
            else:
                between[pair] = between.get(pair, 0.0) + flow.rate
        for (source, target), rate in between.items():
            self.nets[source] = self.nets[source] - rate
            self.nets[target] = self.nets[target] + rate
            if target == TANK:
                self.returned = self.returned + rate
            elif source == TANK:
                self.returned = self.returned - rate
            drop = self._pressures[source] - self._pressures[target]
            self.lost = self.lost + rate * drop


def nets_of(flows: Iterable[Flow], nodes: Iterable[str]) -> dict[str, Number]:
    """What of some flows gets into nodes less what leaves them [m3/s]."""
    out: dict[str, Number] = dict.fromkeys(nodes, 0.0)
    for flow in flows:
        if flow.target in out:
            out[flow.target] = out[flow.target] + flow.rate
        if flow.source in out:
            out[flow.source] = out[flow.source] - flow.rate
    return out
