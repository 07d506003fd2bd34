"""Reference motions, and the paper's statements about its three trajectories."""

import dataclasses
import warnings

import numpy as np
import pytest
from scipy.optimize import brentq

import crane
from crane.common.errors import InputError, LimitError, UnreachableTipError

MM = 1e-3


@pytest.fixture(scope="module")
def tasks(mini):
    return {name: crane.task_trajectory(mini, name) for name in ("loading", "return", "lift")}


# --- the facts of the paper ------------------------------------------------------------------


def reversals(path, joint, start=0.5, end=9.5):
    """Times between start and end at which an active joint turns round."""
    time = np.linspace(start, end, 901)
    speed = path(time)[1][:, joint]
    return [
        brentq(lambda t: path(t)[1][joint], a, b)
        for a, b, u, w in zip(time, time[1:], speed, speed[1:], strict=False)
        if u * w < 0
    ]


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


def test_velocity_of_x1_in_loading(tasks):
    """About -2 mm/s without abrupt change from second 2 to 8: -2.1 +- 0.1."""
    _, velocity, acceleration = tasks["loading"](np.linspace(2, 8, 601))
    x1 = velocity[:, 1] / MM
    assert x1.mean() == pytest.approx(-2.12, abs=0.005) and x1.std() == pytest.approx(
        0.106, abs=2e-3
    )
    assert x1.min() > -2.4 and x1.max() < -1.9
    assert np.abs(acceleration[:, 1]).max() < 0.5 * MM  # mm/s2


def test_x1_moves_an_order_more_than_x2_in_loading(tasks):
    q_a = tasks["loading"](np.array([0.0, 10.0]))[0]
    moved = np.abs(q_a[1] - q_a[0])
    assert moved[1] > 10 * moved[2]
    x2 = np.ptp(tasks["loading"](np.linspace(0, 10, 501))[0][:, 2])
    assert moved[1] > 8 * x2


def test_reversals_of_the_strokes(tasks):
    """Paper: X1 in trajectory 2 around second 7; X2 in trajectory 2 around second 4 and in
    trajectory 3 around second 6.
    """
    (time,) = reversals(tasks["return"], 1)
    assert time == pytest.approx(7.1, abs=0.05)
    highest = tasks["return"](time)[0][1] / MM
    assert highest == pytest.approx(29.985, abs=0.01)  # of 30 mm
    (time,) = reversals(tasks["return"], 2)
    assert time == pytest.approx(4.1, abs=0.05)
    (time,) = reversals(tasks["lift"], 2)
    assert time == pytest.approx(6.35, abs=0.05)
    assert reversals(tasks["loading"], 1) == reversals(tasks["lift"], 1) == []


def test_return_does_not_end_where_loading_starts(tasks):
    gap = tasks["return"].tip(10.0)[0] - tasks["loading"].tip(0.0)[0]
    assert np.linalg.norm(gap) == pytest.approx(0.021, abs=1e-3)


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
