"""Via points: minimum-jerk splines, orientations, tasks and paths through points."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import PPoly, make_interp_spline

import crane
from crane.common.errors import DescriptionError, InputError, UnreachableTipError
from crane.motion.attitude import InclinationCoordinate, roll_pitch_yaw
from crane.motion.quintic_splines import PiecewisePolynomial, least_jerk

# --- the spline ------------------------------------------------------------------------------


def test_one_via_point_is_the_closed_form_of_flash_and_hogan():
    """Their equations (A4) to (A7): the part before the point, of u = t/t_f and u_1."""
    x_0, x_1, x_f, u_1, t_f = 0.3, 1.1, -0.4, 0.37, 2.5
    denominator = u_1**5 * (1 - u_1) ** 5
    c_1 = (
        (x_f - x_0) * (300 * u_1**5 - 1200 * u_1**4 + 1600 * u_1**3)
        + u_1**2 * (-720 * x_f + 120 * x_1 + 600 * x_0)
        + (x_0 - x_1) * (300 * u_1 - 200)
    ) / (t_f**5 * u_1**2 * (1 - u_1) ** 5)
    p_1 = ((x_f - x_0) * (120 * u_1**5 - 300 * u_1**4 + 200 * u_1**3) - 20 * (x_1 - x_0)) / (
        t_f**5 * denominator
    )
    u = np.linspace(0, u_1, 30)
    before = x_0 + t_f**5 / 720 * (
        p_1 * (u_1**4 * (15 * u**4 - 30 * u**3) + u_1**3 * (80 * u**3 - 30 * u**4)
               - 60 * u**3 * u_1**2 + 30 * u**4 * u_1 - 6 * u**5)
        + c_1 * (15 * u**4 - 10 * u**3 - 6 * u**5)
    )  # fmt: skip
    path = crane.via_points([0.0, u_1 * t_f, t_f], [[x_0], [x_1], [x_f]])
    assert np.abs(path.position(u * t_f)[:, 0] - before).max() < 1e-12


def test_it_is_the_spline_of_scipy():
    draw = np.random.default_rng(0)
    time = np.r_[0.0, np.cumsum(draw.uniform(0.05, 1.5, 30))]
    x = draw.normal(size=31) + 1000.0
    v = np.full(31, np.nan)
    v[[0, -1]] = 0.3, -0.2
    found = least_jerk(time, x, v)
    ends = ([(1, 0.3), (2, 0.0)], [(1, -0.2), (2, 0.0)])
    spline = make_interp_spline(time, x, k=5, bc_type=ends)
    size = np.abs(spline(time, 2)).max()
    assert np.abs(found[:, 1] - spline(time, 1)).max() < 1e-10 * size
    assert np.abs(found[:, 2] - spline(time, 2)).max() < 1e-10 * size


@pytest.mark.parametrize(
    ("time", "points", "rates", "line"),
    [
        ([0], [[1]], None, "two at least"),
        ([0, 1], [1, 2], None, "two at least"),
        ([0, 1, 1], [[1], [2], [3]], None, "times of via points do not increase from 0"),
        ([1, 2], [[1], [2]], None, "times of via points do not increase from 0"),
        ([0, np.nan], [[1], [2]], None, "times of via points do not increase from 0"),
        ([0, 1], [[1], [np.nan]], None, "the first and the last via point have to be complete"),
        ([0, 1], [[1], [np.inf]], None, "via points are infinite"),
        ([0, 1], [[1], [2]], [[1]], r"rates have the shape \(1, 1\)"),
        ([0, 1, 2], [[1], [np.nan], [2]], [[0], [1], [0]], "a rate is given where no point is"),
    ],
)
def test_bad_points(time, points, rates, line):
    with pytest.raises(InputError, match=line) as error:
        crane.via_points(time, points, rates)
    assert "\n" not in str(error.value)


# --- attitudes -------------------------------------------------------------------------------


def test_attitudes_turn_as_they_say():
    angles = np.array([[0, 0, 0], [1, 0.5, -2], [np.nan] * 3, [0.2, 3.0, 1.0]])
    rates = np.full((4, 3), np.nan)
    rates[1] = 0.3, -0.2, 0.5
    path = crane.motion.via_attitudes([0, 1, 1.5, 2], angles, rates)
    rotation, velocity, _ = path(np.array([0.0, 1.0, 2.0]))
    assert np.abs(rotation - roll_pitch_yaw(angles[[0, 1, 3]])).max() < 1e-13
    step = 1e-6
    moved = (
        roll_pitch_yaw(angles[1] + step * rates[1]) @ roll_pitch_yaw(angles[1] - step * rates[1]).T
    )
    assert velocity[1] == pytest.approx(pin.log3(moved) / (2 * step), abs=1e-9)
    assert np.abs(velocity[[0, 2]]).max() < 1e-12
    time, step = np.linspace(0.01, 1.99, 50), 1e-5
    _, velocity, acceleration = path(time)
    ahead, back = path(time + step), path(time - step)
    turned = [pin.log3(a @ b.T) for a, b in zip(ahead[0], back[0], strict=True)]
    assert np.abs(np.array(turned) / (2 * step) - velocity).max() < 1e-7
    assert np.abs((ahead[1] - back[1]) / (2 * step) - acceleration).max() < 1e-6
    one = path(1.0)
    assert one[0].shape == (3, 3) and one[1].shape == (3,)


def test_attitudes_go_on_beyond_half_a_turn():
    """0, 2, 4 rad about one axis is a turn of 4 rad, not one of 2 back."""
    path = crane.motion.via_attitudes([0, 1, 2], [[0, 0, 0], [0, 0, 2.0], [0, 0, 4.0]])
    rate = path(np.linspace(0, 2, 50))[1]
    assert rate[1:-1, 2].min() > 0 and np.abs(rate[:, :2]).max() < 1e-12
    with pytest.raises(InputError, match=r"the attitude at 2 s is 6\.1 rad from the first one"):
        crane.motion.via_attitudes([0, 1, 2], [[0, 0, 0], [0, 0, 3.1], [0, 0, 6.1]])
    with pytest.raises(InputError, match=r"attitudes have the shape \(1, 2\)"):
        crane.motion.via_attitudes([0], [[0, 0]])


# --- inverse kinematics ----------------------------------------------------------------------


def drawn(machine, count, seed):
    draw = np.random.default_rng(seed)
    low, high = np.maximum(machine.lower, -1.5), np.minimum(machine.upper, 1.5)
    middle, half = (low + high) / 2, 0.4 * (high - low)
    return middle + half * draw.uniform(-1, 1, (count, len(low)))


def test_inclination_is_the_angle_above_the_horizon(excavator):
    """By Pinocchio: asin of the x axis, while the other axis points up; and on beyond it."""
    kinematics, machine = crane.Kinematics(excavator), excavator
    over = 0
    for q_a in drawn(excavator, 40, 0):
        data = machine.model.createData()
        at = machine.coordinates.configuration(machine.closure.solve(q_a))
        pin.framesForwardKinematics(machine.model, data, at)
        axes = data.oMf[machine.frame("bucket_lip")].rotation
        found = float(kinematics.inclination(q_a))
        elevation = np.arcsin(axes[2, 0])
        wanted = elevation if axes[2, 1] > 0 else np.sign(found) * np.pi - elevation
        over += axes[2, 1] < 0
        assert found == pytest.approx(wanted, abs=1e-7)
    assert over > 5  # beyond the vertical


def test_inclination_grows_with_the_bucket_and_does_not_jump(excavator):
    """Through the whole stroke of the bucket its angle and its inclination change alike."""
    machine = excavator
    home = machine.home[machine.closure.active]
    strokes = np.tile(home, (60, 1))
    strokes[:, 3] = np.linspace(machine.lower[3], machine.upper[3], 60)
    bucket = machine.closure.solve(strokes)[:, machine.column("bucket")]
    found = np.unwrap(crane.Kinematics(machine).inclination(strokes))
    assert np.ptp(found) > 2.5
    assert np.abs((found - bucket) - (found - bucket)[0]).max() < 1e-12


def test_an_axis_along_y_counts_alike(tmp_path):
    """A boom about -y lifts its x axis, one about y lowers it."""
    for axis, sign in (("0 -1 0", 1.0), ("0 1 0", -1.0)):
        machine = crane.load(_boom(tmp_path, axis))
        kinematics = crane.Kinematics(machine, "tool")
        assert kinematics.inclination([0.3, 0.4, 0.5]) == pytest.approx(sign * 1.2)
        rows = kinematics.jacobian([0.3, 0.4, 0.5], "inclination")
        assert rows[3] == pytest.approx([sign] * 3)


def _boom(folder, axis):
    text = '<robot name="boom"><link name="base"/>'
    for i in range(3):
        parent = f"link{i - 1}" if i else "base"
        text += (
            f'<link name="link{i}"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" '
            f'iyy="1" iyz="0" izz="1"/></inertial></link><joint name="q{i}" type="revolute">'
            f'<origin xyz="1 0 0"/><parent link="{parent}"/><child link="link{i}"/>'
            f'<axis xyz="{axis}"/>'
            f'<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>'
        )
    text += (
        '<link name="tool"/><joint name="tip" type="fixed"><origin xyz="1 0 0"/>'
        '<parent link="link2"/><child link="tool"/></joint></robot>'
    )
    path = folder / "boom.urdf"
    path.write_text(text)
    return path


def test_three_drives_in_a_plane_have_position_and_inclination(tmp_path):
    machine = crane.load(_boom(tmp_path, "0 -1 0"))
    kinematics = crane.Kinematics(machine, "tool")
    q_a = np.array([0.4, 0.7, -0.5])
    found = kinematics.inverse(
        kinematics.position(q_a), q_a + 0.2, attitude=kinematics.inclination(q_a)
    )
    assert np.abs(found - q_a).max() < 1e-10


@pytest.mark.parametrize(
    ("name", "attitude"), [("excavator", "inclination"), ("kr300", "rotation")]
)
def test_jacobian_and_bias_with_an_attitude(name, attitude, request):
    """Against differences of forward kinematics along a curve q + v s + a s^2/2."""
    machine = request.getfixturevalue({"kr300": "kr300"}.get(name, name))
    kinematics, draw = crane.Kinematics(machine), np.random.default_rng(2)
    for q_a in drawn(machine, 6, 3):
        v_a, a_a = 0.3 * draw.normal(size=(2, len(q_a)))
        step = 1e-3

        def rate(s, q_a=q_a, v_a=v_a, a_a=a_a):
            q, v = q_a + v_a * s + a_a * s * s / 2, v_a + a_a * s
            return kinematics.jacobian(q, attitude) @ v

        along = kinematics.jacobian(q_a, attitude) @ a_a + kinematics.bias(q_a, v_a, attitude)
        second = (8 * (rate(step) - rate(-step)) - (rate(2 * step) - rate(-2 * step))) / 12 / step
        assert np.abs(second - along).max() < 1e-7 * (1 + np.abs(along).max())
        ahead, back = q_a + 1e-5 * v_a, q_a - 1e-5 * v_a
        moved = (kinematics.position(ahead) - kinematics.position(back)) / 2e-5
        if attitude == "inclination":
            turned = [(kinematics.inclination(ahead) - kinematics.inclination(back)) / 2e-5]
        else:
            turned = pin.log3(kinematics.rotation(ahead) @ kinematics.rotation(back).T) / 2e-5
        assert np.abs(rate(0.0) - np.concatenate([moved, turned])).max() < 1e-7


def test_positions_and_inclinations_come_back(excavator):
    kinematics = crane.Kinematics(excavator)
    for q_a in drawn(excavator, 8, 4):
        position, inclination = kinematics.position(q_a), kinematics.inclination(q_a)
        for whole in (0.0, 2 * np.pi):  # whole turns count the same
            found = kinematics.inverse(position, attitude=inclination + whole)
            assert np.abs(kinematics.position(found) - position).max() < 1e-10
            off = kinematics.inclination(found) - inclination
            assert np.abs((off + np.pi) % (2 * np.pi) - np.pi) < 1e-10


def test_positions_and_rotations_come_back(kr300):
    kinematics, drawn_at = crane.Kinematics(kr300), drawn(kr300, 8, 5)
    positions, rotations = kinematics.position(drawn_at), kinematics.rotation(drawn_at)
    for k, (position, rotation) in enumerate(zip(positions, rotations, strict=True)):
        given = rotation if k % 2 else pin.rpy.matrixToRpy(rotation)
        found = kinematics.inverse(position, attitude=given)
        assert np.abs(kinematics.position(found) - position).max() < 1e-10
        assert np.abs(kinematics.rotation(found) - rotation).max() < 1e-10


def test_a_line_with_constant_inclination(excavator):
    kinematics = crane.Kinematics(excavator)
    start = kinematics.position(excavator.home[excavator.closure.active])
    tip = crane.via_points([0.0, 4.0], [start, start + [-2.0, 0.5, 0.1]])
    held = crane.via_points([0.0, 4.0], [[-1.2], [-1.2]])
    path = crane.tip_trajectory(excavator, tip, attitude=held)
    time = np.random.default_rng(0).uniform(0, 4, 100)
    q_a, v_a, a_a = path(time)
    assert np.abs(kinematics.position(q_a) - tip.position(time)).max() < 1e-11
    assert np.abs(kinematics.inclination(q_a) + 1.2).max() < 1e-11
    jacobian = kinematics.jacobian(q_a, "inclination")
    wanted = [np.hstack([x, y]) for x, y in zip(tip(time)[1:], held(time)[1:], strict=True)]
    assert np.abs(np.einsum("nij,nj->ni", jacobian, v_a) - wanted[0]).max() < 1e-10
    bias = kinematics.bias(q_a, v_a, "inclination")
    second = np.einsum("nij,nj->ni", jacobian, a_a) + bias
    assert np.abs(second - wanted[1]).max() < 1e-7
    assert path.tip is tip and path.attitude is held


def test_a_robot_turns_its_flange_on_the_way(kr300):
    kinematics = crane.Kinematics(kr300)
    ends = np.array([[0.2, -1.4, 1.5, 0.3, 0.9, 0.1], [-0.4, -1.2, 1.2, -0.5, 1.2, 0.8]])
    ends += kr300.home[kr300.closure.active] - kr300.home[kr300.closure.active]
    tip = crane.via_points([0.0, 2.0], kinematics.position(ends))
    angles = [pin.rpy.matrixToRpy(rotation) for rotation in kinematics.rotation(ends)]
    turning = crane.motion.via_attitudes([0.0, 2.0], angles)
    path = crane.tip_trajectory(kr300, tip, ends[0], turning)
    time = np.random.default_rng(0).uniform(0, 2, 60)
    q_a, v_a, a_a = path(time)
    rotation, rate, second = turning(time)
    assert np.abs(kinematics.position(q_a) - tip.position(time)).max() < 1e-9
    assert np.abs(kinematics.rotation(q_a) - rotation).max() < 1e-9
    jacobian = kinematics.jacobian(q_a, "rotation")
    found = np.einsum("nij,nj->ni", jacobian, v_a)
    assert np.abs(found - np.hstack([tip(time)[1], rate])).max() < 1e-7
    found = np.einsum("nij,nj->ni", jacobian, a_a) + kinematics.bias(q_a, v_a, "rotation")
    assert np.abs(found - np.hstack([tip(time)[2], second])).max() < 1e-4


def test_what_cannot_be_reached_is_told_with_time_and_amount(excavator):
    start = crane.Kinematics(excavator).position(excavator.home[excavator.closure.active])
    tip = crane.via_points([0.0, 4.0], [start, start - [3.0, 0, 0]])
    held = crane.via_points([0.0, 4.0], [[-1.0], [-1.0]])
    line = (
        r"cannot reach \(.*\) m with an inclination of -1 rad at t = \d\.\d+ s \(sample \d+\): "
        r"it stays [\d.e-]+ m and [\d.e-]+ rad away"
    )
    with pytest.raises(UnreachableTipError, match=line):
        crane.tip_trajectory(excavator, tip, attitude=held)
    with pytest.raises(InputError, match="the tip takes 4 s and its attitude 3 s"):
        crane.tip_trajectory(
            excavator, tip, attitude=crane.via_points([0.0, 3.0], [[-1.0], [-1.0]])
        )


@pytest.mark.parametrize(
    ("name", "attitude", "line"),
    [
        ("mini_forwarder", "inclination", "too few drives for inclination of 'link7_tip': they "
         "move it in 3 directions and rotate it in 0 further ones"),
        ("excavator", "rotation", "too few drives for roll, pitch, yaw of 'bucket_lip'"),
        ("patu655_grapple", "inclination", "the joint that turns it is upright at home"),
        ("kr300", "inclination", "'flange' of 'kr300' has no inclination: its drives tilt"),
        ("excavator", "inclinaton", "attitude 'inclinaton' is unknown, did you mean "
         "'inclination'"),
    ],
)  # fmt: skip
def test_attitudes_that_a_machine_does_not_have(name, attitude, line):
    machine = crane.load(name)
    with pytest.raises(InputError, match=line):
        crane.Kinematics(machine).jacobian(machine.home[machine.closure.active], attitude)


def test_bad_attitudes(excavator):
    kinematics = crane.Kinematics(excavator)
    for attitude, line in (
        ([1, 2], r"attitude has the shape \(2,\), give one of \(\), \(3,\), \(3, 3\)"),
        (np.nan, "attitude is nan"),
        (np.ones((3, 3)), "attitude is no rotation matrix"),
    ):
        with pytest.raises(InputError, match=line):
            kinematics.inverse([8.0, 0, 0], attitude=attitude)
    with pytest.raises(InputError, match="neither its y axis nor its z axis"):
        InclinationCoordinate(excavator, "base_link" if False else excavator.tree.root_link)


# --- tasks of a machine file -----------------------------------------------------------------


@pytest.fixture
def task(tmp_path):
    """A copy of the excavator's file with another task."""
    import shutil

    from crane.description.machine_lookup import bundled_machines

    source = bundled_machines()["excavator"]
    shutil.copytree(source.parent / "urdf" / "excavator", tmp_path / "urdf" / "excavator")
    text = source.read_text()
    start = text.index("\ntasks:") + 1
    end = text.index("\nhydraulics:")
    end = text.rindex("\n\n", 0, end)

    def load(*points, more=""):
        lines = "".join(f"      - {{{point}}}\n" for point in points)
        own = f"tasks:\n  go:\n{more}    via:\n{lines}"
        path = tmp_path / "excavator.yaml"
        path.write_text(text[:start] + own + text[end:])
        return crane.load(path), start

    load.line = text[:start].count("\n") + 1
    return load


STROKES = "slew: 0, X_boom: 0.82, X_arm: 0.476, X_bucket: 0.47"


def test_strokes_through_points(task, tmp_path):
    machine, _ = task(
        f"time: 0, {STROKES}",
        "time: 1, X_boom: 0.9, rates: {X_boom: 0.1}",
        "time: 2.5, X_arm: 0.6",
        f"time: 4, {STROKES}",
    )
    path = crane.task_trajectory(machine, "go")
    nan = np.nan
    home = [0, 0.82, 0.476, 0.47]
    points = [home, [nan, 0.9, nan, nan], [nan, nan, 0.6, nan], home]
    rates = np.full((4, 4), nan)
    rates[1, 1] = 0.1
    wanted = crane.via_points([0, 1, 2.5, 4], points, rates)
    time = np.linspace(0, 4, 57)
    assert np.abs(path.position(time) - wanted.position(time)).max() < 1e-14
    assert path(1.0)[1][1] == pytest.approx(0.1)
    # and through a file that is written
    again = crane.load(crane.write_machine(machine, tmp_path / "again"))
    assert again.tasks["go"] == machine.tasks["go"]
    assert again.tasks["go"].duration == 4.0
    locked = crane.load(machine.path, lock={"slew": 0.0})
    assert "go" not in locked.tasks


def test_tip_through_points_with_an_inclination(task, tmp_path):
    machine, _ = task(
        "time: 0, x: 8, y: 0, z: 0.3, inclination: -1.2",
        "time: 3, x: 7, z: 0.5, rates: {x: -0.4}",
        "time: 6, x: 6, y: 0.5, z: 0.3, inclination: -1.3",
    )
    path = crane.task_trajectory(machine, "go")
    kinematics = crane.Kinematics(machine)
    q_a, v_a, _ = path([0.0, 3.0, 6.0])
    assert np.abs(kinematics.position(q_a)[:, 0] - [8, 7, 6]).max() < 1e-10
    assert kinematics.inclination(q_a)[[0, 2]] == pytest.approx([-1.2, -1.3])
    assert kinematics.jacobian(q_a[1])[0] @ v_a[1] == pytest.approx(-0.4)
    again = crane.load(crane.write_machine(machine, tmp_path / "again"))
    assert again.tasks["go"] == machine.tasks["go"]
    # a task of the tip stays where others drive it
    assert "go" in crane.load(machine.path, lock={"slew": 0.0}).tasks


TIP = "x: 8, y: 0, z: 0.3"


@pytest.mark.parametrize(
    ("points", "more", "at", "line"),
    [
        ([f"time: 0, {STROKES}"], "", 2, "task 'go' has 1 via points, give two at least"),
        ([f"time: 0, {STROKES}", f"time: 1, {STROKES}", f"time: 1, {STROKES}"], "", 5,
         "times of task 'go' go from 1 to 1 s, let them increase"),
        ([f"time: 0.5, {STROKES}", f"time: 1, {STROKES}"], "", 3,
         "task 'go' begins at 0.5 s, give its first point the time 0"),
        ([f"time: 0, {STROKES}", f"{STROKES}"], "", 4, "a via point of task 'go' has no 'time'"),
        ([f"time: 0, {STROKES}", "time: 1, X_boom: 0.8"], "", 4,
         "the last via point of task 'go' has no 'slew', add it"),
        ([f"time: 0, {STROKES}", "time: 1, X_bom: 0.8", f"time: 2, {STROKES}"], "", 4,
         "unknown key 'X_bom' in a via point of task 'go', did you mean 'X_boom'?"),
        ([f"time: 0, {STROKES}", "time: 1, x: 8", f"time: 2, {STROKES}"], "", 4,
         "task 'go' mixes 'slew' with 'x', name joints or x, y, z"),
        ([f"time: 0, {STROKES}", "time: 1", f"time: 2, {STROKES}"], "", 4,
         "a via point of task 'go' has no coordinate, name some"),
        ([f"time: 0, {STROKES}", "time: .nan, X_boom: 1", f"time: 2, {STROKES}"], "", 4,
         "'time' of a via point of task 'go' is nan, give a finite number"),
        ([f"time: 0, {STROKES}", "time: 1, X_boom: .inf", f"time: 2, {STROKES}"], "", 4,
         "'X_boom' of a via point of task 'go' is inf, give a finite number"),
        ([f"time: 0, {STROKES}", "time: 1, X_boom: 0.9, rates: {X_arm: 1}", f"time: 2, {STROKES}"],
         "", 4, "unknown key 'X_arm' in 'rates' of a via point of task 'go', known: X_boom"),
        ([f"time: 0, {TIP}", "time: 1, inclination: 0", f"time: 2, {TIP}"], "", 3,
         "the first via point of task 'go' has no 'inclination', add it"),
        ([f"time: 0, {TIP}, inclination: 0", f"time: 2, {TIP}, roll: 0, pitch: 0, yaw: 0"], "", 3,
         "task 'go' has an inclination and roll, pitch, yaw, give one of both"),
        ([f"time: 0, {TIP}, roll: 0", f"time: 2, {TIP}, roll: 0"], "", 3,
         "task 'go' has 'roll' without the others of roll, pitch, yaw, add them"),
        ([f"time: 0, {TIP}", f"time: 2, {TIP}"], "    duration: 3\n", 2,
         "task 'go' ends at its last point, leave 'duration' out"),
        ([f"time: 0, {TIP}", f"time: 2, {TIP}"], "    active: {slew: [0]}\n", 2,
         "task 'go' has more than one of 'tip', 'active', 'via', 'joystick', 'phases', give one"),
        ([f"time: 0, {TIP}", f"time: 2, {TIP}"], "    start: {slew: 0}\n", 2,
         "task 'go' starts at its first, leave 'start' out"),
    ],
)  # fmt: skip
def test_bad_tasks(task, points, more, at, line):
    with pytest.raises(DescriptionError) as error:
        task(*points, more=more)
    assert str(error.value).startswith(f"excavator.yaml:{task.line + at}: {line}")


def test_a_task_without_drives_for_its_attitude_is_told(task):
    angles = "roll: 0, pitch: 0, yaw: 0"
    machine, _ = task(f"time: 0, {TIP}, {angles}", f"time: 2, {TIP}, {angles}")
    with pytest.raises(InputError, match="too few drives for roll, pitch, yaw of 'bucket_lip'"):
        crane.task_trajectory(machine, "go")


@pytest.mark.parametrize("degree", [0, 1, 2, 5])
@pytest.mark.parametrize("parts", [1, 4])
def test_piecewise_polynomials_are_those_of_scipy(degree, parts):
    draw = np.random.default_rng(degree)
    knots = np.r_[-0.3, np.cumsum(draw.uniform(0.1, 2.0, parts))]
    rows = draw.normal(size=(degree + 1, parts, 3))
    time = np.r_[knots, draw.uniform(-2.0, knots[-1] + 2.0, 50)]
    own, scipy_s = PiecewisePolynomial(rows, knots), PPoly(rows, knots)
    for order in range(degree + 2):
        wanted = scipy_s(time, order)
        size = np.abs(wanted).max() + 1e-300
        assert np.abs(own(time, order) - wanted).max() <= 1e-13 * size
        assert np.abs(own.derivative(order)(time) - wanted).max() <= 1e-13 * size
        assert own(time[0], order).shape == (3,)
    roots, wanted = own.roots(), scipy_s.roots(extrapolate=False)
    assert all(map(np.array_equal, np.ravel(roots), np.ravel(wanted)))
