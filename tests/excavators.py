"""Small excavators without cylinders as URDF texts: open trees with a boom and an arm."""

BODY = """<link name="{}"><inertial><origin xyz="{} 0 {}"/><mass value="{}"/>
  <inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>
"""
JOINT = """<joint name="{}" type="revolute"><origin xyz="{}" rpy="{}"/>
  <parent link="{}"/><child link="{}"/><axis xyz="{}"/>
  <limit lower="{}" upper="{}" effort="1000" velocity="1"/></joint>
"""


def body(name, length, mass, height=0.0):
    across = mass * length**2 / 12
    return BODY.format(name, length / 2, height, mass, 0.1 * across, across, across)


def joint(name, parent, child, xyz, lower, upper, axis="0 1 0", rpy="0 0 0"):
    return JOINT.format(name, xyz, rpy, parent, child, axis, lower, upper)


def planar(folder, name="digger", rpy="0 0 0", more=""):
    """House, boom and arm that move in the plane y = 0; both links lie along x at zero."""
    text = f'<robot name="{name}"><link name="house"/>\n'
    text += body("boom", 4.0, 800.0) + body("arm", 2.0, 300.0) + '<link name="tip"/>\n'
    text += joint("lift", "house", "boom", "0 0 1.5", -1.1, 0.2, rpy=rpy)
    text += joint("fold", "boom", "arm", "4 0 0", 0.5, 2.3)
    text += '<joint name="tip" type="fixed"><origin xyz="2 0 0"/><parent link="arm"/>'
    text += f'<child link="tip"/></joint>{more}</robot>'
    (folder / f"{name}.urdf").write_text(text)
    return folder / f"{name}.urdf"


# cylinders that fit: eyes, bore, rod and stroke
LIFT = {"between": ["house:0.6,0,0.7", "boom:1.9,0,0.3"], "bore": 0.1, "rod": 0.07, "stroke": 0.9}
FOLD = {
    "between": ["boom:1.5,0,0.9", "arm:-0.5,0,0.35"], "bore": 0.11, "rod": 0.08, "stroke": 1.0,
    "dead_length": 2.2,
}  # fmt: skip


def spatial(folder):
    """The same on a slewing gear, and with a swing of the arm out of the boom's plane."""
    text = '<robot name="swinger"><link name="track"/>\n' + body("house", 2.0, 3000.0)
    text += body("boom", 4.0, 800.0) + body("post", 0.4, 100.0) + body("arm", 2.0, 300.0)
    text += joint("slew", "track", "house", "0 0 1", -3, 3, "0 0 1")
    text += joint("lift", "house", "boom", "0.3 0 0.8", -1.1, 0.2)
    text += joint("swing", "boom", "post", "4 0 0", -0.6, 0.6, "0 0 1")
    text += joint("fold", "post", "arm", "0.4 0 0", 0.5, 2.3)
    (folder / "swinger.urdf").write_text(text + "</robot>")
    return folder / "swinger.urdf"
