"""The wheel loader on four tyres, with a boom suspension: an accumulator at its lift cylinder."""

import wheel_loader

RADIUS, TRACK, FRONT, REAR = 0.7, 1.9, 0.3, -2.8  # of the wheels: radius, their places along y, x
STIFFNESS, LATERAL = {"front": 9e5, "rear": 7e5}, 5e5  # of a tyre, down and along the ground
VOLUME, PRECHARGE, EXPONENT = 2e-3, 1.2e6, 1.3  # of the accumulator
FREE = ("base_x", "base_y", "base_z", "base_rx", "base_ry", "base_rz")
WHEELS = {
    f"{axle}_{side}": (x, y, RADIUS)
    for axle, x in (("front", FRONT), ("rear", REAR))
    for side, y in (("left", TRACK / 2), ("right", -TRACK / 2))
}


SUSPENSION = f"""  accumulators:
    ride: {{volume: {VOLUME}, precharge: {PRECHARGE}, exponent: {EXPONENT}}}
  elements:
    damper: {{type: orifice, from: X_lift.a, to: ride, coefficient: 1e-6}}
    rod: {{type: orifice, from: X_lift.b, to: tank, coefficient: 1e-6}}
"""


def write(folder, more="", slope=0.0, tyres=True, suspension=SUSPENSION):
    """Write the machine; on a slope that rises with x."""
    path = wheel_loader.write(folder)
    urdf = folder / "wheel_loader.urdf"
    wheels = "".join(
        f'<link name="{name}"/><joint name="hub_{name}" type="fixed"><parent link="frame"/>'
        f'<child link="{name}"/><origin xyz="{x} {y} {z}"/></joint>'
        for name, (x, y, z) in WHEELS.items()
    )
    urdf.write_text(urdf.read_text().replace("</robot>", f"{wheels}</robot>"))
    lateral = f", lateral_stiffness: {LATERAL}, lateral_damping: 2e4" if tyres else ""
    contacts = "".join(
        f"  - {{frame: {name}, radius: {RADIUS}, damping: 0.5, "
        f"stiffness: {STIFFNESS[name.partition('_')[0]]}{lateral}}}\n"
        for name in WHEELS
    )
    path.write_text(
        path.read_text()
        + suspension
        + "floating: [x, y, z, rx, ry, rz]\n"
        + f"free: [{', '.join(FREE)}]\n"
        + f"ground: {{normal: [{-slope}, 0, 1]}}\ncontacts:\n{contacts}{more}"
    )
    return path
