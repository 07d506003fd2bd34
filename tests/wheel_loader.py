"""A wheel loader of the 10 t class with Z-bar linkage: its tilt cylinder stands on the frame.

In the plane y = 0, metres, x forwards, z upwards from the ground; places are those at home, with
the bucket level on the ground. The tilt cylinder pushes the upper end of the bellcrank, whose
lower end pulls the bucket back by a link.
"""

import math

from urdf_text import body, frame, joint

PIVOT, PIN, LIP = (-0.70, 1.80), (1.45, 0.30), (2.55, 0.02)  # of the boom, the bucket; its edge
CRANK, EYE, LINK, BUCKET = (0.685, 1.077), (0.80, 1.60), (0.62, 0.52), (1.33, 0.68)
TOGGLE = (0.78, 0.72)  # pin of bellcrank and link: they are in line as the bucket dumps
LIFT, LIFT_EYE, TILT = (-0.95, 0.75), (0.186, 1.06), (-0.62, 2.10)
LIFTED, TILTED = 0.05, 0.40  # strokes at home
PRESSURE, TANK, RELIEF = 2.5e7, 2.0e5, 2.8e7
LIFT_AREAS = (2 * math.pi / 4 * 0.11**2, 2 * math.pi / 4 * (0.11**2 - 0.06**2))  # two cylinders
TILT_AREAS = (math.pi / 4 * 0.13**2, math.pi / 4 * (0.13**2 - 0.07**2))


def _body(name, mass, size, at=(0.0, 0.0)):
    return body(name, mass, (at[0], 0, at[1]), [mass * size**2 / 12] * 3)


def _away(place, base):
    return place[0] - base[0], place[1] - base[1]


def _joint(name, parent, child, at, turn=0.0, **options):
    options = {"axis": (0, -1, 0)} | options
    return joint(name, parent, child, (at[0], 0, at[1]), turn=(0, turn, 0), **options)


def _frame(name, parent, at):
    return frame(name, parent, (at[0], 0, at[1]))


def _cylinder(name, base, eye, stroke, length):
    """Barrel and rod from the frame to an eye; the stroke at home, and how long it is."""
    (x, z), pins = _away(eye, base), math.dist(base, eye)
    limits = 0, length, 5e5, 0.4
    return (
        _body(f"{name}_barrel", 45, 0.9, (0.4, 0)) + _body(f"{name}_rod", 30, 0.9, (-0.4, 0))
        + _joint(f"{name}_barrel", "frame", f"{name}_barrel", base, math.atan2(-z, x))
        + _joint(f"X_{name}", f"{name}_barrel", f"{name}_rod", (pins - stroke, 0),
                 kind="prismatic", axis=(1, 0, 0), limits=limits)
        + _frame(f"{name}_eye", f"{name}_rod", (0, 0))
    )  # fmt: skip


def write(folder, link=LINK):
    """Write the machine; with the link at `TOGGLE` bellcrank and link are in line on the way."""
    parts = [
        '<robot name="wheel_loader">\n' + _body("frame", 8500, 2.5, (-1.6, 1.0)),
        _body("boom", 700, 2.6, (1.1, -0.75)) + _body("bellcrank", 120, 1.1),
        _body("link", 40, 0.7, (0.35, 0.08)) + _body("bucket", 650, 1.2, (0.5, 0.2)),
        _joint("boom", "frame", "boom", PIVOT),
        _joint("bellcrank", "boom", "bellcrank", _away(CRANK, PIVOT)),
        _joint("bucket", "boom", "bucket", _away(PIN, PIVOT)),
        _joint("link", "bellcrank", "link", _away(link, CRANK)),
        _cylinder("lift", LIFT, LIFT_EYE, LIFTED, 0.9),
        _cylinder("tilt", TILT, EYE, TILTED, 0.72),
        _frame("boom_eye", "boom", _away(LIFT_EYE, PIVOT)),
        _frame("crank_eye", "bellcrank", _away(EYE, CRANK)),
        _frame("link_eye", "link", _away(BUCKET, link)),
        _frame("bucket_eye", "bucket", _away(BUCKET, PIN)),
        _frame("lip", "bucket", _away(LIP, PIN)),
        "</robot>\n",
    ]
    (folder / "wheel_loader.urdf").write_text("".join(parts))
    path = folder / "wheel_loader.yaml"
    loop = "  - {{name: {}, type: revolute, predecessor: {}, successor: {}, axis: [0, 1, 0]}}\n"
    loops = [("lift_pin", "boom_eye", "lift_eye"), ("tilt_pin", "crank_eye", "tilt_eye"),
             ("link_pin", "bucket_eye", "link_eye")]  # fmt: skip
    cylinder = (
        "    {}: {{area_a: {}, area_b: {}, hose_a: 1e-3, hose_b: 1e-3, relief: {}, "
        "relief_gain: 3e-9}}\n"
    )
    path.write_text(
        "name: wheel_loader\nchains:\n  - {name: all, urdf: wheel_loader.urdf}\nloops:\n"
        + "".join(loop.format(*one) for one in loops)
        + f"active: [X_lift, X_tilt]\nhome: {{X_lift: {LIFTED}, X_tilt: {TILTED}}}\ntip: lip\n"
        + f"hydraulics:\n  supply: {{pressure: {PRESSURE}, tank: {TANK}, flow: 2.5e-3}}\n"
        + "  oil: {bulk_modulus: 1.4e9}\n  cylinders:\n"
        + cylinder.format("X_lift", *LIFT_AREAS, RELIEF)
        + cylinder.format("X_tilt", *TILT_AREAS, RELIEF)
        + "  valves:\n    all: {type: orifice, c1: 5e-7, c2: 5e-7, c3: 5e-7, c4: 5e-7}\n"
    )
    return path
