"""How do I display a closed machine in ROS 2 if only its actuators are measured?"""

import io
from types import SimpleNamespace

import numpy as np
import yourdfpy

import crane

try:
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import JointState
    from std_msgs.msg import String

    LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
except ImportError:  # without ROS: plain messages, and a node that stores what it would publish
    rclpy, LATCHED, JointState, String = None, None, SimpleNamespace, SimpleNamespace
    published = {}

    class Node:
        """The part of a node that is used here."""

        __init__ = create_subscription = lambda *_: None

        def create_publisher(self, kind, topic, qos):
            """Return a publisher that stores the last message by its topic."""
            return SimpleNamespace(publish=lambda message: published.update({topic: message}))


class ClosedMachine(Node):
    """Convert actuator_states to the input of robot_state_publisher and RViz."""

    def __init__(self, machine):
        super().__init__("closed_machine")
        self.transmission = crane.motion.Transmission(machine)
        description = self.create_publisher(String, "robot_description", LATCHED)
        description.publish(String(data=crane.formats.robot_description(machine)))
        self.joints = self.create_publisher(JointState, "joint_states", 10)
        self.create_subscription(JointState, "actuator_states", self.heard, 10)

    def heard(self, message):
        """Close the loops for a message of one actuator, or of several."""
        given = message.name, message.position, message.velocity, message.effort
        try:
            state = self.transmission.update(*given)
        except crane.CraneError as error:  # nothing is published, tf does not change
            self.get_logger().warning(str(error), throttle_duration_sec=1.0)
            return
        if state is not None:
            fields = ("position", "velocity", "effort")
            values = {field: getattr(state, field).tolist() for field in fields}
            self.joints.publish(JointState(header=message.header, name=list(state.name), **values))


machine = crane.load("patu655")  # a log crane: slewing gear and three cylinders
if rclpy is not None:
    rclpy.init()
    rclpy.spin(ClosedMachine(machine))
else:
    node = ClosedMachine(machine)
    still = ["X_tilt", "slew", "X_ext"], [0.2, 0.5, 0.1], [0.0] * 3, []
    for stroke in np.linspace(0.1, 0.4, 31).tolist():  # [m], its sensor sends separate messages
        for given in (still, (["X_lift"], [stroke], [0.1], [])):
            parts = zip(("name", "position", "velocity", "effort"), given, strict=True)
            node.heard(SimpleNamespace(header=None, **dict(parts)))
    joints, description = published["joint_states"], published["robot_description"].data
    for name, position, velocity in zip(
        joints.name, joints.position, joints.velocity, strict=True
    ):
        print(f"{name:12} {position:8.4f} {velocity:8.4f}")
    print(f"joint_states has {len(joints.name)} joints, of {len(machine.active)} measured ones")

    tree = yourdfpy.URDF.load(io.StringIO(description))
    tree.update_cfg(dict(zip(joints.name, joints.position, strict=True)))
    for loop in machine.closure.equations.loops:  # cut, but its frames coincide in tf
        ends = [tree.get_transform(end)[:3, 3] for end in (loop.predecessor, loop.successor)]
        assert np.abs(ends[0] - ends[1]).max() < 1e-12
