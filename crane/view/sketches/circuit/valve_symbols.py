"""Symbols of valves (ISO 1219-1), and texts of hydraulic quantities."""

import math
from collections.abc import Sequence

from crane.common.units import format_number, format_quantity
from crane.view.sketches.circuit.circuit_canvas import CircuitCanvas, SheetPoint, SymbolPose


def format_pressure(pressure: float) -> str:
    """Return a pressure [Pa] as text in bar."""
    return format_quantity(pressure, "Pa")


def format_flow(flow: float) -> str:
    """Return a flow [m3/s] in l/min, without unit."""
    return format_number(flow * 6e4)


def format_displacement(displacement: float) -> str:
    """Return a displacement [m3/rad] as text per revolution."""
    return f"{format_number(displacement * 2e6 * math.pi)} cm³/rev"


SPOOL_HEIGHT = 20.0
_END_WIDTH = 12.0  # of springs and signals


class SpoolSymbol:
    """Boxes of a directional valve: straight, middle, crossed and, if any, floating position.

    Args:
        x: Middle of the middle box.
        y: Lower edge.
        lower_ports: Lower ports from the left, of "Ta", "LS", "P", "C", "T".
        upper_ports: Upper ports, of "A", "C'", "B"; "C'" is the upper outlet of the open centre.
        has_float_position: Whether it has a floating position.

    Attributes:
        port_positions: Positions of the ports of the middle box by name.
    """

    def __init__(
        self,
        x: float,
        y: float,
        lower_ports: Sequence[str],
        upper_ports: Sequence[str],
        has_float_position: bool,
    ):
        self._x, self._y, self._has_float_position = x, y, has_float_position
        self._width = 15.0 if has_float_position else 20.0
        half_range = 0.35 * self._width
        self.port_positions: dict[str, SheetPoint] = {
            name: (x + half_range * (2 * i / (len(names) - 1) - 1), level)
            for names, level in ((lower_ports, y), (upper_ports, y + SPOOL_HEIGHT))
            for i, name in enumerate(names)
        }

    def draw(self, canvas: CircuitCanvas, component: str) -> None:
        """Draw the symbol."""
        x, y, w, ports = self._x, self._y, self._width, self.port_positions
        box_count = 4 if self._has_float_position else 3
        first, last = x - 1.5 * w, x + (box_count - 1.5) * w
        canvas.draw_box((first, y), (last, y + SPOOL_HEIGHT), gid=component)
        for k in range(1, box_count):
            canvas.draw_line([(first + k * w, y), (first + k * w, y + SPOOL_HEIGHT)])
        for height in (y - 1.8, y + SPOOL_HEIGHT + 1.8):  # of a proportional valve
            canvas.draw_line([(first, height), (last, height)], linewidth=0.6)
        bottom, top, spring_height = y + 1.5, y + 0.46 * SPOOL_HEIGHT, y + 0.74 * SPOOL_HEIGHT
        for end_x, sign in ((first, -1), (last, 1)):
            outer_x = end_x + sign * _END_WIDTH
            canvas.draw_spring((end_x, spring_height), (outer_x, spring_height), half_width=3.0)
            left, right = sorted((end_x, outer_x))
            canvas.draw_box((left, bottom), (right, top))
            canvas.draw_arrow((left - 0.5, bottom - 1.5), (right + 0.5, top + 1.5), size=3.0)
            canvas.draw_line(
                [
                    *[(end_x + sign * 0.3 * _END_WIDTH, bottom)],
                    (end_x + sign * 0.7 * _END_WIDTH, top),
                ]
            )
        self._draw_position(canvas, -w, [("P", "A"), ("B", "T")])
        self._draw_position(canvas, 0.0, [("C", "C'")] if "C" in ports else [])
        self._draw_position(canvas, w, [("P", "B"), ("A", ("Ta" if "Ta" in ports else "T"))])
        if self._has_float_position:
            connected = [name for name in ("A", "B", "Ta", "T") if name in ports]
            level = y + 0.55 * SPOOL_HEIGHT
            for name in connected:
                position_x, port_y = ports[name]
                canvas.draw_line([(position_x + 2 * w, port_y), (position_x + 2 * w, level)])
            port_x = [ports[name][0] + 2 * w for name in connected]
            canvas.draw_line([(min(port_x), level), (max(port_x), level)])
            self._draw_closed_ports(canvas, 2 * w, connected)

    def _draw_position(
        self, canvas: CircuitCanvas, offset: float, flow_paths: list[tuple[str, str]]
    ) -> None:
        for path in flow_paths:
            (x, y), (end_x, end_y) = (self.port_positions[name] for name in path)
            canvas.draw_arrow((x + offset, y), (end_x + offset, end_y), size=4.0)
        self._draw_closed_ports(canvas, offset, [name for path in flow_paths for name in path])

    def _draw_closed_ports(
        self, canvas: CircuitCanvas, offset: float, open_ports: Sequence[str]
    ) -> None:
        for name, (x, y) in self.port_positions.items():
            if name not in (*open_ports, "LS"):
                x, end = x + offset, y + (5 if y == self._y else -5)
                canvas.draw_line([(x, y), (x, end)])
                canvas.draw_line([(x - 2, end), (x + 2, end)])


RELIEF_HALF_LENGTH, CHECK_HALF_LENGTH, THROTTLE_HALF_LENGTH, COMPENSATOR_HALF_LENGTH = (
    9.0,
    7.0,
    7.0,
    8.0,
)  # from the middle to either port
_PILOT_DASHES = (0, (2, 1.5))
WirePaths = tuple[Sequence[SheetPoint], Sequence[SheetPoint]]


def _draw_ports(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    paths: WirePaths,
    port_distance: float,
    body_half_length: float,
) -> None:
    """Add both ports, and draw their lines to the body and the wires that end at them."""
    for net, path, sign in zip(nets, paths, (-1, 1), strict=True):
        port, end = pose((0, sign * port_distance), (0, sign * body_half_length))
        canvas.add_port(component, net, port)
        canvas.draw_wire(net, *path, port)
        if port_distance > body_half_length:
            canvas.draw_line([port, end], linewidth=1.0)


def _draw_spool_valve(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    half_width: float,
    arrow_x: float,
    spring_end: float,
    pilot_y: float,
) -> None:
    """Draw a valve with a spring and a pilot line."""
    canvas.draw_box(*pose((-half_width, -half_width), (half_width, half_width)), gid=component)
    canvas.draw_arrow(*pose((arrow_x, -half_width), (arrow_x, half_width)))
    canvas.draw_spring(*pose((half_width, 0), (spring_end, 0)))
    canvas.draw_line(
        pose((0, pilot_y), (-8.5, pilot_y), (-8.5, 0), (-half_width, 0)),
        linewidth=0.6,
        linestyle=_PILOT_DASHES,
    )


def draw_relief_valve(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    paths: WirePaths,
) -> None:
    """Draw a pressure relief valve.

    Args:
        canvas: Canvas of the drawing.
        pose: Pose of the symbol.
        component: Name of the component.
        nets: Nets of inlet and outlet.
        paths: Points of the wires that end at the inlet and at the outlet.
    """
    _draw_ports(canvas, pose, component, nets, paths, RELIEF_HALF_LENGTH, 5.5)
    _draw_spool_valve(canvas, pose, component, 5.5, 2.2, 12, -7.5)


def draw_compensator(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    paths: WirePaths,
    senses_outlet: bool,
) -> None:
    """Draw a pressure compensator, closed by its inlet or outlet pressure."""
    _draw_ports(canvas, pose, component, nets, paths, COMPENSATOR_HALF_LENGTH, 6.0)
    _draw_spool_valve(canvas, pose, component, 6, 0, 11, -7.5 if senses_outlet else 7.5)


def draw_check_valve(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    paths: WirePaths,
    has_spring: bool = False,
) -> None:
    """Draw a check valve, optionally with a spring."""
    _draw_ports(canvas, pose, component, nets, paths, CHECK_HALF_LENGTH, CHECK_HALF_LENGTH)
    canvas.draw_line(pose((0, -CHECK_HALF_LENGTH), (0, -3.8)), linewidth=1.0)
    canvas.draw_circle(pose((0, 0.4))[0], 3.0, gid=component)
    canvas.draw_line(pose((-4.4, 0.4), (0, -3.9), (4.4, 0.4)))
    outlet = pose((0, 3.4), (0, CHECK_HALF_LENGTH))
    if has_spring:
        canvas.draw_spring(*outlet, half_width=1.8)
    else:
        canvas.draw_line(outlet, linewidth=1.0)


def draw_throttle(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    paths: WirePaths,
    is_laminar: bool = False,
    is_adjustable: bool = False,
) -> None:
    """Draw an orifice or a laminar throttle; an arrow shows that it is adjustable."""
    half_length = THROTTLE_HALF_LENGTH
    _draw_ports(canvas, pose, component, nets, paths, half_length, half_length)
    canvas.draw_line(pose((0, -half_length), (0, half_length)), linewidth=1.0, gid=component)
    for sign in (-1, 1):
        if is_laminar:
            arc = [(sign * (4.6 - 2.8 * math.cos(0.25 * k)), 1.25 * k) for k in range(-4, 5)]
        else:
            arc = [(sign * 4.6, -4.0), (sign * 1.6, 0.0), (sign * 4.6, 4.0)]
        canvas.draw_line(pose(*arc))
    if is_adjustable:
        canvas.draw_arrow(*pose((-8, -3.5), (8, 3.5)))


def draw_rupture_valve(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    paths: WirePaths,
) -> None:
    """Draw a hose rupture valve."""
    _draw_ports(canvas, pose, component, nets, paths, CHECK_HALF_LENGTH + 2, 6.5)
    canvas.draw_box(*pose((-6, -6.5), (6, 6.5)), gid=component)
    canvas.draw_circle(pose((0, 0.5))[0], 2.2, zorder=3.1)
    canvas.draw_line(pose((-3.4, -2.4), (0, -5.6), (3.4, -2.4)))
    canvas.draw_spring(*pose((0, -1.6), (0, -5.4)), half_width=1.2)
    canvas.draw_line(pose((0, 2.7), (0, 6.5)))


def draw_shuttle_valve(
    canvas: CircuitCanvas, position: SheetPoint, component: str, net: str
) -> None:
    """Draw a shuttle valve."""
    x, y = position
    canvas.add_port(component, net, position)
    canvas.draw_box((x - 4, y - 2.6), (x + 4, y + 2.6), gid=component)
    canvas.draw_circle((x, y), 1.6, zorder=3.1)
    for sign in (-1, 1):
        canvas.draw_line([(x + sign * 3.6, y + 2), (x + sign * 1.8, y), (x + sign * 3.6, y - 2)],
                 linewidth=0.6)  # fmt: skip


def draw_tank(
    canvas: CircuitCanvas,
    position: SheetPoint,
    component: str,
    net: str,
    half_width: float = 5.0,
    drop: float = 0.0,
) -> None:
    """Draw a tank at the end of a line that goes down from a position by `drop`."""
    x, y = position[0], position[1] - drop
    canvas.draw_wire(net, position, (x, y))
    canvas.add_port(component, net, (x, y))
    left, right = x - half_width, x + half_width
    canvas.draw_line(
        [(left, y + 3.2), (left, y - 2), (right, y - 2), (right, y + 3.2)],
        linewidth=1.0,
        gid=component,
    )
