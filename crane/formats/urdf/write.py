"""One URDF with the elements of URDF+."""

from pathlib import Path

from lxml import etree

from crane.common.errors import InputError
from crane.common.output import replacing
from crane.description import Coupling, LoopSpec
from crane.description.tree import Tree
from crane.formats.parts import (
    add_friction,
    add_joint,
    add_link,
    add_origin,
    draw,
    drives_of,
    finished,
    left_out,
    linear,
    only_in_machine_files,
    origin_of,
    plain_friction,
    rotors_of,
    text,
    with_whole_flyers,
)
from crane.machine import Machine


def write_urdf_plus(machine: Machine, path: str | Path) -> None:
    """Write a machine as one URDF with `<loop>` and `<coupling>` elements.

    The home posture, which names the assembly branch, becomes a `<group_state name="home">`, as
    SRDF has it; other readers of URDF ignore it. Of friction there are Coulomb and viscous
    friction. A warning names what else is left out.

    Args:
        machine: The machine, as it is: with its changes, locks and payload.
        path: The file, .urdf.

    Raises:
        InputError: A coupling binds several joints in a way that no `<coupling>` says.
        OutputError: It cannot be written.
    """
    tree = with_whole_flyers(machine)
    robot = etree.Element("robot", name=machine.name)
    made = {  # which reading a loop makes again
        f"{loop.name}_{end}": frame
        for loop in machine.closure.equations.loops
        for end, frame in (("predecessor", loop.predecessor), ("successor", loop.successor))
        if frame == f"{loop.name}_{end}"
    }
    for link in tree.links.values():
        if link.name not in made:
            add_link(robot, link)
    for joint in tree.joints.values():
        if not joint.moves and joint.child not in made:
            add_joint(robot, joint)
    passive = [joint for joint in machine.joints if joint not in machine.active]
    for name in (*machine.active, *passive):
        if name in tree.joints:
            _add_moving(machine, robot, name)
    for joint in tree.joints.values():
        if joint.kind == "floating":
            add_joint(robot, joint).set("independent", "true")
    for loop in machine.closure.equations.loops:
        _add_loop(tree, robot, loop)
    for coupling in machine.closure.equations.couplings:
        _add_coupling(machine, robot, coupling)
    state = etree.SubElement(robot, "group_state", name="home", group="all")
    for name, value in zip(machine.joints, machine.home, strict=True):
        etree.SubElement(state, "joint", name=name, value=text([value]))
    if machine.tip is not None:
        tip = {"name": "tip", "parent_link": machine.tip, "group": "all"}
        etree.SubElement(robot, "end_effector", tip)
    draw(robot, machine)
    lost = plain_friction(machine) + only_in_machine_files(machine)
    lost += ["springs and forces"] if machine.forces else []
    lost += ["ropes"] if machine.ropes else []
    lost += ["rotor inertias"] if rotors_of(machine) else []
    lost += ["drives along several joints"] if drives_of(machine) else []
    with replacing(path) as part:
        part.write_bytes(finished(robot, origin_of(machine)))
    left_out(machine, "URDF+", lost)


def _add_moving(machine: Machine, robot: etree._Element, name: str) -> None:
    element = add_joint(robot, machine.tree.joints[name])
    element.set("independent", str(name in machine.active).lower())
    add_friction(element, machine, name)


def _add_loop(tree: Tree, robot: etree._Element, loop: LoopSpec) -> None:
    element = etree.SubElement(robot, "loop", name=loop.name, type=loop.type)
    above = {joint.child: joint for joint in tree.joints.values()}
    for end, name in (("predecessor", loop.predecessor), ("successor", loop.successor)):
        if name != f"{loop.name}_{end}":
            etree.SubElement(element, end, link=name)
            continue
        add_origin(etree.SubElement(element, end, link=above[name].parent), above[name])
    etree.SubElement(element, "axis", xyz=text(loop.axis))


def _add_coupling(machine: Machine, robot: etree._Element, coupling: Coupling) -> None:
    """A <coupling> where one says the same, else a <mimic>."""
    joints, slopes, offset = linear(coupling)
    mimics = len(joints) <= 2 and coupling.name == f"{joints[0]}_mimic"
    ends = None if mimics or offset else _rolling(machine, joints, slopes)
    if ends is not None:
        element = etree.SubElement(robot, "coupling", name=coupling.name, type="rolling")
        etree.SubElement(element, "predecessor", link=ends[0])
        etree.SubElement(element, "successor", link=ends[1])
        etree.SubElement(element, "ratio", value=text([ends[2]]))
        return
    if len(joints) > 2:
        raise InputError(
            f"coupling '{coupling.name}' of {len(joints)} joints has no place in URDF+, write a "
            "machine file"
        )
    others = [name for name in machine.joints if name != joints[0]]
    other = joints[1] if slopes else others[0]  # that of a joint which is held counts for nothing
    (follower,) = (j for j in robot.iterfind("joint") if j.get("name") == joints[0])
    multiplier = text([slopes[0] if slopes else 0.0])
    mimic = {"joint": other, "multiplier": multiplier, "offset": text([offset])}
    if follower.get("independent") == "true":
        raise InputError(
            f"'{joints[0]}' is active and follows '{other}' by the coupling '{coupling.name}', "
            "write a machine file"
        )
    etree.SubElement(follower, "mimic", mimic)


def _rolling(
    machine: Machine, joints: list[str], slopes: list[float]
) -> tuple[str, str, float] | None:
    """Predecessor, successor and ratio with ratio sum_P q = sum_S q, if there are such links.

    Joints of one way have one factor: those of the successor's that of the first joint.
    """
    model = machine.model
    after = [joints[0]] + [x for x, slope in zip(joints[1:], slopes, strict=True) if slope == -1]
    before = [x for x in joints if x not in after]
    ratios = {slope for x, slope in zip(joints[1:], slopes, strict=True) if x in before}
    if len(ratios) > 1:
        return None
    ways = [sorted(model.getJointId(x) for x in way) for way in (before, after)]
    for way in ways:  # depth-first numbers rise from parent to child
        if any(model.parents[b] != a for a, b in zip(way, way[1:], strict=False)):
            return None
    tops = [model.parents[way[0]] for way in ways if way]
    if len(set(tops)) > 1:
        return None
    links = [_moved(machine, way[-1] if way else tops[0]) for way in ways]
    return links[0], links[1], ratios.pop() if ratios else 1.0


def _moved(machine: Machine, joint: int) -> str:
    """The link that a joint of the model moves, the root link for the world."""
    return machine.tree.joints[machine.model.names[joint]].child if joint else machine.tree.root
