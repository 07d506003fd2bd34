"""Reader of Gepetto's example-parallel-robots: a robot.yaml beside a robot.urdf."""

import dataclasses
import re
from itertools import permutations
from pathlib import Path

from crane.common.errors import DescriptionError
from crane.common.package_search import read_plain_file
from crane.description.key_types import (
    Key,
    MapKey,
    NameListKey,
    NumberKey,
    SectionSchema,
)
from crane.description.kinematic_tree import Joint, Link, Tree, joint_series
from crane.description.specification import Chain, Drive, LoopSpec, MachineSpec, source_locations
from crane.formats.machine_file.structure_sections import TreeBuilder, links_by_name, read_home
from crane.formats.machine_file.yaml_section import YamlSection
from crane.formats.machine_file.yaml_text import MAX_FILE_SIZE, format_value
from crane.formats.urdf.link_joint_elements import MOVABLE_TYPES
from crane.formats.urdf.urdf_reader import read_urdf
from crane.formats.xml_file import XmlFile

URDF_FILE = "robot.urdf"

_ROBOT_FILE = SectionSchema(
    "the machine file",
    {
        "closed_loop": Key("pairs of frames that coincide"),
        "type": Key("3d or 6d, of each pair"),
        "name_mot": NameListKey("driven joints"),
        "joint_name": NameListKey("joints of another type than in the URDF"),
        "joint_type": Key("their types"),
        "home": MapKey("home configuration", NumberKey(), "joint"),
    },
)
_CONVENTION_PATTERN = re.compile(r"^(closed_loop|name_mot)\s*:", re.MULTILINE)
_MACHINE_FILE_PATTERN = re.compile(r"^(chains|name)\s*:", re.MULTILINE)
_LOOP_TYPES = {"3d": "spherical", "6d": "fixed"}
_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
_UNIVERSAL_AXES = {"CARDAN": ("X", "Y")} | {
    f"UJOINT_{first}{second}": (first, second) for first, second in permutations("XYZ", 2)
}
_JOINT_TYPES = ("SPHERICAL", "FIXED", *_UNIVERSAL_AXES)


def is_parallel_robot(file: Path) -> bool:
    """Whether a YAML file follows this convention and is not a machine file."""
    try:
        text = read_plain_file(file, MAX_FILE_SIZE).decode("utf-8")
    except (OSError, UnicodeDecodeError):
        return False  # the reader of machine files reports it
    return (
        _CONVENTION_PATTERN.search(text) is not None and _MACHINE_FILE_PATTERN.search(text) is None
    )


def read_parallel_robot(path: Path) -> MachineSpec:
    """Read a machine from its YAML file and the URDF of the same stem, or robot.urdf, beside it.

    Raises:
        DescriptionError: A file is wrong; the message has file and line.
    """
    top = YamlSection.read(path, _ROBOT_FILE)
    file = next(
        (f for f in (path.with_suffix(".urdf"), path.parent / URDF_FILE) if f.is_file()), None
    )
    if file is None:
        raise DescriptionError(f"{path}: there is no {URDF_FILE} beside it, add it")
    replaced_types = _replaced_joint_types(top)
    urdf = read_urdf(file, lambda xml: _replace_joint_types(xml, replaced_types, top))
    for joint, kind in replaced_types.items():
        if kind in _UNIVERSAL_AXES:
            urdf = _split_universal_joint(urdf, joint, _UNIVERSAL_AXES[kind])
    if urdf.loops:
        raise DescriptionError(
            f"{urdf.loops[0].source_location}: the loops stand in {path.name}, keep <loop> or "
            "closed_loop"
        )
    tree = TreeBuilder(urdf.tree, urdf.is_complete)
    if not tree.joints:
        raise DescriptionError(f"{file.name}: no joint moves in this file, add one")
    loops = _read_loops(top, tree)
    motors = top.names("name_mot")
    for joint in motors:
        if joint not in tree.joints and joint in replaced_types:
            raise top.error_at(
                "name_mot",
                f"the motor '{joint}' is {replaced_types[joint]}, drive a joint with one freedom",
            )
        tree.check_joint(joint, top.source_location("name_mot"))
    home, home_locations = read_home(top, tree)
    locations = source_locations(loops, urdf.couplings) | home_locations
    locations["active"] = top.source_location("name_mot")
    if "home" in top:
        locations["home"] = top.source_location("home")
    return dataclasses.replace(
        urdf,
        source=path.name,
        path=path,
        chains=(Chain(urdf.name, file, None, path.name, tuple(tree.joints)),),
        loops=loops,
        active=motors,
        home=home,
        drives=tuple(Drive(joint, {joint: 1.0}) for joint in motors),
        tip=tree.single_leaf_link(),
        source_locations=locations,
    )


def _replaced_joint_types(top: YamlSection) -> dict[str, str]:
    names = top.names("joint_name")
    if not names:
        return {}
    types = _read_texts(top, "joint_type")
    if len(names) != len(types):
        raise top.error_at(
            "joint_type", f"{len(types)} joint types for {len(names)} joints, give one of each"
        )
    for kind in types:
        top.check_name("joint_type", kind, _JOINT_TYPES, f"joint type '{kind}' is unknown")
    return dict(zip(names, types, strict=True))


def _replace_joint_types(xml: XmlFile, replaced_types: dict[str, str], top: YamlSection) -> None:
    joints = {joint.get("name", "").strip(): joint for joint in xml.root.iterfind("joint")}
    for name, kind in replaced_types.items():
        top.check_name("joint_name", name, joints, f"joint '{name}' is unknown")
        joint = joints[name]
        if joint.get("type") not in MOVABLE_TYPES:
            raise top.error_at(
                "joint_name", f"joint '{name}' is {joint.get('type')}, leave it out"
            )
        old_elements = [x for x in joint if x.tag in ("limit", "dynamics", "mimic")]
        for element in old_elements:
            joint.remove(element)
        joint.set("type", kind.lower() if kind in ("SPHERICAL", "FIXED") else "continuous")
        joint.attrib.pop("independent", None)


def _split_universal_joint(urdf: MachineSpec, name: str, axes: tuple[str, str]) -> MachineSpec:
    """Return the URDF with a universal joint as two joints, the first at the parent."""
    parts: list[Link | Joint] = []
    for part in urdf.tree:
        if not isinstance(part, Joint) or part.name != name:
            parts.append(part)
            continue
        freedoms = [(axis, "revolute", _AXES[axis]) for axis in axes]
        placement, end_links = (part.xyz, part.rpy), (part.parent, part.child)
        series = joint_series(name, freedoms, placement, end_links, part.source_location)
        used_names = {(type(x), x.name) for x in urdf.tree}
        if taken := [x.name for x in series if (type(x), x.name) in used_names]:
            raise DescriptionError(
                f"{part.source_location}: joint '{name}' makes '{taken[0]}', which is there "
                "already, rename one"
            )
        parts += series
    return dataclasses.replace(urdf, tree=Tree({}, {}).with_parts(*parts))


def _read_loops(top: YamlSection, tree: TreeBuilder) -> tuple[LoopSpec, ...]:
    """Return the loops between the frames of `closed_loop`: spherical or fixed."""
    pairs: list[list[str]] = []
    if "closed_loop" in top:
        pairs = top.read_list(
            "closed_loop",
            "give a list of pairs [[a, b]]",
            lambda item: isinstance(item, list) and len(item) == 2,
            "write pairs as [a, b]",
        )
    for invalid in [x for pair in pairs for x in pair if not _is_text(x)]:
        raise top.error_at(
            "closed_loop",
            f"'closed_loop' lists {format_value(invalid)}, which is not a name, quote it",
        )
    kinds = _read_texts(top, "type") if "type" in top else ["6d"] * len(pairs)
    if len(kinds) != len(pairs):
        raise top.error_at(
            "type", f"{len(kinds)} types for {len(pairs)} closed loops, give each one"
        )
    link_of_name = links_by_name(tree.tree)
    loops: dict[str, LoopSpec] = {}
    for pair, kind in zip(pairs, kinds, strict=True):
        if kind.lower() not in _LOOP_TYPES:
            raise top.error_at("type", f"a closed loop has the type '{kind}', write 3d or 6d")
        for frame in pair:
            problem = f"the frame '{frame}' is unknown"
            top.check_name("closed_loop", frame, link_of_name, problem)
        name = f"{pair[0]}_{pair[1]}"
        if name in loops:
            raise top.error_at(
                "closed_loop", f"{pair[0]} and {pair[1]} are closed twice, once will do"
            )
        loop = LoopSpec(
            name,
            _LOOP_TYPES[kind.lower()],
            link_of_name[pair[0]],
            link_of_name[pair[1]],
            (0.0, 0.0, 1.0),
            top.source_location("closed_loop"),
        )
        tree.check_loop(loop)
        loops[name] = loop
    return tuple(loops.values())


def _read_texts(top: YamlSection, key: str) -> list[str]:
    return top.read_list(key, "give a list such as [a, b]", _is_text, "which is no text, quote it")


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.isprintable()
