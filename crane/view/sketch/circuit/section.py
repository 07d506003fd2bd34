"""One function of a circuit: its valve above the rails, and its actuator on top."""

from collections.abc import Mapping
from dataclasses import dataclass

from crane.hydraulics.components import Counterbalance, Cylinder, Valve
from crane.hydraulics.sources import TANK, Supply
from crane.view.plots.text import plain
from crane.view.sketch.circuit import machines, symbols
from crane.view.sketch.circuit.ink import NAME, Ink, Point, Pose
from crane.view.sketch.circuit.quantities import bar, figure, litres, per_turn, squared
from crane.view.sketch.circuit.spool import HEIGHT, Spool
from crane.view.sketch.sheet import symbol

WIDTH = 122.0
LANE = 14.0  # of chambers, from the section's middle
_TAP = 55.0  # of chambers that something else is joined to, from the middle
_LINE = 7.6  # height of a line of words
_LANES = {"Ta": -26.0, "LS": -20.0, "P": 0.0, "T": 12.0}
_BENDS = {"Ta": 3.0, "LS": 5.0, "P": 7.0, "T": 4.0}  # below the valve
_BESIDE = -7.0  # lane of P beside an open centre
_COMPENSATOR, _METERED = 28.0, 48.0  # what they need below the valve
_ORIFICE_DROP = 1.0e6  # [Pa] at which flows of plain valves are told


@dataclass(frozen=True)
class Function:
    """A cylinder or motor with its valve.

    Attributes:
        joint: What it drives.
        cylinder: The actuator.
        valve: Its valve.
        supply: The pump that feeds it.
        turns: Whether its joint is a revolute one.
        stroke: Between the joint's limits [m], [rad]; infinite without.
        tapped: Chambers, of "a" and "b", that something else is joined to.
        senses: Whether its load is told to a pump or to other valves.
        compared: Whether others tell theirs to the same.
        centre: Nets before and behind its open centre, None where it is closed.
    """

    joint: str
    cylinder: Cylinder
    valve: Valve
    supply: Supply
    turns: bool
    stroke: float
    tapped: frozenset[str] = frozenset()
    senses: bool = False
    compared: bool = False
    centre: tuple[str, str] | None = None

    @property
    def ports(self) -> list[str]:
        """Ports of its valve below, from the left."""
        parted = self.valve.return_a != self.valve.return_b
        given = {"Ta": parted, "LS": self.senses, "P": True, "C": self.centre is not None,
                 "T": True}  # fmt: skip
        return [name for name, there in given.items() if there]

    @property
    def rails(self) -> dict[str, str]:
        """Nets that lead down to rails, by port of the valve or chamber."""
        valve = self.valve
        found = {"P": valve.supply, "T": valve.return_b}
        if "Ta" in self.ports:
            found["Ta"] = valve.return_a
        if self.senses:
            found["LS"] = f"LS {valve.supply}"
        return found | {side: f"{self.joint}.{side}" for side in sorted(self.tapped)}

    @property
    def below(self) -> float:
        """Height of what stands below the valve."""
        if self.valve.sharing:
            return _METERED
        return _COMPENSATOR if self.valve.margin > 0 else 8.0

    @property
    def told(self) -> list[str]:
        """Words about the valve."""
        valve = self.valve
        margin = valve.margin or (self.supply.margin if valve.sharing else 0.0)
        drop = (margin or _ORIFICE_DROP) ** 0.5
        one, other = litres(valve.c1 * drop), litres(valve.c4 * drop)
        words = [f"{one} l/min"] if one == other else [f"{one} | {other}", "l/min"]
        if valve.spool_b:
            words.insert(0, "2 spools: A, B")
        if valve.margin > 0:
            return [*words, f"Δp {bar(valve.margin)}"]
        return [*words, "sharing"] if margin else [*words, f"at {bar(_ORIFICE_DROP)}"]


def lane_of(function: Function, port: str) -> float:
    """Where a port of the valve goes down to its rail, from the section's middle."""
    if port == "P" and function.centre is not None:
        return _BESIDE
    return _LANES[port]


def rows_of(function: Function) -> list[tuple[str, float]]:
    """What stands between the valve and the actuator, upwards, with heights."""
    cylinder, valve = function.cylinder, function.valve
    rows: list[tuple[str, float]] = []
    for side in "ab":
        if getattr(cylinder, f"counterbalance_{side}") is not None:
            rows.append((f"counterbalance_{side}", 32.0))
    if cylinder.rupture_a or cylinder.rupture_b:
        rows.append(("rupture", 22.0))
    if cylinder.relief or cylinder.refill:
        rows.append(("port", 44.0 if cylinder.relief else 34.0))
    if cylinder.cross_relief:
        rows.append(("cross", 48.0))
    if valve.regeneration:
        rows.append(("regeneration", 24.0))
    if function.tapped:
        rows.append(("tap", 8.0))
    return rows


class Section:
    """Draws a function.

    Args:
        ink: What it is drawn with.
        function: What is drawn.
        x: Its middle.
        valve: Lower edge of the valve.
        actuator: Middle of the actuator.
        rails: Heights by net.
        levels: Heights at which open centres are handed on, by pump.
    """

    def __init__(
        self, ink: Ink, function: Function, x: float, valve: float, actuator: float,
        rails: Mapping[str, float], levels: Mapping[str, float],
    ):  # fmt: skip
        self._ink, self._function, self._x = ink, function, x
        self._valve, self._actuator, self._rails = valve, actuator, rails
        self._level = levels.get(function.valve.supply, valve)
        self._words = min([valve - 8.5, *(level - 7.0 for level in levels.values())])
        self._nets = {side: f"{function.joint}.{side}" for side in "ab"}

    def draw(self) -> tuple[Point, Point] | None:
        """Draw it; where its open centre begins and ends, if it has one."""
        function, ink, x = self._function, self._ink, self._x
        above = ["A", "C", "B"] if function.centre else ["A", "B"]
        spool = Spool(x, self._valve, function.ports, above, function.valve.float_from > 0)
        part = f"valve {function.joint}"
        spool.draw(ink, part)
        for port, net in function.rails.items():
            if port in spool.ports:
                self._down(spool, port, net, part)
        for k, text in enumerate(function.told):
            ink.words(x + 17, self._words - _LINE * k, text, f"label {part}", ha="left")
        top = self._valve + HEIGHT
        current = {side: self._first(side) for side in "ab"}
        for side, sign, port in (("a", -1, "A"), ("b", 1, "B")):
            ink.port(part, current[side], spool.ports[port])
            ink.wire(current[side], spool.ports[port], (spool.ports[port][0], top + 4),
                     (x + sign * LANE, top + 4), (x + sign * LANE, top + 8))  # fmt: skip
        y = top + (14 if function.centre else 8)
        if function.centre:
            self._lanes(current, top + 8, y)
        for name, height in rows_of(function):
            self._row(name, y, height, current)
            y += height
        self._lanes(current, y, self._actuator - machines.BARREL)
        self._drive()
        if not function.centre:
            return None
        before, behind = function.centre
        ink.port(part, before, spool.ports["C"])
        ink.port(part, behind, spool.ports["C'"])
        return spool.ports["C"], spool.ports["C'"]

    def _first(self, side: str) -> str:
        """Net of a chamber's line at the valve."""
        cylinder, net = self._function.cylinder, self._nets[side]
        held = getattr(cylinder, f"counterbalance_{side}") is not None
        burst = getattr(cylinder, f"rupture_{side}") > 0
        return f"{net} valve" if held or burst else net

    def _lanes(self, current: Mapping[str, str], start: float, end: float) -> None:
        for side, sign in (("a", -1), ("b", 1)):
            at = self._x + sign * LANE
            self._ink.wire(current[side], (at, start), (at, end))

    def _down(self, spool: Spool, port: str, net: str, part: str) -> None:
        """From a port of the valve to its rail, through a compensator where there is one."""
        ink, function, x = self._ink, self._function, self._x
        lane, (at, y), rail = x + lane_of(function, port), spool.ports[port], self._rails[net]
        turn = y - _BENDS[port]
        valve = function.valve
        if port == "LS":
            ink.port(part, net, (at, y))
            ink.wire(net, (at, y), (at, turn), (lane, turn), (lane, rail), signal=True)
            if function.compared:
                symbols.shuttle(ink, (lane, rail), f"shuttle {function.joint}", net)
            return
        if port != "P" or not (valve.margin > 0 or valve.sharing):
            ink.port(part, net, (at, y))
            ink.wire(net, (at, y), (at, turn), (lane, turn), (lane, rail))
            return
        inner = f"{function.joint} metered"
        ink.port(part, inner, (at, y))
        middle = y - 18
        ink.wire(inner, (at, y), (at, turn), (lane, turn), (lane, middle + symbols.COMPENSATOR))
        named = f"compensator {function.joint}"
        before = f"{function.joint} inlet" if valve.sharing else net
        symbols.compensator(ink, Pose(lane, middle, flip=True), named, (before, inner),
                            valve.sharing)  # fmt: skip
        foot = middle - symbols.COMPENSATOR
        if valve.sharing:
            symbols.throttle(ink, Pose(lane, foot - 9), f"metering {function.joint}",
                             (net, before), adjusted=True)  # fmt: skip
            ink.wire(before, (lane, foot), (lane, foot - 2))
            foot -= 16
        ink.wire(net, (lane, foot), (lane, rail))

    def _row(self, name: str, y: float, height: float, current: dict[str, str]) -> None:
        cylinder, x, ink = self._function.cylinder, self._x, self._ink
        if name.startswith("counterbalance"):
            self._holding(name[-1], y, height, current)
            return
        if name == "rupture":
            self._rupture(y, height, current)
            return
        self._lanes(current, y, y + height)
        if name == "port":
            for side, sign in (("a", -1), ("b", 1)):
                self._port(side, sign, y, height)
        elif name == "cross":
            for k, (one, other, turn) in enumerate((("a", "b", 3), ("b", "a", 1))):
                self._cross(one, other, turn, y + 12 + 22 * k)
            text = f"Δp {bar(cylinder.cross_relief)}"
            ink.words(x + LANE + 4, y + 23, text, f"label cross {cylinder.joint}", ha="left")
        elif name == "regeneration":
            part, middle = f"regeneration {cylinder.joint}", y + 10
            nets = self._nets["b"], self._nets["a"]
            symbols.check(ink, Pose(x, middle, 1), part, nets)
            ink.wire(nets[0], (x + symbols.CHECK, middle), (x + LANE, middle))
            ink.wire(nets[1], (x - symbols.CHECK, middle), (x - LANE, middle))
            ink.words(x + LANE + 4, middle, "regen.", f"label {part}", ha="left")
        elif name == "tap":
            for side in self._function.tapped:
                sign, net = (-1 if side == "a" else 1), self._nets[side]
                start, lane = (x + sign * LANE, y + 2), x + sign * _TAP
                ink.wire(net, start, (lane, y + 2), (lane, self._rails[net]))

    def _cross(self, one: str, other: str, turn: int, y: float) -> None:
        ink, x, nets = self._ink, self._x, (self._nets[one], self._nets[other])
        sign = -1 if one == "a" else 1
        part = f"cross {self._function.joint}.{one}"
        symbols.relief(ink, Pose(x, y, turn, flip=turn == 3), part, nets)
        ink.wire(nets[0], (x + sign * symbols.RELIEF, y), (x + sign * LANE, y))
        ink.wire(nets[1], (x - sign * symbols.RELIEF, y), (x - sign * LANE, y))

    def _port(self, side: str, sign: int, y: float, height: float) -> None:
        """Relief and suction valves of a chamber, each with the tank."""
        ink, cylinder, net = self._ink, self._function.cylinder, self._nets[side]
        lane, top = self._x + sign * LANE, y + height - (12 if cylinder.relief else 6)
        if cylinder.relief:
            at, part = lane + sign * 15, f"relief {net}"
            middle = top - symbols.RELIEF - 3
            ink.wire(net, (lane, top), (at, top), (at, middle + symbols.RELIEF))
            symbols.relief(ink, Pose(at, middle, 2, flip=sign < 0), part, (net, TANK))
            foot = middle - symbols.RELIEF
            symbols.tank(ink, (at, foot - 3), f"tank {part}", TANK, 4.5)
            ink.wire(TANK, (at, foot), (at, foot - 3))
            ink.words(lane + sign * 4, top + 6, bar(cylinder.relief), f"label {part}",
                      ha="left" if sign > 0 else "right")  # fmt: skip
        if cylinder.refill:
            beside = 34 if cylinder.relief else 15
            at, part = lane + sign * beside, f"suction {net}"
            middle = top - symbols.CHECK - 5
            start = (lane + sign * 15, top) if cylinder.relief else (lane, top)
            ink.wire(net, start, (at, top), (at, middle + symbols.CHECK))
            symbols.check(ink, Pose(at, middle), part, (TANK, net))
            foot = middle - symbols.CHECK
            symbols.tank(ink, (at, foot - 3), f"tank {part}", TANK, 4.5)
            ink.wire(TANK, (at, foot), (at, foot - 3))

    def _holding(self, side: str, y: float, height: float, current: dict[str, str]) -> None:
        """A counterbalance valve: free inflow, outflow when the other chamber's line opens it."""
        ink, sign = self._ink, (-1 if side == "a" else 1)
        other = "b" if side == "a" else "a"
        lane, beside = self._x + sign * LANE, self._x - sign * LANE
        burst = getattr(self._function.cylinder, f"rupture_{side}") > 0
        below, above = current[side], f"{self._nets[side]} held" if burst else self._nets[side]
        part, middle = f"counterbalance {self._nets[side]}", y + height / 2
        ink.wire(below, (lane, y), (lane, middle - symbols.RELIEF))
        ink.wire(above, (lane, middle + symbols.RELIEF), (lane, y + height))
        symbols.relief(ink, Pose(lane, middle, 2, flip=side == "b"), part, (above, below))
        check = lane + sign * 21
        for net, end, foot in ((below, y + 3, -1), (above, y + height - 3, 1)):
            ink.wire(net, (lane, end), (check, end), (check, middle + foot * symbols.CHECK))
        symbols.check(ink, Pose(check, middle), f"{part} check", (below, above))
        ink.wire(current[other], (beside, y), (beside, y + height))
        pilot = lane - sign * 5.5
        ink.wire(current[other], (beside, middle), (pilot, middle), signal=True)
        ink.port(part, current[other], (pilot, middle))
        valve: Counterbalance = getattr(self._function.cylinder, f"counterbalance_{side}")
        words = [bar(valve.pressure), f"{figure(valve.pilot_ratio)} : 1"]
        for k, text in enumerate(words):
            ink.words(beside - sign * 5, middle + 4 - _LINE * k, text, f"label {part}",
                      ha="right" if sign > 0 else "left")  # fmt: skip
        current[side] = above

    def _rupture(self, y: float, height: float, current: dict[str, str]) -> None:
        ink, middle = self._ink, y + height / 2
        for side, sign in (("a", -1), ("b", 1)):
            lane, flow = self._x + sign * LANE, getattr(self._function.cylinder, f"rupture_{side}")
            if not flow:
                ink.wire(current[side], (lane, y), (lane, y + height))
                continue
            part, below, above = f"rupture {self._nets[side]}", current[side], self._nets[side]
            reach = symbols.CHECK + 2
            ink.wire(below, (lane, y), (lane, middle - reach))
            ink.wire(above, (lane, middle + reach), (lane, y + height))
            symbols.rupture(ink, Pose(lane, middle, 2), part, (above, below))
            for k, text in enumerate((litres(flow), "l/min")):
                ink.words(lane + sign * 9, middle + 4 - _LINE * k, text, f"label {part}",
                          ha="left" if sign > 0 else "right")  # fmt: skip
            current[side] = above

    def _drive(self) -> None:
        """The actuator, and what it is."""
        ink, function, at = self._ink, self._function, (self._x, self._actuator)
        cylinder, nets = function.cylinder, (self._nets["a"], self._nets["b"])
        if cylinder.motor:
            part = f"motor {function.joint}"
            machines.motor(ink, (at[0], at[1] + 2), part, nets)
            for net, sign in zip(nets, (-1, 1), strict=True):
                x = at[0] + sign * LANE
                ink.wire(net, (x, at[1] - 8), (x, at[1] - 6))
            words = [per_turn(cylinder.area_a)]
        elif function.turns:
            part = f"rotary drive {function.joint}"
            machines.rotary(ink, at, part, nets)
            sizes = sorted({per_turn(cylinder.area_a), per_turn(cylinder.area_b)})
            words = [" | ".join(sizes)]
        else:
            part = f"cylinder {function.joint}"
            machines.cylinder(ink, at, part, nets, cylinder.area_b / cylinder.area_a)
            words = [f"{squared(cylinder.area_a)} | {squared(cylinder.area_b)} cm²"]
        if function.stroke < 1e6 and not cylinder.motor:
            turned = f"{figure(function.stroke * 57.29578)}°"
            words.append(
                turned if function.turns else f"stroke {figure(1e3 * function.stroke)} mm"
            )
        y = at[1] + TOP - NAME / 2
        ink.words(at[0], y, symbol(function.joint), f"name {part}", size=NAME, weight="bold",
                  room=WIDTH - 8)  # fmt: skip
        for k, text in enumerate(words):
            ink.words(at[0], y - 9 - _LINE * k, plain(text), f"label {part}")


TOP = 46.0  # above the middle of an actuator, with its words
