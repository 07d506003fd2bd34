"""Symbols of machines (ISO 1219-1): pumps, motors, cylinders, accumulators."""

import math

from crane.view.sketches.circuit.circuit_canvas import CircuitCanvas, SheetPoint, SymbolPose

PUMP_RADIUS, ENGINE_RADIUS, MOTOR_RADIUS = 12.0, 12.0, 10.0  # radii
BARREL_HALF_HEIGHT = 8.0  # half of a cylinder's height
PORT_OFFSET = 14.0  # of an actuator, from its middle


def draw_pump(
    canvas: CircuitCanvas, position: SheetPoint, component: str, net: str, is_variable: bool
) -> None:
    """Draw a pump with delivery at the top and suction at the bottom."""
    pose = SymbolPose(*position)
    canvas.add_port(component, net, pose.transform_point(0, PUMP_RADIUS))
    canvas.add_port(component, "suction " + component, pose.transform_point(0, -PUMP_RADIUS))
    canvas.draw_circle(position, PUMP_RADIUS, gid=component)
    canvas.draw_shape(
        pose((0, PUMP_RADIUS), (-4.2, PUMP_RADIUS - 7), (4.2, PUMP_RADIUS - 7)), is_filled=True
    )
    if is_variable:
        canvas.draw_arrow(*pose((-15, -13), (15, 13)), size=4.5)


def draw_regulator(
    canvas: CircuitCanvas, position: SheetPoint, name: str, component: str, has_power_limit: bool
) -> None:
    """Draw a regulator as a box with its name; a hyperbola shows a power limit."""
    x, y = position
    canvas.draw_shape(
        [(x - 11, y - 6), (x + 11, y - 6), (x + 11, y + 6), (x - 11, y + 6)], gid=component
    )
    canvas.draw_text(x, y, name, f"label {component}")
    if has_power_limit:
        x = x - 21
        canvas.draw_line(
            [(x - 6, y + 6), (x - 6, y - 6), (x + 7, y - 6)], gid=f"{component} power"
        )
        curve = [(x - 6 + 1.5 + 1.2 * k, y - 6 + 15.0 / (1.5 + 1.2 * k)) for k in range(9)]
        canvas.draw_line(curve, linewidth=1.1)


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
    pose = SymbolPose(*position)
    for y in (-1.2, 1.2):
        canvas.draw_line(pose((y, MOTOR_RADIUS), (y, MOTOR_RADIUS + 7)), linewidth=0.7)
    canvas.draw_circle(position, MOTOR_RADIUS, gid=component)
    for net, sign in zip(nets, (-1, 1), strict=True):
        canvas.add_port(
            component, net, pose.transform_point(sign * PORT_OFFSET, -BARREL_HALF_HEIGHT)
        )
        canvas.draw_line(
            pose(
                (sign * PORT_OFFSET, -BARREL_HALF_HEIGHT),
                (sign * PORT_OFFSET, 0),
                (sign * MOTOR_RADIUS, 0),
            ),
            linewidth=1.0,
        )
        tip = sign * (MOTOR_RADIUS - 6.5)
        canvas.draw_shape(
            pose(
                (tip, 0), (sign * (MOTOR_RADIUS - 0.4), 3.6), (sign * (MOTOR_RADIUS - 0.4), -3.6)
            ),
            is_filled=True,
            linewidth=0,
        )
    arc = [(7 * math.sin(t / 10), MOTOR_RADIUS + 1 + 3 * math.cos(t / 10)) for t in range(-9, 10)]
    canvas.draw_line(pose(*arc), linewidth=0.7)
    for sign in (-1, 1):
        canvas.draw_arrow(*pose(arc[-3 * sign], arc[-1 if sign > 0 else 0]), size=2.6)


def draw_rotary_drive(
    canvas: CircuitCanvas, position: SheetPoint, component: str, nets: tuple[str, str]
) -> None:
    """Draw a rotary drive of limited angle, its shaft upwards."""
    pose = SymbolPose(*position)
    for y in (-1.2, 1.2):
        canvas.draw_line(pose((y, BARREL_HALF_HEIGHT), (y, BARREL_HALF_HEIGHT + 7)), linewidth=0.7)
    semicircle = [
        (18 * math.cos(k * math.pi / 24), -BARREL_HALF_HEIGHT + 16 * math.sin(k * math.pi / 24))
        for k in range(25)
    ]
    canvas.draw_shape(pose(*semicircle), gid=component)
    for net, sign in zip(nets, (-1, 1), strict=True):
        canvas.add_port(
            component, net, pose.transform_point(sign * PORT_OFFSET, -BARREL_HALF_HEIGHT)
        )
        x = sign * PORT_OFFSET * 0.78
        canvas.draw_shape(
            pose((x, -1.5), (x - 3.2, -BARREL_HALF_HEIGHT), (x + 3.2, -BARREL_HALF_HEIGHT)),
            is_filled=True,
            linewidth=0,
        )
    arc = [
        (7 * math.sin(t / 10), BARREL_HALF_HEIGHT + 1 + 3 * math.cos(t / 10))
        for t in range(-9, 10)
    ]
    canvas.draw_line(pose(*arc), linewidth=0.7)
    for sign in (-1, 1):
        canvas.draw_arrow(*pose(arc[-3 * sign], arc[-1 if sign > 0 else 0]), size=2.6)


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
    canvas.draw_shape(
        pose(
            (-20, -BARREL_HALF_HEIGHT),
            (20, -BARREL_HALF_HEIGHT),
            (20, BARREL_HALF_HEIGHT),
            (-20, BARREL_HALF_HEIGHT),
        ),
        gid=component,
    )
    share = min(area_ratio, 1 / area_ratio)
    rod_half_height = max(BARREL_HALF_HEIGHT * math.sqrt(max(1 - share, 0.0)), 1.4)
    start = -42 if share > 0.999 else -3
    rod_half_height = 2.0 if share > 0.999 else min(rod_half_height, BARREL_HALF_HEIGHT - 1.5)
    canvas.draw_shape(
        rod_pose(
            (start, -rod_half_height),
            (42, -rod_half_height),
            (42, rod_half_height),
            (start, rod_half_height),
        ),
        zorder=3.1,
    )
    canvas.draw_shape(
        rod_pose(
            (-6, -BARREL_HALF_HEIGHT),
            (-2, -BARREL_HALF_HEIGHT),
            (-2, BARREL_HALF_HEIGHT),
            (-6, BARREL_HALF_HEIGHT),
        ),
        zorder=3.2,
    )
    for net, sign in zip(nets, (-1, 1), strict=True):
        canvas.add_port(
            component, net, pose.transform_point(sign * PORT_OFFSET, -BARREL_HALF_HEIGHT)
        )


def draw_accumulator(
    canvas: CircuitCanvas, position: SheetPoint, component: str, net: str
) -> None:
    """Draw an accumulator with gas above its diaphragm, its port below."""
    pose = SymbolPose(*position)
    canvas.add_port(component, net, pose.transform_point(0, -17))
    upper_half = [
        (8 * math.cos(k * math.pi / 16), 9 + 8 * math.sin(k * math.pi / 16)) for k in range(17)
    ]
    lower_half = [(-x, -y) for x, y in upper_half]
    canvas.draw_shape(pose(*upper_half, *lower_half), gid=component)
    canvas.draw_line(pose((-8, 0), (8, 0)))
    canvas.draw_shape(pose((-3.6, 11), (3.6, 11), (0, 4.5)))
