"""How postures change with the places of the pins that close the loops."""

import numpy as np

from crane.common.samples import Array
from crane.machine import Machine


def pin_slopes(machine: Machine, q: Array) -> dict[str, Array]:
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
    pins = _pins(machine)
    out = {f"{link}.{axis}": np.zeros_like(q) for link in pins for axis in "xyz"}
    equations, passive = machine.closure.equations, machine.closure.passive
    for i, place in enumerate(q):
        _, jacobian = equations.scaled(place)
        right = [_moved(machine, pins[link]) for link in pins]
        if right:
            A, b = jacobian[:, passive], -np.column_stack(right) / equations.row_units[:, None]
            solved = np.linalg.lstsq(A, b, rcond=None)[0] * equations.units[passive][:, None]
            for k, name in enumerate(out):
                out[name][i, passive] = solved[:, k]
    return out


def _pins(machine: Machine) -> dict[str, list[tuple[int, float, str]]]:
    """By frame its loops, on which side of each it is, and the link that it stands on."""
    above = {joint.child: joint for joint in machine.tree.joints.values()}
    below = machine.tree.below()
    found: dict[str, list[tuple[int, float, str]]] = {}
    for i, loop in enumerate(machine.closure.equations.loops):
        for side, link in ((-1.0, loop.predecessor), (1.0, loop.successor)):
            if link in above and not above[link].moves and link not in below:
                found.setdefault(link, []).append((i, side, above[link].parent))
    return found


def _moved(machine: Machine, places: list[tuple[int, float, str]]) -> Array:
    """Derivatives (m, 3) of all equations by the place of a frame, where they were evaluated."""
    equations = machine.closure.equations
    data = equations.data
    out = np.zeros((len(equations.loop_of_row), 3))
    count = len(equations.axis1)  # couplings follow
    for i, side, parent in places:
        joint, local = equations.frames[2 * i]
        axes = (data.oMi[joint] * local).rotation
        frame = machine.model.frames[machine.frame(parent)]
        turn = (data.oMi[frame.parentJoint] * frame.placement).rotation
        for row in range(count):
            if equations.loop_of_row[row] == i and equations.is_translation[row]:
                out[row] += side * axes[:, equations.axis1[row]] @ turn
    return out
