"""Small excavators without cylinders as URDF texts: open trees with a boom and an arm."""

from urdf_text import body, frame, joint, write


def _body(name, length, mass):
    across = mass * length**2 / 12
    return body(name, mass, (length / 2, 0, 0), (0.1 * across, across, across))


def _joint(name, parent, child, at, lower, upper, axis="0 1 0", turn="0 0 0"):
    return joint(name, parent, child, at, "revolute", axis, (lower, upper, 1000), turn)


def planar(folder, name="digger", rpy="0 0 0", more=""):
    """House, boom and arm that move in the plane y = 0; both links lie along x at zero."""
    return write(
        folder, name, "house", _body("boom", 4.0, 800.0), _body("arm", 2.0, 300.0),
        _joint("lift", "house", "boom", (0, 0, 1.5), -1.1, 0.2, turn=rpy),
        _joint("fold", "boom", "arm", (4, 0, 0), 0.5, 2.3), frame("tip", "arm", (2, 0, 0)), more,
    )  # fmt: skip


# cylinders that fit: eyes, bore, rod and stroke
LIFT = {"between": ["house:0.6,0,0.7", "boom:1.9,0,0.3"], "bore": 0.1, "rod": 0.07, "stroke": 0.9}
FOLD = {
    "between": ["boom:1.5,0,0.9", "arm:-0.5,0,0.35"], "bore": 0.11, "rod": 0.08, "stroke": 1.0,
    "dead_length": 2.2,
}  # fmt: skip


def spatial(folder):
    """The same on a slewing gear, and with a swing of the arm out of the boom's plane."""
    return write(
        folder, "swinger", "track", _body("house", 2.0, 3000.0), _body("boom", 4.0, 800.0),
        _body("post", 0.4, 100.0), _body("arm", 2.0, 300.0),
        _joint("slew", "track", "house", (0, 0, 1), -3, 3, (0, 0, 1)),
        _joint("lift", "house", "boom", (0.3, 0, 0.8), -1.1, 0.2),
        _joint("swing", "boom", "post", (4, 0, 0), -0.6, 0.6, (0, 0, 1)),
        _joint("fold", "post", "arm", (0.4, 0, 0), 0.5, 2.3),
    )  # fmt: skip
