"""The sections of a machine file on its structure: chains, loops, couplings, drives."""

from collections.abc import Container
from pathlib import Path

from crane.common.errors import DescriptionError, suggest_names
from crane.description.findings import FollowUpError, error_recovery, report_error
from crane.description.floating_bases import check_freedoms
from crane.description.force_elements import ForceElement, Friction
from crane.description.specification import (
    AXISLESS_TYPES,
    LOOP_TYPES,
    Chain,
    Coupling,
    Drive,
    LoopSpec,
    unit_vector,
)
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.urdf.urdf_reader import UrdfModel, read_urdf


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
        problem = f"chain '{name}' has no 'parent', name the frame it hangs from"
        report_error(item.error_at(None, problem))
    elif not earlier_chains and are_all_read and parent is not None:
        problem = f"chain '{name}' is first and stands on the world, remove its 'parent'"
        report_error(item.error_at("parent", problem))
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
            problem = (
                f"{label} has the unknown {end} '{frame}', {suggest_names(tree.links, frame)}"
            )
            report_error(section.error_at(end, problem))
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
    factors = item.value_map("joints", YamlSection.number, tree.check_joint)
    return Coupling(name, factors, item.number("offset"), item.source_location())


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
