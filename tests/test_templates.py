"""Templates of `crane new`: they load, run, have printed figures; a Z-bar linkage by hand."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import yaml
from command_line import typed

import crane
from crane.description import machine_templates

TEMPLATES = [(name, size) for name, sizes in machine_templates().items() for size in sizes]
ELECTRIC = ("delta", "fourbar")
QUICK = [("fourbar", "0.5m"), ("loader_zbar", "10t"), ("scissor_lift", "6m")]
# Printed figures, with their sources in the templates.
WEIGHTS = {  # [kg]
    ("excavator", "3t"): 3141, ("excavator", "10t"): 10182, ("excavator", "20t"): 21600,
    ("loader_zbar", "10t"): 11550, ("loader_zbar", "20t"): 19069, ("forwarder", "8t"): 8000,
    ("loader_parallel", "10t"): 12050,
}  # fmt: skip
RANGES = {  # [m]
    "3t": {"digging depth": 2.949, "reach at ground level": 5.110, "cutting height": 4.651,
           "dump height": 3.310},
    "20t": {"digging depth": 6.72, "reach at ground level": 9.845, "cutting height": 9.36,
            "dump height": 6.49, "depth of a 2.44 m level bottom": 6.55},
}  # fmt: skip
LOADER_RANGES = {  # [m], the reach before tyres of 0.745 m radius
    ("loader_zbar", "10t"): {"hinge pin height": 3.83, "dump height at 45 degrees": 2.85,
                             "dump reach at 45 degrees": 0.97 + 0.745},
    ("loader_zbar", "20t"): {"hinge pin height": 4.105},
    ("loader_parallel", "10t"): {"hinge pin height": 3.83},
}  # fmt: skip
DIGGING_FORCES = {"10t": (77.7e3, 49.2e3), "20t": (140.5e3, 106.7e3)}  # bucket, arm [N]


def template(name, size):
    return machine_templates()[name][size]


@cache
def written(name, size):
    """The content of a template."""
    return yaml.safe_load(template(name, size).read_text())


def load(name, size, **options):
    return crane.load(template(name, size), **options)


def test_templates_are_those_that_are_promised():
    sizes = {name: list(sizes) for name, sizes in machine_templates().items()}
    assert sizes == {
        "delta": ["1kg"], "excavator": ["3t", "10t", "20t"], "forwarder": ["8t"],
        "fourbar": ["0.5m"], "knuckle_boom": ["10tm"], "loader_parallel": ["5t", "10t"],
        "loader_zbar": ["10t", "20t"], "scissor_lift": ["6m"], "stewart": ["1t"],
        "telehandler": ["3t"],
    }  # fmt: skip
    listed = [line.split()[:2] for line in typed("new", "--list").stdout.splitlines()]
    assert listed == [list(each) for each in TEMPLATES]


def test_a_file_is_the_template_with_its_own_name(tmp_path):
    done = typed("new", "loader_zbar", "--size", "10t", "-o", "my loader.yaml", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "its numbers are those of loader_zbar 10t" in done.stdout
    assert "next: crane simulate 'my loader.yaml' --task load" in done.stdout
    original = template("loader_zbar", "10t").read_text()
    written = (tmp_path / "my loader.yaml").read_text()
    assert written == original.replace("name: loader_zbar_10t", "name: 'my_loader'")
    typed("new", "fourbar", cwd=tmp_path)  # one size, and its own name
    assert crane.load(tmp_path / "fourbar.yaml").name == "fourbar"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "error: no template, give one: delta, excavator, "),
        (["excavater"], "error: template 'excavater' is unknown, did you mean 'excavator'?"),
        (["excavator"], "error: no size, give one: --size 3t, 10t, 20t"),
        (["excavator", "--size", "9t"], "error: template 'excavator' has no size '9t', known: "),
        (["fourbar", "-o", "x.urdf"], "error: x.urdf: a machine file ends in .yaml, name it so"),
        (["fourbar", "-o", "is.yaml"], "error: is.yaml: exists already, choose another name or "),
    ],
)
def test_wrong_words_are_one_line(tmp_path, arguments, line):
    (tmp_path / "is.yaml").write_text("mine")
    done = typed("new", *arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(line) and done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["is.yaml"]
    assert (tmp_path / "is.yaml").read_text() == "mine"


def run_for_a_second(name, size):
    """Check a template, and simulate the first second of its task."""
    report = crane.check(template(name, size))
    assert report.findings == () and report.status == 0, report
    assert not [line for line in str(report).splitlines() if "strokes" in line]
    machine = load(name, size)
    assert (machine.hydraulics is None) == (name in ELECTRIC)
    (task,) = machine.tasks
    if machine.tasks[task].space == "joystick":
        control = crane.joystick(machine, task)
    else:
        reference = crane.task_trajectory(machine, task)
        kind = crane.control.default_controller_name(machine)
        control = crane.control.make_controller(kind, machine, reference)
    run = crane.simulate(machine, control, duration=1.0, step=0.01)
    assert np.isfinite(run.q).all() and run.time[-1] == 1.0
    assert max(np.ptp(run[joint]) for joint in machine.active) > 0.02


@pytest.mark.parametrize(("name", "size"), QUICK)
def test_a_template_runs(name, size):
    run_for_a_second(name, size)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), [each for each in TEMPLATES if each not in QUICK])
def test_every_template_runs(name, size):
    run_for_a_second(name, size)


@pytest.mark.parametrize(("name", "size"), WEIGHTS)
def test_weights_are_printed_ones(name, size):
    mass = sum(body.mass for body in load(name, size).model.inertias)
    assert mass == pytest.approx(WEIGHTS[name, size], rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("size", RANGES)
def test_excavators_reach_as_printed(size):
    found = crane.working_range(load("excavator", size))
    for name, printed in RANGES[size].items():
        assert found[name].value == pytest.approx(printed, rel=0.05), name


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), LOADER_RANGES)
def test_loaders_lift_and_dump_as_printed(name, size):
    found = crane.working_range(load(name, size), bucket="X_tilt")
    for term, printed in LOADER_RANGES[name, size].items():
        assert found[term].value == pytest.approx(printed, rel=0.05), term


def test_a_loader_breaks_out_as_printed():
    """100 mm behind the edge of the level bucket: 11 880 kg by the tilt cylinder."""
    found = crane.ratings.breakout(
        load("loader_zbar", "10t"), "behind", bucket="X_tilt", direction="up",
        at={"angle": 0.0, "height": 0.02},
    )  # fmt: skip
    assert found.bucket.isolated_force == pytest.approx(11880 * 9.80665, rel=0.05)
    assert found.bucket.force == found.bucket.isolated_force  # which the lift cylinders hold


@pytest.mark.parametrize("size", DIGGING_FORCES)
def test_excavators_dig_as_printed(size):
    found = crane.ratings.breakout(load("excavator", size))
    forces = found.bucket.isolated_force, found.arm.isolated_force
    assert forces == pytest.approx(DIGGING_FORCES[size], rel=0.05)


def test_a_forwarder_lifts_and_reaches_as_printed():
    """The lift cylinder's best lever is the shorter arm of its triangle: 84 kN m, 8 m."""
    drawing = written("forwarder", "8t")["drawing"]
    points = {name: np.array(place) for name, place in drawing["points"].items()}
    lever = np.linalg.norm(points["boom_eye"] - points["boom_foot"])
    assert 200e5 * np.pi / 4 * 0.110**2 * lever == pytest.approx(84e3, rel=0.05)
    boom = np.linalg.norm(points["outer_pin"] - points["boom_foot"])
    reach = boom + drawing["slides"]["telescope"]["longest"]
    machine = load("forwarder", "8t")
    straight = np.array([0.0, 0.2, 0.62, 2.25])  # X_outer and X_ext at their ends
    frames = (crane.Kinematics(machine, x) for x in ("boom_tip", "boom_boom_foot"))
    tip, foot = (frame.position(straight) for frame in frames)
    assert np.linalg.norm(tip - foot) == pytest.approx(8.0, rel=0.05)
    assert np.linalg.norm(tip - foot) < reach


@pytest.mark.slow
def test_a_telehandler_lifts_as_printed():
    """Level forks come to 7 m; 3.1 t go up with the telescope in."""
    machine = load("telehandler", "3t")
    pitch = crane.Kinematics(machine, "carriage")
    top = [x.limits.upper for x in (machine.tree.joints[j] for j in ("X_boom", "X_ext"))]
    tilts = np.linspace(0.0, 0.4, 401)
    strokes = np.array([[*top, tilt] for tilt in tilts])
    level = strokes[np.abs(pitch.rotation(strokes)[:, 0, 2]).argmin()]
    height = crane.Kinematics(machine, "fork").position(level)[2]
    assert height == pytest.approx(7.0, rel=0.05)
    locked = load("telehandler", "3t", lock={"X_ext": 0.0})
    chart = crane.capacity(locked, radii=[0.9, 1.4, 1.9], heights=[0.5, 2.0, 4.0])
    assert np.nanmin(chart.loads) > 3100


def test_a_scissor_lift_lifts_as_high_and_as_much_as_printed():
    machine = load("scissor_lift", "6m")
    top = [machine.tree.joints["X_lift"].limits.upper]
    height = crane.Kinematics(machine, "load").position(top)[2]
    assert height == pytest.approx(19 * 0.3048, rel=0.05)
    least, _ = crane.ratings.lift_chart(machine, ["X_lift"], "load").least_load()
    assert least > 230


def shoulders(place):
    """The angles of a delta robot's arms below level, by the circle of each elbow [rad].

    The rods swing sideways between the joints at their ends, which stay in the arm's plane.
    """
    drawn = {x: np.array(y) for x, y in written("delta", "1kg")["drawing"]["points"].items()}
    chain = ("shoulder_1", "elbow_1", "elbow_1_cross", "wrist_1_cross", "wrist_1")
    arm, above, rod, below = (np.linalg.norm(drawn[b] - drawn[a]) for a, b in pairwise(chain))
    found = []
    for name in ("1", "2", "3"):
        shoulder, wrist = drawn[f"shoulder_{name}"], drawn[f"wrist_{name}"]
        way = place + wrist - drawn["gripper"] - shoulder
        out = shoulder[:2] / np.linalg.norm(shoulder[:2])
        u, h = way[:2] @ out, way[2]
        side = np.sqrt(way @ way - u**2 - h**2)
        reach = above + np.sqrt(rod**2 - side**2) + below
        cosine = (u**2 + h**2 + arm**2 - reach**2) / 2 / arm / np.hypot(u, h)
        found.append(np.arctan2(-h, u) - np.arccos(cosine))
    return np.array(found)


def test_a_delta_robot_works_within_the_printed_circle():
    """A diameter of 1130 mm over 250 mm, as large as the limits of the arms permit."""
    machine = load("delta", "1kg")
    limits = [machine.tree.joints[x].limits for x in machine.active]
    lower, upper = np.array([[x.lower, x.upper] for x in limits]).T
    home = shoulders(np.array(written("delta", "1kg")["drawing"]["points"]["gripper"]))
    around = 2 * np.pi * np.arange(36) / 36

    def fits(radius, heights=(0.46, 0.71)):
        rows = [
            shoulders(np.array([radius * np.cos(a), radius * np.sin(a), z])) - home
            for a in around for z in heights
        ]  # fmt: skip
        return (lower <= rows).all() and (rows <= upper).all()

    assert fits(0.95 * 0.565) and not fits(1.05 * 0.565)
    place = np.array([0.3, -0.2, 0.5])
    gripper = crane.Kinematics(machine, "gripper")
    assert gripper.position(shoulders(place) - home) == pytest.approx(place, abs=1e-5)


# --- the Z-bar linkage by hand


class ZBar:
    """A loader's pins as complex numbers, from circles, and the forces that hold it."""

    def __init__(self, size, lift, tilt):
        drawing = written("loader_zbar", size)["drawing"]
        drawn = self.drawn = {
            name: complex(place[0], place[-1]) for name, place in drawing["points"].items()
        }
        cylinders = drawing["cylinders"]
        lift, tilt = (
            cylinders[x]["shortest"] + y for x, y in (("X_lift", lift), ("X_tilt", tilt))
        )
        boom = self._turn("boom_foot", "lift_eye", drawn["lift_base"], lift, drawn["boom_foot"])
        at = self.at = {"boom_foot": drawn["boom_foot"], "lift_base": drawn["lift_base"],
                        "tilt_base": drawn["tilt_base"]}  # fmt: skip
        for name in ("lift_eye", "lever_pin", "bucket_pin"):
            at[name] = self._placed(name, "boom_foot", boom)
        crank = self._turn("lever_pin", "lever_top", drawn["tilt_base"], tilt, at["lever_pin"])
        for name in ("lever_top", "lever_bottom"):
            at[name] = self._placed(name, "lever_pin", crank)
        length = abs(drawn["bucket_eye"] - drawn["lever_bottom"])
        bucket = self._turn(
            "bucket_pin", "bucket_eye", at["lever_bottom"], length, at["bucket_pin"],
            drawn["lever_bottom"],
        )  # fmt: skip
        for name in ("bucket_eye", "edge"):
            at[name] = self._placed(name, "bucket_pin", bucket)
        self.turns = {"boom": boom, "bellcrank": crank, "bucket": bucket}

    def _turn(self, pivot, end, other, length, centre, drawn_other=None):
        """The angle by which an arm turns until its end is so far from a point."""
        arm = self.drawn[end] - self.drawn[pivot]
        before = (other if drawn_other is None else drawn_other) - self.drawn[pivot]
        side = np.sign((arm * before.conjugate()).imag)
        way = other - centre
        cosine = (abs(way) ** 2 + abs(arm) ** 2 - length**2) / (2 * abs(way) * abs(arm))
        turn = np.angle(way / arm) + side * np.arccos(cosine)
        return (turn + np.pi) % (2 * np.pi) - np.pi

    def _placed(self, name, pivot, turn):
        return self.at[pivot] + (self.drawn[name] - self.drawn[pivot]) * np.exp(1j * turn)

    def sines(self):
        """Of the angles between two bars, which are 0 at a dead centre."""
        bars = (
            ("lever_top", "lever_pin", "tilt_base"), ("lever_bottom", "lever_pin", "bucket_eye"),
            ("bucket_eye", "bucket_pin", "lever_bottom"), ("lift_eye", "boom_foot", "lift_base"),
        )  # fmt: skip
        ways = [(self.at[a] - self.at[x], self.at[b] - self.at[x]) for x, a, b in bars]
        return [abs((a * b.conjugate()).imag) / abs(a) / abs(b) for a, b in ways]

    def forces(self, loads, weights=()):
        """Pushes of lift and tilt cylinder that hold loads, by equilibrium of every body.

        Unknown are the forces of eleven pins, (x, z) each: of the boom, the bellcrank and the
        bucket on their pins, of the eyes of both cylinders, and along the link. Each of these
        three bodies has three equations, each cylinder one, of moments about its base.

        Args:
            loads: (body, place, force as complex number).
            weights: Of cylinders: (name, part, place, weight [N]).
        """
        at, names = self.at, ("foot", "lever", "bucket", "lift", "tilt")
        along = at["bucket_eye"] - at["lever_bottom"]
        along /= abs(along)
        on = {  # what acts on a body: unknown, sign, place
            "boom": [("foot", 1, "boom_foot"), ("lever", -1, "lever_pin"),
                     ("bucket", -1, "bucket_pin"), ("lift", 1, "lift_eye")],
            "bellcrank": [("lever", 1, "lever_pin"), ("tilt", 1, "lever_top")],
            "bucket": [("bucket", 1, "bucket_pin")],
        }  # fmt: skip
        link = {"bellcrank": (-along, "lever_bottom"), "bucket": (along, "bucket_eye")}
        a, b, row = np.zeros((11, 11)), np.zeros(11), 0
        for body, acting in on.items():
            for name, sign, place in acting:
                k = 2 * names.index(name)
                a[row, k], a[row + 1, k + 1] = sign, sign
                a[row + 2, k : k + 2] = -sign * at[place].imag, sign * at[place].real
            if body in link:
                force, place = link[body]
                moment = (at[place].conjugate() * force).imag
                a[row : row + 3, 10] = force.real, force.imag, moment
            for loaded, place, force in loads:
                if loaded == body:
                    moment = (place.conjugate() * force).imag
                    b[row : row + 3] -= force.real, force.imag, moment
            row += 3
        ends = {"lift": ("lift_base", "lift_eye"), "tilt": ("tilt_base", "lever_top")}
        for name, (base, eye) in ends.items():  # the eye pushes back on the cylinder
            k, arm = 2 * names.index(name), at[eye] - at[base]
            a[row, k : k + 2] = arm.imag, -arm.real
            b[row] = sum((p - at[base]).real * w for who, _, p, w in weights if who == name)
            row += 1
        found, pushes = np.linalg.solve(a, b), []
        for name, (base, eye) in ends.items():
            k, arm = 2 * names.index(name), at[eye] - at[base]
            arm /= abs(arm)
            push = (complex(*found[k : k + 2]) * arm.conjugate()).real
            rod = sum(w for who, part, _, w in weights if (who, part) == (name, "rod"))
            pushes.append(push + rod * arm.imag)
        return np.array(pushes)


def zbar_strokes(size, count):
    """Random strokes of lift and tilt (count, 2)."""
    cylinders = written("loader_zbar", size)["drawing"]["cylinders"]
    spans = [cylinders[x]["longest"] - cylinders[x]["shortest"] for x in ("X_lift", "X_tilt")]
    return np.random.default_rng(3).uniform(0, spans, (count, 2)), np.array(spans)


@pytest.mark.parametrize("size", machine_templates()["loader_zbar"])
def test_a_zbar_holds_its_weight_as_equilibrium_of_its_bodies_says(size):
    machine = load("loader_zbar", size)
    dynamics, gravity = crane.Dynamics(machine), 9.81
    links = {name: link.inertial for name, link in machine.tree.links.items() if link.inertial}
    pivots = {"boom": "boom_foot", "bellcrank": "lever_pin", "bucket": "bucket_pin"}
    for strokes in zbar_strokes(size, 8)[0]:
        hand = ZBar(size, *strokes)
        place = {name: centre(machine, name, strokes) for name in links}
        loads = [(name, place[name], -1j * gravity * links[name].mass) for name in pivots]
        link = place["link"]  # a thin bar: half of its weight at each end
        assert link == pytest.approx((hand.at["lever_bottom"] + hand.at["bucket_eye"]) / 2)
        half = -1j * gravity * links["link"].mass / 2
        loads += [("bellcrank", hand.at["lever_bottom"], half)]
        loads += [("bucket", hand.at["bucket_eye"], half)]
        weights = [
            (name, part, place[f"X_{name}_{part}"], gravity * links[f"X_{name}_{part}"].mass)
            for name in ("lift", "tilt")
            for part in ("barrel", "rod")
        ]
        found = dynamics.gravity(strokes)
        assert hand.forces(loads, weights) == pytest.approx(found, rel=1e-9)


def centre(machine, name, q_a):
    """Centre of mass of a link as a complex number."""
    frame = crane.Kinematics(machine, name)
    com = np.array(machine.tree.links[name].inertial.com)
    return complex(*(frame.position(q_a) + frame.rotation(q_a) @ com)[[0, 2]])


@pytest.mark.parametrize("size", machine_templates()["loader_zbar"])
def test_a_zbar_breaks_out_as_equilibrium_of_its_bodies_says(size):
    machine = load("loader_zbar", size)
    one = crane.ratings.breakout(machine, bucket="X_tilt").bucket
    hand = ZBar(size, *one.lever)
    arm = hand.at["edge"] - hand.at["bucket_pin"]
    push = hand.forces([("bucket", hand.at["edge"], -1j * arm / abs(arm))])[1]
    cylinder = machine.hydraulics.cylinders["X_tilt"]
    supply = written("loader_zbar", size)["hydraulics"]["supply"]
    pressure = float(supply["pressure"].split()[0]) * 1e5
    working = pressure * cylinder.area_a - 1e5 * cylinder.area_b
    assert one.isolated_force == pytest.approx(working / abs(push), rel=1e-9)
    assert one.isolated_force == pytest.approx({"10t": 104e3, "20t": 165e3}[size], rel=0.02)


@pytest.mark.parametrize("size", machine_templates()["loader_zbar"])
def test_a_zbar_keeps_its_bucket_level_and_has_no_dead_centre(size):
    machine = load("loader_zbar", size)
    strokes, spans = zbar_strokes(size, 20)
    q = machine.closure.solve(strokes)
    for row, each in zip(q, strokes, strict=True):
        turns = ZBar(size, *each).turns  # of the bucket from level; of crane from boom to bucket
        bucket = row[machine.column("boom_foot")] + row[machine.column("bucket_pin")]
        assert bucket == pytest.approx(turns["bucket"], abs=1e-9)
    home = np.array([machine.home[machine.column(x)] for x in ("X_lift", "X_tilt")])
    lifts = np.linspace(home[0], spans[0], 40)
    level = np.rad2deg([ZBar(size, lift, home[1]).turns["bucket"] for lift in lifts])
    assert level[0] == pytest.approx(0, abs=1e-9) and level.min() >= 0 and level.max() < 7.5
    grid = np.stack(np.meshgrid(*(np.linspace(0, x, 21) for x in spans)), axis=-1).reshape(-1, 2)
    angles = np.rad2deg(np.arcsin([ZBar(size, *each).sines() for each in grid]))
    assert angles.min() > 17
    rolled, dumped = ZBar(size, home[0], spans[1]), ZBar(size, spans[0], 0.0)
    back, out, height = {"10t": (47, -48, 3.83), "20t": (41, -45.5, 4.2)}[size]
    assert np.rad2deg(rolled.turns["bucket"]) == pytest.approx(back, abs=2)
    assert np.rad2deg(dumped.turns["bucket"]) == pytest.approx(out, abs=3)
    assert dumped.at["bucket_pin"].imag == pytest.approx(height, rel=1e-3)


@pytest.mark.parametrize("size", machine_templates()["loader_parallel"])
def test_a_parallel_lift_keeps_forks_level(size):
    machine = load("loader_parallel", size)
    lift = machine.tree.joints["X_lift"].limits.upper
    home = [machine.home[machine.column(x)] for x in ("X_lift", "X_tilt")]
    lifts = np.linspace(home[0], lift, 50)
    strokes = np.column_stack([lifts, np.full(50, home[1])])
    rotation = crane.Kinematics(machine, "bucket").rotation(strokes)
    assert np.rad2deg(np.abs(np.arcsin(rotation[:, 0, 2]))).max() < 3
