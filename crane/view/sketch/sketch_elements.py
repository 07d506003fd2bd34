"""What a mechanism consists of, in the coordinates of the plane that it is drawn in."""

from collections.abc import Sequence
from dataclasses import dataclass

from crane.common.samples import Array


@dataclass(frozen=True, eq=False)
class SketchPin:
    """A revolute joint seen along its axis, or the joint that closes a loop.

    Attributes:
        name: The joint or loop.
        position: (2,) where its first body has it [m].
        mate_position: (2,) where its second body has it [m]; the same in a closed posture.
        loop_number: Number of the loop from 1, 0 for a joint of the tree.
    """

    name: str
    position: Array
    mate_position: Array
    loop_number: int = 0


@dataclass(frozen=True, eq=False)
class SketchCollar:
    """A revolute joint whose axis lies in the plane.

    Attributes:
        name: The joint.
        position: (2,) a point of its axis [m].
        axis: (2,) unit vector of its axis.
    """

    name: str
    position: Array
    axis: Array


@dataclass(frozen=True, eq=False)
class SketchSlide:
    """A prismatic joint in the plane: a rod in a barrel, or a block on a rail that stands still.

    Attributes:
        name: The joint.
        start: (2,) closed end of the barrel or rail [m].
        mouth: (2,) open end of the barrel, other end of the rail [m].
        rod_inner_end: (2,) end of the rod within the barrel, the block on the rail [m].
        rod_outer_end: (2,) end of the rod outside [m].
        barrel_chain: Number of the sub-chain of the barrel.
        rod_chain: Number of the sub-chain of the rod.
        carries_tip: Whether it carries the tip.
        is_rail: Whether it is a block on a rail.
    """

    name: str
    start: Array
    mouth: Array
    rod_inner_end: Array
    rod_outer_end: Array
    barrel_chain: int
    rod_chain: int
    carries_tip: bool
    is_rail: bool


@dataclass(frozen=True, eq=False)
class SketchBody:
    """What is rigid: points (k, 2) [m] that a line or a polygon joins.

    Attributes:
        points: (k, 2).
        chain: Number of the sub-chain; -1 for the ground.
        carries_tip: Whether it carries the tip.
        centre_of_mass: (2,) centre of mass [m].
    """

    points: Array
    chain: int
    carries_tip: bool
    centre_of_mass: Array


@dataclass(frozen=True, eq=False)
class SketchMechanism:
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

    pins: Sequence[SketchPin]
    collars: Sequence[SketchCollar]
    slides: Sequence[SketchSlide]
    bodies: Sequence[SketchBody]
    ground: Sequence[tuple[Array, Array]]
    regions: dict[int, Array]
    tip: Array | None
    size: float
