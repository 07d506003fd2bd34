"""The tree as it grows, chain by chain, and whether the names that others use are in it."""

import math
from collections.abc import Iterable, Iterator, Sequence

from crane.common.errors import CraneError, DescriptionError, known
from crane.description.findings import FollowUpError, flag, recoverable
from crane.description.floating import afloat_tree
from crane.description.spec import Chain, LoopSpec
from crane.description.tree import Joint, Link, Tree
from crane.formats.machine_file.section import Section
from crane.formats.urdf.read import Urdf


class TreeBuilder:
    """The chains hung onto each other.

    Attributes:
        links: By name.
        joints: Those that move, by name.
        complete: Whether every name is here; where findings are collected, a chain or a name may
            have been refused.
    """

    def __init__(self) -> None:
        self.links: dict[str, Link] = {}
        self.joints: dict[str, Joint] = {}
        self.complete = True
        self._every: dict[str, Joint] = {}
        self._body: dict[str, str] = {}  # link -> the link it is rigidly attached to

    @property
    def tree(self) -> Tree:
        """All that has been added."""
        return Tree(dict(self.links), dict(self._every))

    def add(self, chain: Chain, urdf: Urdf) -> None:
        """Hang a chain from its parent frame, the first from the world.

        Raises:
            DescriptionError: The frame is unknown, or a name is taken by an earlier chain.
        """
        self._body[urdf.root] = urdf.root
        with recoverable():
            self._hang(chain, urdf)
        parts = list(urdf.tree)
        free = list(self.free(parts))
        # what is not there goes by another name
        self.complete &= urdf.complete and len(free) == len(parts)
        for part in free:
            self._enter(part)
        self._attach(urdf)

    def let_float(self, freedoms: Sequence[str]) -> None:
        """Let the root of the first chain float instead of standing on the world."""
        if not freedoms or not self.links:
            return
        root = self.tree.root
        whole = afloat_tree(self.tree, freedoms)
        self.links, self._every = dict(whole.links), dict(whole.joints)
        self.joints = {name: joint for name, joint in whole.joints.items() if joint.moves}
        bodies = {link: root for link, body in self._body.items() if body == root}
        self._body = {whole.root: whole.root} | self._body | bodies

    def free(self, parts: Iterable[Link | Joint]) -> Iterator[Link | Joint]:
        """Those whose names are not taken; the others are noted."""
        for part in parts:
            earlier = self._same(part)
            if earlier is None:
                yield part
                continue
            flag(_taken(part, earlier))
            if earlier.where == part.where:
                return  # one file twice: the rest of it is there, too

    def _same(self, part: Link | Joint) -> Link | Joint | None:
        names = self.links if isinstance(part, Link) else self._every
        return names.get(part.name)

    def _enter(self, part: Link | Joint) -> None:
        if isinstance(part, Link):
            self.links[part.name] = part
            return
        self._every[part.name] = part
        if part.moves:
            self.joints[part.name] = part

    def _hang(self, chain: Chain, urdf: Urdf) -> None:
        if chain.parent is None:
            return
        if chain.parent not in self.links:
            raise self.unknown(
                f"{chain.where}: chain '{chain.name}' hangs from '{chain.parent}', no frame "
                f"of an earlier chain, {known(self.links, chain.parent)}",
                chain.parent,
            )
        joint = chain.attached(urdf.root)
        if (earlier := self._same(joint)) is not None:
            raise _taken(joint, earlier)
        self._enter(joint)
        self._body[urdf.root] = self._body.get(chain.parent, urdf.root)

    def unknown(self, message: str, name: str = "?") -> CraneError:
        """The error about a name, unless a chain is not there or the name has been refused."""
        told = not self.complete or not name
        return FollowUpError(message) if told else DescriptionError(message)

    def _attach(self, urdf: Urdf) -> None:
        """Find out which links of a chain make one body."""
        below = urdf.tree.below()  # which is a forest, see `crane.formats.urdf.graph`
        waiting = [urdf.root]
        while waiting:
            link = waiting.pop()
            for joint in below.get(link, ()):
                self._body[joint.child] = joint.child if joint.moves else self._body[link]
                waiting.append(joint.child)

    def check_joint(self, joint: str, where: str) -> None:
        """Raise for a joint that does not exist or does not move."""
        if joint in self.joints:
            return
        if joint in self._every:
            problem = f"{where}: joint '{joint}' is fixed, name a moving one"
            raise DescriptionError(problem) if self.joints else FollowUpError(problem)
        problem = f"{where}: joint '{joint}' is unknown, {known(self.joints, joint)}"
        raise self.unknown(problem, joint)

    def check_link(self, link: str, where: str, what: str) -> None:
        """Raise for a link that does not exist, called `what`."""
        if link not in self.links:
            problem = f"{where}: {what} '{link}' is unknown, {known(self.links, link)}"
            raise self.unknown(problem, link)

    def joint(self, section: Section) -> str:
        """The joint that a section names."""
        joint = section.text("joint")
        self.check_joint(joint, section.where("joint"))
        return joint

    def frames(self, section: Section) -> tuple[str, str]:
        """The two frames that a section is between, on two bodies.

        Raises:
            DescriptionError: There are not two, one is unknown, or both are on one body.
        """
        links, where = section.names("between"), section.where("between")
        if len(links) != 2:
            raise section.fail("between", f"{section.title} is between two frames, name two")
        for link in links:
            self.check_link(link, where, "the frame")
        one, two = links
        body = self._body.get(one)
        if body is not None and body == self._body.get(two):
            raise section.fail(
                "between",
                f"'{one}' and '{two}' are both on the body '{body}', choose frames of two bodies",
            )
        return one, two

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

    def unlimited(self, joint: str) -> str:
        """How a joint lacks a finite range, in words; empty if it has one, or is unknown."""
        found = self.joints.get(joint)
        if found is None:
            return ""
        endless = [math.isinf(end) for end in (found.limits.lower, found.limits.upper)]
        if all(endless) and found.kind == "revolute":
            return "is continuous"
        return "is not limited at both ends" if any(endless) else ""

    def only_leaf(self) -> str | None:
        """The last link of an unbranched chain."""
        parents = {joint.parent for joint in self._every.values()}
        leaves = [name for name in self.links if name not in parents]
        return leaves[0] if len(leaves) == 1 else None


def _taken(part: Link | Joint, earlier: Link | Joint) -> DescriptionError:
    kind = "link" if isinstance(part, Link) else "joint"
    return DescriptionError(
        f"{part.where}: {kind} '{part.name}' is also in {earlier.where}, rename one"
    )
