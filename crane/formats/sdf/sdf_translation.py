"""SDF translated into URDF with loops, so that one reader checks, draws and converts both.

SDF is a graph: its joints close loops by being there. A spanning tree of them becomes joints (see
`crane.formats.sdf.spanning_tree`), the others become loops, and links keep their frames. What a
file says of a joint that is passed from child to parent holds with its axis turned round, so that
its coordinate stays what it is in SDF.
"""

import dataclasses

import pinocchio as pin
from lxml import etree

from crane.common.errors import DescriptionError, suggest_names
from crane.common.package_search import load_options
from crane.description.specification import ForceElement
from crane.formats.sdf.conversion_notes import ConversionNotes
from crane.formats.sdf.frame_poses import SdfFramePoses, canonical_link
from crane.formats.sdf.gearboxes import gear_followers, mark_geared_edges
from crane.formats.sdf.ground_attachment import GroundAttachment
from crane.formats.sdf.link_inertias import add_inertial, warn_about_missing_inertial
from crane.formats.sdf.model_scope import ModelReader, ModelScope
from crane.formats.sdf.sdf_element import SdfElement
from crane.formats.sdf.sdf_joints import (
    WORLD_NODE,
    CoupledCoordinate,
    SdfAxis,
    SdfJointEdge,
    SdfJoints,
)
from crane.formats.sdf.sdf_shapes import add_shapes
from crane.formats.sdf.spanning_tree import DisjointSets, order_from_root, spanning_tree
from crane.formats.sdf.urdf_axis_elements import (
    add_axis,
    add_dynamics,
    add_limit,
    add_origin,
    is_limited,
)
from crane.formats.xml_file import SourceLocations, XmlFile

_LOOP_TYPES = {"ball": "spherical"}


def translate_to_urdf(xml: XmlFile) -> tuple[XmlFile, tuple[ForceElement, ...]]:
    """The machine of an SDF as URDF, and its springs, for which URDF has no place.

    Raises:
        DescriptionError: With file, line, and what is wrong; several models move.
    """
    notes = ConversionNotes(xml)
    world = ModelReader(xml, notes.note_unsupported).read_world()
    return _SdfTranslation(xml, world, _choose_model(xml, world), notes).build_robot()


def _choose_model(xml: XmlFile, world: ModelScope) -> ModelScope:
    """The model that moves, or that which the argument `model` names."""
    model_name = load_options().arguments.get("model")
    names = list(world.models)
    if model_name is not None:
        if model_name in world.models:
            return world.models[model_name]
        raise DescriptionError(
            f"{xml.file.name}: no model '{model_name}', {suggest_names(names, model_name)}"
        )
    if len(names) == 1:
        return world.models[names[0]]
    moving = [name for name, model in world.models.items() if model.can_move]
    if len(moving) == 1:
        return world.models[moving[0]]
    if not moving:
        raise DescriptionError(f"{xml.file.name}: none of its models moves ({', '.join(names)})")
    raise DescriptionError(
        f"{xml.file.name}: {len(moving)} models move ({', '.join(moving)}), choose one: "
        "--arg model:=NAME, arguments={'model': NAME} in Python"
    )


class _SdfTranslation:
    """A robot as it is built."""

    def __init__(self, xml: XmlFile, world: ModelScope, top: ModelScope, notes: ConversionNotes):
        self._xml, self._top, self._notes = xml, top, notes
        self._frames = SdfFramePoses()
        self._source_locations = SourceLocations(xml.file.name)
        self._robot = etree.Element("robot", name=top.name)
        self._pose_in_world = self._frames.pose_in_scope(world, top.name, top.item)
        self._link_poses: dict[str, pin.SE3] = {WORLD_NODE: self._pose_in_world.inverse()}
        self._links: dict[str, tuple[ModelScope, SdfElement]] = {}
        self._renamed_nodes: dict[
            str, str
        ] = {}  # of the nodes that are called otherwise than in SDF
        self._springs: list[ForceElement] = []
        self._initial_positions: list[tuple[str, SdfAxis]] = []

    def build_robot(self) -> tuple[XmlFile, tuple[ForceElement, ...]]:
        """The robot, with its springs."""
        if self._top.is_static:
            item = self._top.item
            raise item.xml.error_at(item.element, f"{item.label} is static: nothing in it moves")
        for scope in self._top.nested_scopes():
            self._notes.check_model(scope)
            for name, link in scope.links.items():
                self._read_link(scope, name, link)
        if not self._links:
            canonical_link(self._top, self._top.item)  # raises
        joints = SdfJoints(self._top, self._frames)
        groups = _rigid_bodies(joints.edges)
        edges, gears = mark_geared_edges(
            [_fix_locked_joint(edge, self._notes) for edge in joints.edges],
            joints.gearboxes,
            groups,
        )
        edges += GroundAttachment(
            self._top, self._links, self._link_poses, self._notes
        ).ground_edges(edges)
        for edge in edges:
            if edge.composite_joint:
                self._link_poses[edge.child] = edge.placement
        tree = spanning_tree(edges, WORLD_NODE)
        self._add_links(edges)
        tree_edges = order_from_root(tree, WORLD_NODE)
        driven_joints = _driven_joints(edges, joints.coupled_coordinates)
        for edge, forward in tree_edges:
            self._add_joint(edge, forward, driven_joints)
        followers = [*joints.coupled_coordinates, *gear_followers(gears)]
        self._add_mimics(followers, {edge.name for edge, _ in tree_edges})
        tree_edge_ids = {id(edge) for edge, _ in tree_edges}
        self._add_loops([edge for edge in edges if id(edge) not in tree_edge_ids], tree)
        self._add_home()
        self._notes.warn_about_notes()
        xml = XmlFile.from_root(self._xml.file, self._robot, self._source_locations.locations)
        return xml, tuple(self._springs)

    def _set_source_location(self, element: etree._Element, item: SdfElement) -> etree._Element:
        for inner in element.iter(etree.Element):
            self._source_locations.set_location(inner, item.source_location)
        return element

    def _read_link(self, scope: ModelScope, name: str, link: SdfElement) -> None:
        if scope.is_static:
            return
        full_name = f"{scope.prefix}{name}"
        self._links[full_name] = scope, link
        pose_in_scope = self._frames.element_pose(scope, link, link.base_frame)
        self._link_poses[full_name] = self._frames.pose_in_top(scope, self._top) * pose_in_scope

    # --- what is written ---------------------------------------------------------------------

    def _add_links(self, edges: list[SdfJointEdge]) -> None:
        self._renamed_nodes[WORLD_NODE] = self._unique_link_name("world")
        ground = etree.SubElement(self._robot, "link", name=self._renamed_nodes[WORLD_NODE])
        self._set_source_location(ground, self._top.item)
        bodies = _rigid_bodies(edges)
        for name, (scope, link) in self._links.items():
            if bodies.representative(name) != bodies.representative(WORLD_NODE):
                warn_about_missing_inertial(link)
            element = etree.SubElement(self._robot, "link", name=name)
            add_inertial(element, scope, link, self._frames)
            add_shapes(element, scope, link, self._frames, self._notes.note_unsupported)
            self._set_source_location(element, link)
        for edge in edges:
            if edge.composite_joint:
                link = etree.SubElement(
                    self._robot, "link", name=edge.child, between=edge.composite_joint
                )
                self._set_source_location(link, edge.item)

    def _add_joint(
        self, edge: SdfJointEdge, is_forward: bool, driven_joints: set[str] | None
    ) -> None:
        """A joint from parent to child, or the other way round with its axis turned."""
        end_nodes = (edge.parent, edge.child) if is_forward else (edge.child, edge.parent)
        link = self._joint_child_link(edge, end_nodes[1])
        kind = {"ball": "spherical"}.get(edge.kind, edge.kind)
        axis = edge.axis
        if axis is not None and edge.kind == "revolute" and not is_limited(axis):
            kind = "continuous"
        joint = etree.SubElement(self._robot, "joint", name=edge.name, type=kind)
        add_origin(joint, self._link_poses[end_nodes[0]].actInv(edge.placement))
        etree.SubElement(joint, "parent", link=self._renamed_nodes.get(end_nodes[0], end_nodes[0]))
        etree.SubElement(joint, "child", link=link)
        if axis is not None:
            add_axis(joint, axis.direction if is_forward else -axis.direction)
            add_limit(joint, axis)
            add_dynamics(joint, axis)
            self._record_spring_and_start(edge.name, axis)
            if driven_joints is not None:
                joint.set("independent", str(edge.name in driven_joints).lower())
        self._set_source_location(joint, edge.item if axis is None else axis.item)

    def _joint_child_link(self, edge: SdfJointEdge, link: str) -> str:
        """The link that a joint moves: one in its frame, if the link's is another."""
        offset = edge.placement.actInv(self._link_poses[link])
        if offset.isIdentity(_IDENTITY_TOLERANCE):
            return self._renamed_nodes.get(link, link)
        name = self._unique_link_name(f"{edge.name}_frame")
        self._set_source_location(etree.SubElement(self._robot, "link", name=name), edge.item)
        fixed = etree.SubElement(self._robot, "joint", name=f"{name}_fixed", type="fixed")
        add_origin(fixed, offset)
        etree.SubElement(fixed, "parent", link=name)
        etree.SubElement(fixed, "child", link=self._renamed_nodes.get(link, link))
        self._set_source_location(fixed, edge.item)
        return name

    def _unique_link_name(self, name: str) -> str:
        while name in self._link_poses:
            name += "_"
        self._link_poses[name] = pin.SE3.Identity()
        return name

    def _record_spring_and_start(self, name: str, axis: SdfAxis) -> None:
        if axis.stiffness < 0:
            raise axis.item.xml.error_at(
                axis.item.element, f"the spring of {axis.item.label} has a negative stiffness"
            )
        if axis.stiffness:
            self._springs.append(ForceElement(name, axis.stiffness, axis.reference))
        if axis.initial is not None:
            self._initial_positions.append((name, axis))

    def _add_mimics(self, followers: list[CoupledCoordinate], joints: set[str]) -> None:
        elements = {joint.get("name"): joint for joint in self._robot.iterfind("joint")}
        for follower in followers:
            for name in (follower.name, follower.leader):
                if name not in joints:
                    raise follower.item.xml.error_at(
                        follower.item.element,
                        f"{follower.item.label}: joint '{name}' is coupled and closes a loop of "
                        "coupled joints, leave one of them out",
                    )
            joint = elements[follower.name]
            if joint.find("mimic") is not None:
                raise follower.item.xml.error_at(
                    follower.item.element, f"joint '{follower.name}' follows two others, keep one"
                )
            mimic = etree.SubElement(
                joint, "mimic", joint=follower.leader,
                multiplier=repr(follower.multiplier), offset=repr(follower.offset),
            )  # fmt: skip
            self._set_source_location(mimic, follower.item)

    def _add_loops(self, loop_edges: list[SdfJointEdge], tree: list[SdfJointEdge]) -> None:
        bodies = _rigid_bodies(tree)
        for edge in loop_edges:
            if bodies.representative(edge.parent) == bodies.representative(edge.child):
                if edge.kind != "fixed":
                    raise edge.item.xml.error_at(
                        edge.item.element,
                        f"{edge.item.label} joins '{edge.parent}' and '{edge.child}', which are "
                        "one body: leave it out",
                    )
                continue
            kind = _LOOP_TYPES.get(edge.kind, edge.kind)
            loop = etree.SubElement(self._robot, "loop", name=edge.name, type=kind)
            for tag, link in (("predecessor", edge.parent), ("successor", edge.child)):
                end = etree.SubElement(loop, tag, link=self._renamed_nodes.get(link, link))
                add_origin(end, self._link_poses[link].actInv(edge.placement))
            if edge.axis is not None:
                add_axis(loop, edge.axis.direction)
                if is_limited(edge.axis):
                    self._notes.note_unsupported("limits of joints that close loops", edge.name)
                if edge.axis.damping or edge.axis.friction or edge.axis.stiffness:
                    self._notes.note_unsupported(
                        "friction and springs of joints that close loops", edge.name
                    )
            self._set_source_location(loop, edge.item)

    def _add_home(self) -> None:
        if not self._initial_positions:
            return
        state = etree.SubElement(self._robot, "group_state", name="home", group="all")
        for name, axis in self._initial_positions:
            joint = etree.SubElement(state, "joint", name=name, value=repr(axis.initial))
            self._set_source_location(joint, axis.item)


_IDENTITY_TOLERANCE = 1e-15


def _rigid_bodies(edges: list[SdfJointEdge]) -> DisjointSets:
    """The links that fixed joints make one body."""
    groups = DisjointSets()
    for edge in edges:
        if edge.kind == "fixed":
            groups.join(edge.parent, edge.child)
    return groups


def _fix_locked_joint(edge: SdfJointEdge, notes: ConversionNotes) -> SdfJointEdge:
    """A joint that may only stand at zero is fixed: the way to write that before 1.5 had it."""
    axis = edge.axis
    if axis is None or edge.is_coupled or axis.lower != axis.upper or axis.lower:
        return edge
    notes.note_difference("joints limited to 0 are fixed", edge.name)
    return dataclasses.replace(edge, kind="fixed", axis=None)


def _driven_joints(
    edges: list[SdfJointEdge], followers: list[CoupledCoordinate]
) -> set[str] | None:
    """Joints that have an effort; None where the file does not tell them from others.

    An effort of 0 says that nothing drives a joint, unless all have it.
    """
    axis_of_joint = {edge.name: edge.axis for edge in edges if edge.axis is not None}
    coupled_names = {follower.name for follower in followers}
    with_effort = {
        name for name, axis in axis_of_joint.items() if axis.effort and name not in coupled_names
    }
    without_effort = {name for name, axis in axis_of_joint.items() if not axis.effort}
    return with_effort if with_effort and without_effort else None
