"""Functions of a hydraulic circuit: actuators with their valves, and open-centre lines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from crane.hydraulics.circuit_elements import TANK_NODE, Supply
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.view.sketches.circuit import valve_symbols
from crane.view.sketches.circuit.circuit_canvas import CircuitCanvas, SheetPoint, SymbolPose
from crane.view.sketches.circuit.valve_symbols import format_flow, format_pressure

_PORT_LANES = {"Ta": -26.0, "LS": -20.0, "P": 0.0, "T": 12.0}
_SUPPLY_LANE_BESIDE_CENTRE = -7.0  # lane of P beside an open centre
_COMPENSATOR_HEIGHT, _METERING_HEIGHT = 28.0, 48.0  # below the valve
_ORIFICE_DROP = 1.0e6  # pressure drop of the flows that labels of plain valves give [Pa]
_FEED_LANE, _RETURN_LANE, _SIGNAL_OFFSET = 40.0, 59.0, 6.0  # lanes from a section's middle
_LANE_SPACING = 3.0  # between the lines of two pumps

CentreEnds = Mapping[str, tuple[float, SheetPoint, SheetPoint]]


@dataclass(frozen=True)
class CircuitFunction:
    """A cylinder or motor with its valve.

    Attributes:
        joint: Joint that it drives.
        cylinder: The actuator.
        valve: Its valve.
        supply: The pump that feeds it.
        is_revolute: Whether the joint is revolute.
        stroke: Difference of the joint's limits [m], [rad]; infinite without limits.
        tapped_chambers: Chambers "a" and "b" that other components are connected to.
        has_load_sensing: Whether its load pressure goes to a pump or to other valves.
        shares_load_sensing: Whether other functions share this load-sensing line.
        centre_nets: Nets before and behind its open centre; None for a closed centre.
    """

    joint: str
    cylinder: Cylinder
    valve: Valve
    supply: Supply
    is_revolute: bool
    stroke: float
    tapped_chambers: frozenset[str] = frozenset()
    has_load_sensing: bool = False
    shares_load_sensing: bool = False
    centre_nets: tuple[str, str] | None = None

    @property
    def ports(self) -> list[str]:
        """Lower ports of the valve, from the left."""
        has_separate_returns = self.valve.return_a != self.valve.return_b
        availability = {
            "Ta": has_separate_returns,
            "LS": self.has_load_sensing,
            "P": True,
            "C": self.centre_nets is not None,
            "T": True,
        }
        return [name for name, is_present in availability.items() if is_present]

    @property
    def rails(self) -> dict[str, str]:
        """Nets with lines down to rails, by port of the valve or chamber."""
        valve = self.valve
        nets = {"P": valve.supply, "T": valve.return_b}
        if "Ta" in self.ports:
            nets["Ta"] = valve.return_a
        if self.has_load_sensing:
            nets["LS"] = f"LS {valve.supply}"
        return nets | {side: f"{self.joint}.{side}" for side in sorted(self.tapped_chambers)}

    @property
    def height_below(self) -> float:
        """Height required below the valve."""
        if self.valve.sharing:
            return _METERING_HEIGHT
        return _COMPENSATOR_HEIGHT if self.valve.margin > 0 else 8.0

    @property
    def valve_texts(self) -> list[str]:
        """Labels of the valve."""
        valve = self.valve
        margin = valve.margin or (self.supply.margin if valve.sharing else 0.0)
        root_pressure_drop = (margin or _ORIFICE_DROP) ** 0.5
        flow_in, flow_out = (
            format_flow(valve.c1 * root_pressure_drop),
            format_flow(valve.c4 * root_pressure_drop),
        )
        texts = (
            [f"{flow_in} l/min"] if flow_in == flow_out else [f"{flow_in} | {flow_out}", "l/min"]
        )
        if valve.spool_b:
            texts.insert(0, "2 spools: A, B")
        if valve.margin > 0:
            return [*texts, f"Δp {format_pressure(valve.margin)}"]
        return [*texts, "sharing"] if margin else [*texts, f"at {format_pressure(_ORIFICE_DROP)}"]


def port_lane(function: CircuitFunction, port: str) -> float:
    """Return the offset of a port's lane from the middle of the section."""
    if port == "P" and function.centre_nets is not None:
        return _SUPPLY_LANE_BESIDE_CENTRE
    return _PORT_LANES[port]


def valve_rows(function: CircuitFunction) -> list[tuple[str, float]]:
    """Return names and heights of the rows between valve and actuator, upwards."""
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
    if function.tapped_chambers:
        rows.append(("tap", 8.0))
    return rows


class OpenCentreLines:
    """Open-centre lines of all pumps.

    Args:
        hydraulics: The circuit.
        function_rows: Its functions by row.

    Attributes:
        row_nets: Nets that go from one row of functions to another.
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
        """Return the number of open-centre lines of a row."""
        return sum(bool(self._functions_of_pump(row, name)) for name in self._pump_names)

    def line_heights(self, row: int, valve_height: float) -> dict[str, float]:
        """Return the heights of the open-centre lines below the valves, by pump."""
        heights: dict[str, float] = {}
        for name in self._pump_names:
            if self._functions_of_pump(row, name):
                heights[name] = valve_height - 11.0 - 4.0 * len(heights)
        return heights

    def required_nets(self, row: int) -> set[str]:
        """Return the nets of a row that need a rail."""
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
        """Connect the open centres of a row.

        Args:
            canvas: Canvas of the drawing.
            row: Number of the row.
            centre_ends: Middle of a section and both ends of its open centre, by joint.
            rail_heights: Heights of the rails by net.
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
