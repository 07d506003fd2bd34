"""Items below the rails of a circuit drawing: tank, engine, pumps, accumulators, elements."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from crane.common.units import format_number, format_quantity
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
from crane.view.sketches.circuit.circuit_canvas import (
    LINE_HEIGHT,
    CircuitCanvas,
    SheetPoint,
    SymbolPose,
)
from crane.view.sketches.circuit.circuit_functions import CircuitFunction
from crane.view.sketches.circuit.valve_symbols import (
    CHECK_HALF_LENGTH,
    RELIEF_HALF_LENGTH,
    THROTTLE_HALF_LENGTH,
    WirePaths,
    format_flow,
    format_pressure,
)

_SHAFT_DEPTH = 58.0  # of pumps and engine, below where they hang
CONTROL_LABELS = {"pressure": "p", "load-sensing": "LS", "negative": "NFC", "positive": "PFC"}
Rails = Mapping[str, float]
_HALF_LENGTHS = {"relief": RELIEF_HALF_LENGTH, "check": CHECK_HALF_LENGTH}  # of other elements


@dataclass(frozen=True)
class SupplyItem:
    """An item that is connected to rails above it.

    Attributes:
        width: Width of the item.
        height: Height of the item.
        wires: Nets of its lines upwards, with offsets from its left edge.
        stays_in_row: Whether it stays in the row of the previous item.
        draw: Draws the item with its left edge at x and its top at y, below rails at heights by
            net.
    """

    width: float
    height: float
    wires: Sequence[tuple[str, float]]
    stays_in_row: bool
    draw: Callable[[CircuitCanvas, float, float, Rails], None]


def create_supply_items(
    hydraulics: Hydraulics, functions: Sequence[CircuitFunction]
) -> list[SupplyItem]:
    """Return all items below the rails, from the left."""
    items = [_create_tank(hydraulics.supply)]
    if hydraulics.engine is not None:
        items.append(_create_engine(hydraulics.engine))
    for i, (name, supply) in enumerate(hydraulics.pumps.items()):
        # to the previous pump, to the engine, or to an unknown drive
        items.append(
            _create_pump(
                name,
                supply,
                (
                    supply.control == "load-sensing"
                    and any(x.has_load_sensing for x in functions if x.valve.supply == name)
                ),
                116.0 if i else 64.0 if hydraulics.engine is not None else 24.0,
            )
        )
    items += [_create_accumulator(name, x) for name, x in hydraulics.accumulators.items()]
    items += [_create_element(name, x) for name, x in hydraulics.elements.items()]
    return items


def _create_tank(supply: Supply) -> SupplyItem:
    def draw(canvas: CircuitCanvas, x: float, y: float, rails: Rails) -> None:
        position = x + 20
        canvas.draw_wire(TANK_NODE, (position, rails[TANK_NODE]), (position, y - 14))
        valve_symbols.draw_tank(canvas, (position, y - 14), "tank", TANK_NODE, 11.0)
        canvas.draw_labels((position, y - 26), "tank", "tank", [format_pressure(supply.tank)], 38)

    return SupplyItem(44.0, 44.0, [(TANK_NODE, 20.0)], True, draw)


def _create_engine(engine: Engine) -> SupplyItem:
    def draw(canvas: CircuitCanvas, x: float, y: float, rails: Rails) -> None:
        middle = (x + 20, y - _SHAFT_DEPTH)
        # the shaft goes on into the first pump
        machine_symbols.draw_shaft(canvas, middle, (x + 44, middle[1]))
        machine_symbols.draw_engine(canvas, middle, "engine")
        canvas.draw_labels(
            ((middle[0], middle[1] - 20)),
            "engine",
            "engine",
            [
                f"{format_number(engine.speed * 9.5492966)} rpm",
                f"{format_number(engine.torque * engine.speed / 1e3)} kW",
            ],
            38,
        )

    return SupplyItem(44.0, _SHAFT_DEPTH + 40, [], True, draw)


def _create_pump(
    name: str, supply: Supply, has_load_sensing: bool, shaft_length: float
) -> SupplyItem:
    texts = _pump_texts(supply)
    wires = [(name, 52.0)]
    if has_load_sensing:
        wires.append((f"LS {name}", 20.0))
    if supply.control == "negative":
        wires.append((f"N {name}", 20.0))
    if supply.relief:
        wires.append((name, 52.0))

    def draw(canvas: CircuitCanvas, x: float, y: float, rails: Rails) -> None:
        component, (position, middle) = f"pump {name}", (x + 52, y - _SHAFT_DEPTH)
        machine_symbols.draw_shaft(canvas, ((position - shaft_length, middle)), (position, middle))
        machine_symbols.draw_pump(
            canvas, (position, middle), component, name, supply.control != "fixed"
        )
        canvas.draw_wire(
            name, ((position, middle + machine_symbols.PUMP_RADIUS)), (position, rails[name])
        )
        canvas.draw_labels(
            ((position, middle - machine_symbols.PUMP_RADIUS - 16)),
            component,
            escape_label(name),
            texts,
            122,
        )
        _draw_regulator(canvas, name, supply, (x + 20, y - 30), (position - 14.5, middle - 12))
        for net, offset in wires:
            if net != name:
                port = (x + offset, y - 24)
                canvas.add_port(f"regulator {name}", net, port)
                canvas.draw_wire(net, port, (port[0], rails[net]), is_signal=True)
        if supply.relief > 0:
            relief, lane, top = f"relief {name}", position + 22, y - 8
            pose = SymbolPose(lane, top - 3 - RELIEF_HALF_LENGTH, 2, True)
            valve_symbols.draw_relief_valve(
                canvas, pose, relief, (name, TANK_NODE), ([(position, top), (lane, top)], ())
            )
            valve_symbols.draw_tank(
                canvas,
                ((lane, pose.y - RELIEF_HALF_LENGTH)),
                f"tank {relief}",
                TANK_NODE,
                4.5,
                drop=3,
            )
            canvas.draw_text(
                lane + 14,
                pose.y + 4,
                format_pressure(supply.relief),
                f"label {relief}",
                ha="left",
            )

    return SupplyItem(
        116.0,
        _SHAFT_DEPTH + machine_symbols.PUMP_RADIUS + 21 + LINE_HEIGHT * len(texts),
        wires,
        True,
        draw,
    )


def _draw_regulator(
    canvas: CircuitCanvas, name: str, supply: Supply, middle: SheetPoint, pump: SheetPoint
) -> None:
    """Draw the regulator of a pump, if it has one, with its line to the pump."""
    component, has_power_limit = f"regulator {name}", supply.power > 0
    control = CONTROL_LABELS.get(supply.control, "")
    if control or has_power_limit:
        machine_symbols.draw_regulator(canvas, middle, control or "P", component, has_power_limit)
    if control:
        height = middle[1] - 2
        canvas.draw_line([(middle[0] + 11, height), (pump[0], height), pump], linewidth=0.6)


def _pump_texts(supply: Supply) -> list[str]:
    texts = [f"{format_flow(supply.flow)} l/min" if supply.flow else "unlimited flow"]
    if supply.control != "fixed":
        limit = "" if supply.control == "pressure" else "max. "
        texts.append(f"{limit}{format_quantity(supply.pressure, 'Pa')}")
    if supply.control == "load-sensing":
        texts.append(f"LS + {format_quantity(supply.margin, 'Pa')}")
    if supply.control == "negative":
        texts.append(f"pN {format_quantity(supply.signal, 'Pa')}")
    if supply.power:
        sharing_text = f" of {', '.join(supply.summed)}" if supply.summed else ""
        texts.append(f"{format_number(supply.power / 1e3)} kW{sharing_text}")
    return [escape_label(text) for text in texts]


def _create_accumulator(name: str, gas: Accumulator) -> SupplyItem:
    def draw(canvas: CircuitCanvas, x: float, y: float, rails: Rails) -> None:
        component, lane, position, middle = f"accumulator {name}", x + 14, x + 34, y - 20
        bottom, port = middle - 22, (position, middle - 17)
        canvas.draw_wire(name, (lane, rails[name]), (lane, bottom), (position, bottom), port)
        machine_symbols.draw_accumulator(canvas, (position, middle), component, name)
        canvas.draw_labels(
            (position, middle - 32),
            component,
            escape_label(name),
            (format_quantity(gas.volume, "m3"), f"p₀ {format_quantity(gas.precharge, 'Pa')}"),
            62,
        )

    return SupplyItem(68.0, 72.0, [(name, 14.0)], False, draw)


def _create_element(name: str, element: CircuitElement) -> SupplyItem:
    component, nets, texts = f"element {name}", (element.source, element.target), []
    if element.kind == "leak":
        per_bar = element.gain * 1e5
        is_small = per_bar < 1e-3 / 6e4
        flow_text = format_flow(per_bar * (1e3 if is_small else 1))
        texts.append(f"{flow_text} {'m' * is_small}l/min per bar")
    elif element.coefficient:
        texts.append(f"{format_flow(element.coefficient * 1e6**0.5)} l/min at 10 bar")
    if element.pressure:
        texts.append(format_pressure(element.pressure))
    side = "" if element.side == "both" else f" {element.side}"
    texts += [f"by {joint}{side}" for joint in element.joints]

    def draw(canvas: CircuitCanvas, x: float, y: float, rails: Rails) -> None:
        position = x + 34
        if TANK_NODE in nets:
            ends_in_tank = nets[1] == TANK_NODE
            net = nets[0] if ends_in_tank else nets[1]
            pose = SymbolPose(position, y - 20, 2 if ends_in_tank else 0, ends_in_tank)
            paths = [(position, rails[net])], ()
            _draw_element(canvas, element, pose, component, paths if ends_in_tank else paths[::-1])
            valve_symbols.draw_tank(
                canvas,
                (position, y - 20 - _HALF_LENGTHS.get(element.kind, THROTTLE_HALF_LENGTH)),
                f"tank {component}",
                TANK_NODE,
                drop=4,
            )
        else:
            source_path, target_path = (
                [(lane, rails[net]), (lane, y - 24)]
                for net, lane in zip(nets, (position - 18, position + 18), strict=True)
            )
            pose = SymbolPose(position, y - 24, 3, is_mirrored=True)
            _draw_element(canvas, element, pose, component, (source_path, target_path))
        canvas.draw_labels(
            (position, y - 52),
            component,
            escape_label(name),
            [escape_label(text) for text in texts],
            62,
        )

    wires = [(nets[0], 16.0), (nets[1], 52.0)]
    if TANK_NODE in nets:
        wires = [(net, 34.0) for net in nets if net != TANK_NODE]
    return SupplyItem(76.0, 57.0 + LINE_HEIGHT * len(texts), wires, False, draw)


def _draw_element(
    canvas: CircuitCanvas,
    element: CircuitElement,
    pose: SymbolPose,
    component: str,
    paths: WirePaths,
) -> None:
    nets = element.source, element.target
    if element.kind == "relief":
        valve_symbols.draw_relief_valve(canvas, pose, component, nets, paths)
    elif element.kind == "check":
        valve_symbols.draw_check_valve(canvas, pose, component, nets, paths, element.pressure > 0)
    else:
        is_leak, is_adjustable = element.kind == "leak", bool(element.joints)
        valve_symbols.draw_throttle(canvas, pose, component, nets, paths, is_leak, is_adjustable)
