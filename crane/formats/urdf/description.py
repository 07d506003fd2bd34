"""A machine as plain URDF, its loops cut: what ROS calls the robot_description."""

import dataclasses

from lxml import etree

from crane.formats.parts import (
    add_friction,
    add_joint,
    add_link,
    draw,
    finished,
    origin_of,
    with_whole_flyers,
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
    tree = with_whole_flyers(machine)
    for link in tree.links.values():
        add_link(robot, dataclasses.replace(link, between=None))
    for joint in tree.joints.values():
        add_friction(add_joint(robot, joint), machine, joint.name)
    draw(robot, machine, uris=True)
    return finished(robot, origin_of(machine)).decode()
