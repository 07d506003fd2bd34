"""What hangs below the rails: tank, engine, pumps, accumulators, elements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from crane.hydraulics.components import Hydraulics
from crane.hydraulics.elements import Accumulator, Element
from crane.hydraulics.sources import TANK, Engine, Supply
from crane.view.plots.text import plain
from crane.view.sketch.circuit import machines, symbols
from crane.view.sketch.circuit.ink import NAME, Ink, Pose
from crane.view.sketch.circuit.quantities import bar, figure, litres, volume
from crane.view.sketch.circuit.section import Function

_LINE = 7.6
_SHAFT = 58.0  # of pumps and engine, below where they hang
NAMES = {"pressure": "p", "load-sensing": "LS", "negative": "NFC", "positive": "PFC"}


@dataclass(frozen=True)
class Item:
    """Something that hangs on rails.

    Attributes:
        width: What it takes.
        height: Below the place where it hangs.
        wires: Nets that lead up from it, with their places from its left edge.
        together: Whether it stands in the row of what is before it.
    """

    width: float
    height: float
    wires: tuple[tuple[str, float], ...]
    together: bool

    def draw(self, ink: Ink, x: float, y: float, rails: Mapping[str, float]) -> None:
        """Draw it, its left edge at x, hanging from y."""


def items_of(hydraulics: Hydraulics, functions: Sequence[Function]) -> list[Item]:
    """All that hangs below the rails, from the left."""
    items: list[Item] = [_tank(hydraulics)]
    if hydraulics.engine is not None:
        items.append(_engine(hydraulics.engine))
    for i, (name, supply) in enumerate(hydraulics.sources.items()):
        fed = [x for x in functions if x.valve.supply == name]
        senses = any(x.senses for x in fed) and supply.control == "load-sensing"
        # back to the pump before, to the engine, or to nothing that is told
        shaft = 116.0 if i else 64.0 if hydraulics.engine is not None else 24.0
        items.append(_pump(name, supply, senses, shaft))
    items += [_accumulator(name, x) for name, x in hydraulics.accumulators.items()]
    items += [_element(name, x) for name, x in hydraulics.elements.items()]
    return items


def _below(
    ink: Ink, x: float, y: float, room: float, part: str, name: str, words: Sequence[str]
) -> None:
    """Name and words below each other, the first line at y."""
    ink.words(x, y, name, f"name {part}", size=NAME, weight="bold", room=room - 6)
    for k, text in enumerate(words):
        ink.words(x, y - 9 - _LINE * k, text, f"label {part}", room=room - 6)


@dataclass(frozen=True)
class _Tank(Item):
    words: tuple[str, ...]

    def draw(self, ink: Ink, x: float, y: float, rails: Mapping[str, float]) -> None:
        at = x + 20
        ink.wire(TANK, (at, rails[TANK]), (at, y - 14))
        symbols.tank(ink, (at, y - 14), "tank", TANK, 11.0)
        _below(ink, at, y - 26, self.width, "tank", "tank", self.words)


def _tank(hydraulics: Hydraulics) -> _Tank:
    return _Tank(44.0, 44.0, ((TANK, 20.0),), True, (bar(hydraulics.supply.tank),))


@dataclass(frozen=True)
class _Engine(Item):
    words: tuple[str, ...]

    def draw(self, ink: Ink, x: float, y: float, rails: Mapping[str, float]) -> None:
        at = x + 20
        # the shaft goes on into the first pump
        machines.shaft(ink, (at, y - _SHAFT), (x + self.width, y - _SHAFT))
        machines.engine(ink, (at, y - _SHAFT), "engine")
        _below(ink, at, y - _SHAFT - 20, self.width, "engine", "engine", self.words)


def _engine(engine: Engine) -> _Engine:
    turns = f"{figure(engine.speed * 9.5492966)} rpm"
    power = f"{figure(engine.torque * engine.speed / 1e3)} kW"
    return _Engine(44.0, _SHAFT + 40, (), True, (turns, power))


@dataclass(frozen=True)
class _Pump(Item):
    name: str
    supply: Supply
    senses: bool
    shaft: float
    words: tuple[str, ...]

    def draw(self, ink: Ink, x: float, y: float, rails: Mapping[str, float]) -> None:
        name, supply, part = self.name, self.supply, f"pump {self.name}"
        at, middle = x + 52, y - _SHAFT
        machines.shaft(ink, (at - self.shaft, middle), (at, middle))
        machines.pump(ink, (at, middle), part, name, supply.control != "fixed")
        ink.wire(name, (at, middle + machines.PUMP), (at, rails[name]))
        foot = middle - machines.PUMP
        ink.wire("suction " + part, (at, foot), (at, foot - 5))
        symbols.tank(ink, (at, foot - 5), f"tank {part}", "suction " + part)
        _below(ink, at, foot - 16, 2 * self.width - 104, part, plain(name), self.words)
        if supply.control in NAMES:
            box, control = (x + 20, y - 30), f"regulator {name}"
            machines.regulator(ink, box, NAMES[supply.control], control, supply.power > 0)
            level, lane = box[1] - 2, at - 14.5
            ink.line([(box[0] + 11, level), (lane, level), (lane, middle - 12)], linewidth=0.6)
            signal = {"load-sensing": f"LS {name}", "negative": f"N {name}"}.get(supply.control)
            if signal is not None and any(net == signal for net, _ in self.wires):
                lane = box[0]
                ink.port(control, signal, (lane, box[1] + 6))
                ink.wire(signal, (lane, box[1] + 6), (lane, rails[signal]), signal=True)
        elif supply.power > 0:
            machines.regulator(ink, (x + 20, y - 30), "P", f"regulator {name}", True)
        if supply.relief > 0:
            relief, lane, top = f"relief {name}", at + 22, y - 8
            body = top - 3 - symbols.RELIEF
            ink.wire(name, (at, top), (lane, top), (lane, body + symbols.RELIEF))
            symbols.relief(ink, Pose(lane, body, 2, flip=True), relief, (name, TANK))
            ink.wire(TANK, (lane, body - symbols.RELIEF), (lane, body - symbols.RELIEF - 3))
            symbols.tank(ink, (lane, body - symbols.RELIEF - 3), f"tank {relief}", TANK, 4.5)
            ink.words(lane + 14, body + 4, bar(supply.relief), f"label {relief}", ha="left")


def _pump(name: str, supply: Supply, senses: bool, shaft: float) -> _Pump:
    words = [f"{litres(supply.flow)} l/min"] if supply.flow else ["as much as asked for"]
    if supply.control != "fixed":
        words.append(f"max. {bar(supply.pressure)}" if supply.control != "pressure"
                     else bar(supply.pressure))  # fmt: skip
    if supply.control == "load-sensing":
        words.append(f"LS + {bar(supply.margin)}")
    if supply.control == "negative":
        words.append(f"pN {bar(supply.signal)}")
    if supply.power:
        several = f" of {', '.join(supply.summed)}" if supply.summed else ""
        words.append(f"{figure(supply.power / 1e3)} kW{several}")
    wires = [(name, 52.0)]
    if senses:
        wires.append((f"LS {name}", 20.0))
    if supply.control == "negative":
        wires.append((f"N {name}", 20.0))
    if supply.relief:
        wires.append((name, 52.0))
    height = _SHAFT + machines.PUMP + 21 + _LINE * len(words)
    shown = tuple(plain(word) for word in words)
    return _Pump(116.0, height, tuple(wires), True, name, supply, senses, shaft, shown)


@dataclass(frozen=True)
class _Accumulator(Item):
    name: str
    words: tuple[str, ...]

    def draw(self, ink: Ink, x: float, y: float, rails: Mapping[str, float]) -> None:
        part, at, middle = f"accumulator {self.name}", x + 34, y - 20
        ink.wire(self.name, (x + 14, rails[self.name]), (x + 14, middle - 22),
                 (at, middle - 22), (at, middle - 17))  # fmt: skip
        machines.accumulator(ink, (at, middle), part, self.name)
        _below(ink, at, middle - 32, self.width, part, plain(self.name), self.words)


def _accumulator(name: str, gas: Accumulator) -> _Accumulator:
    words = volume(gas.volume), f"p₀ {bar(gas.precharge)}"
    return _Accumulator(68.0, 72.0, ((name, 14.0),), False, name, words)


@dataclass(frozen=True)
class _Element(Item):
    name: str
    element: Element
    words: tuple[str, ...]

    def draw(self, ink: Ink, x: float, y: float, rails: Mapping[str, float]) -> None:
        element, part = self.element, f"element {self.name}"
        nets = element.source, element.target
        if TANK in nets:
            down = element.target == TANK
            net, at, middle = (nets[0] if down else nets[1]), x + 34, y - 20
            ink.wire(net, (at, rails[net]), (at, middle + self._reach))
            pose = Pose(at, middle, 2 if down else 0, flip=down)
            foot = middle - self._reach
            ink.wire(TANK, (at, foot), (at, foot - 4))
            symbols.tank(ink, (at, foot - 4), f"tank {part}", TANK)
        else:
            middle, at = y - 24, x + 34
            for net, sign in zip(nets, (-1, 1), strict=True):
                lane = at + sign * 18
                ink.wire(net, (at + sign * self._reach, middle), (lane, middle),
                         (lane, rails[net]))  # fmt: skip
            pose = Pose(at, middle, 3, flip=True)
        self._symbol(ink, pose, part)
        _below(ink, x + 34, y - 52, 68.0, part, plain(self.name), self.words)

    @property
    def _reach(self) -> float:
        return {"relief": symbols.RELIEF, "check": symbols.CHECK}.get(
            self.element.kind, symbols.THROTTLE
        )

    def _symbol(self, ink: Ink, pose: Pose, part: str) -> None:
        element = self.element
        nets = element.source, element.target
        if element.kind == "relief":
            symbols.relief(ink, pose, part, nets)
        elif element.kind == "check":
            symbols.check(ink, pose, part, nets, loaded=element.pressure > 0)
        else:
            symbols.throttle(ink, pose, part, nets, element.kind == "leak", bool(element.joints))


def _element(name: str, element: Element) -> _Element:
    words = []
    if element.kind == "leak":
        per_bar = element.gain * 1e5
        small = per_bar < 1e-3 / 6e4
        words.append(f"{litres(per_bar * (1e3 if small else 1))} {'m' * small}l/min per bar")
    elif element.coefficient:
        words.append(f"{litres(element.coefficient * 1e6**0.5)} l/min at 10 bar")
    if element.pressure:
        words.append(bar(element.pressure))
    if element.joints:
        side = "" if element.side == "both" else f" {element.side}"
        words += [f"by {joint}{side}" for joint in element.joints]
    nets = element.source, element.target
    wires = [(net, 34.0) for net in nets if net != TANK]
    if TANK not in nets:
        wires = [(nets[0], 16.0), (nets[1], 52.0)]
    shown = tuple(plain(word) for word in words)
    return _Element(76.0, 57.0 + _LINE * len(words), tuple(wires), False, name, element, shown)
