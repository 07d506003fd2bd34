"""Symbols of ISO 1219-1 that stand in a line; drawn with their flow upwards, see `Pose`."""

import math

from crane.view.sketch.circuit.ink import Ink, Point, Pose

RELIEF, CHECK, THROTTLE, COMPENSATOR = 9.0, 7.0, 7.0, 8.0  # from the middle to either port
_PILOT = (0, (2, 1.5))


def _ends(
    ink: Ink, pose: Pose, part: str, nets: tuple[str, str], reach: float, body: float
) -> None:
    for net, sign in zip(nets, (-1, 1), strict=True):
        ink.port(part, net, pose.at(0, sign * reach))
        if reach > body:
            ink.line(pose((0, sign * reach), (0, sign * body)), linewidth=1.0)


def relief(ink: Ink, pose: Pose, part: str, nets: tuple[str, str]) -> None:
    """A pressure relief valve: closed, opened by its inlet against a spring."""
    _ends(ink, pose, part, nets, RELIEF, 5.5)
    ink.shape(pose((-5.5, -5.5), (5.5, -5.5), (5.5, 5.5), (-5.5, 5.5)), gid=part)
    ink.arrow(*pose((2.2, -5.5), (2.2, 5.5)))
    ink.spring(*pose((5.5, 0), (12, 0)))
    ink.line(pose((0, -7.5), (-8.5, -7.5), (-8.5, 0), (-5.5, 0)), linewidth=0.6, linestyle=_PILOT)


def compensator(ink: Ink, pose: Pose, part: str, nets: tuple[str, str], behind: bool) -> None:
    """A pressure compensator: open, throttled by the pressure before it (or behind)."""
    _ends(ink, pose, part, nets, COMPENSATOR, 6.0)
    ink.shape(pose((-6, -6), (6, -6), (6, 6), (-6, 6)), gid=part)
    ink.arrow(*pose((0, -6), (0, 6)))
    ink.spring(*pose((6, 0), (11, 0)))
    y = -7.5 if behind else 7.5
    ink.line(pose((0, y), (-8.5, y), (-8.5, 0), (-6, 0)), linewidth=0.6, linestyle=_PILOT)


def check(ink: Ink, pose: Pose, part: str, nets: tuple[str, str], loaded: bool = False) -> None:
    """A check valve, with a spring where it is loaded."""
    for net, sign in zip(nets, (-1, 1), strict=True):
        ink.port(part, net, pose.at(0, sign * CHECK))
    ink.line(pose((0, -CHECK), (0, -3.8)), linewidth=1.0)
    ink.circle(pose.at(0, 0.4), 3.0, gid=part)
    ink.line(pose((-4.4, 0.4), (0, -3.9), (4.4, 0.4)))
    if loaded:
        ink.spring(*pose((0, 3.4), (0, CHECK)), half=1.8)
    else:
        ink.line(pose((0, 3.4), (0, CHECK)), linewidth=1.0)


def throttle(
    ink: Ink, pose: Pose, part: str, nets: tuple[str, str], laminar: bool = False,
    adjusted: bool = False,
) -> None:  # fmt: skip
    """An orifice, or a throttle whose flow is laminar; with an arrow where it is adjusted."""
    for net, sign in zip(nets, (-1, 1), strict=True):
        ink.port(part, net, pose.at(0, sign * THROTTLE))
    ink.line(pose((0, -THROTTLE), (0, THROTTLE)), linewidth=1.0, gid=part)
    for sign in (-1, 1):
        if laminar:
            arc = [(sign * (4.6 - 2.8 * math.cos(0.25 * k)), 1.25 * k) for k in range(-4, 5)]
        else:
            arc = [(sign * 4.6, -4.0), (sign * 1.6, 0.0), (sign * 4.6, 4.0)]
        ink.line(pose(*arc))
    if adjusted:
        ink.arrow(*pose((-8, -3.5), (8, 3.5)))


def rupture(ink: Ink, pose: Pose, part: str, nets: tuple[str, str]) -> None:
    """A hose rupture valve: a check valve that a spring holds open, in a box."""
    _ends(ink, pose, part, nets, CHECK + 2, 6.5)
    ink.shape(pose((-6, -6.5), (6, -6.5), (6, 6.5), (-6, 6.5)), gid=part)
    ink.circle(pose.at(0, 0.5), 2.2, zorder=3.1)
    ink.line(pose((-3.4, -2.4), (0, -5.6), (3.4, -2.4)))
    ink.spring(*pose((0, -1.6), (0, -5.4)), half=1.2)
    ink.line(pose((0, 2.7), (0, 6.5)))


def shuttle(ink: Ink, at: Point, part: str, net: str) -> None:
    """A shuttle valve, which hands on the higher of two pressures."""
    x, y = at
    ink.port(part, net, at)
    ink.shape([(x - 4, y - 2.6), (x + 4, y - 2.6), (x + 4, y + 2.6), (x - 4, y + 2.6)], gid=part)
    ink.circle((x, y), 1.6, zorder=3.1)
    for sign in (-1, 1):
        ink.line([(x + sign * 3.6, y + 2), (x + sign * 1.8, y), (x + sign * 3.6, y - 2)],
                 linewidth=0.6)  # fmt: skip


def tank(ink: Ink, at: Point, part: str, net: str, half: float = 5.0) -> None:
    """The tank, its line ending in the oil."""
    x, y = at
    ink.port(part, net, at)
    ink.line([(x - half, y + 3.2), (x - half, y - 2), (x + half, y - 2), (x + half, y + 3.2)],
             linewidth=1.0, gid=part)  # fmt: skip
