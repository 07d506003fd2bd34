"""Symbols of valves (ISO 1219-1), and texts of hydraulic quantities."""

import math
from collections.abc import Sequence

from crane.view.sketches.circuit.circuit_canvas import CircuitCanvas, SheetPoint, SymbolPose


def format_number(value: float) -> str:
    """Return a number with three digits, without exponent in the usual range."""
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
        text = f"{value:.{digits}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    return f"{value:.2e}"


def format_pressure(pressure: float) -> str:
    """Return a pressure [Pa] as text in bar."""
    return f"{format_number(pressure / 1e5)} bar"


def format_flow(flow: float) -> str:
    """Return a flow [m3/s] in l/min, without unit."""
    return format_number(flow * 6e4)


def format_volume(cubic: float) -> str:
    """Return a volume [m3] as text."""
    return (
        f"{format_number(cubic * 1e3)} l" if cubic >= 1e-4 else f"{format_number(cubic * 1e6)} cm³"
    )


def format_area(area: float) -> str:
    """Return an area [m2] in cm2, without unit."""
    return format_number(area * 1e4)


def format_displacement(displacement: float) -> str:
    """Return a displacement [m3/rad] as text per revolution."""
    volume_per_turn = displacement * 2 * math.pi
    return (
        f"{format_number(volume_per_turn * 1e3)} l/rev"
        if volume_per_turn >= 1e-3
        else f"{format_number(volume_per_turn * 1e6)} cm³/rev"
    )


SPOOL_HEIGHT = 20.0
_END_WIDTH = 12.0  # of springs and signals


class SpoolSymbol:
    """Boxes of a directional valve: straight, middle, crossed and, if any, floating position.

    Args:
        x: Middle of the middle box.
        y: Lower edge.
        lower_ports: Lower ports from the left, of "Ta", "LS", "P", "C", "T".
        upper_ports: Upper ports, of "A", "C", "B".
        has_float_position: Whether it has a floating position.

    Attributes:
        port_positions: Positions by name; "C'" is the upper outlet of the open centre.
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
        self._lower_ports = dict(
            zip(lower_ports, self._spread_ports(len(lower_ports)), strict=True)
        )
        self._upper_ports = dict(
            zip(upper_ports, self._spread_ports(len(upper_ports)), strict=True)
        )
        self.port_positions: dict[str, SheetPoint] = {
            name: (x + port_offset, y) for name, port_offset in self._lower_ports.items()
        }
        self.port_positions |= {
            ("C'" if name == "C" else name): (x + at, y + SPOOL_HEIGHT)
            for name, at in self._upper_ports.items()
        }

    def _spread_ports(self, count: int) -> list[float]:
        half_range = 0.35 * self._width
        return [half_range * (2 * i / (count - 1) - 1) for i in range(count)]

    def draw(self, canvas: CircuitCanvas, component: str) -> None:
        """Draw the symbol."""
        x, y, w = self._x, self._y, self._width
        first, last = x - 1.5 * w, x + (2.5 if self._has_float_position else 1.5) * w
        corners = [(first, y), (last, y), (last, y + SPOOL_HEIGHT), (first, y + SPOOL_HEIGHT)]
        canvas.draw_shape(corners, gid=component)
        for k in range(1, 4 if self._has_float_position else 3):
            canvas.draw_line([(first + k * w, y), (first + k * w, y + SPOOL_HEIGHT)])
        for height in (y - 1.8, y + SPOOL_HEIGHT + 1.8):  # of a proportional valve
            canvas.draw_line([(first, height), (last, height)], linewidth=0.6)
        for end_x, sign in ((first, -1), (last, 1)):
            canvas.draw_spring(
                (end_x, y + 0.74 * SPOOL_HEIGHT),
                (end_x + sign * _END_WIDTH, y + 0.74 * SPOOL_HEIGHT),
                half_width=3.0,
            )
            box = sorted((end_x, end_x + sign * _END_WIDTH))
            box_bottom, box_top = y + 1.5, y + 0.46 * SPOOL_HEIGHT
            canvas.draw_shape(
                [(box[0], box_bottom), (box[1], box_bottom), (box[1], box_top), (box[0], box_top)]
            )
            canvas.draw_arrow(
                (box[0] - 0.5, box_bottom - 1.5), (box[1] + 0.5, box_top + 1.5), size=3.0
            )
            canvas.draw_line(
                [
                    (end_x + sign * 0.3 * _END_WIDTH, box_bottom),
                    (end_x + sign * 0.7 * _END_WIDTH, box_top),
                ]
            )
        tank_a = "Ta" if "Ta" in self._lower_ports else "T"
        self._draw_flow_paths(canvas, x - w, [("P", "A"), ("B", "T")], set())
        self._draw_middle_position(canvas, x)
        self._draw_flow_paths(canvas, x + w, [("P", "B"), ("A", tank_a)], set())
        if self._has_float_position:
            self._draw_float_position(canvas, x + 2 * w)

    def _draw_flow_paths(
        self,
        canvas: CircuitCanvas,
        x: float,
        flow_paths: list[tuple[str, str]],
        used_ports: set[str],
    ) -> None:
        for source, target in flow_paths:
            start, end = self._port_position(x, source), self._port_position(x, target)
            canvas.draw_arrow(start, end, size=4.0)
            used_ports |= {source, target}
        self._draw_closed_ports(canvas, x, used_ports | {"LS"})

    def _port_position(self, x: float, name: str) -> SheetPoint:
        if name in self._upper_ports:
            return x + self._upper_ports[name], self._y + SPOOL_HEIGHT
        return x + self._lower_ports[name], self._y

    def _draw_closed_ports(self, canvas: CircuitCanvas, x: float, used_ports: set[str]) -> None:
        for row, level, sign in (
            (self._lower_ports, self._y, 1),
            (self._upper_ports, self._y + SPOOL_HEIGHT, -1),
        ):
            for name, position in row.items():
                if name in used_ports:
                    continue
                end = level + sign * 5
                canvas.draw_line([(x + position, level), (x + position, end)])
                canvas.draw_line([(x + position - 2, end), (x + position + 2, end)])

    def _draw_middle_position(self, canvas: CircuitCanvas, x: float) -> None:
        used_ports = {"LS"}
        if "C" in self._lower_ports:
            start, end = (
                (x + self._lower_ports["C"], self._y),
                (x + self._upper_ports["C"], self._y + SPOOL_HEIGHT),
            )
            canvas.draw_arrow(start, end, size=4.0)
            used_ports.add("C")
        self._draw_closed_ports(canvas, x, used_ports)

    def _draw_float_position(self, canvas: CircuitCanvas, x: float) -> None:
        connection_height = self._y + 0.55 * SPOOL_HEIGHT
        connected_ports = [
            name
            for name in ("A", "B", "Ta", "T")
            if name in {**self._upper_ports, **self._lower_ports}
        ]
        for name in connected_ports:
            position = self._port_position(x, name)
            canvas.draw_line([position, (position[0], connection_height)])
        port_x = [self._port_position(x, name)[0] for name in connected_ports]
        canvas.draw_line([(min(port_x), connection_height), (max(port_x), connection_height)])
        self._draw_closed_ports(canvas, x, {*connected_ports, "LS"})


RELIEF_HALF_LENGTH, CHECK_HALF_LENGTH, THROTTLE_HALF_LENGTH, COMPENSATOR_HALF_LENGTH = (
    9.0,
    7.0,
    7.0,
    8.0,
)  # from the middle to either port
_PILOT_DASHES = (0, (2, 1.5))


def _draw_ports(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    port_distance: float,
    body_half_length: float,
) -> None:
    for net, sign in zip(nets, (-1, 1), strict=True):
        canvas.add_port(component, net, pose.transform_point(0, sign * port_distance))
        if port_distance > body_half_length:
            canvas.draw_line(
                pose((0, sign * port_distance), (0, sign * body_half_length)), linewidth=1.0
            )


def draw_relief_valve(
    canvas: CircuitCanvas, pose: SymbolPose, component: str, nets: tuple[str, str]
) -> None:
    """Draw a pressure relief valve."""
    _draw_ports(canvas, pose, component, nets, RELIEF_HALF_LENGTH, 5.5)
    canvas.draw_shape(pose((-5.5, -5.5), (5.5, -5.5), (5.5, 5.5), (-5.5, 5.5)), gid=component)
    canvas.draw_arrow(*pose((2.2, -5.5), (2.2, 5.5)))
    canvas.draw_spring(*pose((5.5, 0), (12, 0)))
    canvas.draw_line(
        pose((0, -7.5), (-8.5, -7.5), (-8.5, 0), (-5.5, 0)), linewidth=0.6, linestyle=_PILOT_DASHES
    )


def draw_compensator(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    senses_outlet: bool,
) -> None:
    """Draw a pressure compensator, closed by its inlet or outlet pressure."""
    _draw_ports(canvas, pose, component, nets, COMPENSATOR_HALF_LENGTH, 6.0)
    canvas.draw_shape(pose((-6, -6), (6, -6), (6, 6), (-6, 6)), gid=component)
    canvas.draw_arrow(*pose((0, -6), (0, 6)))
    canvas.draw_spring(*pose((6, 0), (11, 0)))
    y = -7.5 if senses_outlet else 7.5
    canvas.draw_line(
        pose((0, y), (-8.5, y), (-8.5, 0), (-6, 0)), linewidth=0.6, linestyle=_PILOT_DASHES
    )


def draw_check_valve(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    has_spring: bool = False,
) -> None:
    """Draw a check valve, optionally with a spring."""
    for net, sign in zip(nets, (-1, 1), strict=True):
        canvas.add_port(component, net, pose.transform_point(0, sign * CHECK_HALF_LENGTH))
    canvas.draw_line(pose((0, -CHECK_HALF_LENGTH), (0, -3.8)), linewidth=1.0)
    canvas.draw_circle(pose.transform_point(0, 0.4), 3.0, gid=component)
    canvas.draw_line(pose((-4.4, 0.4), (0, -3.9), (4.4, 0.4)))
    if has_spring:
        canvas.draw_spring(*pose((0, 3.4), (0, CHECK_HALF_LENGTH)), half_width=1.8)
    else:
        canvas.draw_line(pose((0, 3.4), (0, CHECK_HALF_LENGTH)), linewidth=1.0)


def draw_throttle(
    canvas: CircuitCanvas,
    pose: SymbolPose,
    component: str,
    nets: tuple[str, str],
    is_laminar: bool = False,
    is_adjustable: bool = False,
) -> None:
    """Draw an orifice or a laminar throttle; an arrow shows that it is adjustable."""
    for net, sign in zip(nets, (-1, 1), strict=True):
        canvas.add_port(component, net, pose.transform_point(0, sign * THROTTLE_HALF_LENGTH))
    canvas.draw_line(
        pose((0, -THROTTLE_HALF_LENGTH), (0, THROTTLE_HALF_LENGTH)), linewidth=1.0, gid=component
    )
    for sign in (-1, 1):
        if is_laminar:
            arc = [(sign * (4.6 - 2.8 * math.cos(0.25 * k)), 1.25 * k) for k in range(-4, 5)]
        else:
            arc = [(sign * 4.6, -4.0), (sign * 1.6, 0.0), (sign * 4.6, 4.0)]
        canvas.draw_line(pose(*arc))
    if is_adjustable:
        canvas.draw_arrow(*pose((-8, -3.5), (8, 3.5)))


def draw_rupture_valve(
    canvas: CircuitCanvas, pose: SymbolPose, component: str, nets: tuple[str, str]
) -> None:
    """Draw a hose rupture valve."""
    _draw_ports(canvas, pose, component, nets, CHECK_HALF_LENGTH + 2, 6.5)
    canvas.draw_shape(pose((-6, -6.5), (6, -6.5), (6, 6.5), (-6, 6.5)), gid=component)
    canvas.draw_circle(pose.transform_point(0, 0.5), 2.2, zorder=3.1)
    canvas.draw_line(pose((-3.4, -2.4), (0, -5.6), (3.4, -2.4)))
    canvas.draw_spring(*pose((0, -1.6), (0, -5.4)), half_width=1.2)
    canvas.draw_line(pose((0, 2.7), (0, 6.5)))


def draw_shuttle_valve(
    canvas: CircuitCanvas, position: SheetPoint, component: str, net: str
) -> None:
    """Draw a shuttle valve."""
    x, y = position
    canvas.add_port(component, net, position)
    canvas.draw_shape(
        [(x - 4, y - 2.6), (x + 4, y - 2.6), (x + 4, y + 2.6), (x - 4, y + 2.6)], gid=component
    )
    canvas.draw_circle((x, y), 1.6, zorder=3.1)
    for sign in (-1, 1):
        canvas.draw_line([(x + sign * 3.6, y + 2), (x + sign * 1.8, y), (x + sign * 3.6, y - 2)],
                 linewidth=0.6)  # fmt: skip


def draw_tank(
    canvas: CircuitCanvas, position: SheetPoint, component: str, net: str, half_width: float = 5.0
) -> None:
    """Draw a tank with its line."""
    x, y = position
    canvas.add_port(component, net, position)
    canvas.draw_line(
        [
            (x - half_width, y + 3.2),
            (x - half_width, y - 2),
            (x + half_width, y - 2),
            (x + half_width, y + 3.2),
        ],
        linewidth=1.0,
        gid=component,
    )
