"""The spanning tree: all sub-chains merged into one."""

import copy

from lxml import etree

from crane.description.findings import FollowUpError, kept, note
from crane.description.section import Section
from crane.description.spec import Chain, LoopSpec
from crane.description.urdf import Urdf
from crane.description.urdf_graph import MOVING
from crane.errors import CraneError, DescriptionError, known


class Tree:
    """The chains merged into one robot, so that Pinocchio builds it depth-first.

    Attributes:
        robot: One `<robot>` of all links and joints.
        links: File and line of each link.
        joints: File and line of each moving joint.
        where: The same as "link NAME" and "joint NAME".
        complete: Whether every name is here; where findings are collected, a chain or a name may
            have been refused.
    """

    def __init__(self) -> None:
        self.robot = etree.Element("robot", name="machine")
        self.links: dict[str, str] = {}
        self.joints: dict[str, str] = {}
        self.where: dict[str, str] = {}
        self.complete = True
        self._fixed: dict[str, str] = {}
        self._endless: set[str] = set()
        self._body: dict[str, str] = {}  # link -> the link it is rigidly attached to

    def add(self, chain: Chain, urdf: Urdf) -> None:
        """Hang a chain from its parent frame, the first from the world.

        Raises:
            DescriptionError: The frame is unknown, or a name is taken by an earlier chain.
        """
        self._body[urdf.root] = urdf.root
        with kept():
            self._hang(chain, urdf)
        self.complete &= urdf.complete
        for element in urdf.robot:
            name, kind = element.get("name"), element.get("type")
            names = self.links if kind is None else self.joints if kind in MOVING else self._fixed
            where = urdf.lines[element.tag, name]
            if self.where.get(f"{element.tag} {name}") == where:
                note(self._taken(element.tag, name, where))
                self.complete = False
                break  # one file twice: the rest of it is there, too
            if f"{element.tag} {name}" in self.where:
                note(self._taken(element.tag, name, where))
                self.complete = False  # what was meant goes by another name
                continue
            self._enter(element.tag, name, where, names)
            if kind in MOVING and element.find("limit") is None:
                self._endless.add(name)
            self.robot.append(copy.deepcopy(element))
        self._attach(urdf)

    def _hang(self, chain: Chain, urdf: Urdf) -> None:
        if chain.parent is not None:
            if chain.parent not in self.links:
                raise self._unknown(
                    f"{chain.where}: chain '{chain.name}' hangs from '{chain.parent}', no frame "
                    f"of an earlier chain, {known(self.links, chain.parent)}"
                )
            name = f"{chain.name}_attachment"
            self._enter("joint", name, chain.where, self._fixed)
            joint = etree.SubElement(self.robot, "joint", name=name, type="fixed")
            etree.SubElement(joint, "parent", link=chain.parent)
            etree.SubElement(joint, "child", link=urdf.root)
            self._body[urdf.root] = self._body.get(chain.parent, urdf.root)

    def _enter(self, kind: str, name: str, where: str, names: dict[str, str]) -> None:
        if f"{kind} {name}" in self.where:
            raise self._taken(kind, name, where)
        names[name] = self.where[f"{kind} {name}"] = where

    def _taken(self, kind: str, name: str, where: str) -> DescriptionError:
        there = self.where[f"{kind} {name}"]
        return DescriptionError(f"{where}: {kind} '{name}' is also in {there}, rename one")

    def _unknown(self, message: str) -> CraneError:
        """The error about a name that is not there, unless a chain is not, either."""
        return DescriptionError(message) if self.complete else FollowUpError(message)

    def _attach(self, urdf: Urdf) -> None:
        """Find out which links of a chain make one body."""
        below: dict[str, list[tuple[str, bool]]] = {}
        for joint in urdf.robot.iter("joint"):
            parent, child = (joint.find(end).get("link") for end in ("parent", "child"))
            if parent and child:  # which is a forest, see `crane.description.urdf_graph`
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
            problem = f"{where}: joint '{joint}' is fixed, name a moving one"
            raise DescriptionError(problem) if self.joints else FollowUpError(problem)
        if joint not in self.joints:
            raise self._unknown(
                f"{where}: joint '{joint}' is unknown, {known(self.joints, joint)}"
            )

    def check_link(self, link: str, where: str, what: str) -> None:
        """Raise for a link that does not exist, called `what`."""
        if link not in self.links:
            raise self._unknown(f"{where}: {what} '{link}' is unknown, {known(self.links, link)}")

    def joint(self, section: Section) -> str:
        """The joint that a section names."""
        joint = section.text("joint")
        self.check_joint(joint, section.where("joint"))
        return joint

    def check_loop(self, loop: LoopSpec) -> None:
        """Raise for a loop between frames that do not move against each other."""
        body = self._body.get(loop.predecessor)
        if body is not None and body == self._body.get(loop.successor):
            raise DescriptionError(
                f"{loop.where}: loop '{loop.name}' joins '{loop.predecessor}' and "
                f"'{loop.successor}', both on the body '{body}': choose frames of two bodies"
            )

    def moves(self, link: str) -> bool:
        """Whether a link is not fixed to the world."""
        return not self.complete or self._body.get(link) != next(iter(self._body))

    def has_limits(self, joint: str) -> bool:
        """Whether a joint has a finite range."""
        return joint not in self._endless

    def only_leaf(self) -> str | None:
        """The last link of an unbranched chain."""
        parents = {tag.get("link") for tag in self.robot.iter("parent")}
        leaves = [name for name in self.links if name not in parents]
        return leaves[0] if len(leaves) == 1 else None
