"""The convention of Gepetto's example-parallel-robots: robot.urdf with robot.yaml beside it."""

import re
from pathlib import Path

from lxml import etree

from crane.description.section import Section
from crane.description.spec import Chain, LoopSpec, MachineSpec
from crane.description.tree_builder import TreeBuilder
from crane.description.urdf import Urdf, read_urdf
from crane.description.urdf_graph import MOVING
from crane.description.xml import XmlFile
from crane.errors import DescriptionError, known

URDF, YAML = "robot.urdf", "robot.yaml"

_KEYS = ("closed_loop", "type", "name_mot", "joint_name", "joint_type")
_OWN = re.compile(r"^(closed_loop|name_mot)\s*:", re.MULTILINE)
_MACHINE = re.compile(r"^(chains|name)\s*:", re.MULTILINE)
_LOOPS = {"3d": "spherical", "6d": "fixed"}
_AXES = {"X": "1 0 0", "Y": "0 1 0", "Z": "0 0 1"}
_TYPES = ("SPHERICAL", "FIXED", "UJOINT_XY", "UJOINT_YZ", "UJOINT_ZX", "CARDAN")
_UNIVERSAL = re.compile(r"UJOINT_([XYZ])([XYZ])")


def is_parallel_robot(file: Path) -> bool:
    """Whether a YAML file is of this convention and no machine file."""
    try:
        text = file.read_text(encoding="utf-8")
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
    where = {"active": top.where("name_mot")}
    where |= {f"loop {loop.name}": loop.where for loop in loops}
    where |= {f"loop {coupling.name}": coupling.where for coupling in urdf.couplings}
    return MachineSpec(
        name=name,
        source=path.name,
        path=path,
        chains=(chain,),
        tree=tree.tree,
        loops=loops,
        active=motors,
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
        for tag in ("limit", "dynamics", "mimic"):  # of the joint that it was
            for element in joint.findall(tag):
                joint.remove(element)
        if kind in ("SPHERICAL", "FIXED"):
            joint.set("type", kind.lower())
            joint.attrib.pop("independent", None)
            continue
        pair = _UNIVERSAL.fullmatch(kind)
        _write_universal(xml, joint, name, (pair[1], pair[2]) if pair else ("X", "Y"))


def _write_universal(
    xml: XmlFile, joint: etree._Element, name: str, axes: tuple[str, str]
) -> None:
    """A universal joint as two about axes of the joint's frame, the first at the parent."""
    place, child = joint.find("origin"), joint.find("child")
    if child is None:
        raise xml.fail(joint, f"joint '{name}' has no child link, add <child link=\"...\"/>")
    middle = f"{name}_1"
    first, link, second = (etree.Element(tag) for tag in ("joint", "link", "joint"))
    link.set("name", middle)
    link.set("between", name)
    for element, axis in ((first, axes[0]), (second, axes[1])):
        element.set("name", f"{name}_{axis}")
        element.set("type", "continuous")
        etree.SubElement(element, "axis", xyz=_AXES[axis])
    if place is not None:
        first.append(place)
    for parent in joint.findall("parent"):
        first.append(parent)
    etree.SubElement(first, "child", link=middle)
    etree.SubElement(second, "parent", link=middle)
    for element in joint.findall("child"):
        second.append(element)
    at, around = joint.sourceline, joint.getparent()
    index = around.index(joint)
    around[index : index + 1] = [first, link, second]
    for top in (first, link, second):
        for element in top.iter():
            element.sourceline = at


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
        for name, link in zip(pair, links, strict=True):
            if not link:
                raise top.fail(
                    "closed_loop", f"the frame '{name}' is unknown, {known(tree.links, name)}"
                )
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
