"""Reference motions: paths, files, and the paper's statements about its trajectories."""

import dataclasses
import warnings

import numpy as np
import pytest
from command_line import typed
from hydraulic_rig import STROKE, rig
from warned import without_a_word

import crane
from crane.common.errors import (
    CraneError,
    CraneWarning,
    InputError,
    LimitError,
    UnreachableTipError,
)


@pytest.fixture(scope="module")
def tasks(mini):
    return {name: crane.task_trajectory(mini, name) for name in ("loading", "return", "lift")}


# --- the facts of the paper ------------------------------------------------------------------


def test_tasks_are_the_published_polynomials(mini, tasks):
    for name, start, end in (
        ("loading", (0.0, -0.2676, -0.0521), (0.2828, 0.0014, 0.0987)),
        ("return", (0.2828, 0.0014, 0.0987), (-0.0189, -0.2676, -0.0426)),
        ("lift", (0.37439, 0.0, -0.06156), (0.3882, 0.0, 0.1307)),
    ):
        path = tasks[name]
        assert path.duration == 10.0 and path.tip.duration == 10.0
        ends = path.tip(np.array([0.0, 10.0]))[0]
        # printed to 0.1 mm, coefficients to five digits
        assert np.abs(ends - [start, end]).max() < 1.5e-4
        tip = crane.Kinematics(mini).position(path(np.array([0.0, 10.0]))[0])
        assert np.abs(tip - ends).max() < 1e-12


def test_strokes_of_all_tasks_stay_within_their_limits(mini, tasks):
    for path in tasks.values():
        q_a = path(np.linspace(0, 10, 2001))[0]
        mini.check_limits(q_a)


# --- paths of the tip ------------------------------------------------------------------------


def test_tip_follows_its_path_between_knots(mini, tasks):
    """Knots lie 10 ms apart; quintics miss by less than rounding of the inverse kinematics."""
    kinematics = crane.Kinematics(mini)
    time = np.random.default_rng(0).uniform(0, 10, 120)
    for path in tasks.values():
        q_a, v_a, a_a = path(time)
        x, x_rate, x_second = path.tip(time)
        jacobian = kinematics.jacobian(q_a)
        assert np.abs(kinematics.position(q_a) - x).max() < 1e-12
        assert np.abs(np.einsum("nij,nj->ni", jacobian, v_a) - x_rate).max() < 1e-11
        second = np.einsum("nij,nj->ni", jacobian, a_a) + kinematics.bias(q_a, v_a)
        assert np.abs(second - x_second).max() < 1e-9


def test_fast_tip_paths_are_followed_too(mini):
    """Half a second: the curve between knots bends a thousand times more."""
    kinematics = crane.Kinematics(mini)
    start, end = kinematics.position([[0.0, 0.006, 0.005], [0.8, 0.024, 0.02]])
    path = crane.tip_trajectory(
        mini, crane.point_to_point(start, end, 0.5), initial_guess=[0.0, 0.006, 0.005]
    )
    time = np.linspace(0, 0.5, 333)
    q_a, v_a, _ = path(time)
    assert np.abs(q_a[0] - [0.0, 0.006, 0.005]).max() < 1e-10
    assert np.abs(kinematics.position(q_a) - path.tip(time)[0]).max() < 1e-9
    rate = np.einsum("nij,nj->ni", kinematics.jacobian(q_a), v_a)
    assert np.abs(rate - path.tip(time)[1]).max() < 1e-7
    assert np.abs(path(np.array([0.0, 0.5]))[1]).max() < 1e-12


def test_paths_out_of_reach_name_the_sample(mini):
    start = crane.Kinematics(mini).position([0.0, 0.015, 0.015])
    line = crane.point_to_point(start, start + [0.5, 0, 0], 1.0)
    with pytest.raises(UnreachableTipError, match=r"cannot reach .*\(sample \d+\)"):
        crane.tip_trajectory(mini, line)


def test_task_in_active_coordinates(edited):
    task = "tip: rod_middle\ntasks:\n  turn: {{duration: 2, active: {{theta: [{}]}}}}"
    machine = edited("slider_crank.yaml", "tip: rod_middle", task.format("0.5, 1.0"))
    path = crane.task_trajectory(machine, "turn")
    assert path(1.0)[0] == pytest.approx([1.5]) and path(1.0)[1] == pytest.approx([1.0])
    assert path.tip is None
    with pytest.raises(InputError, match="no task 'tern', did you mean 'turn'"):
        crane.task_trajectory(machine, "tern")
    machine = edited("slider_crank.yaml", "tip: rod_middle", task.format("0.5, 2.0"))
    with pytest.raises(LimitError, match=r"task 'turn': the reference of 'theta' goes to"):
        crane.task_trajectory(machine, "turn")


# --- polynomials -----------------------------------------------------------------------------


def test_polynomial_and_its_derivatives():
    path = crane.motion.polynomial([[1.0, 2.0, 3.0, 4.0], [5.0]], 2.0)
    position, velocity, acceleration = path(0.5)
    assert position == pytest.approx([1 + 1 + 0.75 + 0.5, 5])
    assert velocity == pytest.approx([2 + 3 + 3, 0])
    assert acceleration == pytest.approx([6 + 12, 0])
    values = path(np.array([0.0, 0.5, 2.0]))
    assert [value.shape for value in values] == 3 * [(3, 2)]
    assert np.array_equal(values[0][1], position)


def test_before_and_after_it_stands_still():
    path = crane.motion.polynomial([[1.0, 2.0, 3.0]], 2.0)
    position, velocity, acceleration = path(np.array([-1.0, -1e-9, 2.0 + 1e-9, 5.0]))
    assert position[:, 0] == pytest.approx([1, 1, 17, 17])
    assert np.all(velocity == 0) and np.all(acceleration == 0)
    assert path(2.0)[1][0] == pytest.approx(14)  # the end itself still moves


def test_point_to_point_has_the_least_jerk():
    start, end, duration = np.array([0.1, -2.0, 3.0]), np.array([0.4, -2.0, 1.0]), 1.6
    path = crane.point_to_point(start, end, duration)
    position, velocity, acceleration = path(np.array([0, duration / 2, duration]))
    assert position == pytest.approx(np.array([start, (start + end) / 2, end]), abs=1e-14)
    assert velocity[1] == pytest.approx(15 / 8 * (end - start) / duration)
    assert np.abs(velocity[[0, 2]]).max() < 1e-14
    assert np.abs(acceleration).max() < 1e-13  # at rest, and symmetric about the middle
    # the solution of d6x/dt6 = 0 with these ends: the jerk is a parabola 60 - 360 u + 360 u^2
    step = 1e-3 * duration
    u = np.array([0.2, 0.6])
    jerk = (path(u * duration + step)[2] - path(u * duration - step)[2]) / (2 * step)
    shape = 60 - 360 * u + 360 * u**2
    # a difference of a cubic adds its third derivative times step^2 / 6
    assert jerk[:, 0] == pytest.approx(shape * 0.3 / duration**3, rel=1e-4)


def test_bad_arguments(mini):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for call, text in (
            (
                lambda: crane.motion.polynomial([[1.0]], 0.0),
                "duration is 0.0 s, give a number above 0",
            ),
            (lambda: crane.motion.polynomial([[1.0]], np.nan), "duration is nan s"),
            (lambda: crane.motion.polynomial([], 1.0), "coefficients"),
            (lambda: crane.motion.polynomial([[np.inf]], 1.0), "coefficients are not finite"),
            (lambda: crane.motion.polynomial([["a"]], 1.0), "coefficients"),
            (lambda: crane.point_to_point([0, 0], [1, 1], 0.0), "duration is 0.0 s"),
            (lambda: crane.point_to_point([0, 0], [1, 1], -1.0), "duration is -1.0 s"),
            (lambda: crane.point_to_point([0, 0], [1, 1, 1], 1.0), r"end has the shape \(3,\)"),
            (lambda: crane.point_to_point([0, np.nan], [1, 1], 1.0), "start is nan"),
            (lambda: crane.point_to_point("ab", [1, 1], 1.0), "start is not made of real numbers"),
            (
                lambda: crane.task_trajectory(mini, "dance"),
                "no task 'dance', known: lift, loading",
            ),
            (
                lambda: crane.tip_trajectory(mini, crane.motion.polynomial([[0.3], [0.0]], 1.0)),
                "shape",
            ),
        ):
            with pytest.raises(InputError, match=text):
                call()


def test_redundant_arms_move_smoothly():
    arm = crane.load("ur5_robot")
    arm = dataclasses.replace(arm, tip="tool0")
    kinematics = crane.Kinematics(arm)
    q_a = np.array([0.3, -1.2, 1.4, -0.5, 0.4, 0.2])
    start = kinematics.position(q_a)
    line = crane.point_to_point(start, start + [0.05, 0.1, -0.08], 1.0)
    path = crane.tip_trajectory(arm, line, initial_guess=q_a)
    time = np.linspace(0, 1, 997)
    position, velocity, acceleration = path(time)
    np.testing.assert_allclose(kinematics.position(position), line(time)[0], atol=1e-7)
    step = time[1] - time[0]
    slope = (position[2:] - position[:-2]) / (2 * step)
    np.testing.assert_allclose(velocity[1:-1], slope, atol=1e-4)
    assert np.abs(acceleration).max() < 5  # [rad/s2]; the line itself takes 2.4


# --- motions from files -------------------------------------------------------------------------


def written(folder, text, name="path.csv"):
    path = folder / name
    path.write_text(text)
    return path


def test_a_path_of_the_tip_with_its_inclination(tmp_path):
    """Time may begin anywhere, angles and lengths are converted."""
    machine = crane.load("excavator")
    path = written(
        tmp_path,
        "time [s],x [mm],y [m],z [m],inclination [deg]\n"
        "3,8000,0,0.3,-70\n5,7000,0.5,0.3,-80\n8,6000,0,0.3,-70\n",
    )
    motion = crane.motion.read_path(machine, path)
    kinematics = crane.Kinematics(machine)
    q_a, v_a, _ = motion([0.0, 2.0, 5.0])
    places = kinematics.positions_at_configurations(machine.closure.solve(q_a))
    np.testing.assert_allclose(places, [[8, 0, 0.3], [7, 0.5, 0.3], [6, 0, 0.3]], atol=1e-9)
    angles = [float(np.rad2deg(kinematics.inclination(q))) for q in q_a]
    np.testing.assert_allclose(angles, [-70, -80, -70], atol=1e-8)
    assert motion.duration == 5.0 and np.abs(v_a[[0, 2]]).max() < 1e-9 < np.abs(v_a[1]).max()


def test_what_a_run_recorded_is_a_path(tmp_path):
    """Columns beside the driven joints are those of a recording, and what it did is exact."""
    machine = crane.load("mini_forwarder")
    task = crane.task_trajectory(machine, "lift")
    drive = crane.ComputedTorque(machine, task)
    run = crane.simulate(machine, drive, step=0.01, duration=2.0)
    run.to_csv(tmp_path / "run.csv")
    motion = without_a_word(crane.motion.read_path, machine, tmp_path / "run.csv")
    np.testing.assert_allclose(motion.position(run.time), run.q, rtol=0, atol=1e-12)
    between = np.linspace(0.5, 1.5, 777)
    assert np.abs(motion.position(between) - task.position(between)).max() < 1e-6


def test_noise_is_taken_off(tmp_path):
    """1 s of a known motion under noise of 0.1 mm: what is left is far less, in rates, too."""
    machine = rig(tmp_path)
    truth = crane.point_to_point([0.1], [0.4], 4.0)
    time = np.arange(0, 4.0005, 0.005)
    noisy = truth.position(time)[:, 0] + np.random.default_rng(1).normal(0, 1e-4, len(time))
    rows = "".join(f"{t:.4f},{x:.7f}\n" for t, x in zip(time, noisy, strict=True))
    path = written(tmp_path, f"time [s],x [m]\n{rows}")
    told = r"path\.csv: 'x' scatters by (0\.0001|9\.\d+e-05) m, followed up to [\d.]+ Hz"
    with pytest.warns(CraneWarning, match=told):
        motion = crane.motion.read_path(machine, path)
    inside = time[100:-100]
    x, v, a = (np.array(part)[:, 0] for part in motion(inside))
    x_true, v_true, a_true = (np.array(part)[:, 0] for part in truth(inside))
    assert np.sqrt(np.mean((x - x_true) ** 2)) < 2.5e-5
    assert np.abs(v - v_true).max() < 0.02 * np.abs(v_true).max()
    assert np.abs(a - a_true).max() < 0.15 * np.abs(a_true).max()


JOINTS = "time [s],q1 [rad],X1 [m],X2 [m]"
TIP = "time [s],x [m],y [m],z [m]"
BAD = {
    "missing joint": ("time [s],X1 [m],X2 [m]\n0,0.01,0.02\n1,0.02,0.02\n", "'q1' is missing"),
    "unknown": (f"{JOINTS},X3\n0,0,0.01,0.02,1\n1,0,0.02,0.02,1\n", "'X3' is unknown"),
    "nothing": ("time [s],a [m]\n0,1\n1,2\n", "has no column of a path, give time and q1, X1, X2"),
    "axis": ("time [s],x [m],z [m]\n0,1,1\n1,2,1\n", "'y' is missing"),
    "unit": ("time [s],q1 [bar],X1 [m],X2 [m]\n0,0,0.01,0.02\n1,0,0.02,0.02\n", "in [Pa], give"),
    "back": (f"{JOINTS}\n0,0,0.01,0.02\n2,0,0.02,0.02\n1,0,0.02,0.02\n", "increasing"),
    "one": (f"{JOINTS}\n0,0,0.01,0.02\n", "give two"),
    "word": (f"{JOINTS}\n0,0,0.01,0.02\n1,0,much,0.02\n", "line 3"),
    "limit": (f"{JOINTS}\n0,0,0.01,0.02\n1,0,0.05,0.02\n", "beyond its limit 0.03 m"),
    "reach": (f"{TIP}\n0,9,0,0\n1,9,0,1\n", "cannot reach (9, 0, 0) m at t = 0 s"),
    "attitude": (f"{TIP},roll [rad]\n0,0.3,0,0,0\n1,0.3,0,0.01,0\n", "'pitch' is missing"),
    "both": (f"{TIP},roll,inclination [rad]\n0,0.3,0,0,0,0\n1,0.3,0,0,0,0\n", "one of both"),
    "drives": (f"{TIP},inclination [rad]\n0,0.3,0,0,0\n1,0.3,0,0,0\n", "too few drives"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_bad_paths_are_refused_in_one_line(tmp_path, what):
    text, line = BAD[what]
    path = written(tmp_path, text)
    done = typed("simulate", "mini_forwarder", "--path", path, "--out", tmp_path / "run")
    assert done.returncode == 2 and line in done.stderr, done.stderr
    (error,) = (x for x in done.stderr.splitlines() if x.startswith("error"))
    assert what == "reach" or "path.csv" in error
    assert not (tmp_path / "run").exists()


def test_a_path_does_not_go_with_a_task(tmp_path):
    path = written(tmp_path, "time [s],q1 [rad],X1 [m],X2 [m]\n0,0,0.01,0.02\n1,0,0.02,0.02\n")
    for option in ("--task", "--inputs"):
        done = typed(
            "simulate", "mini_forwarder", "--path", path, option, "lift", "--out", tmp_path / "run"
        )
        assert done.returncode == 2 and "--path" in done.stderr and not (tmp_path / "run").exists()


def test_a_run_along_a_path_keeps_to_it(tmp_path):
    """By forces on the command line: a path of 1.2345 s takes whole steps."""
    path = written(
        tmp_path, "time [s],q1 [rad],X1 [m],X2 [m]\n0,0,0.01,0.02\n1.2345,0.1,0.02,0.02\n"
    )
    out = tmp_path / "run"
    done = typed(
        "simulate", "mini_forwarder", "--path", path, "--controller", "computed-torque",
        "--out", out,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    run = crane.Recording.from_csv(next(out.glob("*.csv")))
    assert run.time[-1] == pytest.approx(1.235) and run.task == "path"
    np.testing.assert_allclose(run.q[-1], [0.1, 0.02, 0.02], atol=1e-6)


def test_levers_begin_where_their_task_says(tmp_path):
    machine = rig(tmp_path)
    text = (tmp_path / "rig.yaml").read_text()

    def with_start(value):
        levers = f"duration: 1, start: {{x: {value}}}, joystick: {{x: [0, 0, 1, 0]}}"
        task = f"tasks:\n  up: {{{levers}}}\n"
        (tmp_path / "rig.yaml").write_text(text + task)
        return crane.load(tmp_path / "rig.yaml")

    machine = with_start(0.35)
    run = crane.simulate(machine, crane.joystick(machine, "up"), duration=0.1)
    assert run.q[0, 0] == pytest.approx(0.35, abs=1e-12)
    own = crane.simulate(machine, crane.joystick(machine, "up"), [0.1], duration=0.1)
    assert own.q[0, 0] == pytest.approx(0.1, abs=1e-12)
    crane.write_machine(machine, tmp_path / "again")
    assert crane.load(next((tmp_path / "again").glob("*.yaml"))).tasks["up"].start == {"x": 0.35}
    far = with_start(STROKE + 0.1)
    with pytest.raises(LimitError, match="the start of task 'up': x = 0.635 is outside"):
        crane.joystick(far, "up")
    with pytest.raises(InputError):
        crane.motion.read_path(machine, written(tmp_path, "time [s],y\n0,1\n1,2\n"))
    with pytest.raises(CraneError):
        with_start("high")
