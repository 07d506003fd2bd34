"""Which force does the cylinder need that lifts my boom?"""

from pathlib import Path

import numpy as np

import crane

MASS, LENGTH, LOAD = 200.0, 3.0, 500.0  # of the boom [kg], [m]; at its end [kg]
FOOT, EYE = np.array([0.4, 0, -0.6]), np.array([1.0, 0, -0.1])  # pins, from the boom's pin [m]

Path("boom.urdf").write_text(f"""<robot name="boom">
  <link name="column"/>
  <joint name="lift" type="revolute">
    <parent link="column"/><child link="boom"/><axis xyz="0 -1 0"/>
    <limit lower="-0.04" upper="0.7" effort="1e5" velocity="1"/>
  </joint>
  <link name="boom"><inertial><origin xyz="{LENGTH / 2} 0 0"/><mass value="{MASS}"/>
    <inertia ixx="1" iyy="150" izz="150" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="end" type="fixed"><origin xyz="{LENGTH} 0 0"/>
    <parent link="boom"/><child link="boom_tip"/></joint>
  <link name="boom_tip"/>
</robot>""")


def eye(link, place):
    """A pin in the syntax of `add_cylinder`."""
    return f"{link}:{','.join(map(str, place))}"


added = crane.formats.add_cylinder(
    "boom.urdf",
    (eye("column", FOOT), eye("boom", EYE)),
    bore=0.08,
    rod=0.045,
    stroke=0.5,
    dead_length=0.75,  # pin to pin with the rod retracted [m]
)
machine = crane.load(added.path, changes={"payload.mass": LOAD})
print(machine)

stroke = np.linspace(machine.lower[0] + 0.01, machine.upper[0] - 0.01, 6)[:, None]  # [m]
force = crane.Dynamics(machine).gravity(stroke)[:, 0]  # [N]
angle = machine.closure.solve(stroke)[:, machine.column("lift")]  # of the boom [rad]
for x, turn, f in zip(stroke[:, 0], angle, force, strict=True):
    print(f"stroke {1e3 * x:4.0f} mm, boom at {np.rad2deg(turn):5.1f} deg: {f / 1e3:5.1f} kN")
area = np.pi / 4 * 0.08**2  # [m2]
print(f"at most {force.max() / 1e3:.1f} kN, {force.max() / area / 1e5:.0f} bar on its piston")


# by hand: moment of boom and load over the lever arm of the force, without the weight of the
# cylinder (1 or 2 %)
for turn, f in zip(angle, force, strict=True):
    x, z = EYE[[0, 2]]
    pin = np.array([x * np.cos(turn) - z * np.sin(turn), x * np.sin(turn) + z * np.cos(turn)])
    foot = FOOT[[0, 2]]
    arm = abs(foot[0] * pin[1] - foot[1] * pin[0]) / np.linalg.norm(pin - foot)
    moment = 9.81 * np.cos(turn) * (MASS * LENGTH / 2 + LOAD * LENGTH)
    assert 1.0 < f / (moment / arm) < 1.02
