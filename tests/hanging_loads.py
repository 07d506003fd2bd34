"""A crane with a grapple on two free pins, and a floating four-bar with a pendulum."""

import crane


def link(name, mass, com, inertia):
    xx, xy, xz, yy, yz, zz = inertia
    return (
        f'<link name="{name}"><inertial><origin xyz="{com}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" ixy="{xy}" ixz="{xz}" iyy="{yy}" iyz="{yz}" izz="{zz}"/>'
        "</inertial></link>\n"
    )


def joint(name, parent, child, at, axis, limit="", kind="revolute"):
    kind = kind if limit or kind == "fixed" else "continuous"
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{at}"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/>{limit}</joint>\n'
    )


def limits(lower, upper, effort):
    return f'<limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="2"/>'


HANGING = (
    '<robot name="hanging"><link name="base"/>\n'
    + link("column", 300, "0.1 0 0.5", (40, 0, 0, 40, 0, 20))
    + link("boom", 250, "2 0 0.1", (10, 0, 2, 400, 0, 400))
    + link("link", 15, "0.01 0 -0.1", (0.1, 0, 0, 0.1, 0, 0.05))
    + link("grapple", 180, "0.03 0.01 -0.6", (20, 0.3, 0.1, 25, 0.2, 12))
    + '<link name="jaw"/>'
    + joint("slew", "base", "column", "0 0 0", "0 0 1", limits(-3, 3, 3e4))
    + joint("lift", "column", "boom", "0 0 1.5", "0 -1 0", limits(-0.5, 1.3, 6e4))
    + joint("swing_x", "boom", "link", "4 0 0", "0 1 0")
    + joint("swing_y", "link", "grapple", "0 0 -0.2", "1 0 0")
    + joint("jaw_mount", "grapple", "jaw", "0 0 -1.1", "0 0 1", kind="fixed")
    + "</robot>"
)
PLAIN = """name: hanging
chains: [{name: arm, urdf: hanging.urdf}]
active: [slew, lift]
free: [swing_x, swing_y]
tip: jaw
home: {slew: 0.2, lift: 0.3, swing_x: 0.35}
friction:
  slew: {viscous: 300}
  lift: {viscous: 2000}
  swing_x: {viscous: 20}
  swing_y: {viscous: 20}
control:
  slew: {kp: 4.0e+4, ki: 8.0e+3}
  lift: {kp: 2.0e+5, ki: 6.0e+4}
tasks:
  turn: {duration: 1.0, active: {slew: [0.2, 0, 0.3, -0.1], lift: [0.3, 0, 0.1, -0.05]}}
"""
HYDRAULICS = """hydraulics:
  supply: {pressure: 1.8e+7, flow: 1.2e-3}
  oil: {bulk_modulus: 1.5e+9}
  cylinders:
    slew: {area_a: 2.0e-3, area_b: 2.0e-3, hose_a: 2.0e-4, hose_b: 2.0e-4}
    lift: {area_a: 4.0e-3, area_b: 3.0e-3, hose_a: 2.0e-4, hose_b: 2.0e-4}
  valves:
    slew: {type: compensated, flow: 6.0e-4, margin: 7.0e+5}
    lift: {type: compensated, flow: 6.0e-4, margin: 7.0e+5}
  control:
    slew: {kp: 5.0, kd: 0.1}
    lift: {kp: 5.0, kd: 0.1}
"""


def file(folder, more=""):
    (folder / "hanging.urdf").write_text(HANGING)
    (folder / "hanging.yaml").write_text(PLAIN + more)
    return folder / "hanging.yaml"


PINS = (0.5, 0.4, 0.6)  # of crank, coupler and rocker
FLOATING = (
    '<robot name="afloat">\n'
    + link("hull", 30, "0.1 0.05 -0.1", (2, 0.1, 0.2, 3, -0.1, 4))
    + link("crank", 2, "0.25 0 0.02", (0.02, 0, 0, 0.05, 0, 0.06))
    + link("coupler", 3, "0.2 0.03 0", (0.03, 0.001, 0, 0.06, 0, 0.07))
    + link("rocker", 2.5, "0.3 0 0", (0.02, 0, 0, 0.07, 0.002, 0.08))
    + link("load", 4, "0.02 0.3 0.1", (0.3, 0, 0.01, 0.1, 0, 0.3))
    + joint("turn", "hull", "crank", "0.3 0.1 0.2", "0 0 1")
    + joint("knee", "crank", "coupler", f"{PINS[0]} 0 0", "0 0 1")
    + joint("foot", "hull", "rocker", "0.9 0.1 0.2", "0 0 1")
    + joint("sway", "coupler", "load", "0.2 0.1 0", "1 0.2 0.4")
    + '<loop name="pin" type="revolute">'
    f'<predecessor link="coupler"><origin xyz="{PINS[1]} 0 0"/></predecessor>'
    f'<successor link="rocker"><origin xyz="{PINS[2]} 0 0"/></successor><axis xyz="0 0 1"/></loop>'
    '<group_state name="home"><joint name="turn" value="1.2"/><joint name="knee" value="-1.3"/>'
    '<joint name="foot" value="1.6"/></group_state></robot>'
)


def floating_series(folder):
    """A hull that floats, with a driven four-bar on it and a load that sways on its coupler."""
    (folder / "afloat.urdf").write_text(FLOATING)
    return crane.load(folder / "afloat.urdf", floating=True, active=["turn"], free=["sway"])
