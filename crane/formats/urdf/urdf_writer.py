"""Write a machine as one URDF: with the loop elements of URDF+, or as a plain tree."""

import dataclasses
from pathlib import Path

from lxml import etree

from crane.common.atomic_output import replace_file
from crane.common.errors import InputError
from crane.description.kinematic_tree import Tree
from crane.description.specification import Coupling, LoopSpec
from crane.formats.conversion_notes import warn_about_unsupported
from crane.formats.urdf_elements import (
    add_friction,
    add_joint,
    add_link,
    add_origin,
    format_numbers,
)
from crane.formats.urdf_output import (
    compound_drive_factors,
    copy_shapes,
    format_document,
    origin_text,
    rotor_inertias,
    solve_coupling,
    with_floating_joints,
)
from crane.machine.machine import Machine


def write_urdf_plus(machine: Machine, path: str | Path) -> None:
    """Write a machine as one URDF with `<loop>` and `<coupling>` elements.

    The home configuration, which selects the assembly mode, becomes a `<group_state name="home">`
    as in SRDF; other readers of URDF ignore it. Of friction, Coulomb and viscous friction are
    written. A warning lists what is left out.

    Args:
        machine: The machine with its parameter changes, locked joints and payload.
        path: The file, .urdf.

    Raises:
        InputError: No `<coupling>` represents a coupling of several joints.
        OutputError: The file cannot be written.
    """
    tree = with_floating_joints(machine)
    robot = etree.Element("robot", name=machine.name)
    loop_frames = {  # the reader adds them with the loops
        frame
        for loop in machine.closure.equations.loops
        for end, frame in (("predecessor", loop.predecessor), ("successor", loop.successor))
        if frame == f"{loop.name}_{end}"
    }
    for link in tree.links.values():
        if link.name not in loop_frames:
            add_link(robot, link)
    for joint in tree.joints.values():
        if not joint.is_movable and joint.child not in loop_frames:
            add_joint(robot, joint)
    passive = [joint for joint in machine.joints if joint not in machine.active]
    for name in (*machine.active, *passive):
        if name in tree.joints:
            element = add_joint(robot, tree.joints[name])
            element.set("independent", str(name in machine.active).lower())
            _add_joint_friction(element, machine, name)
    for joint in tree.joints.values():
        if joint.kind == "floating":
            add_joint(robot, joint).set("independent", "true")
    for loop in machine.closure.equations.loops:
        _add_loop(tree, robot, loop)
    for coupling in machine.closure.equations.couplings:
        _add_coupling(machine, robot, coupling)
    state = etree.SubElement(robot, "group_state", name="home", group="all")
    for name, value in zip(machine.joints, machine.home, strict=True):
        etree.SubElement(state, "joint", name=name, value=format_numbers([value]))
    if machine.tip is not None:
        tip = {"name": "tip", "parent_link": machine.tip, "group": "all"}
        etree.SubElement(robot, "end_effector", tip)
    copy_shapes(robot, machine)
    with replace_file(path) as temporary_file:
        temporary_file.write_bytes(format_document(robot, origin_text(machine)))
    sections = {
        "springs and forces": machine.forces,
        "ropes": machine.ropes,
        "rotor inertias": rotor_inertias(machine),
        "drives along several joints": compound_drive_factors(machine),
    }
    unsupported = [name for name, section in sections.items() if section]
    warn_about_unsupported(machine, "URDF+", unsupported)


def _add_joint_friction(element: etree._Element, machine: Machine, joint: str) -> None:
    if (friction := machine.friction.get(joint)) is not None:
        add_friction(element, friction.viscous, friction.coulomb)


def _add_loop(tree: Tree, robot: etree._Element, loop: LoopSpec) -> None:
    element = etree.SubElement(robot, "loop", name=loop.name, type=loop.type)
    parent_joints = {joint.child: joint for joint in tree.joints.values()}
    for end, name in (("predecessor", loop.predecessor), ("successor", loop.successor)):
        if name != f"{loop.name}_{end}":
            etree.SubElement(element, end, link=name)
            continue
        joint = parent_joints[name]
        add_origin(etree.SubElement(element, end, link=joint.parent), joint.xyz, joint.rpy)
    etree.SubElement(element, "axis", xyz=format_numbers(loop.axis))


def _add_coupling(machine: Machine, robot: etree._Element, coupling: Coupling) -> None:
    """Add a `<coupling>` if one represents the coupling, else a `<mimic>`."""
    joints, derivatives, offset = solve_coupling(coupling)
    is_mimic = len(joints) <= 2 and coupling.name == f"{joints[0]}_mimic"
    ends = None if is_mimic or offset else _coupling_ends(machine, joints, derivatives)
    if ends is not None:
        element = etree.SubElement(robot, "coupling", name=coupling.name, type="rolling")
        etree.SubElement(element, "predecessor", link=ends[0])
        etree.SubElement(element, "successor", link=ends[1])
        etree.SubElement(element, "ratio", value=format_numbers([ends[2]]))
        return
    if len(joints) > 2:
        raise InputError(
            f"coupling '{coupling.name}' of {len(joints)} joints has no place in URDF+, write a "
            "machine file"
        )
    others = [name for name in machine.joints if name != joints[0]]
    # the joint that a held joint mimics has no effect
    other = joints[1] if derivatives else others[0]
    (follower,) = (j for j in robot.iterfind("joint") if j.get("name") == joints[0])
    multiplier = format_numbers([derivatives[0] if derivatives else 0.0])
    mimic = {"joint": other, "multiplier": multiplier, "offset": format_numbers([offset])}
    if follower.get("independent") == "true":
        raise InputError(
            f"'{joints[0]}' is active and follows '{other}' by the coupling '{coupling.name}', "
            "write a machine file"
        )
    etree.SubElement(follower, "mimic", mimic)


def _coupling_ends(
    machine: Machine, joints: list[str], derivatives: list[float]
) -> tuple[str, str, float] | None:
    """Return predecessor, successor and ratio with ratio sum_P q = sum_S q, if there are any.

    All joints on the path to the successor have the factor of the first joint, and all joints on
    the path to the predecessor have one other factor.
    """
    model, slopes = machine.model, dict(zip(joints, [-1.0, *derivatives], strict=True))
    ratios = {slope for slope in slopes.values() if slope != -1}
    if len(ratios) > 1:
        return None
    joint_paths = [  # indices rise from parent to child
        sorted(model.getJointId(x) for x, slope in slopes.items() if (slope == -1) == is_successor)
        for is_successor in (False, True)
    ]
    top_joints = [model.parents[path[0]] for path in joint_paths if path]
    is_chain = all(
        model.parents[b] == a for x in joint_paths for a, b in zip(x, x[1:], strict=False)
    )
    if len(set(top_joints)) > 1 or not is_chain:
        return None
    joints_of_ends = [path[-1] if path else top_joints[0] for path in joint_paths]
    links = [
        machine.tree.joints[model.names[joint]].child if joint else machine.tree.root_link
        for joint in joints_of_ends
    ]
    return links[0], links[1], ratios.pop() if ratios else 1.0


def robot_description(machine: Machine) -> str:
    """Return the whole machine as one plain URDF, a tree that every reader of URDF accepts.

    Its joints are those of `Machine.joints` with their names, zeros and signs, so joint states of
    all of them determine the pose of every link; `crane.motion.Transmission` computes them from
    the coordinates of the actuators. A floating base is a joint of type "floating", which joint
    states do not contain. Loops are cut: the two frames of a loop are links that coincide where
    the loop is closed. No joint mimics another. Meshes are named by URIs, `file://` or the
    `package://` of the machine's own files.

    Args:
        machine: The machine with its parameter changes, locked joints and payload.

    Returns:
        The text of the URDF.
    """
    robot = etree.Element("robot", name=machine.name)
    tree = with_floating_joints(machine)
    for link in tree.links.values():
        add_link(robot, dataclasses.replace(link, composite_joint=None))
    for joint in tree.joints.values():
        _add_joint_friction(add_joint(robot, joint), machine, joint.name)
    copy_shapes(robot, machine, uris=True)
    return format_document(robot, origin_text(machine)).decode()
