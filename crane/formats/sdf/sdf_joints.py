"""Joints of SDF as edges of a graph with one degree of freedom, none, or the three of a ball.

A universal joint is two edges with a link between them. So is a screw, whose translation s is
coupled to its rotation q by s = pitch q / 2 pi. A gearbox couples the angles of two other joints.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import suggest_names
from crane.description.kinematic_tree import Limits, parse_limit
from crane.formats.sdf.frame_poses import SdfFramePoses, find_link
from crane.formats.sdf.model_scope import ModelScope, SdfElement, sdf_version

WORLD_NODE = "::world"  # not a possible name of a link
_EDGE_KINDS = {  # of joints that are one edge
    "revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed",
    "ball": "spherical",
}  # fmt: skip
_TWO_FREEDOM_TYPES = ("universal", "revolute2")
_AXISLESS_TYPES = ("fixed", "ball")
JOINT_TYPES = (*_EDGE_KINDS, *_TWO_FREEDOM_TYPES, "screw", "gearbox")
_PARALLEL_TOLERANCE = 1e-6


@dataclass(frozen=True)
class SdfAxis:
    """One degree of freedom of a joint.

    Attributes:
        item: The `<axis>` or the joint.
        direction: (3,) unit vector in the joint's frame.
        limits: Limits; an effort of 0 means that no actuator drives it.
        damping: Viscous friction.
        friction: Coulomb friction.
        stiffness: Stiffness of a spring.
        reference: Coordinate at which the spring is slack.
        initial: Initial coordinate; None if not given.
    """

    item: SdfElement
    direction: np.ndarray
    limits: Limits = Limits()
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    reference: float = 0.0
    initial: float | None = None


@dataclass(frozen=True)
class SdfJointEdge:
    """A joint between two links.

    Attributes:
        name: Name in the whole machine.
        kind: "revolute", "prismatic", "fixed" or "spherical".
        parent: Parent node: the name of a link, or `WORLD_NODE`.
        child: Child node.
        placement: The joint's frame at coordinate zero, in the frame of the top model.
        item: The joint.
        axis: The degree of freedom; None for a fixed joint and a ball.
        is_coupled: Whether a coupling needs its coordinate.
        composite_joint: The joint whose two edges meet at the child, "" if the child is a link of
            the file.
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


class DisjointSets:
    """Disjoint sets of names (union-find)."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}

    def representative(self, name: str) -> str:
        """Return the representative of the set that a name belongs to."""
        while (parent := self._parents.get(name, name)) != name:
            self._parents[name] = name = self._parents.get(parent, parent)
        return name

    def join(self, first: str, second: str) -> bool:
        """Join the sets of two names, and return whether they were different."""
        root, other_root = self.representative(first), self.representative(second)
        self._parents[other_root] = root
        return root != other_root


def rigid_bodies(edges: list[SdfJointEdge]) -> DisjointSets:
    """Return the sets of links that fixed joints join to one body."""
    bodies = DisjointSets()
    for edge in edges:
        if edge.kind == "fixed":
            bodies.join(edge.parent, edge.child)
    return bodies


class SdfJoints:
    """The joints of a model and of the models nested in it.

    Args:
        top: The model.
        frames: Poses of its file.

    Attributes:
        edges: Joints in the order of the file.
        mimics: Coordinates that depend on others: name, `<mimic>` of URDF, and where it is from.
    """

    def __init__(self, top: ModelScope, frames: SdfFramePoses):
        self._top, self._frames = top, frames
        self.edges: list[SdfJointEdge] = []
        self.mimics: list[tuple[str, etree._Element, SdfElement]] = []
        self._gearboxes: list[tuple[SdfElement, tuple[str, str], list[np.ndarray], str]] = []
        self._freedom_names: dict[str, list[str]] = {}  # joint -> its coordinates
        scopes = [scope for scope in top.nested_scopes() if not scope.is_static]
        joints = [(scope, joint) for scope in scopes for joint in scope.joints.values()]
        for scope, joint in joints:
            self._read_joint(scope, joint)
        for scope, joint in joints:
            self._read_mimic(scope, joint)
        self._add_gear_couplings()
        coupled = {x for name, mimic, _ in self.mimics for x in (name, mimic.get("joint"))}
        self.edges = [
            dataclasses.replace(edge, is_coupled=True) if edge.name in coupled else edge
            for edge in self.edges
        ]

    def _read_joint(self, scope: ModelScope, joint: SdfElement) -> None:
        kind = joint.attribute("type")
        if kind not in JOINT_TYPES:
            problem = f"the type '{kind}'" if kind else "no type"
            raise joint.error(
                f"{joint.label} has {problem}, {suggest_names(JOINT_TYPES, kind or None)}"
            )
        name = f"{scope.prefix}{joint.name}"
        ends = self._end_node(scope, joint, "parent"), self._end_node(scope, joint, "child")
        if ends[0] == ends[1]:
            raise joint.error(f"{joint.label} joins '{ends[0]}' to itself")
        placement_in_scope = self._frames.element_pose(
            scope, joint, "" if ends[1] == WORLD_NODE else joint.text("child")
        )
        placement = (
            self._frames.nested_model_pose(self._top, scope, scope.item) * placement_in_scope
        )
        tags = [] if kind in _AXISLESS_TYPES else ["axis"]
        if kind in (*_TWO_FREEDOM_TYPES, "gearbox"):
            tags = ["axis", "axis2"]
        axes = [self._read_axis(scope, joint, tag, placement_in_scope) for tag in tags]
        self._freedom_names[name] = [name]
        if kind == "gearbox":
            reference = self._end_node(scope, joint, "gearbox_reference_body")
            directions = [np.asarray(placement.rotation @ axis.direction) for axis in axes]
            self._gearboxes.append((joint, ends, directions, reference))
        if kind in _TWO_FREEDOM_TYPES:
            parts = [f"{name}_1", f"{name}_2"]
            self._freedom_names[name] = parts
            self._add_edge_pair(parts, ("revolute", "revolute"), ends, placement, joint, axes)
        if kind == "screw":
            axes.append(SdfAxis(joint, axes[0].direction))
            parts = [name, f"{name}_slide"]
            self._add_edge_pair(parts, ("revolute", "prismatic"), ends, placement, joint, axes)
            travel_per_radian = joint.number("screw_thread_pitch", 0.0) / (2 * math.pi)
            if joint.single_child("screw_thread_pitch") is None:
                pitch = joint.number("thread_pitch", 1.0)  # [rad/m], positive if left-handed
                travel_per_radian = -1.0 / pitch if pitch else 0.0
            self._add_mimic(joint, parts[1], name, travel_per_radian)
        if kind in _EDGE_KINDS:
            axis = axes[0] if axes else None
            self.edges.append(SdfJointEdge(name, _EDGE_KINDS[kind], *ends, placement, joint, axis))

    def _end_node(self, scope: ModelScope, joint: SdfElement, tag: str) -> str:
        name = joint.text(tag)
        if not name:
            raise joint.error(f"{joint.label} has no <{tag}>, add it")
        found = find_link(scope, name, joint)
        if found is None:
            return WORLD_NODE
        inner, link = found
        return WORLD_NODE if inner.is_static else f"{inner.prefix}{link}"

    def _read_axis(
        self, scope: ModelScope, joint: SdfElement, tag: str, placement_in_scope: pin.SE3
    ) -> SdfAxis:
        """Read a degree of freedom; the default is about z without limits."""
        axis = joint.single_child(tag)
        if axis is None:
            return SdfAxis(joint, np.array([0.0, 0.0, 1.0]))
        limit, dynamics = (axis.single_child(x) or SdfElement(axis.xml, axis.element, axis.label)
                           for x in ("limit", "dynamics"))  # fmt: skip
        initial_position = axis.single_child("initial_position")
        effort, velocity = (  # a negative one means none
            math.inf if value < 0 else parse_limit(value)
            for value in (limit.number(key, -1.0) for key in ("effort", "velocity"))
        )
        return SdfAxis(
            axis,
            self._axis_direction(scope, axis, placement_in_scope),
            Limits(
                parse_limit(limit.number("lower", -math.inf)),
                parse_limit(limit.number("upper", math.inf)),
                effort,
                velocity,
            ),
            damping=dynamics.number("damping", 0.0),
            friction=dynamics.number("friction", 0.0),
            stiffness=dynamics.number("spring_stiffness", 0.0),
            reference=dynamics.number("spring_reference", 0.0),
            initial=None if initial_position is None else axis.number("initial_position", 0.0),
        )

    def _axis_direction(
        self, scope: ModelScope, axis: SdfElement, placement_in_scope: pin.SE3
    ) -> np.ndarray:
        """Return an axis in the joint's frame; SDF 1.4 and older give it in the model's frame."""
        xyz = axis.direction("xyz")
        child = axis.single_child("xyz")
        frame_name = "" if child is None else child.attribute("expressed_in")
        is_in_model_frame = axis.text("use_parent_model_frame").lower() in ("true", "1")
        if not frame_name and (sdf_version(axis.xml.root) <= (1, 4) or is_in_model_frame):
            frame_name = "__model__"
        if not frame_name:
            return xyz
        frame_name = axis.base_frame if frame_name == "__model__" else frame_name
        rotation = self._frames.pose_in_scope(scope, frame_name, axis).rotation
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
        """Add two edges with a link between them."""
        middle_node = f"{names[0]}_between"
        first, second = (
            SdfJointEdge(name, kind, parent, child, placement, joint, axis)
            for name, kind, parent, child, axis in zip(
                names, kinds, (end_nodes[0], middle_node), (middle_node, end_nodes[1]), axes,
                strict=True,
            )
        )  # fmt: skip
        self.edges += [dataclasses.replace(first, composite_joint=joint.name), second]

    def _add_gear_couplings(self) -> None:
        """Add s_2 q_2 = -ratio s_1 q_1 with the signs s of the angles to both links of each gear.

        Raises:
            DescriptionError: No joint turns a link against the reference about the gear's axis.
        """
        bodies = rigid_bodies(self.edges)
        for item, links, directions, reference in self._gearboxes:
            (first, first_sign), (second, second_sign) = (
                self._gear_angle(item, bodies, reference, link, direction)
                for link, direction in zip(links, directions, strict=True)
            )
            factor = -item.number("gearbox_ratio", 1.0) * first_sign / second_sign
            self._add_mimic(item, second, first, factor)

    def _gear_angle(
        self,
        item: SdfElement,
        bodies: DisjointSets,
        reference: str,
        link: str,
        direction: np.ndarray,
    ) -> tuple[str, float]:
        """Return the joint between the reference and a link, and the sign of its coordinate."""
        required_bodies = bodies.representative(reference), bodies.representative(link)
        for edge in self.edges:
            ends = bodies.representative(edge.parent), bodies.representative(edge.child)
            if edge.kind != "revolute" or edge.axis is None or {*ends} != {*required_bodies}:
                continue
            cosine = float(direction @ edge.placement.rotation @ edge.axis.direction)
            if abs(abs(cosine) - 1) <= _PARALLEL_TOLERANCE:
                sign = 1.0 if ends == required_bodies else -1.0
                return edge.name, float(np.sign(cosine)) * sign
        raise item.error(
            f"{item.label}: no joint turns '{link.removeprefix('::')}' against "
            f"'{reference.removeprefix('::')}' "
            "about the gear's axis, name another gearbox_reference_body",
        )

    def _read_mimic(self, scope: ModelScope, joint: SdfElement) -> None:
        """Read axes that mimic an axis of another joint."""
        for name, tag in zip(
            self._freedom_names.get(f"{scope.prefix}{joint.name}", []),
            ("axis", "axis2"),
            strict=False,
        ):
            axis = joint.single_child(tag)
            mimic = None if axis is None else axis.single_child("mimic")
            if mimic is None:
                continue
            leader = mimic.attribute("joint")
            parts = self._freedom_names.get(f"{scope.prefix}{leader}")
            if parts is None:
                names = [
                    x.removeprefix(scope.prefix)
                    for x in self._freedom_names
                    if x.startswith(scope.prefix)
                ]
                raise mimic.error(
                    f"{mimic.label} mimics the unknown joint '{leader}', "
                    f"{suggest_names(names, leader)}"
                )
            leader_part = parts[-1 if mimic.element.get("axis") == "axis2" else 0]
            multiplier = mimic.number("multiplier", 1.0)
            offset = mimic.number("offset", 0.0) - multiplier * mimic.number("reference", 0.0)
            self._add_mimic(mimic, name, leader_part, multiplier, offset)

    def _add_mimic(
        self, item: SdfElement, name: str, leader: str, multiplier: float, offset: float = 0.0
    ) -> None:
        """Add a coordinate q = multiplier q_leader + offset."""
        values = {"multiplier": repr(multiplier), "offset": repr(offset)}
        self.mimics.append((name, etree.Element("mimic", {"joint": leader, **values}), item))
