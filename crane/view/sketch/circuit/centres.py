"""The lines of open centres, from a pump through its valves to the throttle behind them."""

from collections.abc import Mapping, Sequence

from crane.hydraulics.components import Hydraulics
from crane.hydraulics.sources import TANK
from crane.view.sketch.circuit import symbols
from crane.view.sketch.circuit.ink import Ink, Point, Pose
from crane.view.sketch.circuit.section import Function

_FEED, _RETURN, _SIGNAL = 40.0, 59.0, 6.0  # lanes from a section's middle
_STEP = 3.0  # between the lines of two pumps

Ends = Mapping[str, tuple[float, Point, Point]]


class Centres:
    """Open centres of all pumps.

    Args:
        hydraulics: The circuit.
        stories: Its functions by row.

    Attributes:
        nets: That go from one row of functions to another.
    """

    def __init__(self, hydraulics: Hydraulics, stories: Sequence[Sequence[Function]]):
        self._hydraulics, self._stories = hydraulics, stories
        self._pumps = [
            name
            for name in hydraulics.sources
            if any(x.centre and x.valve.supply == name for row in stories for x in row)
        ]
        self._last = {x.valve.supply: x.joint for row in stories for x in row if x.centre}
        self.nets: list[str] = []
        for row in stories:
            for name in self._pumps:
                mine = [x for x in row if x.centre and x.valve.supply == name]
                if mine and mine[-1].joint != self._last[name]:
                    assert mine[-1].centre is not None
                    self.nets.append(mine[-1].centre[1])

    def _mine(self, k: int, name: str) -> list[Function]:
        return [x for x in self._stories[k] if x.centre and x.valve.supply == name]

    def count(self, k: int) -> int:
        """How many lines of open centres a row has."""
        return sum(bool(self._mine(k, name)) for name in self._pumps)

    def levels(self, k: int, valve: float) -> dict[str, float]:
        """Heights at which they are handed on below the valves, by pump."""
        found: dict[str, float] = {}
        for name in self._pumps:
            if self._mine(k, name):
                found[name] = valve - 11.0 - 4.0 * len(found)
        return found

    def rails(self, k: int) -> set[str]:
        """Nets of a row that need a rail."""
        found: set[str] = set()
        for name in self._pumps:
            mine = self._mine(k, name)
            if not mine:
                continue
            first, last = mine[0].centre, mine[-1].centre
            assert first is not None and last is not None
            found.add(first[0])
            if mine[-1].joint != self._last[name]:
                found.add(last[1])
                continue
            found.add(TANK)
            if self._hydraulics.sources[name].control == "negative":
                found.add(f"N {name}")
        return found

    def draw(
        self, ink: Ink, k: int, ends: Ends, rails: Mapping[str, float],
        levels: Mapping[str, float],
    ) -> None:  # fmt: skip
        """Join the open centres of a row.

        Args:
            ink: What they are drawn with.
            k: Number of the row.
            ends: Middle of a section and where its open centre begins and ends, by joint.
            rails: Heights by net.
            levels: See `levels`.
        """
        for number, name in enumerate(levels):
            level, mine = levels[name], self._mine(k, name)
            lane: float | None = None
            for function in mine:
                x, inlet, outlet = ends[function.joint]
                assert function.centre is not None
                before, behind = function.centre
                if lane is None:
                    lane = x - _FEED - 4.0 * number
                    ink.wire(before, (lane, rails[before]), (lane, level))
                ink.wire(before, (lane, level), (inlet[0], level), inlet)
                lane = x + _RETURN + _STEP * number
                over = outlet[1] + 9
                ink.wire(behind, outlet, (outlet[0], over), (lane, over), (lane, level))
            assert lane is not None
            self._end(ink, name, lane, level, mine[-1], rails)

    def _end(
        self, ink: Ink, name: str, lane: float, level: float, last: Function,
        rails: Mapping[str, float],
    ) -> None:  # fmt: skip
        supply = self._hydraulics.sources[name]
        assert last.centre is not None
        net = last.centre[1]
        if last.joint != self._last[name]:
            ink.wire(net, (lane, level), (lane, rails[net]))
            return
        if not supply.throttle:
            part = f"bypass {name}"
            ink.port(part, net, (lane, level))
            ink.port(part, TANK, (lane, level))
            ink.wire(TANK, (lane, level), (lane, rails[TANK]))
            return
        middle = level - 5 - symbols.THROTTLE
        ink.wire(net, (lane, level), (lane, middle + symbols.THROTTLE))
        symbols.throttle(ink, Pose(lane, middle, 2), f"throttle {name}", (net, TANK))
        ink.wire(TANK, (lane, middle - symbols.THROTTLE), (lane, rails[TANK]))
        if supply.control == "negative":
            signal, beside = f"N {name}", lane + _SIGNAL
            ink.port(f"throttle {name}", signal, (lane, level))
            ink.wire(signal, (lane, level), (beside, level), (beside, rails[signal]), signal=True)
