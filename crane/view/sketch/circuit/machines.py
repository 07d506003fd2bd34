"""Symbols of ISO 1219-1 for what turns, moves and stores: pumps, motors, cylinders, gas."""

import math

from crane.view.sketch.circuit.ink import Ink, Point, Pose

PUMP, ENGINE, MOTOR = 12.0, 12.0, 10.0  # radii
BARREL = 8.0  # half of a cylinder's height
PORT = 14.0  # of an actuator, from its middle


def pump(ink: Ink, at: Point, part: str, net: str, variable: bool) -> None:
    """A pump that delivers upwards and draws from its own tank below; adjustable with an arrow."""
    pose = Pose(*at)
    ink.port(part, net, pose.at(0, PUMP))
    ink.port(part, "suction " + part, pose.at(0, -PUMP))
    ink.circle(at, PUMP, gid=part)
    ink.shape(pose((0, PUMP), (-4.2, PUMP - 7), (4.2, PUMP - 7)), filled=True)
    if variable:
        ink.arrow(*pose((-15, -13), (15, 13)), size=4.5)


def regulator(ink: Ink, at: Point, name: str, part: str, hyperbola: bool) -> None:
    """A box with what a regulator keeps, beside it the hyperbola of one that limits the power."""
    x, y = at
    ink.shape([(x - 11, y - 6), (x + 11, y - 6), (x + 11, y + 6), (x - 11, y + 6)], gid=part)
    ink.words(x, y, name, f"label {part}")
    if hyperbola:
        x = x - 21
        ink.line([(x - 6, y + 6), (x - 6, y - 6), (x + 7, y - 6)], gid=f"{part} power")
        curve = [(x - 6 + 1.5 + 1.2 * k, y - 6 + 15.0 / (1.5 + 1.2 * k)) for k in range(9)]
        ink.line(curve, linewidth=1.1)


def engine(ink: Ink, at: Point, part: str) -> None:
    """What turns the pumps."""
    ink.circle(at, ENGINE, gid=part)
    ink.words(*at, "M", f"symbol {part}", size=9)


def shaft(ink: Ink, start: Point, end: Point) -> None:
    """A shaft: two lines."""
    for y in (-1.2, 1.2):
        ink.line([(start[0], start[1] + y), (end[0], end[1] + y)], linewidth=0.7,
                 zorder=2.5, gid="shaft")  # fmt: skip


def motor(ink: Ink, at: Point, part: str, nets: tuple[str, str]) -> None:
    """A motor for both directions of flow, its shaft upwards."""
    pose = Pose(*at)
    for y in (-1.2, 1.2):
        ink.line(pose((y, MOTOR), (y, MOTOR + 7)), linewidth=0.7)
    ink.circle(at, MOTOR, gid=part)
    for net, sign in zip(nets, (-1, 1), strict=True):
        ink.port(part, net, pose.at(sign * PORT, -BARREL))
        ink.line(pose((sign * PORT, -BARREL), (sign * PORT, 0), (sign * MOTOR, 0)), linewidth=1.0)
        tip = sign * (MOTOR - 6.5)
        ink.shape(pose((tip, 0), (sign * (MOTOR - 0.4), 3.6), (sign * (MOTOR - 0.4), -3.6)),
                  filled=True, linewidth=0)  # fmt: skip
    arc = [(7 * math.sin(t / 10), MOTOR + 1 + 3 * math.cos(t / 10)) for t in range(-9, 10)]
    ink.line(pose(*arc), linewidth=0.7)
    for sign in (-1, 1):
        ink.arrow(*pose(arc[-3 * sign], arc[-1 if sign > 0 else 0]), size=2.6)


def rotary(ink: Ink, at: Point, part: str, nets: tuple[str, str]) -> None:
    """A rotary drive of limited angle: half a circle, its shaft upwards."""
    pose = Pose(*at)
    for y in (-1.2, 1.2):
        ink.line(pose((y, BARREL), (y, BARREL + 7)), linewidth=0.7)
    half = [(18 * math.cos(k * math.pi / 24), -BARREL + 16 * math.sin(k * math.pi / 24))
            for k in range(25)]  # fmt: skip
    ink.shape(pose(*half), gid=part)
    for net, sign in zip(nets, (-1, 1), strict=True):
        ink.port(part, net, pose.at(sign * PORT, -BARREL))
        x = sign * PORT * 0.78
        ink.shape(
            pose((x, -1.5), (x - 3.2, -BARREL), (x + 3.2, -BARREL)), filled=True, linewidth=0
        )
    arc = [(7 * math.sin(t / 10), BARREL + 1 + 3 * math.cos(t / 10)) for t in range(-9, 10)]
    ink.line(pose(*arc), linewidth=0.7)
    for sign in (-1, 1):
        ink.arrow(*pose(arc[-3 * sign], arc[-1 if sign > 0 else 0]), size=2.6)


def cylinder(ink: Ink, at: Point, part: str, nets: tuple[str, str], ratio: float) -> None:
    """A double-acting cylinder, chamber A on the left.

    Args:
        ink: What it is drawn with.
        at: Its middle.
        part: Its name.
        nets: Of chambers A and B.
        ratio: Of area B to area A: below 1 the rod is in B, above in A, and goes through at 1.
    """
    pose, flipped = Pose(*at), Pose(*at, flip=ratio > 1)
    ink.shape(pose((-20, -BARREL), (20, -BARREL), (20, BARREL), (-20, BARREL)), gid=part)
    share = min(ratio, 1 / ratio)
    half = max(BARREL * math.sqrt(max(1 - share, 0.0)), 1.4)
    start = -42 if share > 0.999 else -3
    half = 2.0 if share > 0.999 else min(half, BARREL - 1.5)
    ink.shape(flipped((start, -half), (42, -half), (42, half), (start, half)), zorder=3.1)
    ink.shape(flipped((-6, -BARREL), (-2, -BARREL), (-2, BARREL), (-6, BARREL)), zorder=3.2)
    for net, sign in zip(nets, (-1, 1), strict=True):
        ink.port(part, net, pose.at(sign * PORT, -BARREL))


def accumulator(ink: Ink, at: Point, part: str, net: str) -> None:
    """An accumulator with gas above its diaphragm, its port below."""
    pose = Pose(*at)
    ink.port(part, net, pose.at(0, -17))
    top = [(8 * math.cos(k * math.pi / 16), 9 + 8 * math.sin(k * math.pi / 16)) for k in range(17)]
    below = [(-x, -y) for x, y in top]
    ink.shape(pose(*top, *below), gid=part)
    ink.line(pose((-8, 0), (8, 0)))
    ink.shape(pose((-3.6, 11), (3.6, 11), (0, 4.5)))
