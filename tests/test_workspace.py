"""Workspaces against triangle inequalities, circles and pins of cranes."""

import csv

import numpy as np
import oracles
import pytest
from conftest import DATA
from test_patu655_geometry import ELBOW, LIFT_PIN, STROKES, TIP, plane
from typer.testing import CliRunner

import crane
from crane.cli import program
from crane.common.errors import InputError
from crane.motion.workspaces import workspace
from crane.motion.workspaces.workspace_patch import last_closed_configuration

CRANK, COUPLER, ROCKER, GROUND = 0.2, 0.4, 0.3, 0.4  # of data/four_bar.yaml


# --- one stroke ------------------------------------------------------------------------------


def four_bar(tmp_path, crank):
    """A four-bar with a crank of any length on limits of a whole turn, its coupler pin the tip."""
    text = (DATA / "four_bar_loop.urdf").read_text()
    text = text.replace('lower="-1" upper="1"', 'lower="-3.14" upper="3.14"')
    text = text.replace('<origin xyz="0.2 0 0" rpy="0 0 -0.9"/>',
                        f'<origin xyz="{crank} 0 0" rpy="0 0 -0.9"/>')  # fmt: skip
    path = tmp_path / "four_bar.urdf"
    path.write_text(text)
    return crane.load(path)


def crank_limits(crank):
    """Angles between crank and ground where coupler and rocker just span what is between.

    |coupler - rocker| <= sqrt(crank^2 + ground^2 - 2 crank ground cos a) <= coupler + rocker.
    """
    gaps = np.array([abs(COUPLER - ROCKER), COUPLER + ROCKER])
    cosines = (crank**2 + GROUND**2 - gaps**2) / (2 * crank * GROUND)
    return np.arccos(np.clip(cosines, -1, 1))


def test_a_grashof_crank_turns_all_around(tmp_path):
    """0.2 + 0.4 <= 0.3 + 0.4: the shortest link beside the ground is a crank (Grashof)."""
    assert crank_limits(0.2) == pytest.approx([0, np.pi])
    space = workspace(four_bar(tmp_path, 0.2), 400, "pin_predecessor")
    assert space.closed_share == 1 and not space.curves and space.area == 0
    assert len(space) == 400
    # the pin runs on the rocker's circle
    assert (
        np.abs(
            np.hypot(space.tip_positions[:, 0] - GROUND, space.tip_positions[:, 1]) - ROCKER
        ).max()
        < 1e-12
    )


@pytest.mark.parametrize("crank", [0.34, 0.38, 0.45])
def test_a_longer_crank_only_swings(tmp_path, crank):
    """Coupler and rocker in line end the branch: the law of cosines says where."""
    space = workspace(four_bar(tmp_path, crank), 500, "pin_predecessor")
    ends = sorted(float(curve.q_a[0, 0]) + 1.2 for curve in space.curves)  # from the ground's line
    low, high = crank_limits(crank)
    assert ends == pytest.approx([low, high], abs=1e-5)
    assert space.closed_share == pytest.approx((high - low) / 6.28, abs=2 / 500)
    assert "end of the branch" in space.to_markdown()
    # condition grows without bounds towards the ends
    assert space.condition.max() > 10


def test_slider_crank_driven_by_its_slider(edited):
    """The slider's branch ends where crank and rod are in line: s = 0.4."""
    pump = edited("slider_crank.yaml", "active: [theta]", "active: [s]")
    space = workspace(pump, 300)
    ends = [curve.q_a[0, 0] for curve in space.curves]
    assert any(end == pytest.approx(0.4, abs=1e-5) for end in ends)
    assert space.q_a.max() <= 0.4


# --- a five-bar ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def five(five_bar):
    return workspace(five_bar, 6000, "meeting_predecessor")


def test_five_bar_ends_where_its_rods_are_in_line(five):
    """Distal links stretched: the crank tips are 0.5 apart, twice the rods' 0.25."""
    edges = [curve for curve in five.curves if curve.kind == "branch"]
    q_a = np.vstack([curve.q_a for curve in edges])
    assert len(q_a) > 200
    gap = [np.hypot(*np.subtract(*oracles.five_bar_tips(a, b))) for a, b in q_a]
    assert np.abs(np.array(gap) - 0.5).max() < 1e-5
    # the tip in the middle of the stretched rods
    middle = [np.mean(oracles.five_bar_tips(a, b), axis=0) for a, b in q_a]
    places = np.vstack([curve.section_positions for curve in edges])
    assert np.abs(places - middle).max() < 3e-3  # the root of what is short of the end


def test_five_bar_tip_is_singular_where_crank_and_rod_are_in_line(five):
    """There the tip is as far from a crank's foot as it can be, or as near: 0.55 or 0.05 m."""
    places = np.vstack([curve.section_positions for curve in five.curves if curve.kind == "tip"])
    away = [np.linalg.norm(places - foot, axis=1) for foot in ([0, 0], [0.4, 0])]
    off = [np.minimum(np.abs(d - 0.55), np.abs(d - 0.05)) for d in away]
    assert len(places) > 200
    assert np.minimum(*off).max() < 1e-6


def elbow(foot, points, side):
    """Elbows (N, 2) of an arm of 0.3 and 0.25 m from a foot to points (N, 2), NaN out of reach."""
    way = points - foot
    d2 = (way**2).sum(axis=1)
    along = (d2 + 0.3**2 - 0.25**2) / (2 * d2)
    with np.errstate(invalid="ignore"):
        across = np.sqrt(0.3**2 / d2 - along**2)
    return (
        foot
        + along[:, None] * way
        + side * across[:, None] * np.column_stack([-way[:, 1], way[:, 0]])
    )


def test_five_bar_area_by_counting_points_that_have_inverse_kinematics(five):
    random = np.random.default_rng(0)
    points = random.uniform([-0.6, -0.7], [1.0, 0.7], (200_000, 2))
    able = np.zeros(len(points), dtype=bool)
    for one in (-1, 1):
        for two in (-1, 1):
            a, b = elbow(np.zeros(2), points, one), elbow(np.array([0.4, 0.0]), points, two)
            (x, y), (u, v) = (b - a).T, (points - a).T
            able |= x * v - y * u > 0  # the rods' branch; False where either is NaN
    area, error = 1.6 * 1.4 * able.mean(), 1.6 * 1.4 * able.std() / np.sqrt(len(able))
    assert five.area == pytest.approx(area, abs=0.01 * area + 3 * error)


def test_all_postures_close_and_are_of_the_branch(five, five_bar):
    (patch,) = five.patches
    q = patch.configurations[patch.is_closed]
    assert five_bar.closure.residual(q).max() < 1e-12
    a, b, c, d = q[::40, [five_bar.column(name) for name in "abcd"]].T
    wanted = np.array([oracles.five_bar(*angles) for angles in zip(a, b, strict=True)]).T
    assert np.abs(np.angle(np.exp(1j * (np.array([c, d]) - wanted)))).max() < 1e-6


# --- cranes ----------------------------------------------------------------------------------


def test_patu655_reaches_as_far_as_its_pins_allow():
    """Boom pin, elbow and tip in a level line, extension out: within the strokes."""
    space = workspace(crane.load("patu655"), 3000)
    arm = np.hypot(*ELBOW) + np.hypot(TIP[0] + STROKES[2], TIP[1])
    assert space.extreme("largest radius").value == pytest.approx(LIFT_PIN[0] + arm, abs=1e-6)
    # all others by a fine grid of the closed form in the plane
    lift, tilt = (x.ravel() for x in np.meshgrid(*(np.linspace(0, s, 500) for s in STROKES[:2])))
    at, turn = plane(lift, tilt)
    found = []
    for extension in (0.0, STROKES[2]):
        tip = TIP + np.array([extension, 0.0])
        found.append(at["elbow"] + oracles.turned(turn["tilt"], tip[:, None] + 0 * at["elbow"]))
    both = np.concatenate(found, axis=1)
    for name, value in (
        ("least radius", both[0].min()), ("largest radius", both[0].max()),
        ("least height", both[1].min()), ("largest height", both[1].max()),
    ):  # fmt: skip
        assert space.extreme(name).value == pytest.approx(value, abs=1e-3), name
    assert space.slewing_joint_name == "slew" and space.closed_share == 1
    assert space.strokes == ("X_lift", "X_tilt", "X_ext")
    assert space.section_positions[:, 0] == pytest.approx(space.tip_positions[:, 0], abs=1e-12)


def test_mini_forwarder_area_by_integration(mini):
    """No stroke turns the tip back: the area is the integral of the slopes' determinant."""
    space = workspace(mini, 4000)
    assert space.slewing_joint_name == "q1" and space.strokes == ("X1", "X2") and not space.curves

    def tips(x1, x2):
        return oracles.mini_forwarder(x1, x2)[1]

    nodes, weights = np.polynomial.legendre.leggauss(40)
    x = 0.015 * (nodes + 1)
    x1, x2 = (grid.ravel() for grid in np.meshgrid(x, x))
    slopes = oracles.by_stroke(tips, x1, x2)  # (stroke, coordinate, N)
    determinant = slopes[0, 0] * slopes[1, 1] - slopes[0, 1] * slopes[1, 0]
    assert (determinant < 0).all() or (determinant > 0).all()
    area = 0.015**2 * np.abs(determinant) @ np.outer(weights, weights).ravel()
    assert space.area == pytest.approx(area, rel=5e-3)
    grid = np.linspace(0, 0.03, 400)
    x1, x2 = (values.ravel() for values in np.meshgrid(grid, grid))
    both = tips(x1, x2)
    for k, name in enumerate(space.section.coordinate_names):
        assert space.extreme(f"least {name}").value == pytest.approx(both[k].min(), abs=1e-5)
        assert space.extreme(f"largest {name}").value == pytest.approx(both[k].max(), abs=1e-5)


def test_condition_is_largest_singular_value_of_scaled_gamma(mini):
    space = workspace(mini, 400)
    random = np.random.default_rng(3).integers(len(space), size=5)
    scale = {"X1": 0.03, "X2": 0.03}
    for i in random:
        gamma = mini.closure.gamma(mini.closure.solve(space.q_a[i]))
        for row, joint in enumerate(mini.joints):
            gamma[row] /= scale.get(joint, 1.0)
        for column, joint in enumerate(mini.active):
            gamma[:, column] *= scale.get(joint, 1.0)
        assert space.condition[i] == pytest.approx(np.linalg.svd(gamma, compute_uv=False)[0])


# --- open arms, many strokes -----------------------------------------------------------------


def test_a_two_link_arm_has_the_area_of_its_ring(tmp_path):
    """Without limits: pi ((l1 + l2)^2 - (l1 - l2)^2); stretched and folded are singular."""
    body = ('<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0"'
            ' izz="1"/></inertial>')  # fmt: skip
    text = f"""<robot name="two"><link name="base"/>
    <joint name="a" type="continuous"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
    </joint><link name="one">{body}</link>
    <joint name="b" type="continuous"><origin xyz="0.5 0 0"/><parent link="one"/>
    <child link="two"/><axis xyz="0 1 0"/></joint><link name="two">{body}</link>
    <joint name="c" type="fixed"><origin xyz="0.3 0 0"/><parent link="two"/><child link="tip"/>
    </joint><link name="tip"/></robot>"""
    (tmp_path / "two.urdf").write_text(text)
    space = workspace(crane.load(tmp_path / "two.urdf"), 6000)
    assert space.section.coordinate_names == ("x", "z")
    assert space.area == pytest.approx(np.pi * (0.8**2 - 0.2**2), rel=4e-3)
    assert space.extreme("largest z").value == pytest.approx(0.8, abs=1e-9)
    away = np.linalg.norm(np.vstack([curve.section_positions for curve in space.curves]), axis=1)
    assert len(away) and np.minimum(np.abs(away - 0.8), np.abs(away - 0.2)).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(("name", "frame"), [("kr300", None), ("ur5_robot", "ee_link")])
def test_arms_of_many_joints_are_drawn(name, frame):
    machine = crane.load(name)
    space = workspace(machine, 600, frame)
    assert not space.is_complete and space.slewing_joint_name == machine.active[0]
    assert "the true workspace is larger" in space.to_markdown()
    assert (space.q_a >= space.lower - 1e-12).all() and (space.q_a <= space.upper + 1e-12).all()
    frame = space.frame
    tips = crane.Kinematics(machine, frame).position(space.q_a[::40])
    assert np.abs(tips - space.tip_positions[::40]).max() < 1e-12
    radius = np.hypot(space.tip_positions[:, 0], space.tip_positions[:, 1])
    assert np.abs(space.section_positions[:, 0] - radius).max() < 1e-9
    again = workspace(machine, 600, frame)
    assert np.array_equal(again.q_a, space.q_a) and again.area == space.area


# --- what is written and refused -------------------------------------------------------------


def test_the_command_writes_tables_summary_and_picture(tmp_path):
    out = tmp_path / "space"
    words = ["workspace", "patu655", "--lock", "X_ext=0.5", "--set", "X_lift.upper=0.4",
             "--samples", "400", "--out", str(out)]  # fmt: skip
    result = CliRunner().invoke(program(), words)
    assert result.exit_code == 0, result.output
    assert "largest radius" in result.output
    files = {path.name for path in out.iterdir()}
    assert files == {"workspace.csv", "curves.csv", "workspace.md", "workspace.png"}
    assert (out / "workspace.png").read_bytes()[:4] == b"\x89PNG"
    with (out / "workspace.csv").open() as file:
        start = '# machine: patu655 with {"changes": {"X_lift.upper": 0.4}, "lock": {"X_ext": '
        assert file.readline().startswith(start)
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert len(rows) == 400
    assert max(float(row["X_lift [m]"]) for row in rows) == pytest.approx(0.4)
    assert crane.workspace is workspace


def test_what_cannot_be_mapped_is_refused(five_bar, mini):
    for call, text in (
        (lambda: workspace(five_bar), "has no tip, name a frame"),
        (lambda: workspace(five_bar, 5000, "rod"), "frame 'rod' is unknown"),
        (lambda: workspace(five_bar, 5000, "ground"), "no driven joint moves 'ground'"),
        (lambda: workspace(mini, 10), "samples is 10, give a whole number from 100 to"),
        (lambda: workspace(mini, 100, seed=-1), "the seed is -1"),
    ):
        with pytest.raises(InputError, match=text):
            call()


def test_ways_stop_where_the_branch_ends(five_bar):
    """Out of reach: the last closed posture on the way has its rods in line."""
    home = five_bar.home[five_bar.closure.active]
    for turn in np.linspace(0, 2 * np.pi, 17):
        target = home + 2.5 * np.array([np.cos(turn), np.sin(turn)])
        q, able = last_closed_configuration(five_bar, five_bar.home, target)
        q_a = q[five_bar.closure.active]
        gap = np.hypot(*np.subtract(*oracles.five_bar_tips(*q_a)))
        if able:
            assert q_a == pytest.approx(target)
        else:
            assert gap == pytest.approx(0.5, abs=1e-5) or gap < 1e-3
