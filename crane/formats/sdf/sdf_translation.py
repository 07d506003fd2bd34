"""Translation of SDF to URDF with loops, so that the same reader checks, draws and converts both.

SDF is a graph whose joints may close loops. The joints of a spanning tree (see
`crane.formats.sdf.spanning_tree`) become joints, the others become loops, and links keep their
frames. If the tree passes a joint from child to parent, its axis is reversed, so that its
coordinate is that of SDF.
"""

import dataclasses
from difflib import get_close_matches

import pinocchio as pin
from lxml import etree

from crane.common.errors import DescriptionError, suggest_names, warn
from crane.common.package_search import load_options
from crane.description.force_elements import ForceElement
from crane.description.kinematic_tree import (
    TENSOR_ATTRIBUTES,
    Joint,
    Limits,
    to_vector,
    unique_name,
)
from crane.description.pinocchio_conversion import xyz_rpy_from_se3
from crane.formats.conversion_notes import ConversionNotes
from crane.formats.sdf.frame_poses import SdfFramePoses, canonical_link
from crane.formats.sdf.link_elements import add_link_inertial, add_shapes
from crane.formats.sdf.model_scope import ModelReader, ModelScope, SdfElement
from crane.formats.sdf.sdf_joints import (
    WORLD_NODE,
    DisjointSets,
    SdfAxis,
    SdfJointEdge,
    SdfJoints,
    rigid_bodies,
)
from crane.formats.sdf.spanning_tree import (
    breadth_first,
    ground_edges,
    spanning_tree,
)
from crane.formats.xml_file import (
    XmlFile,
    add_friction,
    add_joint,
    add_origin,
    finite_limits,
    format_numbers,
    set_source_location,
)

_IDENTITY_TOLERANCE = 1e-15
_MAX_SHOWN_NAMES = 4  # of unsupported elements in a warning
# Children that are read, and those that simulators and viewers read.
_KNOWN_CHILDREN: dict[str, set[str]] = {
    "joint": {
        "parent", "child", "axis", "axis2", "pose", "gearbox_ratio", "gearbox_reference_body",
        "thread_pitch", "screw_thread_pitch", "physics", "sensor", "frame", "plugin",
    },
    "axis": {
        "xyz", "limit", "dynamics", "mimic", "use_parent_model_frame", "initial_position",
    },
    "limit": {"lower", "upper", "effort", "velocity", "stiffness", "dissipation"},
    "dynamics": {"damping", "friction", "spring_stiffness", "spring_reference"},
    "inertial": {
        "pose", "mass", "inertia", "density", "fluid_added_mass", "frame", "auto_inertia_params",
    },
    "inertia": {*TENSOR_ATTRIBUTES},
    "mimic": {"multiplier", "offset", "reference"},
    "link": {
        "pose", "inertial", "visual", "collision", "sensor", "plugin", "gravity", "self_collide",
        "kinematic", "must_be_base_link", "velocity_decay", "enable_wind", "projector", "battery",
        "light", "particle_emitter", "audio_sink", "audio_source", "frame", "max_contacts",
    },
}  # fmt: skip
_NOTED_ELEMENTS = {"sensor": "sensors", "plugin": "plugins", "gripper": "grippers"}


def translate_to_urdf(xml: XmlFile) -> tuple[XmlFile, tuple[ForceElement, ...]]:
    """Translate the machine of an SDF file to URDF.

    Returns:
        The URDF, and the springs, which URDF does not have.

    Raises:
        DescriptionError: The file is wrong, or several models move; the message has file and line.
    """
    notes = ConversionNotes(xml.file, "SDF", _MAX_SHOWN_NAMES)
    world = ModelReader(xml, notes.note_unsupported).read_world()
    return _SdfTranslation(xml, world, _choose_model(xml, world), notes).build_robot()


def _choose_model(xml: XmlFile, world: ModelScope) -> ModelScope:
    """Return the only movable model, or the model that the load argument `model` names."""
    model_name, problem = load_options().arguments.get("model"), "none of its models moves"
    names = list(world.models)
    candidates = [name for name in names if model_name in (None, name)]
    if not candidates:
        problem = f"no model '{model_name}', {suggest_names(names, model_name)}"
    elif len(candidates) > 1:
        problem += f" ({', '.join(names)})"
        candidates = [
            name
            for name, model in world.models.items()
            if not model.is_static
            and any(
                joint.element.get("type") != "fixed"
                for scope in model.nested_scopes()
                for joint in scope.joints.values()
            )
        ]
    if len(candidates) == 1:
        return world.models[candidates[0]]
    if candidates:
        problem = (
            f"{len(candidates)} models move ({', '.join(candidates)}), choose one: "
            "--arg model:=NAME, arguments={'model': NAME} in Python"
        )
    raise DescriptionError(f"{xml.file.name}: {problem}")


class _SdfTranslation:
    """Builds the URDF of a model."""

    def __init__(self, xml: XmlFile, world: ModelScope, top: ModelScope, notes: ConversionNotes):
        self._xml, self._top, self._notes = xml, top, notes
        self._frames = SdfFramePoses()
        self._locations = {xml.file.name: 0}
        self._robot = etree.Element("robot", name=top.name)
        if gravity := world.item.numbers("gravity", 3, ()):
            self._robot.set("gravity", format_numbers(gravity))
        self._pose_in_world = self._frames.pose_in_scope(world, top.name, top.item)
        self._link_poses: dict[str, pin.SE3] = {WORLD_NODE: self._pose_in_world.inverse()}
        self._links: dict[str, SdfElement] = {}
        self._scopes: dict[str, ModelScope] = {}  # by link
        self._ground_link = ""
        self._springs: list[ForceElement] = []
        self._initial_positions: list[tuple[str, SdfAxis]] = []

    def build_robot(self) -> tuple[XmlFile, tuple[ForceElement, ...]]:
        """Return the URDF and the springs."""
        if self._top.is_static:
            item = self._top.item
            raise item.error(f"{item.label} is static: nothing in it moves")
        for scope in self._top.nested_scopes():
            _note_unsupported_elements(scope, self._notes)
            for name, link in ({} if scope.is_static else scope.links).items():
                full_name = f"{scope.prefix}{name}"
                self._links[full_name], self._scopes[full_name] = link, scope
                pose_in_scope = self._frames.element_pose(scope, link, link.base_frame)
                scope_pose = self._frames.nested_model_pose(self._top, scope, scope.item)
                self._link_poses[full_name] = scope_pose * pose_in_scope
        if not self._links:
            canonical_link(self._top, self._top.item)  # raises
        joints = SdfJoints(self._top, self._frames)
        edges = [_fix_locked_joint(edge, self._notes) for edge in joints.edges]
        edges += ground_edges(edges, self._top, self._links, self._link_poses, self._notes)
        tree = spanning_tree(edges, WORLD_NODE)
        self._add_links(edges)
        driven_joints = _driven_joints(edges, {name for name, _, _ in joints.mimics})
        placed = {WORLD_NODE}
        for edge in breadth_first(tree, DisjointSets(), WORLD_NODE):
            self._add_joint(edge, edge.parent in placed, driven_joints)
            placed |= {edge.parent, edge.child}
        self._add_mimics(joints, {edge.name for edge in tree})
        tree_edge_ids = {id(edge) for edge in tree}
        self._add_loops([edge for edge in edges if id(edge) not in tree_edge_ids], tree)
        if self._initial_positions:
            state = etree.SubElement(self._robot, "group_state", name="home", group="all")
            for name, axis in self._initial_positions:
                self._set_source_location(
                    etree.SubElement(state, "joint", name=name, value=repr(axis.initial)),
                    axis.item,
                )
        self._notes.warn_about_notes()
        return XmlFile(self._xml.file, self._robot, self._locations), tuple(self._springs)

    def _set_source_location(self, element: etree._Element, item: SdfElement) -> None:
        for inner in element.iter(etree.Element):
            set_source_location(inner, item.source_location, self._locations)

    def _add_links(self, edges: list[SdfJointEdge]) -> None:
        self._ground_link = self._unique_link_name("world")
        self._set_source_location(
            etree.SubElement(self._robot, "link", name=self._ground_link), self._top.item
        )
        bodies = rigid_bodies(edges)
        for name, link in self._links.items():
            scope = self._scopes[name]
            is_moving = bodies.representative(name) != bodies.representative(WORLD_NODE)
            element = etree.SubElement(self._robot, "link", name=name)
            add_link_inertial(element, scope, link, self._frames, is_moving)
            add_shapes(element, scope, link, self._frames, self._notes.note_unsupported)
            self._set_source_location(element, link)
        for edge in edges:
            if edge.composite_joint:
                self._link_poses[edge.child] = edge.placement
                link = etree.SubElement(
                    self._robot, "link", name=edge.child, between=edge.composite_joint
                )
                self._set_source_location(link, edge.item)

    def _link_name(self, node: str) -> str:
        return self._ground_link if node == WORLD_NODE else node

    def _add_joint(
        self, edge: SdfJointEdge, is_forward: bool, driven_joints: set[str] | None
    ) -> None:
        """Add a joint from parent to child, or in the other direction with its axis reversed."""
        parent, child = (edge.parent, edge.child) if is_forward else (edge.child, edge.parent)
        axis = edge.axis
        placement = xyz_rpy_from_se3(self._link_poses[parent].actInv(edge.placement))
        ends = self._link_name(parent), self._joint_child_link(edge, child)
        joint = Joint(edge.name, edge.kind, *ends, "", *placement)
        if axis is not None:
            direction = to_vector(axis.direction if is_forward else -axis.direction)
            joint = dataclasses.replace(joint, axis=direction, limits=axis.limits)
        element = add_joint(self._robot, joint)
        if axis is not None:
            add_friction(element, axis.damping, axis.friction)
            if axis.stiffness < 0:
                raise axis.item.error(f"the spring of {axis.item.label} has a negative stiffness")
            if axis.stiffness:
                self._springs.append(ForceElement(edge.name, axis.stiffness, axis.reference))
            if axis.initial is not None:
                self._initial_positions.append((edge.name, axis))
            if driven_joints is not None:
                element.set("independent", str(edge.name in driven_joints).lower())
        self._set_source_location(element, edge.item if axis is None else axis.item)

    def _joint_child_link(self, edge: SdfJointEdge, link: str) -> str:
        """Return the link that a joint moves, a new one in its frame if the child has another."""
        offset = edge.placement.actInv(self._link_poses[link])
        if offset.isIdentity(_IDENTITY_TOLERANCE):
            return self._link_name(link)
        name = self._unique_link_name(f"{edge.name}_frame")
        self._set_source_location(etree.SubElement(self._robot, "link", name=name), edge.item)
        fixed = Joint(
            f"{name}_fixed", "fixed", name, self._link_name(link), "", *xyz_rpy_from_se3(offset)
        )
        self._set_source_location(add_joint(self._robot, fixed), edge.item)
        return name

    def _unique_link_name(self, name: str) -> str:
        name = unique_name(name, self._link_poses)
        self._link_poses[name] = pin.SE3.Identity()
        return name

    def _add_mimics(self, joints: SdfJoints, names: set[str]) -> None:
        elements = {joint.get("name"): joint for joint in self._robot.iterfind("joint")}
        for name, mimic, item in joints.mimics:
            if missing := [x for x in (name, mimic.get("joint")) if x not in names]:
                raise item.error(
                    f"{item.label}: joint '{missing[0]}' is coupled and closes a loop of "
                    "coupled joints, leave one of them out",
                )
            if elements[name].find("mimic") is not None:
                raise item.error(f"joint '{name}' follows two others, keep one")
            elements[name].append(mimic)
            self._set_source_location(mimic, item)

    def _add_loops(self, loop_edges: list[SdfJointEdge], tree: list[SdfJointEdge]) -> None:
        bodies = rigid_bodies(tree)
        for edge in loop_edges:
            is_one_body = bodies.representative(edge.parent) == bodies.representative(edge.child)
            if is_one_body and edge.kind == "fixed":
                continue
            if is_one_body:
                raise edge.item.error(
                    f"{edge.item.label} joins '{edge.parent}' and '{edge.child}', which are one "
                    "body: leave it out",
                )
            axis = edge.axis
            loop = etree.SubElement(self._robot, "loop", name=edge.name, type=edge.kind)
            for tag, link in (("predecessor", edge.parent), ("successor", edge.child)):
                add_origin(
                    etree.SubElement(loop, tag, link=self._link_name(link)),
                    *xyz_rpy_from_se3(self._link_poses[link].actInv(edge.placement)),
                )
            if axis is not None:
                etree.SubElement(loop, "axis", xyz=format_numbers(axis.direction))
            if axis is not None and finite_limits(axis.limits) is not None:
                self._notes.note_unsupported("limits of joints that close loops", edge.name)
            if axis is not None and (axis.damping or axis.friction or axis.stiffness):
                self._notes.note_unsupported(
                    "friction and springs of joints that close loops", edge.name
                )
            self._set_source_location(loop, edge.item)


def _fix_locked_joint(edge: SdfJointEdge, notes: ConversionNotes) -> SdfJointEdge:
    """Return a joint limited to zero as a fixed joint, which SDF before 1.5 does not have."""
    limits = Limits() if edge.axis is None else edge.axis.limits
    if edge.is_coupled or limits.lower != limits.upper or limits.lower:
        return edge
    notes.note_difference("joints limited to 0 are fixed", edge.name)
    return dataclasses.replace(edge, kind="fixed", axis=None)


def _driven_joints(edges: list[SdfJointEdge], coupled_names: set[str]) -> set[str] | None:
    """Return the joints with an effort, None if all or no joints have one.

    An effort of 0 means that no actuator drives the joint, unless all joints have it.
    """
    axis_of_joint = {edge.name: edge.axis for edge in edges if edge.axis is not None}
    without_effort = {name for name, axis in axis_of_joint.items() if not axis.limits.effort}
    with_effort = axis_of_joint.keys() - without_effort - coupled_names
    return with_effort if with_effort and without_effort else None


def _note_unsupported_elements(scope: ModelScope, notes: ConversionNotes) -> None:
    """Note elements of a model that no machine has, and warn of mistyped elements."""
    item = scope.item
    for element in item.element.iter(*_NOTED_ELEMENTS):
        if next(element.iterancestors("model"), None) is item.element:  # not of a nested model
            notes.note_unsupported(_NOTED_ELEMENTS[element.tag], element.get("name", ""))
    for name, link in scope.links.items():
        if link.text("gravity").lower() in ("0", "false"):
            notes.note_difference(
                "links without gravity have their weight", f"{scope.prefix}{name}"
            )
    for part in (*scope.links.values(), *scope.joints.values()):
        for element in part.element.iter(etree.Element):
            _warn_about_unknown_children(part, element)


def _warn_about_unknown_children(part: SdfElement, element: etree._Element) -> None:
    tags = _KNOWN_CHILDREN.get("axis" if element.tag == "axis2" else element.tag)
    parent = element.getparent()
    if tags is None or (parent is not None and parent.tag in ("ode", "physics", "sensor")):
        return
    for child in element:
        name = child.tag
        if name in tags or name.startswith("{"):
            continue
        similar = get_close_matches(name.lower(), sorted(tags), 1, 0.75)
        other_parents = [x for x, inside in _KNOWN_CHILDREN.items() if name in inside]
        if similar or other_parents:
            hint = (
                f"did you mean <{similar[0]}>?"
                if similar
                else (f"it belongs into <{other_parents[0]}>")
            )
            warn(
                f"{part.xml.source_location(child)}: unknown <{name}> in <{element.tag}> of "
                f"{part.label}, it is left out, {hint}"
            )
