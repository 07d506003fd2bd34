"""Symbols of machines (ISO 1219-1): pumps, motors, cylinders, accumulators."""

import math

from crane.view.sketches.circuit.circuit_canvas import CircuitCanvas, SheetPoint, SymbolPose
from crane.view.sketches.circuit.valve_symbols import draw_tank

PUMP_RADIUS, ENGINE_RADIUS, MOTOR_RADIUS = 12.0, 12.0, 10.0  # radii
BARREL_HALF_HEIGHT = 8.0  # half of a cylinder's height
PORT_OFFSET = 14.0  # of an actuator, from its middle


def draw_pump(
    canvas: CircuitCanvas, position: SheetPoint, component: str, net: str, is_variable: bool
) -> None:
    """Draw a pump with delivery at the top and suction from a tank at the bottom."""
    pose, suction_net = SymbolPose(*position), f"suction {component}"
    bottom, top = pose((0, -PUMP_RADIUS), (0, PUMP_RADIUS))
    canvas.add_port(component, net, top)
    canvas.add_port(component, suction_net, bottom)
    canvas.draw_circle(position, PUMP_RADIUS, gid=component)
    base = PUMP_RADIUS - 7
    canvas.draw_shape(pose((0, PUMP_RADIUS), (-4.2, base), (4.2, base)), is_filled=True)
    if is_variable:
        canvas.draw_arrow(*pose((-15, -13), (15, 13)), size=4.5)
    draw_tank(canvas, bottom, f"tank {component}", suction_net, drop=5)


def draw_regulator(
    canvas: CircuitCanvas, position: SheetPoint, name: str, component: str, has_power_limit: bool
) -> None:
    """Draw a regulator as a box with its name; a hyperbola shows a power limit."""
    x, y = position
    canvas.draw_box((x - 11, y - 6), (x + 11, y + 6), gid=component)
    canvas.draw_text(x, y, name, f"label {component}")
    if has_power_limit:
        left = x - 27
        canvas.draw_line(
            [(left, y + 6), (left, y - 6), (left + 13, y - 6)], gid=f"{component} power"
        )
        canvas.draw_line(
            [(left + s, y - 6 + 15.0 / s) for s in [1.5 + 1.2 * k for k in range(9)]],
            linewidth=1.1,
        )


def draw_engine(canvas: CircuitCanvas, position: SheetPoint, component: str) -> None:
    """Draw an engine."""
    canvas.draw_circle(position, ENGINE_RADIUS, gid=component)
    canvas.draw_text(*position, "M", f"symbol {component}", size=9)


def draw_shaft(canvas: CircuitCanvas, start: SheetPoint, end: SheetPoint) -> None:
    """Draw a shaft as two lines."""
    for y in (-1.2, 1.2):
        canvas.draw_line([(start[0], start[1] + y), (end[0], end[1] + y)], linewidth=0.7,
                 zorder=2.5, gid="shaft")  # fmt: skip


def draw_motor(
    canvas: CircuitCanvas, position: SheetPoint, component: str, nets: tuple[str, str]
) -> None:
    """Draw a motor for both directions of flow, its shaft upwards."""
    pose, radius = SymbolPose(*position), MOTOR_RADIUS
    canvas.draw_circle(position, radius, gid=component)
    _draw_ports(canvas, pose, component, nets)
    for sign in (-1, 1):
        port = sign * PORT_OFFSET
        canvas.draw_line(
            pose((port, -BARREL_HALF_HEIGHT), (port, 0), (sign * radius, 0)), linewidth=1.0
        )
        base = sign * (radius - 0.4)
        canvas.draw_shape(
            pose((sign * (radius - 6.5), 0), (base, 3.6), (base, -3.6)),
            is_filled=True,
            linewidth=0,
        )
    _draw_rotating_shaft(canvas, pose, radius)


def draw_rotary_drive(
    canvas: CircuitCanvas, position: SheetPoint, component: str, nets: tuple[str, str]
) -> None:
    """Draw a rotary drive of limited angle, its shaft upwards."""
    pose, half_height = SymbolPose(*position), BARREL_HALF_HEIGHT
    canvas.draw_shape(
        pose(
            *[
                (18 * math.cos(t), -half_height + 16 * math.sin(t))
                for t in [k * math.pi / 24 for k in range(25)]
            ]
        ),
        gid=component,
    )
    _draw_ports(canvas, pose, component, nets)
    for sign in (-1, 1):
        x = sign * PORT_OFFSET * 0.78
        canvas.draw_shape(
            pose((x, -1.5), (x - 3.2, -half_height), (x + 3.2, -half_height)),
            is_filled=True,
            linewidth=0,
        )
    _draw_rotating_shaft(canvas, pose, half_height)


def _draw_ports(
    canvas: CircuitCanvas, pose: SymbolPose, component: str, nets: tuple[str, str]
) -> None:
    for net, x in zip(nets, (-PORT_OFFSET, PORT_OFFSET), strict=True):
        canvas.add_port(component, net, pose((x, -BARREL_HALF_HEIGHT))[0])


def _draw_rotating_shaft(canvas: CircuitCanvas, pose: SymbolPose, y: float) -> None:
    """Draw a shaft upwards from y, with arrows of its rotation."""
    for x in (-1.2, 1.2):
        canvas.draw_line(pose((x, y), (x, y + 7)), linewidth=0.7)
    arc = pose(*((7 * math.sin(t / 10), y + 1 + 3 * math.cos(t / 10)) for t in range(-9, 10)))
    canvas.draw_line(arc, linewidth=0.7)
    canvas.draw_arrow(arc[-3], arc[-1], size=2.6)
    canvas.draw_arrow(arc[3], arc[0], size=2.6)


def draw_cylinder(
    canvas: CircuitCanvas,
    position: SheetPoint,
    component: str,
    nets: tuple[str, str],
    area_ratio: float,
) -> None:
    """Draw a double-acting cylinder, chamber A on the left.

    Args:
        canvas: Canvas of the drawing.
        position: Middle of the symbol.
        component: Name of the component.
        nets: Nets of chambers A and B.
        area_ratio: Ratio of area B to area A. Below 1 the rod is in B, above 1 in A; at 1 it goes
            through both.
    """
    pose, rod_pose = SymbolPose(*position), SymbolPose(*position, is_mirrored=area_ratio > 1)
    half_height = BARREL_HALF_HEIGHT
    canvas.draw_box(*pose((-20, -half_height), (20, half_height)), gid=component)
    share = min(area_ratio, 1 / area_ratio)
    start, rod = -42, 2.0
    if share <= 0.999:
        start = -3
        rod = min(max(half_height * math.sqrt(1 - share), 1.4), half_height - 1.5)
    canvas.draw_box(*rod_pose((start, -rod), (42, rod)), zorder=3.1)
    canvas.draw_box(*rod_pose((-6, -half_height), (-2, half_height)), zorder=3.2)
    _draw_ports(canvas, pose, component, nets)


def draw_accumulator(
    canvas: CircuitCanvas, position: SheetPoint, component: str, net: str
) -> None:
    """Draw an accumulator with gas above its diaphragm, its port below."""
    pose = SymbolPose(*position)
    canvas.add_port(component, net, pose((0, -17))[0])
    upper_half = [
        (8 * math.cos(t), 9 + 8 * math.sin(t)) for t in [k * math.pi / 16 for k in range(17)]
    ]
    canvas.draw_shape(pose(*upper_half, *((-x, -y) for x, y in upper_half)), gid=component)
    canvas.draw_line(pose((-8, 0), (8, 0)))
    canvas.draw_shape(pose((-3.6, 11), (3.6, 11), (0, 4.5)))
