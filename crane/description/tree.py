"""The spanning tree: all sub-chains merged into one."""

import copy

from lxml import etree

from crane.description.section import Section
from crane.description.spec import Chain, LoopSpec
from crane.description.urdf import MOVING, Urdf
from crane.errors import DescriptionError, known


class Tree:
    """The chains merged into one robot, so that Pinocchio builds it depth-first.

    Attributes:
        robot: One `<robot>` of all links and joints.
        links: File and line of each link.
        joints: File and line of each moving joint.
        where: The same as "link NAME" and "joint NAME".
    """

    def __init__(self) -> None:
        self.robot = etree.Element("robot", name="machine")
        self.links: dict[str, str] = {}
        self.joints: dict[str, str] = {}
        self.where: dict[str, str] = {}
        self._fixed: dict[str, str] = {}
        self._endless: set[str] = set()
        self._body: dict[str, str] = {}  # link -> the link it is rigidly attached to

    def add(self, chain: Chain, urdf: Urdf) -> None:
        """Hang a chain from its parent frame, the first from the world.

        Raises:
            DescriptionError: The frame is unknown, or a name is taken by an earlier chain.
        """
        self._body[urdf.root] = urdf.root
        if chain.parent is not None:
            if chain.parent not in self.links:
                raise DescriptionError(
                    f"{chain.where}: chain '{chain.name}' hangs from '{chain.parent}', no frame "
                    f"of an earlier chain, {known(self.links, chain.parent)}"
                )
            name = f"{chain.name}_attachment"
            self._enter("joint", name, chain.where, self._fixed)
            joint = etree.SubElement(self.robot, "joint", name=name, type="fixed")
            etree.SubElement(joint, "parent", link=chain.parent)
            etree.SubElement(joint, "child", link=urdf.root)
            self._body[urdf.root] = self._body[chain.parent]
        for element in urdf.robot:
            name, kind = element.get("name"), element.get("type")
            names = self.links if kind is None else self.joints if kind in MOVING else self._fixed
            self._enter(element.tag, name, urdf.lines[element.tag, name], names)
            if kind in MOVING and element.find("limit") is None:
                self._endless.add(name)
            self.robot.append(copy.deepcopy(element))
        self._attach(urdf)

    def _enter(self, kind: str, name: str, where: str, names: dict[str, str]) -> None:
        if (there := self.where.get(f"{kind} {name}")) is not None:
            raise DescriptionError(f"{where}: {kind} '{name}' is also in {there}, rename one")
        names[name] = self.where[f"{kind} {name}"] = where

    def _attach(self, urdf: Urdf) -> None:
        """Find out which links of a chain make one body."""
        below: dict[str, list[tuple[str, bool]]] = {}
        for joint in urdf.robot.iter("joint"):
            parent, child = (joint.find(end).get("link") for end in ("parent", "child"))
            below.setdefault(parent, []).append((child, joint.get("type") == "fixed"))
        waiting = [urdf.root]
        while waiting:
            link = waiting.pop()
            for child, fixed in below.get(link, ()):
                self._body[child] = self._body[link] if fixed else child
                waiting.append(child)

    def check_joint(self, joint: str, where: str) -> None:
        """Raise for a joint that does not exist or does not move."""
        if joint in self._fixed:
            raise DescriptionError(f"{where}: joint '{joint}' is fixed, name a moving one")
        if joint not in self.joints:
            raise DescriptionError(
                f"{where}: joint '{joint}' is unknown, {known(self.joints, joint)}"
            )

    def joint(self, section: Section) -> str:
        """The joint that a section names."""
        joint = section.text("joint")
        self.check_joint(joint, section.where("joint"))
        return joint

    def check_loop(self, loop: LoopSpec) -> None:
        """Raise for a loop between frames that do not move against each other."""
        body = self._body[loop.predecessor]
        if body == self._body[loop.successor]:
            raise DescriptionError(
                f"{loop.where}: loop '{loop.name}' joins '{loop.predecessor}' and "
                f"'{loop.successor}', both on the body '{body}': choose frames of two bodies"
            )

    def moves(self, link: str) -> bool:
        """Whether a link is not fixed to the world."""
        return self._body[link] != next(iter(self._body))

    def has_limits(self, joint: str) -> bool:
        """Whether a joint has a finite range."""
        return joint not in self._endless

    def only_leaf(self) -> str | None:
        """The last link of an unbranched chain."""
        parents = {tag.get("link") for tag in self.robot.iter("parent")}
        leaves = [name for name in self.links if name not in parents]
        return leaves[0] if len(leaves) == 1 else None
