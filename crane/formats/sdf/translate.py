"""SDF translated into URDF with loops, so that one reader checks, draws and converts both.

SDF is a graph: its joints close loops by being there. A spanning tree of them becomes joints (see
`crane.formats.sdf.graph`), the others become loops, and links keep their frames. What a file says
of a joint that is passed from child to parent holds with its axis turned round, so that its
coordinate stays what it is in SDF.
"""

import dataclasses

import pinocchio as pin
from lxml import etree

from crane.common.errors import DescriptionError, known
from crane.common.packages import given
from crane.description.spec import ForceElement
from crane.formats.sdf.bodies import add_inertial, warn_of_no_inertial
from crane.formats.sdf.elements import (
    add_axis,
    add_dynamics,
    add_limit,
    add_origin,
    is_limited,
)
from crane.formats.sdf.frames import Frames, canonical
from crane.formats.sdf.gears import followers_of, with_gears
from crane.formats.sdf.graph import Groups, downwards, spanning
from crane.formats.sdf.ground import Ground
from crane.formats.sdf.joints import WORLD, Axis, Edge, Follower, Joints
from crane.formats.sdf.left_out import LeftOut
from crane.formats.sdf.scope import Reader, Scope
from crane.formats.sdf.shapes import add_shapes
from crane.formats.sdf.values import Item
from crane.formats.xml import Places, XmlFile

_LOOPS = {"ball": "spherical"}


def translated(xml: XmlFile) -> tuple[XmlFile, tuple[ForceElement, ...]]:
    """The machine of an SDF as URDF, and its springs, for which URDF has no place.

    Raises:
        DescriptionError: With file, line, and what is wrong; several models move.
    """
    notes = LeftOut(xml)
    world = Reader(xml, notes.lose).world()
    return _Translation(xml, world, _chosen(xml, world), notes).made()


def _chosen(xml: XmlFile, world: Scope) -> Scope:
    """The model that moves, or that which the argument `model` names."""
    wanted = given().arguments.get("model")
    names = list(world.models)
    if wanted is not None:
        if wanted in world.models:
            return world.models[wanted]
        raise DescriptionError(f"{xml.file.name}: no model '{wanted}', {known(names, wanted)}")
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


class _Translation:
    """A robot as it is built."""

    def __init__(self, xml: XmlFile, world: Scope, top: Scope, notes: LeftOut):
        self._xml, self._top, self._notes = xml, top, notes
        self._frames = Frames()
        self._places = Places(xml.file.name)
        self._robot = etree.Element("robot", name=top.name)
        self._in_world = self._frames.within(world, top.name, top.item)
        self._at: dict[str, pin.SE3] = {WORLD: self._in_world.inverse()}
        self._links: dict[str, tuple[Scope, Item]] = {}
        self._names: dict[str, str] = {}  # of the nodes that are called otherwise than in SDF
        self._springs: list[ForceElement] = []
        self._homes: list[tuple[str, Axis]] = []

    def made(self) -> tuple[XmlFile, tuple[ForceElement, ...]]:
        """The robot, with its springs."""
        if self._top.is_static:
            item = self._top.item
            raise item.xml.fail(item.element, f"{item.what} is static: nothing in it moves")
        for scope in self._top.every():
            self._notes.of_model(scope)
            for name, link in scope.links.items():
                self._read_link(scope, name, link)
        if not self._links:
            canonical(self._top, self._top.item)  # raises
        joints = Joints(self._top, self._frames)
        groups = _rigid(joints.edges)
        edges, gears = with_gears([_stiff(edge, self._notes) for edge in joints.edges],
                                  joints.gears, groups)  # fmt: skip
        edges += Ground(self._top, self._links, self._at, self._notes).welds(edges)
        for edge in edges:
            if edge.between:
                self._at[edge.child] = edge.place
        tree = spanning(edges, WORLD)
        self._add_links(edges)
        passed = downwards(tree, WORLD)
        driven = _driven(edges, joints.followers)
        for edge, forward in passed:
            self._add_joint(edge, forward, driven)
        followers = [*joints.followers, *followers_of(gears)]
        self._add_followers(followers, {edge.name for edge, _ in passed})
        inside = {id(edge) for edge, _ in passed}
        self._add_loops([edge for edge in edges if id(edge) not in inside], tree)
        self._add_home()
        self._notes.tell()
        xml = XmlFile.made(self._xml.file, self._robot, self._places.listed)
        return xml, tuple(self._springs)

    def _put(self, element: etree._Element, item: Item) -> etree._Element:
        for inner in element.iter(etree.Element):
            self._places.put(inner, item.where)
        return element

    def _read_link(self, scope: Scope, name: str, link: Item) -> None:
        if scope.is_static:
            return
        full = f"{scope.prefix}{name}"
        self._links[full] = scope, link
        inside = self._frames.of(scope, link, link.base)
        self._at[full] = self._frames.in_top(scope, self._top) * inside

    # --- what is written ---------------------------------------------------------------------

    def _add_links(self, edges: list[Edge]) -> None:
        self._names[WORLD] = self._free_link("world")
        ground = etree.SubElement(self._robot, "link", name=self._names[WORLD])
        self._put(ground, self._top.item)
        bodies = _rigid(edges)
        for name, (scope, link) in self._links.items():
            if bodies.of(name) != bodies.of(WORLD):
                warn_of_no_inertial(link)
            element = etree.SubElement(self._robot, "link", name=name)
            add_inertial(element, scope, link, self._frames)
            add_shapes(element, scope, link, self._frames, self._notes.lose)
            self._put(element, link)
        for edge in edges:
            if edge.between:
                link = etree.SubElement(self._robot, "link", name=edge.child, between=edge.between)
                self._put(link, edge.item)

    def _add_joint(self, edge: Edge, forward: bool, driven: set[str] | None) -> None:
        """A joint from parent to child, or the other way round with its axis turned."""
        ends = (edge.parent, edge.child) if forward else (edge.child, edge.parent)
        link = self._moved(edge, ends[1])
        kind = {"ball": "spherical"}.get(edge.kind, edge.kind)
        axis = edge.axis
        if axis is not None and edge.kind == "revolute" and not is_limited(axis):
            kind = "continuous"
        joint = etree.SubElement(self._robot, "joint", name=edge.name, type=kind)
        add_origin(joint, self._at[ends[0]].actInv(edge.place))
        etree.SubElement(joint, "parent", link=self._names.get(ends[0], ends[0]))
        etree.SubElement(joint, "child", link=link)
        if axis is not None:
            add_axis(joint, axis.direction if forward else -axis.direction)
            add_limit(joint, axis)
            add_dynamics(joint, axis)
            self._note_forces(edge.name, axis)
            if driven is not None:
                joint.set("independent", str(edge.name in driven).lower())
        self._put(joint, edge.item if axis is None else axis.item)

    def _moved(self, edge: Edge, link: str) -> str:
        """The link that a joint moves: one in its frame, if the link's is another."""
        offset = edge.place.actInv(self._at[link])
        if offset.isIdentity(_SAME):
            return self._names.get(link, link)
        name = self._free_link(f"{edge.name}_frame")
        self._put(etree.SubElement(self._robot, "link", name=name), edge.item)
        fixed = etree.SubElement(self._robot, "joint", name=f"{name}_fixed", type="fixed")
        add_origin(fixed, offset)
        etree.SubElement(fixed, "parent", link=name)
        etree.SubElement(fixed, "child", link=self._names.get(link, link))
        self._put(fixed, edge.item)
        return name

    def _free_link(self, name: str) -> str:
        while name in self._at:
            name += "_"
        self._at[name] = pin.SE3.Identity()
        return name

    def _note_forces(self, name: str, axis: Axis) -> None:
        if axis.stiffness < 0:
            raise axis.item.xml.fail(
                axis.item.element, f"the spring of {axis.item.what} has a negative stiffness"
            )
        if axis.stiffness:
            self._springs.append(ForceElement(name, axis.stiffness, axis.reference))
        if axis.initial is not None:
            self._homes.append((name, axis))

    def _add_followers(self, followers: list[Follower], joints: set[str]) -> None:
        elements = {joint.get("name"): joint for joint in self._robot.iterfind("joint")}
        for follower in followers:
            for name in (follower.name, follower.leader):
                if name not in joints:
                    raise follower.item.xml.fail(
                        follower.item.element,
                        f"{follower.item.what}: joint '{name}' is coupled and closes a loop of "
                        "coupled joints, leave one of them out",
                    )
            joint = elements[follower.name]
            if joint.find("mimic") is not None:
                raise follower.item.xml.fail(
                    follower.item.element, f"joint '{follower.name}' follows two others, keep one"
                )
            mimic = etree.SubElement(
                joint, "mimic", joint=follower.leader,
                multiplier=repr(follower.multiplier), offset=repr(follower.offset),
            )  # fmt: skip
            self._put(mimic, follower.item)

    def _add_loops(self, surplus: list[Edge], tree: list[Edge]) -> None:
        bodies = _rigid(tree)
        for edge in surplus:
            if bodies.of(edge.parent) == bodies.of(edge.child):
                if edge.kind != "fixed":
                    raise edge.item.xml.fail(
                        edge.item.element,
                        f"{edge.item.what} joins '{edge.parent}' and '{edge.child}', which are "
                        "one body: leave it out",
                    )
                continue
            kind = _LOOPS.get(edge.kind, edge.kind)
            loop = etree.SubElement(self._robot, "loop", name=edge.name, type=kind)
            for tag, link in (("predecessor", edge.parent), ("successor", edge.child)):
                end = etree.SubElement(loop, tag, link=self._names.get(link, link))
                add_origin(end, self._at[link].actInv(edge.place))
            if edge.axis is not None:
                add_axis(loop, edge.axis.direction)
                if is_limited(edge.axis):
                    self._notes.lose("limits of joints that close loops", edge.name)
                if edge.axis.damping or edge.axis.friction or edge.axis.stiffness:
                    self._notes.lose("friction and springs of joints that close loops", edge.name)
            self._put(loop, edge.item)

    def _add_home(self) -> None:
        if not self._homes:
            return
        state = etree.SubElement(self._robot, "group_state", name="home", group="all")
        for name, axis in self._homes:
            joint = etree.SubElement(state, "joint", name=name, value=repr(axis.initial))
            self._put(joint, axis.item)


_SAME = 1e-15


def _rigid(edges: list[Edge]) -> Groups:
    """The links that fixed joints make one body."""
    groups = Groups()
    for edge in edges:
        if edge.kind == "fixed":
            groups.join(edge.parent, edge.child)
    return groups


def _stiff(edge: Edge, notes: LeftOut) -> Edge:
    """A joint that may only stand at zero is fixed: the way to write that before 1.5 had it."""
    axis = edge.axis
    if axis is None or edge.bound or axis.lower != axis.upper or axis.lower:
        return edge
    notes.differ("joints limited to 0 are fixed", edge.name)
    return dataclasses.replace(edge, kind="fixed", axis=None)


def _driven(edges: list[Edge], followers: list[Follower]) -> set[str] | None:
    """Joints that have an effort; None where the file does not tell them from others.

    An effort of 0 says that nothing drives a joint, unless all have it.
    """
    single = {edge.name: edge.axis for edge in edges if edge.axis is not None}
    following = {follower.name for follower in followers}
    driven = {name for name, axis in single.items() if axis.effort and name not in following}
    passive = {name for name, axis in single.items() if not axis.effort}
    return driven if driven and passive else None
