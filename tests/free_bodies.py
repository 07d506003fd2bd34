"""Statics of a machine by free-body diagrams: all links and joint forces in one system.

Six balances per link that moves; six unknowns per joint and loop, less those along what moves
freely. Places follow from the files' numbers by matrices of four. Nothing of the package but what
it read from the files is used.
"""

from functools import reduce

import numpy as np


def placed(xyz, rpy=(0.0, 0.0, 0.0)):
    r, p, y = rpy
    turn = about((0, 0, 1), y) @ about((0, 1, 0), p) @ about((1, 0, 0), r)
    turn[:3, 3] = xyz
    return turn


def about(axis, angle):
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=float)
    out = np.eye(4)
    out[:3, :3] += np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
    return out


def places(machine, q):
    """Matrices of all links at a closed posture (nq,), in the world."""
    tree, out = machine.tree, {machine.tree.root_link: np.eye(4)}
    waiting = list(tree.joints.values())
    while waiting:
        joint = waiting.pop(0)
        if joint.parent not in out:
            waiting.append(joint)
            continue
        moved = np.eye(4)
        if joint.kind == "revolute":
            moved = about(joint.axis, q[machine.column(joint.name)])
        elif joint.kind == "prismatic":
            moved[:3, 3] = q[machine.column(joint.name)] * np.array(joint.axis)
        out[joint.child] = out[joint.parent] @ placed(joint.xyz, joint.rpy) @ moved
    return out


def balance(machine, q, gravity, load, frame, force=(0.0, 0.0, 0.0)):
    """Forces of the drives, and of each pin, with a load at a frame.

    Args:
        machine: Of revolute and prismatic joints and revolute loops.
        q: (nq,) closed posture.
        gravity: (3,) [m/s2].
        load: [kg] at the frame's origin.
        frame: Link.
        force: (3,) besides, likewise.

    Returns:
        By joint the force of its drive [N], [N m], and by joint and loop the wrench (6,) on what
        it moves, about its origin.
    """
    at, tree = places(machine, q), machine.tree
    rigid = {}  # link: the link that moves it, which joints move
    for link in tree.links:
        carrier = link
        while (joint := _joint_of(tree, carrier)) is not None and joint.kind == "fixed":
            carrier = joint.parent
        rigid[link] = carrier
    bodies = [joint.child for joint in tree.moving_joints]
    right = {body: np.zeros(6) for body in bodies}

    def add(link, point, pull):
        if rigid[link] in right:
            right[rigid[link]] -= np.r_[pull, np.cross(point, pull)]

    for name, link in tree.links.items():
        if link.inertial is not None:
            centre = at[name] @ np.r_[link.inertial.com, 1.0]
            add(name, centre[:3], link.inertial.mass * np.asarray(gravity))
    place = at[frame][:3, 3]
    add(frame, place, load * np.asarray(gravity) + np.asarray(force))
    unknowns = []  # name, (6, k) directions of the wrench, predecessor, successor, origin
    for joint in tree.moving_joints:
        origin, axis = at[joint.child][:3, 3], at[joint.child][:3, :3] @ np.array(joint.axis)
        driven = joint.name in machine.active
        along = np.r_[axis, 0, 0, 0] if joint.kind == "prismatic" else np.r_[0, 0, 0, axis]
        unknowns.append((joint.name, _ways(along, driven), joint.parent, joint.child, origin))
    for loop in machine.closure.equations.loops:
        origin = at[loop.successor][:3, 3]
        axis = at[loop.successor][:3, :3] @ np.array(loop.axis)
        ways = _ways(np.r_[0, 0, 0, axis], False)
        unknowns.append((loop.name, ways, loop.predecessor, loop.successor, origin))
    size = sum(ways.shape[1] for _, ways, *_ in unknowns)
    matrix, first = np.zeros((6 * len(bodies), size)), 0
    for _, ways, predecessor, successor, origin in unknowns:
        whole = ways.copy()
        whole[3:] += np.cross(origin, ways[:3], axis=0)
        for link, sign in ((predecessor, -1.0), (successor, 1.0)):
            if rigid[link] in right:
                row = 6 * bodies.index(rigid[link])
                matrix[row : row + 6, first : first + ways.shape[1]] += sign * whole
        first += ways.shape[1]
    wanted = np.concatenate([right[body] for body in bodies])
    scale = np.linalg.norm(matrix, axis=0)
    found = np.linalg.lstsq(matrix / scale, wanted, rcond=1e-12)[0] / scale
    assert np.abs(matrix @ found - wanted).max() < 1e-9 * np.abs(wanted).max()
    drives, pins, first = {}, {}, 0
    for name, ways, _, successor, _ in unknowns:
        pins[name] = ways @ found[first : first + ways.shape[1]]
        first += ways.shape[1]
        if name in machine.active:
            joint = tree.joints[name]
            axis = at[successor][:3, :3] @ np.array(joint.axis)
            drives[name] = axis @ pins[name][: 3 if joint.kind == "prismatic" else 6][-3:]
    return drives, pins


def moment(machine, q, gravity, load, frame, one, two):
    """About the line from point one to point two, of all weights: what turns it over [N m]."""
    at = places(machine, q)
    weights = [
        (link.inertial.mass, (at[name] @ np.r_[link.inertial.com, 1.0])[:3])
        for name, link in machine.tree.links.items()
        if link.inertial is not None
    ]
    weights.append((load, at[frame][:3, 3]))
    way = (two - one) / np.linalg.norm(two - one)
    pulls = (mass * np.cross(centre - one, gravity) for mass, centre in weights)
    return float(way @ reduce(np.add, pulls))


def _joint_of(tree, link):
    return next((joint for joint in tree.joints.values() if joint.child == link), None)


def _ways(along, driven):
    """Wrenches that a joint can carry: all six, or those without one along its motion."""
    if driven:
        return np.eye(6)
    return np.linalg.svd(along[None])[2][1:].T
