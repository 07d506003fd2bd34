"""How do I describe a delta robot with its loops in a robot.yaml, and where is its platform?"""

from pathlib import Path

import numpy as np

import crane

BASE, ARM, ROD, PLATFORM, WIDE = 0.2, 0.2, 0.45, 0.05, 0.04  # radii, lengths [m]
TURNS = np.deg2rad([0.0, 120.0, 240.0])  # directions of the three arms
TILT = np.arctan2(-(BASE + ARM - PLATFORM), -np.sqrt(ROD**2 - (BASE + ARM - PLATFORM) ** 2))


def link(name, mass, size):
    """A body with its mass at its origin; `size` sets its inertia [kg], [m]."""
    inertia = " ".join(f'{axis}="{mass * size**2 / 12}"' for axis in ("ixx", "iyy", "izz"))
    return f"""
  <link name="{name}"><inertial><mass value="{mass}"/>
    <inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def joint(name, kind, parent, child, place, rpy=(0, 0, 0)):
    """A joint about y."""
    xyz, rpy = (" ".join(map(str, x)) for x in (place, rpy))
    return f"""
  <joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/>
    <parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/></joint>"""


parts = [link("platform", 0.5, 0.1), '<link name="base"/><link name="tip"/>']
closed, elbows = [], []
for i, turn in enumerate(TURNS):
    out = np.array([np.cos(turn), np.sin(turn), 0.0])
    across = np.array([-np.sin(turn), np.cos(turn), 0.0])
    parts.append(link(f"arm{i}", 0.3, ARM))
    parts.append(joint(f"motor{i}", "continuous", "base", f"arm{i}", BASE * out, (0, 0, turn)))
    for side, y in (("a", WIDE), ("b", -WIDE)):
        rod = f"rod{i}{side}"
        elbows.append(f"elbow{i}{side}")
        parts.append(link(rod, 0.05, ROD))
        parts.append(joint(elbows[-1], "continuous", f"arm{i}", rod, (ARM, y, 0), (0, TILT, 0)))
        if (i, side) == (0, "a"):  # the first rod carries the platform, the others are closed
            parts.append(joint("ball", "continuous", rod, "platform", (0, 0, ROD), (0, -TILT, 0)))
            first = PLATFORM * out + y * across
            parts.append(joint("centre", "fixed", "platform", "tip", -first))
        else:
            ends = f"{rod}_end", f"{rod}_hook"
            place = PLATFORM * out + y * across - first
            parts += [f'<link name="{ends[0]}"/><link name="{ends[1]}"/>']
            parts.append(joint(f"{rod}_1", "fixed", rod, ends[0], (0, 0, ROD)))
            parts.append(joint(f"{rod}_2", "fixed", "platform", ends[1], place))
            closed.append(list(ends))

end = '<end_effector name="tip" parent_link="tip"/>'
Path("robot.urdf").write_text(f'<robot name="delta">{"".join(parts)}{end}</robot>')
Path("robot.yaml").write_text(f"""closed_loop: {closed}
type: {["3d"] * 5}
name_mot: [motor0, motor1, motor2]
joint_name: {[*elbows, "ball"]}
joint_type: {["UJOINT_YX"] * 6 + ["SPHERICAL"]}
""")

machine = crane.load("robot.yaml")
print(machine)
angles = np.array([0.2, -0.1, 0.4])  # motor angles, positive downwards [rad]
centre = crane.Kinematics(machine, "tip").position(angles)  # [m]
print(f"the platform is at {(1e3 * centre).round(2)} mm")

# by hand: its distance from each elbow, moved inwards by the platform's radius, is a rod's length
for turn, angle in zip(TURNS, angles, strict=True):
    out = BASE + ARM * np.cos(angle) - PLATFORM
    elbow = [out * np.cos(turn), out * np.sin(turn), -ARM * np.sin(angle)]
    assert abs(np.linalg.norm(centre - elbow) - ROD) < 1e-9
