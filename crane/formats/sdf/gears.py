"""Gearboxes of SDF: a ratio between the angles of two links about a third."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from crane.formats.sdf.graph import Groups
from crane.formats.sdf.joints import Edge, Follower, Gear

_PARALLEL = 1e-6

Meshed = tuple[Gear, list[tuple[str, float]]]  # joints of both angles, and their signs


def with_gears(
    edges: list[Edge], gears: Sequence[Gear], bodies: Groups
) -> tuple[list[Edge], list[Meshed]]:
    """The edges, those that gears count marked as bound, and which ones these are.

    Args:
        edges: All joints.
        gears: All gearboxes.
        bodies: Links that are one body.

    Raises:
        DescriptionError: The two links do not turn against the reference about the gear's axes.
    """
    meshed: list[Meshed] = []
    for gear in gears:
        angles = [
            _angle(edges, gear, bodies, link, direction)
            for link, direction in zip(gear.links, gear.directions, strict=True)
        ]
        meshed.append((gear, angles))
    bound = {name for _, angles in meshed for name, _ in angles}
    return [dataclasses.replace(x, bound=True) if x.name in bound else x for x in edges], meshed


def _angle(
    edges: Sequence[Edge], gear: Gear, bodies: Groups, link: str, direction: np.ndarray
) -> tuple[str, float]:
    """The joint between the reference and a link, and whether it counts as the gear does."""
    wanted = bodies.of(gear.reference), bodies.of(link)
    for edge in edges:
        ends = bodies.of(edge.parent), bodies.of(edge.child)
        if edge.kind != "revolute" or edge.axis is None or {*ends} != {*wanted}:
            continue
        cosine = float(direction @ edge.place.rotation @ edge.axis.direction)
        if abs(abs(cosine) - 1) > _PARALLEL:
            continue
        forward = ends == wanted
        return edge.name, float(np.sign(cosine)) * (1.0 if forward else -1.0)
    raise gear.item.xml.fail(
        gear.item.element,
        f"{gear.item.what}: no joint turns '{_named(link)}' against '{_named(gear.reference)}' "
        "about the gear's axis, name another gearbox_reference_body",
    )


def _named(node: str) -> str:
    return node.removeprefix("::")  # the world


def followers_of(gears: Sequence[Meshed]) -> list[Follower]:
    """Couplings of gears: s_2 q_2 = -ratio s_1 q_1, with the signs s of both angles."""
    found = []
    for gear, ((first, one), (second, two)) in gears:
        found.append(Follower(second, first, -gear.ratio * one / two, 0.0, gear.item))
    return found
