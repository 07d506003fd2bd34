"""Section of a circuit drawing: the valve of one function above the rails, and its actuator."""

from collections.abc import Mapping

from crane.hydraulics.circuit_elements import TANK_NODE
from crane.hydraulics.components import CounterbalanceValve
from crane.view.plots.figure_style import escape_label
from crane.view.sketches.circuit import machine_symbols, valve_symbols
from crane.view.sketches.circuit.circuit_canvas import (
    NAME_TEXT_SIZE,
    CircuitCanvas,
    SheetPoint,
    SymbolPose,
)
from crane.view.sketches.circuit.circuit_functions import CircuitFunction, port_lane, valve_rows
from crane.view.sketches.circuit.valve_symbols import (
    SPOOL_HEIGHT,
    SpoolSymbol,
    format_area,
    format_displacement,
    format_flow,
    format_number,
    format_pressure,
)
from crane.view.sketches.sketch_canvas import format_joint_symbol

SECTION_WIDTH = 122.0
CHAMBER_LANE = 14.0  # of chambers, from the section's middle
_TAP_LANE = 55.0  # of chambers that something else is joined to, from the middle
_LINE_HEIGHT = 7.6  # height of a line of words
_PORT_BENDS = {"Ta": 3.0, "LS": 5.0, "P": 7.0, "T": 4.0}  # below the valve


class CircuitSection:
    """Draws one function of a circuit.

    Args:
        canvas: Canvas of the drawing.
        function: The function.
        x: Middle of the section.
        valve_bottom: Lower edge of the valve.
        actuator_middle: Height of the middle of the actuator.
        rail_heights: Heights of the rails by net.
        line_heights: Heights of the open-centre lines by pump.
    """

    def __init__(
        self,
        canvas: CircuitCanvas,
        function: CircuitFunction,
        x: float,
        valve_bottom: float,
        actuator_middle: float,
        rail_heights: Mapping[str, float],
        line_heights: Mapping[str, float],
    ):
        self._canvas, self._function, self._x = canvas, function, x
        self._valve_bottom, self._actuator_middle, self._rail_heights = (
            valve_bottom,
            actuator_middle,
            rail_heights,
        )
        self._centre_height = line_heights.get(function.valve.supply, valve_bottom)
        self._text_top = min(
            [valve_bottom - 8.5, *(level - 7.0 for level in line_heights.values())]
        )
        self._chamber_nets = {side: f"{function.joint}.{side}" for side in "ab"}

    def draw(self) -> tuple[SheetPoint, SheetPoint] | None:
        """Draw the section, and return the ends of its open centre if it has one."""
        function, canvas, x = self._function, self._canvas, self._x
        upper_ports = ["A", "C", "B"] if function.centre_nets else ["A", "B"]
        spool = SpoolSymbol(
            x, self._valve_bottom, function.ports, upper_ports, function.valve.float_from > 0
        )
        component = f"valve {function.joint}"
        spool.draw(canvas, component)
        for port, net in function.rails.items():
            if port in spool.port_positions:
                self._draw_port_line(spool, port, net, component)
        for k, text in enumerate(function.valve_texts):
            canvas.draw_text(
                x + 17, self._text_top - _LINE_HEIGHT * k, text, f"label {component}", ha="left"
            )
        top = self._valve_bottom + SPOOL_HEIGHT
        current_nets = {side: self._valve_side_net(side) for side in "ab"}
        for side, sign, port in (("a", -1, "A"), ("b", 1, "B")):
            canvas.add_port(component, current_nets[side], spool.port_positions[port])
            canvas.draw_wire(
                current_nets[side],
                spool.port_positions[port],
                (spool.port_positions[port][0], top + 4),
                (x + sign * CHAMBER_LANE, top + 4),
                (x + sign * CHAMBER_LANE, top + 8),
            )
        y = top + (14 if function.centre_nets else 8)
        if function.centre_nets:
            self._draw_chamber_lines(current_nets, top + 8, y)
        for name, height in valve_rows(function):
            self._draw_valve_row(name, y, height, current_nets)
            y += height
        self._draw_chamber_lines(
            current_nets, y, self._actuator_middle - machine_symbols.BARREL_HALF_HEIGHT
        )
        self._draw_actuator()
        if not function.centre_nets:
            return None
        inlet_net, outlet_net = function.centre_nets
        canvas.add_port(component, inlet_net, spool.port_positions["C"])
        canvas.add_port(component, outlet_net, spool.port_positions["C'"])
        return spool.port_positions["C"], spool.port_positions["C'"]

    def _valve_side_net(self, side: str) -> str:
        """Return the net of a chamber's line at the valve."""
        cylinder, net = self._function.cylinder, self._chamber_nets[side]
        has_counterbalance = getattr(cylinder, f"counterbalance_{side}") is not None
        has_rupture_valve = getattr(cylinder, f"rupture_{side}") > 0
        return f"{net} valve" if has_counterbalance or has_rupture_valve else net

    def _draw_chamber_lines(
        self, current_nets: Mapping[str, str], start: float, end: float
    ) -> None:
        for side, sign in (("a", -1), ("b", 1)):
            position = self._x + sign * CHAMBER_LANE
            self._canvas.draw_wire(current_nets[side], (position, start), (position, end))

    def _draw_port_line(self, spool: SpoolSymbol, port: str, net: str, component: str) -> None:
        """Draw the line from a port to its rail, with a compensator if there is one."""
        canvas, function, x = self._canvas, self._function, self._x
        lane, (position, y), rail_height = (
            x + port_lane(function, port),
            spool.port_positions[port],
            self._rail_heights[net],
        )
        bend_height = y - _PORT_BENDS[port]
        valve = function.valve
        if port == "LS":
            canvas.add_port(component, net, (position, y))
            canvas.draw_wire(
                net,
                (position, y),
                (position, bend_height),
                (lane, bend_height),
                (lane, rail_height),
                is_signal=True,
            )
            if function.shares_load_sensing:
                valve_symbols.draw_shuttle_valve(
                    canvas, (lane, rail_height), f"shuttle {function.joint}", net
                )
            return
        if port != "P" or not (valve.margin > 0 or valve.sharing):
            canvas.add_port(component, net, (position, y))
            canvas.draw_wire(
                net,
                (position, y),
                (position, bend_height),
                (lane, bend_height),
                (lane, rail_height),
            )
            return
        metered_net = f"{function.joint} metered"
        canvas.add_port(component, metered_net, (position, y))
        middle = y - 18
        canvas.draw_wire(
            metered_net,
            (position, y),
            (position, bend_height),
            (lane, bend_height),
            (lane, middle + valve_symbols.COMPENSATOR_HALF_LENGTH),
        )
        compensator_name = f"compensator {function.joint}"
        inlet_net = f"{function.joint} inlet" if valve.sharing else net
        valve_symbols.draw_compensator(
            canvas,
            SymbolPose(lane, middle, is_mirrored=True),
            compensator_name,
            (inlet_net, metered_net),
            valve.sharing,
        )
        bottom = middle - valve_symbols.COMPENSATOR_HALF_LENGTH
        if valve.sharing:
            valve_symbols.draw_throttle(
                canvas,
                SymbolPose(lane, bottom - 9),
                f"metering {function.joint}",
                (net, inlet_net),
                is_adjustable=True,
            )
            canvas.draw_wire(inlet_net, (lane, bottom), (lane, bottom - 2))
            bottom -= 16
        canvas.draw_wire(net, (lane, bottom), (lane, rail_height))

    def _draw_valve_row(
        self, name: str, y: float, height: float, current_nets: dict[str, str]
    ) -> None:
        cylinder, x, canvas = self._function.cylinder, self._x, self._canvas
        if name.startswith("counterbalance"):
            self._draw_counterbalance_valve(name[-1], y, height, current_nets)
            return
        if name == "rupture":
            self._draw_rupture_valves(y, height, current_nets)
            return
        self._draw_chamber_lines(current_nets, y, y + height)
        if name == "port":
            for side, sign in (("a", -1), ("b", 1)):
                self._draw_port_valves(side, sign, y, height)
        elif name == "cross":
            for k, (inlet_chamber, outlet_chamber, quarter_turns) in enumerate(
                (("a", "b", 3), ("b", "a", 1))
            ):
                self._draw_cross_relief(
                    inlet_chamber, outlet_chamber, quarter_turns, y + 12 + 22 * k
                )
            text = f"Δp {format_pressure(cylinder.cross_relief)}"
            canvas.draw_text(
                x + CHAMBER_LANE + 4, y + 23, text, f"label cross {cylinder.joint}", ha="left"
            )
        elif name == "regeneration":
            component, middle = f"regeneration {cylinder.joint}", y + 10
            nets = self._chamber_nets["b"], self._chamber_nets["a"]
            valve_symbols.draw_check_valve(canvas, SymbolPose(x, middle, 1), component, nets)
            canvas.draw_wire(
                nets[0], (x + valve_symbols.CHECK_HALF_LENGTH, middle), (x + CHAMBER_LANE, middle)
            )
            canvas.draw_wire(
                nets[1], (x - valve_symbols.CHECK_HALF_LENGTH, middle), (x - CHAMBER_LANE, middle)
            )
            canvas.draw_text(
                x + CHAMBER_LANE + 4, middle, "regen.", f"label {component}", ha="left"
            )
        elif name == "tap":
            for side in self._function.tapped_chambers:
                sign, net = (-1 if side == "a" else 1), self._chamber_nets[side]
                start, lane = (x + sign * CHAMBER_LANE, y + 2), x + sign * _TAP_LANE
                canvas.draw_wire(net, start, (lane, y + 2), (lane, self._rail_heights[net]))

    def _draw_cross_relief(
        self, inlet_chamber: str, outlet_chamber: str, quarter_turns: int, y: float
    ) -> None:
        canvas, x, nets = (
            self._canvas,
            self._x,
            (self._chamber_nets[inlet_chamber], self._chamber_nets[outlet_chamber]),
        )
        sign = -1 if inlet_chamber == "a" else 1
        component = f"cross {self._function.joint}.{inlet_chamber}"
        valve_symbols.draw_relief_valve(
            canvas,
            SymbolPose(x, y, quarter_turns, is_mirrored=quarter_turns == 3),
            component,
            nets,
        )
        canvas.draw_wire(
            nets[0], (x + sign * valve_symbols.RELIEF_HALF_LENGTH, y), (x + sign * CHAMBER_LANE, y)
        )
        canvas.draw_wire(
            nets[1], (x - sign * valve_symbols.RELIEF_HALF_LENGTH, y), (x - sign * CHAMBER_LANE, y)
        )

    def _draw_port_valves(self, side: str, sign: int, y: float, height: float) -> None:
        """Draw relief and suction valve of a chamber, each with a tank."""
        canvas, cylinder, net = self._canvas, self._function.cylinder, self._chamber_nets[side]
        lane, top = self._x + sign * CHAMBER_LANE, y + height - (12 if cylinder.relief else 6)
        if cylinder.relief:
            position, component = lane + sign * 15, f"relief {net}"
            middle = top - valve_symbols.RELIEF_HALF_LENGTH - 3
            canvas.draw_wire(
                net,
                (lane, top),
                (position, top),
                (position, middle + valve_symbols.RELIEF_HALF_LENGTH),
            )
            valve_symbols.draw_relief_valve(
                canvas,
                SymbolPose(position, middle, 2, is_mirrored=sign < 0),
                component,
                (net, TANK_NODE),
            )
            bottom = middle - valve_symbols.RELIEF_HALF_LENGTH
            valve_symbols.draw_tank(
                canvas, (position, bottom - 3), f"tank {component}", TANK_NODE, 4.5
            )
            canvas.draw_wire(TANK_NODE, (position, bottom), (position, bottom - 3))
            canvas.draw_text(
                lane + sign * 4,
                top + 6,
                format_pressure(cylinder.relief),
                f"label {component}",
                ha="left" if sign > 0 else "right",
            )
        if cylinder.refill:
            check_offset = 34 if cylinder.relief else 15
            position, component = lane + sign * check_offset, f"suction {net}"
            middle = top - valve_symbols.CHECK_HALF_LENGTH - 5
            start = (lane + sign * 15, top) if cylinder.relief else (lane, top)
            canvas.draw_wire(
                net, start, (position, top), (position, middle + valve_symbols.CHECK_HALF_LENGTH)
            )
            valve_symbols.draw_check_valve(
                canvas, SymbolPose(position, middle), component, (TANK_NODE, net)
            )
            bottom = middle - valve_symbols.CHECK_HALF_LENGTH
            valve_symbols.draw_tank(
                canvas, (position, bottom - 3), f"tank {component}", TANK_NODE, 4.5
            )
            canvas.draw_wire(TANK_NODE, (position, bottom), (position, bottom - 3))

    def _draw_counterbalance_valve(
        self, side: str, y: float, height: float, current_nets: dict[str, str]
    ) -> None:
        """Draw a counterbalance valve, piloted by the line of the other chamber."""
        canvas, sign = self._canvas, (-1 if side == "a" else 1)
        other_chamber = "b" if side == "a" else "a"
        lane, other_lane = self._x + sign * CHAMBER_LANE, self._x - sign * CHAMBER_LANE
        has_rupture_valve = getattr(self._function.cylinder, f"rupture_{side}") > 0
        valve_net, chamber_net = (
            current_nets[side],
            f"{self._chamber_nets[side]} held" if has_rupture_valve else self._chamber_nets[side],
        )
        component, middle = f"counterbalance {self._chamber_nets[side]}", y + height / 2
        canvas.draw_wire(valve_net, (lane, y), (lane, middle - valve_symbols.RELIEF_HALF_LENGTH))
        canvas.draw_wire(
            chamber_net, (lane, middle + valve_symbols.RELIEF_HALF_LENGTH), (lane, y + height)
        )
        valve_symbols.draw_relief_valve(
            canvas,
            SymbolPose(lane, middle, 2, is_mirrored=side == "b"),
            component,
            (chamber_net, valve_net),
        )
        check = lane + sign * 21
        for net, end, end_sign in ((valve_net, y + 3, -1), (chamber_net, y + height - 3, 1)):
            canvas.draw_wire(
                net,
                (lane, end),
                (check, end),
                (check, middle + end_sign * valve_symbols.CHECK_HALF_LENGTH),
            )
        valve_symbols.draw_check_valve(
            canvas, SymbolPose(check, middle), f"{component} check", (valve_net, chamber_net)
        )
        canvas.draw_wire(current_nets[other_chamber], (other_lane, y), (other_lane, y + height))
        pilot = lane - sign * 5.5
        canvas.draw_wire(
            current_nets[other_chamber], (other_lane, middle), (pilot, middle), is_signal=True
        )
        canvas.add_port(component, current_nets[other_chamber], (pilot, middle))
        valve: CounterbalanceValve = getattr(self._function.cylinder, f"counterbalance_{side}")
        texts = [format_pressure(valve.pressure), f"{format_number(valve.pilot_ratio)} : 1"]
        for k, text in enumerate(texts):
            canvas.draw_text(
                other_lane - sign * 5,
                middle + 4 - _LINE_HEIGHT * k,
                text,
                f"label {component}",
                ha="right" if sign > 0 else "left",
            )
        current_nets[side] = chamber_net

    def _draw_rupture_valves(self, y: float, height: float, current_nets: dict[str, str]) -> None:
        canvas, middle = self._canvas, y + height / 2
        for side, sign in (("a", -1), ("b", 1)):
            lane, flow = (
                self._x + sign * CHAMBER_LANE,
                getattr(self._function.cylinder, f"rupture_{side}"),
            )
            if not flow:
                canvas.draw_wire(current_nets[side], (lane, y), (lane, y + height))
                continue
            component, valve_net, chamber_net = (
                f"rupture {self._chamber_nets[side]}",
                current_nets[side],
                self._chamber_nets[side],
            )
            half_length = valve_symbols.CHECK_HALF_LENGTH + 2
            canvas.draw_wire(valve_net, (lane, y), (lane, middle - half_length))
            canvas.draw_wire(chamber_net, (lane, middle + half_length), (lane, y + height))
            valve_symbols.draw_rupture_valve(
                canvas, SymbolPose(lane, middle, 2), component, (chamber_net, valve_net)
            )
            for k, text in enumerate((format_flow(flow), "l/min")):
                canvas.draw_text(
                    lane + sign * 9,
                    middle + 4 - _LINE_HEIGHT * k,
                    text,
                    f"label {component}",
                    ha="left" if sign > 0 else "right",
                )
            current_nets[side] = chamber_net

    def _draw_actuator(self) -> None:
        canvas, function, position = self._canvas, self._function, (self._x, self._actuator_middle)
        cylinder, nets = function.cylinder, (self._chamber_nets["a"], self._chamber_nets["b"])
        if cylinder.motor:
            component = f"motor {function.joint}"
            machine_symbols.draw_motor(canvas, (position[0], position[1] + 2), component, nets)
            for net, sign in zip(nets, (-1, 1), strict=True):
                x = position[0] + sign * CHAMBER_LANE
                canvas.draw_wire(net, (x, position[1] - 8), (x, position[1] - 6))
            texts = [format_displacement(cylinder.area_a)]
        elif function.is_revolute:
            component = f"rotary drive {function.joint}"
            machine_symbols.draw_rotary_drive(canvas, position, component, nets)
            sizes = sorted(
                {format_displacement(cylinder.area_a), format_displacement(cylinder.area_b)}
            )
            texts = [" | ".join(sizes)]
        else:
            component = f"cylinder {function.joint}"
            machine_symbols.draw_cylinder(
                canvas, position, component, nets, cylinder.area_b / cylinder.area_a
            )
            texts = [f"{format_area(cylinder.area_a)} | {format_area(cylinder.area_b)} cm²"]
        if function.stroke < 1e6 and not cylinder.motor:
            angle_text = f"{format_number(function.stroke * 57.29578)}°"
            texts.append(
                angle_text
                if function.is_revolute
                else f"stroke {format_number(1e3 * function.stroke)} mm"
            )
        y = position[1] + TOP_HEIGHT - NAME_TEXT_SIZE / 2
        canvas.draw_text(
            position[0],
            y,
            format_joint_symbol(function.joint),
            f"name {component}",
            size=NAME_TEXT_SIZE,
            weight="bold",
            available_width=SECTION_WIDTH - 8,
        )
        for k, text in enumerate(texts):
            canvas.draw_text(
                position[0], y - 9 - _LINE_HEIGHT * k, escape_label(text), f"label {component}"
            )


TOP_HEIGHT = 46.0  # above the middle of an actuator, with its words
