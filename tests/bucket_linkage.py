"""The bucket linkage of an excavator: a cylinder turns a rocker, a link turns the bucket.

Stick along x with the bucket's pin at its end, in the plane y = 0, metres. The cylinder's
triangle has two mirror images, and so has the four-bar linkage of stick, rocker, link and bucket.
"""

import math

from urdf_text import body, frame, joint

CYLINDER, ROCKER_PIN, BUCKET_PIN = (0.55, 0.62), (2.33, 0.05), (2.8, 0.0)
RETRACTED, ROCKER, LINK, ARM = 1.45, 0.62, 0.58, 0.45
ACTIVE, PASSIVE = "stroke", ("barrel", "rocker", "link", "bucket")
ZERO = (0.0, math.pi / 2, math.pi / 2, math.pi / 4)  # of each part at zero, from its parent [rad]


def _body(name, length, mass):
    inertia = mass * length**2 / 12
    return body(name, mass, (length / 2, 0, 0), (0.1 * inertia, inertia, inertia))


def _joint(name, parent, child, at, turn=0.0, **options):
    options = {"axis": (0, -1, 0)} | options
    return joint(name, parent, child, (at[0], 0, at[1]), turn=(0, -turn, 0), **options)


def write(folder, stroke, home="", limits=(), zero=ZERO):
    """Write the machine; `home` are more lines of that section, `limits` those of the rocker."""
    turns = dict(zip(PASSIVE, zero, strict=True))
    parts = [
        '<robot name="bucket_linkage"><link name="stick"/>\n',
        _body("barrel", 1.2, 80) + _body("rod", 1.4, 50),
        _body("rocker", ROCKER, 45) + _body("link", LINK, 40) + _body("bucket", ARM, 600),
        _joint("barrel", "stick", "barrel", CYLINDER, turn=turns["barrel"]),
        _joint("stroke", "barrel", "rod", (RETRACTED, 0), kind="prismatic", axis=(1, 0, 0),
               limits=(0, 1, 2e5, 0.5)),
        _joint(
            "rocker", "stick", "rocker", ROCKER_PIN, turns["rocker"], limits=limits,
            kind="revolute" if limits else "continuous",
        ),
        _joint("link", "rocker", "link", (ROCKER, 0), turn=turns["link"]),
        _joint("bucket", "stick", "bucket", BUCKET_PIN, turn=turns["bucket"]),
        frame("rod_eye", "rod", (0.0, 0, 0)) + frame("rocker_eye", "rocker", (ROCKER, 0, 0)),
        frame("link_eye", "link", (LINK, 0, 0)) + frame("bucket_eye", "bucket", (ARM, 0, 0)),
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
