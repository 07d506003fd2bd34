"""The lines of open centres, from a pump through its valves to the throttle behind them."""

from collections.abc import Mapping, Sequence

from crane.hydraulics.circuit_elements import TANK_NODE
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.view.sketch.circuit import valve_symbols
from crane.view.sketch.circuit.circuit_canvas import CircuitCanvas, SheetPoint, SymbolPose
from crane.view.sketch.circuit.circuit_section import CircuitFunction

_FEED_LANE, _RETURN_LANE, _SIGNAL_OFFSET = 40.0, 59.0, 6.0  # lanes from a section's middle
_LANE_SPACING = 3.0  # between the lines of two pumps

CentreEnds = Mapping[str, tuple[float, SheetPoint, SheetPoint]]


class OpenCentreLines:
    """Open centres of all pumps.

    Args:
        hydraulics: The circuit.
        function_rows: Its functions by row.

    Attributes:
        row_nets: That go from one row of functions to another.
    """

    def __init__(self, hydraulics: Hydraulics, function_rows: Sequence[Sequence[CircuitFunction]]):
        self._hydraulics, self._function_rows = hydraulics, function_rows
        self._pump_names = [
            name
            for name in hydraulics.pumps
            if any(x.centre_nets and x.valve.supply == name for row in function_rows for x in row)
        ]
        self._last_joints = {
            x.valve.supply: x.joint for row in function_rows for x in row if x.centre_nets
        }
        self.row_nets: list[str] = []
        for row in function_rows:
            for name in self._pump_names:
                row_functions = [x for x in row if x.centre_nets and x.valve.supply == name]
                if row_functions and row_functions[-1].joint != self._last_joints[name]:
                    assert row_functions[-1].centre_nets is not None
                    self.row_nets.append(row_functions[-1].centre_nets[1])

    def _functions_of_pump(self, row: int, name: str) -> list[CircuitFunction]:
        return [x for x in self._function_rows[row] if x.centre_nets and x.valve.supply == name]

    def line_count(self, row: int) -> int:
        """How many lines of open centres a row has."""
        return sum(bool(self._functions_of_pump(row, name)) for name in self._pump_names)

    def line_heights(self, row: int, valve_height: float) -> dict[str, float]:
        """Heights at which they are handed on below the valves, by pump."""
        heights: dict[str, float] = {}
        for name in self._pump_names:
            if self._functions_of_pump(row, name):
                heights[name] = valve_height - 11.0 - 4.0 * len(heights)
        return heights

    def required_nets(self, row: int) -> set[str]:
        """Nets of a row that need a rail."""
        nets: set[str] = set()
        for name in self._pump_names:
            row_functions = self._functions_of_pump(row, name)
            if not row_functions:
                continue
            first, last = row_functions[0].centre_nets, row_functions[-1].centre_nets
            assert first is not None and last is not None
            nets.add(first[0])
            if row_functions[-1].joint != self._last_joints[name]:
                nets.add(last[1])
                continue
            nets.add(TANK_NODE)
            if self._hydraulics.pumps[name].control == "negative":
                nets.add(f"N {name}")
        return nets

    def draw(
        self,
        canvas: CircuitCanvas,
        row: int,
        centre_ends: CentreEnds,
        rail_heights: Mapping[str, float],
        line_heights: Mapping[str, float],
    ) -> None:
        """Join the open centres of a row.

        Args:
            canvas: What they are drawn with.
            row: Number of the row.
            centre_ends: Middle of a section and where its open centre begins and ends, by joint.
            rail_heights: Heights by net.
            line_heights: See `line_heights`.
        """
        for number, name in enumerate(line_heights):
            level, row_functions = line_heights[name], self._functions_of_pump(row, name)
            lane: float | None = None
            for function in row_functions:
                x, inlet, outlet = centre_ends[function.joint]
                assert function.centre_nets is not None
                inlet_net, outlet_net = function.centre_nets
                if lane is None:
                    lane = x - _FEED_LANE - 4.0 * number
                    canvas.draw_wire(inlet_net, (lane, rail_heights[inlet_net]), (lane, level))
                canvas.draw_wire(inlet_net, (lane, level), (inlet[0], level), inlet)
                lane = x + _RETURN_LANE + _LANE_SPACING * number
                outlet_height = outlet[1] + 9
                canvas.draw_wire(
                    outlet_net,
                    outlet,
                    (outlet[0], outlet_height),
                    (lane, outlet_height),
                    (lane, level),
                )
            assert lane is not None
            self._draw_end(canvas, name, lane, level, row_functions[-1], rail_heights)

    def _draw_end(
        self,
        canvas: CircuitCanvas,
        name: str,
        lane: float,
        line_height: float,
        last_function: CircuitFunction,
        rail_heights: Mapping[str, float],
    ) -> None:
        supply = self._hydraulics.pumps[name]
        assert last_function.centre_nets is not None
        net = last_function.centre_nets[1]
        if last_function.joint != self._last_joints[name]:
            canvas.draw_wire(net, (lane, line_height), (lane, rail_heights[net]))
            return
        if not supply.throttle:
            component = f"bypass {name}"
            canvas.add_port(component, net, (lane, line_height))
            canvas.add_port(component, TANK_NODE, (lane, line_height))
            canvas.draw_wire(TANK_NODE, (lane, line_height), (lane, rail_heights[TANK_NODE]))
            return
        middle = line_height - 5 - valve_symbols.THROTTLE_HALF_LENGTH
        canvas.draw_wire(
            net, (lane, line_height), (lane, middle + valve_symbols.THROTTLE_HALF_LENGTH)
        )
        valve_symbols.draw_throttle(
            canvas, SymbolPose(lane, middle, 2), f"throttle {name}", (net, TANK_NODE)
        )
        canvas.draw_wire(
            TANK_NODE,
            (lane, middle - valve_symbols.THROTTLE_HALF_LENGTH),
            (lane, rail_heights[TANK_NODE]),
        )
        if supply.control == "negative":
            signal, signal_lane = f"N {name}", lane + _SIGNAL_OFFSET
            canvas.add_port(f"throttle {name}", signal, (lane, line_height))
            canvas.draw_wire(
                signal,
                (lane, line_height),
                (signal_lane, line_height),
                (signal_lane, rail_heights[signal]),
                is_signal=True,
            )
