"""Gearboxes of SDF: a ratio between the angles of two links about a third."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from crane.formats.sdf.sdf_joints import CoupledCoordinate, Gearbox, SdfJointEdge
from crane.formats.sdf.spanning_tree import DisjointSets

_PARALLEL_TOLERANCE = 1e-6

GearAngles = tuple[Gearbox, list[tuple[str, float]]]  # joints of both angles, and their signs


def mark_geared_edges(
    edges: list[SdfJointEdge], gears: Sequence[Gearbox], bodies: DisjointSets
) -> tuple[list[SdfJointEdge], list[GearAngles]]:
    """The edges, those that gears count marked as bound, and which ones these are.

    Args:
        edges: All joints.
        gears: All gearboxes.
        bodies: Links that are one body.

    Raises:
        DescriptionError: The two links do not turn against the reference about the gear's axes.
    """
    gear_angles: list[GearAngles] = []
    for gear in gears:
        angles = [
            _gear_angle(edges, gear, bodies, link, direction)
            for link, direction in zip(gear.links, gear.directions, strict=True)
        ]
        gear_angles.append((gear, angles))
    bound_names = {name for _, angles in gear_angles for name, _ in angles}
    return [
        dataclasses.replace(x, is_coupled=True) if x.name in bound_names else x for x in edges
    ], gear_angles


def _gear_angle(
    edges: Sequence[SdfJointEdge],
    gear: Gearbox,
    bodies: DisjointSets,
    link: str,
    direction: np.ndarray,
) -> tuple[str, float]:
    """The joint between the reference and a link, and whether it counts as the gear does."""
    required_bodies = bodies.representative(gear.reference), bodies.representative(link)
    for edge in edges:
        ends = bodies.representative(edge.parent), bodies.representative(edge.child)
        if edge.kind != "revolute" or edge.axis is None or {*ends} != {*required_bodies}:
            continue
        cosine = float(direction @ edge.placement.rotation @ edge.axis.direction)
        if abs(abs(cosine) - 1) > _PARALLEL_TOLERANCE:
            continue
        is_forward = ends == required_bodies
        return edge.name, float(np.sign(cosine)) * (1.0 if is_forward else -1.0)
    raise gear.item.xml.error_at(
        gear.item.element,
        f"{gear.item.label}: no joint turns '{_node_name(link)}' against "
        f"'{_node_name(gear.reference)}' "
        "about the gear's axis, name another gearbox_reference_body",
    )


def _node_name(node: str) -> str:
    return node.removeprefix("::")  # the world


def gear_followers(gears: Sequence[GearAngles]) -> list[CoupledCoordinate]:
    """Couplings of gears: s_2 q_2 = -ratio s_1 q_1, with the signs s of both angles."""
    found = []
    for gear, ((first, first_sign), (second, second_sign)) in gears:
        found.append(
            CoupledCoordinate(
                second, first, -gear.ratio * first_sign / second_sign, 0.0, gear.item
            )
        )
    return found
