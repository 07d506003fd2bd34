"""The tree of a machine: its links and joints in numbers, each with its place in a file."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

Vector = tuple[float, float, float]
Placement = tuple[Vector, Vector]  # xyz [m], rpy [rad] as URDF has them: R_z(y) R_y(p) R_x(r)

NO_LIMIT = 1e9  # in a file: a limit of this size, in whatever unit, says that there is none


def parse_limit(value: float) -> float:
    """A limit of a file, infinite where it says that there is none."""
    return math.copysign(math.inf, value) if abs(value) >= NO_LIMIT else value


@dataclass(frozen=True)
class Inertial:
    """Mass and inertia of a link.

    Attributes:
        mass: [kg].
        com: Centre of mass in the link's frame [m].
        rpy: Turns the axes of the link's frame into those of the tensor [rad].
        tensor: xx, xy, xz, yy, yz, zz about the centre of mass [kg m2].
        finding_location: File and line, where a file has a tensor that is no body's for its form
            alone, see `crane.description.inertia_feasibility`.
    """

    mass: float
    com: Vector
    rpy: Vector
    tensor: tuple[float, ...]
    finding_location: str = ""

    @property
    def inertia_matrix(self) -> np.ndarray:
        """The tensor (3, 3) along the axes that it is written in."""
        xx, xy, xz, yy, yz, zz = self.tensor
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclass(frozen=True)
class Link:
    """A frame, with or without mass.

    Attributes:
        name: Its name.
        source_location: File and line.
        inertial: Mass and inertia, None for a frame.
        composite_joint: What it is within, if it only stands between the joints of a series.
        has_refused_inertial: Whether it has an inertial that was refused while findings are
            collected.
    """

    name: str
    source_location: str
    inertial: Inertial | None = None
    composite_joint: str | None = None
    has_refused_inertial: bool = False


@dataclass(frozen=True)
class Limits:
    """What a joint may do; infinite where there is no limit.

    Attributes:
        lower: Of the coordinate [m], [rad]; NaN if refused while findings are collected.
        upper: Of the coordinate.
        effort: [N], [N m].
        velocity: [m/s], [rad/s].
        source_location: File and line.
    """

    lower: float = -math.inf
    upper: float = math.inf
    effort: float = math.inf
    velocity: float = math.inf
    source_location: str = ""

    def __str__(self) -> str:
        location_text = f" ({self.source_location})" if self.source_location else ""
        return f"{self.lower:g} to {self.upper:g}{location_text}"


@dataclass(frozen=True)
class Joint:
    """A joint with one freedom, or none.

    Attributes:
        name: Its name.
        kind: "revolute", "prismatic" or "fixed".
        parent: Link that it stands on.
        child: Link that it moves, whose frame is that of the joint at coordinate zero.
        source_location: File and line.
        xyz: Its origin in the parent's frame [m].
        rpy: Turns the parent's frame into its own [rad].
        axis: Unit vector in its own frame; without meaning if it is fixed.
        limits: Its limits.
        rotor_inertia: Of the rotor that drives it, seen at the joint: times the square of the
            gear's ratio [kg m2], or [kg] of a slide.
        is_cut: Whether it closes a ring, so that it has no ends, while findings are collected.
        floating_joint: The joint with six freedoms that it is one of, see
            `crane.description.floating_bases`.
    """

    name: str
    kind: str
    parent: str
    child: str
    source_location: str
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (1.0, 0.0, 0.0)
    limits: Limits = field(default_factory=Limits)
    rotor_inertia: float = 0.0
    is_cut: bool = False
    floating_joint: str = ""

    @property
    def is_movable(self) -> bool:
        """Whether it has a freedom."""
        return self.kind != "fixed"


@dataclass(frozen=True)
class Tree:
    """Links and the joints between them, in the order of the file.

    Attributes:
        links: By name.
        joints: By name.
    """

    links: Mapping[str, Link]
    joints: Mapping[str, Joint]

    def __iter__(self) -> Iterator[Link | Joint]:
        yield from self.links.values()
        yield from self.joints.values()

    @property
    def moving_joints(self) -> tuple[Joint, ...]:
        """The joints that move."""
        return tuple(joint for joint in self.joints.values() if joint.is_movable)

    @property
    def root_link(self) -> str:
        """The link that stands on no other."""
        children = {joint.child for joint in self.joints.values()}
        return next(link for link in self.links if link not in children)

    @property
    def total_mass(self) -> float:
        """Of all links [kg]."""
        return sum(link.inertial.mass for link in self.links.values() if link.inertial)

    def joints_by_parent(self) -> dict[str, list[Joint]]:
        """The joints on each link that has some."""
        found: dict[str, list[Joint]] = {}
        for joint in self.joints.values():
            if joint.parent and joint.child:
                found.setdefault(joint.parent, []).append(joint)
        return found

    def bodies_by_link(self) -> dict[str, str]:
        """By link the one that all fixed to it and to each other are named after."""
        parent_joints = {joint.child: joint for joint in self.joints.values()}
        found: dict[str, str] = {}
        for link in self.links:
            body = link
            while body in parent_joints and not parent_joints[body].is_movable:
                body = parent_joints[body].parent
            found[link] = body
        return found

    def with_parts(self, *parts: Link | Joint) -> "Tree":
        """The tree with other links and joints in place of those of the same names, or more."""
        links, joints = dict(self.links), dict(self.joints)
        for part in parts:
            if isinstance(part, Link):
                links[part.name] = part
            else:
                joints[part.name] = part
        return Tree(links, joints)


def with_rotor_inertias(tree: Tree, rotor_inertias: Mapping[str, float]) -> Tree:
    """The tree with rotor inertias [kg m2], [kg] by joint."""
    joints = (replace(tree.joints[name], rotor_inertia=x) for name, x in rotor_inertias.items())
    return tree.with_parts(*joints)
