"""Ratings of loaders, telehandlers and lifts: statics, circles and virtual work by hand."""

import csv
import json
import math
import re

import loaders
import numpy as np
import pytest
import wheel_loader
from command_line import typed
from free_bodies import balance, moment
from scipy.optimize import brentq
from test_wheel_loader import Linkage
from warned import quiet

import crane
from crane.common.errors import CraneError
from crane.dynamics import TippingStability
from crane.ratings.posture_search import PostureSearch
from crane.ratings.strokes import Strokes

G = 9.81  # the default of machine files
STEER, TURN = np.array([-1.1, 0.0]), math.radians(40)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loaders")
    for name, text in (loaders.drawings() | {"scissor": loaders.SCISSOR}).items():
        (folder / f"{name}.yaml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def loader(folder):
    return crane.load(folder / "loader.yaml")


@pytest.fixture(scope="module")
def lift(loader):
    return crane.ratings.lift_chart(loader, ["X_lift"], "heap", rule="iso14397")


def turned(point, angle):
    """A point of the front, with the frame articulated."""
    c, s = math.cos(angle), math.sin(angle)
    x, y = np.asarray(point[:2]) - STEER
    return np.array([STEER[0] + c * x - s * y, STEER[1] + s * x + c * y, *point[2:]])


def by_hand(machine, q_a, frame, working, line):
    """Loads by drives [kg], and by tipping over a line, from balances of all links."""
    q = machine.closure.solve(q_a)
    gravity, circuit = np.array(machine.gravity), machine.hydraulics
    empty, loaded = (balance(machine, q, gravity, load, frame)[0] for load in (0.0, 1000.0))
    loads = {}
    for joint, cylinder in circuit.cylinders.items():
        pressure = circuit.supply.pressure if joint in working else cylinder.relief
        per_kg = (loaded[joint] - empty[joint]) / 1000.0
        areas = cylinder.area_a, cylinder.area_b
        a, b = areas if per_kg > 0 else areas[::-1]
        limit = math.copysign(pressure * a - circuit.supply.tank * b, per_kg)
        loads[joint] = (limit - empty[joint]) / per_kg
    ends = [np.array(x) for x in line]
    over, more = (moment(machine, q, gravity, load, frame, *ends) for load in (0.0, 1000.0))
    loads["tips"] = 1000.0 * over / (over - more)
    return loads


@pytest.mark.parametrize("turn", [0, 1])
def test_the_lift_curve_is_what_statics_by_hand_give(loader, lift, turn):
    """Straight and at full turn, whose front wheels stand where the steering puts them."""
    assert lift.slews == pytest.approx([0.0, TURN]) and lift.raising_joints == ("X_lift",)
    angle = float(lift.slews[turn])
    line = [turned((0.3, y, 0.0), angle) for y in (-0.95, 0.95)]
    columns = {x.element if x.reason != "tips" else x.element: k
               for k, x in enumerate(lift.limiting_factors)}  # fmt: skip
    for a in (0, 23, 40, 64):
        q_a = lift.q_a[turn, 0, a]
        assert q_a[0] == angle
        hand = by_hand(loader, q_a, "heap", ["X_lift"], line)
        found = lift.values_by_factor[turn, 0, a]
        assert found[columns["X_lift"]] == pytest.approx(hand["X_lift"], rel=1e-9)
        tips = found[columns["front_right to front_left"]]
        assert tips == pytest.approx(0.5 * hand["tips"], rel=1e-9)
        assert lift.loads[turn, 0, a] == min(found)
        held = balance(loader, loader.closure.solve(q_a), np.array(loader.gravity), 0.0, "heap")
        assert lift.holding_forces[0, a, 1] == pytest.approx(held[0]["X_lift"], rel=1e-9)
    assert {lift.limiting_factors[k].reason for k in lift.active_factors} == {
        "tips", "working pressure",
    }  # fmt: skip


def test_rated_operating_capacity_is_half_of_the_smallest_tipping_load(loader, lift):
    """ISO 14397-1: along the lift, at full turn; found between the values of the chart."""
    rated, at = lift.least_load(1)
    tips, also = lift.least_load(1, only_tipping=True)
    assert rated == pytest.approx(0.5 * tips, rel=1e-12) and at.strokes == also.strokes
    line = [turned((0.3, y, 0.0), TURN) for y in (-0.95, 0.95)]

    def tipping(stroke):
        q_a = np.array([TURN, stroke, loader.home[loader.column("X_tilt")]])
        return by_hand(loader, q_a, "heap", ["X_lift"], line)["tips"]

    stroke = float(at.strokes[0, 0, 0])
    assert tips == pytest.approx(tipping(stroke), rel=1e-9)
    for beside in (stroke - 2e-3, stroke + 2e-3):
        assert tips < tipping(beside) < tips * (1 + 1e-4)
    assert rated < lift.loads[1].min() * (1 + 1e-5)
    assert lift.least_load(0)[0] > rated  # straight it tips later
    stability = TippingStability(loader)
    (mass,), (name,) = stability.tipping_load(at.q_a[1, 0], "heap")
    assert (mass, name) == (pytest.approx(tips, rel=1e-9), "front_right to front_left")


def test_full_turn_moves_weights_and_the_line_by_hand(loader):
    """Moments about the line of the front wheels: the rear's weight is nearer by a cosine."""
    stability, home = TippingStability(loader), loader.home[loader.closure.active]
    k = stability.line_names.index(("front_right", "front_left"))
    straight, full = (stability.static_margins(home + [x, 0, 0]).moments[0, k] for x in (0, TURN))
    rear = 7400 * G  # 1.0 m behind the pin, which is 1.4 m behind the wheels
    front = straight - rear * 2.4
    assert full == pytest.approx(front + rear * (1.4 + math.cos(TURN)), rel=1e-12)
    places = stability.support_positions(loader.closure.solve(home + [TURN, 0, 0])[None])[0]
    for name, y in (("front_left", 0.95), ("front_right", -0.95)):
        found = places[stability.support_names.index(name)]
        assert found == pytest.approx(turned((0.3, y, 0.0), TURN), abs=1e-12)
    forces = stability.support_forces(
        loader.closure.solve(home + [TURN, 0, 0])[None],
        stability.ground_wrench(loader.closure.solve(home + [TURN, 0, 0])[None]),
    )
    assert forces.sum() == pytest.approx(stability.mass * G, rel=1e-9) and forces.min() > 0


class Circles:
    """Pins of the page's loader in its plane, where circles cross."""

    A, B, C, D = (np.array(x) for x in ((0, 1.75), (-0.35, 0.75), (0.8, 1.13), (2.04, 0.3)))
    E, F, G = (np.array(x) for x in ((1.09, 1.57), (0.98, 2.45), (0.71, 0.98)))
    H, T, edge = (np.array(x) for x in ((1.93, 0.62), (0.35, 1.86), (3.14, 0.02)))

    def __init__(self, lift, tilt):
        boom = self.crossing(self.A, self.C, self.B, 1.19 + lift, 0.5)
        self.pin, crank = self.about(self.A, self.D, boom), self.about(self.A, self.E, boom)
        bell = self.crossing(crank, crank + self.F - self.E, self.T, 0.62 + tilt, boom)
        lower = crank + self.rotated(self.G - self.E, bell)
        self.angle = self.crossing(
            self.pin, self.pin + self.H - self.D, lower, math.dist(self.G, self.H), -0.2
        )
        self.lip = self.pin + self.rotated(self.edge - self.D, self.angle)

    @staticmethod
    def rotated(arm, angle):
        c, s = math.cos(angle), math.sin(angle)
        return np.array([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]])

    def about(self, centre, point, angle):
        return centre + self.rotated(point - centre, angle)

    def crossing(self, centre, end, other, distance, near):
        """The angle nearest to one that puts an arm's end at a distance from a point."""

        def gap(x):
            return math.dist(self.about(centre, end, x), other) - distance

        angles = near + np.linspace(-1.7, 1.7, 401)
        gaps = np.array([gap(x) for x in angles])
        found = np.flatnonzero(gaps[:-1] * gaps[1:] <= 0)
        k = found[np.abs(angles[found] - near).argmin()]
        return brentq(gap, angles[k], angles[k + 1], xtol=1e-15)


def test_levelling_is_what_circles_give(loader, lift):
    tilt = loader.home[loader.column("X_tilt")]
    for a in (0, 20, 45, 64):
        by_circles = Circles(float(lift.strokes[0, a, 0]), tilt).angle
        assert lift.angles[0, a] == pytest.approx(by_circles, abs=1e-10)
    low, high = lift.angle_range()
    by_circles = np.array([Circles(x, tilt).angle for x in np.linspace(0, 0.855, 172)])
    assert low == pytest.approx(by_circles.min(), abs=1e-5) and low <= by_circles.min() + 1e-10
    assert high == pytest.approx(by_circles.max(), abs=1e-5) and high >= by_circles.max() - 1e-10
    assert math.degrees(high - low) == pytest.approx(5.364, abs=1e-3)


@pytest.mark.slow
def test_dump_height_and_reach_are_what_circles_give(loader):
    found = crane.working_range(loader, bucket="X_tilt")
    top = Circles(0.855, loader.home[loader.column("X_tilt")])
    assert found["hinge pin height"].value == pytest.approx(top.pin[1], abs=1e-9)
    tilt = brentq(lambda x: Circles(0.855, x).angle + math.pi / 4, 0.04, 0.06, xtol=1e-14)
    dumps = Circles(0.855, tilt)
    assert found["dump height at 45 degrees"].value == pytest.approx(dumps.lip[1], abs=1e-9)
    reach = found["dump reach at 45 degrees"].value
    assert reach == pytest.approx(dumps.lip[0] - 0.3, abs=1e-9)
    assert found["dump height at 45 degrees"].q_a == pytest.approx([0, 0.855, tilt], abs=1e-9)
    page = loaders.PAGE.read_text()
    for line in found.to_markdown().splitlines():
        assert not line.startswith("|") or line in page, line
    names = [x.name for x in found.dimensions]
    assert "dump height" not in names and "vertical wall digging depth" not in names


def test_break_out_at_a_posture_is_what_moments_give(tmp_path):
    """ISO 14397-2: vertical, by either cylinder, with the level bucket on the ground."""
    machine = crane.load(wheel_loader.write(tmp_path))
    found = crane.ratings.breakout(
        machine, bucket="X_tilt", direction="up", at={"angle": 0.0, "height": wheel_loader.LIP[1]}
    )
    home = Linkage(wheel_loader.LIFTED, wheel_loader.TILTED)
    for one in (found.bucket, found.arm):
        by_moments = home.most([0.0, 1.0], [one.joint])
        assert one.q_a == pytest.approx([wheel_loader.LIFTED, wheel_loader.TILTED], abs=1e-10)
        assert one.isolated_force == pytest.approx(by_moments[one.joint], rel=1e-9)
        assert one.force == pytest.approx(min(by_moments.values()), rel=1e-9)
    tangent = crane.ratings.breakout(machine, bucket="X_tilt", at={"X_tilt": 0.3})
    at = Linkage(wheel_loader.LIFTED, 0.3)
    by_moments = at.most(at.path("X_tilt"), ["X_tilt"])
    assert tangent.bucket.force == pytest.approx(min(by_moments.values()), rel=1e-9)


def test_break_out_ends_where_the_rear_lifts(loader):
    """With weight; the force and the weights about the line of the front wheels."""
    at = {"angle": 0.0, "height": 0.02}
    found = crane.ratings.breakout(
        loader, "behind", bucket="X_tilt", weights=True, direction="up", at=at
    )
    assert found.bucket.limiting_factor.reason == "tips"
    q = loader.closure.solve(found.bucket.q_a)
    gravity = np.array(loader.gravity)
    line = np.array([0.3, 0.95, 0.0]), np.array([0.3, -0.95, 0.0])
    holds = moment(loader, q, gravity, 0.0, "behind", *line)
    lip = Circles(*found.bucket.q_a[1:]).lip[0] - 0.1
    assert found.bucket.force == pytest.approx(holds / (lip - 0.3), rel=1e-9)


def test_a_scissor_lift_holds_what_virtual_work_says(folder):
    """F dx = W dh with h = sqrt(L^2 - x^2): of the deck, its roller, and half of both arms."""
    machine = crane.load(folder / "scissor.yaml")
    chart = crane.ratings.lift_chart(machine)  # its only stroke
    assert chart.over == ("X_lift",)
    weight = (300 + 20 + 80) * G  # both arms' centres rise half as far
    across = 1.6 + chart.strokes[0, :, 0] - 0.3
    height = np.sqrt(2.4**2 + 1.0 - across**2)
    assert chart.positions[0, :, 1] == pytest.approx(height + 0.2, rel=1e-12)
    per_newton = -across / height
    assert chart.holding_forces[0, :, 0] == pytest.approx(weight * per_newton, rel=1e-9)
    pull = machine.model.effortLimit[machine.column("X_lift")]
    assert chart.loads[0, 0] * G == pytest.approx(pull / -per_newton - weight, rel=1e-9)


def test_what_lock_leaves_is_the_curve_over_it(loader, lift):
    tilt = float(loader.home[loader.column("X_tilt")])
    locked = crane.load(loader.path, lock={"X_tilt": tilt})
    chart = crane.ratings.lift_chart(locked, frame="heap", rule="iso14397")
    assert chart.over == ("X_lift",)
    by_tipping = [k for k, x in enumerate(chart.limiting_factors) if x.reason == "tips"]
    same = [k for k, x in enumerate(lift.limiting_factors) if x.reason == "tips"]
    assert chart.values_by_factor[..., by_tipping] == pytest.approx(
        lift.values_by_factor[..., same], rel=1e-9
    )


STEERED = {  # two cylinders in place of the driven pin
    "steer: {axis: z, driven: yes, ": "steer: {axis: z, ",
    "rear: {points: [steer, ": "rear: {points: [steer, left_rear, right_rear, ",
    "front: {points: [steer, ": "front: {points: [steer, left_front, right_front, ",
    "    edge: ": "    left_rear: [-1.9, 0.3, 0.8]\n    right_rear: [-1.9, -0.3, 0.8]\n"
    "    left_front: [-0.75, 0.35, 0.8]\n    right_front: [-0.75, -0.35, 0.8]\n    edge: ",
    "    X_tilt: {points: [T": "".join(
        f"    X_{x}: {{points: [{x}_rear, {x}_front], bore: 0.07, rod: 0.04, shortest: 0.86, "
        "longest: 1.33}\n" for x in ("left", "right")
    ) + "    X_tilt: {points: [T",
}  # fmt: skip


@pytest.mark.slow
def test_steering_cylinders_at_full_steer_tip_as_statics_by_hand(folder, lift):
    """The pin locked at 40 degrees, moments of all links about the line of the turned wheels."""
    text = (folder / "loader.yaml").read_text().split("hydraulics:")[0]
    for old, new in STEERED.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "steered.yaml"
    path.write_text(text)
    with pytest.raises(CraneError, match="choose them: --active X_lift,X_left,X_tilt"):
        crane.ratings.lift_chart(quiet(crane.load, path), ["X_lift"], "heap")
    machine = crane.load(path, lock={"steer": TURN}, active=["X_lift", "X_tilt"])
    tips, at = crane.ratings.lift_chart(machine, ["X_lift"], "heap", rule="iso14397").least_load(
        0, only_tipping=True
    )
    q = machine.closure.solve(at.q_a[0, 0, 0])
    line = [turned([0.3, y, 0.0], TURN) for y in (-0.95, 0.95)]
    over = moment(machine, q, np.array(machine.gravity), tips, "heap", *line)
    assert over == pytest.approx(0.0, abs=1e-9 * 12000 * G * 3)
    assert tips == pytest.approx(lift.least_load(1, only_tipping=True)[0], rel=0.01)  # steel more
    with pytest.warns(UserWarning, match="passive joint 'X_left' is at -0.0728"):
        path.write_text(text.replace("left_rear: [-1.9", "left_rear: [-1.82"))
        crane.load(path, lock={"steer": TURN}, active=["X_lift", "X_tilt"])


@pytest.fixture(scope="module")
def zones(folder):
    machine = crane.load(folder / "telehandler.yaml")
    return crane.ratings.lift_chart(
        machine, ["X_boom", "X_extension"], at={"angle": 0.0}, zones=[1500.0, 4000.0],
        rule="iso14397-rough",
    )  # fmt: skip


def test_zones_end_where_statics_by_hand_tip_it(zones):
    """At an edge 60 % of the tipping load is the load of the zone, with the fork level."""
    machine, checked = zones.machine, 0
    line = np.array([0.8, -0.95, 0.0]), np.array([0.8, 0.95, 0.0])
    columns = [machine.active.index(x) for x in zones.over]
    for load, edge in zip(zones.zones, zones.zone_edges[0], strict=True):
        for a in np.flatnonzero(np.isfinite(edge) & (edge < 3.2 - 1e-9))[::5]:
            at = zones.at_strokes(np.array([[[zones.strokes[0, a, 0], edge[a]]]]))
            assert at.q_a[0, 0, 0, columns] == pytest.approx([zones.strokes[0, a, 0], edge[a]])
            q = machine.closure.solve(at.q_a[0, 0, 0])
            over = moment(machine, q, np.array(machine.gravity), load / 0.6, "load", *line)
            assert over == pytest.approx(0.0, abs=1e-9 * 7000 * G * 3)
            # the carriage is level: the load is where it was drawn, from its pin
            assert at.angles[0, 0] == pytest.approx(0.0, abs=1e-10)
            checked += 1
    assert checked > 6
    empty = np.isnan(zones.zone_edges[0, 1])
    assert (zones.loads[0, 0, empty] < 4000).all() and empty.any()
    whole = zones.zone_edges[0, 0] == 3.2
    assert (zones.loads[0, -1, whole] >= 1500).all() and whole.any()


def test_the_angles_of_the_boom_are_those_of_its_telescope(zones):
    """From the length of the lift cylinder by the cosine theorem, at home and at its ends."""
    a, b, c = np.array([-2.2, 1.75]), np.array([-0.7, 0.7]), np.array([-1.45, 1.6])
    arm, base = math.dist(a, c), math.dist(a, b)

    def between(length):
        return math.acos((arm**2 + base**2 - length**2) / (2 * arm * base))

    drawn = math.atan2(1.36 - 1.73, 1.5 + 2.1)
    for k in (0, 16, 32):
        turn = between(1.15 + zones.strokes[0, k, 0]) - between(math.dist(b, c))
        assert zones.boom_angles()[k] == pytest.approx(drawn + turn, abs=1e-6)


def test_postures_that_are_not_there_are_said_in_one_line(loader):
    places = Strokes(loader, "edge")
    for at, over, said in (
        ({"X_lift": 1.0}, (), r"'X_lift' goes from 0 to 0.855 m, not to 1"),
        ({"X_lft": 0.1}, (), r"'X_lft' is no active joint, did you mean 'X_lift'"),
        (
            {"angle": 0.0},
            (),
            "1 of the strokes would follow, in .*, and X_lift, X_tilt may; name or",
        ),
        ({"angle": 40.0}, ("X_lift",), "the angle is 40 rad, more than a turn: write degrees as"),
        ({"angle": 0.0, "X_lift": 0.1, "X_tilt": 0.1}, (), "and none may; name"),
        ({"X_lift": 0.1}, ("X_lift",), "'X_lift' is swept or given twice"),
        ({"angle": 2.0, "X_lift": 0.1}, (), "reaches no posture with angle 2 within its strokes"),
        ({"angle": math.nan, "X_lift": 0.1}, (), "the angle is nan rad, give a number"),
    ):
        with pytest.raises(CraneError, match=said) as error:
            PostureSearch(places, at, over).configuration()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--over", "X_lift", "--step", "0.1"), "--step is for the reach, not over strokes"),
        (("--over", "X_lift,X_tilt,steer"), "'steer' does not move 'edge'"),
        (("--over", "X_lift,X_lift"), "'X_lift' is swept or given twice, name it once"),
        (("--over", ""), "'' does not move 'edge'"),
        (("--zones", "1000"), "--zones are over two strokes, name them with --over"),
        (("--over", "X_lift", "--zones", "1000"), "zones are over two strokes, not over 'X_lift'"),
        (("--over", "X_lift,X_tilt", "--zones", "1000,-1"), "the load of a zone is -1"),
        (("--over", "X_lift,X_tilt", "--zones", "heavy"), "--zones heavy are no loads"),
        (("--over", "X_lift", "--at", "angle=400deg"), "more than a turn: write degrees"),
        (("--over", "X_lift", "--at", "angle=170deg"), "reaches no such posture over X_lift"),
        (("--over", "X_lift", "--at", "tilt=1"), "'tilt' is no active joint"),
        (("--over", "X_lift", "--at", "X_tilt"), "--at"),
    ],
)  # fmt: skip
def test_wrong_options_are_said_in_one_line(folder, tmp_path, words, said):
    done = typed("capacity", folder / "loader.yaml", *words, "--out", tmp_path / "out")
    assert done.returncode == 2 and said in done.stderr, done.stderr
    assert "Traceback" not in done.stderr and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_command_writes_curve_and_figure(folder, tmp_path):
    out = tmp_path / "out"
    done = typed("capacity", folder / "loader.yaml", "--over", "X_lift", "--frame", "heap",
                 "--rule", "iso14397", "--at", "angle=5deg", "--out", out)  # fmt: skip
    assert done.returncode == 0, done.stderr
    text = (out / "lift_chart.md").read_text()
    assert "# Lift chart of loader" in text and "- held: angle = 0.08727" in text
    assert "rated 40° |" in text and "tips front |" in text
    lines = [x for x in (out / "lift_chart.csv").read_text().splitlines() if x[0] != "#"]
    names = [x.split(" ")[0] for x in next(csv.reader(lines))]
    assert names[:5] == ["slew", "radius", "height", "angle", "force_steer"]
    assert {"X_lift", "X_tilt", "force_X_lift", "cause"} <= {*names}
    values = np.genfromtxt(lines[1:], delimiter=",")
    assert len(values) == 2 * 65 and values[:, 3] == pytest.approx(math.radians(5), abs=1e-10)
    assert (out / "lift_chart.png").stat().st_size > 10_000
    data = page_data(out)
    assert ["over", "X_lift"] in data["facts"] and data["slews"] == ["front", "40°"]
    cells = np.array([row[:3] for cells in data["cells"] for row in cells])
    wanted = values[:, [names.index(x) for x in ("radius", "height", "load")]]
    assert cells == pytest.approx(wanted, rel=1e-4)
    for cell in data["cells"][1][::16]:  # the machine is drawn where it holds the load
        corners = data["unit"] * np.concatenate(data["shapes"][cell[7]][0]).reshape(-1, 2)
        assert np.linalg.norm(corners - cell[:2], axis=1).min() < data["unit"]
        assert cell[8] == pytest.approx(5.0, abs=1e-6)


def page_data(folder):
    """The data within the page of a lift chart."""
    text = (folder / "lift_chart.html").read_text(encoding="utf-8")
    (inside,) = re.findall(r'id="data">(.*?)</script>', text, re.S)
    return json.loads(inside)


@pytest.mark.slow
def test_zones_are_lines_of_the_page(zones, tmp_path):
    zones.write(tmp_path / "out")
    data = page_data(tmp_path / "out")
    (_, (words, (line,))) = data["contours"][0]
    assert words == "4000 kg"
    edge = np.column_stack([zones.strokes[0, :, 0], zones.zone_edges[0, 1]])
    places = zones.at_strokes(edge[np.isfinite(edge[:, 1])][None]).positions[0]
    drawn = data["unit"] * np.array(line).reshape(-1, 2)
    assert drawn == pytest.approx(places, abs=data["unit"])


def test_supports_that_leave_the_ground_are_refused(folder, tmp_path):
    text = (folder / "loader.yaml").read_text()
    path = tmp_path / "loader.yaml"
    path.write_text(text.replace("supports: [front_left,", "supports: [heap,"))
    with pytest.raises(CraneError, match=r"loader.yaml:\d+: .*support 'heap' is lifted by 'A'"):
        crane.load(path)


def test_an_outline_that_changes_is_told(folder, tmp_path):
    """A fifth support inside the outline at home, which the steering puts outside."""
    text = (folder / "loader.yaml").read_text()
    text = text.replace("    heap: [2.64, 0.5]", "    foot: [-0.1, 1.0, 0]\n    heap: [2.64, 0.5]")
    text = text.replace("front_left, front_right], mass", "foot, front_left, front_right], mass")
    text = text.replace(
        "rear_left, rear_right]\nhydraulics", "rear_left, rear_right, foot]\nhydraulics"
    )
    path = tmp_path / "loader.yaml"
    path.write_text(text.replace("front_left: [0.3, 0.95, 0]", "front_left: [0.3, 1.05, 0]"))
    machine = crane.load(path)
    stability, home = TippingStability(machine), machine.home[machine.closure.active]
    stability.static_margins(home)
    with pytest.raises(CraneError, match="other corners here than at home"):
        stability.static_margins(home + [-TURN, 0, 0])
    with pytest.raises(CraneError, match="other corners here than at home"):
        crane.ratings.lift_chart(machine, ["X_lift"], "heap", slews=[-TURN])


@pytest.mark.slow
def test_the_page_shows_what_the_machines_have(folder, loader, lift, monkeypatch, capsys):
    """Its tables are those of today, and its program runs."""
    page = loaders.PAGE.read_text()
    found = [lift.to_markdown()]
    at = {"angle": 0.0, "height": 0.02}
    found.append(
        crane.ratings.breakout(
            loader, "behind", bucket="X_tilt", weights=True, direction="up", at=at
        ).to_markdown()
    )
    for line in "\n".join(found).splitlines():
        assert not line.startswith("|") or line in page, line
    (program,) = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    monkeypatch.chdir(folder)
    exec(compile(program, "loader_ratings.md", "exec"), {})
    assert "# Lift chart of loader" in capsys.readouterr().out
