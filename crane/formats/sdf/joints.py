"""Joints of SDF as edges with one freedom, none, or the three of a ball.

A universal joint is two edges with a link between them, as is a screw, whose slide s follows its
turn q by s = pitch q / 2 pi. A gearbox is no edge: it couples the angles of two others.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.common.errors import known
from crane.description.tree import NO_LIMIT
from crane.formats.sdf.frames import Frames, link_of
from crane.formats.sdf.scope import Scope
from crane.formats.sdf.values import Item

WORLD = "::world"  # as no link can be called
_ONE = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
_TWO = ("universal", "revolute2")
_NO_AXIS = ("fixed", "ball")
TYPES = (*_ONE, *_TWO, *_NO_AXIS, "screw", "gearbox")


@dataclass(frozen=True)
class Axis:
    """What SDF says of one freedom.

    Attributes:
        item: The `<axis>` or the joint.
        direction: (3,) unit vector in the joint's frame.
        lower: Limit, infinite for none.
        upper: Limit.
        effort: Limit; 0 where nothing drives it.
        velocity: Limit.
        damping: Viscous friction.
        friction: Coulomb friction.
        stiffness: Of a spring.
        reference: Where that is slack.
        initial: Coordinate at the beginning; None if not given.
    """

    item: Item
    direction: np.ndarray
    lower: float = -math.inf
    upper: float = math.inf
    effort: float = math.inf
    velocity: float = math.inf
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    reference: float = 0.0
    initial: float | None = None


@dataclass(frozen=True)
class Edge:
    """A joint between two links.

    Attributes:
        name: Its name in the whole machine.
        kind: "revolute", "prismatic", "fixed" or "ball".
        parent: Node that it stands on: the name of a link, or `WORLD`.
        child: Node that it moves.
        place: Its frame at coordinate zero, in that of the top model.
        item: The joint.
        axis: Of its freedom; None for a fixed one and a ball.
        bound: Whether a coupling needs its coordinate.
        between: The joint whose parts meet at the child, empty if that is a link of the file.
    """

    name: str
    kind: str
    parent: str
    child: str
    place: pin.SE3
    item: Item
    axis: Axis | None = None
    bound: bool = False
    between: str = ""


@dataclass(frozen=True)
class Follower:
    """A coordinate that follows another: q = multiplier q_leader + offset."""

    name: str
    leader: str
    multiplier: float
    offset: float
    item: Item


@dataclass(frozen=True)
class Gear:
    """Angles from a reference to two links that a gearbox couples: q_2 = -ratio q_1.

    The directions (3,) of both angles are in the top model's frame.
    """

    reference: str
    links: tuple[str, str]
    directions: tuple[np.ndarray, np.ndarray]
    ratio: float
    item: Item


class Joints:
    """The joints of a model and of those within it.

    Args:
        top: The model.
        frames: Poses of its file.

    Attributes:
        edges: In the order of the file.
        followers: Coordinates that follow others.
        gears: Gearboxes.
    """

    def __init__(self, top: Scope, frames: Frames):
        self._top, self._frames = top, frames
        self.edges: list[Edge] = []
        self.followers: list[Follower] = []
        self.gears: list[Gear] = []
        self._axes: dict[str, list[str]] = {}  # joint -> names of its freedoms
        scopes = [scope for scope in top.every() if not scope.is_static]
        for scope in scopes:
            for joint in scope.joints.values():
                self._read(scope, joint)
        for scope in scopes:
            for joint in scope.joints.values():
                self._mimic(scope, joint)
        leaders = {x for f in self.followers for x in (f.name, f.leader)}
        self.edges = [
            dataclasses.replace(edge, bound=True) if edge.name in leaders else edge
            for edge in self.edges
        ]

    def _read(self, scope: Scope, joint: Item) -> None:
        kind = str(joint.element.get("type", "")).strip()
        if kind not in TYPES:
            problem = f"the type '{kind}', {known(TYPES, kind)}" if kind else "no type"
            raise joint.xml.fail(joint.element, f"{joint.what} has {problem}")
        name = f"{scope.prefix}{joint.name}"
        ends = self._end(scope, joint, "parent"), self._end(scope, joint, "child")
        if ends[0] == ends[1]:
            raise joint.xml.fail(joint.element, f"{joint.what} joins '{ends[0]}' to itself")
        child = joint.text("child")
        in_scope = self._frames.of(scope, joint, "" if ends[1] == WORLD else child)
        place = self._frames.in_top(scope, self._top) * in_scope
        tags = ("axis", "axis2")[: 2 if kind in (*_TWO, "gearbox") else kind not in _NO_AXIS]
        axes = [self._axis(scope, joint, tag, in_scope) for tag in tags]
        self._axes[name] = [name]
        if kind in _NO_AXIS:
            self.edges.append(Edge(name, kind, *ends, place, joint))
        elif kind in _ONE:
            self.edges.append(Edge(name, _ONE[kind], *ends, place, joint, axes[0]))
        elif kind in _TWO:
            parts = [f"{name}_1", f"{name}_2"]
            self._axes[name] = parts
            self._pair(parts, ("revolute", "revolute"), ends, place, joint, axes)
        elif kind == "screw":
            self._screw(name, ends, place, joint, axes[0])
        else:
            self._gear(scope, ends, place, joint, axes)

    def _end(self, scope: Scope, joint: Item, tag: str) -> str:
        """The node that an end of a joint stands for."""
        given = joint.text(tag)
        if not given:
            raise joint.xml.fail(joint.element, f"{joint.what} has no <{tag}>, add it")
        found = link_of(scope, given, joint)
        if found is None:
            return WORLD
        inner, link = found
        return WORLD if inner.is_static else f"{inner.prefix}{link}"

    def _axis(self, scope: Scope, joint: Item, tag: str, in_scope: pin.SE3) -> Axis:
        """The numbers of a freedom; about z without limits where nothing is said."""
        axis = joint.only(tag)
        if axis is None:
            return Axis(joint, np.array([0.0, 0.0, 1.0]))
        limit, dynamics = (axis.only(x) or Item(axis.xml, axis.element, axis.what)
                           for x in ("limit", "dynamics"))  # fmt: skip
        given = axis.only("initial_position")
        return Axis(
            axis,
            self._direction(scope, axis, in_scope),
            lower=_bound(limit.number("lower", -math.inf)),
            upper=_bound(limit.number("upper", math.inf)),
            effort=_most(limit.number("effort", -1.0)),
            velocity=_most(limit.number("velocity", -1.0)),
            damping=dynamics.number("damping", 0.0),
            friction=dynamics.number("friction", 0.0),
            stiffness=dynamics.number("spring_stiffness", 0.0),
            reference=dynamics.number("spring_reference", 0.0),
            initial=None if given is None else axis.number("initial_position", 0.0),
        )

    def _direction(self, scope: Scope, axis: Item, in_scope: pin.SE3) -> np.ndarray:
        """An axis in the joint's frame; in the model's up to version 1.4."""
        xyz = axis.direction("xyz")
        child = axis.only("xyz")
        said = "" if child is None else str(child.element.get("expressed_in", "")).strip()
        if not said and (scope.version <= (1, 4) or axis.is_true("use_parent_model_frame")):
            said = axis.base
        if not said:
            return xyz
        said = axis.base if said == "__model__" else said
        turn = self._frames.turn(scope, said, axis)
        return np.asarray(in_scope.rotation.T @ turn @ xyz)

    def _pair(
        self, names: list[str], kinds: tuple[str, str], ends: tuple[str, str], place: pin.SE3,
        joint: Item, axes: list[Axis],
    ) -> None:  # fmt: skip
        """Two edges with a link between them."""
        middle = f"{names[0]}_between"
        whole = joint.name
        self.edges += [
            Edge(names[0], kinds[0], ends[0], middle, place, joint, axes[0], between=whole),
            Edge(names[1], kinds[1], middle, ends[1], place, joint, axes[1]),
        ]

    def _screw(
        self, name: str, ends: tuple[str, str], place: pin.SE3, joint: Item, axis: Axis
    ) -> None:
        slope = joint.number("screw_thread_pitch", 0.0) / (2 * math.pi)
        if joint.only("screw_thread_pitch") is None:
            pitch = joint.number("thread_pitch", 1.0)  # [rad/m], of a left-handed thread
            slope = -1.0 / pitch if pitch else 0.0
        slide = f"{name}_slide"
        names = [name, slide]
        self._pair(names, ("revolute", "prismatic"), ends, place, joint,
                   [axis, Axis(joint, axis.direction)])  # fmt: skip
        self.followers.append(Follower(slide, name, slope, 0.0, joint))

    def _gear(
        self, scope: Scope, ends: tuple[str, str], place: pin.SE3, joint: Item, axes: list[Axis]
    ) -> None:
        reference = self._end(scope, joint, "gearbox_reference_body")
        one, two = (np.asarray(place.rotation @ axis.direction) for axis in axes)
        ratio = joint.number("gearbox_ratio", 1.0)
        self.gears.append(Gear(reference, (ends[0], ends[1]), (one, two), ratio, joint))

    def _mimic(self, scope: Scope, joint: Item) -> None:
        """Axes that follow one of another joint."""
        own = self._axes.get(f"{scope.prefix}{joint.name}", [])
        for name, tag in zip(own, ("axis", "axis2"), strict=False):
            axis = joint.only(tag)
            mimic = None if axis is None else axis.only("mimic")
            if mimic is not None:
                self.followers.append(self._follower(scope, name, mimic))

    def _follower(self, scope: Scope, name: str, mimic: Item) -> Follower:
        leader = str(mimic.element.get("joint", "")).strip()
        parts = self._axes.get(f"{scope.prefix}{leader}")
        if parts is None:
            names = [
                x.removeprefix(scope.prefix) for x in self._axes if x.startswith(scope.prefix)
            ]
            raise mimic.xml.fail(
                mimic.element, f"{mimic.what} mimics the unknown joint '{leader}', "
                f"{known(names, leader)}"
            )  # fmt: skip
        second = mimic.element.get("axis", "axis") == "axis2"
        multiplier = mimic.number("multiplier", 1.0)
        offset = mimic.number("offset", 0.0) - multiplier * mimic.number("reference", 0.0)
        return Follower(name, parts[-1 if second else 0], multiplier, offset, mimic)


def _bound(value: float) -> float:
    """A limit, infinite from 1e9 on: older versions write 1e16 for none."""
    return math.copysign(math.inf, value) if abs(value) >= NO_LIMIT else value


def _most(value: float) -> float:
    """An effort or velocity; a negative one is not limited."""
    return math.inf if value < 0 else _bound(value)
