"""Plane and elements of a sketch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.common.errors import InputError, check_name
from crane.common.samples import Array
from crane.machine.machine import Machine

_PARALLEL_TOLERANCE = 1e-6  # deviation of unit vectors that count as parallel

# Directions to the right and up in views along a world axis.
VIEW_DIRECTIONS = {
    "xy": (np.array([1.0, 0, 0]), np.array([0, 1.0, 0])),
    "xz": (np.array([1.0, 0, 0]), np.array([0, 0, 1.0])),
    "yz": (np.array([0, 1.0, 0]), np.array([0, 0, 1.0])),
}


@dataclass(frozen=True, eq=False)
class DrawingPlane:
    """Plane of a drawing.

    Attributes:
        right: (3,) unit vector of the first coordinate.
        up: (3,) unit vector of the second coordinate.
        labels: Labels of the coordinates.
    """

    right: Array
    up: Array
    labels: tuple[str, str]

    @property
    def normal(self) -> Array:
        """(3,) unit vector towards the viewer."""
        return np.cross(self.right, self.up)

    def project(self, vectors: Array) -> Array:
        """Return the coordinates (..., 2) of points or directions (..., 3)."""
        return vectors @ np.column_stack([self.right, self.up])


def find_plane(machine: Machine, q: Array, view: str | None = None) -> DrawingPlane:
    """Find the plane in which a machine moves.

    At least half of the revolute axes, including those of loops, are parallel in the home
    configuration and perpendicular to the plane. Of several such planes, one that contains the
    vertical is preferred. The plane turns with the body that carries the first of these joints.

    Args:
        machine: The machine.
        q: (nq,) closed configuration.
        view: A key of `VIEW_DIRECTIONS`, for a view along an axis of the world instead.

    Raises:
        InputError: The view is unknown, or too few axes are parallel.
    """
    if view is not None:
        check_name(view, VIEW_DIRECTIONS, f"view '{view}' is unknown")
        return _label_plane(*VIEW_DIRECTIONS[view])
    home_data = pin.Data(machine.model)
    to_pinocchio = machine.coordinates.configuration
    pin.forwardKinematics(machine.model, home_data, to_pinocchio(machine.home))
    axes, carriers = _revolute_axes(machine, home_data)
    counts = (np.abs(axes @ axes.T) > 1 - _PARALLEL_TOLERANCE).sum(axis=1)
    if 2 * counts.max(initial=0) < max(len(axes), 1):
        raise InputError(
            f"{machine.name} has no plane: no more than {counts.max(initial=0)} of its "
            f"{len(axes)} revolute axes are parallel; choose the plane "
            f"({', '.join(VIEW_DIRECTIONS)})"
        )
    is_level = np.abs(axes[:, 2]) < _PARALLEL_TOLERANCE
    chosen_axis = max(range(len(axes)), key=lambda i: (counts[i], is_level[i], -i))
    right, up = _plane_directions(axes[chosen_axis])
    moved_data = pin.Data(machine.model)
    pin.forwardKinematics(machine.model, moved_data, to_pinocchio(q))
    body = carriers[chosen_axis]
    body_rotation = moved_data.oMi[body].rotation @ home_data.oMi[body].rotation.T
    return _label_plane(body_rotation @ right, body_rotation @ up)


def joint_axes(machine: Machine, data: pin.Data) -> Array:
    """Return the directions (njoints, 3) of all joints in the world, zero for ball joints.

    The first row is unused.

    Args:
        machine: The machine.
        data: Pinocchio data after forward kinematics.
    """
    model = machine.model
    axes = np.zeros((model.njoints, 3))
    for i in range(1, model.njoints):
        if model.joints[i].nv > 1:
            continue
        column = np.asarray(model.joints[i].createData().S).reshape(6)
        axes[i] = data.oMi[i].rotation @ (column[:3] + column[3:])  # one of both is zero
    return axes


def _revolute_axes(machine: Machine, data: pin.Data) -> tuple[Array, list[int]]:
    """Return the directions (k, 3) of all revolute axes, and the parent joint of each."""
    model, equations = machine.model, machine.closure.equations
    all_axes, axes, carriers = joint_axes(machine, data), [], []
    for i, name in zip(machine.coordinates.joints.tolist(), machine.joints, strict=True):
        if machine.unit(name) == "rad" and model.joints[i].nv == 1:
            axes.append(all_axes[i])
            carriers.append(int(model.parents[i]))
    for loop, (joint, placement) in zip(equations.loops, equations.frames[::2], strict=True):
        if loop.type == "revolute":
            axes.append((data.oMi[joint] * placement).rotation[:, 2])
            carriers.append(joint)
    return np.array(axes).reshape(-1, 3), carriers


def _plane_directions(normal: Array) -> tuple[Array, Array]:
    """Return right and up directions of a plane, close to those of the world."""
    vertical_part = np.eye(3)[2] - normal[2] * normal
    up = (
        vertical_part if np.linalg.norm(vertical_part) > 0.5 else np.eye(3)[1] - normal[1] * normal
    )
    up = up / np.linalg.norm(up)
    right = np.cross(up, normal)
    return right * np.sign(right[np.argmax(np.abs(right))]), up


def _label_plane(right_direction: Array, up_direction: Array) -> DrawingPlane:
    names = []
    for direction, default_label in (
        (right_direction, "in the machine's plane"),
        (up_direction, "upwards"),
    ):
        axis = int(np.argmax(direction))
        names.append("xyz"[axis] if direction[axis] > 1 - _PARALLEL_TOLERANCE else default_label)
    return DrawingPlane(right_direction, up_direction, (names[0], names[1]))


@dataclass(frozen=True, eq=False)
class SketchPin:
    """A revolute joint seen along its axis, or a loop joint.

    Attributes:
        name: Name of the joint or loop.
        position: (2,) position on its first body [m].
        mate_position: (2,) position on its second body [m]; the same in a closed configuration.
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
        position: (2,) point on its axis [m].
        axis: (2,) unit vector of its axis.
    """

    name: str
    position: Array
    axis: Array


@dataclass(frozen=True, eq=False)
class SketchSlide:
    """A prismatic joint in the plane: a rod in a barrel, or a block on a fixed rail.

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
    """A rigid body: points (k, 2) [m] that a line or a polygon connects.

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
    """All elements of a sketch, in the coordinates of its plane.

    Attributes:
        pins: Revolute joints seen along their axes, and all loops.
        collars: Other revolute joints.
        slides: Prismatic joints.
        bodies: Bodies that move.
        ground: Points (2,) on the ground [m], each with the unit vector (2,) into the ground.
        regions: Corners (k, 2) of the region that each loop encloses, by number of the loop.
        tip: (2,) position of the tip [m]; None without a tip.
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
