"""What a machine looks like: what its URDFs draw, or a skeleton."""

import warnings

import numpy as np
import pinocchio as pin

from crane.common.errors import CraneWarning
from crane.common.samples import Array
from crane.formats.opening import robots
from crane.formats.visuals.visuals import PLAIN, Box, Cylinder, Sphere, Visual, read_drawn
from crane.machine import Machine


def read_visuals(machine: Machine) -> list[Visual]:
    """The visuals of every link, or a skeleton where no URDF has any.

    A mesh whose file is missing or damaged is a box, and what cannot be drawn is left out, with a
    warning; where nothing but boxes would be left, the skeleton is there, too.
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
    if all(visual.shape is box for visual in visuals):
        visuals += skeleton(machine)
    return visuals


def _warn(text: str) -> None:
    warnings.warn(text, CraneWarning, stacklevel=3)


def _reach(machine: Machine) -> float:
    """Largest distance between two joints on one body [m]; 1 where all are in one place."""
    places = machine.model.jointPlacements
    return max(float(np.linalg.norm(place.translation)) for place in places) or 1.0


def skeleton(machine: Machine) -> list[Visual]:
    """Bars from each joint to the joints and frames of the body it moves."""
    model = machine.model
    links: dict[int, str] = {}  # joint -> the first link of the body it moves
    ends: list[tuple[int, Array]] = []
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            links.setdefault(frame.parentJoint, frame.name)
            ends.append((frame.parentJoint, frame.placement.translation))
    for joint in range(1, model.njoints):
        ends.append((model.parents[joint], model.jointPlacements[joint].translation))
    radius = 0.03 * max(float(np.linalg.norm(end)) for _, end in ends) or 0.02
    visuals = []
    for body, end in ends:
        in_link = model.frames[machine.frame(links[body])].placement.inverse()
        ball = in_link.homogeneous
        ball[:3, 3] = in_link.act(end)
        visuals.append(Visual(links[body], Sphere(1.5 * radius), ball, PLAIN))
        if length := float(np.linalg.norm(end)):
            along = pin.Quaternion.FromTwoVectors(pin.ZAxis, end)
            bar = (in_link * pin.SE3(along, end / 2)).homogeneous
            visuals.append(Visual(links[body], Cylinder(radius, length), bar, PLAIN))
    return visuals
