"""Cylinders added to open machines: steel, mounting points, and the closed machine."""

import os
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from command_line import typed
from excavators import FOLD, LIFT, planar, spatial
from oracles import SliderCrank
from warned import told as told_by

import crane
from crane.common.errors import CraneError
from crane.formats.steel_cylinder import RELIEF_PRESSURE, SteelCylinder

ZX200 = Path(__file__).parents[2] / "shared/data/third_party/zx200/zx200.xacro"

pytestmark = pytest.mark.filterwarnings("ignore::crane.CraneWarning")


def eyes_apart(machine, name, q):
    """(N,) from the pin of a cylinder's barrel to the eye on the other body, by frames."""
    data, found = machine.model.createData(), []
    for posture in np.atleast_2d(q):
        pin.forwardKinematics(machine.model, data, posture)
        one, two = (
            pin.updateFramePlacement(machine.model, data, machine.frame(f"{name}_{end}"))
            for end in ("barrel", "eye")
        )
        found.append(np.linalg.norm(two.translation - one.translation))
    return np.array(found)


def covered(machine, names, rng, count=50):
    """(N, n) coordinates, cylinders within the middle of their stroke."""
    home = machine.home[machine.closure.active]
    q_a = np.tile(home, (count, 1))
    for name in names:
        i = machine.active.index(name)
        end = min(machine.upper[i], home[i] + 0.3)
        q_a[:, i] = rng.uniform(home[i], end, count)
    return q_a


def energy_of(run):
    energy = run.channels["kinetic"] + run.channels["potential"] + run.channels["dissipated"]
    return np.ptp(energy) / np.ptp(run.channels["kinetic"])


# --- steel -------------------------------------------------------------------------------------


@pytest.mark.parametrize("retracted", [1.74, 1.5, 2.4])
def test_masses_are_those_of_the_shapes(retracted):
    """Cut into thin slices along x, whichever part they belong to."""
    bore, rod, stroke = 0.12, 0.085, 1.26
    steel = SteelCylinder.from_dimensions(bore, rod, stroke, retracted)
    e = min(bore, (retracted - stroke) / 4)
    assert steel.part_length == pytest.approx(e, rel=1e-15)
    x = (np.arange(40_000) + 0.5) * retracted / 40_000
    area, second = np.zeros((2, 2, x.size))  # of barrel and rod, per slice
    for body, (start, end, inner, outer) in (
        (0, (0, retracted - e, bore, 1.2 * bore)), (0, (0, e, 0, bore)),
        (0, (retracted - 2 * e, retracted - e, rod, bore)),
        (1, (e, 2 * e, 0, bore)), (1, (2 * e, retracted, 0, rod)),
    ):  # fmt: skip
        inside = (x > start) & (x < end)
        area[body] += inside * np.pi / 4 * (outer**2 - inner**2)
        second[body] += inside * np.pi / 64 * (outer**4 - inner**4)
    for body, (found, eye) in enumerate(
        ((steel.barrel_inertia, 0.0), (steel.rod_inertia, retracted))
    ):
        line = 7850.0 * area[body] * (x[1] - x[0])
        com = line @ x / line.sum()
        across = line @ (x - com) ** 2 + 7850.0 * second[body].sum() * (x[1] - x[0])
        about = 2 * 7850.0 * second[body].sum() * (x[1] - x[0])
        assert found.mass == pytest.approx(line.sum(), rel=2e-3)
        assert found.lever[0] + eye == pytest.approx(com, rel=2e-3)
        assert found.inertia[1, 1] == found.inertia[2, 2] == pytest.approx(across, rel=4e-3)
        assert found.inertia[0, 0] == pytest.approx(about, rel=2e-3)
    # the piston runs from the cap to the gland
    assert 2 * e + stroke <= retracted - 2 * e + 1e-12
    assert steel.max_force == pytest.approx(RELIEF_PRESSURE * np.pi / 4 * bore**2)


# --- machines ----------------------------------------------------------------------------------


@pytest.fixture
def closed(tmp_path):
    """The planar digger with both cylinders, by two calls."""
    planar(tmp_path)
    crane.formats.add_cylinder(
        tmp_path / "digger.urdf", name="hoist", out=tmp_path / "d.yaml", **LIFT
    )
    crane.formats.add_cylinder(
        tmp_path / "d.yaml", name="crowd", out=tmp_path / "d.yaml", force=True, **FOLD
    )
    return crane.load(tmp_path / "d.yaml")


def test_an_open_digger_becomes_a_closed_one(closed, tmp_path):
    assert closed.active == ("hoist", "crowd") and closed.free == ()
    assert closed.undriven_joints == ()
    assert [loop.type for loop in closed.closure.equations.loops] == ["revolute"] * 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d", "d.yaml", "digger.urdf"]
    rng = np.random.default_rng(3)
    q_a = covered(closed, closed.active, rng)
    q = closed.closure.solve(q_a)
    assert max(closed.closure.residual(one) for one in q) < 1e-13
    for name, given in (("hoist", LIFT), ("crowd", FOLD)):
        retracted = given.get("dead_length", given["stroke"] + 4 * given["bore"])
        stroke = q[:, closed.column(name)]
        assert eyes_apart(closed, name, q) == pytest.approx(retracted + stroke, abs=1e-13)
        lower, upper = (x[closed.active.index(name)] for x in (closed.lower, closed.upper))
        assert (lower, upper) == (0.0, given["stroke"])
    assert closed.home[closed.column("lift")] == pytest.approx(0.0, abs=1e-14)
    assert closed.home[closed.column("fold")] == 0.5  # the limit nearest to zero
    report = crane.check(tmp_path / "d.yaml")
    assert report.status == 0, [str(one) for one in report.findings]


def test_the_force_of_the_boom_cylinder_by_moments(closed):
    """Gravity moments about the boom's pin, with the weight of the cylinder between two pins."""
    dynamics = crane.Dynamics(closed)
    q_a = covered(closed, closed.active, np.random.default_rng(5), 7)
    for sample, q in zip(q_a, closed.closure.solve(q_a), strict=True):
        data = closed.model.createData()
        pin.forwardKinematics(closed.model, data, q)

        def at(link, point=(0, 0, 0), data=data):
            place = pin.updateFramePlacement(closed.model, data, closed.frame(link))
            return place.act(np.array(point, dtype=float))[[0, 2]]

        weights = {
            link.name: (at(link.name, link.inertial.com), 9.81 * link.inertial.mass)
            for link in closed.tree.links.values()
            if link.inertial
        }
        pivot, foot, eye = at("boom"), at("hoist_barrel"), at("hoist_eye")
        axis = (eye - foot) / np.linalg.norm(eye - foot)
        normal = np.array([-axis[1], axis[0]])
        own = ("hoist_barrel", "hoist_rod")
        pull = sum((place - pivot)[0] * w for k, (place, w) in weights.items() if k not in own)
        # the eye carries what of the cylinder's weight does not go into its foot
        across = sum((weights[k][0] - foot)[0] * weights[k][1] for k in own)
        across /= np.linalg.norm(eye - foot)
        arm = eye - pivot

        def turned(force, arm=arm):  # moment that lifts
            return arm[0] * force[1] - arm[1] * force[0]

        push = (pull + across * turned(normal)) / turned(axis)
        push += weights["hoist_rod"][1] * axis[1]
        assert dynamics.gravity(sample)[0] == pytest.approx(push, rel=1e-12)


def test_without_weight_it_is_the_open_machine(tmp_path):
    """With very light cylinders the machine moves as the open one does."""
    first = crane.load(planar(tmp_path))
    for name, given, before in (("hoist", LIFT, "digger.urdf"), ("crowd", FOLD, "a.yaml")):
        length = given.get("dead_length", given["stroke"] + 4 * given["bore"])
        crane.formats.add_cylinder(
            tmp_path / before, given["between"], 1e-5, 5e-6, given["stroke"],
            name=name, dead_length=length, out=tmp_path / "a.yaml", force=True,
        )  # fmt: skip
    again = crane.load(tmp_path / "a.yaml").with_active_joints(["lift", "fold"])
    q_a = np.random.default_rng(0).uniform([-0.4, 0.6], [0.2, 1.8], (20, 2))
    one, two = crane.Dynamics(first), crane.Dynamics(again)
    v, a = 0.3 * q_a, 1 - q_a
    assert two.inverse(q_a, v, a) == pytest.approx(one.inverse(q_a, v, a), rel=1e-6)
    assert two.mass_matrix(q_a) == pytest.approx(one.mass_matrix(q_a), rel=1e-6)


@pytest.mark.slow
def test_in_space_the_barrel_has_a_universal_joint(tmp_path):
    """Mounting points beside the boom's plane, and between bodies that turn about two axes."""
    given = [
        ("hoist", ["house:0.9,0.4,0.1", "boom:1.9,0.2,0.3"], 0.1, 0.9, None),
        ("side", ["boom:2.6,0.4,0", "post:0.1,0.35,0.2"], 0.06, 0.4, 1.3),
        ("crowd", ["boom:1.5,0,0.9", "arm:-0.6,0,0.1"], 0.1, 1.2, None),
    ]
    before = spatial(tmp_path)
    for name, between, bore, stroke, dead in given:
        added = crane.formats.add_cylinder(
            before, between, bore, bore / 2, stroke,
            name=name, dead_length=dead, out=tmp_path / "s.yaml", force=True,
        )  # fmt: skip
        before = added.path
    assert added.joint == "fold"  # which it changes more than the swing, that is passive by now
    machine = crane.load(tmp_path / "s.yaml")
    assert machine.active == ("slew", "hoist", "side", "crowd")
    assert [x.type for x in machine.closure.equations.loops][1:] == ["spherical"] * 2
    q_a = covered(machine, ("side",), np.random.default_rng(2))
    q_a[:, 1] += np.random.default_rng(3).uniform(0, 0.3, len(q_a))
    q = machine.closure.solve(q_a)
    assert max(machine.closure.residual(one) for one in q) < 1e-13
    stroke = q[:, machine.column("side")]
    assert eyes_apart(machine, "side", q) == pytest.approx(1.3 + stroke, abs=1e-12)
    assert machine.closure.degrees_of_freedom == 4
    assert energy_of(crane.simulate(machine, lambda t, q, v: 0 * q, duration=0.3)) < 1e-9


def test_two_cylinders_on_one_boom_share_its_load(tmp_path):
    path = planar(tmp_path)
    one = crane.formats.add_cylinder(path, name="left", out=tmp_path / "d.yaml", **LIFT)
    assert one.joint == "lift" and not one.shares_load
    two = crane.formats.add_cylinder(one.path, name="right", out=tmp_path / "d2.yaml", **LIFT)
    assert two.joint == "left" and two.shares_load
    assert str(two).startswith("right shares the load on left from 0 to 0.9 m")
    machine = crane.load(two.path)
    assert machine.active == ("left", "fold")
    assert [drive.name for drive in machine.drives] == ["left", "fold", "right"]
    dynamics = crane.Dynamics(machine)
    q_a = machine.home[machine.closure.active]
    forces = dynamics.drive_forces(q_a, dynamics.gravity(q_a))
    assert forces[0] == pytest.approx(forces[2], rel=1e-12)


@pytest.mark.parametrize("kind", ["mjcf", "urdf+", "machine"])
def test_any_format_goes_in(kind, tmp_path):
    if kind == "mjcf":
        pytest.importorskip("mujoco")
    machine = crane.load(planar(tmp_path))
    first = {
        "mjcf": lambda: (
            crane.formats.write_mjcf(machine, tmp_path / "m.xml") or tmp_path / "m.xml"
        ),
        "urdf+": lambda: (
            crane.formats.write_urdf_plus(machine, tmp_path / "m.urdf") or tmp_path / "m.urdf"
        ),
        "machine": lambda: crane.write_machine(machine, tmp_path / "m"),
    }[kind]()
    added = crane.formats.add_cylinder(first, name="hoist", out=tmp_path / "out.yaml", **LIFT)
    closed = crane.load(added.path)
    assert closed.active == ("hoist", "fold")
    assert eyes_apart(closed, "hoist", closed.home)[0] == pytest.approx(
        1.3 + closed.home[closed.column("hoist")], abs=1e-12
    )


def test_an_eye_beside_the_plane_moves_along_its_pin(tmp_path):
    between = ["house:0.6,0.02,0.7", "boom:1.9,-0.03,0.3"]
    added = crane.formats.add_cylinder(
        planar(tmp_path), **LIFT | {"between": between}, out=tmp_path / "d.yaml"
    )
    (note,) = added.notes
    assert note == "the rod's eye moved 50 mm along its pin, into the plane of the barrel's"
    assert crane.load(added.path).closure.equations.loops[0].type == "revolute"


def test_axes_that_are_parallel_to_few_digits_get_a_universal_joint(tmp_path):
    """A surplus equation would not hold to rounding, a universal joint has none."""
    path = planar(tmp_path, rpy="1e-6 0 0")
    path.write_text(path.read_text().replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 1e-6"/>', 1))
    given = {"between": ["house:0.6,0,0.7", "arm:0.3,0,0.1"], "bore": 0.1, "rod": 0.05}
    added = crane.formats.add_cylinder(
        path, **given, stroke=2.0, dead_length=2.5, out=tmp_path / "d.yaml"
    )
    machine = crane.load(added.path)
    assert machine.closure.equations.loops[0].type == "spherical"
    assert machine.closure.residual(machine.home) < 1e-13


def test_of_two_joints_it_drives_the_one_it_moves_best(tmp_path):
    """From the house to the arm: whichever stays active, the loop closes and says so."""
    given = {"between": ["house:0.6,0,0.7", "arm:-0.5,0,0.35"], "bore": 0.1, "rod": 0.06}
    added = crane.formats.add_cylinder(
        planar(tmp_path), **given, stroke=2.0, dead_length=2.1, out=tmp_path / "d.yaml"
    )
    assert added.joint == "lift"
    assert added.notes[0] == "fold stays driven: of them and lift the cylinder drives lift best"
    machine = crane.load(added.path)
    assert machine.active == ("cylinder", "fold")
    other = machine.with_active_joints(["cylinder", "lift"])  # the choice that was not taken
    conditions = [float(m.closure.condition_number(m.home)) for m in (machine, other)]
    assert conditions[0] < conditions[1]


def test_home_goes_where_the_cylinder_fits(tmp_path):
    """At the zero configuration the mounting points are closer than the retracted cylinder."""
    given = LIFT | {"stroke": 0.6, "dead_length": 1.8}
    added, told = told_by(
        crane.formats.add_cylinder,
        planar(tmp_path),
        name="hoist",
        out=tmp_path / "d.yaml",
        **given,
    )
    machine = crane.load(added.path)
    stroke = machine.home[machine.column("hoist")]
    assert 0 <= stroke <= 0.01 and machine.home[machine.column("lift")] < -0.09
    assert added.notes == ("home: lift at -0.099, where the cylinder fits",)
    (line,) = told
    assert line.startswith("'lift' moves from -1.1 to 0.2 rad, and a cylinder of 1.8 to 2.4 m dri")


def test_its_ends_are_where_the_stroke_ends(tmp_path):
    """By the law of cosines about the pin, at radii a and b: L^2 = a^2 + b^2 - 2 a b cos."""
    a, b = np.hypot(0.6, 0.8), np.hypot(1.9, 0.3)
    added, told = told_by(
        crane.formats.add_cylinder, planar(tmp_path), out=tmp_path / "d.yaml", **LIFT
    )

    def lift(length):
        angle = np.arccos((a**2 + b**2 - length**2) / (2 * a * b))
        return angle - np.arctan2(0.8, 0.6) - np.arctan2(0.3, 1.9)

    def lever(value):
        angle = value + np.arctan2(0.8, 0.6) + np.arctan2(0.3, 1.9)
        return a * b * np.sin(angle) / np.sqrt(a**2 + b**2 - 2 * a * b * np.cos(angle))

    low, high = added.driven_range
    assert low == pytest.approx(-lift(2.2), abs=1e-8) and high == 0.2
    assert added.stroke_range[0] == 0.9 and 0 < added.stroke_range[1] < 0.9
    values = -np.linspace(low, high, 20001)
    assert added.lever_arm_range == pytest.approx(
        (lever(values).min(), lever(values).max()), rel=1e-5
    )
    assert f"drives it from {low:.4g} to {high:.4g}: its eyes" in told[0]


@pytest.mark.parametrize("along", [0.2, 0.35])
def test_its_ends_are_dead_centres_where_these_come_first(tmp_path, along):
    """Where both eyes and the pin between them lie on a line."""
    eyes = ["house:0.6,0,1.5", f"boom:-1.0,0,{along}"]
    steel = {"bore": 0.1, "rod": 0.07, "stroke": 1.2, "dead_length": 1.35}
    added, told = told_by(
        crane.formats.add_cylinder, planar(tmp_path), eyes, out=tmp_path / "d.yaml", **steel
    )
    dead = -np.arctan2(along, 1.0)
    assert dead in [pytest.approx(x, abs=1e-6) for x in added.driven_range]
    assert f"with a dead centre at {dead:.4g}: its" in told[0]


@pytest.mark.slow
def test_its_ends_are_where_the_machine_closes(tmp_path):
    """The stroke of a slider ends where its crank and rod are in line."""
    data = Path(__file__).parent / "data"
    text = (data / "slider_crank.yaml").read_text().replace("urdf: ", f"urdf: {data}/")
    (tmp_path / "s.yaml").write_text(text.replace("active: [theta]", "active: [s]"))
    reach = np.sqrt((SliderCrank.r + SliderCrank.rod) ** 2 - SliderCrank.e**2)
    eyes = ["base:-0.5,0,0.3", "slider"]
    steel = {"bore": 0.05, "rod": 0.03, "stroke": 0.3, "dead_length": 0.65}
    added = crane.formats.add_cylinder(tmp_path / "s.yaml", eyes, out=tmp_path / "d.yaml", **steel)
    assert added.driven_range == pytest.approx((0.15, reach), abs=1e-6)
    assert added.limits[1] == pytest.approx(reach, abs=1e-8)
    assert added.stroke_range == pytest.approx((0.0, reach - 0.15), abs=1e-6)
    assert added.lever_arm_range == pytest.approx((1.0, 1.0))


def test_strokes_beyond_a_dead_centre_are_told(tmp_path):
    given = FOLD | {"between": ["boom:1.5,0,0.9", "arm:-0.6,0,0.1"], "stroke": 1.2}
    given["dead_length"] = 1.64
    _, told = told_by(
        crane.formats.add_cylinder, planar(tmp_path), out=tmp_path / "e.yaml", **given
    )
    assert any("the linkage does not close at 0 to 0.40" in line for line in told)
    machine = crane.load(tmp_path / "e.yaml")
    q_a = machine.home[machine.closure.active]
    q_a[1] = 0.41
    machine.closure.solve(q_a)
    q_a[1] = 0.405
    with pytest.raises(CraneError):
        machine.closure.solve(q_a)


def test_machines_lighter_than_their_cylinder_are_told(tmp_path):
    """Placeholder masses in a file are reported, since only the steel would have weight."""
    path = planar(tmp_path)
    path.write_text(path.read_text().replace('mass value="800.0"', 'mass value="0.03"'))
    lift, fold = LIFT | {"name": "hoist"}, FOLD | {"name": "crowd"}
    _, told = told_by(crane.formats.add_cylinder, path, out=tmp_path / "d.yaml", **lift)
    assert not any("weighs" in line for line in told)  # it moves the arm as well
    path.write_text(re.sub('mass value=".*?"', 'mass value="0.03"', path.read_text()))
    _, told = told_by(crane.formats.add_cylinder, path, out=tmp_path / "e.yaml", **lift)
    assert told[-1] == (
        "the cylinder weighs 81.26 kg, and all that 'lift' moves 0.06 kg: forces are little more "
        "than its own weight, give the bodies the masses of the real machine"
    )
    _, told = told_by(crane.formats.add_cylinder, path, out=tmp_path / "f.yaml", **fold)
    assert "all that 'fold' moves 0.03 kg" in told[-1]


def test_a_joint_without_limits_takes_those_of_its_cylinder(tmp_path):
    path = planar(tmp_path)
    path.write_text(path.read_text().replace('"lift" type="revolute"', '"lift" type="continuous"'))
    added, told = told_by(crane.formats.add_cylinder, path, out=tmp_path / "d.yaml", **LIFT)
    assert not told
    machine = crane.load(added.path)
    lift = machine.closure.solve([[0.0, 1.0], [0.9, 1.0]])[:, machine.column("lift")]
    foot, eye = np.array([0.6, -0.8]), np.array([1.9, 0.3])  # from the pin of the boom
    a, b, length = np.linalg.norm(foot), np.linalg.norm(eye), np.array([1.3, 2.2])
    angle = np.arccos((a**2 + b**2 - length**2) / (2 * a * b))  # by the law of cosines
    assert abs(lift[1] - lift[0]) == pytest.approx(angle[1] - angle[0])
    assert added.length_range[0] < length[0] and added.length_range[1] > length[1]


def test_what_belonged_to_the_joint_is_left_out(tmp_path):
    planar(tmp_path)
    (tmp_path / "m.yaml").write_text(
        "name: m\nchains:\n  - {name: all, urdf: digger.urdf}\nactive: [lift]\nfree: [fold]\n"
        "home: {fold: 0.6}\ncontrol:\n  lift: {kp: 5, ki: 1}\nfriction:\n  lift: {viscous: 3}\n"
        "tip: tip\ntasks:\n  up: {duration: 1, active: {lift: [0]}}\n"
        "  over: {duration: 1, tip: {x: [5], y: [0], z: [2]}}\n"
    )
    added, told = told_by(
        crane.formats.add_cylinder,
        tmp_path / "m.yaml",
        name="hoist",
        out=tmp_path / "n.yaml",
        **LIFT,
    )
    assert any("m: gains, tasks of active joints belonged to the active joints" in x for x in told)
    machine = crane.load(added.path)
    assert (machine.active, machine.free) == (("hoist", "fold"), ("fold",))
    assert list(machine.tasks) == ["over"] and not machine.control
    assert machine.friction["lift"].viscous == 3


# --- what is refused ---------------------------------------------------------------------------

REFUSED = {
    "unknown frame": (
        {"between": ["hous:0,0,1", "boom"]},
        "'hous' is no link of 'digger', did you mean 'house'?",
    ),
    "no point": (
        {"between": ["house:0.6,0", "boom"]},
        "'house:0.6,0' is no point, write LINK or LINK:x,y,z with metres in the link's frame",
    ),
    "not finite": ({"between": ["house:0,nan,0", "boom"]}, "'house:0,nan,0' is no point, write"),
    "same body": (
        {"between": ["arm:-0.6,0,0.1", "tip"]},
        "'arm:-0.6,0,0.1' and 'tip' are on one body, choose points of two that move against each",
    ),
    "negative bore": ({"bore": -0.1}, "the bore is -0.1 m, it must be positive"),
    "bore of nothing": ({"bore": float("nan")}, "the bore is nan m, give a number"),
    "rod as thick": (
        {"rod": 0.1},
        "the rod of 0.1 m does not fit into the bore of 0.1 m, choose a thinner one",
    ),
    "short stroke": (
        {"stroke": 0.1},
        "a cylinder of 0.5 to 0.6 m does not fit between 'house:0.6,0,0.7' and "
        "'boom:1.9,0,0.3', 1.503 to 2.629 m apart with lift at -1.1 to 0.2 rad: choose another "
        "stroke, dead length or eyes",
    ),
    "stroke in millimetres": (
        {"stroke": 900},
        "the stroke is 900 m: looks like mm, write 900e-3 or cm, write 900e-2",
    ),
    "bore in millimetres": ({"bore": 100}, "the bore is 100 m: looks like mm, write 100e-3"),
    "dead length beyond all": (
        {"dead_length": 1e7},
        "the dead length is 1e+07 m, longer than any part of a machine, give metres",
    ),
    "machine in millimetres": (
        {"between": ["house:600,0,700", "boom:1900,0,300"]},
        "'house:600,0,700' and 'boom:1900,0,300' are 1003 m apart and more, farther than a "
        "machine is large: look at its units with crane check, lengths are metres",
    ),
    "no stroke": ({"stroke": 0}, "the stroke is 0 m, it must be positive"),
    "short dead length": (
        {"dead_length": 0.9},
        "the dead length of 0.9 m is pin to pin with the rod in, it has to be more than the strok",
    ),
    "name that is taken": (
        {"name": "lift"},
        "'lift' is a part of 'digger' already, give the cylinder another name with --name",
    ),
    "no name": ({"name": ""}, "the cylinder's name is '', give a word"),
    "eyes on one pin": (
        {"between": ["house:0,0,1.5", "boom"]},
        "no active joint changes the distance between 'house:0,0,1.5' and 'boom' (between them: "
        "lift), choose other points",
    ),
    "no machine file": ({"out": "d.urdf"}, "d.urdf: a machine file is written, let its name end"),
    "file as a folder": (
        {"out": "digger.urdf/d.yaml"},
        "digger.urdf: is a file, give the name of a folder",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line_and_nothing_is_left(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    changed, text = REFUSED[case]
    planar(tmp_path)
    given = {"out": "d.yaml"} | LIFT | changed
    with pytest.raises(CraneError) as caught:
        crane.formats.add_cylinder("digger.urdf", **given)
    assert str(caught.value).startswith(text)
    assert os.listdir(tmp_path) == ["digger.urdf"]


def test_the_command(tmp_path):
    planar(tmp_path)
    words = ["--bore", "0.1", "--rod", "0.07", "--stroke", "0.9", "--name", "hoist"]
    words += ["--between", *LIFT["between"]]
    done = typed("add", "cylinder", "digger.urdf", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "hoist drives lift from -0.5233 to 0.2 rad, with 0.9 to 0.2035 m of its stroke, "
        "lever arm 0.874 to 1 m",
        "barrel 41.86 kg, rod 39.4 kg of steel, without oil",
        "written to digger_hoist.yaml",
    ]
    assert done.stderr.startswith("warning: 'lift' moves from -1.1 to 0.2 rad, and a cylinder of")
    before = (tmp_path / "digger_hoist.yaml").read_bytes()
    done = typed("add", "cylinder", "digger.urdf", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == (
        "error: digger_hoist.yaml: exists already, choose another name or add --force"
    )
    assert (tmp_path / "digger_hoist.yaml").read_bytes() == before
    done = typed("add", "cylinder", "digger.urdf", *words, "--force", cwd=tmp_path)
    assert done.returncode == 0
    done = typed("add", "cylinder", "digger_hoist.yaml", *words, cwd=tmp_path)
    assert done.stderr.splitlines()[-1].startswith("error: 'hoist' is a part of 'digger' already")
    done = typed("add", "cylinder", "digger.urdf", *words[:2], cwd=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1


# --- an excavator of other people --------------------------------------------------------------

CYLINDERS = (
    ("boom", "body_link:0.70,-0.040187,0.25", "boom_link:1.876,0,1.576", 0.120, 0.085, 1.26),
    ("arm", "boom_link:2.150,0.010957,2.218", "arm_link:-0.657,0,-0.540", 0.135, 0.095, 1.49),
    ("bucket", "arm_link:0.125,-0.023546,0.987", "bucket_link:-0.544,0,0.185", 0.115, 0.080, 1.12),
)  # fmt: skip


OUTBOARD = {  # bodies beyond the pin that a cylinder turns, those of other cylinders with them
    "bucket": ["bucket_link", "bucket_end_link"],
    "arm": ["arm_link", "bucket_link", "bucket_end_link", "bucket_barrel", "bucket_rod"],
}
OUTBOARD["boom"] = ["boom_link", *OUTBOARD["arm"], "arm_barrel", "arm_rod"]


def cylinder_force(machine, name, q):
    """By moments about the pin that a cylinder turns, and about its own foot, in its plane."""
    data = machine.model.createData()
    pin.forwardKinematics(machine.model, data, q)

    def place(link):
        return pin.updateFramePlacement(machine.model, data, machine.frame(link))

    ahead = np.cross(place("boom_link").rotation[:, 1], [0, 0, 1])

    def at(link, point=(0, 0, 0)):
        found = place(link).act(np.array(point, dtype=float))
        return np.array([found @ ahead, found[2]])

    def moment(point, force):
        return point[0] * force[1] - point[1] * force[0]

    def weighed(links, about):
        found = [(link, machine.tree.links[link].inertial) for link in links]
        return sum(moment(at(link, x.com) - about, [0, -9.81 * x.mass]) for link, x in found)

    foot, eye, pivot = at(f"{name}_barrel"), at(f"{name}_eye"), at(f"{name}_link")
    along = (eye - foot) / np.linalg.norm(eye - foot)
    across = np.array([-along[1], along[0]])
    own = [f"{name}_barrel", f"{name}_rod"]
    sideways = weighed(own, foot) / np.linalg.norm(eye - foot) * across
    turning = weighed(OUTBOARD[name], pivot) + moment(eye - pivot, sideways)
    push = -turning / moment(eye - pivot, along)
    return push + 9.81 * machine.tree.links[own[1]].inertial.mass * along[1]


def test_an_excavator_is_closed_by_three_commands(tmp_path):
    if not ZX200.is_file():
        pytest.skip(f"{ZX200} is not there")
    xacro = pytest.importorskip("xacro")
    (tmp_path / "zx200.urdf").write_text(xacro.process_file(str(ZX200)).toxml())
    machine = "zx200.urdf"
    for name, one, two, bore, rod, stroke in CYLINDERS:
        done = typed(
            "add", "cylinder", machine, "--name", name, "--between", one, two, "--bore", bore,
            "--rod", rod, "--stroke", stroke, "--out", "excavator.yaml", "--force", cwd=tmp_path,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        machine = "excavator.yaml"
    machine = crane.load(tmp_path / machine)
    assert machine.active == ("swing_joint", "boom", "arm", "bucket", "bucket_end_joint")
    rng = np.random.default_rng(1)
    lower, upper = np.nan_to_num(machine.lower, neginf=-3), np.nan_to_num(machine.upper, posinf=3)
    q_a = rng.uniform(lower, upper, (200, 5))
    q_a[:32, 1:4] = np.array(np.meshgrid(*zip(lower[1:4], upper[1:4], strict=True))).T.reshape(
        -1, 3
    )[np.arange(32) % 8]
    q = machine.closure.solve(q_a)  # over all of their strokes
    assert max(machine.closure.residual(one) for one in q) < 1e-13
    for name, *_, bore, _, stroke in CYLINDERS:
        lengths = stroke + 4 * bore + q[:, machine.column(name)]
        assert eyes_apart(machine, name, q) == pytest.approx(lengths, abs=1e-12)
    for sample, posture in zip(q_a[:40], q[:40], strict=True):
        forces = crane.Dynamics(machine).gravity(sample * [1, 1, 1, 1, 0])
        posture = machine.closure.solve(sample * [1, 1, 1, 1, 0], posture)
        for name, *_ in CYLINDERS:
            by_hand = cylinder_force(machine, name, posture)
            assert forces[machine.active.index(name)] == pytest.approx(
                by_hand, rel=1e-10, abs=1e-7
            )
    home = machine.home[machine.closure.active]
    way = crane.point_to_point(home, home + [0, 0.2, 0.2, 0.2, 0], 1.0)
    hold = crane.ComputedTorque(machine, way)
    assert np.ptp(crane.simulate(machine, hold).q[:, 1]) == pytest.approx(0.2, abs=1e-6)
    run = crane.simulate(machine, lambda t, q, v: np.zeros(5), duration=0.3)
    assert energy_of(run) < 1e-9
