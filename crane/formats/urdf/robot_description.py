"""A machine as plain URDF, its loops cut: what ROS calls the robot_description."""

import dataclasses

from lxml import etree

from crane.formats.urdf_output import (
    add_friction,
    add_joint,
    add_link,
    copy_shapes,
    format_document,
    origin_text,
    with_floating_joints,
)
from crane.machine import Machine


def robot_description(machine: Machine) -> str:
    """The whole machine as one URDF, a tree that every reader of URDF takes.

    Its joints are those of `Machine.joints`, each with one freedom, with their names, zeros and
    signs, so that joint states of all of them place every link; `crane.Transmission` makes these
    from the actuators'. A vehicle that floats stands on a joint "floating", which joint states do
    not have. Each loop is cut: its two frames are links that lie on each other where the loop is
    closed. There are no mimic joints. Meshes have URIs, `file://` or the `package://` of the
    machine's own files.

    Args:
        machine: The machine, as it is: with its changes, locks and payload.

    Returns:
        The text of the URDF.
    """
    robot = etree.Element("robot", name=machine.name)
    tree = with_floating_joints(machine)
    for link in tree.links.values():
        add_link(robot, dataclasses.replace(link, composite_joint=None))
    for joint in tree.joints.values():
        add_friction(add_joint(robot, joint), machine, joint.name)
    copy_shapes(robot, machine, uris=True)
    return format_document(robot, origin_text(machine)).decode()
