"""The convention of Gepetto's example-parallel-robots: robot.urdf with robot.yaml beside it."""

import dataclasses
import re
from pathlib import Path

from crane.common.errors import DescriptionError, known
from crane.common.inputs import content
from crane.description.spec import Chain, Drive, LoopSpec, MachineSpec, places
from crane.description.tree import Joint, Link, Tree
from crane.formats.machine_file.posture import read_home
from crane.formats.machine_file.section import LARGEST, Section
from crane.formats.machine_file.tree_builder import TreeBuilder
from crane.formats.series import series
from crane.formats.urdf.graph import MOVING
from crane.formats.urdf.read import Urdf, read_urdf
from crane.formats.xml import XmlFile

URDF, YAML = "robot.urdf", "robot.yaml"

_KEYS = ("closed_loop", "type", "name_mot", "joint_name", "joint_type", "home")
_OWN = re.compile(r"^(closed_loop|name_mot)\s*:", re.MULTILINE)
_MACHINE = re.compile(r"^(chains|name)\s*:", re.MULTILINE)
_LOOPS = {"3d": "spherical", "6d": "fixed"}
_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
_TYPES = ("SPHERICAL", "FIXED", "UJOINT_XY", "UJOINT_YZ", "UJOINT_ZX", "CARDAN")
_UNIVERSAL = re.compile(r"UJOINT_([XYZ])([XYZ])")


def is_parallel_robot(file: Path) -> bool:
    """Whether a YAML file is of this convention and no machine file."""
    try:
        text = content(file, LARGEST).decode("utf-8")
    except (OSError, UnicodeDecodeError):
        return False  # which the reader of machine files says better
    return _OWN.search(text) is not None and _MACHINE.search(text) is None


def read_parallel_robot(path: Path) -> MachineSpec:
    """Read a machine from its yaml; the URDF of the same stem, or robot.urdf, stands beside it.

    Raises:
        DescriptionError: With file, line, what is wrong, and the names that exist.
    """
    top = Section.read(path, _KEYS)
    file = next((f for f in (path.with_suffix(".urdf"), path.parent / URDF) if f.is_file()), None)
    if file is None:
        raise DescriptionError(f"{path}: there is no {URDF} beside it, add it")
    replaced = _replaced(top)
    urdf = read_urdf(file, lambda xml: _replace(xml, replaced, top))
    for joint, (kind, _) in replaced.items():
        if kind not in ("SPHERICAL", "FIXED"):
            pair = _UNIVERSAL.fullmatch(kind)
            urdf = _split(urdf, joint, (pair[1], pair[2]) if pair else ("X", "Y"))
    if urdf.loops:
        raise DescriptionError(
            f"{urdf.loops[0].where}: the loops stand in {path.name}, keep <loop> or closed_loop"
        )
    name = urdf.name
    chain = Chain(name, file, None, path.name, urdf.moving)
    tree = TreeBuilder()
    tree.add(chain, urdf)
    if not tree.joints:
        raise DescriptionError(f"{file.name}: no joint moves in this file, add one")
    loops = _loops(top, urdf, tree)
    motors = top.names("name_mot") if "name_mot" in top else ()
    for joint in motors:
        if joint not in tree.joints and joint in replaced:
            raise top.fail(
                "name_mot",
                f"the motor '{joint}' is {replaced[joint][0]}, drive a joint with one freedom",
            )
        tree.check_joint(joint, top.where("name_mot"))
    home, home_lines = read_home(top, tree)
    where = {"active": top.where("name_mot")} | places(loops, urdf.couplings)
    where |= {f"home {joint}": place for joint, place in home_lines.items()}
    if "home" in top:
        where["home"] = top.where("home")
    return MachineSpec(
        name=name,
        source=path.name,
        path=path,
        chains=(chain,),
        tree=tree.tree,
        loops=loops,
        active=motors,
        home=home,
        drives=tuple(Drive(joint, {joint: 1.0}) for joint in motors),
        friction=urdf.friction,
        tip=tree.only_leaf(),
        couplings=urdf.couplings,
        where=where,
    )


def _replaced(top: Section) -> dict[str, tuple[str, str]]:
    """Types that joints of the URDF are replaced by, and where that was written."""
    if "joint_name" not in top:
        return {}
    names = top.names("joint_name")
    types = top.texts("joint_type")
    if len(names) != len(types):
        raise top.fail(
            "joint_type", f"{len(types)} joint types for {len(names)} joints, give one of each"
        )
    for kind in types:
        pair = _UNIVERSAL.fullmatch(kind)
        if kind not in _TYPES and (pair is None or pair[1] == pair[2]):
            raise top.fail("joint_type", f"joint type '{kind}' is unknown, {known(_TYPES, kind)}")
    where = top.where("joint_type")
    return {name: (kind, where) for name, kind in zip(names, types, strict=True)}


def _replace(xml: XmlFile, replaced: dict[str, tuple[str, str]], top: Section) -> None:
    """Write the other types into a URDF."""
    joints = {joint.get("name", "").strip(): joint for joint in xml.root.iterfind("joint")}
    for name, (kind, _) in replaced.items():
        if name not in joints:
            raise top.fail("joint_name", f"joint '{name}' is unknown, {known(joints, name)}")
        joint = joints[name]
        if joint.get("type") not in MOVING:
            raise top.fail("joint_name", f"joint '{name}' is {joint.get('type')}, leave it out")
        of_before = [x for x in joint if x.tag in ("limit", "dynamics", "mimic")]
        for element in of_before:
            joint.remove(element)
        joint.set("type", kind.lower() if kind in ("SPHERICAL", "FIXED") else "continuous")
        joint.attrib.pop("independent", None)


def _split(urdf: Urdf, name: str, axes: tuple[str, str]) -> Urdf:
    """A universal joint as two about axes of the joint's frame, the first at the parent."""
    parts: list[Link | Joint] = []
    for part in urdf.tree:
        if isinstance(part, Joint) and part.name == name:
            parts += _universal(part, axes, urdf.tree)
        else:
            parts.append(part)
    return dataclasses.replace(urdf, tree=Tree({}, {}).replacing(*parts))


def _universal(joint: Joint, axes: tuple[str, str], tree: Tree) -> list[Link | Joint]:
    """What a joint becomes as a universal one, under names that the tree does not have."""
    freedoms = [(axis, "revolute", _AXES[axis]) for axis in axes]
    place, ends = (joint.xyz, joint.rpy), (joint.parent, joint.child)
    parts = series(joint.name, freedoms, place, ends, joint.where)
    for made in parts:
        if made.name in (tree.links if isinstance(made, Link) else tree.joints):
            raise DescriptionError(
                f"{joint.where}: joint '{joint.name}' makes '{made.name}', which is there "
                "already, rename one"
            )
    return parts


def _loops(top: Section, urdf: Urdf, tree: TreeBuilder) -> tuple[LoopSpec, ...]:
    """Loops between the frames of `closed_loop`: points that coincide, or frames."""
    pairs = top.pairs("closed_loop") if "closed_loop" in top else []
    kinds = top.texts("type") if "type" in top else ("6d",) * len(pairs)
    if len(kinds) != len(pairs):
        raise top.fail("type", f"{len(kinds)} types for {len(pairs)} closed loops, give each one")
    below = {joint.name: joint.child for joint in urdf.tree.joints.values()}
    loops: dict[str, LoopSpec] = {}
    for pair, kind in zip(pairs, kinds, strict=True):
        if kind.lower() not in _LOOPS:
            raise top.fail("type", f"a closed loop has the type '{kind}', write 3d or 6d")
        links = [name if name in tree.links else below.get(name, "") for name in pair]
        lost = [name for name, link in zip(pair, links, strict=True) if not link]
        if lost:
            problem = f"the frame '{lost[0]}' is unknown, {known(tree.links, lost[0])}"
            raise top.fail("closed_loop", problem)
        name = f"{pair[0]}_{pair[1]}"
        if name in loops:
            raise top.fail(
                "closed_loop", f"{pair[0]} and {pair[1]} are closed twice, once will do"
            )
        where = top.where("closed_loop")
        loop = LoopSpec(name, _LOOPS[kind.lower()], links[0], links[1], (0.0, 0.0, 1.0), where)
        tree.check_loop(loop)
        loops[name] = loop
    return tuple(loops.values())
