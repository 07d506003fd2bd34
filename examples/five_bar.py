"""Where is the tool of a five-bar robot, and how well can its two motors move it?"""

from pathlib import Path

import numpy as np

import crane

BASE, CRANK, ROD = 0.3, 0.25, 0.4  # distance of the motors, lengths of cranks and rods [m]


def link(name, length):
    """A slender rod of 0.5 kg along x."""
    turning = 0.5 * length**2 / 12
    return f"""
  <link name="{name}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="0.5"/>
    <inertia ixx="0" iyy="{turning}" izz="{turning}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def joint(name, parent, child, x, angle, motor):
    """A joint about z with its zero at an angle [rad]."""
    return f"""
  <joint name="{name}" type="continuous" independent="{motor}">
    <origin xyz="{x} 0 0" rpy="0 0 {angle}"/>
    <parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/></joint>"""


Path("five_bar.urdf").write_text(f"""<robot name="five_bar">
  <link name="table"/><link name="tool"/>
  {link("crank_a", CRANK)}{link("crank_b", CRANK)}{link("rod_a", ROD)}{link("rod_b", ROD)}
  {joint("a", "table", "crank_a", 0, 2.2, "true")}
  {joint("b", "table", "crank_b", BASE, 0.9, "true")}
  {joint("c", "crank_a", "rod_a", CRANK, -1.2, "false")}
  {joint("d", "crank_b", "rod_b", CRANK, 1.2, "false")}
  <joint name="e" type="fixed"><origin xyz="{ROD} 0 0"/>
    <parent link="rod_a"/><child link="tool"/></joint>
  <loop name="tool_pin" type="revolute"><axis xyz="0 0 1"/>
    <predecessor link="rod_a"><origin xyz="{ROD} 0 0"/></predecessor>
    <successor link="rod_b"><origin xyz="{ROD} 0 0"/></successor></loop>
  <end_effector name="tip" parent_link="tool"/>
</robot>""")

machine = crane.load("five_bar.urdf")
tool = crane.Kinematics(machine, "tool")
q_a = np.array([0.1, -0.05])  # motors from their zeros [rad]
place = tool.position(q_a)  # [m]
print(f"the tool is at x = {1e3 * place[0]:.2f} mm, y = {1e3 * place[1]:.2f} mm")

# by hand: the tool is at the intersection of circles about the ends of both cranks
a, b = (
    np.array([x + CRANK * np.cos(t), CRANK * np.sin(t)])
    for x, t in ((0.0, 2.2 + q_a[0]), (BASE, 0.9 + q_a[1]))
)
half = (b - a) / 2
up = np.array([-half[1], half[0]]) / np.linalg.norm(half)
assert np.allclose(place[:2], a + half + up * np.sqrt(ROD**2 - half @ half), atol=1e-12)

# forces at the tool by motors of 1 N m: tau = J^T f, so the weakest direction has 1 / |J|
J = tool.jacobian(q_a)[:2]  # [m/rad]
print(f"1 N m makes between {1 / np.linalg.norm(J, 2):.1f} and {1 / np.linalg.norm(J, -2):.1f} N")
goal = tool.inverse(np.array([0.15, 0.5, 0.0]))
print(f"to reach x = 150, y = 500 mm the motors turn to {np.rad2deg(goal).round(2)} deg")
assert np.allclose(tool.position(goal), [0.15, 0.5, 0], atol=1e-9)
