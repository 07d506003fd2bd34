"""Random mechanisms of twelve kinds, closed at zero by construction, and distant starts.

Each is built in the world: joints and loops have a point and an axis there while the machine is
closed, and every body has a frame with random orientation. So all loops are closed at zero,
without any use of the search.
"""

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

GROUND = "ground"
_BODY = (
    '<inertial><mass value="2"/><inertia ixx="0.05" iyy="0.05" izz="0.05" ixy="0" ixz="0" '
    'iyz="0"/></inertial>'
)
Y = np.array([0.0, 1.0, 0.0])


def _numbers(values):
    return " ".join(repr(float(value)) for value in values)


@dataclass
class Mechanism:
    """Joints and loops of a mechanism, and which of its joints are driven.

    Attributes:
        random: Draws its dimensions, and how its bodies' frames are turned.
        limited: Share of the joints that get limits.
    """

    random: np.random.Generator
    limited: float = 0.0
    joints: dict = field(default_factory=dict)  # (parent, slides, axis, limits, heavy) by name
    frames: dict = field(default_factory=lambda: {GROUND: pin.SE3.Identity()})
    loops: list = field(default_factory=list)
    active: list = field(default_factory=list)

    def body(self, name, parent, point, axis=Y, slides=False, driven=False, heavy=True):
        """A body that a joint of the same name moves, on another; its name."""
        turned = pin.Quaternion(self.random.normal(size=4)).normalized().toRotationMatrix()
        self.frames[name] = pin.SE3(turned, np.asarray(point, dtype=float))
        limits = None
        if slides or self.random.random() < self.limited:
            wide = (0.2, 0.6) if slides else (0.4, 4.0)
            limits = -self.random.uniform(*wide), self.random.uniform(*wide)
        self.joints[name] = parent, slides, np.asarray(axis, dtype=float), limits, heavy
        if driven:
            self.active.append(name)
        return name

    def ball(self, name, parent, point, freedoms=3):
        """A body on a ball, or on a cross (2 freedoms), as pins one after the other."""
        turned = pin.Quaternion(self.random.normal(size=4)).normalized().toRotationMatrix()
        for i in range(freedoms - 1):
            parent = self.body(f"{name}{i}", parent, point, turned[:, i], heavy=False)
        return self.body(name, parent, point, turned[:, freedoms - 1])

    def loop(self, one, two, point, axis=Y, kind="revolute"):
        """A joint that closes a loop between two bodies."""
        self.loops.append((one, two, np.asarray(point, dtype=float), np.asarray(axis), kind))

    def urdf(self, home=None):
        """Its text, with a home posture by joint."""
        lines = ['<robot name="mechanism">', f'<link name="{GROUND}"/>']
        for name, (parent, slides, axis, limits, heavy) in self.joints.items():
            place = self.frames[parent].actInv(self.frames[name])
            turns = "revolute" if limits else "continuous"
            lines.append(
                f'<joint name="{name}" type="{"prismatic" if slides else turns}"'
                + (' independent="true"' if name in self.active else "")
                + f"><origin {_place(place)}/><parent link={parent!r}/><child link={name!r}/>"
                f'<axis xyz="{_numbers(self.frames[name].rotation.T @ axis)}"/>'
                + (
                    f'<limit lower="{limits[0]!r}" upper="{limits[1]!r}" effort="9" velocity="9"/>'
                    if limits
                    else ""
                )
                + f'</joint><link name="{name}">{_BODY if heavy else ""}</link>'
            )
        for i, (one, two, point, axis, kind) in enumerate(self.loops):
            at = pin.SE3(np.eye(3), point)
            ends = "".join(
                f'<{end} link="{body}"><origin {_place(self.frames[body].actInv(at))}/></{end}>'
                for end, body in (("predecessor", one), ("successor", two))
            )
            along = f'<axis xyz="{_numbers(axis)}"/>' if kind == "revolute" else ""
            lines.append(f'<loop name="loop{i}" type="{kind}">{ends}{along}</loop>')
        if home is not None:
            said = "".join(f'<joint name="{x}" value="{float(v)!r}"/>' for x, v in home.items())
            lines.append(f'<group_state name="home" group="all">{said}</group_state>')
        return "\n".join([*lines, "</robot>"])

    def start(self, random):
        """Any posture within limits, by joint; driven joints where they close."""
        return {
            name: 0.0
            if name in self.active
            else random.uniform(*(limits or ((-0.5, 0.5) if slides else (-np.pi, np.pi))))
            for name, (_, slides, _, limits, _) in self.joints.items()
        }


def _place(place):
    rpy = pin.rpy.matrixToRpy(place.rotation)
    return f'xyz="{_numbers(place.translation)}" rpy="{_numbers(rpy)}"'


def _flat(x, z):
    return np.array([x, 0.0, z])


def _spread(random, *centres):
    """Points of the plane about some centres."""
    return [_flat(*np.add(centre, random.uniform(-0.25, 0.25, 2))) for centre in centres]


def _four_bar(m, ground=GROUND, base=(0.0, 0.0), name="", driven=True):
    """Crank, coupler and rocker; the points of the coupler's pins and of its own eye."""
    x, z = base
    crank, rocker, one, two, eye = _spread(
        m.random, (x, z), (x + 1, z), (x + 0.1, z + 0.5), (x + 1.1, z + 0.8), (x + 0.6, z + 1.2)
    )
    m.body(f"{name}crank", ground, crank, driven=driven)
    m.body(f"{name}coupler", f"{name}crank", one)
    m.body(f"{name}rocker", ground, rocker)
    m.loop(f"{name}coupler", f"{name}rocker", two)
    return eye


def _dyad(m, one, at, two, foot, name):
    """Two more links from a point of one body to one of another."""
    (knee,) = _spread(m.random, ((at + foot) / 2 + _flat(0.4, 0.3))[[0, 2]])
    m.body(f"{name}link", one, at)
    m.body(f"{name}lever", two, foot)
    m.loop(f"{name}link", f"{name}lever", knee)
    return knee


def four_bar(m):
    """Four bars."""
    _four_bar(m)


def six_bar(m):
    """Watt's or Stephenson's, as it is drawn."""
    eye = _four_bar(m)
    (foot,) = _spread(m.random, (1.8, 0.1))
    _dyad(m, "coupler", eye, GROUND, foot, "a")


def eight_bar(m):
    """Another dyad on top."""
    eye = _four_bar(m)
    one, two = _spread(m.random, (1.8, 0.1), (2.8, 0.2))
    knee = _dyad(m, "coupler", eye, GROUND, one, "a")
    _dyad(m, "alever", (knee + one) / 2 + _flat(0.2, 0.1), GROUND, two, "b")


def _cylinder(m, one, foot, two, eye, name):
    """A cylinder between points of two bodies."""
    m.body(f"{name}barrel", one, foot)
    along = (eye - foot) / np.linalg.norm(eye - foot)
    m.body(f"{name}stroke", f"{name}barrel", foot, along, slides=True, driven=True)
    m.loop(f"{name}stroke", two, eye)


def crane(m):
    """Boom and stick, a cylinder each, and a linkage that the second one drives."""
    pin0, foot, eye, pin1, back, horn = _spread(
        m.random, (0, 1.5), (0.6, 0.4), (1.2, 2.0), (3, 2.5), (1.5, 2.6), (3.3, 3.1)
    )
    m.body("boom", GROUND, pin0)
    m.body("stick", "boom", pin1)
    _cylinder(m, GROUND, foot, "boom", eye, "lift_")
    _cylinder(m, "boom", back, "stick", horn, "tilt_")


def bucket(m):
    """A cylinder that turns a rocker, which turns a bucket by a link."""
    foot, rocker, bucket, eye, end = _spread(
        m.random, (0.5, 0.6), (2.2, 0), (3, 0), (2.1, 0.8), (3.1, 0.7)
    )
    m.body("rocker", GROUND, rocker)
    _cylinder(m, GROUND, foot, "rocker", eye, "")
    m.body("link", "rocker", eye)
    m.body("bucket", GROUND, bucket)
    m.loop("link", "bucket", end)


def _points(random, *centres):
    return [np.add(centre, random.uniform(-0.2, 0.2, 3)) for centre in centres]


def rssr(m):
    """Two cranks about any axes, and a rod between balls, one of them a cross."""
    one, two, crank, rocker = _points(
        m.random, (0.4, 0, 0.3), (1.2, 0.3, 0.9), (0, 0, 0), (1, 0.4, 0)
    )
    axes = m.random.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    m.body("crank", GROUND, crank, axes[0], driven=True)
    m.ball("rod", "crank", one, 2)
    m.body("rocker", GROUND, rocker, axes[1])
    m.loop("rod", "rocker", two, kind="spherical")


def rsur(m):
    """Likewise with the cross in the loop."""
    one, two, crank, rocker = _points(
        m.random, (0.4, 0, 0.3), (1.2, 0.3, 0.9), (0, 0, 0), (1, 0.4, 0)
    )
    turned = pin.Quaternion(m.random.normal(size=4)).normalized().toRotationMatrix()
    axes = m.random.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    m.body("crank", GROUND, crank, axes[0], driven=True)
    m.ball("rod", "crank", one)
    m.body("rocker", GROUND, rocker, axes[1])
    m.body("cross", "rocker", two, turned[:, 0])
    m.loop("rod", "cross", two, turned[:, 1])


def bennett(m):
    """Four pins, a / sin(alpha) = b / sin(beta); its turns p and q follow from each other.

    tan(p/2) tan(q/2) = sin((beta + alpha)/2) / sin((beta - alpha)/2).
    """
    alpha, beta = m.random.uniform(0.3, 0.8), m.random.uniform(1.0, 1.4)
    a, b = np.sin(alpha), np.sin(beta)
    first = m.random.uniform(0.6, 2.4)
    ratio = np.sin((beta + alpha) / 2) / np.sin((beta - alpha) / 2)
    second = 2 * np.arctan(ratio / np.tan(first / 2))
    place, places = pin.SE3.Identity(), []
    for angle, length, twist in (
        (first, a, alpha), (second, b, beta), (-first, a, alpha), (-second, b, beta)
    ):  # fmt: skip
        places.append(place)
        turn = pin.SE3(pin.utils.rotate("z", angle), np.zeros(3))
        place = place * turn * pin.SE3(pin.utils.rotate("x", twist), np.array([length, 0, 0]))
    assert np.abs(place.homogeneous - np.eye(4)).max() < 1e-12
    # axis 0 and 3 stand on the ground
    m.body("one", GROUND, places[0].translation, places[0].rotation[:, 2], driven=True)
    m.body("two", "one", places[1].translation, places[1].rotation[:, 2])
    m.body("three", "two", places[2].translation, places[2].rotation[:, 2])
    m.loop("three", GROUND, places[3].translation, places[3].rotation[:, 2])


def stewart(m):
    """Six legs of a cross, a slide and a ball; the first carries the platform."""
    around = np.arange(6) * np.pi / 3
    feet = np.column_stack([np.cos(around), np.sin(around), 0 * around])
    eyes = np.column_stack(
        [0.6 * np.cos(around + 0.5), 0.6 * np.sin(around + 0.5), 0 * around + 1]
    )
    feet, eyes = (x + m.random.uniform(-0.15, 0.15, (6, 3)) for x in (feet, eyes))
    for i, (foot, eye) in enumerate(zip(feet, eyes, strict=True)):
        m.ball(f"leg{i}_", GROUND, foot, 2)
        along = (eye - foot) / np.linalg.norm(eye - foot)
        m.body(f"stroke{i}", f"leg{i}_", foot, along, slides=True, driven=True)
        if i == 0:
            m.ball("platform", "stroke0", eye)
        else:
            m.loop(f"stroke{i}", "platform", eye, kind="spherical")


def platform(m):
    """Three legs of two links in the plane."""
    feet = _spread(m.random, (0, 0), (2, 0), (1, 1.8))
    eyes = _spread(m.random, (0.7, 0.5), (1.3, 0.5), (1, 1))
    for i, (foot, eye) in enumerate(zip(feet, eyes, strict=True)):
        (knee,) = _spread(m.random, ((foot + eye) / 2 + _flat(0.3, 0.2))[[0, 2]])
        m.body(f"upper{i}", GROUND, foot, driven=True)
        m.body(f"lower{i}", f"upper{i}", knee)
        if i == 0:
            m.body("plate", "lower0", eye)
        else:
            m.loop(f"lower{i}", "plate", eye)


def scissor(m):
    """Three stages of crossed bars over a foot that slides."""
    angle, length = m.random.uniform(0.5, 1.1), m.random.uniform(0.6, 1.2)
    wide, high = length * np.cos(angle), length * np.sin(angle)
    m.body("foot", GROUND, _flat(wide, 0), (1, 0, 0), slides=True, driven=True)
    left, right = GROUND, "foot"
    for i in range(3):
        m.body(f"rising{i}", left, _flat(0, i * high))
        m.body(f"falling{i}", right, _flat(wide, i * high))
        m.loop(f"rising{i}", f"falling{i}", _flat(wide / 2, (i + 0.5) * high))
        left, right = f"falling{i}", f"rising{i}"


def chain(m):
    """Three four-bar linkages, each on the coupler of the one before."""
    ground = GROUND
    for i in range(3):
        _four_bar(m, ground, (0.3 * i, 1.3 * i), f"{i}_")
        ground = f"{i}_coupler"


KINDS = {
    make.__name__: make
    for make in (
        four_bar, six_bar, eight_bar, crane, bucket, rssr, rsur, bennett, stewart, platform,
        scissor, chain,
    )
}  # fmt: skip


def drawn(kind, seed):
    """A mechanism of a kind, every second with limits on a third of its pins."""
    mechanism = Mechanism(np.random.default_rng([sorted(KINDS).index(kind), seed]))
    mechanism.limited = 1 / 3 if seed % 2 else 0.0
    KINDS[kind](mechanism)
    return mechanism
