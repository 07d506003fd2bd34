"""Joints with several freedoms as series of joints with one each.

A joint J becomes joints J_x, J_y, ... with massless links J_1, J_2, ... between them. So every
coordinate is one number with a rate of its own, and all that holds for machines of revolute and
prismatic joints holds for these, too. The price is that of Cardan angles: where the second of
three rotations is 90 degrees from its zero, the first and third turn about the same axis, and a
closure through the joint is at the edge of its branch.
"""

from collections.abc import Sequence

import numpy as np
from lxml import etree

Part = tuple[str, str, tuple[float, float, float]]  # suffix, type, axis

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_TURNS: tuple[Part, ...] = (
    ("rx", "continuous", _X), ("ry", "continuous", _Y), ("rz", "continuous", _Z),
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

    def exact(vector: np.ndarray) -> tuple[float, float, float]:
        x, y, z = (float(value) + 0.0 for value in vector)
        return x, y, z

    return (
        ("x", "prismatic", exact(first)),
        ("y", "prismatic", exact(second)),
        ("rz", "continuous", exact(normal)),
    )


def names_of(name: str, parts: Sequence[Part]) -> list[str]:
    """Names of the joints that make up joint `name`."""
    return [f"{name}_{suffix}" for suffix, _, _ in parts]


def write_series(
    robot: etree._Element,
    name: str,
    parts: Sequence[Part],
    origin: dict[str, str],
    ends: tuple[str, str],
) -> list[tuple[str, str]]:
    """Add the joints, and the links between them, to a robot.

    Args:
        robot: Where to.
        name: Of the joint.
        parts: Its freedoms, from the parent on.
        origin: Attributes of its `<origin>`.
        ends: Parent and child link.

    Returns:
        What was added, as ("link", name) or ("joint", name).
    """
    added = []
    links = [ends[0], *(f"{name}_{i}" for i in range(1, len(parts))), ends[1]]
    for i, (suffix, kind, axis) in enumerate(parts):
        if i:
            etree.SubElement(robot, "link", name=links[i], between=name)
            added.append(("link", links[i]))
        joint = etree.SubElement(robot, "joint", name=f"{name}_{suffix}", type=kind)
        etree.SubElement(joint, "origin", origin if i == 0 else {"xyz": "0 0 0", "rpy": "0 0 0"})
        etree.SubElement(joint, "parent", link=links[i])
        etree.SubElement(joint, "child", link=links[i + 1])
        etree.SubElement(joint, "axis", xyz=" ".join(repr(float(x)) for x in axis))
        added.append(("joint", f"{name}_{suffix}"))
    return added
