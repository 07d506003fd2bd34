"""Functions of a hydraulic circuit: actuators with their valves, and open-centre lines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from crane.common.units import format_quantity
from crane.hydraulics.circuit_elements import TANK_NODE, Supply
from crane.hydraulics.components import Cylinder, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics
from crane.view.sketches.circuit import valve_symbols
from crane.view.sketches.circuit.circuit_canvas import CircuitCanvas, SheetPoint, SymbolPose
from crane.view.sketches.circuit.valve_symbols import format_flow

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
        centre_nets: Nets before and behind its open centre; none for a closed centre.
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
    centre_nets: tuple[str, ...] = ()

    @property
    def ports(self) -> list[str]:
        """Lower ports of the valve, from the left."""
        availability = {
            "Ta": self.valve.return_a != self.valve.return_b,
            "LS": self.has_load_sensing,
            "P": True,
            "C": bool(self.centre_nets),
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
        flows = [format_flow(x * root_pressure_drop) for x in (valve.c1, valve.c4)]
        texts = ["2 spools: A, B"] if valve.spool_b else []
        if flows[0] == flows[1]:
            texts.append(f"{flows[0]} l/min")
        else:
            texts += [" | ".join(flows), "l/min"]
        if valve.margin > 0:
            return [*texts, f"Δp {format_quantity(valve.margin, 'Pa')}"]
        return [*texts, "sharing" if margin else f"at {format_quantity(_ORIFICE_DROP, 'Pa')}"]


def port_lane(function: CircuitFunction, port: str) -> float:
    """Return the offset of a port's lane from the middle of the section."""
    return (
        _SUPPLY_LANE_BESIDE_CENTRE if (port == "P" and function.centre_nets) else _PORT_LANES[port]
    )


def valve_rows(function: CircuitFunction) -> list[tuple[str, float]]:
    """Return names and heights of the rows between valve and actuator, upwards."""
    cylinder = function.cylinder
    heights = {
        "counterbalance a": 32.0 if cylinder.counterbalance_a is not None else 0.0,
        "counterbalance b": 32.0 if cylinder.counterbalance_b is not None else 0.0,
        "rupture": 22.0 if cylinder.rupture_a or cylinder.rupture_b else 0.0,
        "port": 44.0 if cylinder.relief else 34.0 if cylinder.refill else 0.0,
        "cross": 48.0 if cylinder.cross_relief else 0.0,
        "regeneration": 24.0 if function.valve.regeneration else 0.0,
        "tap": 8.0 if function.tapped_chambers else 0.0,
    }
    return [(name, height) for name, height in heights.items() if height]


class OpenCentreLines:
    """Open-centre lines of all pumps.

    Args:
        hydraulics: The circuit.
        function_rows: Its functions by row.

    Attributes:
        row_nets: Nets that go from one row of functions to another.
    """

    def __init__(self, hydraulics: Hydraulics, function_rows: Sequence[Sequence[CircuitFunction]]):
        self._hydraulics = hydraulics
        self._last_joints: dict[str, str] = {}
        self._rows: list[dict[str, list[CircuitFunction]]] = []
        for functions in function_rows:
            in_series = [x for x in functions if x.centre_nets]
            self._last_joints |= {x.valve.supply: x.joint for x in in_series}
            row = {
                name: [x for x in in_series if x.valve.supply == name] for name in hydraulics.pumps
            }
            self._rows.append({name: row[name] for name in row if row[name]})
        self.row_nets = [
            functions[-1].centre_nets[1]
            for row in self._rows
            for functions in row.values()
            if not self._ends_with(functions[-1])
        ]

    def _ends_with(self, function: CircuitFunction) -> bool:
        return function.joint == self._last_joints[function.valve.supply]

    def line_count(self, row: int) -> int:
        """Return the number of open-centre lines of a row."""
        return len(self._rows[row])

    def line_heights(self, row: int, valve_height: float) -> dict[str, float]:
        """Return the heights of the open-centre lines below the valves, by pump."""
        return {name: valve_height - 11.0 - 4.0 * k for k, name in enumerate(self._rows[row])}

    def required_nets(self, row: int) -> set[str]:
        """Return the nets of a row that need a rail."""
        nets: set[str] = set()
        for name, functions in self._rows[row].items():
            nets.add(functions[0].centre_nets[0])
            if not self._ends_with(functions[-1]):
                nets.add(functions[-1].centre_nets[1])
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
        for number, (name, functions) in enumerate(self._rows[row].items()):
            level, first_net = line_heights[name], functions[0].centre_nets[0]
            lane = centre_ends[functions[0].joint][0] - _FEED_LANE - 4.0 * number
            canvas.draw_wire(first_net, (lane, rail_heights[first_net]), (lane, level))
            for function in functions:
                x, inlet, outlet = centre_ends[function.joint]
                inlet_net, outlet_net = function.centre_nets
                canvas.draw_wire(inlet_net, (lane, level), (inlet[0], level), inlet)
                lane = x + _RETURN_LANE + _LANE_SPACING * number
                top = outlet[1] + 9
                canvas.draw_wire(outlet_net, outlet, (outlet[0], top), (lane, top), (lane, level))
            if self._ends_with(functions[-1]):
                self._draw_end(canvas, name, (lane, level), outlet_net, rail_heights)
            else:
                canvas.draw_wire(outlet_net, (lane, level), (lane, rail_heights[outlet_net]))

    def _draw_end(
        self,
        canvas: CircuitCanvas,
        name: str,
        end: SheetPoint,
        net: str,
        rail_heights: Mapping[str, float],
    ) -> None:
        """Draw the end of a line at the tank, through a throttle if the pump has one."""
        supply, lane, tank_rail = self._hydraulics.pumps[name], end[0], rail_heights[TANK_NODE]
        if not supply.throttle:
            canvas.add_port(f"bypass {name}", net, end)
            canvas.add_port(f"bypass {name}", TANK_NODE, end)
            canvas.draw_wire(TANK_NODE, end, (lane, tank_rail))
            return
        component = f"throttle {name}"
        valve_symbols.draw_throttle(
            canvas,
            SymbolPose(lane, end[1] - 5 - valve_symbols.THROTTLE_HALF_LENGTH, 2),
            component,
            (net, TANK_NODE),
            ([end], [(lane, tank_rail)]),
        )
        if supply.control == "negative":
            signal, signal_lane = f"N {name}", lane + _SIGNAL_OFFSET
            canvas.add_port(component, signal, end)
            canvas.draw_wire(
                signal,
                end,
                (signal_lane, end[1]),
                ((signal_lane, rail_heights[signal])),
                is_signal=True,
            )
