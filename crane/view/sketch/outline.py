"""A machine's outline in the section of a chart: bodies, cylinders, and what stands still."""

import dataclasses
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.workspaces.section import Section, upwards
from crane.view.sketch.canvas import hull
from crane.view.sketch.mechanism import project
from crane.view.sketch.plane import Plane


class Outline(NamedTuple):
    """A machine in one posture, in the coordinates of a section [m].

    Attributes:
        bodies: Hulls (k, 2) of bodies between their pins, those that carry the tip last.
        cylinders: (c, 3, 2) closed end, mouth and rod's end.
        standing: (k, 2) hull of what stands still, nothing without supports.
    """

    bodies: list[Array]
    cylinders: Array
    standing: Array


def outline(machine: Machine, frame: str, section: Section, q: Array) -> Outline:
    """The outline of a machine, seen across the plane through its slewing axis.

    Args:
        machine: The machine.
        frame: What the section is of.
        section: The section; its plane turns with the slewing joint.
        q: (nq,) closed posture.
    """
    if machine.tip is None:
        machine = dataclasses.replace(machine, tip=frame)
    model, data = machine.model, machine.model.createData()
    pin.framesForwardKinematics(model, data, machine.coordinates.configuration(q))
    plane = Plane(_forward(machine, frame, section, data), section.second, section.names)
    origin = plane.project(section.origin)
    seen = project(machine, q, plane)
    bodies = [hull(body.points) - origin for body in sorted(seen.bodies, key=lambda x: x.boom)
              if len(body.points) > 1]  # fmt: skip
    slides = [np.array([x.start, x.mouth, x.end]) - origin for x in seen.slides if not x.rail]
    feet = [plane.project(data.oMf[machine.frame(x)].translation) for x in machine.supports]
    standing = np.zeros((0, 2))
    if feet:
        standing = hull(np.array([*feet, *(at for at, _ in seen.ground)])) - origin
    return Outline(bodies, np.array(slides).reshape(-1, 3, 2), standing)


def _forward(machine: Machine, frame: str, section: Section, data: pin.Data) -> Array:
    """The direction (3,) of the section's first coordinate."""
    if section.around:
        away = data.oMf[machine.frame(frame)].translation - section.origin
        away = away - (away @ section.second) * section.second
        length = float(np.linalg.norm(away))
        if length > 0:
            return np.asarray(away / length)
        across = np.cross(section.second, upwards(machine))
        return np.asarray(across if across.any() else np.eye(3)[0])
    if section.slew is None:
        return section.first
    at_home = machine.model.createData()
    pin.forwardKinematics(machine.model, at_home, machine.coordinates.configuration(machine.home))
    joint = machine.model.getJointId(machine.active[section.slew])
    turn = data.oMi[joint].rotation @ at_home.oMi[joint].rotation.T
    return np.asarray(turn @ section.first)
