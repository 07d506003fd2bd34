"""The structure of a machine file: chains, loops, couplings, drives, and the tree that they form.

The tree grows chain by chain, and knows whether names that others use are in it.
"""

import math
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path

from crane.common.errors import CraneError, DescriptionError, suggest_names
from crane.description.findings import FollowUpError, error_recovery, report_error
from crane.description.floating_bases import add_base_joints, check_freedoms
from crane.description.force_elements import ForceElement, Friction
from crane.description.kinematic_tree import Joint, Link, Tree, body_of
from crane.description.specification import (
    AXISLESS_TYPES,
    LOOP_TYPES,
    Chain,
    Coupling,
    Drive,
    LoopSpec,
    unit_vector,
)
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.urdf.urdf_reader import UrdfModel, read_urdf


class TreeBuilder:
    """The chains hung onto each other.

    Attributes:
        links: By name.
        joints: Those that move, by name.
        is_complete: Whether every name is here; where findings are collected, a chain or a name
            may have been refused.
    """

    def __init__(self) -> None:
        self.links: dict[str, Link] = {}
        self.joints: dict[str, Joint] = {}
        self.is_complete = True
        self._all_joints: dict[str, Joint] = {}
        self._parent_joints: dict[str, Joint] = {}

    @property
    def tree(self) -> Tree:
        """All that has been added."""
        return Tree(dict(self.links), dict(self._all_joints))

    def add_chain(self, chain: Chain, urdf: UrdfModel) -> None:
        """Hang a chain from its parent frame, the first from the world.

        Raises:
            DescriptionError: The frame is unknown, or a name is taken by an earlier chain.
        """
        with error_recovery():
            self._attach_to_parent(chain, urdf)
        parts = list(urdf.tree)
        free = list(self.filter_new_names(parts))
        # what is not there goes by another name
        self.is_complete &= urdf.is_complete and len(free) == len(parts)
        for part in free:
            self._add_part(part)

    def add_floating_base(self, freedoms: Sequence[str]) -> None:
        """Let the root of the first chain float instead of standing on the world."""
        if not freedoms or not self.links:
            return
        floating_tree = add_base_joints(self.tree, freedoms)
        self.links, self._all_joints, self.joints = {}, {}, {}
        for part in floating_tree:
            self._add_part(part)

    def filter_new_names(self, parts: Iterable[Link | Joint]) -> Iterator[Link | Joint]:
        """Those whose names are not taken; the others are noted."""
        for part in parts:
            earlier = self._find_same_name(part)
            if earlier is None:
                yield part
                continue
            report_error(_duplicate_name_error(part, earlier))
            if earlier.source_location == part.source_location:
                return  # one file twice: the rest of it is there, too

    def _find_same_name(self, part: Link | Joint) -> Link | Joint | None:
        names = self.links if isinstance(part, Link) else self._all_joints
        return names.get(part.name)

    def _add_part(self, part: Link | Joint) -> None:
        if isinstance(part, Link):
            self.links[part.name] = part
            return
        self._all_joints[part.name] = self._parent_joints[part.child] = part
        if part.is_movable:
            self.joints[part.name] = part

    def _attach_to_parent(self, chain: Chain, urdf: UrdfModel) -> None:
        if chain.parent is None:
            return
        if chain.parent not in self.links:
            raise self.unknown_name_error(
                f"{chain.source_location}: chain '{chain.name}' hangs from '{chain.parent}', no "
                f"frame of an earlier chain, {suggest_names(self.links, chain.parent)}",
                chain.parent,
            )
        joint = chain.attachment_joint(urdf.root_link)
        if (earlier := self._find_same_name(joint)) is not None:
            raise _duplicate_name_error(joint, earlier)
        self._add_part(joint)

    def unknown_name_error(self, message: str, name: str = "?") -> CraneError:
        """The error about a name, unless a chain is not there or the name has been refused."""
        return (
            FollowUpError(message)
            if (not self.is_complete or not name)
            else DescriptionError(message)
        )

    def check_joint(self, joint: str, source_location: str) -> None:
        """Raise for a joint that does not exist or does not move."""
        if joint in self.joints:
            return
        if joint in self._all_joints:
            problem = f"{source_location}: joint '{joint}' is fixed, name a moving one"
            raise DescriptionError(problem) if self.joints else FollowUpError(problem)
        raise self.unknown_name_error(
            f"{source_location}: joint '{joint}' is unknown, {suggest_names(self.joints, joint)}",
            joint,
        )

    def check_link(self, link: str, source_location: str, label: str) -> None:
        """Raise for a link that does not exist, called `label`."""
        if link not in self.links:
            raise self.unknown_name_error(
                (
                    f"{source_location}: {label} '{link}' is unknown, "
                    f"{suggest_names(self.links, link)}"
                ),
                link,
            )

    def read_frame_pair(self, section: YamlSection) -> tuple[str, str]:
        """The two frames that a section is between, on two bodies.

        Raises:
            DescriptionError: There are not two, one is unknown, or both are on one body.
        """
        links, where = section.names("between"), section.source_location("between")
        if len(links) != 2:
            raise section.error_at("between", f"{section.title} is between two frames, name two")
        for link in links:
            self.check_link(link, where, "the frame")
        first, second = links
        body = body_of(self._parent_joints, first)
        if body == body_of(self._parent_joints, second):
            raise section.error_at(
                "between",
                f"'{first}' and '{second}' are both on the body '{body}', choose frames of two "
                f"bodies",
            )
        return first, second

    def check_loop(self, loop: LoopSpec) -> None:
        """Raise for a loop between frames that do not move against each other."""
        body = body_of(self._parent_joints, loop.predecessor)
        if body == body_of(self._parent_joints, loop.successor):
            raise DescriptionError(
                f"{loop.source_location}: loop '{loop.name}' joins '{loop.predecessor}' and "
                f"'{loop.successor}', both on the body '{body}': choose frames of two bodies"
            )

    def is_movable(self, link: str) -> bool:
        """Whether a link is not fixed to the world."""
        return not self.is_complete or body_of(self._parent_joints, link) != self.tree.root_link

    def missing_limit_text(self, joint: str) -> str:
        """How a joint lacks a finite range, in words; empty if it has one, or is unknown."""
        found = self.joints.get(joint)
        if found is None:
            return ""
        is_infinite = [math.isinf(end) for end in (found.limits.lower, found.limits.upper)]
        if all(is_infinite) and found.kind == "revolute":
            return "is continuous"
        return "is not limited at both ends" if any(is_infinite) else ""

    def single_leaf_link(self) -> str | None:
        """The last link of an unbranched chain."""
        parents = {joint.parent for joint in self._all_joints.values()}
        leaves = [name for name in self.links if name not in parents]
        return leaves[0] if len(leaves) == 1 else None


def _duplicate_name_error(part: Link | Joint, earlier: Link | Joint) -> DescriptionError:
    kind = "link" if isinstance(part, Link) else "joint"
    return DescriptionError(
        f"{part.source_location}: {kind} '{part.name}' is also in {earlier.source_location}, "
        f"rename one"
    )


def read_chains(
    top: YamlSection, path: Path
) -> tuple[
    tuple[Chain, ...], TreeBuilder, dict[str, Friction], tuple[Coupling, ...],
    tuple[ForceElement, ...],
]:  # fmt: skip
    """The sub-chains, their tree, and the friction, couplings and springs of their URDFs."""
    chains: list[Chain] = []
    tree = TreeBuilder()
    friction: dict[str, Friction] = {}
    couplings: tuple[Coupling, ...] = ()
    springs: tuple[ForceElement, ...] = ()
    for item in top.list_items("chains"):
        tree.is_complete &= top.is_complete
        was_complete = tree.is_complete
        tree.is_complete = False
        with error_recovery():
            chain, urdf = _read_chain(item, chains, was_complete, path)
            tree.is_complete = was_complete
            tree.add_chain(chain, urdf)
            chains.append(chain)
            friction |= urdf.friction
            couplings += urdf.couplings
            springs += urdf.springs
    tree.is_complete &= top.is_complete
    if not chains and tree.is_complete:
        report_error(top.error_at("chains", "there are no chains, add one under 'chains:'"))
        tree.is_complete = False
    with error_recovery(harmless=True):
        tree.add_floating_base(check_freedoms(top.names("floating")))
    if not tree.joints and tree.is_complete:
        report_error(top.error_at("chains", "no joint of these chains moves, add one"))
    return tuple(chains), tree, friction, couplings, springs


def _read_chain(
    item: YamlSection, earlier_chains: list[Chain], are_all_read: bool, path: Path
) -> tuple[Chain, UrdfModel]:
    """A chain and its file.

    Args:
        item: Where it is written.
        earlier_chains: The chains before it.
        are_all_read: Whether these are all that were written before it.
        path: The machine file.
    """
    name, parent = item.text("name"), item.text("parent")
    file = item.file("urdf")
    if any(chain.name == name for chain in earlier_chains):
        report_error(item.error_at("name", f"two chains are named '{name}', rename one"))
    elif (earlier_chains or not are_all_read) and parent is None:
        report_error(
            item.error_at(None, f"chain '{name}' has no 'parent', name the frame it hangs from")
        )
    elif not earlier_chains and are_all_read and parent is not None:
        report_error(
            item.error_at(
                "parent", f"chain '{name}' is first and stands on the world, remove its 'parent'"
            )
        )
        parent = None
    urdf = read_urdf(file)
    for loop in urdf.loops[:1]:
        problem = f"a sub-chain has no <loop>, write it under 'loops' of {path.name}"
        report_error(DescriptionError(f"{loop.source_location}: {problem}"))
    return Chain(name, file, parent, item.source_location("parent"), urdf.moving_joints), urdf


def read_loops(top: YamlSection, tree: TreeBuilder) -> tuple[LoopSpec, ...]:
    """Joints that close the chains into loops."""
    loops: dict[str, LoopSpec] = {}
    for item in top.list_items("loops"):
        with error_recovery():
            loop = _read_loop(item, tree, loops)
            loops[loop.name] = loop
    return tuple(loops.values())


def _read_loop(section: YamlSection, tree: TreeBuilder, earlier_names: Container[str]) -> LoopSpec:
    name, kind = section.text("name"), section.text("type")
    label = f"loop '{name}'" if name else "a loop"
    frames = []
    for end in ("predecessor", "successor"):
        frame = section.text(end)
        if frame and frame not in tree.links and tree.is_complete:
            report_error(
                section.error_at(
                    end,
                    f"{label} has the unknown {end} '{frame}', {suggest_names(tree.links, frame)}",
                )
            )
        frames.append(frame)
    axis = None
    with error_recovery():
        axis = unit_vector(section.numbers("axis"))
        if axis is None and kind in AXISLESS_TYPES:
            axis = (0.0, 0.0, 1.0)
        if axis is None:
            problem = f"the axis of {label} is no direction"
            raise section.error_at("axis", f"{problem}, give three numbers, not all zero")
    if axis is None or kind not in LOOP_TYPES or not all(end in tree.links for end in frames):
        raise FollowUpError(f"{label} is not complete")
    loop = LoopSpec(name, kind, frames[0], frames[1], axis, section.source_location())
    tree.check_loop(loop)
    if name in earlier_names:
        raise section.error_at("name", f"two loops are named '{name}', rename one")
    return loop


def read_couplings(top: YamlSection, tree: TreeBuilder) -> tuple[Coupling, ...]:
    """Linear constraints of joints."""
    found: dict[str, Coupling] = {}
    for item in top.list_items("couplings"):
        with error_recovery():
            coupling = _read_coupling(item, tree, found)
            found[coupling.name] = coupling
    return tuple(found.values())


def _read_coupling(
    item: YamlSection, tree: TreeBuilder, earlier_names: Container[str]
) -> Coupling:
    name, joints = item.text("name"), item.section("joints")
    if name in earlier_names:
        raise item.error_at("name", f"two couplings are named '{name}', rename one")
    if joints is None or len(list(joints)) < 2:
        raise item.error_at("joints", f"coupling '{name}' joins less than two joints, add some")
    return Coupling(
        name,
        item.value_map("joints", YamlSection.number, tree.check_joint),
        item.number("offset"),
        item.source_location(),
    )


def read_drives(top: YamlSection, tree: TreeBuilder) -> tuple[Drive, ...]:
    """What motors act along, where that is not the active joints one by one."""

    def read_drive(section: YamlSection, name: str) -> Drive:
        title = f"drive '{name}'"
        joints = section.section(name, title)
        if joints is None or not list(joints):
            raise section.error_at(name, f"{title} moves no joint, name some")
        for joint in joints:
            tree.check_joint(joint, joints.source_location(joint))
        return Drive(name, section.value_map(name, YamlSection.number, title=title))

    return tuple(top.value_map("drives", read_drive).values())


def read_home(top: YamlSection, tree: TreeBuilder) -> tuple[dict[str, float], dict[str, str]]:
    """Coordinates of the home configuration, and the file and line of each as "home JOINT"."""
    home = top.value_map("home", YamlSection.number, tree.check_joint)
    locations = top.item_locations("home") if home else {}
    return home, {f"home {joint}": locations[joint] for joint in home}
