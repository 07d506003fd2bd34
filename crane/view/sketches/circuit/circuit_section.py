"""Section of a circuit drawing: the valve of one function above the rails, and its actuator."""

from collections.abc import Mapping

from crane.common.units import format_number, format_quantity
from crane.hydraulics.circuit_elements import TANK_NODE
from crane.hydraulics.components import CounterbalanceValve
from crane.view.plots.figure_style import escape_label, joint_symbol
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
    format_displacement,
    format_flow,
    format_pressure,
)

SECTION_WIDTH = 122.0
TOP_HEIGHT = 46.0  # above the middle of an actuator, with its words
_SIGNS = {"a": -1, "b": 1}  # sides of the chambers
CHAMBER_LANE = 14.0  # of chambers, from the section's middle
_TAP_LANE = 55.0  # of chambers that something else is joined to, from the middle
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
        self._valve_bottom, self._actuator_middle = valve_bottom, actuator_middle
        self._rail_heights = rail_heights
        self._text_top = min(
            [valve_bottom - 8.5, *(level - 7.0 for level in line_heights.values())]
        )
        self._nets = {side: f"{function.joint}.{side}" for side in _SIGNS}
        self._lanes = {side: x + sign * CHAMBER_LANE for side, sign in _SIGNS.items()}

    def draw(self) -> tuple[SheetPoint, SheetPoint] | None:
        """Draw the section, and return the ends of its open centre if it has one."""
        function, canvas = self._function, self._canvas
        spool = SpoolSymbol(
            self._x,
            self._valve_bottom,
            function.ports,
            ["A", "C'", "B"] if function.centre_nets else ["A", "B"],
            function.valve.float_from > 0,
        )
        component, ports = f"valve {function.joint}", spool.port_positions
        spool.draw(canvas, component)
        for port, net in function.rails.items():
            if port in ports:
                self._draw_port_line(ports[port], port, net, component)
        canvas.draw_texts(
            self._x + 17, self._text_top, function.valve_texts, f"label {component}", ha="left"
        )
        top = self._valve_bottom + SPOOL_HEIGHT
        y = top + (14 if function.centre_nets else 8)
        current_nets = dict(self._nets)
        for side, lane in self._lanes.items():
            has_counterbalance = getattr(function.cylinder, f"counterbalance_{side}") is not None
            if has_counterbalance or getattr(function.cylinder, f"rupture_{side}") > 0:
                current_nets[side] += " valve"
            port_x, _ = ports[side.upper()]
            canvas.add_port(component, current_nets[side], (port_x, top))
            canvas.draw_wire(
                current_nets[side],
                (port_x, top),
                (port_x, top + 4),
                (lane, top + 4),
                (lane, top + 8),
                (lane, y),
            )
        for name, height in valve_rows(function):
            self._draw_valve_row(name, y, height, current_nets)
            y += height
        self._draw_chamber_lines(
            current_nets, y, self._actuator_middle - machine_symbols.BARREL_HALF_HEIGHT
        )
        self._draw_actuator()
        if not function.centre_nets:
            return None
        for port, net in zip(("C", "C'"), function.centre_nets, strict=True):
            canvas.add_port(component, net, ports[port])
        return ports["C"], ports["C'"]

    def _draw_chamber_lines(
        self, current_nets: Mapping[str, str], start: float, end: float
    ) -> None:
        for side, lane in self._lanes.items():
            self._canvas.draw_wire(current_nets[side], (lane, start), (lane, end))

    def _draw_port_line(self, position: SheetPoint, port: str, net: str, component: str) -> None:
        """Draw the line from a port to its rail, with a compensator if there is one."""
        canvas, function, valve = self._canvas, self._function, self._function.valve
        lane, bend_height = self._x + port_lane(function, port), position[1] - _PORT_BENDS[port]
        rail = (lane, self._rail_heights[net])
        bend = [position, (position[0], bend_height), (lane, bend_height)]
        if port != "P" or not (valve.margin > 0 or valve.sharing):
            canvas.add_port(component, net, position)
            canvas.draw_wire(net, *bend, rail, is_signal=port == "LS")
            if port == "LS" and function.shares_load_sensing:
                valve_symbols.draw_shuttle_valve(canvas, rail, f"shuttle {function.joint}", net)
            return
        metered_net = f"{function.joint} metered"
        canvas.add_port(component, metered_net, position)
        pose = SymbolPose(lane, position[1] - 18, is_mirrored=True)
        inlet_net, inlet_path = net, [rail]
        if valve.sharing:
            inlet_net, inlet_path = f"{function.joint} inlet", []
            bottom = pose.y - valve_symbols.COMPENSATOR_HALF_LENGTH
            valve_symbols.draw_throttle(
                canvas,
                SymbolPose(lane, bottom - 9),
                f"metering {function.joint}",
                (net, inlet_net),
                ([rail], [(lane, bottom)]),
                is_adjustable=True,
            )
        valve_symbols.draw_compensator(
            canvas,
            pose,
            f"compensator {function.joint}",
            (inlet_net, metered_net),
            (inlet_path, bend),
            valve.sharing,
        )

    def _draw_valve_row(
        self, name: str, y: float, height: float, current_nets: dict[str, str]
    ) -> None:
        kind, _, side = name.partition(" ")
        if kind == "counterbalance":
            self._draw_counterbalance_valve(side, y, height, current_nets)
            return
        if kind == "rupture":
            self._draw_rupture_valves(y, height, current_nets)
            return
        self._draw_chamber_lines(current_nets, y, y + height)
        canvas, x, joint = self._canvas, self._x, self._function.joint
        text_x = self._lanes["b"] + 4
        if kind == "port":
            for side in _SIGNS:
                self._draw_port_valves(side, y + height)
        if kind == "cross":
            for inlet, outlet, level in (("a", "b", y + 12), ("b", "a", y + 34)):
                pose = SymbolPose(x, level, 3 if inlet == "a" else 1, is_mirrored=inlet == "a")
                paths = [(self._lanes[inlet], level)], [(self._lanes[outlet], level)]
                nets = self._nets[inlet], self._nets[outlet]
                valve_symbols.draw_relief_valve(
                    canvas, pose, f"cross {joint}.{inlet}", nets, paths
                )
            canvas.draw_text(
                text_x,
                y + 23,
                f"Δp {format_quantity(self._function.cylinder.cross_relief, 'Pa')}",
                f"label cross {joint}",
                ha="left",
            )
        if kind == "regeneration":
            component, middle = f"regeneration {joint}", y + 10
            paths = [(self._lanes["b"], middle)], [(self._lanes["a"], middle)]
            nets = self._nets["b"], self._nets["a"]
            pose = SymbolPose(x, middle, 1)
            valve_symbols.draw_check_valve(canvas, pose, component, nets, paths)
            canvas.draw_text(text_x, middle, "regen.", f"label {component}", ha="left")
        if kind == "tap":
            for side in self._function.tapped_chambers:
                net, lane = self._nets[side], x + _SIGNS[side] * _TAP_LANE
                canvas.draw_wire(
                    net,
                    (self._lanes[side], y + 2),
                    (lane, y + 2),
                    ((lane, self._rail_heights[net])),
                )

    def _draw_port_valves(self, side: str, row_top: float) -> None:
        """Draw relief and suction valve of a chamber, each with a tank."""
        canvas, cylinder, net = self._canvas, self._function.cylinder, self._nets[side]
        lane, sign, top = self._lanes[side], _SIGNS[side], row_top - 6
        path = [(lane, top)]
        if cylinder.relief:
            top = row_top - 12
            position, component = lane + sign * 15, f"relief {net}"
            path = [(lane, top), (position, top)]
            middle = top - valve_symbols.RELIEF_HALF_LENGTH - 3
            pose = SymbolPose(position, middle, 2, is_mirrored=sign < 0)
            valve_symbols.draw_relief_valve(canvas, pose, component, (net, TANK_NODE), (path, []))
            valve_symbols.draw_tank(
                canvas,
                ((position, middle - valve_symbols.RELIEF_HALF_LENGTH)),
                f"tank {component}",
                TANK_NODE,
                4.5,
                drop=3,
            )
            text, alignment = (
                format_pressure(cylinder.relief),
                "left" if sign > 0 else "right",
            )
            canvas.draw_text(lane + sign * 4, top + 6, text, f"label {component}", ha=alignment)
        if cylinder.refill:
            position, component = lane + sign * (34 if cylinder.relief else 15), f"suction {net}"
            pose = SymbolPose(position, top - valve_symbols.CHECK_HALF_LENGTH - 5)
            valve_symbols.draw_check_valve(
                canvas, pose, component, (TANK_NODE, net), ([], [path[-1], (position, top)])
            )
            valve_symbols.draw_tank(
                canvas,
                ((position, pose.y - valve_symbols.CHECK_HALF_LENGTH)),
                f"tank {component}",
                TANK_NODE,
                4.5,
                drop=3,
            )

    def _draw_counterbalance_valve(
        self, side: str, y: float, height: float, current_nets: dict[str, str]
    ) -> None:
        """Draw a counterbalance valve, piloted by the line of the other chamber."""
        canvas, sign, cylinder = self._canvas, _SIGNS[side], self._function.cylinder
        other_chamber = "b" if side == "a" else "a"
        lane, other_lane = self._lanes[side], self._lanes[other_chamber]
        valve_net, pilot_net = current_nets[side], current_nets[other_chamber]
        chamber_net = self._nets[side]
        if getattr(cylinder, f"rupture_{side}") > 0:
            chamber_net += " held"
        component, middle, top = f"counterbalance {self._nets[side]}", y + height / 2, y + height
        pose = SymbolPose(lane, middle, 2, is_mirrored=side == "b")
        paths = [(lane, top)], [(lane, y)]
        valve_symbols.draw_relief_valve(canvas, pose, component, (chamber_net, valve_net), paths)
        check = lane + sign * 21
        paths = [(lane, y + 3), (check, y + 3)], [(lane, top - 3), (check, top - 3)]
        pose, nets = SymbolPose(check, middle), (valve_net, chamber_net)
        valve_symbols.draw_check_valve(canvas, pose, f"{component} check", nets, paths)
        canvas.draw_wire(pilot_net, (other_lane, y), (other_lane, top))
        pilot = (lane - sign * 5.5, middle)
        canvas.draw_wire(pilot_net, (other_lane, middle), pilot, is_signal=True)
        canvas.add_port(component, pilot_net, pilot)
        valve: CounterbalanceValve = getattr(cylinder, f"counterbalance_{side}")
        text_x, alignment = other_lane - sign * 5, "right" if sign > 0 else "left"
        canvas.draw_texts(
            text_x,
            middle + 4,
            [format_pressure(valve.pressure), f"{format_number(valve.pilot_ratio)} : 1"],
            f"label {component}",
            ha=alignment,
        )
        current_nets[side] = chamber_net

    def _draw_rupture_valves(self, y: float, height: float, current_nets: dict[str, str]) -> None:
        canvas, middle, top = self._canvas, y + height / 2, y + height
        for side, sign in _SIGNS.items():
            lane, flow = self._lanes[side], getattr(self._function.cylinder, f"rupture_{side}")
            if not flow:
                canvas.draw_wire(current_nets[side], (lane, y), (lane, top))
                continue
            component, nets = f"rupture {self._nets[side]}", (self._nets[side], current_nets[side])
            valve_symbols.draw_rupture_valve(
                canvas, SymbolPose(lane, middle, 2), component, nets, ([(lane, top)], [(lane, y)])
            )
            texts, alignment = (format_flow(flow), "l/min"), "left" if sign > 0 else "right"
            canvas.draw_texts(
                lane + sign * 9, middle + 4, texts, f"label {component}", ha=alignment
            )
            current_nets[side] = self._nets[side]

    def _draw_actuator(self) -> None:
        canvas, function, (x, y) = self._canvas, self._function, (self._x, self._actuator_middle)
        cylinder, nets = function.cylinder, (self._nets["a"], self._nets["b"])
        if cylinder.motor:
            component = f"motor {function.joint}"
            machine_symbols.draw_motor(canvas, (x, y + 2), component, nets)
            for side, lane in self._lanes.items():
                canvas.draw_wire(self._nets[side], (lane, y - 8), (lane, y - 6))
            texts = [format_displacement(cylinder.area_a)]
        elif function.is_revolute:
            component = f"rotary drive {function.joint}"
            machine_symbols.draw_rotary_drive(canvas, (x, y), component, nets)
            texts = [
                " | ".join(
                    sorted(
                        {format_displacement(area) for area in (cylinder.area_a, cylinder.area_b)}
                    )
                )
            ]
        else:
            component = f"cylinder {function.joint}"
            machine_symbols.draw_cylinder(
                canvas, (x, y), component, nets, cylinder.area_b / cylinder.area_a
            )
            areas = (format_number(1e4 * x) for x in (cylinder.area_a, cylinder.area_b))
            texts = [f"{' | '.join(areas)} cm²"]
        if function.stroke < 1e6 and not cylinder.motor:
            texts.append(
                f"{format_number(function.stroke * 57.29578)}°"
                if function.is_revolute
                else f"stroke {format_number(1e3 * function.stroke)} mm"
            )
        canvas.draw_labels(
            (x, y + TOP_HEIGHT - NAME_TEXT_SIZE / 2), component,
            joint_symbol(function.joint), map(escape_label, texts), SECTION_WIDTH - 8,
        )  # fmt: skip
