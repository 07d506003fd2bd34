"""Joints with several freedoms as series of joints with one each.

A joint J becomes joints J_x, J_y, ... with massless links J_1, J_2, ... between them. So every
coordinate is one number with a rate of its own, and all that holds for machines of revolute and
prismatic joints holds for these, too. The price is that of Cardan angles: where the second of
three rotations is 90 degrees from its zero, the first and third turn about the same axis, and a
closure through the joint is at the edge of its branch.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from crane.description.tree import Joint, Link, Placement, Vector

Part = tuple[str, str, Vector]  # suffix, kind, axis

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_TURNS: tuple[Part, ...] = (
    ("rx", "revolute", _X), ("ry", "revolute", _Y), ("rz", "revolute", _Z),
)  # fmt: skip
_SLIDES: tuple[Part, ...] = (
    ("x", "prismatic", _X), ("y", "prismatic", _Y), ("z", "prismatic", _Z),
)  # fmt: skip

SEVERAL = ("floating", "planar", "spherical")  # types of URDF, and that of balls


def parts_of(kind: str, axis: Sequence[float]) -> tuple[Part, ...]:
    """The freedoms of a joint with several.

    Args:
        kind: One of `SEVERAL`.
        axis: Normal of a planar joint's plane.
    """
    if kind == "spherical":
        return _TURNS
    if kind == "floating":
        return (*_SLIDES, *_TURNS)
    normal = np.asarray(axis, dtype=np.float64)
    first = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)

    def exact(vector: np.ndarray) -> Vector:
        x, y, z = (float(value) + 0.0 for value in vector)
        return x, y, z

    return (
        ("x", "prismatic", exact(first)),
        ("y", "prismatic", exact(second)),
        ("rz", "revolute", exact(normal)),
    )


def names_of(name: str, parts: Sequence[Part]) -> list[str]:
    """Names of the joints that make up joint `name`."""
    return [f"{name}_{suffix}" for suffix, _, _ in parts]


def series(
    name: str, parts: Sequence[Part], place: Placement, ends: tuple[str, str], where: str
) -> list[Link | Joint]:
    """The joints, and the links between them.

    Args:
        name: Of the joint.
        parts: Its freedoms, from the parent on.
        place: Of the first in the parent's frame.
        ends: Parent and child link.
        where: File and line.
    """
    floats = name if tuple(parts) == (*_SLIDES, *_TURNS) else ""
    links = [ends[0], *(f"{name}_{i}" for i in range(1, len(parts))), ends[1]]
    found: list[Link | Joint] = [Link(link, where, between=name) for link in links[1:-1]]
    for i, (suffix, kind, axis) in enumerate(parts):
        joint = Joint(
            f"{name}_{suffix}", kind, links[i], links[i + 1], where, axis=axis, floats=floats
        )
        found.append(joint if i else dataclasses.replace(joint, xyz=place[0], rpy=place[1]))
    return found
