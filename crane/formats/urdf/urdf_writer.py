"""Write a machine as one URDF: with the loop elements of URDF+, or as a plain tree.

Here are also the parts that writers of several formats share: shapes, couplings, drives, the
document, and the warning about what is left out.
"""

import copy
import dataclasses
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from lxml import etree

from crane.common.atomic_output import replace_file
from crane.common.errors import InputError, format_one_line, warn
from crane.description.kinematic_tree import Tree
from crane.description.specification import STANDARD_GRAVITY, Coupling, LoopSpec
from crane.formats.robot_files import open_robots
from crane.formats.visuals.urdf_shapes import find_mesh_file
from crane.formats.xml_file import (
    add_friction,
    add_joint,
    add_link,
    add_origin,
    format_numbers,
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
    if machine.gravity != STANDARD_GRAVITY:
        robot.set("gravity", format_numbers(machine.gravity))
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
        etree.SubElement(
            robot, "end_effector", {"name": "tip", "parent_link": machine.tip, "group": "all"}
        )
    copy_shapes(robot, machine)
    with replace_file(path) as temporary_file:
        temporary_file.write_bytes(format_document(robot, origin_text(machine)))
    sections = {
        "springs and forces": machine.forces,
        "ropes": machine.ropes,
        "rotor inertias": rotor_inertias(machine),
        "drives along several joints": compound_drive_factors(machine),
    }
    warn_about_unsupported(
        machine, "URDF+", [name for name, section in sections.items() if section]
    )


def _add_joint_friction(element: etree._Element, machine: Machine, joint: str) -> None:
    if (friction := machine.friction.get(joint)) is not None:
        add_friction(element, friction.viscous, friction.sliding_force)


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
    if coupling.powers:
        raise InputError(
            f"coupling '{coupling.name}' has powers, for which URDF+ has no place, write a "
            "machine file"
        )
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
    # the joint that a held joint mimics has no effect
    other = [*joints[1:], *(name for name in machine.joints if name != joints[0])][0]
    (follower,) = (j for j in robot.iterfind("joint") if j.get("name") == joints[0])
    mimic = {
        "joint": other,
        "multiplier": format_numbers([derivatives[0] if derivatives else 0.0]),
        "offset": format_numbers([offset]),
    }
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


def with_floating_joints(machine: Machine) -> Tree:
    """Return the tree with a floating joint in place of the six joints of each floating base."""
    links, joints = dict(machine.tree.links), dict(machine.tree.joints)
    for column in machine.coordinates.floating_base_columns:
        series = [joints.pop(name) for name in machine.joints[column : column + 6]]
        for joint in series[:-1]:
            del links[joint.child]
        name = series[0].floating_joint
        joints[name] = dataclasses.replace(
            series[0], name=name, kind="floating", child=series[-1].child
        )
    return Tree(links, joints)


def copy_shapes(
    robot: etree._Element,
    machine: Machine,
    chains: Iterable[str] | None = None,
    uris: bool = False,
) -> None:
    """Copy visuals, collisions and materials of a machine's URDFs to the links of the same names.

    Args:
        robot: The `<robot>` that receives them.
        machine: The machine.
        chains: Names of the chains to copy from, all if not given.
        uris: Whether to name meshes by URIs, as ROS requires, instead of paths.
    """
    targets = {link.get("name"): link for link in robot.iterfind("link")}
    materials: dict[str, etree._Element] = {}
    with open_robots(machine, chains) as sources:
        shapes = [
            (targets[link.get("name", "").strip()], xml.file.parent, shape)
            for xml in sources
            for link in xml.root.iterfind("link")
            if link.get("name", "").strip() in targets
            for shape in (*link.iterfind("visual"), *link.iterfind("collision"))
        ]
        for material in (x for xml in sources for x in xml.root.iterfind("material")):
            materials.setdefault(material.get("name", ""), copy.deepcopy(material))
        for target, folder, shape in shapes:
            target.append(_with_mesh_paths(shape, folder, uris))
    for material in reversed(materials.values()):
        robot.insert(0, material)


def _with_mesh_paths(shape: etree._Element, folder: Path, uris: bool) -> etree._Element:
    """Return a copy of a shape that names its mesh by an absolute path or URI if the file exists.

    As a URI, a mesh of a package keeps its `package://` name, which other computers can resolve.
    """
    shape = copy.deepcopy(shape)
    for mesh in shape.iter("mesh"):
        name = mesh.get("filename", "")
        if uris and name.startswith("package://"):
            continue
        if (file := find_mesh_file(name, folder)) is not None:
            mesh_path = file.resolve()
            mesh.set("filename", mesh_path.as_uri() if uris else str(mesh_path))
    return shape


def solve_coupling(coupling: Coupling) -> tuple[list[str], list[float], float]:
    """Solve a coupling for its first joint: q_0 = sum slope_i q_i + offset.

    Returns:
        Names of all joints, slopes of the joints after the first, offset.
    """
    joints, factors = list(coupling.factors), list(coupling.factors.values())
    slopes = [-factor / factors[0] + 0.0 for factor in factors[1:]]
    return joints, slopes, coupling.offset / factors[0] + 0.0


def format_document(
    robot: etree._Element, comment: str, element_notes: Sequence[tuple[etree._Element, str]] = ()
) -> bytes:
    """Return an indented XML document with a comment in its first line and beside elements."""
    etree.indent(robot)
    for element, note in element_notes:
        comment_element = etree.Comment(f" {_comment_text(note)} ")
        parent = element.getparent()
        parent.insert(parent.index(element) + 1, comment_element)
        comment_element.tail, element.tail = element.tail, "  "
    header = f'<?xml version="1.0"?>\n<!-- {_comment_text(comment)} -->\n'
    return header.encode() + etree.tostring(robot, encoding="utf-8") + b"\n"


def _comment_text(comment: str) -> str:
    """Return a text that is allowed in an XML comment."""
    return re.sub("-(?=-)", "- ", " ".join(format_one_line(comment).split())).strip(" -")


def origin_text(machine: Machine) -> str:
    """Return the comment that names the source of a written machine."""
    return f"{machine.name}, written by crane; source: {machine.source or machine.path.name}"


def compound_drive_factors(machine: Machine) -> dict[str, dict[str, float]]:
    """Return the factors of all drives if one of them acts along several joints, else nothing."""
    drives = {drive.name: dict(drive.factors) for drive in machine.drives}
    is_plain = all(factors == {name: 1.0} for name, factors in drives.items())
    return {} if is_plain else drives


def rotor_inertias(machine: Machine) -> dict[str, float]:
    """Return the rotor inertias that are not zero, by joint."""
    joints = machine.tree.joints
    return {x: joints[x].rotor_inertia for x in machine.joints if joints[x].rotor_inertia}


def warn_about_unsupported(machine: Machine, format_name: str, others: Sequence[str]) -> None:
    """Warn of parts of a machine that a written format cannot represent.

    Those are the sections that only a machine file represents, and friction laws: other formats
    have Coulomb and viscous friction alone.

    Args:
        machine: The machine.
        format_name: Name of the format.
        others: Further parts.
    """
    names = [
        f"the friction law of {joint}"
        for joint, law in machine.friction.items()
        if law.coulomb_offset or law.viscous_offset or law.stiction or law.stiction_2 or law.root
        or law.has_history or (law.coulomb and law.smoothing)
    ]  # fmt: skip
    sections = {
        "gas springs": machine.gas_springs,
        "end stops": machine.end_stops,
        "tasks": machine.tasks,
        "gains": machine.control,
        "hydraulics": machine.hydraulics,
    }
    names += [name for name, section in sections.items() if section]
    if listed := ", ".join([*names, *others]):
        warn(
            f"{machine.name}: {format_name} has no place for {listed}, left out (a machine "
            "file has)",
            stacklevel=3,
        )
