"""How do I close a loop, which URDF cannot describe?"""

from pathlib import Path

import numpy as np

import crane

GROUND, CRANK, COUPLER, ROCKER = 0.4, 0.15, 0.4, 0.3  # lengths of a four-bar linkage [m]


def rod(name, length):
    """A link along its x axis, 1 kg, a slender rod."""
    turning = length**2 / 12
    return f"""
  <link name="{name}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="1"/>
    <inertia ixx="0" iyy="{turning}" izz="{turning}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def pin(name, parent, child, x, angle):
    """A joint about y; angles are those of the URDF's zero [rad]."""
    return f"""
  <joint name="{name}" type="continuous"><origin xyz="{x} 0 0" rpy="0 {angle} 0"/>
    <parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/></joint>"""


# an open tree, as exporters write it, and one <loop> that closes it
Path("four_bar.urdf").write_text(f"""<robot name="four_bar">
  <link name="ground"/>{rod("crank", CRANK)}{rod("coupler", COUPLER)}{rod("rocker", ROCKER)}
  {pin("A", "ground", "crank", 0, 0)}
  {pin("B", "crank", "coupler", CRANK, -0.8)}{pin("D", "ground", "rocker", GROUND, -1.5)}
  <loop name="C" type="revolute">
    <predecessor link="coupler"><origin xyz="{COUPLER} 0 0"/></predecessor>
    <successor link="rocker"><origin xyz="{ROCKER} 0 0"/></successor>
    <axis xyz="0 1 0"/>
  </loop>
</robot>""")

machine = crane.load("four_bar.urdf", active=["A"])
turn = np.linspace(0.0, 2 * np.pi, 73)[:, None]  # of the crank [rad]
q = machine.closure.solve(turn)
swing = q[:, machine.column("D")]
gap = np.abs(machine.closure.residual(q)).max()
print(f"joints: {', '.join(machine.joints)}; driven: {', '.join(machine.active)}")
print(f"the rocker swings by {np.rad2deg(np.ptp(swing)):.1f} deg, loops closed to {gap:.0e} m")

# Grashof linkage: at the ends of its swing crank and coupler are collinear


def inner(reach):
    """Angle at D in the triangle of ground, rocker and the line from A to C."""
    return np.arccos((GROUND**2 + ROCKER**2 - reach**2) / (2 * GROUND * ROCKER))


expected = inner(COUPLER + CRANK) - inner(COUPLER - CRANK)
assert abs(np.ptp(swing) - expected) < 2e-3  # the grid of 5 deg does not contain the ends
assert gap < 1e-12
