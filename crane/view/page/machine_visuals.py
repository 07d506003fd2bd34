"""Visuals of a machine: shapes of its URDFs, or a skeleton."""

import warnings
from collections.abc import Collection

import numpy as np
import pinocchio as pin

from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.formats.robot_files import open_robots
from crane.formats.visuals.urdf_shapes import (
    DEFAULT_COLOUR,
    BoxShape,
    CylinderShape,
    SphereShape,
    Visual,
    read_shapes,
)
from crane.machine.machine import Machine

_MAX_ROD_STROKE_RATIO = (
    3.0  # largest distances on one body, the longest stroke that is drawn as a rod
)


def read_visuals(machine: Machine) -> list[Visual]:
    """Return the visuals of every link, and a skeleton of bodies with mass that have none.

    Without any visuals, all bodies are drawn as a skeleton. A mesh with a missing or damaged file
    is drawn as a box, and shapes that cannot be drawn are left out, with a warning; if only boxes
    remain, the skeleton is added. Sliding bodies without visuals are drawn as rods or blocks.
    """
    visuals: list[Visual] = []
    missing_meshes: list[str] = []
    problems: list[str] = []
    box = BoxShape((0.15 * _largest_joint_distance(machine),) * 3)
    with open_robots(machine) as sources:
        for xml in sources:
            drawn_visuals = read_shapes(xml, replacement=box)
            visuals += drawn_visuals.shapes["visual"]
            missing_meshes += drawn_visuals.missing_meshes
            problems += drawn_visuals.problems
    if missing_meshes:
        _warn(
            f"{machine.name}: {len(missing_meshes)} mesh files are not there and are drawn as "
            f"boxes ({missing_meshes[0]}), install the package that has them"
        )
    if problems:
        more_text = f" ({len(problems)} such, crane check lists them)" if len(problems) > 1 else ""
        _warn(f"{problems[0]}{more_text}")
    frames = machine.model.frames
    shown_joints = {frames[machine.frame(visual.link)].parentJoint for visual in visuals}
    long = {joint for joint, end, _ in _body_points(machine) if joint and end.any()}
    masses = machine.model.inertias
    visuals += skeleton_visuals(
        machine,
        None
        if all(visual.shape is box for visual in visuals)
        else {joint for joint in long - shown_joints if masses[joint].mass},
    )
    return visuals + sliding_body_visuals(machine, shown_joints)


def _warn(text: str) -> None:
    warnings.warn(text, CraneWarning, stacklevel=3)


def _largest_joint_distance(machine: Machine) -> float:
    """Return the largest distance between two joints on one body [m]; 1 if all are 0."""
    return (
        max(
            float(np.linalg.norm(placement.translation))
            for placement in machine.model.jointPlacements
        )
        or 1.0
    )


def _body_points(machine: Machine) -> list[tuple[int, Array, str]]:
    """Return parent joint, position (3,) [m] and name of all frames and joints on bodies."""
    model = machine.model
    points = [
        (frame.parentJoint, frame.placement.translation, frame.name)
        for frame in (frame for frame in model.frames if frame.type == pin.FrameType.BODY)
    ]
    for joint in range(1, model.njoints):
        points.append(
            (model.parents[joint], model.jointPlacements[joint].translation, model.names[joint])
        )
    return points


def largest_body_extent(machine: Machine) -> float:
    """Return the largest distance from a joint to a frame of its body [m]; 1 if all are 0."""
    return max(float(np.linalg.norm(end)) for _, end, _ in _body_points(machine)) or 1.0


def _first_links(machine: Machine) -> dict[int, str]:
    """Return the first link of each body, by joint."""
    links: dict[int, str] = {}
    for frame in machine.model.frames:
        if frame.type == pin.FrameType.BODY:
            links.setdefault(frame.parentJoint, frame.name)
    return links


def sliding_body_visuals(machine: Machine, drawn_joints: Collection[int]) -> list[Visual]:
    """Return rods and blocks for sliding bodies with mass that have no visuals.

    A body on a moving body is a rod as long as the stroke, whose end is in the mouth of the barrel
    when extended; a body on the ground, or with a long stroke, is a block.
    """
    model, links, size = machine.model, _first_links(machine), largest_body_extent(machine)
    width, limits = 0.11 * size, machine.coordinates
    visuals = []
    for joint in range(1, model.njoints):
        column = model.joints[joint].idx_v
        is_prismatic = column not in limits.floating_base_columns and limits.is_translation[column]
        if not is_prismatic or joint in drawn_joints or not model.inertias[joint].mass:
            continue
        axis = np.ravel(model.joints[joint].createData().S)[:3]
        stroke = float(limits.upper[column] - limits.lower[column])
        is_rod = bool(model.parents[joint]) and stroke < _MAX_ROD_STROKE_RATIO * size
        shape = (
            CylinderShape(0.2 * width, stroke) if is_rod else BoxShape((1.5 * width, width, width))
        )
        rotation = pin.Quaternion.FromTwoVectors(pin.ZAxis if is_rod else pin.XAxis, axis)
        link_placement = model.frames[machine.frame(links[joint])].placement.inverse() * pin.SE3(
            rotation, -0.5 * stroke * axis if is_rod else np.zeros(3)
        )
        visuals.append(Visual(links[joint], shape, link_placement.homogeneous, DEFAULT_COLOUR))
    return visuals


def skeleton_visuals(machine: Machine, bodies: Collection[int] | None = None) -> list[Visual]:
    """Return bars from each joint to the joints and frames of its body.

    Ends of springs on the ground are drawn as spheres only; a bar would hide the springs.

    Args:
        machine: The machine.
        bodies: Joints of the bodies to draw; by default all, and the ground.
    """
    model, links, radius = (
        machine.model,
        _first_links(machine),
        0.03 * largest_body_extent(machine),
    )
    element_links = {link for item in machine.force_elements for link in item.between or ()}
    visuals = []
    for body, point, name in _body_points(machine):
        if bodies is not None and body not in bodies:
            continue
        link_placement = model.frames[machine.frame(links[body])].placement.inverse()
        ball_placement = link_placement.homogeneous
        ball_placement[:3, 3] = link_placement.act(point)
        visuals.append(
            Visual(links[body], SphereShape(1.5 * radius), ball_placement, DEFAULT_COLOUR)
        )
        length = float(np.linalg.norm(point))
        if length and (body or name not in element_links):
            rotation = pin.Quaternion.FromTwoVectors(pin.ZAxis, point)
            bar_placement = (link_placement * pin.SE3(rotation, point / 2)).homogeneous
            visuals.append(
                Visual(links[body], CylinderShape(radius, length), bar_placement, DEFAULT_COLOUR)
            )
    return visuals
