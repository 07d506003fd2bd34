"""What a machine looks like: what its URDFs draw, or a skeleton."""

import warnings
from collections.abc import Collection

import numpy as np
import pinocchio as pin

from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.formats.opening import robots
from crane.formats.visuals.visuals import PLAIN, Box, Cylinder, Sphere, Visual, read_drawn
from crane.machine import Machine

_BARRELS = 3.0  # largest distances on one body, the longest stroke that is drawn as a rod


def read_visuals(machine: Machine) -> list[Visual]:
    """The visuals of every link, and a skeleton of bodies with mass that have none.

    Where no URDF has any, the skeleton is of all that there is. A mesh whose file is missing or
    damaged is a box, and what cannot be drawn is left out, with a warning; where nothing but boxes
    would be left, the skeleton is there, too. Bodies that slide and have no visuals are rods or
    blocks.
    """
    visuals: list[Visual] = []
    missing: list[str] = []
    problems: list[str] = []
    box = Box((0.15 * _reach(machine),) * 3)
    with robots(machine) as sources:
        for xml in sources:
            drawn = read_drawn(xml, instead=box)
            visuals += drawn.shapes["visual"]
            missing += drawn.missing
            problems += drawn.problems
    if missing:
        _warn(
            f"{machine.name}: {len(missing)} mesh files are not there and are drawn as boxes "
            f"({missing[0]}), install the package that has them"
        )
    if problems:
        more = f" ({len(problems)} such, crane check lists them)" if len(problems) > 1 else ""
        _warn(f"{problems[0]}{more}")
    frames = machine.model.frames
    shown = {frames[machine.frame(visual.link)].parentJoint for visual in visuals}
    bare = all(visual.shape is box for visual in visuals)
    long = {joint for joint, end, _ in _ends(machine) if joint and end.any()}
    masses = machine.model.inertias
    bodies = {joint for joint in long - shown if masses[joint].mass}
    visuals += skeleton(machine, None if bare else bodies)
    return visuals + sliding(machine, shown)


def _warn(text: str) -> None:
    warnings.warn(text, CraneWarning, stacklevel=3)


def _reach(machine: Machine) -> float:
    """Largest distance between two joints on one body [m]; 1 where all are in one place."""
    places = machine.model.jointPlacements
    return max(float(np.linalg.norm(place.translation)) for place in places) or 1.0


def _ends(machine: Machine) -> list[tuple[int, Array, str]]:
    """Of each body, by its joint, where its frames and the next joints are (3,) [m]; names."""
    model = machine.model
    bodies = (frame for frame in model.frames if frame.type == pin.FrameType.BODY)
    ends = [(frame.parentJoint, frame.placement.translation, frame.name) for frame in bodies]
    for joint in range(1, model.njoints):
        end = model.jointPlacements[joint].translation
        ends.append((model.parents[joint], end, model.names[joint]))
    return ends


def longest(machine: Machine) -> float:
    """Largest distance from a joint to a frame of the body it moves [m]; 1 where all meet."""
    return max(float(np.linalg.norm(end)) for _, end, _ in _ends(machine)) or 1.0


def _links(machine: Machine) -> dict[int, str]:
    """The first link of the body that each joint moves."""
    links: dict[int, str] = {}
    for frame in machine.model.frames:
        if frame.type == pin.FrameType.BODY:
            links.setdefault(frame.parentJoint, frame.name)
    return links


def sliding(machine: Machine, drawn: Collection[int]) -> list[Visual]:
    """What shows bodies with mass that slide, but for those that are drawn, by joints.

    On what moves, a rod as long as the stroke, whose end is in the mouth of the barrel when it is
    out; on what stands still, or without limits that any barrel has, a block.
    """
    model, links, size = machine.model, _links(machine), longest(machine)
    width, limits = 0.11 * size, machine.coordinates
    found = []
    for joint in range(1, model.njoints):
        column = model.joints[joint].idx_v
        slides = column not in limits.floating and limits.slides[column]
        if not slides or joint in drawn or not model.inertias[joint].mass:
            continue
        axis = np.ravel(model.joints[joint].createData().S)[:3]
        stroke = float(limits.upper[column] - limits.lower[column])
        rod = bool(model.parents[joint]) and stroke < _BARRELS * size
        shape = Cylinder(0.2 * width, stroke) if rod else Box((1.5 * width, width, width))
        turned = pin.Quaternion.FromTwoVectors(pin.ZAxis if rod else pin.XAxis, axis)
        along = pin.SE3(turned, -0.5 * stroke * axis if rod else np.zeros(3))
        in_link = model.frames[machine.frame(links[joint])].placement.inverse() * along
        found.append(Visual(links[joint], shape, in_link.homogeneous, PLAIN))
    return found


def skeleton(machine: Machine, bodies: Collection[int] | None = None) -> list[Visual]:
    """Bars from each joint to the joints and frames of the body it moves.

    Where springs are held by what stands still there is a ball alone: a bar would hide them.

    Args:
        machine: The machine.
        bodies: By the joints that move them; all, and what stands still, if not given.
    """
    model, links, radius = machine.model, _links(machine), 0.03 * longest(machine)
    held = {link for item in machine.elements for link in item.between or ()}
    visuals = []
    for body, end, name in _ends(machine):
        if bodies is not None and body not in bodies:
            continue
        in_link = model.frames[machine.frame(links[body])].placement.inverse()
        ball = in_link.homogeneous
        ball[:3, 3] = in_link.act(end)
        visuals.append(Visual(links[body], Sphere(1.5 * radius), ball, PLAIN))
        length = float(np.linalg.norm(end))
        if length and (body or name not in held):
            along = pin.Quaternion.FromTwoVectors(pin.ZAxis, end)
            bar = (in_link * pin.SE3(along, end / 2)).homogeneous
            visuals.append(Visual(links[body], Cylinder(radius, length), bar, PLAIN))
    return visuals
