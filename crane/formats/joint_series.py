"""Composite joints as series of joints with one degree of freedom each.

A joint J becomes joints J_x, J_y, ... with massless links J_1, J_2, ... between them, so that all
code for revolute and prismatic joints applies. The disadvantage is the singularity of Cardan
angles: if the second of three rotations is at 90 degrees, the first and third have the same axis,
and a closure through the joint is singular.
"""

from collections.abc import Sequence

import numpy as np

from crane.description.kinematic_tree import Joint, Link, Placement, Vector
from crane.description.pinocchio_conversion import to_vector

Freedom = tuple[str, str, Vector]  # suffix, kind, axis

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_ROTATIONS: tuple[Freedom, ...] = (
    ("rx", "revolute", _X), ("ry", "revolute", _Y), ("rz", "revolute", _Z),
)  # fmt: skip
_TRANSLATIONS: tuple[Freedom, ...] = (
    ("x", "prismatic", _X), ("y", "prismatic", _Y), ("z", "prismatic", _Z),
)  # fmt: skip

MULTI_FREEDOM_TYPES = ("floating", "planar", "spherical")  # types of URDF, and ball joints


def joint_freedoms(kind: str, axis: Sequence[float]) -> tuple[Freedom, ...]:
    """Return the degrees of freedom of a composite joint.

    Args:
        kind: One of `MULTI_FREEDOM_TYPES`.
        axis: Normal of the plane of a planar joint.
    """
    if kind == "spherical":
        return _ROTATIONS
    if kind == "floating":
        return (*_TRANSLATIONS, *_ROTATIONS)
    normal = np.asarray(axis, dtype=np.float64)
    first = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    first /= np.linalg.norm(first)
    return (
        ("x", "prismatic", to_vector(first)),
        ("y", "prismatic", to_vector(np.cross(normal, first))),
        ("rz", "revolute", to_vector(normal)),
    )


def joint_series(
    name: str,
    freedoms: Sequence[Freedom],
    placement: Placement,
    end_links: tuple[str, str],
    source_location: str,
) -> list[Link | Joint]:
    """Return the joints of a composite joint, and the links between them.

    Args:
        name: Name of the composite joint.
        freedoms: Its degrees of freedom, from the parent on.
        placement: Placement of the first joint in the parent's frame.
        end_links: Parent and child link.
        source_location: File and line.
    """
    floating_joint = name if tuple(freedoms) == (*_TRANSLATIONS, *_ROTATIONS) else ""
    links = [end_links[0], *(f"{name}_{i}" for i in range(1, len(freedoms))), end_links[1]]
    found: list[Link | Joint] = [
        Link(link, source_location, composite_joint=name) for link in links[1:-1]
    ]
    for i, (suffix, kind, axis) in enumerate(freedoms):
        xyz, rpy = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) if i else placement
        found.append(
            Joint(
                f"{name}_{suffix}", kind, links[i], links[i + 1], source_location, xyz, rpy, axis,
                floating_joint=floating_joint,
            )
        )  # fmt: skip
    return found
