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

from crane.description.kinematic_tree import Joint, Link, Placement, Vector

Freedom = tuple[str, str, Vector]  # suffix, kind, axis

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_ROTATIONS: tuple[Freedom, ...] = (
    ("rx", "revolute", _X), ("ry", "revolute", _Y), ("rz", "revolute", _Z),
)  # fmt: skip
_TRANSLATIONS: tuple[Freedom, ...] = (
    ("x", "prismatic", _X), ("y", "prismatic", _Y), ("z", "prismatic", _Z),
)  # fmt: skip

MULTI_FREEDOM_TYPES = ("floating", "planar", "spherical")  # types of URDF, and that of balls


def joint_freedoms(kind: str, axis: Sequence[float]) -> tuple[Freedom, ...]:
    """The freedoms of a joint with several.

    Args:
        kind: One of `MULTI_FREEDOM_TYPES`.
        axis: Normal of a planar joint's plane.
    """
    if kind == "spherical":
        return _ROTATIONS
    if kind == "floating":
        return (*_TRANSLATIONS, *_ROTATIONS)
    normal = np.asarray(axis, dtype=np.float64)
    first = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)

    def to_vector(vector: np.ndarray) -> Vector:
        x, y, z = (float(value) + 0.0 for value in vector)
        return x, y, z

    return (
        ("x", "prismatic", to_vector(first)),
        ("y", "prismatic", to_vector(second)),
        ("rz", "revolute", to_vector(normal)),
    )


def series_joint_names(name: str, freedoms: Sequence[Freedom]) -> list[str]:
    """Names of the joints that make up joint `name`."""
    return [f"{name}_{suffix}" for suffix, _, _ in freedoms]


def joint_series(
    name: str,
    freedoms: Sequence[Freedom],
    placement: Placement,
    end_links: tuple[str, str],
    source_location: str,
) -> list[Link | Joint]:
    """The joints, and the links between them.

    Args:
        name: Of the joint.
        freedoms: Its freedoms, from the parent on.
        placement: Of the first in the parent's frame.
        end_links: Parent and child link.
        source_location: File and line.
    """
    floating_joint = name if tuple(freedoms) == (*_TRANSLATIONS, *_ROTATIONS) else ""
    links = [end_links[0], *(f"{name}_{i}" for i in range(1, len(freedoms))), end_links[1]]
    found: list[Link | Joint] = [
        Link(link, source_location, composite_joint=name) for link in links[1:-1]
    ]
    for i, (suffix, kind, axis) in enumerate(freedoms):
        joint = Joint(
            f"{name}_{suffix}",
            kind,
            links[i],
            links[i + 1],
            source_location,
            axis=axis,
            floating_joint=floating_joint,
        )
        found.append(
            joint if i else dataclasses.replace(joint, xyz=placement[0], rpy=placement[1])
        )
    return found
