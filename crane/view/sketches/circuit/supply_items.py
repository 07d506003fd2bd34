"""Items below the rails of a circuit drawing: tank, engine, pumps, accumulators, elements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from crane.hydraulics.circuit_elements import (
    TANK_NODE,
    Accumulator,
    CircuitElement,
    Engine,
    Supply,
)
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.view.plots.figure_style import escape_label
from crane.view.sketches.circuit import machine_symbols, valve_symbols
from crane.view.sketches.circuit.circuit_canvas import NAME_TEXT_SIZE, CircuitCanvas, SymbolPose
from crane.view.sketches.circuit.circuit_functions import CircuitFunction
from crane.view.sketches.circuit.valve_symbols import (
    format_flow,
    format_number,
    format_pressure,
    format_volume,
)

_LINE_HEIGHT = 7.6
_SHAFT_DEPTH = 58.0  # of pumps and engine, below where they hang
CONTROL_LABELS = {"pressure": "p", "load-sensing": "LS", "negative": "NFC", "positive": "PFC"}


@dataclass(frozen=True)
class SupplyItem:
    """An item that is connected to rails above it.

    Attributes:
        width: Width of the item.
        height: Height of the item.
        wires: Nets of its lines upwards, with offsets from its left edge.
        stays_in_row: Whether it stays in the row of the previous item.
    """

    width: float
    height: float
    wires: tuple[tuple[str, float], ...]
    stays_in_row: bool

    def draw(self, canvas: CircuitCanvas, x: float, y: float, rails: Mapping[str, float]) -> None:
        """Draw the item with its left edge at x and its top at y."""


def create_supply_items(
    hydraulics: Hydraulics, functions: Sequence[CircuitFunction]
) -> list[SupplyItem]:
    """Return all items below the rails, from the left."""
    items: list[SupplyItem] = [_create_tank(hydraulics)]
    if hydraulics.engine is not None:
        items.append(_create_engine(hydraulics.engine))
    for i, (name, supply) in enumerate(hydraulics.pumps.items()):
        fed_functions = [x for x in functions if x.valve.supply == name]
        senses = (
            any(x.has_load_sensing for x in fed_functions) and supply.control == "load-sensing"
        )
        # to the previous pump, to the engine, or to an unknown drive
        shaft = 116.0 if i else 64.0 if hydraulics.engine is not None else 24.0
        items.append(_create_pump(name, supply, senses, shaft))
    items += [_create_accumulator(name, x) for name, x in hydraulics.accumulators.items()]
    items += [_create_element(name, x) for name, x in hydraulics.elements.items()]
    return items


def _draw_labels(
    canvas: CircuitCanvas,
    x: float,
    y: float,
    available_width: float,
    component: str,
    name: str,
    texts: Sequence[str],
) -> None:
    """Write a name at y and texts below it."""
    canvas.draw_text(
        x,
        y,
        name,
        f"name {component}",
        size=NAME_TEXT_SIZE,
        weight="bold",
        available_width=available_width - 6,
    )
    for k, text in enumerate(texts):
        canvas.draw_text(
            x,
            y - 9 - _LINE_HEIGHT * k,
            text,
            f"label {component}",
            available_width=available_width - 6,
        )


@dataclass(frozen=True)
class _TankItem(SupplyItem):
    texts: tuple[str, ...]

    def draw(self, canvas: CircuitCanvas, x: float, y: float, rails: Mapping[str, float]) -> None:
        position = x + 20
        canvas.draw_wire(TANK_NODE, (position, rails[TANK_NODE]), (position, y - 14))
        valve_symbols.draw_tank(canvas, (position, y - 14), "tank", TANK_NODE, 11.0)
        _draw_labels(canvas, position, y - 26, self.width, "tank", "tank", self.texts)


def _create_tank(hydraulics: Hydraulics) -> _TankItem:
    return _TankItem(
        44.0, 44.0, ((TANK_NODE, 20.0),), True, (format_pressure(hydraulics.supply.tank),)
    )


@dataclass(frozen=True)
class _EngineItem(SupplyItem):
    texts: tuple[str, ...]

    def draw(self, canvas: CircuitCanvas, x: float, y: float, rails: Mapping[str, float]) -> None:
        position = x + 20
        # the shaft goes on into the first pump
        machine_symbols.draw_shaft(
            canvas, (position, y - _SHAFT_DEPTH), (x + self.width, y - _SHAFT_DEPTH)
        )
        machine_symbols.draw_engine(canvas, (position, y - _SHAFT_DEPTH), "engine")
        _draw_labels(
            canvas, position, y - _SHAFT_DEPTH - 20, self.width, "engine", "engine", self.texts
        )


def _create_engine(engine: Engine) -> _EngineItem:
    speed_text = f"{format_number(engine.speed * 9.5492966)} rpm"
    power_text = f"{format_number(engine.torque * engine.speed / 1e3)} kW"
    return _EngineItem(44.0, _SHAFT_DEPTH + 40, (), True, (speed_text, power_text))


@dataclass(frozen=True)
class _PumpItem(SupplyItem):
    name: str
    supply: Supply
    has_load_sensing: bool
    shaft_length: float
    texts: tuple[str, ...]

    def draw(self, canvas: CircuitCanvas, x: float, y: float, rails: Mapping[str, float]) -> None:
        name, supply, component = self.name, self.supply, f"pump {self.name}"
        position, middle = x + 52, y - _SHAFT_DEPTH
        machine_symbols.draw_shaft(
            canvas, (position - self.shaft_length, middle), (position, middle)
        )
        machine_symbols.draw_pump(
            canvas, (position, middle), component, name, supply.control != "fixed"
        )
        canvas.draw_wire(
            name, (position, middle + machine_symbols.PUMP_RADIUS), (position, rails[name])
        )
        bottom = middle - machine_symbols.PUMP_RADIUS
        canvas.draw_wire("suction " + component, (position, bottom), (position, bottom - 5))
        valve_symbols.draw_tank(
            canvas, (position, bottom - 5), f"tank {component}", "suction " + component
        )
        _draw_labels(
            canvas,
            position,
            bottom - 16,
            2 * self.width - 104,
            component,
            escape_label(name),
            self.texts,
        )
        if supply.control in CONTROL_LABELS:
            box, control = (x + 20, y - 30), f"regulator {name}"
            machine_symbols.draw_regulator(
                canvas, box, CONTROL_LABELS[supply.control], control, supply.power > 0
            )
            signal_height, lane = box[1] - 2, position - 14.5
            canvas.draw_line(
                [(box[0] + 11, signal_height), (lane, signal_height), (lane, middle - 12)],
                linewidth=0.6,
            )
            signal = {"load-sensing": f"LS {name}", "negative": f"N {name}"}.get(supply.control)
            if signal is not None and any(net == signal for net, _ in self.wires):
                lane = box[0]
                canvas.add_port(control, signal, (lane, box[1] + 6))
                canvas.draw_wire(signal, (lane, box[1] + 6), (lane, rails[signal]), is_signal=True)
        elif supply.power > 0:
            machine_symbols.draw_regulator(
                canvas, (x + 20, y - 30), "P", f"regulator {name}", True
            )
        if supply.relief > 0:
            relief, lane, top = f"relief {name}", position + 22, y - 8
            body = top - 3 - valve_symbols.RELIEF_HALF_LENGTH
            canvas.draw_wire(
                name, (position, top), (lane, top), (lane, body + valve_symbols.RELIEF_HALF_LENGTH)
            )
            valve_symbols.draw_relief_valve(
                canvas, SymbolPose(lane, body, 2, is_mirrored=True), relief, (name, TANK_NODE)
            )
            canvas.draw_wire(
                TANK_NODE,
                (lane, body - valve_symbols.RELIEF_HALF_LENGTH),
                (lane, body - valve_symbols.RELIEF_HALF_LENGTH - 3),
            )
            valve_symbols.draw_tank(
                canvas,
                (lane, body - valve_symbols.RELIEF_HALF_LENGTH - 3),
                f"tank {relief}",
                TANK_NODE,
                4.5,
            )
            canvas.draw_text(
                lane + 14, body + 4, format_pressure(supply.relief), f"label {relief}", ha="left"
            )


def _create_pump(
    name: str, supply: Supply, has_load_sensing: bool, shaft_length: float
) -> _PumpItem:
    texts = [f"{format_flow(supply.flow)} l/min"] if supply.flow else ["unlimited flow"]
    if supply.control != "fixed":
        texts.append(f"max. {format_pressure(supply.pressure)}" if supply.control != "pressure"
                     else format_pressure(supply.pressure))  # fmt: skip
    if supply.control == "load-sensing":
        texts.append(f"LS + {format_pressure(supply.margin)}")
    if supply.control == "negative":
        texts.append(f"pN {format_pressure(supply.signal)}")
    if supply.power:
        sharing_text = f" of {', '.join(supply.summed)}" if supply.summed else ""
        texts.append(f"{format_number(supply.power / 1e3)} kW{sharing_text}")
    wires = [(name, 52.0)]
    if has_load_sensing:
        wires.append((f"LS {name}", 20.0))
    if supply.control == "negative":
        wires.append((f"N {name}", 20.0))
    if supply.relief:
        wires.append((name, 52.0))
    height = _SHAFT_DEPTH + machine_symbols.PUMP_RADIUS + 21 + _LINE_HEIGHT * len(texts)
    labels = tuple(escape_label(text) for text in texts)
    return _PumpItem(
        116.0, height, tuple(wires), True, name, supply, has_load_sensing, shaft_length, labels
    )


@dataclass(frozen=True)
class _AccumulatorItem(SupplyItem):
    name: str
    texts: tuple[str, ...]

    def draw(self, canvas: CircuitCanvas, x: float, y: float, rails: Mapping[str, float]) -> None:
        component, position, middle = f"accumulator {self.name}", x + 34, y - 20
        canvas.draw_wire(self.name, (x + 14, rails[self.name]), (x + 14, middle - 22),
                 (position, middle - 22), (position, middle - 17))  # fmt: skip
        machine_symbols.draw_accumulator(canvas, (position, middle), component, self.name)
        _draw_labels(
            canvas,
            position,
            middle - 32,
            self.width,
            component,
            escape_label(self.name),
            self.texts,
        )


def _create_accumulator(name: str, gas: Accumulator) -> _AccumulatorItem:
    texts = format_volume(gas.volume), f"p₀ {format_pressure(gas.precharge)}"
    return _AccumulatorItem(68.0, 72.0, ((name, 14.0),), False, name, texts)


@dataclass(frozen=True)
class _ElementItem(SupplyItem):
    name: str
    element: CircuitElement
    texts: tuple[str, ...]

    def draw(self, canvas: CircuitCanvas, x: float, y: float, rails: Mapping[str, float]) -> None:
        element, component = self.element, f"element {self.name}"
        nets = element.source, element.target
        if TANK_NODE in nets:
            ends_in_tank = element.target == TANK_NODE
            net, position, middle = (nets[0] if ends_in_tank else nets[1]), x + 34, y - 20
            canvas.draw_wire(net, (position, rails[net]), (position, middle + self._half_length))
            pose = SymbolPose(position, middle, 2 if ends_in_tank else 0, is_mirrored=ends_in_tank)
            bottom = middle - self._half_length
            canvas.draw_wire(TANK_NODE, (position, bottom), (position, bottom - 4))
            valve_symbols.draw_tank(canvas, (position, bottom - 4), f"tank {component}", TANK_NODE)
        else:
            middle, position = y - 24, x + 34
            for net, sign in zip(nets, (-1, 1), strict=True):
                lane = position + sign * 18
                canvas.draw_wire(
                    net,
                    (position + sign * self._half_length, middle),
                    (lane, middle),
                    (lane, rails[net]),
                )
            pose = SymbolPose(position, middle, 3, is_mirrored=True)
        self._draw_symbol(canvas, pose, component)
        _draw_labels(canvas, x + 34, y - 52, 68.0, component, escape_label(self.name), self.texts)

    @property
    def _half_length(self) -> float:
        return {
            "relief": valve_symbols.RELIEF_HALF_LENGTH,
            "check": valve_symbols.CHECK_HALF_LENGTH,
        }.get(self.element.kind, valve_symbols.THROTTLE_HALF_LENGTH)

    def _draw_symbol(self, canvas: CircuitCanvas, pose: SymbolPose, component: str) -> None:
        element = self.element
        nets = element.source, element.target
        if element.kind == "relief":
            valve_symbols.draw_relief_valve(canvas, pose, component, nets)
        elif element.kind == "check":
            valve_symbols.draw_check_valve(
                canvas, pose, component, nets, has_spring=element.pressure > 0
            )
        else:
            valve_symbols.draw_throttle(
                canvas, pose, component, nets, element.kind == "leak", bool(element.joints)
            )


def _create_element(name: str, element: CircuitElement) -> _ElementItem:
    texts = []
    if element.kind == "leak":
        per_bar = element.gain * 1e5
        is_small = per_bar < 1e-3 / 6e4
        texts.append(
            f"{format_flow(per_bar * (1e3 if is_small else 1))} {'m' * is_small}l/min per bar"
        )
    elif element.coefficient:
        texts.append(f"{format_flow(element.coefficient * 1e6**0.5)} l/min at 10 bar")
    if element.pressure:
        texts.append(format_pressure(element.pressure))
    if element.joints:
        side = "" if element.side == "both" else f" {element.side}"
        texts += [f"by {joint}{side}" for joint in element.joints]
    nets = element.source, element.target
    wires = [(net, 34.0) for net in nets if net != TANK_NODE]
    if TANK_NODE not in nets:
        wires = [(nets[0], 16.0), (nets[1], 52.0)]
    labels = tuple(escape_label(text) for text in texts)
    return _ElementItem(
        76.0, 57.0 + _LINE_HEIGHT * len(texts), tuple(wires), False, name, element, labels
    )
