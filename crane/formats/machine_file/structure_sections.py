"""The structure of a machine file: chains, loops, couplings, drives, and the tree that they form.

The tree grows chain by chain, and knows whether names that others use are in it.
"""

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from crane.common.errors import CraneError, DescriptionError, suggest_names, warn
from crane.description.findings import FollowUpError, error_recovery, report_error
from crane.description.force_elements import ForceElement, Friction
from crane.description.kinematic_tree import Joint, Link, Tree, body_of, path_to_root
from crane.description.pinocchio_conversion import rotation_from_rpy, se3_from_xyz_rpy
from crane.description.rotation_vectors import add_base_joints, check_freedoms
from crane.description.specification import (
    AXISLESS_TYPES,
    LOOP_TYPES,
    STANDARD_GRAVITY,
    Chain,
    Coupling,
    Drive,
    LoopSpec,
    MachineSpec,
    unit_vector,
)
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.urdf.urdf_reader import read_urdf

_LOOP_END_PATTERN = re.compile(
    r"((?:closing_|closed?_?loop|loop_?clos).*?)_?([12AB])", re.IGNORECASE
)
_END_LABELS = ({"1", "2"}, {"A", "B"})
_MAX_SHOWN, _UPRIGHT_TOLERANCE = 4, 1e-9  # pairs in a line; rise of a level unit vector


class TreeBuilder:
    """The chains hung onto each other.

    Args:
        tree: What is there already.
        is_complete: See below.

    Attributes:
        tree: All links and joints.
        joints: Those that move, by name.
        is_complete: Whether every name is here; where findings are collected, a chain or a name
            may have been refused.
    """

    def __init__(self, tree: Tree, is_complete: bool = True):
        self.is_complete = is_complete
        self._set_tree(tree)

    def _set_tree(self, tree: Tree) -> None:
        self.tree, self.links, self._parent_joints = tree, tree.links, tree.parent_joints
        self.joints = {joint.name: joint for joint in tree.moving_joints}

    def add_chain(self, chain: Chain, urdf: MachineSpec) -> None:
        """Hang a chain from its parent frame, the first from the world.

        Raises:
            DescriptionError: The frame is unknown, or a name is taken by an earlier chain.
        """
        with error_recovery():
            label = f"{chain.source_location}: chain '{chain.name}' hangs from '{chain.parent}'"
            if chain.parent is not None:
                problem = f"{label}, no frame of an earlier chain"
                self.check_name(chain.parent, self.links, problem)
            attachments = [chain.attachment_joint(urdf.tree.root_link)] * (
                chain.parent is not None
            )
            self._set_tree(self.tree.with_parts(*self.filter_new_names(attachments)))
        parts = list(urdf.tree)
        free = list(self.filter_new_names(parts))
        # what is not there goes by another name
        self.is_complete &= urdf.is_complete and len(free) == len(parts)
        self._set_tree(self.tree.with_parts(*free))

    def add_floating_base(self, freedoms: Sequence[str]) -> None:
        """Let the root of the first chain float instead of standing on the world."""
        if freedoms and self.links:
            self._set_tree(add_base_joints(self.tree, freedoms))

    def filter_new_names(self, parts: Iterable[Link | Joint]) -> Iterator[Link | Joint]:
        """Those whose names are not taken; the others are noted."""
        for part in parts:
            is_link = isinstance(part, Link)
            earlier = (self.links if is_link else self.tree.joints).get(part.name)
            if earlier is None:
                yield part
                continue
            report_error(
                DescriptionError(
                    f"{part.source_location}: {'link' if is_link else 'joint'} '{part.name}' is "
                    f"also in {earlier.source_location}, rename one"
                )
            )
            if earlier.source_location == part.source_location:
                return  # one file twice: the rest of it is there, too

    def unknown_name_error(self, message: str, name: str = "?") -> CraneError:
        """The error about a name, unless a chain is not there or the name has been refused."""
        return DescriptionError(message) if self.is_complete and name else FollowUpError(message)

    def check_name(self, name: str, names: Collection[str], problem: str) -> None:
        """Raise for a name that is not among some."""
        if name not in names:
            raise self.unknown_name_error(f"{problem}, {suggest_names(names, name)}", name)

    def check_joint(self, joint: str, source_location: str) -> None:
        """Raise for a joint that does not exist or does not move."""
        if joint in self.joints:
            return
        if joint in self.tree.joints:
            problem = f"{source_location}: joint '{joint}' is fixed, name a moving one"
            raise DescriptionError(problem) if self.joints else FollowUpError(problem)
        self.check_name(joint, self.joints, f"{source_location}: joint '{joint}' is unknown")

    def check_link(self, link: str, source_location: str, label: str) -> None:
        """Raise for a link that does not exist, called `label`."""
        self.check_name(link, self.links, f"{source_location}: {label} '{link}' is unknown")

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
        is_forest = any(joint.is_cut for joint in self.tree.joints.values())
        is_known = self.is_complete and not is_forest
        return not is_known or body_of(self._parent_joints, link) != self.tree.root_link

    def lifting_joint(self, link: str) -> str:
        """The first joint from the world to a link that does not move it level; "" if none."""
        rotation, found = np.eye(3), ""
        for joint in path_to_root(self._parent_joints, link)[::-1]:
            rotation = rotation @ rotation_from_rpy(joint.rpy)
            tilt = abs(abs(float(rotation[2] @ joint.axis)) - (joint.kind == "revolute"))
            found = found or joint.name * (joint.is_movable and tilt > _UPRIGHT_TOLERANCE)
        return found

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
        parents = {joint.parent for joint in self.tree.joints.values()}
        leaves = [name for name in self.links if name not in parents]
        return leaves[0] if len(leaves) == 1 else None


def read_drawn_chain(top: YamlSection, path: Path) -> MachineSpec:
    """The machine that the section `drawing` has, of one chain; of none without the section."""
    if "drawing" in top:
        with error_recovery():
            spec = read_urdf(path)
            chain = replace(
                spec.chains[0], name="drawing", source_location=top.source_location("drawing")
            )
            return replace(spec, chains=(chain,))
        top.is_complete = False
    return MachineSpec(name="", source="", path=path, chains=(), tree=Tree({}, {}))


def read_chains(
    top: YamlSection, path: Path, drawn: MachineSpec
) -> tuple[
    tuple[Chain, ...], TreeBuilder, dict[str, Friction], tuple[Coupling, ...],
    tuple[ForceElement, ...], tuple[float, ...],
]:  # fmt: skip
    """The sub-chains, their tree, the friction, couplings and springs of their URDFs, gravity."""
    chains: list[Chain] = []
    tree = TreeBuilder(Tree({}, {}))
    friction: dict[str, Friction] = {}
    couplings: tuple[Coupling, ...] = ()
    springs: tuple[ForceElement, ...] = ()
    gravities: dict[tuple[float, ...], str] = {}  # name of a chain that states each
    for chain in drawn.chains:
        tree.add_chain(chain, drawn)
        chains.append(chain)
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
            springs += urdf.forces
            if "gravity" in urdf.source_locations:
                gravities.setdefault(urdf.gravity, chain.name)
    tree.is_complete &= top.is_complete
    if not chains and tree.is_complete:
        report_error(
            top.error_at("chains", "there are no chains, add one under 'chains:', or a 'drawing:'")
        )
        tree.is_complete = False
    with error_recovery(harmless=True):
        tree.add_floating_base(check_freedoms(top.names("floating")))
    if not tree.joints and tree.is_complete:
        report_error(top.error_at("chains", "no joint of these chains moves, add one"))
    return tuple(chains), tree, friction, couplings, springs, _read_gravity(top, gravities)


def _read_gravity(
    top: YamlSection, gravities: Mapping[tuple[float, ...], str]
) -> tuple[float, ...]:
    """The gravity of the file, or else the only one that its chains state."""
    if "gravity" in top or not gravities:
        with error_recovery(harmless=True):
            if len(gravity := top.numbers("gravity")) == 3:
                return gravity
            raise top.error_at("gravity", f"gravity has {len(gravity)} numbers, give 3: [x, y, z]")
    if len(gravities) > 1:
        names = " and ".join(f"'{name}'" for name in gravities.values())
        problem = f"the chains {names} have different gravity, write 'gravity' in this file"
        report_error(top.error_at("chains", problem))
    return next(iter(gravities), STANDARD_GRAVITY)


def _read_chain(
    item: YamlSection, earlier_chains: list[Chain], are_all_read: bool, path: Path
) -> tuple[Chain, MachineSpec]:
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
    if not earlier_chains and are_all_read and parent is not None:
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
    location, joints = item.source_location("parent"), urdf.chains[0].joints
    return Chain(name, file, parent, location, joints), urdf


def read_loops(top: YamlSection, tree: TreeBuilder) -> tuple[LoopSpec, ...]:
    """Joints that close the chains into loops."""
    names: list[str] = []

    def read_loop(section: YamlSection) -> LoopSpec:
        name, kind = section.text("name"), section.text("type")
        label = f"loop '{name}'" if name else "a loop"
        frames = []
        for end in ("predecessor", "successor"):
            frame = section.text(end)
            location = section.source_location(end)
            with error_recovery():
                problem = f"{location}: {label} has the unknown {end} '{frame}'"
                tree.check_name(frame, tree.links, problem)
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
        if name in names:
            raise section.error_at("name", f"two loops are named '{name}', rename one")
        names.append(name)
        return loop

    return top.read_items("loops", read_loop)


def read_couplings(top: YamlSection, tree: TreeBuilder) -> tuple[Coupling, ...]:
    """Constraints of joints."""
    names: list[str] = []

    def read_coupling(item: YamlSection) -> Coupling:
        name = item.text("name")
        if name in names:
            raise item.error_at("name", f"two couplings are named '{name}', rename one")
        factors = item.value_map("joints", YamlSection.number, tree.check_joint)
        powers = item.value_map("powers", _read_powers, tree.check_joint)
        coupling = Coupling(name, factors, item.number("offset"), item.source_location(), powers)
        if len(coupling.joints) < 2:
            raise item.error_at(
                "joints", f"coupling '{name}' joins less than two joints, add some"
            )
        names.append(name)
        return coupling

    return top.read_items("couplings", read_coupling)


def _read_powers(section: YamlSection, joint: str) -> tuple[float, ...]:
    if len(powers := section.numbers(joint)) != 3:
        raise section.error_at(
            joint, f"'{joint}' has {len(powers)} coefficients, give 3: [a, b, c]"
        )
    return powers


def read_drives(top: YamlSection, tree: TreeBuilder) -> tuple[Drive, ...]:
    """What motors act along, where that is not the active joints one by one."""

    def read_drive(section: YamlSection, name: str) -> Drive:
        title = f"drive '{name}'"
        factors = section.value_map(name, YamlSection.number, tree.check_joint, title)
        if not factors:
            raise section.error_at(name, f"{title} moves no joint, name some")
        return Drive(name, factors)

    return tuple(top.value_map("drives", read_drive).values())


def read_home(top: YamlSection, tree: TreeBuilder) -> tuple[dict[str, float], dict[str, str]]:
    """Coordinates of the home configuration, and the file and line of each as "home JOINT"."""
    home = top.value_map("home", YamlSection.number, tree.check_joint)
    locations = top.item_locations("home") if home else {}
    return home, {f"home {joint}": locations[joint] for joint in home}


def warn_about_open_loops(spec: MachineSpec) -> None:
    """Warn of pairs of frames that are named like the two ends of a loop that nothing closes.

    onshape-to-robot, from whose files placo's examples are, cuts a loop into the frames
    closing_NAME_1 and closing_NAME_2; example-parallel-robots into closedloopNAME_A and
    closedloopNAME_B, of links or joints. Without the file that says so, such a machine is an open
    tree: it loads and moves, and is another machine.
    """
    parent_joints = spec.tree.parent_joints

    def bodies(*links: str) -> set[str]:
        return {body_of(parent_joints, link) for link in links}

    closed_pairs = [bodies(loop.predecessor, loop.successor) for loop in spec.loops]
    pairs = [
        ends
        for _, *ends in loop_end_pairs(spec.tree)
        if len(bodies(*ends)) == 2 and bodies(*ends) not in closed_pairs
    ]
    if not pairs:
        return
    pair_texts = [
        f"{one} and {two}{_gap_text(parent_joints, one, two)}" for one, two in pairs[:_MAX_SHOWN]
    ]
    remainder_text = [f"{len(pairs) - _MAX_SHOWN} more"] if len(pairs) > _MAX_SHOWN else []
    location = spec.tree.links[pairs[0][0]].source_location
    warn(
        f"{location}: no joint closes what looks like {len(pairs)} loop{'s' * (len(pairs) > 1)}, "
        f"{', '.join(pair_texts + remainder_text)}: close them by crane add loops, paste what "
        "crane check proposes into a machine file, or rename the frames"
    )


def links_by_name(tree: Tree) -> dict[str, str]:
    """Return links by their names, and child links by the names of joints."""
    children = {name: x.child for name, x in tree.joints.items() if name not in tree.links}
    return {name: name for name in tree.links} | children


def loop_end_pairs(tree: Tree) -> list[tuple[str, str, str]]:
    """A name for each loop, and its two links, which have the names themselves or their joints."""
    ends: dict[str, dict[str, str]] = {}
    for name, link in links_by_name(tree).items():
        if match := _LOOP_END_PATTERN.fullmatch(name):
            ends.setdefault(match[1], {})[match[2].upper()] = link
    return [
        (
            name.removeprefix("closing_"),
            links_of_end[min(links_of_end)],
            links_of_end[max(links_of_end)],
        )
        for name, links_of_end in ends.items()
        if set(links_of_end) in _END_LABELS
    ]


def _gap_text(parent_joints: Mapping[str, Joint], first: str, second: str) -> str:
    """How far two frames are apart with all joints at zero, in words."""
    placements = []
    for link in (first, second):
        placement = pin.SE3.Identity()
        for joint in path_to_root(parent_joints, link):
            placement = se3_from_xyz_rpy(joint.xyz, joint.rpy) * placement
        placements.append(placement)
    relative_placement = placements[0].actInv(placements[1])
    if not np.isfinite(relative_placement.homogeneous).all():  # an origin is refused
        return ""
    distance = float(np.linalg.norm(relative_placement.translation))
    angle = math.degrees(float(np.linalg.norm(pin.log3(relative_placement.rotation))))
    return f" ({1e3 * distance:.3g} mm and {angle:.3g} deg apart at zero)"
