"""Places and inertias of a description as Pinocchio has them, and back."""

import dataclasses
import math

import numpy as np
import pinocchio as pin

from crane.description.tree import Inertial, Placement, Tree, Vector


def vector(values: np.ndarray) -> Vector:
    """Three numbers, zeros without a sign."""
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z


def rotation(rpy: Vector) -> np.ndarray:
    """(3, 3) R_z(yaw) R_y(pitch) R_x(roll), by way of the quaternion that readers of URDF take.

    So it is to the last digit what Pinocchio makes of the same numbers in a URDF.
    """
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in rpy)
    x, y, z, w = (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    length = math.sqrt(x * x + y * y + z * z + w * w)
    quaternion = pin.Quaternion(w / length, x / length, y / length, z / length)
    return np.asarray(quaternion.toRotationMatrix())


def se3(xyz: Vector, rpy: Vector) -> pin.SE3:
    """A placement."""
    return pin.SE3(rotation(rpy), np.array(xyz))


def placement(place: pin.SE3) -> Placement:
    """Numbers of a placement."""
    return vector(place.translation), vector(pin.rpy.matrixToRpy(place.rotation))


def inertia(inertial: Inertial | None) -> pin.Inertia:
    """The inertia of a link in its frame, zero without one."""
    if inertial is None:
        return pin.Inertia.Zero()
    turn = rotation(inertial.rpy)
    out = pin.Inertia(inertial.mass, np.array(inertial.com), np.zeros((3, 3)))
    out.inertia = (
        turn @ inertial.matrix @ turn.T
    )  # the constructor refuses what assembling refuses with the link's name
    return out


def inertial(inertia: pin.Inertia) -> Inertial | None:
    """An inertia along the axes of the link's frame, None without mass."""
    if not inertia.mass:
        return None
    tensor = tuple(float(x) + 0.0 for x in inertia.inertia[np.triu_indices(3)])
    return Inertial(float(inertia.mass), vector(inertia.lever), (0.0, 0.0, 0.0), tensor)


def loaded(tree: Tree, frame: str, load: pin.Inertia) -> Tree:
    """A tree with a rigid load on a frame, as part of the link that the frame is fixed to.

    So a point mass is no link of its own, which a URDF has to give an inertia.
    """
    above = {joint.child: joint for joint in tree.joints.values()}
    link = frame
    while link in above and not above[link].moves:
        load = load.se3Action(se3(above[link].xyz, above[link].rpy))
        link = above[link].parent
    body = tree.links[link]
    whole = inertial(inertia(body.inertial) + load)
    if whole is not None and body.inertial is not None:
        whole = dataclasses.replace(whole, doubt=body.inertial.doubt)
    return tree.replacing(dataclasses.replace(body, inertial=whole))
