"""Conversion of placements and inertias of a description to Pinocchio and back."""

import dataclasses
import math

import numpy as np
import pinocchio as pin

from crane.description.kinematic_tree import Inertial, Placement, Tree, Vector, to_vector


def rotation_from_rpy(rpy: Vector) -> np.ndarray:
    """Return (3, 3) R_z(yaw) R_y(pitch) R_x(roll), computed from the quaternion as for URDF.

    The result is equal to the last digit to that of Pinocchio for the same values in a URDF.
    """
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in rpy)
    x, y, z, w = (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return np.asarray(
        pin.Quaternion(w / length, x / length, y / length, z / length).toRotationMatrix()
    )


def se3_from_xyz_rpy(xyz: Vector, rpy: Vector) -> pin.SE3:
    """Return a placement of Pinocchio."""
    return pin.SE3(rotation_from_rpy(rpy), np.array(xyz))


def xyz_rpy_from_se3(se3_placement: pin.SE3) -> Placement:
    """Return xyz and rpy of a placement."""
    return to_vector(se3_placement.translation), to_vector(
        pin.rpy.matrixToRpy(se3_placement.rotation)
    )


def inertia_from_inertial(link_inertial: Inertial | None) -> pin.Inertia:
    """Return the spatial inertia of a link in its frame, zero without one."""
    if link_inertial is None:
        return pin.Inertia.Zero()
    axes_rotation = rotation_from_rpy(link_inertial.rpy)
    spatial_inertia = pin.Inertia(
        link_inertial.mass, np.array(link_inertial.com), np.zeros((3, 3))
    )
    # not by the constructor, which refuses infeasible inertias without the link's name
    spatial_inertia.inertia = axes_rotation @ link_inertial.inertia_matrix @ axes_rotation.T
    return spatial_inertia


def inertial_from_inertia(spatial_inertia: pin.Inertia) -> Inertial | None:
    """Return an inertial along the axes of the link's frame, None without mass."""
    if not spatial_inertia.mass:
        return None
    return Inertial(
        float(spatial_inertia.mass),
        to_vector(spatial_inertia.lever),
        (0.0, 0.0, 0.0),
        tuple(float(x) + 0.0 for x in spatial_inertia.inertia[np.triu_indices(3)]),
    )


def add_rigid_load(tree: Tree, frame: str, load: pin.Inertia) -> Tree:
    """Return a tree with a rigid load on a frame, added to the link that the frame is fixed to.

    So a point mass needs no link, for which URDF requires an inertia.
    """
    parent_joints = {joint.child: joint for joint in tree.joints.values()}
    link = frame
    while link in parent_joints and not parent_joints[link].is_movable:
        load = load.se3Action(se3_from_xyz_rpy(parent_joints[link].xyz, parent_joints[link].rpy))
        link = parent_joints[link].parent
    body_link = tree.links[link]
    loaded_inertial = inertial_from_inertia(inertia_from_inertial(body_link.inertial) + load)
    if loaded_inertial is not None and body_link.inertial is not None:
        loaded_inertial = dataclasses.replace(
            loaded_inertial, finding_location=body_link.inertial.finding_location
        )
    return tree.with_parts(dataclasses.replace(body_link, inertial=loaded_inertial))
