"""A machine's outline in the section of a chart: bodies, cylinders, and what stands still."""

import dataclasses
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.machine import Machine
from crane.motion.workspaces.workspace_section import WorkspaceSection, up_direction
from crane.view.sketch.drawing_plane import DrawingPlane
from crane.view.sketch.mechanism_projection import project_mechanism
from crane.view.sketch.sketch_canvas import convex_hull


class MachineOutline(NamedTuple):
    """A machine in one posture, in the coordinates of a section [m].

    Attributes:
        bodies: Hulls (k, 2) of bodies between their pins, those that carry the tip last.
        cylinders: (c, 3, 2) closed end, mouth and rod's end.
        stationary_hull: (k, 2) hull of what stands still, nothing without supports.
    """

    bodies: list[Array]
    cylinders: Array
    stationary_hull: Array


def machine_outline(
    machine: Machine, frame: str, section: WorkspaceSection, q: Array
) -> MachineOutline:
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
    plane = DrawingPlane(
        _forward_direction(machine, frame, section, data),
        section.second_direction,
        section.coordinate_names,
    )
    origin = plane.project(section.origin)
    mechanism = project_mechanism(machine, q, plane)
    bodies = [
        convex_hull(body.points) - origin
        for body in sorted(mechanism.bodies, key=lambda x: x.carries_tip)
        if len(body.points) > 1
    ]
    slides = [
        np.array([x.start, x.mouth, x.rod_outer_end]) - origin
        for x in mechanism.slides
        if not x.is_rail
    ]
    support_points = [
        plane.project(data.oMf[machine.frame(x)].translation) for x in machine.supports
    ]
    stationary_hull = np.zeros((0, 2))
    if support_points:
        stationary_hull = (
            convex_hull(
                np.array([*support_points, *(position for position, _ in mechanism.ground)])
            )
            - origin
        )
    return MachineOutline(bodies, np.array(slides).reshape(-1, 3, 2), stationary_hull)


def _forward_direction(
    machine: Machine, frame: str, section: WorkspaceSection, data: pin.Data
) -> Array:
    """The direction (3,) of the section's first coordinate."""
    if section.is_radial:
        offset = data.oMf[machine.frame(frame)].translation - section.origin
        offset = offset - (offset @ section.second_direction) * section.second_direction
        length = float(np.linalg.norm(offset))
        if length > 0:
            return np.asarray(offset / length)
        lateral = np.cross(section.second_direction, up_direction(machine))
        return np.asarray(lateral if lateral.any() else np.eye(3)[0])
    if section.slewing_joint is None:
        return section.first_direction
    home_data = machine.model.createData()
    pin.forwardKinematics(
        machine.model, home_data, machine.coordinates.configuration(machine.home)
    )
    joint = machine.model.getJointId(machine.active[section.slewing_joint])
    slew_rotation = data.oMi[joint].rotation @ home_data.oMi[joint].rotation.T
    return np.asarray(slew_rotation @ section.first_direction)
