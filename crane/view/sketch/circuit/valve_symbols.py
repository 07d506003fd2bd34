"""Symbols of ISO 1219-1 that stand in a line; drawn with their flow upwards, see `SymbolPose`."""

import math

from crane.view.sketch.circuit.circuit_canvas import CircuitCanvas, SheetPoint, SymbolPose

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
    """A pressure relief valve: closed, opened by its inlet against a spring."""
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
    """A pressure compensator: open, throttled by the pressure before it (or behind)."""
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
    """A check valve, with a spring where it is loaded."""
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
    """An orifice, or a throttle whose flow is laminar; with an arrow where it is adjusted."""
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
    """A hose rupture valve: a check valve that a spring holds open, in a box."""
    _draw_ports(canvas, pose, component, nets, CHECK_HALF_LENGTH + 2, 6.5)
    canvas.draw_shape(pose((-6, -6.5), (6, -6.5), (6, 6.5), (-6, 6.5)), gid=component)
    canvas.draw_circle(pose.transform_point(0, 0.5), 2.2, zorder=3.1)
    canvas.draw_line(pose((-3.4, -2.4), (0, -5.6), (3.4, -2.4)))
    canvas.draw_spring(*pose((0, -1.6), (0, -5.4)), half_width=1.2)
    canvas.draw_line(pose((0, 2.7), (0, 6.5)))


def draw_shuttle_valve(
    canvas: CircuitCanvas, position: SheetPoint, component: str, net: str
) -> None:
    """A shuttle valve, which hands on the higher of two pressures."""
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
    """The tank, its line ending in the oil."""
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
