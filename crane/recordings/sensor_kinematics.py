"""Readings of ideal sensors, and derivatives of configurations by positions of pins."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from crane.common.samples import Array
from crane.description.kinematic_tree import path_to_root
from crane.description.sensors import INCLINATION_PREFIX, VELOCITY_SUFFIX
from crane.machine.machine import Machine

_MIN_EFFECT = 1e-6  # of a pin's coordinate on joints, in their units per metre


def ideal_readings(machine: Machine, q: Array, v: Array, names: Sequence[str]) -> dict[str, Array]:
    """Readings of ideal sensors: coordinates, inclinations and their rates (N,) by name, SI units.

    The inclination of a link is the elevation of its x axis, asin(x_z); its rate is (w x x)_z /
    sqrt(1 - x_z^2).

    Args:
        machine: The machine.
        q: (N, nv) closed configurations.
        v: (N, nv) velocities.
        names: Names X and X_velocity of joints, inclination_LINK and inclination_LINK_velocity.
    """
    found = {}
    for name in names:
        joint = name.removesuffix(VELOCITY_SUFFIX)
        if joint in machine.joints:
            found[name] = (q if joint == name else v)[:, machine.column(joint)]
    links = {
        name.removeprefix(INCLINATION_PREFIX).removesuffix(VELOCITY_SUFFIX)
        for name in names
        if name not in found
    }
    inclinations = _inclinations(machine, q, v, sorted(links)) if links else {}
    return found | {name: inclinations[name] for name in names if name not in found}


def _inclinations(machine: Machine, q: Array, v: Array, links: list[str]) -> dict[str, Array]:
    """Inclinations of links and their rates (N,), by name of the column."""
    model, data = machine.model, machine.model.createData()
    frames = [machine.frame(link) for link in links]
    x, w = np.empty((2, len(links), len(q), 3))
    axes, up = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, machine.up_direction
    for i, (place, rate) in enumerate(zip(q, v, strict=True)):
        pin.forwardKinematics(model, data, machine.coordinates.configuration(place), rate)
        for k, frame in enumerate(frames):
            x[k, i] = pin.updateFramePlacement(model, data, frame).rotation[:, 0]
            w[k, i] = pin.getFrameVelocity(model, data, frame, axes).angular
    flat = np.maximum(np.linalg.norm(np.cross(up, x), axis=-1), 1e-12)
    rates = np.cross(w, x) @ up / flat
    out = np.stack([np.arctan2(x @ up, flat), rates], axis=1).reshape(-1, len(q))
    names = [INCLINATION_PREFIX + link + end for link in links for end in ("", VELOCITY_SUFFIX)]
    return dict(zip(names, out, strict=True))


def pin_derivatives(machine: Machine, q: Array) -> dict[str, Array]:
    """Derivatives dq/dp (N, nv) at constant active coordinates, by the name of the parameter p.

    The translational equations of a loop are phi = a . (p_2 - p_1) with an axis a of its first
    frame. The k-th coordinate of a frame on a link with the rotation R moves the frame by R e_k,
    so that dphi/dp = -+ a . R e_k, and J_P dq_P = -dphi gives the passive joints.

    Args:
        machine: The machine.
        q: (N, nv) closed configurations.

    Returns:
        Derivatives by LINK.x, LINK.y, LINK.z for frames of loops that are fixed to a link and
        carry no other link.
    """
    pins = _loop_pins(machine)
    out = {f"{link}.{axis}": np.zeros_like(q) for link in pins for axis in "xyz"}
    equations, passive = machine.closure.equations, machine.closure.passive
    for i, configuration in enumerate(q):
        _, jacobian = equations.evaluate_scaled(configuration)
        constraint_derivatives = [_constraint_derivatives(machine, pins[link]) for link in pins]
        if constraint_derivatives:
            A, b = (
                jacobian[:, passive],
                -np.column_stack(constraint_derivatives) / equations.residual_units[:, None],
            )
            solved = (
                np.linalg.lstsq(A, b, rcond=None)[0] * equations.coordinate_units[passive][:, None]
            )
            for k, name in enumerate(out):
                out[name][i, passive] = solved[:, k]
    return out


def cylinder_pins(machine: Machine, joint: str) -> list[str]:
    """Coordinates LINK.x, .y, .z of the pins between a cylinder and what it moves, as they matter.

    They are on the sides of loops that the cylinder's own joint does not carry.

    Args:
        machine: The machine.
        joint: Joint of the cylinder.
    """
    parents, found = machine.tree.parent_joints, []
    derivatives = pin_derivatives(machine, machine.home[None])
    for loop in machine.closure.equations.loops:
        carried = [
            link
            for link in (loop.predecessor, loop.successor)
            if joint in (x.name for x in path_to_root(parents, link))
        ]
        if len(carried) == 1:
            other = loop.successor if carried[0] == loop.predecessor else loop.predecessor
            names = [f"{other}.{axis}" for axis in "xyz"]
            found += [x for x in names if np.any(np.abs(derivatives.get(x, 0.0)) > _MIN_EFFECT)]
    return found


def _loop_pins(machine: Machine) -> dict[str, list[tuple[int, float, str]]]:
    """By frame: its loops, its side (-1, 1) in each of them, and the link that carries it."""
    parent_joints = machine.tree.parent_joints
    moving_subtrees = machine.tree.joints_by_parent()
    found: dict[str, list[tuple[int, float, str]]] = {}
    for i, loop in enumerate(machine.closure.equations.loops):
        for side, link in ((-1.0, loop.predecessor), (1.0, loop.successor)):
            if (
                link in parent_joints
                and not parent_joints[link].is_movable
                and link not in moving_subtrees
            ):
                found.setdefault(link, []).append((i, side, parent_joints[link].parent))
    return found


def _constraint_derivatives(machine: Machine, loop_sides: list[tuple[int, float, str]]) -> Array:
    """Derivatives (m, 3) of all equations by the position of a frame, at the last evaluation."""
    equations = machine.closure.equations
    data = equations.data
    out = np.zeros((len(equations.loop_of_row), 3))
    count = len(equations.axis_of_frame1)  # rows of couplings follow
    for i, side, parent in loop_sides:
        joint, local = equations.frames[2 * i]
        axes = (data.oMi[joint] * local).rotation
        frame = machine.model.frames[machine.frame(parent)]
        rotation = (data.oMi[frame.parentJoint] * frame.placement).rotation
        of_loop = (equations.loop_of_row[:count] == i) & equations.is_translation[:count]
        for row in np.flatnonzero(of_loop):
            out[row] += side * axes[:, equations.axis_of_frame1[row]] @ rotation
    return out
