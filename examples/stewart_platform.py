"""How long are the six legs of a Stewart platform, and what do they carry?"""

from pathlib import Path

import numpy as np

import crane

HEIGHT, MASS = 0.8, 100.0  # of the platform [m], [kg]
around = np.deg2rad([50, 70, 170, 190, 290, 310])  # of the joints below
above = np.deg2rad([10, 110, 130, 230, 250, 350])  # of the joints on the platform
low = np.column_stack([0.8 * np.cos(around), 0.8 * np.sin(around), 0 * around])  # [m]
high = np.column_stack([0.5 * np.cos(above), 0.5 * np.sin(above), 0 * above])


def link(name, mass, size):
    """A body with its mass at its origin; `size` sets its inertia [kg], [m]."""
    inertia = " ".join(f'{axis}="{mass * size**2 / 12}"' for axis in ("ixx", "iyy", "izz"))
    return f"""
  <link name="{name}"><inertial><mass value="{mass}"/>
    <inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def joint(name, kind, parent, child, axis, place=(0, 0, 0), rpy=(0, 0, 0)):
    """A joint of the URDF; prismatic joints are driven."""
    xyz, rpy, axis = (" ".join(map(str, x)) for x in (place, rpy, axis))
    more = '<limit lower="-0.3" upper="0.3" effort="5e3" velocity="1"/>'
    return f"""
  <joint name="{name}" type="{kind}" independent="{str(kind == "prismatic").lower()}">
    <origin xyz="{xyz}" rpy="{rpy}"/><parent link="{parent}"/><child link="{child}"/>
    <axis xyz="{axis}"/>{more if kind == "prismatic" else ""}</joint>"""


parts = ['<link name="ground"/>', link("platform", MASS, 1.0)]
parts.append(joint("free", "floating", "ground", "platform", (1, 0, 0), (0, 0, HEIGHT)))
way = high + [0, 0, HEIGHT] - low
length = np.linalg.norm(way, axis=1)  # of the legs at home [m]
for i, (x, y, z) in enumerate(way):
    turn = (0, -np.arcsin(z / length[i]), np.arctan2(y, x))  # the leg's x axis points up the leg
    parts += [link(f"cross{i}", 0.1, 0.1), link(f"tube{i}", 1.0, 0.3), link(f"rod{i}", 1.0, 0.3)]
    parts.append(joint(f"a{i}", "continuous", "ground", f"cross{i}", (0, 1, 0), low[i], turn))
    parts.append(joint(f"b{i}", "continuous", f"cross{i}", f"tube{i}", (0, 0, 1)))
    out = (length[i], 0, 0)
    parts.append(joint(f"leg{i}", "prismatic", f"tube{i}", f"rod{i}", (1, 0, 0), out))
    place = " ".join(map(str, high[i]))
    parts.append(f"""
  <loop name="ball{i}" type="spherical"><predecessor link="platform"><origin xyz="{place}"/>
    </predecessor><successor link="rod{i}"/></loop>""")
end = '<end_effector name="tip" parent_link="platform"/>'
Path("stewart.urdf").write_text(f'<robot name="stewart">{"".join(parts)}{end}</robot>')

machine = crane.load("stewart.urdf")
goal = np.array([0.05, -0.03, 0.9])  # of the platform [m]
attitude = np.deg2rad([4.0, -3.0, 5.0])  # roll, pitch, yaw [rad]
place = crane.Kinematics(machine)
strokes = place.inverse(goal, attitude=attitude)
print(f"strokes: {(1e3 * strokes).round(2)} mm")

rotation = place.rotation(strokes)
legs = np.linalg.norm(goal + high @ rotation.T - low, axis=1)  # by hand
assert np.allclose(strokes, legs - length, atol=1e-9)

force = crane.Dynamics(machine).gravity(np.zeros(6))  # platform level, at home [N]
up = force @ (way[:, 2] / length)  # vertical force of all legs [N]
print(f"each leg carries {force.mean():.1f} N; together they hold {up / 9.81:.1f} kg")
assert np.isclose(up / 9.81, MASS + 6 * 1.0)  # the platform and the rods attached to it
