"""What a mechanism consists of, in the coordinates of the plane that it is drawn in."""

from collections.abc import Sequence
from dataclasses import dataclass

from crane.common.samples import Array


@dataclass(frozen=True, eq=False)
class Pin:
    """A revolute joint seen along its axis, or the joint that closes a loop.

    Attributes:
        name: The joint or loop.
        at: (2,) where its first body has it [m].
        mate: (2,) where its second body has it [m]; the same in a closed posture.
        loop: Number of the loop from 1, 0 for a joint of the tree.
    """

    name: str
    at: Array
    mate: Array
    loop: int = 0


@dataclass(frozen=True, eq=False)
class Collar:
    """A revolute joint whose axis lies in the plane.

    Attributes:
        name: The joint.
        at: (2,) a point of its axis [m].
        along: (2,) unit vector of its axis.
    """

    name: str
    at: Array
    along: Array


@dataclass(frozen=True, eq=False)
class Slide:
    """A prismatic joint in the plane: a rod in a barrel, or a block on a rail that stands still.

    Attributes:
        name: The joint.
        start: (2,) closed end of the barrel or rail [m].
        mouth: (2,) open end of the barrel, other end of the rail [m].
        inner: (2,) end of the rod within the barrel, the block on the rail [m].
        end: (2,) end of the rod outside [m].
        chain: Number of the sub-chain of the barrel.
        rod_chain: Number of the sub-chain of the rod.
        boom: Whether it carries the tip.
        rail: Whether it is a block on a rail.
    """

    name: str
    start: Array
    mouth: Array
    inner: Array
    end: Array
    chain: int
    rod_chain: int
    boom: bool
    rail: bool


@dataclass(frozen=True, eq=False)
class Body:
    """What is rigid: points (k, 2) [m] that a line or a polygon joins.

    Attributes:
        points: (k, 2).
        chain: Number of the sub-chain; -1 for the ground.
        boom: Whether it carries the tip.
        com: (2,) centre of mass [m].
    """

    points: Array
    chain: int
    boom: bool
    com: Array


@dataclass(frozen=True, eq=False)
class Mechanism:
    """Everything a sketch shows, in the coordinates of its plane.

    Attributes:
        pins: Revolute joints seen along their axes, and all loops.
        collars: Other revolute joints.
        slides: Prismatic joints.
        bodies: Bodies that move.
        ground: What stands still: points (2,) [m], each with the unit vector (2,) into the ground.
        regions: By the number of a loop, (k, 2) corners of what it encloses.
        tip: (2,) [m], None without one.
        size: Largest extent of all points [m].
    """

    pins: Sequence[Pin]
    collars: Sequence[Collar]
    slides: Sequence[Slide]
    bodies: Sequence[Body]
    ground: Sequence[tuple[Array, Array]]
    regions: dict[int, Array]
    tip: Array | None
    size: float
