"""How postures change with the places of the pins that close the loops."""

import numpy as np

from crane.common.samples import Array
from crane.machine import Machine


def pin_derivatives(machine: Machine, q: Array) -> dict[str, Array]:
    """Derivatives dq/dp (N, nv) at given active coordinates, by the names of the numbers p.

    A loop's equations of translation are phi = a . (p_2 - p_1), with a an axis of its first frame.
    A frame that stands on a link of rotation R moves by R e_k with its k-th coordinate there, so
    that dphi/dp = -+ a . R e_k, and the passive joints follow by J_P dq_P = -dphi.

    Args:
        machine: The machine.
        q: (N, nv) closed postures.

    Returns:
        By LINK.x, LINK.y, LINK.z of frames of loops that are fixed to a link and carry none.
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


def _loop_pins(machine: Machine) -> dict[str, list[tuple[int, float, str]]]:
    """By frame its loops, on which side of each it is, and the link that it stands on."""
    parent_joints = {joint.child: joint for joint in machine.tree.joints.values()}
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
    """Derivatives (m, 3) of all equations by the place of a frame, where they were evaluated."""
    equations = machine.closure.equations
    data = equations.data
    out = np.zeros((len(equations.loop_of_row), 3))
    count = len(equations.axis_of_frame1)  # couplings follow
    for i, side, parent in loop_sides:
        joint, local = equations.frames[2 * i]
        axes = (data.oMi[joint] * local).rotation
        frame = machine.model.frames[machine.frame(parent)]
        rotation = (data.oMi[frame.parentJoint] * frame.placement).rotation
        for row in range(count):
            if equations.loop_of_row[row] == i and equations.is_translation[row]:
                out[row] += side * axes[:, equations.axis_of_frame1[row]] @ rotation
    return out
