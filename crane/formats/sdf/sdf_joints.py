"""Joints of SDF as edges with one freedom, none, or the three of a ball.

A universal joint is two edges with a link between them, as is a screw, whose slide s follows its
turn q by s = pitch q / 2 pi. A gearbox is no edge: it couples the angles of two others.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.common.errors import suggest_names
from crane.description.kinematic_tree import NO_LIMIT
from crane.formats.sdf.frame_poses import SdfFramePoses, find_link
from crane.formats.sdf.model_scope import ModelScope
from crane.formats.sdf.sdf_element import SdfElement

WORLD_NODE = "::world"  # as no link can be called
_SINGLE_FREEDOM_TYPES = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
}
_TWO_FREEDOM_TYPES = ("universal", "revolute2")
_AXISLESS_TYPES = ("fixed", "ball")
JOINT_TYPES = (*_SINGLE_FREEDOM_TYPES, *_TWO_FREEDOM_TYPES, *_AXISLESS_TYPES, "screw", "gearbox")


@dataclass(frozen=True)
class SdfAxis:
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

    item: SdfElement
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
class SdfJointEdge:
    """A joint between two links.

    Attributes:
        name: Its name in the whole machine.
        kind: "revolute", "prismatic", "fixed" or "ball".
        parent: Node that it stands on: the name of a link, or `WORLD_NODE`.
        child: Node that it moves.
        placement: Its frame at coordinate zero, in that of the top model.
        item: The joint.
        axis: Of its freedom; None for a fixed one and a ball.
        is_coupled: Whether a coupling needs its coordinate.
        composite_joint: The joint whose parts meet at the child, empty if that is a link of the
            file.
    """

    name: str
    kind: str
    parent: str
    child: str
    placement: pin.SE3
    item: SdfElement
    axis: SdfAxis | None = None
    is_coupled: bool = False
    composite_joint: str = ""


@dataclass(frozen=True)
class CoupledCoordinate:
    """A coordinate that follows another: q = multiplier q_leader + offset."""

    name: str
    leader: str
    multiplier: float
    offset: float
    item: SdfElement


@dataclass(frozen=True)
class Gearbox:
    """Angles from a reference to two links that a gearbox couples: q_2 = -ratio q_1.

    The directions (3,) of both angles are in the top model's frame.
    """

    reference: str
    links: tuple[str, str]
    directions: tuple[np.ndarray, np.ndarray]
    ratio: float
    item: SdfElement


class SdfJoints:
    """The joints of a model and of those within it.

    Args:
        top: The model.
        frames: Poses of its file.

    Attributes:
        edges: In the order of the file.
        coupled_coordinates: Coordinates that follow others.
        gearboxes: Gearboxes.
    """

    def __init__(self, top: ModelScope, frames: SdfFramePoses):
        self._top, self._frames = top, frames
        self.edges: list[SdfJointEdge] = []
        self.coupled_coordinates: list[CoupledCoordinate] = []
        self.gearboxes: list[Gearbox] = []
        self._freedom_names: dict[str, list[str]] = {}  # joint -> names of its freedoms
        scopes = [scope for scope in top.nested_scopes() if not scope.is_static]
        for scope in scopes:
            for joint in scope.joints.values():
                self._read_joint(scope, joint)
        for scope in scopes:
            for joint in scope.joints.values():
                self._read_mimic(scope, joint)
        leaders = {x for f in self.coupled_coordinates for x in (f.name, f.leader)}
        self.edges = [
            dataclasses.replace(edge, is_coupled=True) if edge.name in leaders else edge
            for edge in self.edges
        ]

    def _read_joint(self, scope: ModelScope, joint: SdfElement) -> None:
        kind = str(joint.element.get("type", "")).strip()
        if kind not in JOINT_TYPES:
            problem = (
                f"the type '{kind}', {suggest_names(JOINT_TYPES, kind)}" if kind else "no type"
            )
            raise joint.xml.error_at(joint.element, f"{joint.label} has {problem}")
        name = f"{scope.prefix}{joint.name}"
        ends = self._end_node(scope, joint, "parent"), self._end_node(scope, joint, "child")
        if ends[0] == ends[1]:
            raise joint.xml.error_at(joint.element, f"{joint.label} joins '{ends[0]}' to itself")
        child = joint.text("child")
        placement_in_scope = self._frames.element_pose(
            scope, joint, "" if ends[1] == WORLD_NODE else child
        )
        placement = self._frames.pose_in_top(scope, self._top) * placement_in_scope
        tags = ("axis", "axis2")[
            : 2 if kind in (*_TWO_FREEDOM_TYPES, "gearbox") else kind not in _AXISLESS_TYPES
        ]
        axes = [self._read_axis(scope, joint, tag, placement_in_scope) for tag in tags]
        self._freedom_names[name] = [name]
        if kind in _AXISLESS_TYPES:
            self.edges.append(SdfJointEdge(name, kind, *ends, placement, joint))
        elif kind in _SINGLE_FREEDOM_TYPES:
            self.edges.append(
                SdfJointEdge(name, _SINGLE_FREEDOM_TYPES[kind], *ends, placement, joint, axes[0])
            )
        elif kind in _TWO_FREEDOM_TYPES:
            parts = [f"{name}_1", f"{name}_2"]
            self._freedom_names[name] = parts
            self._add_edge_pair(parts, ("revolute", "revolute"), ends, placement, joint, axes)
        elif kind == "screw":
            self._add_screw(name, ends, placement, joint, axes[0])
        else:
            self._add_gearbox(scope, ends, placement, joint, axes)

    def _end_node(self, scope: ModelScope, joint: SdfElement, tag: str) -> str:
        """The node that an end of a joint stands for."""
        name = joint.text(tag)
        if not name:
            raise joint.xml.error_at(joint.element, f"{joint.label} has no <{tag}>, add it")
        found = find_link(scope, name, joint)
        if found is None:
            return WORLD_NODE
        inner, link = found
        return WORLD_NODE if inner.is_static else f"{inner.prefix}{link}"

    def _read_axis(
        self, scope: ModelScope, joint: SdfElement, tag: str, placement_in_scope: pin.SE3
    ) -> SdfAxis:
        """The numbers of a freedom; about z without limits where nothing is said."""
        axis = joint.single_child(tag)
        if axis is None:
            return SdfAxis(joint, np.array([0.0, 0.0, 1.0]))
        limit, dynamics = (axis.single_child(x) or SdfElement(axis.xml, axis.element, axis.label)
                           for x in ("limit", "dynamics"))  # fmt: skip
        initial_position = axis.single_child("initial_position")
        return SdfAxis(
            axis,
            self._axis_direction(scope, axis, placement_in_scope),
            lower=_limit_or_infinity(limit.number("lower", -math.inf)),
            upper=_limit_or_infinity(limit.number("upper", math.inf)),
            effort=_maximum_or_infinity(limit.number("effort", -1.0)),
            velocity=_maximum_or_infinity(limit.number("velocity", -1.0)),
            damping=dynamics.number("damping", 0.0),
            friction=dynamics.number("friction", 0.0),
            stiffness=dynamics.number("spring_stiffness", 0.0),
            reference=dynamics.number("spring_reference", 0.0),
            initial=None if initial_position is None else axis.number("initial_position", 0.0),
        )

    def _axis_direction(
        self, scope: ModelScope, axis: SdfElement, placement_in_scope: pin.SE3
    ) -> np.ndarray:
        """An axis in the joint's frame; in the model's up to version 1.4."""
        xyz = axis.direction("xyz")
        child = axis.single_child("xyz")
        frame_name = "" if child is None else str(child.element.get("expressed_in", "")).strip()
        if not frame_name and (scope.version <= (1, 4) or axis.is_true("use_parent_model_frame")):
            frame_name = axis.base_frame
        if not frame_name:
            return xyz
        frame_name = axis.base_frame if frame_name == "__model__" else frame_name
        rotation = self._frames.rotation_in_scope(scope, frame_name, axis)
        return np.asarray(placement_in_scope.rotation.T @ rotation @ xyz)

    def _add_edge_pair(
        self,
        names: list[str],
        kinds: tuple[str, str],
        end_nodes: tuple[str, str],
        placement: pin.SE3,
        joint: SdfElement,
        axes: list[SdfAxis],
    ) -> None:
        """Two edges with a link between them."""
        middle_node = f"{names[0]}_between"
        composite_joint = joint.name
        self.edges += [
            SdfJointEdge(
                names[0],
                kinds[0],
                end_nodes[0],
                middle_node,
                placement,
                joint,
                axes[0],
                composite_joint=composite_joint,
            ),
            SdfJointEdge(names[1], kinds[1], middle_node, end_nodes[1], placement, joint, axes[1]),
        ]

    def _add_screw(
        self,
        name: str,
        end_nodes: tuple[str, str],
        placement: pin.SE3,
        joint: SdfElement,
        axis: SdfAxis,
    ) -> None:
        travel_per_radian = joint.number("screw_thread_pitch", 0.0) / (2 * math.pi)
        if joint.single_child("screw_thread_pitch") is None:
            pitch = joint.number("thread_pitch", 1.0)  # [rad/m], of a left-handed thread
            travel_per_radian = -1.0 / pitch if pitch else 0.0
        slide = f"{name}_slide"
        names = [name, slide]
        self._add_edge_pair(names, ("revolute", "prismatic"), end_nodes, placement, joint,
                   [axis, SdfAxis(joint, axis.direction)])  # fmt: skip
        self.coupled_coordinates.append(
            CoupledCoordinate(slide, name, travel_per_radian, 0.0, joint)
        )

    def _add_gearbox(
        self,
        scope: ModelScope,
        end_nodes: tuple[str, str],
        placement: pin.SE3,
        joint: SdfElement,
        axes: list[SdfAxis],
    ) -> None:
        reference = self._end_node(scope, joint, "gearbox_reference_body")
        first_direction, second_direction = (
            np.asarray(placement.rotation @ axis.direction) for axis in axes
        )
        ratio = joint.number("gearbox_ratio", 1.0)
        self.gearboxes.append(
            Gearbox(
                reference,
                (end_nodes[0], end_nodes[1]),
                (first_direction, second_direction),
                ratio,
                joint,
            )
        )

    def _read_mimic(self, scope: ModelScope, joint: SdfElement) -> None:
        """Axes that follow one of another joint."""
        own_freedoms = self._freedom_names.get(f"{scope.prefix}{joint.name}", [])
        for name, tag in zip(own_freedoms, ("axis", "axis2"), strict=False):
            axis = joint.single_child(tag)
            mimic = None if axis is None else axis.single_child("mimic")
            if mimic is not None:
                self.coupled_coordinates.append(self._coupled_coordinate(scope, name, mimic))

    def _coupled_coordinate(
        self, scope: ModelScope, name: str, mimic: SdfElement
    ) -> CoupledCoordinate:
        leader = str(mimic.element.get("joint", "")).strip()
        parts = self._freedom_names.get(f"{scope.prefix}{leader}")
        if parts is None:
            names = [
                x.removeprefix(scope.prefix)
                for x in self._freedom_names
                if x.startswith(scope.prefix)
            ]
            raise mimic.xml.error_at(
                mimic.element, f"{mimic.label} mimics the unknown joint '{leader}', "
                f"{suggest_names(names, leader)}"
            )  # fmt: skip
        second = mimic.element.get("axis", "axis") == "axis2"
        multiplier = mimic.number("multiplier", 1.0)
        offset = mimic.number("offset", 0.0) - multiplier * mimic.number("reference", 0.0)
        return CoupledCoordinate(name, parts[-1 if second else 0], multiplier, offset, mimic)


def _limit_or_infinity(value: float) -> float:
    """A limit, infinite from 1e9 on: older versions write 1e16 for none."""
    return math.copysign(math.inf, value) if abs(value) >= NO_LIMIT else value


def _maximum_or_infinity(value: float) -> float:
    """An effort or velocity; a negative one is not limited."""
    return math.inf if value < 0 else _limit_or_infinity(value)
