"""The bucket linkage of an excavator: a cylinder turns a rocker, a link turns the bucket.

Stick along x with the bucket's pin at its end, in the plane y = 0, metres. The cylinder's
triangle has two mirror images, and so has the four-bar linkage of stick, rocker, link and bucket.
"""

import math

CYLINDER, ROCKER_PIN, BUCKET_PIN = (0.55, 0.62), (2.33, 0.05), (2.8, 0.0)
RETRACTED, ROCKER, LINK, ARM = 1.45, 0.62, 0.58, 0.45
ACTIVE, PASSIVE = "stroke", ("barrel", "rocker", "link", "bucket")
ZERO = (0.0, math.pi / 2, math.pi / 2, math.pi / 4)  # of each part at zero, from its parent [rad]

_BODY = (
    '<link name="{}"><inertial><origin xyz="{} 0 0"/><mass value="{}"/><inertia ixx="{}" '
    'iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>\n'
)


def _body(name, length, mass):
    inertia = mass * length**2 / 12
    return _BODY.format(name, length / 2, mass, 0.1 * inertia, inertia, inertia)


def _joint(name, parent, child, xyz, kind="continuous", axis="0 -1 0", limit="", turn=0.0):
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{xyz[0]} 0 {xyz[1]}" '
        f'rpy="0 {-turn} 0"/>'
        f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>{limit}</joint>\n'
    )


def _pin(name, parent, x):
    return f'<link name="{name}"/>' + _joint(f"{name}_fixed", parent, name, (x, 0.0), "fixed")


def write(folder, stroke, home="", limits="", zero=ZERO):
    """Write the machine; `home` are more lines of that section, `limits` those of the rocker."""
    turns = dict(zip(PASSIVE, zero, strict=True))
    slide = '<limit lower="0" upper="1.0" effort="2e5" velocity="0.5"/>'
    parts = [
        '<robot name="bucket_linkage"><link name="stick"/>\n',
        _body("barrel", 1.2, 80) + _body("rod", 1.4, 50),
        _body("rocker", ROCKER, 45) + _body("link", LINK, 40) + _body("bucket", ARM, 600),
        _joint("barrel", "stick", "barrel", CYLINDER, turn=turns["barrel"]),
        _joint("stroke", "barrel", "rod", (RETRACTED, 0), "prismatic", "1 0 0", slide),
        _joint(
            "rocker", "stick", "rocker", ROCKER_PIN, "revolute" if limits else "continuous",
            limit=limits, turn=turns["rocker"],
        ),
        _joint("link", "rocker", "link", (ROCKER, 0), turn=turns["link"]),
        _joint("bucket", "stick", "bucket", BUCKET_PIN, turn=turns["bucket"]),
        _pin("rod_eye", "rod", 0.0) + _pin("rocker_eye", "rocker", ROCKER),
        _pin("link_eye", "link", LINK) + _pin("bucket_eye", "bucket", ARM),
        "</robot>\n",
    ]  # fmt: skip
    (folder / "bucket_linkage.urdf").write_text("".join(parts))
    path = folder / "bucket.yaml"
    path.write_text(
        "name: bucket\nchains:\n  - {name: all, urdf: bucket_linkage.urdf}\nloops:\n"
        "  - {name: eye, type: revolute, predecessor: rod_eye, successor: rocker_eye, "
        "axis: [0, 1, 0]}\n"
        "  - {name: pin, type: revolute, predecessor: link_eye, successor: bucket_eye, "
        "axis: [0, 1, 0]}\n"
        f"active: [stroke]\nhome:\n  stroke: {stroke}\n{home}"
    )
    return path


def assemblies(stroke, zero=ZERO):
    """All four ways to assemble it, (4, 4) of the passive joints, from circles that cross."""
    found = []
    for side in (1, -1):
        eye = _crossing(CYLINDER, RETRACTED + stroke, ROCKER_PIN, ROCKER, side)
        for other in (1, -1):
            pin = _crossing(eye, LINK, BUCKET_PIN, ARM, other)
            rocker = _angle(ROCKER_PIN, eye)
            turned = (_angle(CYLINDER, eye), rocker, _angle(eye, pin) - rocker,
                      _angle(BUCKET_PIN, pin))  # fmt: skip
            found.append([
                math.remainder(a - b, 2 * math.pi) for a, b in zip(turned, zero, strict=True)
            ])  # fmt: skip
    return found


def _angle(one, two):
    return math.atan2(two[1] - one[1], two[0] - one[0])


def _crossing(one, radius_one, two, radius_two, side):
    """Where two circles cross, on one side of the line of their centres."""
    away = math.dist(one, two)
    along = (away**2 + radius_one**2 - radius_two**2) / (2 * away)
    beside = side * math.sqrt(radius_one**2 - along**2)
    x, z = ((b - a) / away for a, b in zip(one, two, strict=True))
    return one[0] + along * x - beside * z, one[1] + along * z + beside * x
